"""The controller inside a robot's 1 kHz loop: measured force in, commanded motion out; no torch, nothing that grows."""

import math
import threading
from typing import Literal, final

from numpy.typing import ArrayLike

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.filters import StiffnessFilter
from torch_pbd.control.realtime import limits
from torch_pbd.control.realtime.clock import ScheduleClock
from torch_pbd.control.realtime.limits import FINE, ForceChannel, Numbers, Option, TickStatus
from torch_pbd.control.realtime.motion import Motion
from torch_pbd.control.realtime.steps import Vector
from torch_pbd.control.realtime.table import ScheduleTable, virtual_mass
from torch_pbd.control.schedule import Schedule

_SHARED = "this controller is in a tick already: two threads share it. Give each its own."


@final
class RealTimeAdmittance:
    """Robot that moves as ``M a = f + K (x_d - x) + D (v_d - v)``, eq. (15) as admittance, one tick at a time.

    A tick is solved exactly over the time that really passed, with force and schedule held over it: irregular and
    late ticks add no energy where the gains are constant. (Where they change, see `certify`.) The schedule is copied
    to a table of rows ``1 / rate`` apart, as `Schedule.resample` makes them. A tick takes the row nearest to its
    beginning, and after the end the last one, with no velocity. Schedule time comes up to speed and slows down before
    the end, so that desired motion begins as fast as the robot moves and ends at rest, within 1.5 times the schedule's
    own acceleration, or that of a soft start if it is more: also where it does several of these at a time.

    On poses the deviation ``x - x_d`` ends with the rotation vector Log(R R_d'), v with the angular velocity, and f is
    a wrench, all in world axes; a spring that is not as stiff about all axes is a potential only to the second order of
    that vector, and ticks are exact to its first. Limits are then pairs, of lengths and of rotations, in N and Nm or in
    m/s and rad/s: ``force_limit=(50.0, 5.0)``. Speeds as far apart as the two approach speeds count as equal where the
    motion is braked or catches up as a whole; the two stop together.

    Where damping shares the modes of stiffness and mass in every row, as that of `Schedule.with_inertia` does, a tick
    takes microseconds, else 0.1 ms, for a matrix exponential: interpolation between rows loses the sharing, so sample
    the schedule at ``rate``, and then tell it the inertia. The table of a minute at 1 kHz takes 10 MB for d = 2, 100 MB
    for poses; ticks keep no memory. Nothing is fed forward: ``schedule.acceleration`` is not used.

    Parameters
    ----------
    schedule : Schedule
    mass : float or array_like of shape (d, d), default=None
        Virtual mass in kg, for poses also kg m and kg m^2; None takes the schedule's, row by row, or 1 kg. Another one
        is told.
    rate, max_step : float, default=1000.0, 0.01
        Rate of the loop in 1/s and longest tick in s. Over a longer one the robot has braked, or rests at its last
        command if there was time to be back; after three on end it stops.
    force_limit, deadband : float or (float, float), default=None
        Range of the sensor, as the length of the vector; and force on an axis that counts as none and is taken off
        larger ones, against drift and noise. None is 200 N and 20 Nm, and no deadband.
    spring_limit : float or (float, float), default=None
        Largest pull of the spring ``K e``, e = x_d - x; None takes ``force_limit``. Beyond it, K is scaled by
        ``spring_limit / sqrt(k_max e'K e)``, k_max its largest eigenvalue: the force of a potential that is concave in
        e'K e, and so adds no energy where K is constant, whatever the mass. On poses each spring by itself, or both by
        the smaller scale where K couples them.
    velocity_limit, acceleration_limit : float or (float, float), default=None
        Largest speed and acceleration of the command; where they act, ticks are not exact. None is the most that the
        desired motion and ``force_limit`` can cause where the damping is least.
    hold_ticks, max_bad_ticks : int, default=10
        Ticks on end with a force that is not finite, or a time that is not or does not increase, before the robot
        stops. Until then the median of the last five good forces acts, fading to nothing, or the robot brakes.
    stop_deceleration : float or (float, float), default=None
        Deceleration of a stop, and where time is wrong, within ``acceleration_limit``. None is 5 units/s2 and
        10 rad/s2, or the most that the desired motion takes if that is more.
    soft_start : float, default=1.0
        Time in s in which the desired place moves from the robot's at ``start`` to the schedule's, by minimum jerk and
        about one axis; longer where it would be beyond a limit. At 0 s the schedule begins at full speed.
    approach_speed : float or (float, float), default=None
        Largest speed of that; None is 0.5 units/s and 1 rad/s.
    on_gap : {"pause", "resume"}, default="pause"
        After a tick longer than ``max_step`` the schedule goes on from where it was, or also catches up, within limits
        and not before the end of a soft start.
    force_rate_limit : float or (float, float), default=None
        Fastest change of the force, per s: a spike of the sensor moves the robot less, and a contact is felt later.
    stiffness_filter : EnergyTank or RateLimit, default=None
        Holds back what would feed energy into the robot. The k_max of ``spring_limit`` is then that of all rows. The
        proof of a `RateLimit` is of springs that no limit scales, of one mass, and not of poses.

    Attributes
    ----------
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
        options = limits.options_of_blocks(given | {"stop_deceleration": stop_deceleration}, len(schedule.blocks))
        self._mass = virtual_mass(schedule, mass)
        rate = checks.number(rate, "rate", above=0.0, unit="1/s")
        self._channel = ForceChannel(options, schedule.blocks, hold_ticks)
        steady = stiffness_filter is not None
        self._table = table = ScheduleTable(schedule, self._mass, rate, options["spring_limit"], steady=steady)
        self._clock = ScheduleClock(table, soft_start, options["approach_speed"], options["acceleration_limit"], on_gap)
        self._motion = Motion(table, self._clock, options, stiffness_filter, max_step, max_bad_ticks)
        self._is_pose, self._speeds, self._turn = len(table.blocks) == 2, options["velocity_limit"], threading.Lock()
        still = (0.0,) * table.n_axes
        self._begin(math.nan, 0.0, (None, None, still), still)

    def __repr__(self) -> str:
        mass = f"{self._mass:g} kg" if isinstance(self._mass, float) else str(self._mass.shape[-2:])
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
        """Begin, or begin again: faults, forces and motion are forgotten.

        Parameters
        ----------
        now : float
            Time of a monotonic clock, in s, from which ticks count.
        position, velocity : sequence of p and d floats, default=None
            State of the robot, in units and units/s; None is where the schedule is, and at rest.
        orientation : sequence of 4 floats, default=None
            Unit quaternion w x y z of the robot; None is that of the schedule.
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
        now = checks.number(now, "now", unit="s")
        at = checks.number(at, "at", least=0.0, most=self._table.end, unit="s")
        state = limits.start_state(position, orientation, velocity, self._table.blocks, self._speeds)
        bias = limits.finite_floats(force_bias, "force_bias", self._table.n_axes)
        if not self._turn.acquire(False):
            raise RuntimeError(_SHARED)
        try:
            self._begin(now, at, state, bias)
        finally:
            self._turn.release()

    def tick(self, now: float, force: Numbers) -> TickStatus:
        """Move on to ``now``, and tell the faults, 0 if none; position, orientation and velocity are then the command.

        Parameters
        ----------
        now : float
            Time of the clock that ``start`` was given, in s.
        force : sequence of d floats
            External force in N, and torque in Nm, as measured now; it acts over the time since the last tick.

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
            channel, motion = self._channel, self._motion
            step = now - motion.last
            is_regular = motion.is_regular and 0.0 < step <= motion.max_step
            status = channel.take(force, step if is_regular else motion.step)
            if status is not FINE:
                motion.is_stopped = motion.is_stopped or channel.is_lost
            push = channel.push
            reached = motion.live(now, step, push) if is_regular else motion.live_irregular(now, push)
            if reached is not FINE:
                status |= reached
            if motion.is_stopped:
                status |= TickStatus.STOPPED
            if status is not FINE:
                self.faults |= status
            return status
        finally:
            self._turn.release()

    @property
    def position(self) -> Vector:
        """Position to command, p floats in units."""
        return self._motion.place[: self._table.blocks[0].stop]

    @property
    def orientation(self) -> Vector | None:
        """Orientation to command, a unit quaternion w x y z; None where the schedule has none."""
        return self._motion.place[-4:] if self._is_pose else None

    @property
    def velocity(self) -> Vector:
        """Velocity to command, d floats in units/s, and of rotations in rad/s and world axes."""
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
        """Desired orientation R_d of the last tick, as ``orientation``."""
        return self._motion.desired_place[-4:] if self._is_pose else None

    @property
    def desired_velocity(self) -> Vector:
        """Desired velocity v_d of the last tick, d floats in units/s."""
        return self._motion.row[self._table.n_place :][: self._table.n_axes]

    @property
    def stiffness(self) -> Floats:
        """Stiffness K (d, d) of the last tick in N/m, as ``spring_limit`` let it be."""
        return self._table.scaled(self._motion.gains[0], self._motion.scale)

    @property
    def damping(self) -> Floats:
        """Damping D (d, d) of the last tick in N s/m."""
        return self._motion.gains[1].copy()

    @property
    def filter_share(self) -> float:
        """Share of the last change of the gains that ``stiffness_filter`` granted, 0 to 1."""
        filtered = self._motion.filtered
        return 1.0 if filtered is None or filtered.active.gains is None else float(filtered.active.gains[2])

    @property
    def tank_energy(self) -> float | None:
        """Energy in the tank of an `EnergyTank` in J; None without."""
        energy = None if self._motion.filtered is None else self._motion.filtered.active.tank_energy
        return None if energy is None else float(energy)

    @property
    def schedule_time(self) -> float:
        """Time in the schedule, in s."""
        return self._clock.time_at(self._motion.last)

    def _begin(self, now: float, at: float, start: limits.StartState, bias: Vector) -> None:
        self._channel.begin(bias)
        self._motion.begin(now, at, *start)
        self.faults = FINE
