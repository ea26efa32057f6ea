"""What a schedule says of itself, and of where it came from."""

from dataclasses import asdict, is_dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator

from torch_pbd.control.primitive.units import robot_unit


def schedule_labels(controller: Any) -> dict[str, Any]:
    """Names, units, limits of the schedules of a fitted controller, and what they come from, as JSON can hold it."""
    return {
        "names": controller.names_,
        "units": robot_unit(controller.units_),
        "frame": controller.frame_,
        "stiffness_limits": (controller.law_.stiffness_min, controller.law_.stiffness_max),
        "covariance_of": controller.variability,
        "mass": float(controller.mass),
        "provenance": _provenance(controller),
    }


def _provenance(controller: Any) -> dict[str, Any]:
    """Parameters, the covariance model, bounds, version."""
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
