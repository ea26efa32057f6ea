"""Save and load fitted estimators: one safetensors file whose header is JSON; nothing in it is ever executed.

A file of format 1 holds an estimator's class, parameters, and what its fit learned ("fitted"). A regressor adds the
``config()`` of its model's core ("module"), and as arrays the model's ``state_dict``; a controller the arrays of its
movement, and under "covariance_" all that of its regressor. A model of movements is written like a controller, with a
regressor of its own, if it has one, under "regressor_".
"""

import hashlib
import json
import os
import re
import struct
import warnings
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load as from_bytes
from safetensors.numpy import save as to_bytes
from sklearn.utils.validation import check_is_fitted

from torch_pbd import checks
from torch_pbd.control.controller import DMPController
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.exceptions import ModelFileError
from torch_pbd.files import LOADERS, Arrays, replacing
from torch_pbd.files.memory import require_memory
from torch_pbd.persistence import plain
from torch_pbd.registry import ESTIMATORS, MOVEMENTS, REGRESSORS

FORMAT_VERSION = 1
_KEY = "torch_pbd"
_PARTS = {"DMPController": "covariance_", **dict.fromkeys(MOVEMENTS, "regressor_")}  # models that others consist of
MAX_HEADER_BYTES = 2**22
"""Longest JSON header that is written or read, about 200 000 numbers: lists in it take up to 20 times the memory."""

_MAX_OUTER_BYTES = 4 * MAX_HEADER_BYTES  # the header of safetensors, in which ours is a string with escapes
_COPIES = 3.0  # the file, the arrays in it, and one array's bytes under the checksum
_FOREIGN = re.compile(
    r"\.(pkl|pickle|joblib|skops|pt|pth|ckpt|bin|onnx|np[yz]|h5|hdf5|mat|zip|json|ya?ml|toml|csv|txt|parquet)", re.I
)


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
    name = type(estimator).__name__
    if not plain.is_ours(estimator):
        raise TypeError(f"estimator is a {name}; can save {', '.join(ESTIMATORS)}. In a pipeline, save that step.")
    check_is_fitted(estimator)
    # What could not be loaded again is not written.
    description, arrays = _described(estimator)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a device that is not here: who loads the file is warned
            _restored(description, arrays)
    except Exception as error:  # parts that do not fit together raise errors of all kinds
        raise ValueError(f"the {name} cannot be saved, as it is not sound: {_brief(error)}.") from error
    versions = {package: version(package) for package in ("torch", "scikit-learn", "numpy")}
    header = {"format_version": FORMAT_VERSION, **description, "versions": versions}
    write_archive(Path(path), header, arrays)


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
        header, arrays = read_archive(path)
    except ModelFileError as error:
        if not _FOREIGN.fullmatch(path.suffix):
            raise
        raise ModelFileError(f"{error} {LOADERS} Pickles are never loaded.") from error
    try:
        if not isinstance(header.pop("versions", None), dict):
            raise ValueError("it does not say what wrote it")
        del header["format_version"]
        return _restored(header, arrays)
    except Exception as error:
        what = f"{header.get('class')!s:.80}"
        remedy = "if an earlier version of torch_pbd wrote it, fit and save it again"
        raise ModelFileError(f"{path} does not describe a whole {what} ({_brief(error)}): {remedy}.") from error


def _brief(error: BaseException) -> str:
    return " ".join(str(error).split())[:500].rstrip(".")


def _described(estimator: Any) -> tuple[dict[str, Any], Arrays]:
    """Class, parameters and what was learned, as JSON can hold it; and the arrays."""
    description, part = plain.encode_parameters(estimator), _PARTS.get(type(estimator).__name__)
    learned = plain.learned_checks(estimator, vars(estimator))
    if isinstance(estimator, CovarianceRegressor):
        state = estimator.__getstate__()
        arrays, description["module"] = state.pop("_module_arrays"), state.pop("_module_config")
        unknown = set(state) - {*learned, *description["params"], "_sklearn_version"}
        if unknown:
            raise TypeError(
                f"estimator has an attribute {min(unknown)!r}, which a model file cannot hold: delete it, or pickle "
                "the estimator."
            )
    elif {"_shown", "_known"} & set(vars(estimator)):
        raise TypeError("estimator was conditioned, which a file cannot hold: save it before, or pickle it.")
    else:
        arrays = estimator._arrays()
    if part is not None and hasattr(estimator, part):
        description[part], parts = _described(getattr(estimator, part))
        arrays |= {f"{part}.{key}": value for key, value in parts.items()}
    description["fitted"] = {name: plain.encode(getattr(estimator, name), name) for name in learned}
    return description, arrays


def _restored(description: Any, arrays: Arrays, known: Mapping[str, str] = ESTIMATORS) -> Any:
    """Estimator of a known class, of a description and its arrays."""
    estimator = plain.decode_parameters(description, known)
    part = _PARTS.get(description["class"], "module")
    # A model of movements need not have a regressor.
    names = {"class", "params", "fitted"} | ({part} if part == "module" else {part} & set(description))
    plain.check_entries(description, names, "its header")
    vars(estimator).update(plain.decode_learned(estimator, description["fitted"]))
    for name, array in arrays.items():
        _check_numbers(name, array)
    if part == "module":
        _restore_module(estimator, description["module"], arrays)
        return estimator
    prefix = f"{part}."
    if part in description:
        parts = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
        inner = _restored(description[part], parts, {**REGRESSORS, **MOVEMENTS})
        if (inner.n_features_in_, inner.n_outputs_) != (1, estimator.n_outputs_):
            raise ValueError(f"its regressor must have 1 input, time, and {estimator.n_outputs_} outputs")
        setattr(estimator, part, inner)
    rest = {key: value for key, value in arrays.items() if not key.startswith(prefix)}
    estimator._check_parameters()
    estimator._restore(rest)
    estimator.predict_cov(np.zeros((1, 1)))  # of arrays that do not fit together
    return estimator


def _restore_module(estimator: Any, config: Any, arrays: Arrays) -> None:
    estimator.__setstate__({**vars(estimator), "_module_config": config, "_module_arrays": arrays})
    module, n_inputs, n_outputs = estimator.module_, estimator.n_features_in_, estimator.n_outputs_
    if (len(module.x_shift), len(module.y_shift)) != (n_inputs, n_outputs):
        raise ValueError(f"its arrays are not for {n_inputs} inputs and {n_outputs} outputs, as it says")
    if estimator._y_is_1d and n_outputs != 1:
        raise ValueError(f"it says that y was 1-D, and that there are {n_outputs} outputs")
    if len(getattr(estimator, "feature_names_in_", module.x_shift)) != n_inputs:
        raise ValueError(f"it has not {n_inputs} names of inputs")
    if hasattr(estimator, "df_") and module.core.covariance.prior_root.shape[1] != estimator.df_:
        raise ValueError(f"df_ is {estimator.df_}, its arrays are for another")
    # What can be said of numbers that are well-formed is whether they predict at the middle of their data.
    mean, scale_tril = module(module.x_shift[None])
    sound = mean.isfinite().all() and scale_tril.isfinite().all() and (scale_tril.diagonal(dim1=-2, dim2=-1) > 0).all()
    if not bool(sound):
        raise ValueError("it predicts no mean and positive definite covariance at the middle of its data")


def _check_numbers(name: str, array: Any) -> None:
    """Check that an array is of float64 in the range that those of its name have; of any shape."""
    if array.dtype != np.float64:
        raise ValueError(f"array {name!r:.80} is of {array.dtype}, must be of float64")
    last = name.rpartition(".")[2]
    # An infinite one means that there is none.
    finite = ~np.isnan(array) if last in ("period", "log_density_floor") else np.isfinite(array)
    checks.require(finite, array, name, "finite")
    if last.endswith(("x_scale", "y_scale", "length_scale", "counts", "period")):
        checks.require(array > 0.0, array, name, "above 0")
    if last.endswith(("amplitude", "noise_ratio", "correlation_variance")):
        checks.require(array >= 0.0, array, name, "at least 0")
    if last == "log_diagonal":  # beyond, the squares of factors are no numbers
        checks.require(np.abs(array) < 300.0, array, name, "below 300 in size")
    factor = np.atleast_2d(array)
    if last in ("prior_tril", "pooled_tril") and (
        (factor != np.tril(factor)).any() or (np.diagonal(factor) <= 0.0).any()
    ):
        raise ValueError(f"array {name!r:.80} must be the lower factor of a positive definite matrix")


def write_archive(path: Path, header: Mapping[str, Any], arrays: Arrays) -> None:
    """Write arrays of numbers, and a header of what JSON can hold with a checksum, to a file that is there whole."""
    whole = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    # Through JSON once: the checksum is of what will be read again, lists where there were tuples.
    plain = json.loads(json.dumps(dict(header)))
    text = json.dumps({**plain, "sha256": checksum(plain, whole)})
    if len(text) > MAX_HEADER_BYTES:
        raise ValueError(
            f"the header of {path} has {len(text)} bytes, must have at most {MAX_HEADER_BYTES}: keep long lists as "
            "arrays."
        )
    with replacing(path) as file:
        file.write(to_bytes(whole, metadata={_KEY: text}))


def read_archive(path: Path) -> tuple[dict[str, Any], Arrays]:
    """Header, less its checksum, and arrays of a file that :func:`write_archive` wrote; nothing is executed.

    A ModelFileError tells of another kind or format, of a file that the memory cannot take, or that is not as it was
    written: to the byte, but for the spelling of what safetensors says of the arrays.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no model file at {path}")
    try:
        require_memory(_COPIES * path.stat().st_size, what=f"{path}", remedy="Read it where there is more.")
    except ValueError as error:
        raise ModelFileError(str(error)) from error
    try:
        # Not mapped into memory, as safe_open would: a file that shrinks while it is read would end the process.
        text, arrays = _unpacked(path.read_bytes())
        header = json.loads(text)
        # The checksum is of the content: another spelling of it would have the same.
        if json.dumps(header) != text:
            raise ValueError("its header is not as it was written")
    except Exception as error:  # parsers of bytes that are not what they claim to be raise errors of all kinds
        what = f"{str(error) or type(error).__name__:.200}"
        raise ModelFileError(f"{path} is not a model of {_KEY}, or is damaged ({what}).") from error
    found = header.get("format_version") if isinstance(header, dict) else None
    if type(found) is not int or found != FORMAT_VERSION:
        raise ModelFileError(
            f"{path} has format version {found!s:.40}; this torch_pbd reads {FORMAT_VERSION}. Upgrade it."
        )
    if header.pop("sha256", None) != checksum(header, arrays):
        raise ModelFileError(f"{path} is damaged: it does not match its checksum.")
    return header, arrays


def _unpacked(content: bytes) -> tuple[str, Arrays]:
    """Our header as text, and the arrays: their bytes are as many as their shapes need."""
    (length,) = struct.unpack_from("<Q", content)
    if length > _MAX_OUTER_BYTES:
        raise ValueError(f"it declares a header of {length} bytes")
    arrays: Arrays = from_bytes(content)
    # Metadata, texts by their names, are read by safe_open alone. By now this is known to be a sound header.
    metadata = json.loads(content[8 : 8 + length]).get("__metadata__", {})
    if set(metadata) != {_KEY}:
        raise ValueError(f"it is not marked {_KEY!r}")
    if len(metadata[_KEY]) > MAX_HEADER_BYTES:
        raise ValueError(f"its header is longer than {MAX_HEADER_BYTES} bytes")
    return metadata[_KEY], arrays


def checksum(header: dict[str, Any], arrays: Arrays) -> str:
    """SHA-256 of what JSON holds and of arrays by their names."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape} ".encode())
        digest.update(arrays[name].tobytes())
    return digest.hexdigest()
