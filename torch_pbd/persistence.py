"""Save and load fitted estimators: one safetensors file whose header is JSON; nothing in it is ever executed."""

import os
from dataclasses import asdict
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted

from torch_pbd.checksummed import read_checksummed, write_checksummed
from torch_pbd.control.controller import DMPController
from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.control.storage import controller_state, restore_controller
from torch_pbd.estimators._base import CovarianceRegressor
from torch_pbd.exceptions import ModelFileError

FORMAT_VERSION = 1
_CLASSES = {
    "CholeskyCovRegressor": "torch_pbd.estimators.cholesky",
    "WishartProcessRegressor": "torch_pbd.estimators.wishart",
    "HeteroscedasticGPRegressor": "torch_pbd.estimators.heteroscedastic",
    "GMMBaseline": "torch_pbd.estimators.mixture",
    "DMPController": "torch_pbd.control.controller",
}
_PART = "covariance_."  # before the names of the arrays of a controller's regressor
_KEY = "torch_pbd"


def save(estimator: CovarianceRegressor | DMPController, path: str | os.PathLike[str]) -> None:
    """Save a fitted estimator to one file, which is there whole or not at all.

    Parameters
    ----------
    estimator : fitted covariance regressor or DMPController
    path : path-like
        File to write; by custom it ends in ``.safetensors``. Its folder must exist.

    Raises
    ------
    sklearn.exceptions.NotFittedError
        If the estimator is not fitted.
    TypeError
        If it is not one of this package, or a parameter (a callable prior, a random state object) cannot
        be written as JSON.
    """
    name = type(estimator).__name__
    if name not in _CLASSES:
        raise TypeError(f"estimator is a {name}; can save {', '.join(_CLASSES)}. In a pipeline, save that step.")
    check_is_fitted(estimator)
    description, arrays = _described(estimator)
    header = {
        "format_version": FORMAT_VERSION,
        **description,
        "versions": {package: version(package) for package in ("torch", "scikit-learn", "numpy")},
    }
    write_checksummed(Path(path), _KEY, header, arrays)


def _described(estimator: Any) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Class, parameters and what was learned, as JSON; and the arrays."""
    parameters = estimator.get_params(deep=False)
    description: dict[str, Any] = {
        "class": type(estimator).__name__,
        "params": {key: _encode(value, key) for key, value in parameters.items()},
    }
    if isinstance(estimator, DMPController):
        values, arrays = controller_state(estimator)
        regressor, parts = _described(estimator.covariance_)
        learned = {key: _encode(value, key) for key, value in values.items()}
        description |= {"fitted": learned, "covariance_": regressor}
        arrays |= {_PART + key: value for key, value in parts.items()}
    else:
        state = estimator.__getstate__()
        arrays = state.pop("_module_arrays")
        description["module"] = state.pop("_module_spec")
        description["fitted"] = {key: _encode(value, key) for key, value in state.items() if key not in parameters}
    return description, {key: np.ascontiguousarray(value) for key, value in arrays.items()}


def load(path: str | os.PathLike[str]) -> Any:
    """Load an estimator that :func:`save` wrote: it predicts the same to the last bit.

    One that was fitted on a device which this machine lacks is put on the CPU, with a warning.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModelFileError
        If it is damaged, of a newer format, or no model of this package.
    """
    path = Path(path)
    header, arrays = read_checksummed(path, _KEY, FORMAT_VERSION)
    if header.get("class") not in list(_CLASSES):  # a list asks for no hash
        raise ModelFileError(f"{path} holds a {header.get('class')!r}; known are {', '.join(_CLASSES)}.")
    try:
        return _restored(header, arrays)
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ModelFileError(f"{path} does not describe a whole {header['class']} ({error}).") from error


def _restored(description: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Any:
    """The estimator that :func:`_described` told of."""
    estimator = _unfitted(description)
    if isinstance(estimator, DMPController):
        parts = {key.removeprefix(_PART): value for key, value in arrays.items() if key.startswith(_PART)}
        regressor = _restored(description["covariance_"], parts)
        restore_controller(estimator, regressor, _decode(description["fitted"]), arrays)
        return estimator
    state = {**estimator.__dict__, **_decode(description["fitted"])}
    estimator.__setstate__({**state, "_module_spec": description["module"], "_module_arrays": arrays})
    _try_out(estimator)
    return estimator


def _unfitted(description: dict[str, Any]) -> Any:
    name = description["class"]
    return getattr(import_module(_CLASSES[name]), name)(**_decode(description["params"]))


def _try_out(estimator: CovarianceRegressor) -> None:
    """Raise what a model of parts that do not fit together raises."""
    mean, scale_tril = estimator.module_(estimator._door(np.zeros((1, estimator.n_features_in_))))
    if mean.shape != (1, estimator.n_outputs_) or scale_tril.shape != (*mean.shape, estimator.n_outputs_):
        raise ValueError(f"it is for {estimator.n_outputs_} outputs, its arrays for {mean.shape[-1]}")
    if not isinstance(estimator._y_is_1d, bool):
        raise ValueError("it does not say how y was shaped")


def _encode(value: Any, name: str) -> Any:
    """JSON of a value; arrays are marked."""
    if isinstance(value, np.ndarray):
        return {
            "array": _encode(value.tolist(), name),
            "dtype": "object" if value.dtype == object else str(value.dtype),
        }
    if isinstance(value, np.generic):
        return _encode(value.item(), name)
    if isinstance(value, list | tuple):
        return [_encode(entry, name) for entry in value]
    if type(value).__name__ in _CLASSES:
        parameters = value.get_params(deep=False).items()
        return {"class": type(value).__name__, "params": {key: _encode(entry, key) for key, entry in parameters}}
    if isinstance(value, StiffnessLaw):
        return {"stiffness_law": asdict(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(
        f"{name} is a {type(value).__name__}, which a model file cannot hold; pickle the estimator, or fit it with "
        f"{name} given as numbers."
    )


def _decode(value: Any) -> Any:
    if isinstance(value, dict):
        if set(value) == {"array", "dtype"}:
            return np.array(value["array"], dtype=value["dtype"])
        if set(value) == {"class", "params"}:
            return _unfitted(value)
        if set(value) == {"stiffness_law"}:
            return StiffnessLaw(**value["stiffness_law"])
        return {key: _decode(entry) for key, entry in value.items()}
    return value
