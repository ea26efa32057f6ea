"""Where the real-time controller is in its schedule: begun, paused, caught up and ended without a jerk."""

import math
from operator import mul, sub
from typing import final

import numpy as np

from torch_pbd.control.realtime.checks import number
from torch_pbd.control.realtime.steps import Vector, minimum_jerk
from torch_pbd.control.realtime.table import ScheduleTable

# The desired motion may be 1.5 times as fast as the schedule, and accelerate so much more: one half of that changes the
# pace, the other is left for the square of the pace while it catches up.
_SPEED, _SHARE = 1.5, 0.25
# A minimum jerk of 1 over a time of 1 has a velocity of 15/8 and an acceleration of 10 / sqrt(3).
_STEEPEST, _SHARPEST = 1.875, 5.7735


@final
class ScheduleClock:
    """Schedule time, which runs at a pace from 0 to 1, or a little more to catch up, and what is desired then.

    At a pace r the desired velocity is r x' and its acceleration r^2 x'' + r' x'. The second term is at most ``gain``,
    also towards the end of a schedule that ends while moving: there r^2 <= 2 gain times the integral of dt / |x'| over
    what is left. ``boost`` is that term, to be fed forward, so that no change of pace displaces the robot. At a pace
    of 1 schedule time is a difference of two times of the loop's clock, which adds up no rounding.
    """

    def __init__(
        self, table: ScheduleTable, soft_start: float, approach_speed: float, acceleration_limit: float, on_gap: str
    ) -> None:
        if on_gap not in ("pause", "resume"):
            raise ValueError(f"on_gap={on_gap!r} must be 'pause' or 'resume'.")
        self._table, self._d, self._rate, self._catches_up = table, table.n_axes, table.rate, on_gap == "resume"
        self._packed, self._row_size, self._unpack = table.packed, table.layout.size, table.layout.unpack_from
        self._soft_start = number("soft_start", soft_start, "s, or 0", zero=True)
        self._approach_speed = number("approach_speed", approach_speed, "units/s")
        own, fastest = table.acceleration, float(table.speeds.max())
        # What a soft start needs to come up to speed; without one, a second is as long as its default.
        soft = max(fastest, approach_speed) / (soft_start or 1.0)
        self.gain = min(max(_SHARE * own, soft), 0.5 * acceleration_limit)
        self.speed = _SPEED * fastest + approach_speed
        self.acceleration = max((1.0 + _SHARE) * own + self.gain, _SHARPEST / _STEEPEST * soft)
        room = (self.acceleration - self.gain) / own if own else math.inf
        self._fastest = min(_SPEED, math.sqrt(room)) if self._catches_up else 1.0
        times = np.append(np.arange(table.last) / table.rate, table.end)
        speeds = np.maximum(0.5 * (table.speeds[1:] + table.speeds[:-1]), 1e-9 * self.speed)
        left = np.append(np.cumsum((np.diff(times) / speeds)[::-1])[::-1], 0.0)
        self._squared_limits = 2.0 * self.gain * left
        self._tail = int(np.count_nonzero(self._squared_limits >= self._fastest**2))

    def begin(self, now: float, at: float, position: Vector | None, velocity: Vector) -> Vector:
        """Start at a time of the schedule, whose row it is, as fast as the velocity of the robot is the desired one.

        A desired position that begins elsewhere comes to the schedule's by minimum jerk.
        """
        d = self._d
        self._at, self._origin, self._lag, self._is_soft = at, now - at, 0.0, False
        self.boost: Vector = ()
        row, squared_limit = self._desired(at)
        self._distance: Vector = (0.0,) * d if position is None else tuple(map(sub, row, position))
        self._blend = max(self._soft_start, _STEEPEST * math.hypot(*self._distance) / self._approach_speed)
        self._is_soft = any(self._distance) and self._soft_start > 0.0
        motion = row[d : 2 * d]
        square, along = sum(map(mul, motion, motion)), sum(map(mul, motion, velocity))
        pace = max(0.0, along / square) if square and self._soft_start else 1.0
        self._pace = min(1.0, pace, math.sqrt(squared_limit))
        self._is_steady = self._pace == 1.0 and not self._is_soft
        return row

    def time_at(self, now: float) -> float:
        """Schedule time at the end of the last tick, in s."""
        return min(now - self._origin, self._table.end)

    def speed_at(self, now: float) -> float:
        """Desired speed at the end of the last tick."""
        row, _ = self._desired(now - self._origin)
        return self._pace * math.hypot(*row[self._d : 2 * self._d])

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
        speed, ran = self.speed_at(begin), 0.0
        if speed > 0.0:
            slower = self._pace * max(0.0, 1.0 - deceleration * passed / speed)
            ran, self._pace = 0.5 * min(passed, speed / deceleration) * (self._pace + slower), slower
        self.shift(passed - ran)
        self._lag = max(0.0, self._lag + self._catches_up * (passed - ran))
        self.boost, self._is_steady = (), False

    def shift(self, time: float) -> None:
        """Let so much time of the loop's clock pass without schedule time."""
        self._origin += time

    def _ramped(self, begin: float, step: float) -> Vector:
        d, time, last_pace = self._d, begin - self._origin, self._pace
        row, squared_limit = self._desired(time)
        motion = row[d : 2 * d]
        speed = math.hypot(*motion)
        rise = self.gain / speed if speed else math.inf
        goal = min(self._fastest, 1.0 + math.sqrt(2.0 * rise * self._lag)) if self._lag else 1.0
        change = rise * step
        self._pace = pace = min(last_pace + change, max(goal, last_pace - change), math.sqrt(squared_limit))
        self.boost = tuple([(pace - last_pace) / step * part for part in motion])
        lost = step - 0.5 * step * (pace + last_pace)
        self._origin += lost
        self._lag = max(0.0, self._lag + lost) if self._lag else 0.0
        if pace == 1.0 != last_pace:  # onto a row: without ramps a tick takes the nearest one
            self._origin += time + step - lost - round((time + step - lost) * self._rate) / self._rate
        if not self._is_soft and (time >= self._table.end or (pace == last_pace == 1.0 and not self._lag)):
            self.boost, self._is_steady = (), True
        return (*row[:d], *[pace * part for part in motion], *row[2 * d :])

    def _desired(self, time: float) -> tuple[Vector, float]:
        """Row at a time, with what is desired at a pace of 1, between it and the next; square of the largest pace."""
        table, d, limits = self._table, self._d, self._squared_limits
        if time >= table.end:
            self.index, row, squared_limit = table.last, table.row(table.last), math.inf
        else:
            self.index = index = min(int(time * self._rate), table.last - 1)
            start, stop = index / self._rate, table.end if index + 1 == table.last else (index + 1) / self._rate
            share = min(1.0, (time - start) / (stop - start))
            row, after = table.row(index), table.row(index + 1)
            row = (*[a + share * (b - a) for a, b in zip(row[: 2 * d], after, strict=False)], *row[2 * d :])
            squared_limit = float(limits[index] + share * (limits[index + 1] - limits[index]))
        phase = (time - self._at) / self._blend if self._is_soft else 1.0
        self._is_soft = phase < 1.0
        if self._is_soft:
            left, slope = minimum_jerk(phase)
            position = [value - left * part for value, part in zip(row, self._distance, strict=False)]
            velocity = [
                value - slope / self._blend * part for value, part in zip(row[d:], self._distance, strict=False)
            ]
            row = (*position, *velocity, *row[2 * d :])
        return row, squared_limit
