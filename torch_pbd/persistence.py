"""Save and load fitted estimators: one safetensors file whose header is JSON; nothing in it is ever executed."""

import hashlib
import json
import os
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as to_bytes
from sklearn.utils.validation import check_is_fitted

from torch_pbd.estimators._base import CovarianceRegressor
from torch_pbd.exceptions import ModelFileError
from torch_pbd.files import replacing

FORMAT_VERSION = 1
_CLASSES = {
    "CholeskyCovRegressor": "torch_pbd.estimators.cholesky",
    "WishartProcessRegressor": "torch_pbd.estimators.wishart",
    "GMMBaseline": "torch_pbd.estimators.mixture",
}
_KEY = "torch_pbd"


def save(estimator: CovarianceRegressor, path: str | os.PathLike[str]) -> None:
    """Save a fitted estimator to one file, which is there whole or not at all.

    Parameters
    ----------
    estimator : fitted covariance regressor
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
    state = estimator.__getstate__()
    arrays = {key: np.ascontiguousarray(value) for key, value in state.pop("_module_arrays").items()}
    header = {
        "format_version": FORMAT_VERSION,
        "class": name,
        "params": {key: _encode(value, key) for key, value in estimator.get_params(deep=False).items()},
        "module": state.pop("_module_spec"),
        "fitted": {
            key: _encode(value, key) for key, value in state.items() if key not in estimator.get_params(deep=False)
        },
        "versions": {package: version(package) for package in ("torch", "scikit-learn", "numpy")},
    }
    header["sha256"] = _digest(header, arrays)
    with replacing(Path(path)) as file:
        file.write(to_bytes(arrays, metadata={_KEY: json.dumps(header)}))


def load(path: str | os.PathLike[str]) -> CovarianceRegressor:
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
    if not path.is_file():
        raise FileNotFoundError(f"no model file at {path}")
    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {})[_KEY])
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, KeyError, ValueError, OSError, RecursionError) as error:
        raise ModelFileError(f"{path} is not a model of torch_pbd, or is damaged ({error}).") from error
    if not isinstance(header, dict) or header.get("format_version") != FORMAT_VERSION:
        found = header.get("format_version") if isinstance(header, dict) else None
        raise ModelFileError(f"{path} has format version {found}; this torch_pbd reads {FORMAT_VERSION}. Upgrade it.")
    if header.get("class") not in list(_CLASSES):  # a list asks for no hash
        raise ModelFileError(f"{path} holds a {header.get('class')!r}; known are {', '.join(_CLASSES)}.")
    if header.pop("sha256", None) != _digest(header, arrays):
        raise ModelFileError(f"{path} is damaged: it does not match its checksum.")
    try:
        estimator_class = getattr(import_module(_CLASSES[header["class"]]), header["class"])
        estimator: CovarianceRegressor = estimator_class(**_decode(header["params"]))
        state = {**estimator.__dict__, **_decode(header["fitted"])}
        estimator.__setstate__({**state, "_module_spec": header["module"], "_module_arrays": arrays})
        _try_out(estimator)
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ModelFileError(f"{path} does not describe a whole {header['class']} ({error}).") from error
    return estimator


def _try_out(estimator: CovarianceRegressor) -> None:
    """Raise what a model of parts that do not fit together raises."""
    mean, scale_tril = estimator.module_(estimator._door(np.zeros((1, estimator.n_features_in_))))
    if mean.shape != (1, estimator.n_outputs_) or scale_tril.shape != (*mean.shape, estimator.n_outputs_):
        raise ValueError(f"it is for {estimator.n_outputs_} outputs, its arrays for {mean.shape[-1]}")
    if not isinstance(estimator._y_is_1d, bool):
        raise ValueError("it does not say how y was shaped")


def _digest(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape} ".encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()


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
        return {key: _decode(entry) for key, entry in value.items()}
    return value
