"""The controller inside a robot's 1 kHz loop: measured force in, commanded motion out; no torch, nothing that grows."""

import math
import threading
from collections.abc import Sequence
from operator import add
from typing import Any, Literal, final

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.realtime.clock import SMOOTHING, ScheduleClock, TickTimer
from torch_pbd.control.realtime.force import ForceChannel
from torch_pbd.control.realtime.limits import FINE, TickStatus, limited
from torch_pbd.control.realtime.steps import Vector, braked
from torch_pbd.control.realtime.table import ScheduleTable
from torch_pbd.control.schedule import Schedule

Numbers = Sequence[float] | Floats

_DECELERATION = 5.0  # units/s^2: from 0.5 m/s to rest in 0.1 s and 25 mm
_LIGHTEST = 1e-50  # kg, of which products with gains are numbers
_SHARED = "this controller is in a tick already: two threads share it. Give each its own."


@final
class RealTimeAdmittance:
    """Moves as ``M a = f + K (x_d - x) + D (v_d - v)`` asks, eq. (15) as admittance, one tick at a time.

    A tick is solved exactly over the time that really passed, with force and schedule held over it: irregular and
    late ticks add no energy where the stiffness is constant. (Where it rises, see `certify`.) The schedule is copied
    to a table of rows ``1 / rate`` apart; between its own rows it is what `Schedule.resample` says. A tick takes the
    row nearest to its beginning, and after the end of the schedule the last one, with no velocity.

    Desired motion begins as fast as the robot moves and ends at rest: schedule time comes up to speed, and slows down
    before the end, within 1.5 times the schedule's own acceleration, or what a soft start takes if that is more.

    Where damping shares the axes of stiffness in every row, as ``2 zeta sqrt(m K)`` does, a tick takes microseconds,
    otherwise a matrix exponential by NumPy, 0.1 ms. Interpolation between turned axes loses the sharing: sample the
    schedule at ``rate``. The table of a minute at 1 kHz takes 10 MB for d = 2; ticks keep no memory.

    Parameters
    ----------
    schedule : Schedule
        Or anything with its ``time`` (n,), ``position`` and ``velocity`` (n, d), ``stiffness`` and ``damping``
        (n, d, d), and ``stiffness_limits``.
    mass : float, default=None
        Virtual mass in kg, the same in all directions; None takes the schedule's ``mass``, or 1 kg if it has none.
    rate : float, default=1000.0
        Rows of the table in 1/s: the rate of the loop.
    max_step : float, default=0.01
        Longest tick in s. Over a longer one the robot has braked, or rests at its last command if there was time to
        be back; after three on end it stops.
    force_limit : float, default=200.0
        Range of the sensor, in N, as the length of the vector.
    deadband : float, default=0.0
        Forces up to it on an axis, in N, count as none, and larger ones by so much less, against drift and noise.
    spring_limit : float, default=None
        Largest pull of the spring ``K (x_d - x)`` at the start of a tick, in N; None takes ``force_limit``. Farther
        off, K is scaled by ``spring_limit / sqrt(k_max e'K e)``, e = x_d - x, k_max the largest eigenvalue: the force
        of a potential that is concave in e'K e, and so adds no energy where K is constant.
    velocity_limit, acceleration_limit : float, default=None
        Limits of the command, in units/s and units/s^2, as lengths of vectors. Where they act, ticks are not exact.
        None is the most that the desired motion and ``force_limit`` can cause where the damping is least.
    hold_ticks : int, default=10
        Ticks on end for which a force that is not finite is replaced, before the robot stops: by the median of the last
        five good ones, fading to nothing.
    stop_deceleration : float, default=None
        Deceleration of a stop, and where time is wrong, in units/s^2; never more than ``acceleration_limit``. None is
        5, or the most that the desired motion takes if that is more.
    soft_start, approach_speed : float, default=1.0, 0.5
        Time in s in which the desired position moves from the robot's at ``start`` to the schedule's, by minimum jerk;
        longer where it would move away from the schedule faster than this, in units/s. With a soft_start of 0 the
        schedule begins at its own speed.
    on_gap : {"pause", "resume"}, default="pause"
        After a tick longer than ``max_step`` the schedule goes on from where it was, or also catches up, within limits.
    max_bad_ticks : int, default=10
        Ticks on end whose time does not increase or is not finite, over which the robot brakes, before it stops.
    force_rate_limit : float, default=None
        Fastest change of the force, in N/s: a spike of the sensor moves the robot less, and a contact is felt later.

    Attributes
    ----------
    position, velocity : tuple of d floats
        The command, in units and units/s.
    faults : TickStatus
        All faults since ``start``.

    Raises
    ------
    ValueError
        If a parameter is not as described, or the schedule not as `Schedule` describes it.

    Examples
    --------
    >>> import numpy as np
    >>> still, gain = np.zeros((2, 1)), np.ones((2, 1, 1))
    >>> controller = RealTimeAdmittance(Schedule([0.0, 1.0], still, still, 100.0 * gain, 20.0 * gain, gain, [0.0, 0.0]))
    >>> controller.start(0.0)
    >>> for tick in range(1, 2000):
    ...     status = controller.tick(tick / 1000, [5.0])
    >>> [round(value, 4) for value in controller.position]  # 5 N on 100 N/m
    [0.05]
    """

    faults: TickStatus
    _is_stopped: bool

    def __init__(
        self,
        schedule: Schedule | Any,
        *,
        mass: float | None = None,
        rate: float = 1000.0,
        max_step: float = 0.01,
        force_limit: float = 200.0,
        deadband: float = 0.0,
        spring_limit: float | None = None,
        velocity_limit: float | None = None,
        acceleration_limit: float | None = None,
        hold_ticks: int = 10,
        stop_deceleration: float | None = None,
        soft_start: float = 1.0,
        approach_speed: float = 0.5,
        on_gap: Literal["pause", "resume"] = "pause",
        max_bad_ticks: int = 10,
        force_rate_limit: float | None = None,
    ) -> None:
        own = getattr(schedule, "mass", None)
        given = (own or 1.0) if mass is None else mass
        self._mass = checks.number(given, "mass", least=_LIGHTEST, most=1.0 / _LIGHTEST, unit="kg")
        if own is not None and self._mass != own:
            checks.warn(f"mass is {mass}, but damping_ratio was met for mass={own:g} kg: give both the same.")
        self._timer = TickTimer(rate, max_step, max_bad_ticks)
        self._channel = ForceChannel(self._mass, force_limit, deadband, force_rate_limit, hold_ticks)
        pull = force_limit if spring_limit is None else spring_limit
        self._pull_limit = checks.number(pull, "spring_limit", above=0.0, unit="N") / self._mass
        self._table = table = ScheduleTable(schedule, self._mass, float(rate))
        speed = checks.number(velocity_limit, "velocity_limit", above=0.0, unit="units/s", optional=True)
        rise = checks.number(acceleration_limit, "acceleration_limit", above=0.0, unit="units/s^2", optional=True)
        self._speed_limit, self._acceleration_limit = speed or math.inf, rise or math.inf
        self._is_limited = min(self._speed_limit, self._acceleration_limit) < math.inf
        self._clock = clock = ScheduleClock(table, soft_start, approach_speed, self._acceleration_limit, on_gap)
        stop = max(_DECELERATION, clock.acceleration) if stop_deceleration is None else stop_deceleration
        stop = checks.number(stop, "stop_deceleration", above=0.0, unit="units/s^2")
        self._deceleration = min(stop, self._acceleration_limit)
        # Velocity answers a force with an impulse response whose absolute values integrate to 2 / damping at most.
        damping = table.least_damping * self._mass
        answer = 2.0 * (force_limit + pull) / damping if damping > 0.0 else math.inf
        self._speed_due = clock.speed + answer if velocity_limit is None else self._speed_limit
        self._turn = threading.Lock()
        self._begin(math.nan, None, (0.0,) * table.n_axes, 0.0, ())

    def __repr__(self) -> str:
        table = self._table
        return (
            f"RealTimeAdmittance(n_axes={table.n_axes}, rows={table.last + 1}, rate={table.rate:g} Hz, "
            f"mass={self._mass:g} kg, schedule_time={self.schedule_time:.6g}..{table.end:.6g} s, faults={self.faults})"
        )

    def start(
        self,
        now: float,
        position: Numbers | None = None,
        velocity: Numbers | None = None,
        *,
        at: float = 0.0,
        force_bias: Numbers | None = None,
    ) -> None:
        """Begin, or begin again: faults, forces and motion are forgotten.

        Parameters
        ----------
        now : float
            Time of a monotonic clock, in s, from which ticks count.
        position, velocity : sequence of d floats, default=None
            State of the robot, in units and units/s; None takes it to be where the schedule is, at rest.
        at : float, default=0.0
            Time in the schedule to begin at, in s; ``schedule_time`` goes on after a stop.
        force_bias : sequence of d floats, default=None
            Reading of the sensor at rest, in N: the mean of some while nothing touches it. It is taken off every
            force; None is none. A bias of 0.5 N moves a robot of 50 N/m by 10 mm.

        Raises
        ------
        ValueError
            If an argument is not finite, too large or of another length, ``at`` is not within the schedule, or the
            velocity beyond ``velocity_limit``.
        RuntimeError
            If another thread is in a tick.
        """
        now = checks.number(now, "now", unit="s")
        at = checks.number(at, "at", least=0.0, most=self._table.end, unit="s")
        here = None if position is None else self._vector(position, "position")
        moving = (0.0,) * self._table.n_axes if velocity is None else self._vector(velocity, "velocity")
        if math.hypot(*moving) > self._speed_limit:
            must = f"at most {self._speed_limit:g}, the velocity_limit, in length"
            raise checks.refusal(moving, "velocity", must, "slow the robot first", unit="units/s")
        bias = () if force_bias is None else self._vector(force_bias, "force_bias")
        if not self._turn.acquire(False):
            raise RuntimeError(_SHARED)
        try:
            self._begin(now, here, moving, at, bias)
        finally:
            self._turn.release()

    def tick(self, now: float, force: Numbers) -> TickStatus:
        """Move on to ``now``; ``position`` and ``velocity`` are then the command.

        Parameters
        ----------
        now : float
            Time of the clock that ``start`` was given, in s.
        force : sequence of d floats
            External force in N as measured now; it acts over the time since the last tick.

        Returns
        -------
        TickStatus
            Faults of the tick; 0 if none.

        Raises
        ------
        ValueError
            If ``now`` is not a number or ``force`` not d numbers; or at the third tick on end since ``start`` that
            takes longer than ``max_step``. The command has not changed then.
        RuntimeError
            If ``start`` was not called, or another thread is in a tick.
        """
        if not self._turn.acquire(False):
            raise RuntimeError(_SHARED)
        try:
            try:
                now = float(now)
            except (TypeError, ValueError, OverflowError):
                raise checks.refusal(now, "now", "a time in s") from None
            timer = self._timer
            step = now - timer.last
            is_regular = timer.is_regular and 0.0 < step <= timer.max_step
            status = self._channel.take(force, step if is_regular else timer.step)
            if status is not FINE:
                self._is_stopped = self._is_stopped or self._channel.is_lost
            moved = self._live(now, step) if is_regular else self._live_irregular(now)
            if moved is not FINE:
                status |= moved
            if self._is_stopped:
                status |= TickStatus.STOPPED
            if status is not FINE:
                self.faults |= status
            return status
        finally:
            self._turn.release()

    @property
    def force(self) -> Vector:
        """External force f that acted in the last tick, d floats in N."""
        return tuple(self._mass * component for component in self._channel.push)

    @property
    def desired_position(self) -> Vector:
        """Desired position x_d of the last tick, d floats in units."""
        return self._row[: self._table.n_axes]

    @property
    def desired_velocity(self) -> Vector:
        """Desired velocity v_d of the last tick, d floats in units/s."""
        return self._row[self._table.n_axes : 2 * self._table.n_axes]

    @property
    def stiffness(self) -> Floats:
        """Stiffness K (d, d) of the last tick in N/m, as ``spring_limit`` let it be."""
        return self._scale * self._table.stiffness[self._clock.index]

    @property
    def damping(self) -> Floats:
        """Damping D (d, d) of the last tick in N s/m."""
        return self._table.damping[self._clock.index].copy()

    @property
    def schedule_time(self) -> float:
        """Time in the schedule, in s."""
        return self._clock.time_at(self._timer.last)

    def _vector(self, values: Numbers, name: str) -> Vector:
        return tuple(checks.array(values, name, (self._table.n_axes,)).tolist())

    def _begin(self, now: float, position: Vector | None, velocity: Vector, at: float, bias: Vector) -> None:
        self._timer.begin(now)
        self._channel.begin(len(velocity), bias)
        self._scale, self._row = 1.0, self._clock.begin(now, at, position, velocity)
        self.position, self.velocity = position or self._row[: len(velocity)], velocity
        self._top_speed = max(self._speed_due, math.hypot(*velocity))
        self._is_stopped, self.faults = False, FINE

    def _live(self, now: float, step: float) -> TickStatus:
        if self._is_stopped:
            self._brake(now, step, self._deceleration)
            return FINE
        here, push = (self.position, self.velocity), self._channel.push
        row = self._clock.row(self._timer.last, step)
        if self._clock.boost:
            push = tuple(map(add, push, self._clock.boost))
        position, velocity, self._scale = self._table.advance(row, push, *here, step, self._pull_limit)
        status = FINE if self._scale == 1.0 else TickStatus.SPRING_LIMITED
        if self._is_limited or math.hypot(*velocity) > self._top_speed:
            limits = self._top_speed, self._acceleration_limit
            position, velocity, reached = limited((position, velocity), here, step, *limits)
            status |= reached
        self._row, self.position, self.velocity = row, position, velocity
        self._timer.last = now
        self._timer.step += SMOOTHING * (step - self._timer.step)
        return status

    def _live_irregular(self, now: float) -> TickStatus:
        timer = self._timer
        status, shift = timer.read(now)
        self._clock.shift(shift)
        if timer.is_failed:
            self._is_stopped = True
        if status is FINE:
            return self._live(now, now - timer.last)
        if status is TickStatus.CLOCK:
            now = timer.last + timer.step
        # In 1 + sqrt(2) times as long as it brakes the robot can be back: after a longer gap, without commands, it
        # rests where it was told to be last, and is not thrown from there.
        passed, speed = now - timer.last, max(math.hypot(*self.velocity), self._clock.speed_at(timer.last))
        can_be_back = status is TickStatus.LATE and passed * self._deceleration > 3.0 * speed
        self._brake(now, passed, math.inf if can_be_back else self._deceleration)
        return status

    def _brake(self, now: float, passed: float, deceleration: float) -> None:
        self._clock.brake(self._timer.last, passed, deceleration)
        self.position, self.velocity = braked(self.position, self.velocity, deceleration, passed)
        self._timer.last = now
