"""Limits of the measured force and of the command, their options, and the status of a tick."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from enum import IntFlag
from operator import sub
from typing import Any, final

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.realtime.steps import State, Vector, deviation, mean_move, moved

Numbers = Sequence[float] | Floats
Option = float | tuple[float, float] | None
"""Number for positions; for poses a pair, of positions and of rotations; None is the default."""

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


def options_of_blocks(given: Mapping[str, Any], n_blocks: int) -> dict[str, Vector]:
    """Options for positions, and for poses also for rotations."""
    values = {}
    for name, (default, unit) in _OPTIONS.items():
        value, units = given[name], (unit, _ANGULAR[unit])[:n_blocks]
        if value is None:
            values[name] = default[:n_blocks]
            continue
        if n_blocks == 2 and not (isinstance(value, Sequence) and len(value) == 2):
            raise checks.refusal(value, name, f"a pair for poses, in {units[0]} and {units[1]}")
        parts, titles = ([value], [name]) if n_blocks == 1 else (value, [f"{name}[0]", f"{name}[1]"])
        above, least = (None, 0.0) if name == "deadband" else (0.0, None)
        values[name] = tuple(
            checks.number(part, title, above=above, least=least, unit=each)
            for part, title, each in zip(parts, titles, units, strict=True)
        )
    values["spring_limit"] = values["spring_limit"] or values["force_limit"]
    return values


def finite_floats(values: Numbers | None, name: str, d: int) -> Vector:
    """Finite floats, one per axis; zeros for None."""
    return (0.0,) * d if values is None else tuple(checks.array(values, name, (d,)).tolist())


@final
class ForceChannel:
    """Force, and for poses torque, that acts in a tick, each within its own limits.

    One that is lost is replaced by the median of the last good ones, on each axis, fading to nothing over
    ``hold_ticks``: neither a wild reading before the loss nor an old push can carry the robot away. After more ticks
    than that it ``is_lost``.
    """

    def __init__(self, options: Mapping[str, Vector], blocks: Sequence[slice], hold_ticks: int) -> None:
        self._hold_ticks, self._n_axes = checks.count(hold_ticks, "hold_ticks", least=0), blocks[-1].stop
        limits = (options[name] for name in ("force_limit", "deadband", "force_rate_limit"))
        self._blocks = list(zip(range(len(blocks)), blocks, *limits, strict=True))

    def begin(self, bias: Vector) -> None:
        """Clear all forces; the force before the first tick is zero."""
        self.push: Vector = (0.0,) * self._n_axes
        self._bias, self.is_lost = bias if any(bias) else None, False
        self._n_lost = [0] * len(self._blocks)
        self._recent = [deque([self.push[block]] * _RECENT, _RECENT) for _, block, *_ in self._blocks]

    def take(self, force: Numbers, step: float) -> int:
        """Let a measured force act within the limits, ``step`` s after the last one; returns its faults."""
        try:
            # tuple() of an iterator leaves one more tuple on Python's free list each time.
            given = (*map(float, force),)
        except (TypeError, ValueError, OverflowError):
            given = ()
        if len(given) != self._n_axes:
            raise checks.refusal(force, "force", f"{self._n_axes} numbers in N and Nm")
        if self._bias:
            given = (*map(sub, given, self._bias),)
        status: int = 0
        acting: Vector = ()
        for b, block, limit, deadband, rate_limit in self._blocks:
            push, recent = given[block], self._recent[b]
            if deadband:
                push = tuple([part - max(-deadband, min(deadband, part)) for part in push])
            length = math.hypot(*push)
            if not length < math.inf:
                status |= TickStatus.FORCE_INVALID
                acting += self._replaced(b)
                continue
            if length > limit:
                push, status = tuple([part / length * limit for part in push]), status | TickStatus.FORCE_SATURATED
            if rate_limit < math.inf:
                last, most = self.push[block], rate_limit * step
                if (change := math.dist(push, last)) > most:
                    push = tuple([old + most / change * (new - old) for old, new in zip(last, push, strict=True)])
                    status |= TickStatus.FORCE_RATE_LIMITED
            self._n_lost[b] = 0
            recent.append(push)
            acting += push
        self.push = acting
        return status

    def _replaced(self, b: int) -> Vector:
        """Force of a block, one more of which is lost."""
        self._n_lost[b] += 1
        self.is_lost = self.is_lost or self._n_lost[b] > self._hold_ticks
        share = max(0.0, 1.0 - self._n_lost[b] / (self._hold_ticks + 1))
        return tuple([share * sorted(parts)[_RECENT // 2] for parts in zip(*self._recent[b], strict=True)])


def within_limits(
    state: State, last: State, step: float, blocks: Sequence[slice], top_speeds: Vector, accelerations: Vector
) -> tuple[State, int]:
    """Place and velocity after a tick of ``step`` s, within a largest speed and acceleration per block, and faults."""
    (place, velocity), (last_place, last_velocity) = state, last
    move, status = deviation(place, last_place, len(velocity)), 0
    moves: Vector = ()
    velocities: Vector = ()
    for block, top_speed, rise in zip(blocks, top_speeds, accelerations, strict=True):
        before, after, reached = last_velocity[block], velocity[block], 0
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
