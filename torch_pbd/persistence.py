"""Save and load fitted estimators: one safetensors file whose header is JSON; nothing in it is ever executed."""

import os
import re
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted

from torch_pbd.control.controller import DMPController
from torch_pbd.control.storage import check_controller, controller_state, restore_controller
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.exceptions import ModelFileError
from torch_pbd.files.atomic import LOADERS
from torch_pbd.files.tensors import read_checksummed, write_checksummed
from torch_pbd.learned import decode_learned, learned_names
from torch_pbd.model_header import (
    decode_law,
    decode_parameters,
    encode,
    encode_law,
    encode_parameters,
    is_ours,
)
from torch_pbd.models.layout import check_layout
from torch_pbd.registry import ESTIMATORS, REGRESSORS

FORMAT_VERSION = 1
_KEY = "torch_pbd"
_PART = "covariance_."  # before the names of the arrays of a controller's regressor
_MODELS = {
    "CholeskyCovRegressor": "cholesky",
    "WishartProcessRegressor": "wishart",
    "HeteroscedasticGPRegressor": "heteroscedastic",
    "GMMBaseline": "mixture",
}
_FOREIGN = re.compile(
    r"\.(pkl|pickle|joblib|skops|pt|pth|ckpt|bin|onnx|np[yz]|h5|hdf5|mat|zip|json|ya?ml|toml|csv|txt|parquet)", re.I
)
# What parts that do not fit together raise.
_UNSOUND = (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError)


def save(estimator: CovarianceRegressor | DMPController, path: str | os.PathLike[str]) -> None:
    """Save a fitted estimator to one file, which is there whole or not at all.

    Parameters
    ----------
    estimator : fitted covariance regressor or DMPController
    path : path-like
        File to write; by custom it ends in ``.safetensors``, never as other formats (``.pkl``, ``.npz``). Its folder
        must exist.

    Raises
    ------
    sklearn.exceptions.NotFittedError
        If the estimator is not fitted.
    TypeError
        If it is not one of this package, has attributes that this package did not give it, or a parameter (a callable
        prior, a random state object) cannot be written as JSON.
    ValueError
        If it is not sound, and could not be loaded again; or if the suffix is another format's.
    """
    if _FOREIGN.fullmatch(Path(path).suffix):
        raise ValueError(f"path={str(path)!r} has the suffix of another format: take .safetensors.")
    if not is_ours(estimator):
        name = type(estimator).__name__
        raise TypeError(f"estimator is a {name}; can save {', '.join(ESTIMATORS)}. In a pipeline, save that step.")
    check_is_fitted(estimator)
    description, arrays = _described(estimator)
    header = {
        "format_version": FORMAT_VERSION,
        **description,
        "versions": {package: version(package) for package in ("torch", "scikit-learn", "numpy")},
    }
    write_checksummed(Path(path), _KEY, header, arrays)


def load(path: str | os.PathLike[str]) -> Any:
    """Load an estimator that :func:`save` wrote: it predicts the same to the last bit.

    One that was fitted on a device which this machine lacks is put on the CPU, with a warning.

    Nothing in the file is executed, and no more is allocated than a small multiple of its size, whoever made it: names
    of classes, parameters, attributes and arrays are looked up in closed tables, and all shapes compared. What
    well-formed numbers say is believed.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ModelFileError
        If it is damaged, of a newer format, or no model of this package.
    """
    path = Path(path)
    try:
        header, arrays = read_checksummed(path, _KEY, FORMAT_VERSION)
    except ModelFileError as error:
        if not _FOREIGN.fullmatch(path.suffix):
            raise
        raise ModelFileError(f"{error} {LOADERS} Pickles are never loaded.") from error
    if header.get("class") not in list(ESTIMATORS):  # a list asks for no hash
        raise ModelFileError(f"{path} holds a {header.get('class')!r:.80}; known are {', '.join(ESTIMATORS)}.")
    try:
        if not isinstance(header.pop("versions", None), dict) or header.pop("format_version") != FORMAT_VERSION:
            raise ValueError("it does not say what wrote it")
        return _restored(header, arrays)
    except _UNSOUND as error:
        brief = f"{error!s:.500}"
        raise ModelFileError(f"{path} does not describe a whole {header['class']} ({brief}).") from error


def _described(estimator: Any) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Class, parameters and what was learned, as JSON; and the arrays. All of it sound."""
    described = _described_controller if isinstance(estimator, DMPController) else _described_regressor
    try:
        return described(estimator)
    except (ArithmeticError, ValueError) as error:
        raise ValueError(f"the {type(estimator).__name__} cannot be saved, as it is not sound: {error}.") from error


def _described_regressor(estimator: CovarianceRegressor) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    name, state = type(estimator).__name__, estimator.__getstate__()
    arrays, spec = state.pop("_module_arrays"), state.pop("_module_spec")
    check_layout(spec, estimator.module_.state_dict())
    learned = {key: value for key, value in state.items() if key not in estimator.get_params(deep=False)}
    strangers = set(learned) - learned_names(name)
    if strangers:
        raise TypeError(
            f"estimator has an attribute {min(strangers)!r}, which a model file cannot hold: delete it, or pickle the "
            "estimator."
        )
    fitted = {key: encode(value, key) for key, value in learned.items()}
    _check_sizes(decode_learned(name, fitted), arrays)
    description = {**encode_parameters(estimator), "module": spec, "fitted": fitted}
    # One number is written as an array of one.
    return description, {key: np.ascontiguousarray(value) for key, value in arrays.items()}


def _described_controller(controller: DMPController) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    values, arrays = controller_state(controller)
    law = values.pop("law_")
    fitted = {key: encode(value, key) for key, value in values.items()}
    check_controller(controller, {**decode_learned("DMPController", fitted), "law_": law}, arrays)
    regressor, parts = _described(controller.covariance_)
    arrays |= {_PART + key: value for key, value in parts.items()}
    fitted["law_"] = encode_law(law)
    return {**encode_parameters(controller), "fitted": fitted, "covariance_": regressor}, arrays


def _restored(description: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """The estimator that :func:`_described` told of."""
    estimator = decode_parameters(description)
    if isinstance(estimator, DMPController):
        _check_entries(description, {"class", "params", "fitted", "covariance_"})
        _restore_controller(estimator, description, arrays)
    else:
        _check_entries(description, {"class", "params", "fitted", "module"})
        _restore_regressor(estimator, description, arrays)
    return estimator


def _restore_controller(controller: Any, description: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    of_regressor, fitted = description["covariance_"], description["fitted"]
    if not isinstance(of_regressor, dict) or of_regressor.get("class") not in list(REGRESSORS):
        raise ValueError("its covariance is no regressor")
    parts = {key.removeprefix(_PART): value for key, value in arrays.items() if key.startswith(_PART)}
    own = {key: value for key, value in arrays.items() if not key.startswith(_PART)}
    regressor = _restored(of_regressor, parts)
    values = decode_learned("DMPController", {key: value for key, value in fitted.items() if key != "law_"})
    restore_controller(controller, regressor, {**values, "law_": decode_law(fitted["law_"])}, own)


def _restore_regressor(estimator: Any, description: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    name, spec = description["class"], description["module"]
    if not isinstance(spec, dict) or spec.get("covariance") != _MODELS[name]:
        raise ValueError("its model is of another class")
    wrong = [key for key, array in arrays.items() if array.dtype != np.float64]
    if wrong:
        raise ValueError(f"{wrong[0]!r:.80} is of {arrays[wrong[0]].dtype}, it must be of float64")
    learned = decode_learned(name, description["fitted"])
    _check_sizes(learned, arrays)
    estimator.__setstate__({**vars(estimator), **learned, "_module_spec": spec, "_module_arrays": arrays})
    _try_out(estimator)


def _check_entries(description: dict[str, Any], names: set[str]) -> None:
    if set(description) != names:
        raise ValueError(f"its header has {', '.join(description)!r:.200}, it must have {', '.join(sorted(names))}")


def _check_sizes(learned: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    """Compare what the attributes say of inputs and outputs with the arrays."""
    n_features, n_outputs = learned["n_features_in_"], learned["n_outputs_"]
    if arrays["x_shift"].shape != (n_features,) or arrays["y_shift"].shape != (n_outputs,):
        raise ValueError(
            f"it is for {n_features} inputs and {n_outputs} outputs, its arrays for {arrays['x_shift'].size} and "
            f"{arrays['y_shift'].size}"
        )
    if learned["_y_is_1d"] and n_outputs != 1:
        raise ValueError(f"it says that y was 1-D, and that there are {n_outputs} outputs")
    if len(learned.get("feature_names_in_", arrays["x_shift"])) != n_features:
        raise ValueError(f"it has not {n_features} names of inputs")
    root = arrays.get("core.covariance.prior_root")
    if root is not None and root.shape[-1] != learned["df_"]:
        raise ValueError(f"df_ is {learned['df_']}, its arrays are for {root.shape[-1]}")


def _try_out(estimator: CovarianceRegressor) -> None:
    """Raise what a model raises, or what can be said of it, that does not predict at the middle of its data."""
    mean, scale_tril = estimator.module_(estimator.module_.x_shift[None])
    sound = mean.isfinite().all() and scale_tril.isfinite().all() and (scale_tril.diagonal(dim1=-2, dim2=-1) > 0).all()
    if not bool(sound):
        raise ValueError("it predicts no mean and positive definite covariance at the middle of its data")
