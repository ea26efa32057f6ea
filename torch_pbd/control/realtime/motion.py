"""Motion of the real-time controller, tick by tick: by eq. (15), possibly with filtered gains, or braking."""

import math
from collections.abc import Mapping
from copy import copy
from operator import add
from typing import Any, final

import numpy as np

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.control.filters import ActiveFilter, RateLimit, StiffnessFilter
from torch_pbd.control.realtime.clock import ScheduleClock
from torch_pbd.control.realtime.limits import Numbers, TickStatus, finite_floats, within_limits
from torch_pbd.control.realtime.steps import State, Vector, deviation, mean_move, moved
from torch_pbd.control.realtime.table import Scale, ScheduleTable
from torch_pbd.exceptions import InvalidParameterError

# From an approach at 0.5 m/s and 1 rad/s a robot is at rest in 0.1 s, after 25 mm and 3 degrees.
_DECELERATION = (5.0, 10.0)
# Time readings must resolve ticks to 1 %: times since 1970 in s do, as floats in ns they do not. So much of a tick is
# rounding of its length.
_COARSE = 0.01
# One late tick is a stall, and two may be; three that were not made up for mean that the loop is too slow.
_LATE_ON_END = 3
# Share of a bad or late tick that a good one makes up for: by default a robot that braked in one at 5 m/s^2 is as fast
# as before ten ticks later. A clock that repeats every other stamp, or one in ten, would hold it for ever.
_MADE_UP = 0.1
# Weight of the newest tick in the running mean of their duration, so that single short or long ones count little.
_SMOOTHING = 0.1
_OFF = 1e-3  # tolerance of a quaternion's length, which admits four rounded digits


@final
class Motion:
    """Place and velocity of the command, their dynamics, and whether the robot brakes for good.

    Ticks take at most ``longest`` s; ``last`` is the time up to which the motion is known, ``step`` the mean tick.
    """

    row: Vector
    place: Vector
    velocity: Vector
    scale: Scale

    def __init__(
        self,
        table: ScheduleTable,
        clock: ScheduleClock,
        options: Mapping[str, Vector],
        wanted: StiffnessFilter | None,
        max_step: float,
        max_bad_ticks: int,
    ) -> None:
        self._table, self._clock = table, clock
        above, remedy = 1.0 / table.rate, "give some ticks"
        self._max_step = checks.number(max_step, "max_step", above=above, unit="s", remedy=remedy)
        self.longest = self._max_step + _COARSE / table.rate
        self._max_bad_ticks = checks.count(max_bad_ticks, "max_bad_ticks")
        speeds, rises, stops = (options[name] for name in ("velocity_limit", "acceleration_limit", "stop_deceleration"))
        self._speed_limits, self._rises = speeds, rises
        self.filtered = None if wanted is None else FilteredGains(wanted, table)
        self._advance = (self.filtered or table).advance
        stop = clock.least(stops) if stops else max(clock.least(_DECELERATION[: len(table.blocks)]), clock.acceleration)
        self._deceleration = min(stop, clock.least(rises))
        # Impulse responses of velocity to force integrate, in absolute values, to 2 / damping at most along each mode,
        # for any mass: twice what damping alone lets them do, where not all modes are met at their worst at once.
        answers = 2.0 * table.mobility @ np.add(options["force_limit"], options["spring_limit"])
        due = [clock.speed / scale + answer for scale, answer in zip(clock.scales, answers.tolist(), strict=True)]
        self._speeds_due = tuple([d if most == math.inf else most for d, most in zip(due, speeds, strict=True)])

    def begin(
        self, now: float, at: float, position: Numbers | None, orientation: Numbers | None, velocity: Numbers | None
    ) -> None:
        """Restart in a state of the robot, which is checked; None is the schedule's place at that time, at rest."""
        table, blocks = self._table, self._table.blocks
        now, at = checks.number(now, "now", unit="s"), checks.number(at, "at", least=0.0, most=table.end, unit="s")
        if math.ulp(now) * table.rate > _COARSE:
            must = f"small enough to tell ticks of {1.0 / table.rate:g} s apart"
            raise checks.refusal(now, "now", must, "give seconds", unit="s")
        here = None if position is None else finite_floats(position, "position", blocks[0].stop)
        turned: Vector | None = None
        if orientation is not None:
            if len(blocks) == 1:
                raise InvalidParameterError("orientation is given, must be None for a schedule without: leave it out.")
            quaternion = checks.array(orientation, "orientation", (4,))
            length, remedy = float(np.linalg.norm(quaternion)), "give a unit quaternion w x y z"
            checks.number(length, "the length of orientation", least=1.0 - _OFF, most=1.0 + _OFF, remedy=remedy)
            turned = tuple((quaternion / length).tolist())
        moving = finite_floats(velocity, "velocity", table.n_axes)
        speeds = [math.hypot(*moving[block]) for block in blocks]
        kinds = ("the speed", "units/s"), ("the angular speed", "rad/s")
        for speed, most, (name, unit) in zip(speeds, self._speed_limits, kinds, strict=False):
            checks.number(speed, name, most=most, unit=unit, remedy="slow it down, or raise velocity_limit")
        self.last = self._newest = now
        self.step = 1.0 / table.rate
        self.is_regular, self._is_new, self.is_stopped = False, True, False
        self._n_bad = self._n_late = self._n_good = 0.0
        self.row, self.place = self._clock.begin(now, at, here, turned, moving)
        self.velocity, self.scale = moving, 1.0
        self._top_speeds = tuple(map(max, self._speeds_due, speeds))
        self._least_top = -1.0 if min(*self._speed_limits, *self._rises) < math.inf else min(self._top_speeds)
        if self.filtered is not None:  # the first tick gets the gains of its row unfiltered
            self.filtered.active = copy(self.filtered.fresh)

    @property
    def desired_place(self) -> Vector:
        """Desired place of the last tick; its quaternion is a unit one."""
        return moved(self.row[: self._table.n_place], (0.0,) * self._table.n_axes)

    @property
    def gains(self) -> tuple[Floats, Floats, Any]:
        """Stiffness before scaling by a limit, damping (d, d), and the granted share of a change, of the last tick."""
        if self.filtered is not None and self.filtered.active.gains is not None:
            return self.filtered.active.gains
        return self._table.stiffness[self._clock.index], self._table.damping[self._clock.index], 1.0

    def live(self, now: float, step: float, push: Vector) -> int:
        """Advance to ``now``, ``step`` s after the last tick, under a push; returns its faults."""
        if self.is_stopped:
            self._brake(now, self._deceleration)
            return 0
        clock, table = self._clock, self._table
        here = self.place, self.velocity
        row = clock.row(self.last, step)
        acting = tuple(map(add, push, table.forced(clock.boost, clock.index))) if clock.boost else push
        state, self.scale = self._advance(row, clock.index, acting, here, step)
        if clock.boost:
            clock.spare(table.accelerated(push, clock.index), here[1], state[1], step)
        status: int = 0 if self.scale == 1.0 else TickStatus.SPRING_LIMITED
        # No block is beyond its own top speed where all together are within the least of them.
        if math.hypot(*state[1]) > self._least_top:
            state, reached = within_limits(state, here, step, table.blocks, self._top_speeds, self._rises)
            status |= reached
        if self.filtered is not None:
            self.filtered.settle(row, acting, here, state)
        self.row, (self.place, self.velocity) = row, state
        self.last = now
        self.step += _SMOOTHING * (step - self.step)
        self._n_good += 1
        return status

    def check_start(self, now: float) -> None:
        """Raise before the start, and where all of several ticks since then were longer than ``max_step``."""
        if math.isnan(self.last):
            raise RuntimeError("tick before start: call start(now) with the time of the same clock first.")
        late, step = self._n_late + 1, now - self.last
        if self._is_new and late >= _LATE_ON_END and self.longest < step < math.inf:
            must = f"longer than a tick: all {late:g} since start were longer, the last of {step:.4g} s"
            raise checks.refusal(self._max_step, "max_step", must, "give some ticks, and times in s", unit="s")

    def live_irregular(self, now: float, push: Vector) -> int:
        """Advance as `live` by a tick that differs from the last one, or to an invalid time ``now``."""
        status = self._read(now)
        self.is_stopped |= self._n_bad >= self._max_bad_ticks or self._n_late >= _LATE_ON_END
        if not status:
            return self.live(now, now - self.last, push)
        if status == TickStatus.CLOCK:  # a tick is then taken to be as long as they are
            now = self.last + self.step
        # In 1 + sqrt(2) times as long as it brakes the robot can be back: after a longer gap, without commands, it
        # rests where it was told to be last, and is not thrown from there.
        passed, speed = now - self.last, max(self._clock.norm(self.velocity), self._clock.speed_at(self.last))
        can_be_back = status == TickStatus.LATE and passed * self._deceleration > 3.0 * speed
        self._brake(now, math.inf if can_be_back else self._deceleration)
        return status

    def _read(self, now: float) -> int:
        """Fault of a tick that differs from the last one."""
        if self.is_regular:
            made_up = _MADE_UP * self._n_good
            self._n_bad, self._n_late = max(0.0, self._n_bad - made_up), max(0.0, self._n_late - made_up)
            self.is_regular, self._newest, self._n_good = False, self.last, 0.0
        if not self._newest < now < math.inf:
            self._n_bad += 1
            return TickStatus.CLOCK
        # The clock has lost what bad ticks have lived through.
        if self._newest < self.last and now < self.last + 0.5 * self.step:
            self._clock.shift(now - self.step - self.last)
            self.last = now - self.step
        self._newest = now
        if now - self.last > self.longest:
            self._n_late += 1
            return TickStatus.LATE
        self.is_regular, self._is_new = True, False
        return 0

    def _brake(self, now: float, deceleration: float) -> None:
        """Brake all axes in proportion until ``now``, or until standstill."""
        passed, speed = now - self.last, self._clock.norm(self.velocity)
        self._clock.brake(self.last, passed, deceleration, speed)
        braking = min(passed, speed / deceleration)
        left = 1.0 - deceleration * passed / speed if braking == passed else 0.0
        slower = tuple([left * component for component in self.velocity])
        self.place = moved(self.place, mean_move(self.velocity, slower, braking))
        self.velocity, self.last = slower, now


@final
class FilteredGains:
    """Filtered stiffness and damping (d, d) in effect, and ticks with them; the table's where nothing is held back.

    The springs of a table that is ``steady`` are limited by the largest stiffness of all rows: their force is that of
    one potential that is concave in e'K e, also where K changes. A rise of e'K e then puts at most ``scale / 2`` times
    itself into it, with the scale before the rise, and a fall takes at least as much out.
    """

    active: ActiveFilter
    _row: Vector

    def __init__(self, wanted: StiffnessFilter, table: ScheduleTable) -> None:
        checks.instance(wanted, "stiffness_filter", StiffnessFilter)
        mass = table.mass
        if not np.ptp(mass, axis=0).any():
            mass = mass[0]
        # In the simulation a run stops where the damping does not pay for what these add; a robot must not, half way.
        if isinstance(wanted, RateLimit) and (mass.ndim == 3 or len(table.blocks) == 2):
            must = "an EnergyTank for poses and masses that vary"
            remedy = "before the loop nobody knows whether the damping pays for what turns or grows"
            raise checks.refusal(wanted, "stiffness_filter", must, remedy)
        self._table = table
        self.fresh = wanted.start(table.stiffness, table.damping, mass)

    def advance(self, row: Vector, index: int, push: Vector, here: State, step: float) -> tuple[State, Scale]:
        """Place and velocity after a tick of ``step`` s along a row of the table, and the scale of the stiffness."""
        table, active, scale = self._table, self.active, np.ones(self._table.n_axes)
        off = np.array(deviation(here[0], row[: table.n_place], table.n_axes))
        if active.gains is not None:
            # What is held on to turns with the desired orientation, as the tool sees it.
            turn: Floats = np.array(deviation(row[: table.n_place], self._row[: table.n_place], table.n_axes)[-3:])
            if table.n_place > table.n_axes and turn.any():
                active.carry(rotations.matrix(rotations.exp(turn)))
            scale = table.along_axes(table.scales(row, active.gains[0], off))
        active.select(table.stiffness[index], table.damping[index], table.mass[index], step, off, scale)
        self._row = row
        return table.advance(row, index, push, here, step, active.gains[:2] if active.gains[2] < 1.0 else None)

    def settle(self, row: Vector, push: Vector, before: State, after: State) -> None:
        """Record the tick: place and velocity at its start and end, and the push held during it."""
        n_place, d = self._table.n_place, self._table.n_axes
        force = push + self.active.gains[1] @ row[self._table.twist]
        start, end = ((np.array(deviation(place, row[:n_place], d)), np.array(v)) for place, v in (before, after))
        self.active.settle(start, end, force, self._energy)

    def _energy(self, stiffness: Floats, off: Floats) -> float:
        """Energy of the limited springs in J."""
        energy = 0.0
        for spring, top in zip(self._table.springs, self._row[self._table.twist.stop :], strict=False):
            stretch = float(off[spring] @ stiffness[spring, spring] @ off[spring])
            energy += 0.5 * stretch if top * stretch <= 1.0 else math.sqrt(stretch / top) - 0.5 / top
        return energy
