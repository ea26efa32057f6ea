"""Limits of the commanded velocity and acceleration."""

import math
from typing import final

from torch_pbd.control.realtime.checks import limit, number
from torch_pbd.control.realtime.status import TickStatus
from torch_pbd.control.realtime.steps import Vector, drift

_DECELERATION = 5.0  # units/s^2: from 0.5 m/s to rest in 0.1 s and 25 mm


@final
class CommandLimits:
    """Largest speed and acceleration of the command, and how fast it brakes.

    Parameters
    ----------
    speed, acceleration, deceleration : float or None
        As `RealTimeAdmittance` takes them; None is no acceleration limit, and what is due for the others.
    due_speed, due_acceleration : float
        What desired motion and forces can cause together; what the desired motion can.
    """

    def __init__(
        self,
        speed: float | None,
        acceleration: float | None,
        deceleration: float | None,
        due_speed: float,
        due_acceleration: float,
    ) -> None:
        self.acceleration = limit("acceleration_limit", acceleration, "units/s^2")
        self.given_speed = limit("velocity_limit", speed, "units/s")
        self.speed = due_speed if speed is None else self.given_speed
        braking = max(_DECELERATION, due_acceleration) if deceleration is None else deceleration
        self.deceleration = min(number("stop_deceleration", braking, "units/s^2"), self.acceleration)
        self.is_given = min(self.given_speed, self.acceleration) < math.inf

    def limited(
        self, position: Vector, velocity: Vector, last_position: Vector, last_velocity: Vector, step: float
    ) -> tuple[Vector, Vector, TickStatus]:
        """Position and velocity within limits, and which of them acted, of those that a tick of ``step`` s leads to.

        The change of velocity is shortened, then the velocity: the second never undoes the first.
        """
        change, most, reached = math.dist(velocity, last_velocity), self.acceleration * step, TickStatus(0)
        if change > most:
            velocity = tuple(v + most / change * (w - v) for v, w in zip(last_velocity, velocity, strict=True))
            reached |= TickStatus.ACCELERATION_LIMITED
        speed = math.hypot(*velocity)
        if speed > self.speed:
            velocity = tuple(self.speed / speed * component for component in velocity)
            reached |= TickStatus.VELOCITY_LIMITED
        elif math.dist(position, last_position) > self.speed * step:
            reached |= TickStatus.VELOCITY_LIMITED
        if reached:
            position = drift(last_position, last_velocity, velocity, step)
        return position, velocity, reached
