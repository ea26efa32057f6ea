"""The controller inside a robot's 1 kHz loop: measured force in, commanded motion out; no torch, nothing that grows."""

import math
import threading
from operator import add
from typing import Literal, final

import numpy as np

from torch_pbd.control.realtime.checks import Numbers, limit, mass_of, moment, number, vector
from torch_pbd.control.realtime.clock import ScheduleClock
from torch_pbd.control.realtime.force import ForceChannel
from torch_pbd.control.realtime.limits import limited
from torch_pbd.control.realtime.status import TickStatus
from torch_pbd.control.realtime.steps import Floats, Vector, braked
from torch_pbd.control.realtime.table import ScheduleLike, ScheduleTable
from torch_pbd.control.realtime.timer import SMOOTHING, TickTimer

_FINE = TickStatus(0)
_DECELERATION = 5.0  # units/s^2: from 0.5 m/s to rest in 0.1 s and 25 mm
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
        ``position`` and ``velocity`` (n, d), ``stiffness`` and ``damping`` (n, d, d) at ``time`` (n,), in s.
    mass : float, default=None
        Virtual mass in kg, the same in all directions; None takes the schedule's ``mass``, or 1 kg if it has none.
    rate : float, default=1000.0
        Rows of the table in 1/s: the rate of the loop.
    max_step : float, default=0.01
        Longest tick in s. Over a longer one the robot has braked, or rests where it was told to be last if there was
        time to be back; after three on end it stops.
    force_limit : float, default=200.0
        Range of the sensor, in N, as the length of the vector.
    deadband : float, default=0.0
        Forces up to it on an axis, in N, count as none, and larger ones by so much less, against drift and noise.
    spring_limit : float, default=None
        Most that the spring ``K (x_d - x)`` may pull at the start of a tick, in N; None takes ``force_limit``.
        Farther off, K is scaled by ``spring_limit / sqrt(k_max e'K e)``, e = x_d - x, k_max the largest eigenvalue:
        the force of a potential that is concave in e'K e, and so adds no energy where K is constant.
    velocity_limit, acceleration_limit : float, default=None
        Of the command, in units/s and units/s^2, as lengths of vectors. Where they act, ticks are not exact. None is
        the most that the desired motion and ``force_limit`` can cause where the damping is least.
    hold_ticks : int, default=10
        Ticks on end for which a force that is not finite is replaced, before the robot stops: by the median of the last
        five good ones, fading to nothing.
    stop_deceleration : float, default=None
        Of a stop, and where time is wrong, in units/s^2; never more than ``acceleration_limit``. None is 5, or what the
        desired motion may take if that is more.
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
        All that was wrong since ``start``.
    schedule_time : float
        Where in the schedule it is, in s.
    force, desired_position, desired_velocity : tuple of d floats
        What acted in the last tick: f in N, x_d and v_d.
    stiffness, damping : ndarray of shape (d, d)
        K in N/m, as ``spring_limit`` let it be, and D in N s/m of the last tick.

    Raises
    ------
    ValueError
        If a parameter is not as described, or a row of the schedule is not finite, not symmetric, not positive
        semidefinite, outside of ``stiffness_limits``, or has an axis with neither stiffness nor damping.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> still, stiffness = np.zeros((2, 1)), np.full((2, 1, 1), 100.0)
    >>> controller = RealTimeAdmittance(
    ...     SimpleNamespace(time=np.array([0.0, 1.0]), position=still, velocity=still, stiffness=stiffness,
    ...                     damping=2.0 * np.sqrt(stiffness), stiffness_limits=None)
    ... )
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
        schedule: ScheduleLike,
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
        self._mass = mass_of(schedule, mass)
        self._timer = TickTimer(rate, max_step, max_bad_ticks)
        self._channel = ForceChannel(self._mass, force_limit, deadband, force_rate_limit, hold_ticks)
        pull_limit = number("spring_limit", force_limit if spring_limit is None else spring_limit, "N, or None")
        self._pull_limit = pull_limit / self._mass
        self._table = table = ScheduleTable.of(schedule, self._mass, float(rate))
        self._speed_limit = limit("velocity_limit", velocity_limit, "units/s")
        self._acceleration_limit = limit("acceleration_limit", acceleration_limit, "units/s^2")
        self._is_limited = min(self._speed_limit, self._acceleration_limit) < math.inf
        self._clock = clock = ScheduleClock(table, soft_start, approach_speed, self._acceleration_limit, on_gap)
        stop = max(_DECELERATION, clock.acceleration) if stop_deceleration is None else stop_deceleration
        self._deceleration = min(number("stop_deceleration", stop, "units/s^2"), self._acceleration_limit)
        # Velocity answers a force with an impulse response whose absolute values integrate to 2 / damping at most.
        damping = float(np.linalg.eigvalsh(table.damping).min()) * self._mass
        answer = 2.0 * (force_limit + pull_limit) / damping if damping > 0.0 else math.inf
        self._speed_due = clock.speed + answer if velocity_limit is None else self._speed_limit
        self._turn = threading.Lock()
        self._begin(math.nan, None, (0.0,) * table.n_axes, 0.0, ())

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
            Where the robot is and how it moves; None takes it to be where the schedule is, at rest.
        at : float, default=0.0
            Where in the schedule to begin, in s; ``schedule_time`` goes on after a stop.
        force_bias : sequence of d floats, default=None
            What the sensor reads at rest, in N: the mean of some readings while nothing touches it. It is taken off
            every force; None is none. A bias of 0.5 N moves a robot of 50 N/m by 10 mm.

        Raises
        ------
        ValueError
            If an argument is not finite, too large or of another length, ``at`` is not within the schedule, or the
            velocity beyond ``velocity_limit``.
        RuntimeError
            If another thread is in a tick.
        """
        now, at = moment("now", now), moment("at", at)
        if not 0.0 <= at <= self._table.end:
            raise ValueError(f"at={at!r} must be a time in the schedule, from 0 to {self._table.end!r} s.")
        d = self._table.n_axes
        here = None if position is None else vector("position", position, d)
        moving = vector("velocity", (0.0,) * d if velocity is None else velocity, d)
        if math.hypot(*moving) > self._speed_limit:
            raise ValueError(f"velocity={moving} is beyond velocity_limit={self._speed_limit}: slow the robot first.")
        bias = () if force_bias is None else vector("force_bias", force_bias, d)
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
            Time of the clock that ``start`` was told, in s.
        force : sequence of d floats
            External force in N as measured now; it acts over the time since the last tick.

        Returns
        -------
        TickStatus
            What was wrong; 0 if nothing.

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
                raise ValueError(f"now={now!r} must be a time in s.") from None
            timer = self._timer
            step = now - timer.last
            is_regular = timer.is_regular and 0.0 < step <= timer.max_step
            status = self._channel.take(force, step if is_regular else timer.step)
            if status is not _FINE:
                self._is_stopped = self._is_stopped or self._channel.is_lost
            moved = self._live(now, step) if is_regular else self._live_irregular(now)
            if moved is not _FINE:
                status |= moved
            if self._is_stopped:
                status |= TickStatus.STOPPED
            if status is not _FINE:
                self.faults |= status
            return status
        finally:
            self._turn.release()

    @property
    def force(self) -> Vector:  # noqa: D102 - the class describes these
        return tuple(self._mass * component for component in self._channel.push)

    @property
    def desired_position(self) -> Vector:  # noqa: D102
        return self._row[: self._table.n_axes]

    @property
    def desired_velocity(self) -> Vector:  # noqa: D102
        return self._row[self._table.n_axes : 2 * self._table.n_axes]

    @property
    def stiffness(self) -> Floats:  # noqa: D102
        return self._scale * self._table.stiffness[self._clock.index]

    @property
    def damping(self) -> Floats:  # noqa: D102
        return self._table.damping[self._clock.index].copy()

    @property
    def schedule_time(self) -> float:  # noqa: D102
        return self._clock.time_at(self._timer.last)

    def _begin(self, now: float, position: Vector | None, velocity: Vector, at: float, bias: Vector) -> None:
        self._timer.begin(now)
        self._channel.begin(len(velocity), bias)
        self._scale, self._row = 1.0, self._clock.begin(now, at, position, velocity)
        self.position, self.velocity = position or self._row[: len(velocity)], velocity
        self._top_speed = max(self._speed_due, math.hypot(*velocity))
        self._is_stopped, self.faults = False, _FINE

    def _live(self, now: float, step: float) -> TickStatus:
        if self._is_stopped:
            self._brake(now, step, self._deceleration)
            return _FINE
        here, push = (self.position, self.velocity), self._channel.push
        row = self._clock.row(self._timer.last, step)
        if self._clock.boost:
            push = tuple(map(add, push, self._clock.boost))
        position, velocity, self._scale = self._table.advance(row, push, *here, step, self._pull_limit)
        status = _FINE if self._scale == 1.0 else TickStatus.SPRING_LIMITED
        if self._is_limited or math.hypot(*velocity) > self._top_speed:
            limits = self._top_speed, self._acceleration_limit
            position, velocity, reached = limited(position, velocity, *here, step, *limits)
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
        if status is _FINE:
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
