"""The controller as an estimator: demonstrations in, a stiffness schedule out (Section V)."""

from collections.abc import Sequence
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control import parameters
from torch_pbd.control.impedance import OnUnknown, fit_covariance, fit_law, gains_at, outputs_under
from torch_pbd.control.primitive import smoothing, units
from torch_pbd.control.primitive.adaptation import Adaptation
from torch_pbd.control.primitive.dmp import Gate
from torch_pbd.control.primitive.reproduction import Reproduction, primitive
from torch_pbd.control.schedule.rows import tick_times
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.simulation.run import simulate_schedule
from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.control.via import Bend, conditioned, planned
from torch_pbd.data import Demonstrations
from torch_pbd.data.units import TIMES
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.movement.base import MovementRegressor

_LIMITS = units.MotionLimits()


class DMPController(BaseEstimator):
    """Learn a movement and its variability from demonstrations, and how stiffly to follow it.

    A dynamic movement primitive, eq. (16) to (18), whose forcing is the mean of a Gaussian process, reproduces the mean
    movement; a covariance regressor learns the variability, whose principal axes get stiffness by eq. (19) and (20),
    and damping from it. Demonstrations may be of any lengths and sampling times: each is smoothed at its true times,
    and stretched linearly, from its first to its last sample, to the median duration: one that was cut short too.

    Of poses (``Demonstrations(rotation=...)``) position and rotation are learned as one movement in a chart around the
    mean rotation; covariance and gains are those of deviations at the desired pose, in axes of the world, and in blocks
    of N/m and Nm/rad. Nothing depends on signs of quaternions, on how the world and the tool are turned, or on units.

    Parameters
    ----------
    covariance : covariance regressor or movement model, default=None
        Cloned before it is fitted; None is ``HeteroscedasticGPRegressor()``. A model of whole movements, such as
        ``TrajectoryRegressor()``, lets movements be bent: see :meth:`condition` and :meth:`schedule`.
    alpha, beta, gamma, tau : float, default=25.0, None, 0.7, 1.0
        Of the movement primitive, see :class:`~torch_pbd.control.DMP`; the paper's are 1, 1, 0.7, 1. With
        adaptation="safe" tau is that of a movement of 10 s, like the paper's, and goes with the duration.
    adaptation : {"safe", "additive"}, default="safe"
        How it moves to other goals, and from other starts; "additive", the paper's, throws the robot.
    gate : {"time", "phase", "none"}, default="time"
        How the forcing ends after an "additive" movement, so that it comes to rest at the goal; "none" is the paper's.
        A "safe" one is over with its duration, see :meth:`schedule`.
    phase_input : {"time", "log_s", "s"}, default="time"
        Input of the regressors: movement time, or the phase s of eq. (17) or its logarithm, which is time in
        other units. "s" is the paper's; scripts/benchmarks/phase_input.py compares them.
    variability : {"position", "forcing"}, default="position"
        Covariance of what becomes stiffness: of positions, in their units; or of the forcing, which the paper
        takes: second derivatives, in units of acceleration times s^2.
    goal : {"common", "each"}, default="common"
        Goal in eq. (18): the mean end of all demonstrations, or that of each.
    cutoff : float, "auto" or None, default="auto"
        Of the smoothing before derivatives are taken, in Hz: amplitudes are halved there. "auto" is 40 cycles a
        movement, and not below 4 Hz; None does not smooth.
    duration : float, default=None
        Of the movement, in s; None is the median of the demonstrations. Needed where their times are phases.
    n_steps : int, default=100
        Points of a movement at which forcing and variability are learned.
    stiffness_law : StiffnessLaw, default=None
        None is ``StiffnessLaw()``: 50 to 1000 N/m between quantiles of the standard deviations along the movement; of
        poses with ``RotationLimits()``, 2.5 to 50 Nm/rad. Of angles the two are in Nm/rad.
    mass : float or array-like of shape (d, d), default=1.0
        Virtual mass of the admittance, kg; of angles, and the rotation of poses, kg m^2. A robot's own, which changes
        along the movement, is what :meth:`Schedule.with_inertia` takes.
    damping_ratio : float or "paper", default=1.0
        See :func:`~torch_pbd.control.damping_from_stiffness`.
    on_unknown : {"soft", "prior", "raise"}, default="soft"
        Where data are missing, fewer than two demonstrations having samples near (Type I uncertainty u): "soft" takes
        the share u of the way to the least stiffness; "prior" trusts the covariance there, the regressor's prior;
        "raise" raises where u is above 0.5. Separate from variability (Type II), which people showed.

    Attributes
    ----------
    covariance_ : fitted covariance regressor
        Its input is what ``phase_input`` says, its output what ``variability`` says; of poses in the coordinates that
        ``outputs_.decode`` takes to outputs, see :meth:`predict_cov`.
    dmp_, law_ : DMP, StiffnessLaw
        With the duration, and the bounds, of this movement.
    duration_, start_time_, time_scale_ : float
        Of the movement, in s; time at which all demonstrations start, 0 where they differ; s in a unit of their time.
    start_, goal_ : ndarray of shape (d,)
    noise_scale_, noise_share_ : ndarray of shape (d,)
        Root mean square of what the smoothing took away; share of the variance that white noise as large would make.
    unsampled_ : ndarray of shape (m,)
        Type I uncertainty of the recordings' times, at evenly spaced times of the movement: 0 up to 2.5 spacings from
        a sample, 1 from five (a 40th of the movement at least), in the recording that knows second most.
    cutoff_, reproduction_error_ : float
        Hz; root mean square distance of the reproduced path from the mean of the demonstrations as recorded, of poses
        that of the positions.
    n_outputs_, n_demos_ : int
    outputs_ : Outputs
        Which outputs share a unit, and the chart and the axes in which those of poses are learned.

    Examples
    --------
    >>> from torch_pbd.data import make_tunnel_demonstrations
    >>> controller = DMPController().fit(make_tunnel_demonstrations(random_state=0))
    >>> controller.schedule(rate=100.0).stiffness.shape
    (1001, 2, 2)
    """

    _bend: Bend | None = None

    def __init__(
        self,
        covariance: CovarianceRegressor | MovementRegressor | None = None,
        *,
        alpha: float = 25.0,
        beta: float | None = None,
        gamma: float = 0.7,
        tau: float = 1.0,
        adaptation: Adaptation = "safe",
        gate: Gate = "time",
        phase_input: parameters.PhaseInput = "time",
        variability: parameters.Variability = "position",
        goal: parameters.Goals = "common",
        cutoff: float | Literal["auto"] | None = "auto",
        duration: float | None = None,
        n_steps: int = 100,
        stiffness_law: StiffnessLaw | None = None,
        mass: float = 1.0,
        damping_ratio: float | Literal["paper"] = 1.0,
        on_unknown: OnUnknown = "soft",
    ) -> None:
        self.covariance = covariance
        self.alpha = alpha
        self.beta = beta
        self.gamma = gamma
        self.tau = tau
        self.adaptation = adaptation
        self.gate = gate
        self.phase_input = phase_input
        self.variability = variability
        self.goal = goal
        self.cutoff = cutoff
        self.duration = duration
        self.n_steps = n_steps
        self.stiffness_law = stiffness_law
        self.mass = mass
        self.damping_ratio = damping_ratio
        self.on_unknown = on_unknown

    def fit(
        self, X: Demonstrations | ArrayLike, y: ArrayLike | None = None, *, groups: ArrayLike | None = None
    ) -> Self:
        """Learn from demonstrations.

        Parameters
        ----------
        X : Demonstrations, or array-like of shape (n_samples, 1)
            Or the times of samples, in s, which increase within each demonstration; for phases, give ``duration``.
        y : array-like of shape (n_samples, n_outputs), default=None
            Positions at these times.
        groups : array-like of shape (n_samples,), default=None
            Demonstration of each sample.

        Raises
        ------
        ValueError
            If there are fewer than two demonstrations, too few samples in one, a parameter cannot be used, there is
            not the memory for ``n_steps``, or a path leaves the recorded range by more than a tenth of it.

        Warns
        -----
        UserWarning
            Of samples that were merged, as their times are too close; of holes, with their times.
        """
        for name in ("law_", "_bend", "_shown"):  # a fit that fails leaves no mixture of two
            self.__dict__.pop(name, None)
        parameters.check_parameters(self)
        # 1. Recordings. Samples whose times are one are merged; the table of holes is Type I uncertainty.
        shown = smoothing.merge_bursts(parameters.as_demonstrations(X, y, groups))
        self.names_, self.frame_, self.units_, self.time_unit_ = shown.names, shown.frame, shown.units, shown.time_unit
        self.n_demos_, self.n_outputs_ = len(shown), shown.n_outputs
        outputs = outputs_under(self, shown)
        self.duration_, self.time_scale_ = units.duration_of(shown, self.duration)
        self.start_time_ = units.common_start(shown)
        seconds = self.time_unit_ in TIMES
        automatic = smoothing.automatic_cutoff(self.duration_, knows_seconds=seconds)
        self.cutoff_ = automatic if self.cutoff == "auto" else self.cutoff
        self.dmp_ = primitive(self)
        parameters.check_against_duration(self)
        parameters.check_steps(self.n_steps, self.n_demos_, self.n_outputs_, learned=True)
        self.unsampled_ = smoothing.tabulate_unsampled(shown, self.duration_ / self.time_scale_, self.on_unknown)
        # 2. Smoothing. Splines at the true times give positions, velocities and accelerations at common times.
        movements = smoothing.smooth(shown, self.cutoff_, self.n_steps, self.duration_)
        # 3. Mean movement. Eq. (16) is driven by the mean over demonstrations of the forcing of eq. (18), through which
        # goes a Gaussian process, eq. (5), over the phase of eq. (17) or another input that is a function of time.
        self.reproduction_ = Reproduction.learn(
            self.dmp_, movements, self.phase_input, own_goals=self.goal == "each", blocks=outputs.blocks
        )
        self.start_, self.goal_ = self.reproduction_.start, self.reproduction_.goal
        self.reproduction_error_, *_ = self.reproduction_.check_against(movements)
        if seconds and units.counts_as_metres(outputs.units(self.units_)):
            self.reproduction_.warn_if_cut(units.in_si(outputs.units(self.units_)))
        # 4. Variability. The regressor learns the covariance over the same input, of positions or of the forcing; of
        # poses along the principal axes of each block.
        varying, phase = self.varying(movements), self.reproduction_.phase
        self.outputs_ = outputs.with_axes(varying, movements.known)
        self.covariance_ = fit_covariance(
            self.covariance, phase(movements.time), varying, movements.known, self.outputs_
        )
        # White noise as large as what the smoothing took away, smoothed: its share of the variance is no variability.
        self.noise_scale_ = movements.noise_scale
        noise = smoothing.noise_like(shown, self.noise_scale_)
        smoothed = smoothing.smooth(noise, self.cutoff_, self.n_steps, self.duration_, noise=True)
        self.noise_share_ = smoothing.variance_share(self.varying(smoothed), varying)
        # 5. Gains. The bounds of eq. (20) are quantiles of the deviations where there are samples; eq. (19) then gives
        # each principal axis its stiffness, and the damping follows from stiffness and mass.
        self.law_ = fit_law(self, varying)
        return self

    def predict(self, X: ArrayLike) -> Floats:
        """Reproduced outputs (n, d) at times X (n, 1), which count as those of the demonstrations do.

        Positions, and of poses three coordinates of a rotation, see :meth:`predict_pose`. From ``start_time_``; the
        movement is over ``duration_`` later, and then stays at the goal.
        """
        return self._path(self._movement_time(X))

    def predict_pose(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """Reproduced positions (n, p) and orientations (n, 4), unit quaternions w x y z, at times X (n, 1).

        Raises
        ------
        ValueError
            If no rotation was demonstrated.
        """
        path = self.predict(X)
        if self.outputs_.reference is None:
            raise ValueError("The demonstrations have no rotation: predict(X) is all of the movement.")
        return self.outputs_.poses(path)

    def predict_cov(self, X: ArrayLike) -> Floats:
        """Covariance (n, d, d) of the outputs at times X (n, 1), in their squared units: of poses in their chart."""
        inputs = self.reproduction_.phase(self._movement_time(X))
        return self.outputs_.covariance(self.covariance_.predict_cov(inputs))

    def condition(self, times: ArrayLike, positions: ArrayLike, *, noise_scale: ArrayLike = 0.0) -> Self:
        """Fitted copy of a movement that passes there: where a robot was pushed to, what was seen so far, a via point.

        The rest of the movement, and its gains, follow as demonstrations make likely. ``covariance`` must be a model of
        whole movements, with variability="position". A copy can be conditioned again.

        Parameters
        ----------
        times : array-like of shape (m,)
            Times, which count as those of the demonstrations do.
        positions : array-like of shape (m, d), or (m, p + 4) for poses
            In their units; NaN where an output is not given. Of poses p positions and a quaternion w x y z, or outputs;
            each of the two is given whole or not at all.
        noise_scale : float or array-like of shape (d,), default=0.0
            Standard deviation of the error of positions; of poses one for all positions and one for the rotation.
        """
        time = self._movement_time(checks.array(times, "times", ("m",))[:, np.newaxis])
        position = self.outputs_.rows(positions, "positions")
        if position.shape != (len(time), self.n_outputs_):
            raise ValueError(f"positions has shape {position.shape}, must have shape ({len(time)}, {self.n_outputs_}).")
        return conditioned(self, time, position - self._path(time), self.outputs_.noise(noise_scale))

    def predict_stiffness(self, X: ArrayLike) -> Floats:
        """Stiffness (n, d, d) at times X (n, 1): in N/m, of angles in Nm/rad, of poses in both and in world axes."""
        time = self._movement_time(X)
        return gains_at(self, time, self._path(time)).stiffness

    def predict_damping(self, X: ArrayLike) -> Floats:
        """Damping (n, d, d) at times X (n, 1), in N s/m or Nm s/rad."""
        time = self._movement_time(X)
        return gains_at(self, time, self._path(time)).damping

    def schedule(
        self,
        rate: float = 1000.0,
        *,
        settle: float = 0.0,
        goal: ArrayLike | None = None,
        start: ArrayLike | None = None,
        via: Sequence[tuple[float, ArrayLike]] | None = None,
        speed: float = 1.0,
        limits: units.MotionLimits | None = _LIMITS,
    ) -> Schedule:
        """Motion and gains at ``rate``, for a robot: in s, m and rad, if the demonstrations tell units.

        It begins at the speed that was shown. Where recordings were cut while moving, a robot at rest needs a ramp.

        Parameters
        ----------
        rate : float, default=1000.0
            In Hz; the last row is at the end, ``duration_ / speed + settle``, and may follow sooner.
        settle : float, default=0.0
            How long to go on after the movement, in s: it then comes to rest at the goal. One that was cut while moving
            brakes on its own path, half before its end and half after. Of what comes after it nothing was shown, so
            that on_unknown="soft" makes the robot compliant there.
        goal, start : array-like of shape (d,), default=None
            In the units of the recordings; None are ``goal_`` and ``start_``. A goal (n, d) is that at each row. Of
            poses, here and in ``via``, p positions and a unit quaternion w x y z, p + 4 numbers; or the p + 3 outputs.
        via : sequence of (time, position), default=None
            Points that the movement passes, with the stiffness of what must be met there: movement time in s from its
            start, and position (d,) in the units of the recordings, NaN where an output is free. ``covariance`` must
            be a model of whole movements: with one, goals and starts too bend the movement as far as demonstrations
            make likely, and the primitive does the rest. A warning tells of points that they make unlikely.
        speed : float, default=1.0
            How fast movement time passes: at 0.5 the movement takes twice as long. Gains are those of movement time.
        limits : MotionLimits or None
            What no robot does, default 600 s, 10 m, 10 m/s; None is no limits. They hold for recordings in units of
            length, and such without units.

        Raises
        ------
        ValueError
            If there are less than two ticks, they do not fit in memory, or the motion is beyond ``limits``.
        """
        check_is_fitted(self)
        speed = checks.number(speed, "speed", above=0.0)
        recorded = self.outputs_.units(self.units_), self.time_unit_
        units.check_motion(limits, *recorded, duration=self.duration_ / speed)
        time = tick_times(self.duration_ / speed, rate, self.n_outputs_, settle=settle)
        bent, goal, start = planned(self, *self._ends(goal, start), via)
        path, velocity, acceleration, moved = bent._motion(time, goal, start, speed)
        unit = units.in_si(recorded[0])
        rows: dict[str, Any] = self.outputs_.motion(path, velocity, acceleration, unit)
        distance = float(np.linalg.norm(np.ptp(rows["position"], axis=0)))
        fastest = float(np.linalg.norm(rows["velocity"][:, : self.outputs_.n_positions], axis=1).max())
        units.check_motion(limits, *recorded, distance=distance, speed=fastest)
        gains, scales = gains_at(bent, moved, path), self.outputs_.scales(unit)
        rows |= gains._asdict() | {"covariance": np.multiply.outer(scales, scales) * gains.covariance}
        return Schedule(time=time, **rows, **parameters.schedule_labels(self))

    def simulate(
        self,
        plant: AdmittancePlant | None = None,
        force: ArrayLike | None = None,
        rate: float = 1000.0,
        *,
        random_state: Any = None,
    ) -> Rollout:
        """Run the schedule on a simulated robot that external forces push.

        Parameters
        ----------
        plant : AdmittancePlant, default=None
            None is ``AdmittancePlant(mass)`` with the mass of this controller; a warning tells of another mass.
        force : array-like of shape (T, d), default=None
            External force in N, one row for each of the schedule's ticks; None is none.
        rate : float, default=1000.0
            Of the ticks, Hz. The last one, which may be later than the end of the movement, follows its last row.
        random_state : int, RandomState or None, default=None
            Of the noise of the plant's sensor.
        """
        schedule = self.schedule(rate)
        return simulate_schedule(schedule, plant, force, rate, random_state)

    def reproduce(
        self,
        rate: float = 1000.0,
        *,
        settle: float = 0.0,
        goal: ArrayLike | None = None,
        start: ArrayLike | None = None,
        speed: ArrayLike | None = None,
    ) -> tuple[Floats, Floats, Floats]:
        """Time (n,), position and velocity (n, d) of the movement to other goals, from other starts, at other speeds.

        Parameters
        ----------
        rate, settle : float
            As for :meth:`schedule`; the ticks are those of the movement at speed 1, or as many as ``speed`` has.
        goal : array-like of shape (d,) or (n, d), default=None
            Goal, at each tick if it changes at run time; None is ``goal_``. A change is followed over the rest of the
            movement, or half its duration if that is longer: the movement then ends later.
        start : array-like of shape (d,), default=None
            None is ``start_``.
        speed : float or array-like of shape (n,), default=None
            How fast movement time passes, at each tick if it changes; it should change smoothly.
        """
        check_is_fitted(self)
        paces = parameters.as_speed(1.0 if speed is None else speed)
        if paces.ndim:
            time = np.arange(len(paces)) / checks.number(rate, "rate", above=0.0, unit="Hz")
        else:
            time = tick_times(self.duration_, rate, self.n_outputs_, settle=settle)
        position, velocity, *_ = self._motion(time, *self._ends(goal, start), paces)
        return time, position, velocity

    def phase(self, time: ArrayLike) -> Floats:
        """Inputs (n, 1) of ``covariance_`` at movement times (n,), which start at 0: what ``phase_input`` says."""
        check_is_fitted(self)
        return self.reproduction_.phase(checks.array(time, "time", ("n",)))

    def smooth(self, demonstrations: Demonstrations, n_steps: int | None = None) -> smoothing.Movements:
        """Demonstrations of this task as the controller sees them, smoothed and stretched to ``duration_``."""
        check_is_fitted(self)
        checks.instance(demonstrations, "demonstrations", Demonstrations)
        if demonstrations.n_outputs != self.n_outputs_:
            raise ValueError(f"n_outputs of demonstrations is {demonstrations.n_outputs}, must be {self.n_outputs_}.")
        n_steps = self.n_steps if n_steps is None else checks.count(n_steps, "n_steps", least=2)
        parameters.check_steps(n_steps, len(demonstrations), self.n_outputs_, learned=False)
        return smoothing.smooth(smoothing.merge_bursts(demonstrations), self.cutoff_, n_steps, self.duration_)

    def varying(self, movements: smoothing.Movements) -> Floats:
        """Positions or forcings (K, n, d) of smoothed movements of the same task, by ``variability``."""
        checks.instance(movements, "movements", smoothing.Movements, remedy="give what smooth(demonstrations) returns")
        return movements.position if self.variability == "position" else self.reproduction_.forcing_of(movements)

    def _path(self, time: Floats) -> Floats:
        """Reproduced position (n, d) at movement times (n,)."""
        position = self.reproduction_.motion(time)[0]
        return position if self._bend is None else position + self._bend(time)

    def _motion(
        self, time: Floats, goal: ArrayLike | None, start: ArrayLike | None, speed: float | Floats
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Outputs, their velocity and acceleration (n, d) at times (n,), and the movement time of the gains there."""
        position, velocity, acceleration, moved = self.reproduction_.plan(time, goal, start, speed)
        if self._bend is not None:
            pace = np.gradient(moved, time)
            rate, slope = pace[:, np.newaxis], np.gradient(pace, time)[:, np.newaxis]
            position, velocity = position + self._bend(moved), velocity + rate * self._bend(moved, 1)
            acceleration = acceleration + rate**2 * self._bend(moved, 2) + slope * self._bend(moved, 1)
        return position, velocity, acceleration, moved

    def _ends(self, goal: ArrayLike | None, start: ArrayLike | None) -> tuple[Floats | None, Floats | None]:
        """Goal and start as outputs."""
        given = {"goal": goal, "start": start}
        own = [None if value is None else self.outputs_.rows(value, name) for name, value in given.items()]
        return own[0], own[1]

    def __sklearn_is_fitted__(self) -> bool:
        return "law_" in vars(self)

    def _movement_time(self, X: ArrayLike) -> Floats:
        check_is_fitted(self)
        return self.time_scale_ * (parameters.as_times(X) - self.start_time_)
