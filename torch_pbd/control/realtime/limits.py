"""Limits of the force that comes in and of the command that goes out, and the status of a tick where they acted."""

import math
from collections import deque
from collections.abc import Mapping
from enum import IntFlag
from typing import final

from torch_pbd import checks
from torch_pbd.control.realtime.places import Vector, deviation, moved
from torch_pbd.control.realtime.steps import Numbers, State, mean_move


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

# A median of five is a good force after one or two wild ones, and 2 ms late at 1 kHz.
_RECENT = 5


@final
class ForceChannel:
    """The force, or torque, of d axes that acts, over ``unit`` kg: limits in N, or in Nm.

    A lost force is replaced by the median of the last good ones, on each axis, which fades to nothing over
    ``hold_ticks``: neither a wild reading before the loss nor an old push can carry the robot away. After more ticks
    than that, it ``is_lost``.
    """

    def __init__(self, unit: float, limit: float, deadband: float, rate_limit: float, hold_ticks: int) -> None:
        self._unit, self._limit, self._deadband = unit, limit / unit, deadband / unit
        self._rate_limit = rate_limit / unit
        self._hold_ticks = checks.count(hold_ticks, "hold_ticks", least=0)
        self.begin(0, ())

    def begin(self, d: int, bias: Vector) -> None:
        """Forget all forces; before the first there was none."""
        self.push: Vector = (0.0,) * d
        self._bias, self._n_lost, self.is_lost = bias, 0, False
        self._recent = deque([self.push] * _RECENT, _RECENT)

    def take(self, force: Numbers, step: float) -> TickStatus:
        """Let a force as measured act, as far as it may, ``step`` s after the last one."""
        try:
            unit = self._unit
            if self._bias:
                push = tuple([(float(part) - bias) / unit for part, bias in zip(force, self._bias, strict=True)])
            else:
                push = tuple([float(part) / unit for part in force])
        except (TypeError, ValueError, OverflowError):
            push = ()
        if len(push) != len(self.push):
            raise checks.refusal(force, "force", f"{len(self.push)} numbers in N")
        if self._deadband:
            push = tuple([part - max(-self._deadband, min(self._deadband, part)) for part in push])
        length, status = math.hypot(*push), FINE
        if not length <= self._limit:
            if not length < math.inf:
                self._bridge()
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

    def _bridge(self) -> None:
        self._n_lost += 1
        self.is_lost = self._n_lost > self._hold_ticks
        share = max(0.0, 1.0 - self._n_lost / (self._hold_ticks + 1))
        self.push = tuple([share * sorted(parts)[_RECENT // 2] for parts in zip(*self._recent, strict=True)])


@final
class WrenchChannel:
    """Force and torque on a pose, each as its own `ForceChannel`: one that is lost is bridged by itself."""

    def __init__(self, force: ForceChannel, torque: ForceChannel) -> None:
        self._channels = force, torque

    @property
    def push(self) -> Vector:
        """Force and torque that act."""
        force, torque = self._channels
        return force.push + torque.push

    @property
    def is_lost(self) -> bool:
        """True if the force or the torque is lost."""
        return self._channels[0].is_lost or self._channels[1].is_lost

    def begin(self, d: int, bias: Vector) -> None:
        """Forget all; before the first there was none."""
        force, torque = self._channels
        force.begin(d - 3, bias[:-3])
        torque.begin(3, bias[-3:])
        self._n_axes = d

    def take(self, wrench: Numbers, step: float) -> TickStatus:
        """Let a wrench as measured act, as far as it may, ``step`` s after the last one."""
        try:
            parts = tuple([float(part) for part in wrench])
        except (TypeError, ValueError, OverflowError):
            parts = ()
        if len(parts) != self._n_axes:
            raise checks.refusal(wrench, "force", f"{self._n_axes} numbers in N and Nm")
        force, torque = self._channels
        status, of_torque = force.take(parts[:-3], step), torque.take(parts[-3:], step)
        return status if of_torque is FINE else status | of_torque


def channel_of(unit: float, options: Mapping[str, Vector], hold_ticks: int) -> ForceChannel | WrenchChannel:
    """Channel of a force, or of a force and a torque, by the options of `of_blocks`."""
    names = ("force_limit", "deadband", "force_rate_limit")
    of_each = zip(*[options[name] for name in names], strict=True)
    channels = [ForceChannel(unit, limit, band, rate_limit, hold_ticks) for limit, band, rate_limit in of_each]
    return channels[0] if len(channels) == 1 else WrenchChannel(*channels)


@final
class CommandLimits:
    """Largest speed and acceleration of the command, for each block; infinite where there is none."""

    def __init__(self, speeds: Vector, accelerations: Vector, blocks: tuple[slice, ...]) -> None:
        self.speeds, self.accelerations, self._blocks = speeds, accelerations, blocks
        self.is_any = min(*speeds, *accelerations) < math.inf

    def applied(self, state: State, last: State, step: float, top_speeds: Vector) -> tuple[State, TickStatus]:
        """Place and velocity that a tick of ``step`` s leads to, within limits, and which of these acted."""
        (place, velocity), (last_place, last_velocity) = state, last
        move, reached = deviation(place, last_place, len(velocity)), FINE
        moves: Vector = ()
        velocities: Vector = ()
        for block, top_speed, most in zip(self._blocks, top_speeds, self.accelerations, strict=True):
            of_block = move[block], velocity[block], last_velocity[block]
            part, slower, acted = _limited(*of_block, step, top_speed, most * step)
            moves, velocities, reached = moves + part, velocities + slower, reached | acted
        return ((moved(last_place, moves), velocities) if reached else state), reached


def _limited(
    move: Vector, velocity: Vector, last_velocity: Vector, step: float, top_speed: float, most: float
) -> tuple[Vector, Vector, TickStatus]:
    """Move and velocity of a block in a tick in which the velocity changes by ``most`` at most."""
    # The change of velocity is shortened first, then the velocity: the second never undoes the first.
    change, reached = math.dist(velocity, last_velocity), FINE
    if change > most:
        velocity = tuple([v + most / change * (w - v) for v, w in zip(last_velocity, velocity, strict=True)])
        reached |= TickStatus.ACCELERATION_LIMITED
    speed = math.hypot(*velocity)
    if speed > top_speed:
        velocity = tuple([top_speed / speed * component for component in velocity])
        reached |= TickStatus.VELOCITY_LIMITED
    # A swing within one tick, from rest to rest, is too fast as well.
    elif math.hypot(*move) > top_speed * step:
        reached |= TickStatus.VELOCITY_LIMITED
    return (mean_move(last_velocity, velocity, step) if reached else move), velocity, reached
