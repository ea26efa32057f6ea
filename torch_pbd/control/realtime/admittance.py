"""Controller for a robot's 1 kHz loop, from measured force to commanded motion, without torch, in constant memory."""

import math
import threading
from typing import Literal, final

import numpy as np
from numpy.typing import ArrayLike

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.filters import StiffnessFilter
from torch_pbd.control.realtime.clock import ScheduleClock
from torch_pbd.control.realtime.limits import (
    ForceChannel,
    Numbers,
    Option,
    TickStatus,
    finite_floats,
    options_of_blocks,
)
from torch_pbd.control.realtime.motion import Motion
from torch_pbd.control.realtime.steps import Vector
from torch_pbd.control.realtime.table import ScheduleTable
from torch_pbd.control.schedule import Schedule

_FINE = TickStatus(0)  # made once: to make one takes a third of a tick
_SHARED = "this controller is in a tick already: two threads share it. Give each its own."


@final
class RealTimeAdmittance:
    """Admittance ``M a = f + K (x_d - x) + D (v_d - v)``, eq. (15), computed one tick at a time.

    A tick is solved exactly over the time that really passed, with force and schedule held over it: irregular and
    late ticks add no energy where the gains are constant. (Where they change, see `certify`.) The schedule is copied
    to a table of rows ``1 / rate`` apart, as by `Schedule.resample`. A tick takes the row nearest to its beginning, and
    after the end the last one, with zero velocity. Schedule time accelerates at the start and slows down before the
    end, so that the desired motion begins at the robot's velocity and ends at rest, within 1.5 times the schedule's own
    acceleration, or that of a soft start if larger, even where these coincide.

    For poses the deviation ``x - x_d`` ends with the rotation vector Log(R R_d'), v with the angular velocity, and f is
    a wrench, all in world axes. A spring of unequal rotational stiffness is a potential only to second order in that
    vector, and ticks are exact to first order. Limits are then pairs for positions and rotations, in N and Nm or in m/s
    and rad/s: ``force_limit=(50.0, 5.0)``. Braking and catching up treat linear and angular speeds in the ratio of the
    two approach speeds as equal; both stop together.

    Where damping shares the modes of stiffness and mass in every row, as after `Schedule.with_inertia`, a tick takes
    microseconds, otherwise 0.1 ms for a matrix exponential. Interpolation between rows loses the shared modes, so
    resample the schedule at ``rate`` before `Schedule.with_inertia`. The table of a minute at 1 kHz takes 10 MB for
    d = 2 and 100 MB for poses; ticks allocate no lasting memory. ``schedule.acceleration`` is not fed forward.

    Parameters
    ----------
    schedule : Schedule
    mass : float or array_like of shape (d, d), default=None
        Virtual mass in kg, for poses also kg m and kg m^2; None takes the schedule's, row by row, or 1 kg. A mass other
        than the schedule's raises a warning.
    rate, max_step : float, default=1000.0, 0.01
        Rate of the loop in Hz and longest tick in s. Over a longer tick the robot brakes, or rests at its last command
        if there was time to return to it; after three it stops, unless ten good ticks for each made up for them.
    force_limit, deadband : float or (float, float), default=None
        Largest norm of the force, the range of the sensor; and soft threshold of the force per axis, against drift and
        noise. None is 200 N and 20 Nm, and no deadband.
    spring_limit : float or (float, float), default=None
        Largest force of the spring ``K e``, e = x_d - x; None takes ``force_limit``. Beyond it, K is scaled by
        ``spring_limit / sqrt(k_max e'K e)``, k_max its largest eigenvalue: the force of a potential that is concave in
        e'K e, and so adds no energy where K is constant, whatever the mass. For poses each spring is scaled by itself,
        or both by the smaller scale where K couples them.
    velocity_limit, acceleration_limit : float or (float, float), default=None
        Largest speed and acceleration of the command; where they act, ticks are not exact. None is the most that the
        desired motion and ``force_limit`` can cause where the damping is smallest.
    hold_ticks, max_bad_ticks : int, default=10
        Consecutive ticks with a non-finite force, or ticks with an invalid time (ten good ones make up for one), before
        the robot stops. Until then the median of the last five good forces acts, fading to zero, or the robot brakes.
    stop_deceleration : float or (float, float), default=None
        Deceleration of a stop and at invalid times, within ``acceleration_limit``. None is 5 units/s^2 and 10 rad/s^2,
        or the largest acceleration of the desired motion if that is more.
    soft_start : float, default=1.0
        Time in s in which the desired pose moves from the robot's at ``start`` to the schedule's, by minimum jerk and
        about one axis; longer where a limit requires it. At 0 s the schedule begins at full speed.
    approach_speed : float or (float, float), default=None
        Largest speed of the soft start; None is 0.5 units/s and 1 rad/s.
    on_gap : {"pause", "resume"}, default="pause"
        After a tick longer than ``max_step`` the schedule continues from where it was, or with "resume" also catches
        up, within limits and not before the end of a soft start.
    force_rate_limit : float or (float, float), default=None
        Largest rate of change of the force, per s; it attenuates sensor spikes and delays the response to contact.
    stiffness_filter : EnergyTank or RateLimit, default=None
        Filter that holds back stiffness changes that would feed energy into the robot. The k_max of ``spring_limit`` is
        then that of all rows. The proof of `RateLimit` covers unscaled springs of one mass, and no poses.

    Attributes
    ----------
    faults : TickStatus
        All faults since ``start``.

    Raises
    ------
    ValueError
        If a parameter is invalid.

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

    def __init__(
        self,
        schedule: Schedule,
        *,
        mass: ArrayLike | None = None,
        rate: float = 1000.0,
        max_step: float = 0.01,
        force_limit: Option = None,
        deadband: Option = None,
        spring_limit: Option = None,
        velocity_limit: Option = None,
        acceleration_limit: Option = None,
        hold_ticks: int = 10,
        stop_deceleration: Option = None,
        soft_start: float = 1.0,
        approach_speed: Option = None,
        on_gap: Literal["pause", "resume"] = "pause",
        max_bad_ticks: int = 10,
        force_rate_limit: Option = None,
        stiffness_filter: StiffnessFilter | None = None,
    ) -> None:
        checks.instance(schedule, "schedule", Schedule)
        given = {"force_limit": force_limit, "spring_limit": spring_limit, "deadband": deadband}
        given |= {"force_rate_limit": force_rate_limit, "velocity_limit": velocity_limit}
        given |= {"acceleration_limit": acceleration_limit, "approach_speed": approach_speed}
        options = options_of_blocks(given | {"stop_deceleration": stop_deceleration}, len(schedule.blocks))
        rate = checks.number(rate, "rate", above=0.0, unit="1/s")
        self._channel = ForceChannel(options, schedule.blocks, hold_ticks)
        self._table = ScheduleTable(schedule, mass, rate, options["spring_limit"], steady=stiffness_filter is not None)
        self._clock = ScheduleClock(self._table, options, soft_start, on_gap)
        self._motion = Motion(self._table, self._clock, options, stiffness_filter, max_step, max_bad_ticks)
        self._is_pose, self._turn = len(self._table.blocks) == 2, threading.Lock()
        self.start(0.0)
        self._motion.last = math.nan  # the robot's own start is still to come

    def __repr__(self) -> str:
        one = self._table.one_mass
        mass = str(self._table.mass.shape[1:]) if one is None else f"{one:g} kg"
        return (
            f"RealTimeAdmittance(n_axes={self._table.n_axes}, mass={mass}, rate={self._table.rate:g} Hz, "
            f"schedule_time={self.schedule_time:.6g}..{self._table.end:.6g} s, faults={self.faults})"
        )

    def start(
        self,
        now: float,
        position: Numbers | None = None,
        velocity: Numbers | None = None,
        *,
        orientation: Numbers | None = None,
        at: float = 0.0,
        force_bias: Numbers | None = None,
    ) -> None:
        """Start or restart the controller, clearing faults, forces and motion.

        Parameters
        ----------
        now : float
            Time of a monotonic clock, in s, from which ticks count.
        position, velocity : sequence of p and d floats, default=None
            State of the robot, in units and units/s; None is the schedule's position, at rest.
        orientation : sequence of 4 floats, default=None
            Unit quaternion w x y z of the robot; None is that of the schedule.
        at : float, default=0.0
            Start time in the schedule in s; pass ``schedule_time`` to continue after a stop.
        force_bias : sequence of d floats, default=None
            Mean sensor reading in N without contact, subtracted from every force; None is zero. A bias of 0.5 N moves
            a robot of 50 N/m by 10 mm.

        Raises
        ------
        ValueError, RuntimeError
            If an argument is invalid, the velocity exceeds ``velocity_limit``, or another thread is in a tick.
        """
        bias = finite_floats(force_bias, "force_bias", self._table.n_axes)
        if not self._turn.acquire(False):
            raise RuntimeError(_SHARED)
        try:
            self._motion.begin(now, at, position, orientation, velocity)
            self._channel.begin(bias)
            self.faults = _FINE
        finally:
            self._turn.release()

    def tick(self, now: float, force: Numbers) -> TickStatus:
        """Advance to ``now`` and return the faults, 0 if none; position, orientation and velocity are the command.

        Parameters
        ----------
        now : float
            Time in s of the same clock as in ``start``.
        force : sequence of d floats
            External force in N and torque in Nm measured now; it acts over the time since the last tick.

        Raises
        ------
        ValueError, RuntimeError
            If ``now`` is not a number or ``force`` not d numbers, before ``start``, at the third tick after
            it if all took longer than ``max_step``, or while another thread is in a tick. The state is then unchanged.
        """
        if not self._turn.acquire(False):
            raise RuntimeError(_SHARED)
        try:
            try:
                now = float(now)
            except (TypeError, ValueError, OverflowError):
                raise checks.refusal(now, "now", "a time in s") from None
            channel, motion = self._channel, self._motion
            step = now - motion.last
            is_regular = motion.is_regular and 0.0 < step <= motion.longest
            if not is_regular:
                motion.check_start(now)
            status = channel.take(force, step if is_regular else motion.step)
            motion.is_stopped |= channel.is_lost
            status |= motion.live(now, step, channel.push) if is_regular else motion.live_irregular(now, channel.push)
            if motion.is_stopped:
                status |= TickStatus.STOPPED
            if not status:
                return _FINE
            self.faults |= status
            return TickStatus(status)
        finally:
            self._turn.release()

    @property
    def position(self) -> Vector:
        """Commanded position, p floats in units."""
        return self._motion.place[: self._table.blocks[0].stop]

    @property
    def orientation(self) -> Vector | None:
        """Commanded orientation, a unit quaternion w x y z; None where the schedule has none."""
        return self._motion.place[-4:] if self._is_pose else None

    @property
    def velocity(self) -> Vector:
        """Commanded velocity, d floats in units/s, and for rotations in rad/s and world axes."""
        return self._motion.velocity

    @property
    def force(self) -> Vector:
        """External force f that acted in the last tick, d floats in N."""
        return self._channel.push

    @property
    def desired_position(self) -> Vector:
        """Desired position x_d of the last tick, p floats in units."""
        return self._motion.desired_place[: self._table.blocks[0].stop]

    @property
    def desired_orientation(self) -> Vector | None:
        """Desired orientation R_d of the last tick, a unit quaternion w x y z or None."""
        return self._motion.desired_place[-4:] if self._is_pose else None

    @property
    def desired_velocity(self) -> Vector:
        """Desired velocity v_d of the last tick, d floats in units/s."""
        return self._motion.row[self._table.twist]

    @property
    def stiffness(self) -> Floats:
        """Stiffness K (d, d) of the last tick in N/m, scaled by ``spring_limit``."""
        scales = np.broadcast_to(self._motion.scale, len(self._table.springs))
        return self._table.along_axes(scales.tolist())[:, np.newaxis] * self._motion.gains[0]

    @property
    def damping(self) -> Floats:
        """Damping D (d, d) of the last tick in N s/m."""
        return self._motion.gains[1].copy()

    @property
    def filter_share(self) -> float:
        """Share of the last change of the gains that ``stiffness_filter`` granted, 0 to 1."""
        return float(self._motion.gains[2])

    @property
    def tank_energy(self) -> float | None:
        """Energy in the `EnergyTank` in J; None without one."""
        energy = None if self._motion.filtered is None else self._motion.filtered.active.tank_energy
        return None if energy is None else float(energy)

    @property
    def schedule_time(self) -> float:
        """Time in the schedule, in s."""
        return self._clock.time_at(self._motion.last)
