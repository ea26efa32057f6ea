"""What the arguments of a controller must be."""

import warnings
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_array, check_X_y

from torch_pbd.control.damping import damping_from_stiffness
from torch_pbd.control.dmp import DMP, Gate
from torch_pbd.control.impedance import OnUnknown
from torch_pbd.control.matrices import check_count, check_finite, check_positive
from torch_pbd.control.sampling import count_intervals
from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.data import Demonstrations, check_unimodal
from torch_pbd.memory import require_memory

Floats = NDArray[np.float64]
PhaseInput = Literal["time", "log_s", "s"]
Variability = Literal["position", "forcing"]
Goals = Literal["common", "each"]

_CHOICES = {"gate": Gate, "phase_input": PhaseInput, "variability": Variability, "on_unknown": OnUnknown, "goal": Goals}


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
            raise ValueError(f"{name} == {getattr(controller, name)!r}, must be one of {listed}.")
    check_count("n_steps", controller.n_steps, 5)
    if controller.cutoff not in ("auto", None):
        check_positive("cutoff", controller.cutoff)
    law = controller.stiffness_law
    if law is not None and not isinstance(law, StiffnessLaw):
        raise ValueError(f"stiffness_law == {law!r}, must be a StiffnessLaw or None.")
    if controller.duration is not None:
        check_positive("duration", controller.duration, "s")
    # What the primitive and the damping say of theirs.
    DMP(controller.alpha, controller.beta, controller.gamma, controller.tau)
    damping_from_stiffness(np.eye(1), controller.mass, controller.damping_ratio)


def as_demonstrations(X: Demonstrations | ArrayLike, y: ArrayLike | None, groups: ArrayLike | None) -> Demonstrations:
    """Two demonstrations or more: as they are, or of samples X (n, 1), y (n, d) whose groups (n,) tell them apart.

    Raises
    ------
    ValueError
        If there is one only, shapes disagree, or times do not increase within a demonstration.

    Warns
    -----
    UnimodalityWarning
        If they follow more than one way.
    UserWarning
        If their outputs are in different units, which no turned axis of stiffness can have.
    """
    demonstrations = X if isinstance(X, Demonstrations) else _grouped(X, y, groups)
    if len(demonstrations) < 2:
        raise ValueError(
            "DMPController needs >= 2 demonstrations, got 1: what varies between demonstrations cannot be learned "
            "from one. Record more, or give groups that tell the samples of several apart."
        )
    check_unimodal(demonstrations)
    units = demonstrations.units
    if units is not None and len(set(units)) > 1:
        warnings.warn(
            f"The outputs are in different units, {', '.join(units)}: their principal axes mix them, and nothing is "
            "converted to m. Bring them to one unit, or control them apart.",
            stacklevel=3,
        )
    return demonstrations


def _grouped(X: ArrayLike, y: ArrayLike | None, groups: ArrayLike | None) -> Demonstrations:
    if y is None:
        raise ValueError("y is None: give Demonstrations, or times X (n, 1), positions y (n, d) and groups (n,).")
    times, positions = check_X_y(X, y, dtype=np.float64, multi_output=True, y_numeric=True)
    if times.shape[1] != 1:
        raise ValueError(f"X has {times.shape[1]} columns, must have 1: the time of each sample.")
    labels = np.zeros(len(times), dtype=int) if groups is None else np.asarray(groups)
    if labels.shape != (len(times),):
        raise ValueError(f"groups has shape {labels.shape}, must have shape ({len(times)},): one for each row of X.")
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
    times = check_array(X, dtype=np.float64, ensure_min_samples=0)
    if times.shape[1] != 1:
        raise ValueError(f"X has {times.shape[1]} features, but DMPController is expecting 1 feature: the time.")
    return np.asarray(times[:, 0])


def count_ticks(duration: float, rate: float, settle: float) -> int:
    """Ticks of a schedule that ends ``settle`` after the movement."""
    check_positive("rate", rate)
    check_finite("settle", settle)
    if settle < 0.0:
        raise ValueError(f"settle == {settle:g}, must not be negative.")
    n_ticks = count_intervals(duration + settle, rate) + 1
    if n_ticks < 2:
        raise ValueError(f"rate == {rate:g} gives {n_ticks} tick in {duration:g}, must give at least 2.")
    return n_ticks


def check_memory(n_ticks: int, d: int) -> None:
    """Refuse a schedule that does not fit in memory: its arrays, and twice as much while they are made."""
    require_memory(
        3 * 8 * n_ticks * (2 + 2 * d + 3 * d * d),
        what=f"a schedule of {n_ticks} ticks of {d} axes",
        remedy="Lower rate, and let the robot interpolate between its rows.",
    )
