"""The controller inside a robot's 1 kHz loop: measured force in, commanded motion out; no torch, nothing that grows."""

import math
import threading
from operator import sub
from typing import final

import numpy as np

from torch_pbd.control.realtime.checks import Numbers, limit, moment, number, vector
from torch_pbd.control.realtime.limits import limited
from torch_pbd.control.realtime.status import TickStatus
from torch_pbd.control.realtime.steps import Floats, Vector, braked, softened
from torch_pbd.control.realtime.table import ScheduleLike, ScheduleTable

_FINE = TickStatus(0)
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
        stop_deceleration: float = 5.0,
        soft_start: float = 1.0,
        approach_speed: float = 0.5,
    ) -> None:
        mass = (getattr(schedule, "mass", None) or 1.0) if mass is None else mass
        self._mass = number("mass", mass, "kg; it is the same in all directions, matrices are not supported")
        if not 1e-50 <= self._mass <= 1e50:
            raise ValueError(f"mass={mass!r} must be a finite number from 1e-50 to 1e50 kg.")
        self._max_step = number("max_step", max_step, "s")
        if self._max_step * number("rate", rate, "1/s") <= 1.0:
            raise ValueError(f"max_step={max_step} s is no longer than a tick at rate={rate}: raise it, to some ticks.")
        self._push_limit = number("force_limit", force_limit, "N") / self._mass
        self._deadband = number("deadband", deadband, "N, or 0", zero=True) / self._mass
        pull_limit = force_limit if spring_limit is None else spring_limit
        self._pull_limit = number("spring_limit", pull_limit, "N, or None") / self._mass
        self._speed_limit = limit("velocity_limit", velocity_limit, "units/s")
        self._acceleration_limit = limit("acceleration_limit", acceleration_limit, "units/s^2")
        self._is_limited = min(self._speed_limit, self._acceleration_limit) < math.inf
        deceleration = number("stop_deceleration", stop_deceleration, "units/s^2")
        self._deceleration = min(deceleration, self._acceleration_limit)
        if isinstance(hold_ticks, bool) or not isinstance(hold_ticks, int | np.integer) or hold_ticks < 0:
            raise ValueError(f"hold_ticks={hold_ticks!r} must be an integer of at least 0: a number of ticks.")
        self._hold_ticks = hold_ticks
        self._soft_start = number("soft_start", soft_start, "s, or 0", zero=True)
        self._approach_speed = number("approach_speed", approach_speed, "units/s")
        self._table = ScheduleTable.of(schedule, self._mass, float(rate))
        table = self._table
        self._packed, self._row_size, self._unpack = table.packed, table.layout.size, table.layout.unpack_from
        self._rate, self._end, self._advance = table.rate, table.last, table.advance
        self._turn = threading.Lock()
        self._bias: Vector = ()
        self._begin(math.nan, self._table.row(0)[: self._table.n_axes], (0.0,) * self._table.n_axes, 0.0)

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
        if at < 0.0:
            raise ValueError(f"at={at!r} must be a time in the schedule, at least 0 s.")
        d = self._table.n_axes
        here = vector("position", self._table.row(self._table.index_at(at))[:d] if position is None else position, d)
        moving = vector("velocity", (0.0,) * d if velocity is None else velocity, d)
        if math.hypot(*moving) > self._speed_limit:
            raise ValueError(f"velocity={moving} is beyond velocity_limit={self._speed_limit}: slow the robot first.")
        bias = () if force_bias is None else vector("force_bias", force_bias, d)
        if not self._turn.acquire(False):
            raise RuntimeError(_SHARED)
        self._begin(now, here, moving, at)
        self._bias = bias
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
        return tuple(self._mass * component for component in self._push)

    @property
    def desired_position(self) -> Vector:  # noqa: D102
        return self._row[: self._table.n_axes]

    @property
    def desired_velocity(self) -> Vector:  # noqa: D102
        return self._row[self._table.n_axes : 2 * self._table.n_axes]

    @property
    def stiffness(self) -> Floats:  # noqa: D102
        return self._scale * self._table.stiffness[self._index]

    @property
    def damping(self) -> Floats:  # noqa: D102
        return self._table.damping[self._index].copy()

    @property
    def schedule_time(self) -> float:  # noqa: D102
        return self._last - self._origin

    def _begin(self, now: float, position: Vector, velocity: Vector, at: float) -> None:
        self.position, self.velocity = position, velocity
        self._last, self._begun, self._origin = now, now, now - at
        self._index, self._scale = self._table.index_at(at), 1.0
        self._row = self._table.row(self._index)
        self._distance = tuple(map(sub, self._row, position))  # stops at the end of position
        # The steepest slope of a minimum jerk is 15/8 of its mean.
        self._blend = max(self._soft_start, 1.875 * math.hypot(*self._distance) / self._approach_speed)
        self._soft_end = now + self._blend if any(self._distance) and self._soft_start else -math.inf
        self._push: Vector = (0.0,) * len(position)
        self._bias = ()
        self._n_lost, self._is_stopped, self.faults = 0, False, _FINE

    def _tick(self, now: float, force: Numbers) -> TickStatus:
        try:
            if self._bias:
                force = [float(component) - bias for component, bias in zip(force, self._bias, strict=True)]
            mass = self._mass
            now, push = float(now), tuple([float(component) / mass for component in force])
        except (TypeError, ValueError, OverflowError):
            push = ()
        if len(push) != len(self.position):
            raise ValueError(f"tick takes a time and {len(self.position)} numbers in N; got {now!r} and {force!r}.")
        if self._deadband:
            push = tuple([part - max(-self._deadband, min(self._deadband, part)) for part in push])
        step, status = now - self._last, _FINE
        if math.hypot(*push) <= self._push_limit:
            self._push, self._n_lost = push, 0
        else:
            status = self._repair_force(push)
        if not 0.0 < step <= self._max_step:
            status |= self._skip(now, step)
        elif self._is_stopped:
            self.position, self.velocity = braked(self.position, self.velocity, self._deceleration, step)
            self._last = now
        else:
            limited = self._move(step)
            status = limited if status is _FINE else status | limited
            self._last = now
        if self._is_stopped:
            status |= TickStatus.STOPPED
        if status is not _FINE:
            self.faults |= status
        return status

    def _repair_force(self, push: Vector) -> TickStatus:
        length = math.hypot(*push)
        if length < math.inf:
            self._push, self._n_lost = tuple(component / length * self._push_limit for component in push), 0
            return TickStatus.FORCE_SATURATED
        self._n_lost += 1
        self._is_stopped = self._is_stopped or self._n_lost > self._hold_ticks
        return TickStatus.FORCE_INVALID

    def _skip(self, now: float, step: float) -> TickStatus:
        if math.isnan(self._last):
            raise RuntimeError("tick before start: call start(now) with the time of the same clock first.")
        if self._max_step < step < math.inf:
            self._last = now
            return TickStatus.LATE
        return TickStatus.CLOCK

    def _move(self, step: float) -> TickStatus:
        here = (self.position, self.velocity)
        index = int((self._last - self._origin) * self._rate + 0.5)  # index_at and row of the table, without calls
        self._index = index = index if index < self._end else self._end
        row = self._unpack(self._packed, index * self._row_size)
        if self._last < self._soft_end:
            row = softened(row, self._distance, (self._last - self._begun) / self._blend, self._blend)
        position, velocity, self._scale = self._advance(row, self._push, *here, step, self._pull_limit)
        status = _FINE if self._scale == 1.0 else TickStatus.SPRING_LIMITED
        if self._is_limited:
            limits = self._speed_limit, self._acceleration_limit
            position, velocity, reached = limited(position, velocity, *here, step, *limits)
            status |= reached
        self._row, self.position, self.velocity = row, position, velocity
        return status
