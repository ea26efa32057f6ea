"""Estimators' classes, parameters and plain values as JSON, and back: only what closed tables name."""

from dataclasses import asdict, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.registry import ESTIMATORS, REGRESSORS, load_class

_LAW = "stiffness_law"
_INTEGERS = {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
_ENTRIES: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("float64", "float32", "float16"), (int, float)),
    **dict.fromkeys(_INTEGERS, (int,)),
    "bool": (bool,),
    "object": (str,),
}


def is_ours(estimator: Any) -> bool:
    """Whether an object is of one of the classes, and not of a subclass that bears its name."""
    return ESTIMATORS.get(type(estimator).__name__) == type(estimator).__module__


def encode_parameters(estimator: Any) -> dict[str, Any]:
    """Class and parameters of an estimator.

    Raises
    ------
    TypeError
        If a parameter is not what a file can hold; it is named.
    """
    parameters = estimator.get_params(deep=False).items()
    return {
        "class": type(estimator).__name__,
        "params": {name: _encode_parameter(value, name) for name, value in parameters},
    }


def decode_parameters(description: Any) -> Any:
    """The unfitted estimator of which :func:`encode_parameters` told.

    Raises
    ------
    ValueError, TypeError
        If it is of no known class, or a parameter is unknown or of a type that it cannot have.
    """
    if not isinstance(description, dict) or not {"class", "params"} <= set(description):
        raise ValueError("it has no class and parameters")
    name, parameters = description["class"], description["params"]
    if name not in list(ESTIMATORS) or not isinstance(parameters, dict):  # a list asks for no hash
        raise ValueError(f"it holds a {name!r:.80}")
    kind = load_class(name)
    nested = {"covariance": _regressor, _LAW: decode_law} if name == "DMPController" else {}
    if name == "DMPController":  # files from before there was a choice are of the printed equation
        parameters = {"adaptation": "additive", **parameters}
    values = {key: nested.get(key, decode)(value) for key, value in parameters.items()}
    device = values.get("device")
    if not isinstance(device, str | None) or (device or "").startswith("meta"):  # which holds no numbers
        raise ValueError(f"device is {device!r:.80}, it must be the name of one, or null")
    return kind(**values)


def encode_law(law: StiffnessLaw) -> dict[str, Any]:
    """JSON of a stiffness law."""
    return {_LAW: asdict(law)}


def decode_law(value: Any) -> StiffnessLaw | None:
    """The law, or None.

    Raises
    ------
    ValueError, TypeError
        If it is neither.
    """
    if value is None:
        return None
    parts = value.get(_LAW) if isinstance(value, dict) and len(value) == 1 else None
    names = {field.name for field in fields(StiffnessLaw)}
    if not isinstance(parts, dict) or set(parts) != names or not isinstance(parts["smooth"], bool):
        raise ValueError("its stiffness law is none")
    return StiffnessLaw(**parts)


def encode(value: Any, name: str) -> Any:
    """JSON of plain values and of arrays, which are marked.

    Raises
    ------
    TypeError
        If a file cannot hold it; ``name`` says what it is of.
    """
    if isinstance(value, np.ndarray) and value.dtype.name in _ENTRIES:
        return {"array": encode(value.tolist(), name), "dtype": value.dtype.name}
    if isinstance(value, np.generic):
        return encode(value.item(), name)
    if isinstance(value, list | tuple):
        return [encode(entry, name) for entry in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(
        f"{name} is a {type(value).__name__}, which a model file cannot hold; pickle the estimator, or fit it with "
        f"{name} given as numbers."
    )


def decode(value: Any) -> Any:
    """What :func:`encode` made this of, tuples as lists.

    Raises
    ------
    ValueError, OverflowError
        If it made it of nothing.
    """
    if isinstance(value, list):
        return [decode(entry) for entry in value]
    if isinstance(value, dict):
        return _decode_array(value)
    return value


def _encode_parameter(value: Any, name: str) -> Any:
    if is_ours(value):
        return encode_parameters(value)
    return encode_law(value) if isinstance(value, StiffnessLaw) else encode(value, name)


def _regressor(value: Any) -> Any:
    """An unfitted regressor, or None."""
    if isinstance(value, dict) and value.get("class") not in list(REGRESSORS):
        raise ValueError("its covariance is no regressor")
    return decode_parameters(value) if isinstance(value, dict) else decode(value)


def _decode_array(marked: dict[str, Any]) -> NDArray[Any]:
    if set(marked) != {"array", "dtype"} or marked["dtype"] not in list(_ENTRIES):
        raise ValueError(f"it holds an object of {', '.join(marked)!r:.80}")
    entries, dtype = marked["array"], marked["dtype"]
    _check_entries(entries, _ENTRIES[dtype])
    array = np.array(entries, dtype=dtype)
    if dtype == "object" and array.ndim != 1:
        raise ValueError("its names are no list")
    return array


def _check_entries(entries: Any, types: tuple[type, ...]) -> None:
    for entry in entries if isinstance(entries, list) else [entries]:
        if isinstance(entry, list):
            _check_entries(entry, types)
        elif type(entry) not in types:
            raise ValueError(f"{entry!r:.80} is no entry of its array")
