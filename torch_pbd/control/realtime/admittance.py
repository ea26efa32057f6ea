"""The controller inside a robot's 1 kHz loop: measured force in, commanded motion out; no torch, nothing that grows."""

import math
import threading
from operator import add
from typing import Literal, final

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.realtime.clock import SMOOTHING, ScheduleClock, TickTimer
from torch_pbd.control.realtime.limits import FINE, CommandLimits, ForceChannel, TickStatus
from torch_pbd.control.realtime.steps import Numbers, Vector, braked, vector
from torch_pbd.control.realtime.table import ScheduleTable, virtual_mass
from torch_pbd.control.schedule import Schedule

_DECELERATION = 5.0  # units/s^2: from 0.5 m/s to rest in 0.1 s and 25 mm
_SHARED = "this controller is in a tick already: two threads share it. Give each its own."


@final
class RealTimeAdmittance:
    """Robot that moves as ``M a = f + K (x_d - x) + D (v_d - v)``, eq. (15) as admittance, one tick at a time.

    A tick is solved exactly over the time that really passed, with force and schedule held over it: irregular and
    late ticks add no energy where the stiffness is constant. (Where it rises, see `certify`.) The schedule is copied
    to a table of rows ``1 / rate`` apart, as `Schedule.resample` makes them. A tick takes the row nearest to its
    beginning, and after the end the last one, with no velocity. Schedule time comes up to speed and slows down before
    the end, so that desired motion begins as fast as the robot moves and ends at rest, within 1.5 times the schedule's
    own acceleration, or that of a soft start if it is more: also where it does several of these at a time.

    Where damping shares the axes of stiffness in every row, as ``2 zeta sqrt(m K)`` does, a tick takes microseconds,
    else 0.1 ms, for a matrix exponential: interpolation between turned axes loses the sharing, so sample the schedule
    at ``rate``. The table of a minute at 1 kHz takes 10 MB for d = 2; ticks keep no memory.

    Parameters
    ----------
    schedule : Schedule
    mass : float, default=None
        Virtual mass in kg, the same in all directions; None takes the schedule's, or 1 kg. Another one is told.
    rate, max_step : float, default=1000.0, 0.01
        Rate of the loop in 1/s and longest tick in s. Over a longer one the robot has braked, or rests at its last
        command if there was time to be back; after three on end it stops.
    force_limit, deadband : float, default=200.0, 0.0
        Range of the sensor in N, as the length of the vector; and force on an axis, in N, that counts as none and is
        taken off larger ones, against drift and noise.
    spring_limit : float, default=None
        Largest pull of the spring ``K e``, e = x_d - x, in N; None takes ``force_limit``. Beyond it, K is scaled by
        ``spring_limit / sqrt(k_max e'K e)``, k_max its largest eigenvalue: the force of a potential that is concave in
        e'K e, and so adds no energy where K is constant.
    velocity_limit, acceleration_limit : float, default=None
        Largest speed and acceleration of the command, in units/s and units/s^2; where they act, ticks are not exact.
        None is the most that the desired motion and ``force_limit`` can cause where the damping is least.
    hold_ticks, max_bad_ticks : int, default=10
        Ticks on end with a force that is not finite, or a time that is not or does not increase, before the robot
        stops. Until then the median of the last five good forces acts, fading to nothing, or the robot brakes.
    stop_deceleration : float, default=None
        Deceleration of a stop, and where time is wrong, in units/s^2, within ``acceleration_limit``. None is 5, or the
        most that the desired motion takes if that is more.
    soft_start, approach_speed : float, default=1.0, 0.5
        Time in s in which the desired position moves from the robot's at ``start`` to the schedule's, by minimum jerk;
        longer where it would be faster than this, in units/s, or beyond the limit above. At 0 s the schedule begins at
        full speed.
    on_gap : {"pause", "resume"}, default="pause"
        After a tick longer than ``max_step`` the schedule goes on from where it was, or also catches up, within limits
        and not before the end of a soft start.
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
        If a parameter is not as described.

    Examples
    --------
    >>> still, stiffness, damping = [[0.0]] * 2, [[[100.0]]] * 2, [[[20.0]]] * 2
    >>> controller = RealTimeAdmittance(Schedule([0.0, 1.0], still, still, stiffness, damping, damping, [0.0, 0.0]))
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
        schedule: Schedule,
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
        checks.instance(schedule, "schedule", Schedule)
        self._mass = virtual_mass(schedule.mass, mass)
        self._timer = TickTimer(rate, max_step, max_bad_ticks)
        self._channel = ForceChannel(self._mass, force_limit, deadband, force_rate_limit, hold_ticks)
        pull = force_limit if spring_limit is None else spring_limit
        self._pull_limit = checks.number(pull, "spring_limit", above=0.0, unit="N") / self._mass
        self._table = table = ScheduleTable(schedule, self._mass, float(rate))
        self._limits = limits = CommandLimits(velocity_limit, acceleration_limit)
        self._clock = clock = ScheduleClock(table, soft_start, approach_speed, limits.acceleration, on_gap)
        stop = checks.number(stop_deceleration, "stop_deceleration", above=0.0, unit="units/s^2", optional=True)
        self._deceleration = min(stop or max(_DECELERATION, clock.acceleration), limits.acceleration)
        # Impulse responses of velocity to force integrate, in absolute values, to 2 / damping at most, for any mass.
        damping = table.least_damping
        answer = 2.0 * (force_limit + pull) / damping if damping > 0.0 else math.inf
        self._speed_due = clock.speed + answer if velocity_limit is None else limits.speed
        self._turn = threading.Lock()
        self._begin(math.nan, None, (0.0,) * table.n_axes, 0.0, ())

    def __repr__(self) -> str:
        return (
            f"RealTimeAdmittance(n_axes={self._table.n_axes}, mass={self._mass:g} kg, rate={self._table.rate:g} Hz, "
            f"schedule_time={self.schedule_time:.6g}..{self._table.end:.6g} s, faults={self.faults})"
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
            State of the robot, in units and units/s; None is where the schedule is, and at rest.
        at : float, default=0.0
            Time in the schedule to begin at, in s; ``schedule_time`` goes on after a stop.
        force_bias : sequence of d floats, default=None
            Mean reading of the sensor, in N, while nothing touches it, which is taken off every force; None is none.
            A bias of 0.5 N moves a robot of 50 N/m by 10 mm.

        Raises
        ------
        ValueError, RuntimeError
            If an argument is not as described, or the velocity beyond ``velocity_limit``; in a tick of another thread.
        """
        d = self._table.n_axes
        now = checks.number(now, "now", unit="s")
        at = checks.number(at, "at", least=0.0, most=self._table.end, unit="s")
        here = None if position is None else vector(position, "position", d)
        moving = (0.0,) * d if velocity is None else vector(velocity, "velocity", d)
        bias = () if force_bias is None else vector(force_bias, "force_bias", d)
        checks.number(math.hypot(*moving), "the speed", most=self._limits.speed, unit="units/s", remedy="slow it down")
        if not self._turn.acquire(False):
            raise RuntimeError(_SHARED)
        try:
            self._begin(now, here, moving, at, bias)
        finally:
            self._turn.release()

    def tick(self, now: float, force: Numbers) -> TickStatus:
        """Move on to ``now``, and tell the faults, 0 if none; ``position`` and ``velocity`` are then the command.

        Parameters
        ----------
        now : float
            Time of the clock that ``start`` was given, in s.
        force : sequence of d floats
            External force in N as measured now; it acts over the time since the last tick.

        Raises
        ------
        ValueError, RuntimeError
            If ``now`` is not a number or ``force`` not d numbers, or at the third tick on end since ``start`` that
            takes longer than ``max_step``; before ``start``, or in a tick of another thread. Nothing has changed then.
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
        timer, clock, limits = self._timer, self._clock, self._limits
        here, push = (self.position, self.velocity), self._channel.push
        row = clock.row(timer.last, step)
        if clock.boost:
            boosted = tuple(map(add, push, clock.boost))
            state, self._scale = self._table.advance(row, boosted, here, step, self._pull_limit)
            clock.spare(push, here[1], state[1], step)
        else:
            state, self._scale = self._table.advance(row, push, here, step, self._pull_limit)
        status = FINE if self._scale == 1.0 else TickStatus.SPRING_LIMITED
        if limits.is_any or math.hypot(*state[1]) > self._top_speed:
            state, reached = limits.applied(state, here, step, self._top_speed)
            status |= reached
        self._row, (self.position, self.velocity) = row, state
        timer.last = now
        timer.step += SMOOTHING * (step - timer.step)
        return status

    def _live_irregular(self, now: float) -> TickStatus:
        timer = self._timer
        status, shift = timer.read(now)
        self._clock.shift(shift)
        self._is_stopped |= timer.is_failed
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
        self._clock.brake(self._timer.last, passed, deceleration, math.hypot(*self.velocity))
        self.position, self.velocity = braked((self.position, self.velocity), deceleration, passed)
        self._timer.last = now
