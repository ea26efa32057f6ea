"""Clock of the schedule in the real-time controller, and the desired motion at its time."""

import math
from collections.abc import Mapping, Sequence
from operator import add, mul
from typing import final

import numpy as np

from torch_pbd import checks, rotations
from torch_pbd.control.realtime.steps import Vector, deviation, moved
from torch_pbd.control.realtime.table import ScheduleTable

# The desired motion may be 1.5 times as fast as the schedule, with as much more acceleration: half of that changes the
# pace, the other half is left for the square of the pace while it catches up.
_SPEED, _SHARE = 1.5, 0.25
# Share of `gain` that a rise of the pace may always take, so that shaking the robot cannot stop its schedule.
_LEAST_SPARE = 0.1
# Share of a row that counts as rounding: time aligned with a row takes that row, whichever way it was rounded.
_ON_ROW = 1e-6
# Maximum of 1 + (w t - 1) e^(-w t), the response of a critically damped spring to a step of desired acceleration.
_OVERSHOOT = 1.0 + math.exp(-2.0)
# A minimum jerk of 1 over a time of 1 has a velocity of 15/8 and an acceleration of 10 / sqrt(3).
_STEEPEST, _SHARPEST = 1.875, 5.7735


@final
class ScheduleClock:
    """Schedule time, which runs at a pace from 0 to 1, or a little more to catch up, and the motion desired then.

    At a pace r the desired velocity is r x' and its acceleration r^2 x'' + r' x'. The second term, ``boost``, is fed
    forward, so that no change of pace displaces the robot. It is at most ``gain``, also before the end of a schedule
    that ends while moving: there r^2 <= 2 gain times the integral of dt / |x'| over what is left. At a pace of 1
    schedule time is a difference of two times of the loop's clock, which adds up no rounding.

    The desired motion stays within ``acceleration``, and with it a robot that nobody pushes: an approach from elsewhere
    takes what the schedule's own acceleration leaves, and a change of pace what both leave; nothing is caught up
    meanwhile; and the pace rises no faster than the pull of the spring leaves room for (see `spare`). The end of the
    schedule does not slow an approach, which has a pace of its own, ``_free``, and is ``_ahead`` of the schedule then.

    An approach of poses turns the desired orientation by A, a share of the way in between: ``A R_d`` moves at
    w_A + A w_d, and the acceleration of that has w_A x A w_d besides, which is allowed for at full speed.
    """

    def __init__(self, table: ScheduleTable, options: Mapping[str, Vector], soft_start: float, on_gap: str) -> None:
        self._catches_up = checks.choice(on_gap, "on_gap", ("pause", "resume")) == "resume"
        self._table, self._rate = table, table.rate
        self._soft_start = checks.number(soft_start, "soft_start", least=0.0, unit="s")
        # What a soft start does not tell apart counts as equally fast.
        approach_speed = options["approach_speed"][0]
        self.scales = scales = tuple([approach_speed / speed for speed in options["approach_speed"]])
        self._lever = None if len(scales) == 1 else scales[1]
        acceleration_limit = self.least(options["acceleration_limit"])
        speeds, accelerations = (
            np.max(
                [scale * np.linalg.norm(rows[:, b], axis=1) for scale, b in zip(scales, table.blocks, strict=True)],
                axis=0,
            )
            for rows in (table.velocity, table.acceleration)
        )
        own, fastest = float(accelerations.max()), float(speeds.max())
        spin = float(np.linalg.norm(table.velocity[:, table.blocks[1]], axis=1).max()) if self._lever else 0.0
        if spin * approach_speed > _SHARE * acceleration_limit:
            approach_speed = _SHARE * acceleration_limit / spin
        # Acceleration of a soft start that comes up to speed; without one, a second is as long as its default.
        soft = max(fastest, approach_speed) / (soft_start or 1.0)
        # One half of a limit is left for the schedule's own acceleration.
        self.gain = min(max(_SHARE * own, soft), 0.5 * acceleration_limit)
        self.speed = _SPEED * fastest + approach_speed
        self.acceleration = max((1.0 + _SHARE) * own + self.gain, _SHARPEST / _STEEPEST * soft)
        # What the schedule's own acceleration, with what the robot overshoots it by, leaves to an approach.
        self._room = max(self.gain, self.acceleration - (1.0 + _SHARE) * own)
        spare = (self.acceleration - self.gain) / (_OVERSHOOT * own) if own else math.inf
        self._fastest = min(_SPEED, math.sqrt(spare)) if self._catches_up else 1.0
        self._approach_speed, self.acceleration = approach_speed, self.acceleration + approach_speed * spin
        # Integral of dt / |x'| from each row to the end; where the schedule rests it is long, not endless.
        times = np.append(np.arange(table.last) / table.rate, table.end)
        middle = np.maximum(0.5 * (speeds[1:] + speeds[:-1]), 1e-9 * self.speed)
        left = np.append(np.cumsum((np.diff(times) / middle)[::-1])[::-1], 0.0)
        squared_limits = 2.0 * self.gain * left
        self._tail = int(np.count_nonzero(squared_limits >= self._fastest**2))
        # Where a schedule that ends while moving is slower if it may take one half of `gain` for that.
        ends_moving = speeds[-1] * table.rate > self.gain
        self._slow_from = float(times[np.count_nonzero(squared_limits >= 2.0) - 1]) if ends_moving else math.inf
        # Items of a memoryview are floats, and a tick takes them faster than those of an array.
        self._squared_limits = squared_limits.data

    def begin(
        self, now: float, at: float, position: Vector | None, orientation: Vector | None, velocity: Vector
    ) -> tuple[Vector, Vector]:
        """Row of the schedule at the time of the start, and place of the robot, which is the row's where that is None.

        The desired place comes from there by minimum jerk, at first as fast as the robot, and turns about one axis.
        """
        self._at, self._origin, self._lag, self._is_soft = at, now - at, 0.0, False
        self.boost: Vector = ()
        self._spare, self._ahead, self._end_share = self.gain, 0.0, 1.0
        row, squared_limit = self._desired(at)
        goal, n_positions = row[: self._table.n_place], self._table.blocks[0].stop
        place = (*(position or goal[:n_positions]), *(orientation or goal[n_positions:]))
        self._distance = deviation(goal, place, len(velocity))
        way, room = self.norm(self._distance), self._room
        self._blend = self._time_of(way, room)
        # An approach that meets the slow end of its schedule leaves one half of `gain` to it.
        if at + self._blend > self._slow_from:
            room, self._end_share = room - 0.5 * self.gain, 0.5
            self._blend = self._time_of(way, room)
            squared_limit *= self._end_share
        self._is_soft = any(self._distance) and self._soft_start > 0.0
        if self._is_soft:
            # At a pace of 1 the approach leaves this much less than `gain` to changes of pace.
            taken = self.gain + _SHARPEST * way / self._blend / self._blend - self._room
            self._taken = min(max(taken, 0.0), self.gain)
        # The pace at which the desired motion is nearest to that of the robot.
        square = along = 0.0
        for scale, block in zip(self.scales, self._table.blocks, strict=True):
            desired = row[self._table.twist][block]
            square += scale**2 * sum(map(mul, desired, desired))
            along += scale**2 * sum(map(mul, desired, velocity[block]))
        pace = max(0.0, along / square) if square and self._soft_start else 1.0
        self._free = min(1.0, pace)
        self._pace = min(self._free, math.sqrt(squared_limit))
        self._is_steady = self._pace == 1.0 and not self._is_soft
        return tuple(row), moved(place, (0.0,) * len(velocity))  # between two rows quaternions are shorter than 1

    def norm(self, twist: Sequence[float]) -> float:
        """Length of a velocity; for poses the larger of linear speed and lever, in units/rad, times angular speed."""
        if self._lever is None:
            return math.hypot(*twist)
        return max(math.hypot(*twist[:-3]), self._lever * math.hypot(*twist[-3:]))

    def least(self, options: Vector) -> float:
        """Smaller one of the speeds or accelerations of positions and rotations, as the norm tells them."""
        return min(map(mul, self.scales, options))

    def time_at(self, now: float) -> float:
        """Schedule time at the end of the last tick, in s."""
        return min(now - self._origin, self._table.end)

    def speed_at(self, now: float) -> float:
        """Desired speed at the end of the last tick."""
        row, _ = self._desired(now - self._origin)
        motion = row[self._table.twist]
        if self._is_soft:
            return self.norm([self._pace * v + self._free * w for v, w in zip(motion, self._slope, strict=True)])
        return self._pace * self.norm(motion)

    def row(self, begin: float, step: float) -> Vector:
        """Row of the table, with the desired motion, for a tick; without calls where nothing is ramped."""
        if self._is_steady:
            self.index = index = int((begin - self._origin) * self._rate + 0.5)
            if index < self._tail:
                return self._table.row(index)
            if begin - self._origin >= self._table.end:
                self.index, self.boost = self._table.last, ()
                return self._table.row(self.index)
        return self._ramped(begin, step)

    def brake(self, begin: float, passed: float, deceleration: float, robot_speed: float) -> None:
        """Let schedule time, while ``passed`` s pass, brake at most so fast, and then stand.

        From the robot's speed, where that is lower: a desired position that went on faster would pull the spring.
        """
        desired, ran = self.speed_at(begin), 0.0
        speed = min(desired, robot_speed)
        if desired > 0.0:
            pace, free = self._pace * speed / desired, self._free * speed / desired
            left = max(0.0, 1.0 - deceleration * passed / speed) if speed else 0.0
            braking = 0.5 * min(passed, speed / deceleration)
            ran = braking * (1.0 + left) * pace
            self._ahead += braking * (1.0 + left) * free - ran
            self._pace, self._free = pace * left, free * left
        self.shift(passed - ran)
        self._lag = max(0.0, self._lag + self._catches_up * (passed - ran))
        self.boost, self._is_steady = (), False
        # The spring pulls at the braked robot as hard as before, and a rise of the pace would add to it: the next tick
        # tells how much it may.
        self._spare = 0.0

    def spare(self, pushed: Vector, before: Vector, after: Vector, step: float) -> None:
        """Let the pace rise by what a tick's change of velocity leaves, where boost and acceleration do not cause it.

        The acceleration is that of a push from outside.
        """
        # While a push is not taken out, a robot that is shaken comes back to its schedule seconds later.
        surplus = [w - v - step * part for v, w, part in zip(before, after, self.boost, strict=True)]
        self._spare = self.acceleration + self.norm(pushed) - self.norm(surplus) / step

    def shift(self, time: float) -> None:
        """Let so much time of the loop's clock pass without schedule time."""
        self._origin += time

    def _ramped(self, begin: float, step: float) -> Vector:
        time, last_pace = begin - self._origin, self._pace
        row, squared_limit = self._desired(time)
        motion = row[self._table.twist]
        speed, last_free, gain = self.norm(motion), last_pace, self.gain
        if self._is_soft:
            slope, last_free = self._slope, self._free
            gain -= self._taken * last_free * last_free
            # Where the schedule is slower than its approach, `gain` is for the changes of both.
            speed = speed + self.norm(slope) if last_pace < last_free else self.norm([*map(add, motion, slope)])
        faster, free = self._freely(last_free, gain, speed, step)
        self._pace = pace = min(last_pace + faster, free, math.sqrt(squared_limit))
        # Where the pace is even nothing says what is spare, and the first tick of a rise finds out.
        if pace == last_pace and (free == last_free or not self._is_soft):
            self.boost, self._spare = (), 0.0
        else:
            self.boost = tuple([(pace - last_pace) / step * part for part in motion])
        row[self._table.twist] = [pace * part for part in motion]
        if self._is_soft:
            if self.boost:
                self.boost = tuple([a + (free - last_free) / step * b for a, b in zip(self.boost, slope, strict=True)])
            self._ahead += 0.5 * step * (free + last_free - pace - last_pace)
            row[self._table.twist] = [pace * a + free * b for a, b in zip(motion, slope, strict=True)]
        self._free = free if self._is_soft else pace
        lost = step - 0.5 * step * (pace + last_pace)
        self._origin, self._lag = self._origin + lost, max(0.0, self._lag + lost) if self._lag else 0.0
        # Time is put onto a row where the ramp ends: without ramps a tick takes the nearest one.
        if pace == 1.0 != last_pace:
            self._origin += time + step - lost - round((time + step - lost) * self._rate) / self._rate
        if not self._is_soft and (time >= self._table.end or (pace == last_pace == 1.0 and not self._lag)):
            self.boost, self._is_steady = (), True
        return tuple(row)

    def _freely(self, pace: float, gain: float, speed: float, step: float) -> tuple[float, float]:
        """Largest rise of the pace in a tick, and the pace after it where the end of the schedule does not limit it."""
        # The pace changes by `rise` a second at most. From a pace of 1 + p, p^2 / (2 rise) of the lag is made up for by
        # the time it is down to 1 again: the p of the whole lag is the one to go for, once an approach is over.
        rise = gain / speed if speed else math.inf
        goal = 1.0
        if self._lag and not self._is_soft:
            goal = min(self._fastest, 1.0 + math.sqrt(2.0 * rise * self._lag))
        change = faster = rise * step
        if self._spare < gain and speed:
            faster = min(gain, max(_LEAST_SPARE * self.gain, self._spare)) / speed * step
        return faster, min(pace + faster, max(goal, pace - change))

    def _desired(self, time: float) -> tuple[list[float], float]:
        """Row at a time, its motion at a pace of 1 between it and the next, and the square of the largest pace.

        An approach under way changes the position, and its own velocity at a pace of 1 is ``_slope``.
        """
        table, limits, n_place = self._table, self._squared_limits, self._table.n_place
        if time >= table.end:
            self.index, row, squared_limit = table.last, list(table.row(table.last)), math.inf
        else:
            self.index = index = min(int(time * self._rate + _ON_ROW), table.last - 1)
            start, stop = index / self._rate, table.end if index + 1 == table.last else (index + 1) / self._rate
            share = (time - start) / (stop - start) if time < stop else 1.0
            row, after = list(table.row(index)), table.row(index + 1)
            # Quaternions this close are interpolated linearly: angles change evenly enough, and lengths do not matter.
            for i in range(table.twist.stop):
                row[i] += share * (after[i] - row[i])
            low, high = limits[index], limits[index + 1]
            squared_limit = low + share * (high - low)
        if self._is_soft:
            phase = (time + self._ahead - self._at) / self._blend
            self._is_soft = phase < 1.0
        if self._is_soft:
            # Rest of a way of 1 by minimum jerk, and its slope.
            left = 1.0 - phase**3 * (10.0 - 15.0 * phase + 6.0 * phase**2)
            slope = 30.0 * phase**2 * (1.0 - phase) ** 2 / self._blend
            away = [-left * part for part in self._distance]
            row[:n_place] = moved(row[:n_place], away)
            if self._lever is not None:
                turning = slice(table.twist.stop - 3, table.twist.stop)
                row[turning] = (rotations.matrix(rotations.exp(np.array(away[-3:]))) @ row[turning]).tolist()
            self._slope = [slope * part for part in self._distance]
            squared_limit *= self._end_share
        return row, squared_limit

    def _time_of(self, way: float, room: float) -> float:
        """Time of an approach within its largest speed and this acceleration."""
        return max(self._soft_start, _STEEPEST * way / self._approach_speed, math.sqrt(_SHARPEST * way / room))
