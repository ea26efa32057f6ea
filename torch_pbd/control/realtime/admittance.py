"""The controller inside a robot's 1 kHz loop: measured force in, commanded motion out; no torch, nothing that grows."""

import math
import threading
import warnings
from operator import add
from typing import Literal, final

import numpy as np

from torch_pbd.control.realtime.checks import Numbers, limit, moment, number, vector, whole
from torch_pbd.control.realtime.clock import ScheduleClock
from torch_pbd.control.realtime.force import ForceChannel
from torch_pbd.control.realtime.limits import limited
from torch_pbd.control.realtime.status import TickStatus
from torch_pbd.control.realtime.steps import Floats, Vector, braked
from torch_pbd.control.realtime.table import ScheduleLike, ScheduleTable

_FINE = TickStatus(0)
_COARSE = 0.01  # of a tick, to which a time must be told
_DECELERATION = 5.0  # units/s^2: from 0.5 m/s to rest in 0.1 s and 25 mm
_LATE_ON_END = 3  # ticks that are no stall any more
_SHARED = "this controller is in a tick already: two threads share it. Give each its own."


@final
class RealTimeAdmittance:
    """Moves as ``M a = f + K (x_d - x) + D (v_d - v)`` asks, eq. (15) as admittance, one tick at a time.

    A tick is solved exactly over the time that really passed, with force and schedule held over it: irregular and
    late ticks add no energy where the stiffness is constant. (Where it rises, see `certify`.) The schedule is copied
    to a table of rows ``1 / rate`` apart; between its own rows it is what `Schedule.resample` says. A tick takes the
    row nearest to its beginning, and after the end of the schedule the last one, with no velocity.

    Where damping shares the axes of stiffness in every row, as ``2 zeta sqrt(m K)`` does, each axis is solved in
    closed form with Python floats, in microseconds. Otherwise a tick takes a matrix exponential by NumPy, some
    0.1 ms. Interpolation between turned axes loses the sharing: sample the schedule at ``rate``. The table of a
    minute at 1 kHz takes 10 MB for d = 2; ticks keep no memory.

    Parameters
    ----------
    schedule : Schedule
        ``position`` and ``velocity`` (n, d), ``stiffness`` and ``damping`` (n, d, d) at ``time`` (n,), in s.
    mass : float, default=None
        Virtual mass in kg, the same in all directions; None takes the schedule's ``mass``, or 1 kg if it has none.
    rate : float, default=1000.0
        Rows of the table in 1/s: the rate of the loop.
    max_step : float, default=0.01
        Longest tick in s; over a longer one the motion is held, while the schedule goes on.
    force_limit : float, default=200.0
        Range of the sensor, in N, as the length of the vector.
    deadband : float, default=0.0
        Forces up to it on an axis, in N, count as none, and larger ones by so much less: what is left of a sensor's
        drift and noise does not move the robot.
    spring_limit : float, default=None
        Most that the spring ``K (x_d - x)`` may pull at the start of a tick, in N; None takes ``force_limit``.
        Farther off, K is scaled by ``spring_limit / sqrt(k_max e'K e)``, e = x_d - x, k_max the largest eigenvalue:
        the force of a potential that is concave in e'K e, and so adds no energy where K is constant.
    velocity_limit, acceleration_limit : float, default=None
        Of the command, in units/s and units/s^2, as lengths of vectors. Where they act, ticks are not exact.
    hold_ticks : int, default=10
        Ticks on end for which the last good force stands in for one that is not finite, before the robot stops.
    stop_deceleration : float, default=5.0
        Of that stop, in units/s^2; never more than ``acceleration_limit``.
    soft_start, approach_speed : float, default=1.0, 0.5
        Time in s in which the desired position moves from the robot's at ``start`` to the schedule's, by minimum jerk;
        longer where it would move away from the schedule faster than this, in units/s. A soft_start of 0 does neither.

    Attributes
    ----------
    position, velocity : tuple of d floats
        The command, in units and units/s.
    faults : TickStatus
        All that was wrong since ``start``.
    schedule_time : float
        How long the schedule has run, in s.
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
    >>> print(controller.tick(0.001, [np.nan]))
    FORCE_INVALID
    >>> for tick in range(2, 2000):
    ...     status = controller.tick(tick / 1000, [5.0])
    >>> [round(value, 4) for value in controller.position]  # 5 N on 100 N/m
    [0.05]
    """

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
        own_mass = getattr(schedule, "mass", None)
        mass = (own_mass or 1.0) if mass is None else mass
        self._mass = number("mass", mass, "kg; it is the same in all directions, matrices are not supported")
        if not 1e-50 <= self._mass <= 1e50:
            raise ValueError(f"mass={mass!r} must be a finite number from 1e-50 to 1e50 kg.")
        if own_mass is not None and self._mass != own_mass:
            warnings.warn(
                f"mass is {mass}, but damping_ratio was met for mass={own_mass:g} kg: give both the same.", stacklevel=2
            )
        self._max_step = number("max_step", max_step, "s")
        if self._max_step * number("rate", rate, "1/s") <= 1.0:
            raise ValueError(f"max_step={max_step} s is no longer than a tick at rate={rate}: raise it, to some ticks.")
        if on_gap not in ("pause", "resume"):
            raise ValueError(f"on_gap={on_gap!r} must be 'pause' or 'resume'.")
        self._max_bad_ticks = whole("max_bad_ticks", max_bad_ticks, 1)
        force_limit = number("force_limit", force_limit, "N")
        self._channel = ForceChannel(
            self._mass,
            force_limit,
            number("deadband", deadband, "N, or 0", zero=True),
            limit("force_rate_limit", force_rate_limit, "N/s"),
            whole("hold_ticks", hold_ticks, 0),
        )
        pull_limit = number("spring_limit", force_limit if spring_limit is None else spring_limit, "N, or None")
        self._pull_limit = pull_limit / self._mass
        soft_start = number("soft_start", soft_start, "s, or 0", zero=True)
        approach_speed = number("approach_speed", approach_speed, "units/s")
        self._table = table = ScheduleTable.of(schedule, self._mass, float(rate))
        self._advance = table.advance
        self._clock = ScheduleClock(table, soft_start, approach_speed, catches_up=on_gap == "resume")
        self._set_limits(velocity_limit, acceleration_limit, stop_deceleration, force_limit + pull_limit)
        self._turn = threading.Lock()
        self._begin(math.nan, self._clock.position_at(0.0), (0.0,) * table.n_axes, 0.0, ())

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
            If an argument is not finite or of another length, or the velocity is beyond ``velocity_limit``.
        RuntimeError
            If another thread is in a tick.
        """
        now, at = moment("now", now), moment("at", at)
        if math.ulp(now) * self._table.rate > _COARSE:
            raise ValueError(f"now={now!r} leaves no digits for ticks of {1 / self._table.rate:g} s: give seconds.")
        if not 0.0 <= at <= self._table.end:
            raise ValueError(f"at={at!r} must be a time in the schedule, from 0 to {self._table.end!r} s.")
        d = self._table.n_axes
        here = vector("position", self._clock.position_at(at) if position is None else position, d)
        moving = vector("velocity", (0.0,) * d if velocity is None else velocity, d)
        if self._is_limited and math.hypot(*moving) > self._speed_limit:
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
            If ``now`` is not a number or ``force`` not d numbers; nothing has changed then.
        RuntimeError
            If ``start`` was not called, or another thread is in a tick.
        """
        if not self._turn.acquire(False):
            raise RuntimeError(_SHARED)
        try:
            return self._tick(now, force)
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
        return self._clock.time_at(self._last)

    def _set_limits(self, speed: float | None, acceleration: float | None, stop: float | None, force: float) -> None:
        """Limits of the command; ``force`` is what sensor and spring may exert together, in N."""
        self._acceleration_limit = limit("acceleration_limit", acceleration, "units/s^2")
        self._speed_limit = limit("velocity_limit", speed, "units/s")
        self._is_limited = min(self._speed_limit, self._acceleration_limit) < math.inf
        deceleration = max(_DECELERATION, self._clock.acceleration) if stop is None else stop
        self._deceleration = min(number("stop_deceleration", deceleration, "units/s^2"), self._acceleration_limit)
        # Velocity answers a force with an impulse response whose absolute values integrate to 2 / damping at most.
        damping = float(np.linalg.eigvalsh(self._table.damping).min()) * self._mass
        answer = 2.0 * force / damping if damping > 0.0 else math.inf
        self._fastest = 1.5 * self._clock.speed + answer if speed is None else self._speed_limit

    def _begin(self, now: float, position: Vector, velocity: Vector, at: float, bias: Vector) -> None:
        self.position, self.velocity, self.faults = position, velocity, _FINE
        self._last = self._newest = now
        self._step = 1.0 / self._table.rate
        self._is_regular, self._is_new, self._is_stopped = False, True, False
        self._n_bad = self._n_late = 0
        self._top_speed = max(self._fastest, math.hypot(*velocity))
        self._scale, self._row = 1.0, self._clock.begin(now, at, position, velocity)
        self._channel.begin(len(position), bias)

    def _tick(self, now: float, force: Numbers) -> TickStatus:
        try:
            now = float(now)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"now={now!r} must be a time in s.") from None
        step = now - self._last
        is_regular = self._is_regular and 0.0 < step <= self._max_step
        status = self._channel.take(force, step if is_regular else self._step)
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

    def _live_irregular(self, now: float) -> TickStatus:
        """After the start, or a tick whose time was wrong, or in one: the last tick may not be what ``now`` follows."""
        if math.isnan(self._last):
            raise RuntimeError("tick before start: call start(now) with the time of the same clock first.")
        if self._is_regular:
            self._is_regular, self._newest = False, self._last
        if not self._newest < now < math.inf:
            self._n_bad += 1
            self._is_stopped = self._is_stopped or self._n_bad >= self._max_bad_ticks
            self._brake(self._last + self._step, self._step, self._deceleration)
            return TickStatus.CLOCK
        if now <= self._last:  # by which bad ticks have lived already, as the clock did not say
            self._clock.shift(self._newest - self._last)
            self._last = self._newest
        step, self._newest, self._n_bad = now - self._last, now, 0
        if step > self._max_step:
            return self._bridge(now, step)
        self._is_regular, self._is_new, self._n_late = True, False, 0
        return self._live(now, step)

    def _bridge(self, now: float, gap: float) -> TickStatus:
        """Begin anew after a gap, of which the robot has seen no command, and must not be thrown to one."""
        speed = max(math.hypot(*self.velocity), self._clock.speed_at(self._last))
        # Within 1 + sqrt(2) times as long as it brakes, it can be back too: it rests where it was told to be last.
        rests = gap * self._deceleration > 3.0 * speed
        self._brake(now, gap, math.inf if rests else self._deceleration)
        self._n_late += 1
        if self._n_late >= _LATE_ON_END:
            self._is_stopped = True
            if self._is_new:
                self.faults |= TickStatus.LATE | TickStatus.STOPPED
                raise ValueError(
                    f"max_step={self._max_step:g} s is shorter than all {_LATE_ON_END} ticks since start, the last of "
                    f"{gap:.4g} s: give a max_step of some ticks of your loop, and times in s."
                )
        return TickStatus.LATE

    def _brake(self, now: float, passed: float, deceleration: float) -> None:
        self._clock.brake(self._last, passed, deceleration)
        self.position, self.velocity = braked(self.position, self.velocity, deceleration, passed)
        self._last = now

    def _live(self, now: float, step: float) -> TickStatus:
        self._step = step
        if self._is_stopped:
            self._brake(now, step, self._deceleration)
            return _FINE
        here, push = (self.position, self.velocity), self._channel.push
        row = self._clock.row(self._last, step)
        if self._clock.boost:
            push = tuple(map(add, push, self._clock.boost))
        position, velocity, self._scale = self._advance(row, push, *here, step, self._pull_limit)
        status = _FINE if self._scale == 1.0 else TickStatus.SPRING_LIMITED
        if self._is_limited or math.hypot(*velocity) > self._top_speed:
            limits = self._top_speed, self._acceleration_limit
            position, velocity, reached = limited(position, velocity, *here, step, *limits)
            status |= reached
        self._row, self.position, self.velocity, self._last = row, position, velocity, now
        return status
