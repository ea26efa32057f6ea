"""The robot of the page: it follows a schedule at 1 kHz, and a spring to the pointer, or the keys, pull at it."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from torch_pbd.control.realtime import RealTimeAdmittance
from torch_pbd.control.schedule import Schedule

_TICK = 0.001  # s
_LONGEST = 0.1  # s of ticks at a time: after a page that was hidden the robot goes on from where it stood
_REST = 0.8  # s at the end, before the movement begins again
_HAND = 150.0  # N/m of the spring between hand and robot: a hand's own, between relaxed and firm
_STRONGEST = 25.0  # N: what people push robots with


class Robot:
    """Point that moves as :class:`~torch_pbd.control.realtime.RealTimeAdmittance` says, over and over."""

    def __init__(self) -> None:
        self._schedule: Schedule | None = None
        self._controller: RealTimeAdmittance | None = None
        self._now = self._rest = self._left = 0.0
        self._desired: Sequence[float] = (0.0, 0.0)

    @staticmethod
    def prepare(schedule: Schedule) -> RealTimeAdmittance:
        """Loop of a schedule, whose table takes longer to lay out than a frame."""
        return RealTimeAdmittance(schedule, soft_start=0.5)

    def follow(self, schedule: Schedule, controller: RealTimeAdmittance | None = None) -> None:
        """Take up a schedule, and its loop, from where the robot is, at the same share of the movement."""
        here, at, before = None, 0.0, self._controller
        if before is not None and self._schedule is not None:
            here, at = before.position, min(1.0, before.schedule_time / self._schedule.duration) * schedule.duration
        self._schedule, self._controller = schedule, controller or self.prepare(schedule)
        self._controller.start(self._now, here, at=at)
        self._desired = self._controller.desired_position

    def advance(self, elapsed: float, hand: tuple[float, float] | None, push: tuple[float, float]) -> dict[str, Any]:
        """State after ``elapsed`` s in which a hand at a place in m pulled by a spring, or None, and keys pushed in N.

        The state is what the page draws: time in s, positions in m, force in N, stiffness in N/m as (xx, xy, yy).
        """
        controller, schedule = self._controller, self._schedule
        if controller is None or schedule is None:
            return {"type": "robot", "is_there": False}
        self._left += min(elapsed, _LONGEST)
        force = push
        while self._left >= _TICK:
            self._left -= _TICK
            self._now += _TICK
            force, before = _pull(controller.position, hand, push), controller.desired_position
            controller.tick(self._now, force)
            # The loop's desired place is that of the tick's start; the robot has come to its end.
            self._desired = [2.0 * d - b for d, b in zip(controller.desired_position, before, strict=True)]
            self._rest = self._rest + _TICK if controller.schedule_time >= schedule.duration else 0.0
            if self._rest > _REST:
                self._rest = 0.0
                controller.start(self._now)  # at its start: on a way back it would not be where the schedule is
                self._desired = controller.desired_position
        stiffness = np.asarray(controller.stiffness)
        return {
            "type": "robot",
            "is_there": True,
            "time": controller.schedule_time,
            "position": controller.position,
            "desired": self._desired,
            "force": force,
            "stiffness": [stiffness[0, 0], stiffness[0, 1], stiffness[1, 1]],
            "deviation": math.dist(controller.position, self._desired),
            "faults": str(controller.faults) if controller.faults else "",
        }


def _pull(position: Any, hand: tuple[float, float] | None, push: tuple[float, float]) -> tuple[float, float]:
    """Force of the hand's spring and of the keys, no stronger than a person."""
    x, y = push
    if hand is not None:
        x, y = x + _HAND * (hand[0] - position[0]), y + _HAND * (hand[1] - position[1])
    share = min(1.0, _STRONGEST / (math.hypot(x, y) or 1.0))
    return share * x, share * y
