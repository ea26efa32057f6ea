"""Where the real-time controller is in its schedule: begun, paused, caught up and ended without a jerk."""

import math
from operator import mul, sub
from typing import final

import numpy as np

from torch_pbd.control.realtime.steps import Vector, minimum_jerk
from torch_pbd.control.realtime.table import ScheduleTable

# Of the half by which the desired motion may exceed the schedule's own acceleration: one quarter changes the pace, and
# another is left for the square of the pace while it catches up.
_SHARE = 0.25
_CATCH_UP = math.sqrt(1.0 + _SHARE)
# The steepest slope of a minimum jerk is 15/8 of its mean.
_STEEPEST = 1.875


@final
class ScheduleClock:
    """Schedule time, which runs at a pace from 0 to 1, or a little more to catch up, and what is desired then.

    At a pace r the desired velocity is r x', and its acceleration r^2 x'' + r' x'. The second term is at most
    ``gain``: on the way, and towards the end of a schedule that ends while moving, where r <= sqrt(2 gain Q) with Q
    the integral of dt / |x'| over what is left. ``boost`` is that term of the last row, an acceleration to feed
    forward, so that no change of pace displaces the robot.

    At a pace of 1 schedule time is a difference of two times of the loop's clock, which adds up no rounding. A
    desired position that began elsewhere comes to the schedule's by minimum jerk, at the same pace.
    """

    def __init__(self, table: ScheduleTable, soft_start: float, approach_speed: float, *, catches_up: bool) -> None:
        self._table, self._d = table, table.n_axes
        self._packed, self._row_size, self._unpack = table.packed, table.layout.size, table.layout.unpack_from
        self._rate, self._soft_start, self._approach_speed = table.rate, soft_start, approach_speed
        self._catches_up, self._fastest = catches_up, _CATCH_UP if catches_up else 1.0
        # What a soft start needs to come up to speed; without one, a second is as long as its default.
        fastest = float(table.speeds.max())
        soft = max(fastest, approach_speed) / (soft_start or 1.0)
        self.speed = fastest + approach_speed
        self.gain = max(_SHARE * table.acceleration, soft)
        self.acceleration = (1.0 + _SHARE) * table.acceleration + self.gain
        times = np.append(np.arange(table.last) / table.rate, table.end)
        speeds = np.maximum(0.5 * (table.speeds[1:] + table.speeds[:-1]), 1e-9 * self.speed)
        left = np.append(np.cumsum((np.diff(times) / speeds)[::-1])[::-1], 0.0)
        self._squared_limits = 2.0 * self.gain * left
        self._tail = int(np.count_nonzero(self._squared_limits >= self._fastest**2))

    def begin(self, now: float, at: float, position: Vector, velocity: Vector) -> Vector:
        """Start at a time of the schedule, whose row it is, as fast as the velocity of the robot is the desired one."""
        self.index, row, _ = self._between(at)
        self._origin, self._soft_origin = now - at, now
        self._distance: Vector = tuple(map(sub, row, position))  # stops at the end of position
        self._blend = max(self._soft_start, _STEEPEST * math.hypot(*self._distance) / self._approach_speed)
        self._is_soft = any(self._distance) and self._soft_start > 0.0
        motion = row[self._d : 2 * self._d]
        square, along = sum(map(mul, motion, motion)), sum(map(mul, motion, velocity))
        self._pace = min(1.0, max(0.0, along / square)) if square and self._soft_start else 1.0
        self._running, self._lag = self._pace, 0.0
        self.boost: Vector = ()
        self._is_steady = self._pace == 1.0 and not self._is_soft
        return row

    def position_at(self, at: float) -> Vector:
        """Desired position at a time of the schedule."""
        return self._between(at)[1][: self._d]

    def time_at(self, now: float) -> float:
        """Schedule time at the end of the last tick, in s."""
        return min(now - self._origin, self._table.end)

    def speed_at(self, now: float) -> float:
        """Desired speed at the end of the last tick."""
        _, motion, approach, _ = self._desired(now)
        return self._pace * (math.hypot(*motion) + math.hypot(*approach))

    def row(self, begin: float, step: float) -> Vector:
        """Row of the table, with what is desired, for a tick; without calls where nothing is ramped."""
        if self._is_steady:
            self.index = index = int((begin - self._origin) * self._rate + 0.5)
            if index < self._tail:
                return self._unpack(self._packed, index * self._row_size)
            if begin - self._origin >= self._table.end:
                self.index, self.boost = self._table.last, ()
                return self._unpack(self._packed, self.index * self._row_size)
        return self._ramped(begin, step)

    def brake(self, begin: float, passed: float, deceleration: float) -> None:
        """Let schedule time, while ``passed`` s pass, brake at most so fast, and then stand."""
        speed, pace, slower = self.speed_at(begin), self._pace, self._pace
        ran = soft_ran = 0.0
        if speed > 0.0:
            slower = pace * max(0.0, 1.0 - deceleration * passed / speed)
            time, running = min(passed, speed / deceleration), min(self._running, slower)
            ran, soft_ran = 0.5 * time * (self._running + running), 0.5 * time * (pace + slower)
            self._pace, self._running = slower, running
        self.shift(passed - ran)
        self._soft_origin += ran - soft_ran
        self._lag += self._catches_up * (passed - ran)
        self.boost, self._is_steady = (), False

    def shift(self, time: float) -> None:
        """Let so much time of the loop's clock pass without schedule time."""
        self._origin += time
        self._soft_origin += time

    def _ramped(self, begin: float, step: float) -> Vector:
        row, motion, approach, squared_limit = self._desired(begin)
        speed = math.hypot(*motion) + math.hypot(*approach)
        rise = self.gain / speed if speed else math.inf
        goal = min(self._fastest, 1.0 + math.sqrt(2.0 * rise * self._lag)) if self._lag else 1.0
        pace = min(self._pace + rise * step, goal)
        running = min(pace, math.sqrt(squared_limit))
        faster, soft_faster = (running - self._running) / step, (pace - self._pace) / step
        self.boost = tuple([faster * v + soft_faster * w for v, w in zip(motion, approach, strict=True)])
        lost = step * (1.0 - 0.5 * (running + self._running))
        self._origin += lost
        self._soft_origin += step * (1.0 - 0.5 * (pace + self._pace))
        self._lag = max(0.0, self._lag + lost) if self._lag else 0.0
        is_even = running == self._running == 1.0
        if running == 1.0 and not is_even:  # onto a row: without ramps a tick takes the nearest one
            time = begin + step - self._origin
            self._origin += time - round(time * self._rate) / self._rate
        self._pace, self._running = pace, running
        is_over = self.index == self._table.last
        if not self._is_soft and (is_over or (is_even and not self._lag)):
            self.boost, self._is_steady = (), True
        desired = [running * v + pace * w for v, w in zip(motion, approach, strict=True)]
        return (*row[: self._d], *desired, *row[2 * self._d :])

    def _desired(self, now: float) -> tuple[Vector, Vector, Vector, float]:
        """Row, velocity of the schedule and of the soft start at a pace of 1, and the square of the largest pace."""
        d = self._d
        self.index, row, squared_limit = self._between(now - self._origin)
        motion, approach = row[d : 2 * d], (0.0,) * d
        phase = (now - self._soft_origin) / self._blend if self._is_soft else 1.0
        self._is_soft = phase < 1.0
        if self._is_soft:
            left, slope = minimum_jerk(phase)
            approach = tuple([-slope / self._blend * part for part in self._distance])
            row = (*[value - left * part for value, part in zip(row, self._distance, strict=False)], *row[d:])
        return row, motion, approach, squared_limit

    def _between(self, time: float) -> tuple[int, Vector, float]:
        """Number of the row before a time, the row with the motion on the line to the next, and the largest pace^2."""
        table, d = self._table, self._d
        if time >= table.end:
            return table.last, table.row(table.last), 0.0
        index = min(int(time * self._rate), table.last - 1)
        start, stop = index / self._rate, table.end if index + 1 == table.last else (index + 1) / self._rate
        share = min(1.0, (time - start) / (stop - start))
        row, after = table.row(index), table.row(index + 1)
        motion = [value + share * (then - value) for value, then in zip(row[: 2 * d], after, strict=False)]
        limits = self._squared_limits
        return index, (*motion, *row[2 * d :]), float(limits[index] + share * (limits[index + 1] - limits[index]))
