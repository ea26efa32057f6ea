"""Limits of the measured force and of the command, their options, and the status of a tick."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from enum import IntFlag
from operator import sub
from typing import Any, final

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.realtime.steps import State, Vector, deviation, mean_move, moved
from torch_pbd.exceptions import InvalidParameterError

Numbers = Sequence[float] | Floats
Option = float | tuple[float, float] | None
"""Number for positions; for poses a pair, of positions and of rotations; None is the default."""

StartState = tuple[Vector | None, Vector | None, Vector]
"""Position, orientation and velocity; places are None where they are those of the schedule."""

# Units of rotations by the corresponding unit of positions.
_ANGULAR = {"N": "Nm", "N/s": "Nm/s", "units/s": "rad/s", "units/s^2": "rad/s^2"}
# Defaults and units of the options; empty defaults depend on other options.
_OPTIONS: dict[str, tuple[Vector, str]] = {
    "force_limit": ((200.0, 20.0), "N"),
    "spring_limit": ((), "N"),
    "deadband": ((0.0, 0.0), "N"),
    "force_rate_limit": ((math.inf, math.inf), "N/s"),
    "velocity_limit": ((math.inf, math.inf), "units/s"),
    "acceleration_limit": ((math.inf, math.inf), "units/s^2"),
    "approach_speed": ((0.5, 1.0), "units/s"),
    "stop_deceleration": ((), "units/s^2"),
}
_OFF = 1e-3  # tolerance of a quaternion's length, which admits four rounded digits
# A median of five is a good force after one or two wild ones, and 2 ms late at 1 kHz.
_RECENT = 5


class TickStatus(IntFlag):
    """Faults of a tick; 0, which is false, where there was none."""

    FORCE_INVALID = 1
    """The force was NaN or infinite: the median of the last good ones acts, fading."""
    FORCE_SATURATED = 2
    """The force was longer than ``force_limit`` and was shortened to it."""
    CLOCK = 4
    """``now`` did not increase, or is not finite: the robot brakes over a tick as long as they are."""
    LATE = 8
    """More than ``max_step`` after the last tick: the robot has braked meanwhile, and goes on from there."""
    SPRING_LIMITED = 16
    """The stiffness was scaled down for ``spring_limit``."""
    ACCELERATION_LIMITED = 32
    """``acceleration_limit`` acted."""
    VELOCITY_LIMITED = 64
    """``velocity_limit`` acted."""
    STOPPED = 128
    """Force or clock were bad for too long: the robot brakes and then stands still, until ``start``."""
    FORCE_RATE_LIMITED = 256
    """The force changed faster than ``force_rate_limit``."""

    def __str__(self) -> str:
        return self.name or "fine"


# Ticks compare statuses with this one by identity, and join only faults: to join two takes a third of a tick.
FINE = TickStatus(0)


def options_of_blocks(given: Mapping[str, Any], n_blocks: int) -> dict[str, Vector]:
    """Options for positions, and for poses also for rotations."""
    values = {}
    for name, (default, unit) in _OPTIONS.items():
        value = given[name]
        if value is None:
            values[name] = default[:n_blocks]
        elif n_blocks == 1:
            values[name] = (_checked(value, name, unit),)
        elif isinstance(value, Sequence) and len(value) == 2:
            values[name] = _checked(value[0], f"{name}[0]", unit), _checked(value[1], f"{name}[1]", _ANGULAR[unit])
        else:
            raise checks.refusal(value, name, f"a pair for poses, in {unit} and {_ANGULAR[unit]}")
    values["spring_limit"] = values["spring_limit"] or values["force_limit"]
    return values


def _checked(value: Any, name: str, unit: str) -> float:
    if name.startswith("deadband"):
        return checks.number(value, name, least=0.0, unit=unit)
    return checks.number(value, name, above=0.0, unit=unit)


def finite_floats(values: Numbers | None, name: str, d: int) -> Vector:
    """Finite floats, one per axis; zeros for None."""
    return (0.0,) * d if values is None else tuple(checks.array(values, name, (d,)).tolist())


def start_state(
    position: Numbers | None,
    orientation: Numbers | None,
    velocity: Numbers | None,
    blocks: Sequence[slice],
    speed_limits: Vector,
) -> StartState:
    """Checked initial state of a robot, at rest where no velocity is given."""
    here = None if position is None else finite_floats(position, "position", blocks[0].stop)
    turned: Vector | None = None
    if orientation is not None:
        if len(blocks) == 1:
            raise InvalidParameterError("orientation is given, must be None for a schedule without: leave it out.")
        quaternion = checks.array(orientation, "orientation", (4,))
        length, remedy = float(np.linalg.norm(quaternion)), "give a unit quaternion w x y z"
        checks.number(length, "the length of orientation", least=1.0 - _OFF, most=1.0 + _OFF, remedy=remedy)
        turned = tuple((quaternion / length).tolist())
    moving, remedy = finite_floats(velocity, "velocity", blocks[-1].stop), "slow it down, or raise velocity_limit"
    kinds = ("the speed", "units/s"), ("the angular speed", "rad/s")
    for (name, unit), block, most in zip(kinds, blocks, speed_limits, strict=False):
        checks.number(math.hypot(*moving[block]), name, most=most, unit=unit, remedy=remedy)
    return here, turned, moving


@final
class ForceChannel:
    """Force, and for poses torque, that acts in a tick, each within its own limits."""

    push: Vector

    def __init__(self, options: Mapping[str, Vector], blocks: Sequence[slice], hold_ticks: int) -> None:
        checks.count(hold_ticks, "hold_ticks", least=0)
        limits = [options[name] for name in ("force_limit", "deadband", "force_rate_limit")]
        self._vectors = [
            (_ForceVector(limit, deadband, rate_limit, hold_ticks), block)
            for limit, deadband, rate_limit, block in zip(*limits, blocks, strict=True)
        ]
        self._n_axes, self._only = blocks[-1].stop, self._vectors[0][0] if len(blocks) == 1 else None

    def begin(self, bias: Vector) -> None:
        """Clear all forces; the force before the first tick is zero."""
        self.push, self._bias = (0.0,) * self._n_axes, bias if any(bias) else None
        for vector, block in self._vectors:
            vector.begin(block.stop - block.start)

    @property
    def is_lost(self) -> bool:
        """Whether the force or the torque has been missing for longer than it is replaced."""
        return any(vector.is_lost for vector, _ in self._vectors)

    def take(self, force: Numbers, step: float) -> TickStatus:
        """Let a measured force act within the limits, ``step`` s after the last one."""
        try:
            push = (*map(float, force),)  # tuple() of an iterator leaves one more tuple on Python's free list each time
        except (TypeError, ValueError, OverflowError):
            push = ()
        if len(push) != self._n_axes:
            raise checks.refusal(force, "force", f"{self._n_axes} numbers in N and Nm")
        if self._bias:
            push = (*map(sub, push, self._bias),)
        if self._only:
            status = self._only.take(push, step)
            self.push = self._only.push
            return status
        status, self.push = FINE, ()
        for vector, block in self._vectors:
            reached = vector.take(push[block], step)
            status = status if reached is FINE else status | reached
            self.push += vector.push
        return status


@final
class _ForceVector:
    """A force or a torque; one that is lost is replaced by the median of the last good ones, on each axis.

    That fades to nothing over ``hold_ticks``: neither a wild reading before the loss nor an old push can carry the
    robot away. After more ticks than that, it ``is_lost``.
    """

    push: Vector

    def __init__(self, limit: float, deadband: float, rate_limit: float, hold_ticks: int) -> None:
        self._limit, self._deadband, self._rate_limit, self._hold_ticks = limit, deadband, rate_limit, hold_ticks

    def begin(self, d: int) -> None:
        self.push, self._n_lost = (0.0,) * d, 0
        self._recent = deque([self.push] * _RECENT, _RECENT)

    @property
    def is_lost(self) -> bool:
        return self._n_lost > self._hold_ticks

    def take(self, push: Vector, step: float) -> TickStatus:
        if self._deadband:
            push = tuple([part - max(-self._deadband, min(self._deadband, part)) for part in push])
        length, status = math.hypot(*push), FINE
        if not length <= self._limit:
            if not length < math.inf:
                self._n_lost += 1
                share = max(0.0, 1.0 - self._n_lost / (self._hold_ticks + 1))
                self.push = tuple([share * sorted(parts)[_RECENT // 2] for parts in zip(*self._recent, strict=True)])
                return TickStatus.FORCE_INVALID
            push, status = tuple([part / length * self._limit for part in push]), TickStatus.FORCE_SATURATED
        if self._rate_limit < math.inf:
            change, most = math.dist(push, self.push), self._rate_limit * step
            if change > most:
                push = tuple([old + most / change * (new - old) for old, new in zip(self.push, push, strict=True)])
                status |= TickStatus.FORCE_RATE_LIMITED
        self.push, self._n_lost = push, 0
        self._recent.append(push)
        return status


@final
class CommandLimits:
    """Largest speed and acceleration of the command per block; infinite where there is no limit."""

    def __init__(self, speeds: Vector, accelerations: Vector, blocks: Sequence[slice]) -> None:
        self._accelerations, self._blocks = accelerations, blocks
        self.is_any = min(*speeds, *accelerations) < math.inf

    def applied(self, state: State, last: State, step: float, top_speeds: Vector) -> tuple[State, TickStatus]:
        """Place and velocity after a tick of ``step`` s within the limits, and the limits that acted."""
        (place, velocity), (last_place, last_velocity) = state, last
        move, status = deviation(place, last_place, len(velocity)), FINE
        moves: Vector = ()
        velocities: Vector = ()
        for block, top_speed, rise in zip(self._blocks, top_speeds, self._accelerations, strict=True):
            before, after, reached = last_velocity[block], velocity[block], FINE
            # The change of velocity is shortened first, then the velocity: the second never undoes the first.
            change = math.dist(after, before)
            if change > rise * step:
                share = rise * step / change
                after = tuple([v + share * (w - v) for v, w in zip(before, after, strict=True)])
                reached |= TickStatus.ACCELERATION_LIMITED
            speed = math.hypot(*after)
            if speed > top_speed:
                after = tuple([top_speed / speed * component for component in after])
                reached |= TickStatus.VELOCITY_LIMITED
            # A swing within one tick, from rest to rest, is too fast as well.
            elif math.hypot(*move[block]) > top_speed * step:
                reached |= TickStatus.VELOCITY_LIMITED
            moves += mean_move(before, after, step) if reached else move[block]
            velocities, status = velocities + after, status | reached
        return ((moved(last_place, moves), velocities) if status else state), status
