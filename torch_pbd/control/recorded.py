"""What a controller is fitted to, and what it writes of itself."""

from dataclasses import asdict, is_dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_X_y

from torch_pbd.data import Demonstrations


def as_demonstrations(X: ArrayLike, y: ArrayLike | None, groups: ArrayLike | None) -> Demonstrations:
    """Demonstrations of samples X (n, 1), y (n, d) whose groups (n,) tell them apart.

    Raises
    ------
    ValueError
        If shapes disagree, or times do not increase within a demonstration.
    """
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
    return Demonstrations([times[m, 0] for m in members], [positions[m] for m in members])


def provenance(controller: Any) -> dict[str, Any]:
    """What a schedule came from, as JSON: parameters, the covariance model, bounds, version."""
    return {
        "controller": _plain(controller),
        "covariance": _plain(controller.covariance_),
        "n_demos": controller.n_demos_,
        "cutoff": controller.cutoff_,
        "sigma_low": controller.law_.sigma_low,
        "sigma_high": controller.law_.sigma_high,
        "torch_pbd": version("torch_pbd"),
    }


def _plain(value: Any) -> Any:
    """What JSON can say of a parameter."""
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, BaseEstimator):
        return {type(value).__name__: {k: _plain(v) for k, v in value.get_params(deep=False).items()}}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value if value is None or isinstance(value, bool | int | float | str | list) else repr(value)
