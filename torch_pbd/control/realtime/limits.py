"""Limits of the commanded velocity and acceleration, and the status of a tick in which one of them acted."""

import math
from enum import IntFlag

from torch_pbd.control.realtime.steps import Vector, drift


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


FINE = TickStatus(0)


def limited(
    state: tuple[Vector, Vector], last: tuple[Vector, Vector], step: float, speed_limit: float, rise_limit: float
) -> tuple[Vector, Vector, TickStatus]:
    """Position and velocity that a tick of ``step`` s leads to from the last ones, within limits of speed and
    acceleration, and which of these acted.
    """
    (position, velocity), (last_position, last_velocity) = state, last
    # The change of velocity is shortened first, then the velocity: the second never undoes the first.
    change, most, reached = math.dist(velocity, last_velocity), rise_limit * step, FINE
    if change > most:
        velocity = tuple(v + most / change * (w - v) for v, w in zip(last_velocity, velocity, strict=True))
        reached |= TickStatus.ACCELERATION_LIMITED
    speed = math.hypot(*velocity)
    if speed > speed_limit:
        velocity = tuple(speed_limit / speed * component for component in velocity)
        reached |= TickStatus.VELOCITY_LIMITED
    # A swing within one tick, from rest to rest, is too fast as well.
    elif math.dist(position, last_position) > speed_limit * step:
        reached |= TickStatus.VELOCITY_LIMITED
    if reached:
        position = drift(last_position, last_velocity, velocity, step)
    return position, velocity, reached
