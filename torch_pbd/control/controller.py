"""The controller as an estimator: demonstrations in, a stiffness schedule out (Section V)."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.impedance import check_parameters, fit_covariance, fit_law, outputs_under
from torch_pbd.control.planning import Planning
from torch_pbd.control.primitive import smoothing
from torch_pbd.control.primitive.dmp import Adaptation, Gate
from torch_pbd.control.primitive.outputs import common_unit, counts_as_metres, in_si
from torch_pbd.control.primitive.reproduction import Reproduction, check_against_duration, primitive
from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.data import Demonstrations, check_unimodal
from torch_pbd.data.alignment import TIMING_REMOVED
from torch_pbd.data.poses import ROTATION
from torch_pbd.data.units import ANGLES, LENGTHS, TIMES
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.estimators.validation import check_groups, check_squares, checked_rows
from torch_pbd.movement.base import MovementRegressor


@dataclass(eq=False, repr=False)
class DMPController(Planning):
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
        How the forcing of an "additive" movement ends, so that it comes to rest at the goal; "none" is the paper's.
    phase_input : {"time", "log_s", "s"}, default="time"
        Input of the regressors: movement time, or the phase s of eq. (17), the paper's, or its logarithm, which is time
        in other units; scripts/benchmarks/phase_input.py compares them.
    variability : {"position", "forcing"}, default="position"
        What becomes stiffness by its covariance: positions, in their units; or the forcing, as in the paper, in units
        of acceleration times s^2.
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
    mass : float or array-like of shape (d, d), default=None
        Virtual mass of the admittance. A number counts in kg, and as many kg m^2 for angles and rotations. None is 1,
        but for the rotation of poses 0.0289 kg m^2, as 1 kg at 0.17 m has it: 1 kg m^2 is a heavy wrist, which lags
        behind soft rotations. A robot's own, which changes along the movement, goes to :meth:`Schedule.with_inertia`.
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
    mass_ : float or ndarray of shape (d, d)
        The virtual mass.
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

    covariance: CovarianceRegressor | MovementRegressor | None = None
    _: KW_ONLY
    alpha: float = 25.0
    beta: float | None = None
    gamma: float = 0.7
    tau: float = 1.0
    adaptation: Adaptation = "safe"
    gate: Gate = "time"
    phase_input: Literal["time", "log_s", "s"] = "time"
    variability: Literal["position", "forcing"] = "position"
    goal: Literal["common", "each"] = "common"
    cutoff: float | Literal["auto"] | None = "auto"
    duration: float | None = None
    n_steps: int = 100
    stiffness_law: StiffnessLaw | None = None
    mass: float | Floats | None = None
    damping_ratio: float | Literal["paper"] = 1.0
    on_unknown: Literal["soft", "prior", "raise"] = "soft"

    def fit(
        self, X: Demonstrations | ArrayLike, y: ArrayLike | None = None, *, groups: ArrayLike | None = None
    ) -> Self:
        """Learn from demonstrations.

        Parameters
        ----------
        X : Demonstrations, or array-like of shape (n_samples, 1)
            Or the times of samples, in s, which increase within each demonstration; for phases, give ``duration``.
        y : array-like of shape (n_samples, n_outputs), default=None
            Positions at these times, in m: arrays have no units and no rotations, which Demonstrations have. What
            ``stack()`` gives of poses would count rad as m; a table whose columns are named so is refused.
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
        check_parameters(self)
        # 1. Recordings. Samples whose times are one are merged; the table of holes is Type I uncertainty.
        shown = smoothing.merge_bursts(as_demonstrations(X, y, groups))
        self.names_, self.frame_, self.units_, self.time_unit_ = shown.names, shown.frame, shown.units, shown.time_unit
        self.n_demos_, self.n_outputs_ = len(shown), shown.n_outputs
        outputs = outputs_under(self, shown)
        self.duration_, self.time_scale_ = smoothing.duration_of(shown, self.duration)
        self.start_time_ = smoothing.common_start(shown)
        seconds = self.time_unit_ in TIMES
        automatic = smoothing.automatic_cutoff(self.duration_, knows_seconds=seconds)
        self.cutoff_ = automatic if self.cutoff == "auto" else self.cutoff
        self.dmp_ = primitive(self)
        check_against_duration(self)
        smoothing.check_steps(self.n_steps, self.n_demos_, self.n_outputs_, learned=True)
        self.unsampled_ = smoothing.tabulate_unsampled(shown, self.duration_ / self.time_scale_, self.on_unknown)
        # 2. Smoothing. Splines at the true times give positions, velocities and accelerations at common times.
        movements = smoothing.smooth(shown.times, shown.positions, self.cutoff_, self.n_steps, self.duration_)
        # 3. Mean movement. Eq. (16) is driven by the mean over demonstrations of the forcing of eq. (18), through which
        # goes a Gaussian process, eq. (5), over the phase of eq. (17) or another input that is a function of time.
        self.reproduction_ = Reproduction.learn(
            self.dmp_, movements, self.phase_input, own_goals=self.goal == "each", blocks=outputs.blocks
        )
        self.start_, self.goal_ = self.reproduction_.start, self.reproduction_.goal
        self.reproduction_error_ = self.reproduction_.check_against(movements)
        if seconds and counts_as_metres(outputs.units(self.units_)):
            self.reproduction_.warn_if_cut(in_si(outputs.units(self.units_)))
        # 4. Variability. The regressor learns the covariance over the same input, of positions or of the forcing; of
        # poses along axes of each block that its covariances have in common.
        varying, phase = self.varying(movements), self.reproduction_.phase
        self.outputs_ = outputs.with_axes(varying, movements.known)
        self.covariance_ = fit_covariance(
            self.covariance, phase(movements.time), varying, movements.known, self.outputs_
        )
        # White noise as large as what the smoothing took away, smoothed: its share of the variance is no variability.
        self.noise_scale_ = movements.noise_scale
        noise = smoothing.white_noise(shown.n_steps, self.noise_scale_)
        smoothed = smoothing.smooth(shown.times, noise, self.cutoff_, self.n_steps, self.duration_, noise=True)
        self.noise_share_ = smoothing.variance_share(self.varying(smoothed), varying)
        # 5. Gains. The bounds of eq. (20) are quantiles of the deviations where there are samples; eq. (19) then gives
        # each principal axis its stiffness, and the damping follows from stiffness and mass.
        self.law_ = fit_law(self, varying)
        return self

    def smooth(self, demonstrations: Demonstrations, n_steps: int | None = None) -> smoothing.Movements:
        """Demonstrations of this task as the controller sees them, smoothed and stretched to ``duration_``."""
        check_is_fitted(self)
        checks.instance(demonstrations, "demonstrations", Demonstrations)
        if demonstrations.n_outputs != self.n_outputs_:
            raise ValueError(f"n_outputs of demonstrations is {demonstrations.n_outputs}, must be {self.n_outputs_}.")
        n_steps = self.n_steps if n_steps is None else checks.count(n_steps, "n_steps", least=2)
        smoothing.check_steps(n_steps, len(demonstrations), self.n_outputs_, learned=False)
        shown = smoothing.merge_bursts(demonstrations)
        return smoothing.smooth(shown.times, shown.positions, self.cutoff_, n_steps, self.duration_)

    def varying(self, movements: smoothing.Movements) -> Floats:
        """Positions or forcings (K, n, d) of smoothed movements of the same task, by ``variability``."""
        checks.instance(movements, "movements", smoothing.Movements, remedy="give what smooth(demonstrations) returns")
        return movements.position if self.variability == "position" else self.reproduction_.forcing_of(movements)

    def __sklearn_is_fitted__(self) -> bool:
        return "law_" in vars(self)


def as_demonstrations(X: Demonstrations | ArrayLike, y: ArrayLike | None, groups: ArrayLike | None) -> Demonstrations:
    """Two demonstrations or more: as they are, or of samples X (n, 1), y (n, d) whose groups (n,) tell them apart.

    Warns of more than one way, of units that stiffness cannot have, and of timing that was taken out by warping.
    """
    if isinstance(X, Demonstrations) and not (y is None and groups is None):
        raise ValueError("X is Demonstrations, which have their positions: give neither y nor groups with them.")
    demonstrations = X if isinstance(X, Demonstrations) else _grouped(X, y, groups)
    if len(demonstrations) < 2:
        raise ValueError(
            "DMPController needs >= 2 demonstrations, got 1: what varies between demonstrations cannot be learned "
            "from one. Record more, or give groups that tell the samples of several apart."
        )
    if demonstrations.suspects:
        raise ValueError(f"A controller cannot be learned of these outputs. {' '.join(demonstrations.suspects)}")
    if demonstrations.rotation_reference is not None and demonstrations.n_outputs == 3:
        raise ValueError(
            f"The demonstrations have a rotation alone, {', '.join(demonstrations.names)}, must have positions beside "
            "it: record them too."
        )
    check_unimodal(demonstrations)
    if isinstance(X, Demonstrations):  # arrays have no units: they are in m and s
        _warn_of_units(X.units if X.units is None or X.rotation_reference is None else X.units[:-3])
    if demonstrations.alignment == "dtw":
        checks.warn(TIMING_REMOVED)
    return demonstrations


def _warn_of_units(units: Sequence[str] | None) -> None:
    """Warn of what becomes of positions whose units are not given, differ, or are no lengths and no angles."""
    common = common_unit(units)
    if units is None:
        checks.warn(
            "The demonstrations tell no units: positions are taken to be in m. Say so, or in what else: units='m'."
        )
    elif common is None:
        checks.warn(
            f"The outputs are in different units, {', '.join(units)}: their principal axes mix them, and nothing is "
            "converted to m. Bring them to one unit, or control them apart."
        )
    elif common not in LENGTHS | ANGLES:
        checks.warn(
            f"The positions are in {common!r}, which is no known length or angle ({', '.join(LENGTHS | ANGLES)}): "
            "stiffness is in N per that unit, and no limits of motion apply."
        )


def _grouped(X: ArrayLike, y: ArrayLike | None, groups: ArrayLike | None) -> Demonstrations:
    if y is None:
        raise ValueError("y is None: give Demonstrations, or times X (n, 1), positions y (n, d) and groups (n,).")
    times, positions = checked_rows(BaseEstimator(), X, y)
    check_squares(times, "X")
    check_squares(positions, "y")
    if times.shape[1] != 1:
        raise ValueError(f"X has {times.shape[1]} columns, must have 1: the time of each sample.")
    labels = np.zeros(len(times), dtype=int) if groups is None else check_groups(groups, len(times))
    if groups is None and (back := np.diff(times[:, 0]) <= 0.0).any():
        raise ValueError(
            f"X does not increase at row {int(np.argmax(back)) + 1}: if another demonstration starts there, give "
            "groups, the number of the demonstration of each row."
        )
    names = [str(name) for name in y.columns] if hasattr(y, "columns") else None
    if set(ROTATION) <= set(names or ()):
        raise ValueError(
            f"y has columns {', '.join(ROTATION)}, as rotations of poses are called, which would count in m: give "
            "Demonstrations."
        )
    members = [labels == label for label in dict.fromkeys(labels.tolist())]
    return Demonstrations([times[m, 0] for m in members], [positions[m] for m in members], names=names)
