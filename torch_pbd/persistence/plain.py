"""Conversion of estimators to plain JSON and back, restricted to the classes and attributes in closed tables."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from torch_pbd import checks
from torch_pbd.control.stiffness import RotationLimits, StiffnessLaw
from torch_pbd.registry import ESTIMATORS, MOVEMENTS, REGRESSORS, load_class

Check = Callable[[Any, str], Any]

_LAW = "stiffness_law"
_INTEGERS = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
_DTYPES = ["float64", "float32", "float16", *_INTEGERS, "bool", "object"]  # column names are arrays of objects


def is_ours(estimator: Any) -> bool:
    """Whether an object is of one of the classes, and not of a subclass that bears its name."""
    return ESTIMATORS.get(type(estimator).__name__) == type(estimator).__module__


def encode_parameters(estimator: Any) -> dict[str, Any]:
    """Class and parameters of an estimator; a TypeError names one that a file cannot hold."""
    parameters = estimator.get_params(deep=False).items()
    return {"class": type(estimator).__name__, "params": {name: encode(value, name) for name, value in parameters}}


def decode_parameters(description: Any, known: Mapping[str, str] = ESTIMATORS) -> Any:
    """Unfitted estimator of what :func:`encode_parameters` gave, of a known class."""
    if not isinstance(description, dict) or not {"class", "params"} <= set(description):
        raise ValueError("it has no class and parameters")
    name, parameters = description["class"], description["params"]
    if name not in list(known) or not isinstance(parameters, dict):  # a list asks for no hash
        raise ValueError(f"it holds a {name!r:.80}; known are {', '.join(known)}")
    if name == "DMPController":  # files from before there was a choice are of the printed equation
        parameters = {"adaptation": "additive", **parameters}
    former = {"HeteroscedasticGPRegressor": "shared_length_scale", "WishartProcessRegressor": "start"}.get(name)
    parameters = {key: value for key, value in parameters.items() if key != former}  # learned is what it led to
    estimator = load_class(name)(**_decoded(name, parameters))
    device = getattr(estimator, "device", None)
    if not isinstance(device, str | None) or (device or "").startswith("meta"):  # which holds no numbers
        raise ValueError(f"device is {device!r:.80}, must be the name of one, or null")
    return estimator


def learned_checks(estimator: Any, given: Any) -> dict[str, Check]:
    """Attributes that a fit gives an estimator beside its module and arrays, and what each of them must be.

    Names of columns are among them if they are among those ``given``: fits to arrays learn none.
    """
    name = type(estimator).__name__
    if name == "DMPController":
        return dict(_CONTROLLER)
    table = {**(_MOVEMENT if name in MOVEMENTS else _REGRESSOR), **estimator._learned}
    return table | ({"feature_names_in_": _names} if isinstance(given, dict) and "feature_names_in_" in given else {})


def decode_learned(estimator: Any, values: Any) -> dict[str, Any]:
    """Learned attributes of an estimator, from their JSON; none is missing, unknown or not what it must be."""
    table = learned_checks(estimator, values)
    check_entries(values, set(table), "what it learned")
    decoded = _decoded(type(estimator).__name__, values)
    for name, check in table.items():
        check(decoded[name], name)
    return decoded


def check_entries(entries: Any, names: set[str], what: str) -> None:
    """Check that a mapping has entries of these names, and no others."""
    if not isinstance(entries, dict) or set(entries) != names:
        listed = ", ".join(entries) if isinstance(entries, dict) else repr(entries)
        raise ValueError(f"{what} has {listed:.200}, must have {', '.join(sorted(names))}")


def encode(value: Any, name: str) -> Any:
    """JSON of an attribute of this name; arrays, stiffness laws and unfitted estimators are marked."""
    if isinstance(value, np.ndarray) and value.dtype.name in _DTYPES:
        return {"array": encode(value.tolist(), name), "dtype": value.dtype.name}
    if isinstance(value, np.generic):
        return encode(value.item(), name)
    if isinstance(value, list | tuple):
        return [encode(entry, name) for entry in value]
    if isinstance(value, StiffnessLaw):
        return {_LAW: asdict(value)}
    if is_ours(value):
        return encode_parameters(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(
        f"{name} is a {type(value).__name__}, which a model file cannot hold; pickle the estimator, or fit it with "
        f"{name} given as numbers."
    )


def _decoded(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of an estimator of class ``name``; laws and regressors only where a controller has them."""
    nested: dict[str, Callable[[Any], Any]] = {"regressor": _regressor} if name in MOVEMENTS else {}
    if name == "DMPController":
        nested = {"covariance": _regressor, _LAW: _law, "law_": _law}
    return {key: nested.get(key, _decode)(value) for key, value in values.items()}


def _decode(value: Any) -> Any:
    """Plain value or array, tuples as lists."""
    if isinstance(value, list):
        return [_decode(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    if set(value) != {"array", "dtype"} or value["dtype"] not in _DTYPES:
        raise ValueError(f"it holds an object of {', '.join(value)!r:.80}")
    array = np.array(value["array"], dtype=value["dtype"])
    # NumPy would make numbers of text, and round them: only what it gives back unchanged is of this type.
    if array.tolist() != value["array"] or (array.dtype == object and not all(isinstance(x, str) for x in array.flat)):
        raise ValueError(f"{value['array']!r:.80} are no entries of an array of {value['dtype']}")
    return array


def _law(value: Any) -> StiffnessLaw | None:
    if value is None:
        return None
    check_entries(value, {_LAW}, "its stiffness law")
    # The first files say nothing of what the laws of then did not have: it is as by default.
    own = dict(value[_LAW])
    if own.get("rotation") is not None:
        own["rotation"] = RotationLimits(**own["rotation"])
    return StiffnessLaw(**own)


def _regressor(value: Any) -> Any:
    """An unfitted regressor or movement model, or None."""
    return decode_parameters(value, {**REGRESSORS, **MOVEMENTS}) if isinstance(value, dict) else value


def _fitted_law(value: Any, name: str) -> None:
    if checks.instance(value, name, StiffnessLaw).bounds == "quantile":
        raise ValueError("its stiffness law has no bounds")


def _names(value: Any, name: str) -> None:
    if not isinstance(value, np.ndarray) or value.dtype != object or value.ndim != 1:
        raise ValueError(f"{name} is {value!r:.80}, must be an array of names")


def _list_of(check: Check, *, optional: bool = False) -> Check:
    def checked(value: Any, name: str) -> None:
        for entry in checks.instance(value, name, list, optional=optional) or ():
            check(entry, name)

    return checked


_REAL = partial(checks.instance, kind=float)  # also infinite, or not a number: a loss may be
_TEXT = partial(checks.instance, kind=str)
_POSITIVE = partial(checks.number, above=0.0)

_REGRESSOR: Mapping[str, Check] = {
    "n_features_in_": checks.count,
    "n_outputs_": checks.count,
    "_y_is_1d": checks.flag,
    "n_iter_": checks.count,
    "loss_": _REAL,
    "loss_curve_": _list_of(_REAL),
    "converged_": checks.flag,
    "jitter_": checks.number,
}
_MOVEMENT: Mapping[str, Check] = {
    "n_features_in_": partial(checks.count, most=1),
    "n_outputs_": checks.count,
    "_y_is_1d": checks.flag,
    "input_": partial(checks.choice, choices=("time", "phase", "array")),
}
_CONTROLLER: Mapping[str, Check] = {
    "names_": _list_of(_TEXT),
    "frame_": partial(_TEXT, optional=True),
    "units_": _list_of(_TEXT, optional=True),
    "time_unit_": _TEXT,
    "n_demos_": checks.count,
    "n_outputs_": checks.count,
    "cutoff_": partial(_POSITIVE, optional=True),
    "duration_": _POSITIVE,
    "start_time_": checks.number,
    "time_scale_": _POSITIVE,
    "reproduction_error_": checks.number,
    "law_": _fitted_law,
}
