"""A fitted controller as plain values and arrays, and back, for model files."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd.control.controller import DMPController
from torch_pbd.control.impedance import Impedance
from torch_pbd.control.parameters import check_parameters
from torch_pbd.control.primitive.reproduction import Phase, Reproduction, primitive
from torch_pbd.control.stiffness import StiffnessLaw

Arrays = dict[str, NDArray[np.float64]]

_PLAIN = (
    "names_", "frame_", "units_", "time_unit_", "n_demos_", "n_outputs_", "cutoff_", "duration_", "start_time_",
    "time_scale_",     "reproduction_error_",
)  # fmt: skip
_ARRAYS = ("noise_scale_", "noise_share_")
_HOLES = "unsampled_"  # where there are any: other files are as those of versions that knew of none
_MOTION = ("start", "velocity", "goal", "forcing")


def controller_state(controller: DMPController) -> tuple[dict[str, Any], Arrays]:
    """What a fit learned, but for the covariance: values that JSON can hold, and arrays."""
    values = {name: getattr(controller, name) for name in _PLAIN} | {"law_": controller.law_}
    arrays = {name: getattr(controller, name) for name in _ARRAYS}
    arrays |= {name: getattr(controller.reproduction_, name) for name in _MOTION}
    if controller.unsampled_.any():
        arrays[_HOLES] = controller.unsampled_
    return values, arrays


def check_controller(controller: DMPController, values: dict[str, Any], arrays: Arrays) -> None:
    """Check that the parts of a fitted controller fit together, but for its regressor.

    Raises
    ------
    ValueError
        If a parameter cannot be used, or an array is missing, unknown, of another shape or not finite.
    """
    check_parameters(controller)
    d = values["n_outputs_"]
    holes = arrays.get(_HOLES, np.zeros(2))
    arrays = {name: array for name, array in arrays.items() if name != _HOLES}
    if holes.dtype != np.float64 or holes.ndim != 1 or len(holes) < 2 or not ((holes >= 0.0) & (holes <= 1.0)).all():
        raise ValueError(f"{_HOLES} is not of shares from 0 to 1")
    if set(arrays) != {*_ARRAYS, *_MOTION}:
        raise ValueError(f"its arrays are {', '.join(arrays)!r:.200}, they must be {', '.join((*_ARRAYS, *_MOTION))}")
    for name, array in arrays.items():
        rows = len(array) if name == "forcing" and array.ndim == 2 else 0
        if array.shape != ((rows, d) if name == "forcing" else (d,)) or (name == "forcing" and rows < 2):
            raise ValueError(f"its parts are not all for {d} outputs: {name} has shape {array.shape}")
        if array.dtype != np.float64 or not np.isfinite(array).all():
            raise ValueError(f"{name} is not of finite numbers in float64")
    for name in ("names_", "units_"):
        if values[name] is not None and len(values[name]) != d:
            raise ValueError(f"{name} has {len(values[name])} entries, it must have {d}")
    if not isinstance(values["law_"], StiffnessLaw) or values["law_"].bounds == "quantile":
        raise ValueError("its stiffness law has no bounds")


def restore_controller(controller: DMPController, covariance: Any, values: dict[str, Any], arrays: Arrays) -> None:
    """Make an unfitted controller the fitted one that :func:`controller_state` told of.

    Raises
    ------
    ValueError
        If a part is missing or does not fit the others.
    """
    check_controller(controller, values, arrays)
    if covariance.n_outputs_ != values["n_outputs_"] or covariance.n_features_in_ != 1:
        raise ValueError(
            f"its parts are not all for {values['n_outputs_']} outputs, or its regressor sees more than time"
        )
    for name in _PLAIN:
        setattr(controller, name, values[name])
    for name in _ARRAYS:
        setattr(controller, name, arrays[name])
    controller.unsampled_ = arrays.get(_HOLES, np.zeros(2))
    controller.names_ = tuple(controller.names_)
    controller.units_ = None if controller.units_ is None else tuple(controller.units_)
    controller.covariance_, controller.dmp_ = covariance, (dmp := primitive(controller))
    time = np.linspace(0.0, controller.duration_, len(arrays["forcing"]))
    motion = {name: arrays[name] for name in _MOTION}
    phase = Phase(dmp, controller.phase_input)
    controller.reproduction_ = Reproduction(dmp, phase, controller.goal == "each", time=time, **motion)
    controller.start_, controller.goal_ = motion["start"], motion["goal"]
    controller.law_ = values["law_"]
    over = (covariance, phase, controller.duration_, controller.unsampled_, controller.law_)
    controller._impedance = Impedance(*over, controller.mass, controller.damping_ratio, controller.on_unknown)
