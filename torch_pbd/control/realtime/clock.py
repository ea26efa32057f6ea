"""The two clocks of the real-time controller: that of the loop, and where it is in its schedule."""

import math
from operator import add, mul, sub
from typing import final

import numpy as np

from torch_pbd import checks
from torch_pbd.control.realtime.limits import FINE, TickStatus
from torch_pbd.control.realtime.steps import Vector, minimum_jerk
from torch_pbd.control.realtime.table import ScheduleTable

# A reading must tell ticks apart to 1 %: times since 1970 in s do, in ns they do not.
_COARSE = 0.01
# One late tick is a stall, two may be; three on end are a loop that is too slow.
_LATE_ON_END = 3
# Share of the newest tick in how long a tick lasts: neither one short tick nor one long counts for much.
SMOOTHING = 0.1
# The desired motion may be 1.5 times as fast as the schedule, and accelerate so much more: one half of that changes the
# pace, the other is left for the square of the pace while it catches up.
_SPEED, _SHARE = 1.5, 0.25
# Share of `gain` that a rise of the pace may always take, so that nobody who shakes the robot makes its schedule stand.
_LEAST_SPARE = 0.1
# Share of a row: time that was put onto a row takes that row, to whichever side it was rounded.
_ON_ROW = 1e-6
# A minimum jerk of 1 over a time of 1 has a velocity of 15/8 and an acceleration of 10 / sqrt(3).
_STEEPEST, _SHARPEST = 1.875, 5.7735


@final
class TickTimer:
    """Ticks of at most ``max_step`` s; ``last`` is until when the motion is known, ``step`` how long ticks last."""

    def __init__(self, rate: float, max_step: float, max_bad_ticks: int) -> None:
        self._rate = checks.number(rate, "rate", above=0.0, unit="1/s")
        self.max_step = checks.number(max_step, "max_step", above=1.0 / self._rate, unit="s", remedy="give some ticks")
        self._max_bad_ticks = checks.count(max_bad_ticks, "max_bad_ticks")
        self.begin(math.nan)

    def begin(self, now: float) -> None:
        """Count from ``now``."""
        if math.ulp(now) * self._rate > _COARSE:
            must = f"small enough to tell ticks of {1.0 / self._rate:g} s apart"
            raise checks.refusal(now, "now", must, "give seconds", unit="s")
        self.last = self._newest = now
        self.step = 1.0 / self._rate
        self.is_regular, self._is_new = False, True
        self._n_bad = self._n_late = 0

    @property
    def is_failed(self) -> bool:
        """Whether bad or late ticks are too many on end for the robot to go on."""
        return self._n_bad >= self._max_bad_ticks or self._n_late >= _LATE_ON_END

    def read(self, now: float) -> tuple[TickStatus, float]:
        """Fault of a tick that is not like the last one, and the time by which ``last`` was put forward.

        Where the clock does not say how long a tick took, it is taken to be as long as they are.
        """
        if math.isnan(self.last):
            raise RuntimeError("tick before start: call start(now) with the time of the same clock first.")
        if self.is_regular:
            self.is_regular, self._newest = False, self.last
        if not self._newest < now < math.inf:
            self._n_bad += 1
            return TickStatus.CLOCK, 0.0
        shift = 0.0
        # The clock has lost what bad ticks have lived through.
        if self._n_bad and now < self.last + 0.5 * self.step:
            shift, self.last = now - self.step - self.last, now - self.step
        self._newest, self._n_bad, step = now, 0, now - self.last
        if step > self.max_step:
            self._n_late += 1
            if self._is_new and self._n_late >= _LATE_ON_END:
                must = f"longer than a tick: all {self._n_late} since start were longer, the last of {step:.4g} s"
                raise checks.refusal(self.max_step, "max_step", must, "give some ticks, and times in s", unit="s")
            return TickStatus.LATE, shift
        self.is_regular, self._is_new, self._n_late = True, False, 0
        return FINE, shift


@final
class ScheduleClock:
    """Schedule time, which runs at a pace from 0 to 1, or a little more to catch up, and the motion desired then.

    At a pace r the desired velocity is r x' and its acceleration r^2 x'' + r' x'. The second term is at most ``gain``,
    also towards the end of a schedule that ends while moving: there r^2 <= 2 gain times the integral of dt / |x'| over
    what is left. ``boost`` is that term, to be fed forward, so that no change of pace displaces the robot. At a pace
    of 1 schedule time is a difference of two times of the loop's clock, which adds up no rounding.

    The desired motion stays within ``acceleration``, and with it a robot that nobody pushes: an approach from elsewhere
    takes what the schedule's own acceleration leaves, and a change of pace what both leave; nothing is caught up
    meanwhile; and the pace rises no faster than the pull of the spring leaves room for (see `spare`). The end of the
    schedule does not slow an approach, which has a pace of its own, ``_free``, and is ``_ahead`` of the schedule then.
    """

    def __init__(
        self, table: ScheduleTable, soft_start: float, approach_speed: float, acceleration_limit: float, on_gap: str
    ) -> None:
        self._catches_up = checks.choice(on_gap, "on_gap", ("pause", "resume")) == "resume"
        self._table, self._d, self._rate = table, table.n_axes, table.rate
        self._packed, self._row_size, self._unpack = table.packed, table.layout.size, table.layout.unpack_from
        self._soft_start = checks.number(soft_start, "soft_start", least=0.0, unit="s")
        self._approach_speed = checks.number(approach_speed, "approach_speed", above=0.0, unit="units/s")
        own, fastest = table.acceleration, float(table.speeds.max())
        # Acceleration of a soft start that comes up to speed; without one, a second is as long as its default.
        soft = max(fastest, approach_speed) / (soft_start or 1.0)
        # One half of a limit is left for the schedule's own acceleration.
        self.gain = min(max(_SHARE * own, soft), 0.5 * acceleration_limit)
        self.speed = _SPEED * fastest + approach_speed
        self.acceleration = max((1.0 + _SHARE) * own + self.gain, _SHARPEST / _STEEPEST * soft)
        # What the schedule's own acceleration leaves to an approach; a critically damped spring overshoots it by 13 %.
        self._room = max(self.gain, self.acceleration - (1.0 + _SHARE) * own)
        room = (self.acceleration - self.gain) / own if own else math.inf
        self._fastest = min(_SPEED, math.sqrt(room)) if self._catches_up else 1.0
        # Integral of dt / |x'| from each row to the end; where the schedule rests it is long, not endless.
        times = np.append(np.arange(table.last) / table.rate, table.end)
        speeds = np.maximum(0.5 * (table.speeds[1:] + table.speeds[:-1]), 1e-9 * self.speed)
        left = np.append(np.cumsum((np.diff(times) / speeds)[::-1])[::-1], 0.0)
        squared_limits = 2.0 * self.gain * left
        self._tail = int(np.count_nonzero(squared_limits >= self._fastest**2))
        # Where a schedule that ends while moving is slower if it may take one half of `gain` for that.
        ends_moving = table.speeds[-1] * table.rate > self.gain
        self._slow_from = float(times[np.count_nonzero(squared_limits >= 2.0) - 1]) if ends_moving else math.inf
        # Items of a memoryview are floats, and a tick takes them faster than those of an array.
        self._squared_limits = squared_limits.data

    def begin(self, now: float, at: float, position: Vector | None, velocity: Vector) -> Vector:
        """Start at a time of the schedule, whose row it is, as fast as the velocity of the robot is the desired one.

        A desired position that begins elsewhere comes to the schedule's by minimum jerk.
        """
        d = self._d
        self._at, self._origin, self._lag, self._is_soft = at, now - at, 0.0, False
        self.boost: Vector = ()
        self._spare, self._ahead, self._end_share = self.gain, 0.0, 1.0
        row, squared_limit = self._desired(at)
        self._distance: Vector = (0.0,) * d if position is None else tuple(map(sub, row, position))
        way, room = math.hypot(*self._distance), self._room
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
        motion = row[d : 2 * d]
        square, along = sum(map(mul, motion, motion)), sum(map(mul, motion, velocity))
        pace = max(0.0, along / square) if square and self._soft_start else 1.0
        self._free = min(1.0, pace)
        self._pace = min(self._free, math.sqrt(squared_limit))
        self._is_steady = self._pace == 1.0 and not self._is_soft
        return tuple(row)

    def time_at(self, now: float) -> float:
        """Schedule time at the end of the last tick, in s."""
        return min(now - self._origin, self._table.end)

    def speed_at(self, now: float) -> float:
        """Desired speed at the end of the last tick."""
        row, _ = self._desired(now - self._origin)
        motion = row[self._d : 2 * self._d]
        if self._is_soft:
            return math.hypot(*[self._pace * v + self._free * w for v, w in zip(motion, self._slope, strict=True)])
        return self._pace * math.hypot(*motion)

    def row(self, begin: float, step: float) -> Vector:
        """Row of the table, with the desired motion, for a tick; without calls where nothing is ramped."""
        if self._is_steady:
            self.index = index = int((begin - self._origin) * self._rate + 0.5)
            if index < self._tail:
                return self._unpack(self._packed, index * self._row_size)
            if begin - self._origin >= self._table.end:
                self.index, self.boost = self._table.last, ()
                return self._unpack(self._packed, self.index * self._row_size)
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

    def spare(self, push: Vector, before: Vector, after: Vector, step: float) -> None:
        """Let the pace rise by what a tick's change of velocity leaves, where the boost and a push do not cause it."""
        # While a push is not taken out, a robot that is shaken comes back to its schedule seconds later.
        boosted = [v + step * part for v, part in zip(before, self.boost, strict=True)]
        self._spare = self.acceleration + math.hypot(*push) - math.dist(after, boosted) / step

    def shift(self, time: float) -> None:
        """Let so much time of the loop's clock pass without schedule time."""
        self._origin += time

    def _ramped(self, begin: float, step: float) -> Vector:
        d, time, last_pace = self._d, begin - self._origin, self._pace
        row, squared_limit = self._desired(time)
        motion = row[d : 2 * d]
        # Most ticks of an approach: at a pace of 1 nothing changes it, for nothing is caught up.
        if self._is_soft and last_pace == self._free == 1.0 <= squared_limit:
            self.boost, self._spare = (), 0.0
            row[d : 2 * d] = map(add, motion, self._slope)
            return tuple(row)
        speed, last_free, gain = math.hypot(*motion), last_pace, self.gain
        if self._is_soft:
            slope, last_free = self._slope, self._free
            gain -= self._taken * last_free * last_free
            # Where the schedule is slower than its approach, `gain` is for the changes of both.
            speed = speed + math.hypot(*slope) if last_pace < last_free else math.hypot(*map(add, motion, slope))
        faster, free = self._freely(last_free, gain, speed, step)
        self._pace = pace = min(last_pace + faster, free, math.sqrt(squared_limit))
        # Where the pace is even nothing says what is spare, and the first tick of a rise finds out.
        if pace == last_pace and (free == last_free or not self._is_soft):
            self.boost, self._spare = (), 0.0
        else:
            self.boost = tuple([(pace - last_pace) / step * part for part in motion])
        row[d : 2 * d] = [pace * part for part in motion]
        if self._is_soft:
            if self.boost:
                self.boost = tuple([a + (free - last_free) / step * b for a, b in zip(self.boost, slope, strict=True)])
            self._ahead += 0.5 * step * (free + last_free - pace - last_pace)
            for i, part in enumerate(slope, start=d):
                row[i] += free * part
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
        table, d, limits = self._table, self._d, self._squared_limits
        if time >= table.end:
            self.index, row, squared_limit = table.last, list(table.row(table.last)), math.inf
        else:
            self.index = index = min(int(time * self._rate + _ON_ROW), table.last - 1)
            start, stop = index / self._rate, table.end if index + 1 == table.last else (index + 1) / self._rate
            share = (time - start) / (stop - start) if time < stop else 1.0
            row = list(self._unpack(self._packed, index * self._row_size))
            after = self._unpack(self._packed, (index + 1) * self._row_size)
            for i in range(2 * d):
                row[i] += share * (after[i] - row[i])
            low, high = limits[index], limits[index + 1]
            squared_limit = low + share * (high - low)
        if self._is_soft:
            phase = (time + self._ahead - self._at) / self._blend
            self._is_soft = phase < 1.0
        if self._is_soft:
            left, slope = minimum_jerk(phase)
            slope /= -self._blend
            for i, part in enumerate(self._distance):
                row[i] -= left * part
            self._slope = [slope * part for part in self._distance]
            squared_limit *= self._end_share
        return row, squared_limit

    def _time_of(self, way: float, room: float) -> float:
        """Time of an approach within its largest speed and this acceleration."""
        return max(self._soft_start, _STEEPEST * way / self._approach_speed, math.sqrt(_SHARPEST * way / room))
