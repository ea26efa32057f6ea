"""The controller as an estimator: demonstrations in, a stiffness schedule out (Section V)."""

from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal, Self, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_is_fitted

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.learning import as_demonstrations, fit_covariance, fit_law, law_for
from torch_pbd.control.matrices import as_damping_ratio, as_mass
from torch_pbd.control.planning import Planning
from torch_pbd.control.primitive import smoothing
from torch_pbd.control.primitive.dmp import Adaptation, Gate
from torch_pbd.control.primitive.outputs import outputs_of
from torch_pbd.control.primitive.reproduction import Reproduction, primitive
from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.data import Demonstrations
from torch_pbd.data.units import TIMES
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.movement.base import MovementRegressor
from torch_pbd.movement.law import check_arrays

_NEEDED = ("get_params", "fit", "predict_cov", "predict_uncertainty")  # methods of a covariance regressor
# Arrays of model files: for each output one number, but for the forcing.
_NOISE, _MOTION = ("noise_scale_", "noise_share_"), ("start", "velocity", "goal", "forcing")


@dataclass(eq=False, repr=False)
class DMPController(Planning):
    """Movement, variability and variable-stiffness gains, learned from demonstrations.

    A dynamic movement primitive, eq. (16) to (18), whose forcing is the mean of a Gaussian process, reproduces the mean
    movement; a covariance regressor learns the variability, whose principal axes determine the stiffness by eq. (19)
    and (20), and with it the damping. Demonstrations may have any durations and sampling times: each is smoothed at its
    true times and stretched linearly, from first to last sample, to the median duration, even one that was cut short.

    Position and rotation of poses (``Demonstrations(rotation=...)``) are learned as one movement in a chart around the
    mean rotation; covariance and gains are those of deviations at the desired pose, in world axes, with blocks in N/m
    and Nm/rad. Results do not depend on quaternion signs, on the world and tool frames, or on units.

    Parameters
    ----------
    covariance : covariance regressor or movement model, default=None
        Model of the variability, cloned before it is fitted; None is ``HeteroscedasticGPRegressor()``. A model of whole
        movements, such as ``TrajectoryRegressor()``, allows bent movements: see :meth:`condition` and :meth:`schedule`.
    alpha, beta, gamma, tau : float, default=25.0, None, 0.7, 1.0
        Parameters of the movement primitive, see :class:`~torch_pbd.control.DMP`; the paper uses 1, 1, 0.7, 1. With
        adaptation="safe" tau is given for a movement of 10 s, like the paper's, and scales with the duration.
    adaptation : {"safe", "additive"}, default="safe"
        Adaptation of the movement to other goals and starts; the paper's "additive" throws the robot.
    gate : {"time", "phase", "none"}, default="time"
        How the forcing of an "additive" movement fades, so that it comes to rest at the goal; "none" is the paper's.
    phase_input : {"time", "log_s", "s"}, default="time"
        Input of the regressors: movement time, the phase s of eq. (17) as in the paper, or its logarithm, which is time
        in other units; scripts/benchmarks/phase_input.py compares them.
    variability : {"position", "forcing"}, default="position"
        Quantity whose covariance determines the stiffness: the position, in its units, or as in the paper the forcing,
        in units of acceleration times s^2.
    goal : {"common", "each"}, default="common"
        Goal in eq. (18): the mean end of all demonstrations, or the end of each.
    cutoff : float, "auto" or None, default="auto"
        Cutoff frequency in Hz, at which amplitudes are halved, of the smoothing before differentiation. "auto" is 40
        cycles per movement, at least 4 Hz; None does not smooth.
    duration : float, default=None
        Duration of the movement in s; None is the median of the demonstrations, of whose phases 1 would count as 1 s.
    n_steps : int, default=100
        Number of points along the movement at which forcing and variability are learned.
    stiffness_law : StiffnessLaw, default=None
        Map from covariance to stiffness. None is ``StiffnessLaw()``: 50 to 1000 N/m (Nm/rad for joint angles) between
        quantiles of the standard deviations along the movement; rotations of poses get ``RotationLimits()``, 2.5 to
        50 Nm/rad.
    mass : float or array-like of shape (d, d), default=None
        Virtual mass of the admittance, in kg, and for angles and rotations in kg m^2. None is 1, but 0.0289 kg m^2 for
        the rotation of poses, that of 1 kg at 0.17 m: 1 kg m^2 is a heavy wrist, which lags behind soft rotations. The
        inertia of a robot, which changes along the movement, goes to :meth:`Schedule.with_inertia`.
    damping_ratio : float or "paper", default=1.0
        Damping ratio of every mode, see :func:`~torch_pbd.control.damping_from_stiffness`.
    on_unknown : {"soft", "prior", "raise"}, default="soft"
        Policy where data are missing, i.e. fewer than two demonstrations have samples near (Type I uncertainty u):
        "soft" moves the stiffness by the share u towards its minimum; "prior" uses the covariance there, the
        regressor's prior; "raise" raises where u exceeds 0.5. Demonstrated variability (Type II) is separate.

    Attributes
    ----------
    covariance_ : fitted covariance regressor
        Regressor from the input ``phase_input`` to the quantity ``variability``; those of poses are in the coordinates
        that ``outputs_.decode`` maps to outputs, see :meth:`predict_cov`.
    dmp_, law_ : DMP, StiffnessLaw
        Movement primitive with the duration, and stiffness law with the bounds, of this movement.
    duration_, start_time_, time_scale_ : float
        Duration in s; common start time of the demonstrations, 0 if they differ; seconds per unit of their time.
    start_, goal_ : ndarray of shape (d,)
    noise_scale_, noise_share_ : ndarray of shape (d,)
        Root mean square of the residual of the smoothing; share of the variance that white noise of that size makes.
    unsampled_ : ndarray of shape (m,)
        Type I uncertainty at evenly spaced times of the movement, from the recording with the second best coverage:
        0 up to 2.5 sample spacings from a sample, 1 from five (at least a 40th of the movement).
    cutoff_, reproduction_error_ : float
        Cutoff in Hz; root mean square distance of the reproduced path (positions) from the mean of the recordings.
    mass_ : float or ndarray of shape (d, d)
        Virtual mass.
    n_outputs_, n_demos_ : int
    outputs_ : Outputs
        Outputs that share a unit, and the chart and axes in which poses are learned.

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
            Demonstrations, or sample times in s that increase within each demonstration; with phases give ``duration``.
        y : array-like of shape (n_samples, n_outputs), default=None
            Positions at these times, in m. Arrays have neither units nor rotations, which Demonstrations do: the
            rotations that ``stack()`` gives for poses would count rad as m; tables with such columns raise an error.
        groups : array-like of shape (n_samples,), default=None
            Label of each sample's demonstration.

        Raises
        ------
        ValueError
            If there are fewer than two demonstrations, one has too few samples, a parameter is invalid, ``n_steps``
            does not fit in memory, or a path leaves the recorded range by more than a tenth of it.

        Warns
        -----
        UserWarning
            If samples at nearly equal times were merged, or recordings have gaps, with their times.
        """
        for name in ("law_", "_shown"):  # a fit that fails leaves no mixture of two
            self.__dict__.pop(name, None)
        self._check_parameters()
        # 1. Recordings. Samples at equal times are merged; the table of gaps is Type I uncertainty.
        shown = smoothing.merge_bursts(as_demonstrations(X, y, groups))
        self.names_, self.frame_, self.units_, self.time_unit_ = shown.names, shown.frame, shown.units, shown.time_unit
        self.n_demos_, self.n_outputs_ = len(shown), shown.n_outputs
        outputs = outputs_of(self.n_outputs_, self.units_, shown.rotation_reference)
        law = law_for(self, outputs)
        self.duration_, self.time_scale_ = smoothing.duration_of(shown, self.duration)
        self.start_time_ = smoothing.common_start(shown)
        seconds = self.time_unit_ in TIMES
        automatic = max(smoothing.CUTOFF_HZ if seconds else 0.0, smoothing.CUTOFF_CYCLES / self.duration_)
        self.cutoff_ = automatic if self.cutoff == "auto" else self.cutoff
        self.dmp_ = primitive(self)
        smoothing.check_steps(self.n_steps, self.n_demos_, self.n_outputs_, learned=True)
        self.unsampled_ = smoothing.tabulate_unsampled(shown, self.duration_ / self.time_scale_, self.on_unknown)
        # 2. Smoothing. Splines at the true times give positions, velocities and accelerations at common times.
        movements = smoothing.smooth(shown.times, shown.positions, self.cutoff_, self.n_steps, self.duration_)
        # 3. Mean movement. Eq. (16) is driven by the mean over demonstrations of the forcing of eq. (18), regressed by
        # a Gaussian process, eq. (5), over the phase of eq. (17) or another input that is a function of time.
        self.reproduction_ = Reproduction.learn(
            movements, self.dmp_, self.phase_input, own_goals=self.goal == "each", blocks=outputs.blocks
        )
        self.start_, self.goal_ = self.reproduction_.start, self.reproduction_.goal
        self.reproduction_error_ = self.reproduction_.check_against(movements)
        if seconds and outputs.in_metres:
            self.reproduction_.warn_if_cut(outputs.si)
        # 4. Variability. The regressor learns the covariance of positions or of the forcing over the same input; for
        # poses, along common axes of each block's covariances.
        varying, phase = self.varying(movements), self.reproduction_.phase
        self.outputs_ = outputs.with_axes(varying, movements.known)
        self.covariance_ = fit_covariance(
            self.covariance, phase(movements.time), varying, movements.known, self.outputs_
        )
        # Share of the variance that white noise as large as the smoothing's residual would make: not variability.
        self.noise_scale_ = movements.noise_scale
        noise = smoothing.smoothed_noise(movements, shown.times, self.cutoff_)
        self.noise_share_ = smoothing.variance_share(self.varying(noise), varying)
        # 5. Gains. The bounds of eq. (20) are quantiles of the standard deviations where there are samples; eq. (19)
        # then gives each principal axis its stiffness, and the damping follows from stiffness and mass.
        self.law_ = fit_law(self, law, varying)
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

    def _check_parameters(self) -> None:
        """Check the parameters, before any work."""
        for name, kind in get_type_hints(type(self)).items():
            if get_origin(kind) is Literal:
                checks.choice(getattr(self, name), name, kind)
        for name, unit in (("alpha", ""), ("gamma", ""), ("tau", "s")):
            checks.number(getattr(self, name), name, above=0.0, unit=unit)
        checks.number(self.beta, "beta", above=0.0, optional=True)
        checks.number(self.duration, "duration", above=0.0, unit="s", optional=True)
        checks.count(self.n_steps, "n_steps", least=5)
        if self.cutoff != "auto":
            checks.number(self.cutoff, "cutoff", above=0.0, unit="Hz", optional=True, remedy="leave it 'auto'")
        regressor = self.covariance
        able = not isinstance(regressor, type) and all(hasattr(regressor, need) for need in _NEEDED)
        if regressor is not None and not able:
            raise checks.refusal(regressor, "covariance", "a covariance regressor, not yet fitted or fitted, or None")
        if (timing := getattr(regressor, "timing", "none")) != "none":
            remedy = "a controller sets the time of its movement itself"
            raise checks.refusal(timing, "timing of covariance", "'none'", remedy)
        checks.instance(self.stiffness_law, "stiffness_law", StiffnessLaw, optional=True)
        mass: Any = 1.0 if self.mass is None else self.mass
        if np.ndim(mass) < 2:
            checks.number(mass, "mass", above=0.0, unit="kg", remedy="or give a matrix (d, d)")
        as_mass(mass)
        as_damping_ratio(self.damping_ratio)

    def _arrays(self) -> dict[str, Floats]:
        """Arrays of the movement for model files, without the regressor's."""
        outputs = self.outputs_
        arrays = {name: getattr(self, name) for name in _NOISE}
        arrays |= {name: getattr(self.reproduction_, name) for name in _MOTION}
        if self.unsampled_.any():  # other files are as those of versions that knew of no holes
            arrays["unsampled_"] = self.unsampled_
        if outputs.reference is not None and outputs.axes is not None:
            arrays |= {"rotation_reference": outputs.reference, "output_axes": outputs.axes}
        return arrays

    def _restore(self, arrays: dict[str, Floats]) -> None:
        """Restore the movement from finite arrays of a model file; what does not fit raises a ValueError."""
        if not hasattr(self, "covariance_"):
            raise ValueError("its covariance is no regressor")
        d, own = self.n_outputs_, {"unsampled_": np.zeros(2), **arrays}
        shapes: dict[str, tuple[int | str, ...]] = dict.fromkeys((*_NOISE, *_MOTION), (d,))
        shapes |= {"forcing": ("m", d), "unsampled_": ("m",)}
        if {"rotation_reference", "output_axes"} & set(own):
            shapes |= {"rotation_reference": (4,), "output_axes": (d, d)}
        check_arrays(own, shapes)
        holes, reference, axes = own["unsampled_"], own.get("rotation_reference"), own.get("output_axes")
        checks.require((holes >= 0.0) & (holes <= 1.0), holes, "unsampled_", "a share from 0 to 1")
        if min(len(own["forcing"]), len(holes)) < 2:
            raise ValueError("forcing and unsampled_ must have a row at the start and one at the end")
        if reference is not None and abs(float(np.linalg.norm(reference)) - 1.0) > 1e-9:
            raise ValueError("its rotation_reference must be a unit quaternion")
        if axes is not None and np.linalg.cond(axes) > 1e12:
            raise ValueError("its output_axes must be independent")
        for name in ("names_", "units_"):
            if (value := getattr(self, name)) is not None:
                if len(value) != d:
                    raise ValueError(f"{name} has {len(value)} entries, must have {d}")
                setattr(self, name, tuple(value))
        self.outputs_ = outputs_of(d, self.units_, reference, axes)
        self.law_.blocks(d)
        for name in (*_NOISE, "unsampled_"):
            setattr(self, name, own[name])
        self.start_, self.goal_, self.dmp_ = own["start"], own["goal"], primitive(self)
        motion = {name: own[name] for name in _MOTION}
        self.reproduction_ = Reproduction(
            self.dmp_, self.phase_input, own_goals=self.goal == "each", blocks=self.outputs_.blocks, **motion
        )
