"""Limits of the commanded velocity and acceleration."""

import math

from torch_pbd.control.realtime.status import TickStatus
from torch_pbd.control.realtime.steps import Vector, drift


def limited(
    position: Vector,
    velocity: Vector,
    last_position: Vector,
    last_velocity: Vector,
    step: float,
    speed_limit: float,
    acceleration_limit: float,
) -> tuple[Vector, Vector, TickStatus]:
    """Position and velocity within limits, and which of them acted, of those that a tick of ``step`` s would lead to.

    The change of velocity is shortened, then the velocity: the second never undoes the first.
    """
    change, most, reached = math.dist(velocity, last_velocity), acceleration_limit * step, TickStatus(0)
    if change > most:
        velocity = tuple(v + most / change * (w - v) for v, w in zip(last_velocity, velocity, strict=True))
        reached |= TickStatus.ACCELERATION_LIMITED
    speed = math.hypot(*velocity)
    if speed > speed_limit:
        velocity = tuple(speed_limit / speed * component for component in velocity)
        reached |= TickStatus.VELOCITY_LIMITED
    elif math.dist(position, last_position) > speed_limit * step:
        reached |= TickStatus.VELOCITY_LIMITED
    if reached:
        position = drift(last_position, last_velocity, velocity, step)
    return position, velocity, reached
