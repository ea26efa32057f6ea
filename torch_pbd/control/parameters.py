"""What the arguments of a controller must be."""

import math
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import issparse
from sklearn.exceptions import NotFittedError
from sklearn.utils.validation import check_array, check_X_y

from torch_pbd import checks
from torch_pbd.control.damping import damping_from_stiffness
from torch_pbd.control.impedance import OnUnknown
from torch_pbd.control.matrices import check_count, check_finite, check_positive
from torch_pbd.control.primitive.adaptation import Adaptation
from torch_pbd.control.primitive.dmp import Gate
from torch_pbd.control.primitive.smoothing import CUTOFF_HZ
from torch_pbd.control.primitive.units import warn_of_units
from torch_pbd.control.schedule.rows import count_rows, row_times
from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.data import Demonstrations, check_unimodal
from torch_pbd.data.alignment import TIMING_REMOVED
from torch_pbd.data.units import TIMES
from torch_pbd.estimators.demonstrations import check_groups
from torch_pbd.estimators.validation import check_squares, checked_values
from torch_pbd.files.memory import require_memory, require_much

Floats = NDArray[np.float64]
PhaseInput = Literal["time", "log_s", "s"]
Variability = Literal["position", "forcing"]
Goals = Literal["common", "each"]

# A movement may have as many cycles of its cutoff; its primitive as many time constants, and be at rest as many
# durations later, and its phase decay as far.
_FEWEST_CYCLES, _MOST_CYCLES = 0.01, 1e6
_FASTEST, _SLOWEST = 1e12, 100.0
_LEAST_DECAY, _MOST_DECAY = 1e-6, {"s": 30.0, "log_s": 1e12}
_MOST_TICKS = 1e12
_BRIEFEST = 1e-100  # s: squares of what is briefer, or of its inverse, are no numbers
# Measured, in numbers: of each of a demonstration's positions while it is smoothed; of each pair of steps while the
# forcing is learned, in all and of each axis where they are many; of each axis at a step, while it is tabulated.
_SMOOTHED, _PAIRED, _PAIRED_AXIS, _TABULATED = 10.0, 34.0, 5.0, 16e3
_NEEDED = ("get_params", "fit", "predict_cov", "predict_uncertainty")

_CHOICES = {
    "gate": Gate, "phase_input": PhaseInput, "variability": Variability, "on_unknown": OnUnknown, "goal": Goals,
    "adaptation": Adaptation,
}  # fmt: skip


def check_parameters(controller: Any) -> None:
    """Check the parameters of a DMPController, before any work.

    Raises
    ------
    ValueError
        If one cannot be used.
    """
    for name, kind in _CHOICES.items():
        if getattr(controller, name) not in get_args(kind):
            listed = ", ".join(map(repr, get_args(kind)))
            raise ValueError(f"{name} is {getattr(controller, name)!r}, must be one of {listed}.")
    check_count("n_steps", controller.n_steps, 5)
    if controller.cutoff not in ("auto", None):
        check_positive("cutoff", controller.cutoff)
    regressor = controller.covariance
    if regressor is not None and (isinstance(regressor, type) or not all(hasattr(regressor, need) for need in _NEEDED)):
        raise ValueError(
            f"covariance is {regressor!r}, must be a covariance regressor, not yet fitted or fitted, or None."
        )
    law = controller.stiffness_law
    if law is not None and not isinstance(law, StiffnessLaw):
        raise ValueError(f"stiffness_law is {law!r}, must be a StiffnessLaw or None.")
    if controller.duration is not None:
        check_positive("duration", controller.duration, "s")
    for name, unit in (("mass", "kg"), ("alpha", ""), ("gamma", ""), ("tau", "s")):
        check_positive(name, getattr(controller, name), unit)
    if controller.beta is not None:
        check_positive("beta", controller.beta)
    ratio = controller.damping_ratio
    if not (isinstance(ratio, str) and ratio == "paper"):
        check_finite("damping_ratio", ratio)
        ratio = float(ratio)
    damping_from_stiffness(np.eye(1), float(controller.mass), ratio)  # what it says of its own


def check_against_duration(controller: Any) -> None:
    """Check the parameters that only the duration of the movement makes too small or too large."""
    duration, tau = controller.duration_, controller.dmp_.tau
    if not _BRIEFEST <= duration <= 1.0 / _BRIEFEST:
        raise ValueError(f"duration is {duration:g}, must be {_BRIEFEST:g} to {1.0 / _BRIEFEST:g} s.")
    cycles = None if controller.cutoff_ is None else controller.cutoff_ * duration
    if cycles is not None and not _FEWEST_CYCLES <= cycles <= _MOST_CYCLES:
        # Where the automatic one too would be out of range, the times are in another unit than they say.
        suspect = controller.cutoff == "auto" or CUTOFF_HZ * duration > _MOST_CYCLES
        units = f"the unit of the times is suspect, time_unit={controller.time_unit_!r} (known: {', '.join(TIMES)})"
        automatic = "leave it 'auto'"
        raise ValueError(
            f"cutoff={controller.cutoff_:g} Hz is {cycles:.3g} cycles in a movement of duration={duration:.3g}, "
            f"must be {_FEWEST_CYCLES:g} to {_MOST_CYCLES:g}: {units if suspect else automatic}."
        )
    alpha, beta, gamma = (float(value) for value in (controller.alpha, controller.beta or 1.0, controller.gamma))
    fastest = max(alpha, math.sqrt(alpha) * math.sqrt(beta)) / tau * duration
    if fastest > _FASTEST:
        raise ValueError(
            f"alpha={alpha:g} and beta={beta:g} with tau={tau:g} are {fastest:.3g} time constants in a "
            f"movement of {duration:.3g} s, must be at most {_FASTEST:g}: lower alpha or raise tau."
        )
    resting = max(2.0 * tau / alpha, tau / gamma if controller.gate == "phase" else 0.0) / duration
    if resting > _SLOWEST:
        raise ValueError(
            f"alpha={alpha:g} and gamma={gamma:g} with tau={tau:g} let the primitive rest only {resting:.3g} "
            f"durations (duration={duration:.3g}) after the movement, must be at most {_SLOWEST:g}: raise alpha, or "
            "lower tau."
        )
    decay = gamma * duration / tau
    if controller.phase_input != "time" and not _LEAST_DECAY <= decay <= _MOST_DECAY[controller.phase_input]:
        raise ValueError(
            f"gamma={gamma:g} with tau={tau:g} takes the phase from 1 to exp(-{decay:.3g}) in a movement of "
            f"{duration:.3g} s, where its times cannot be told apart: take phase_input='time', or another gamma."
        )


def check_task(demonstrations: Any, n_outputs: int | None) -> None:
    """Check that demonstrations are such, of as many outputs as a controller was fitted to."""
    if not isinstance(demonstrations, Demonstrations):
        raise ValueError(f"demonstrations is a {type(demonstrations).__name__}, must be Demonstrations.")
    if n_outputs is None:
        raise NotFittedError("This DMPController is not fitted yet: call fit first.")
    if demonstrations.n_outputs != n_outputs:
        raise ValueError(f"demonstrations have {demonstrations.n_outputs} outputs, must have {n_outputs}, as fitted.")


def as_demonstrations(X: Demonstrations | ArrayLike, y: ArrayLike | None, groups: ArrayLike | None) -> Demonstrations:
    """Two demonstrations or more: as they are, or of samples X (n, 1), y (n, d) whose groups (n,) tell them apart.

    Raises
    ------
    ValueError
        If there is one only, shapes disagree, times do not increase within a demonstration, or outputs are unit
        quaternions or angles that jump by a turn.

    Warns
    -----
    UnimodalityWarning
        If they follow more than one way.
    UserWarning
        If their outputs are in different units, which no turned axis of stiffness can have; in none; or in one that
        is neither a length nor an angle. If their timing was taken out by dynamic time warping.
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
    check_unimodal(demonstrations)
    if isinstance(X, Demonstrations):  # arrays have no units: they are in m and s
        warn_of_units(X.units)
    if demonstrations.alignment == "dtw":
        checks.warn(TIMING_REMOVED)
    return demonstrations


def _grouped(X: ArrayLike, y: ArrayLike | None, groups: ArrayLike | None) -> Demonstrations:
    if y is None:
        raise ValueError("y is None: give Demonstrations, or times X (n, 1), positions y (n, d) and groups (n,).")
    if issparse(y):
        raise TypeError("Sparse data was passed for y, but dense data is required. Use '.toarray()'.")
    times, positions = check_X_y(
        checked_values(X, "X"), checked_values(y, "y"), dtype=np.float64, multi_output=True, y_numeric=True
    )
    check_squares(times, "X")
    check_squares(positions, "y")
    if times.shape[1] != 1:
        raise ValueError(f"X has {times.shape[1]} columns, must have 1: the time of each sample.")
    labels = np.zeros(len(times), dtype=int) if groups is None else check_groups(groups, len(times))
    if groups is None and (np.diff(times[:, 0]) <= 0.0).any():
        row = int(np.argmax(np.diff(times[:, 0]) <= 0.0)) + 1
        raise ValueError(
            f"X does not increase at row {row}: if another demonstration starts there, give groups, the number of the "
            "demonstration of each row."
        )
    members = [labels == label for label in dict.fromkeys(labels.tolist())]
    names = [str(name) for name in y.columns] if hasattr(y, "columns") else None
    return Demonstrations([times[m, 0] for m in members], [positions[m] for m in members], names=names)


def as_times(X: ArrayLike) -> Floats:
    """Times (n,) of a column X (n, 1), which may be empty."""
    times = check_array(checked_values(X, "X"), dtype=np.float64, ensure_min_samples=0)
    if times.shape[1] != 1:
        raise ValueError(f"X has {times.shape[1]} features, but DMPController is expecting 1 feature: the time.")
    return np.asarray(times[:, 0])


def as_movement_times(time: ArrayLike) -> Floats:
    """Movement times (n,), finite."""
    times = checks.real_floats(time, "time")
    if times.ndim != 1 or not np.isfinite(times).all():
        raise ValueError(f"time has shape {times.shape}, must be finite times of shape (n,), in s from the start.")
    return times


def as_places(values: ArrayLike, name: str, d: int, n_ticks: int | None = None) -> Floats:
    """A place (d,), or one for each tick (n, d), finite."""
    places = checks.real_floats(values, name)
    allowed = [(d,)] if n_ticks is None else [(d,), (1, d), (n_ticks, d)]
    if places.shape not in allowed:
        listed = " or ".join(map(str, allowed))
        raise ValueError(f"{name} has shape {places.shape}, must have shape {listed}: one number for each output.")
    if not np.isfinite(places).all():
        raise ValueError(f"{name} has a value that is not finite: {values!r}.")
    return places


def as_speed(values: ArrayLike) -> Floats:
    """How fast movement time passes: a number, or one for each tick (n,); finite, none negative."""
    speed = checks.real_floats(values, "speed")
    if speed.ndim > 1 or not speed.size:
        raise ValueError(f"speed has shape {speed.shape}, must be a number, or (n,): one for each tick.")
    if not np.isfinite(speed).all():
        raise ValueError(f"speed has a value that is not finite: {values!r}.")
    if (speed < 0.0).any():
        raise ValueError(f"speed has a negative value: {values!r}. A movement does not run backwards.")
    return speed


def as_tick_times(duration: float, rate: float, settle: float, d: int, n_ticks: int | None = None) -> Floats:
    """Times (n,) of the rows of a schedule of d outputs that ends ``settle`` after the movement, or of ``n_ticks``."""
    check_positive("rate", rate)
    check_finite("settle", settle)
    if settle < 0.0:
        raise ValueError(f"settle is {settle:g}, must not be negative.")
    if (duration + settle) * rate > _MOST_TICKS:
        raise ValueError(
            f"rate={rate:g} with settle={settle:g} makes {(duration + settle) * rate:.3g} ticks of a movement of "
            f"{duration:g} s, more than {_MOST_TICKS:g}: lower them."
        )
    counted = count_rows(duration + settle, rate)
    if counted < 2:
        raise ValueError(f"rate={rate:g} gives {counted} tick in {duration:g}, must give at least 2.")
    check_memory(counted if n_ticks is None else n_ticks, d)
    return row_times(duration + settle, rate) if n_ticks is None else np.arange(n_ticks) / rate


def check_memory(n_ticks: int, d: int) -> None:
    """Refuse a schedule that does not fit in memory: its arrays, and twice as much while they are made."""
    require_memory(
        3 * 8 * n_ticks * (2 + 2 * d + 3 * d * d),
        what=f"a schedule of {n_ticks} ticks of {d} axes",
        remedy="Lower rate, and let the robot interpolate between its rows.",
    )


def check_steps(n_steps: int, n_demos: int, d: int, *, learned: bool) -> None:
    """Refuse more points of a movement than fit in memory: smoothed ones, and what learning the forcing of them takes.

    Gaussian processes of the forcing have matrices of all pairs of points, unless a few nodes carry it.
    """
    n = float(n_steps)
    needed = _SMOOTHED * n * n_demos * d
    if learned:
        needed += n * (max(_PAIRED, _PAIRED_AXIS * d) * n + _TABULATED * d)
    require_much(
        8.0 * needed,
        what=f"n_steps={n_steps} of {n_demos} demonstrations of {d} axes",
        remedy="Lower n_steps: 100 to 500 follow most movements.",
    )
