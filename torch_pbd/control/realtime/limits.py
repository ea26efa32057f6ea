"""Limits of the force that comes in and of the command that goes out, and the status of a tick where they acted."""

import math
from collections import deque
from enum import IntFlag
from typing import final

from torch_pbd import checks
from torch_pbd.control.realtime.steps import Numbers, State, Vector, drift


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
    """The force that acts, per kg of virtual mass; options as `RealTimeAdmittance` takes them.

    A lost force is replaced by the median of the last good ones, on each axis, which fades to nothing over
    ``hold_ticks``: neither a wild reading before the loss nor an old push can carry the robot away. After more ticks
    than that, it ``is_lost``.
    """

    def __init__(
        self, mass: float, force_limit: float, deadband: float, force_rate_limit: float | None, hold_ticks: int
    ) -> None:
        self._mass = mass
        self._limit = checks.number(force_limit, "force_limit", above=0.0, unit="N") / mass
        self._deadband = checks.number(deadband, "deadband", least=0.0, unit="N") / mass
        rate = checks.number(force_rate_limit, "force_rate_limit", above=0.0, unit="N/s", optional=True)
        self._rate_limit = math.inf if rate is None else rate / mass
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
            mass = self._mass
            if self._bias:
                push = tuple([(float(part) - bias) / mass for part, bias in zip(force, self._bias, strict=True)])
            else:
                push = tuple([float(part) / mass for part in force])
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
class CommandLimits:
    """Largest speed and acceleration of the command; infinite where they are None."""

    def __init__(self, velocity_limit: float | None, acceleration_limit: float | None) -> None:
        speed = checks.number(velocity_limit, "velocity_limit", above=0.0, unit="units/s", optional=True)
        rise = checks.number(acceleration_limit, "acceleration_limit", above=0.0, unit="units/s^2", optional=True)
        self.speed, self.acceleration = speed or math.inf, rise or math.inf
        self.is_any = min(self.speed, self.acceleration) < math.inf

    def applied(self, state: State, last: State, step: float, top_speed: float) -> tuple[State, TickStatus]:
        """Position and velocity that a tick of ``step`` s leads to, within limits, and which of these acted."""
        (position, velocity), (last_position, last_velocity) = state, last
        # The change of velocity is shortened first, then the velocity: the second never undoes the first.
        change, most, reached = math.dist(velocity, last_velocity), self.acceleration * step, FINE
        if change > most:
            velocity = tuple(v + most / change * (w - v) for v, w in zip(last_velocity, velocity, strict=True))
            reached |= TickStatus.ACCELERATION_LIMITED
        speed = math.hypot(*velocity)
        if speed > top_speed:
            velocity = tuple(top_speed / speed * component for component in velocity)
            reached |= TickStatus.VELOCITY_LIMITED
        # A swing within one tick, from rest to rest, is too fast as well.
        elif math.dist(position, last_position) > top_speed * step:
            reached |= TickStatus.VELOCITY_LIMITED
        if reached:
            position = drift(last_position, last_velocity, velocity, step)
        return (position, velocity), reached
