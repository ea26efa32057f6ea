"""What a fit may have learned beside its arrays: the attributes that a model file may set, and their kinds."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from torch_pbd.model_header import decode

Kind = Callable[[Any], bool]


def decode_learned(name: str, values: Any) -> dict[str, Any]:
    """Attributes of a fitted estimator of class ``name``, from their JSON.

    Raises
    ------
    ValueError, OverflowError
        If one is missing, unknown or not what it must be.
    """
    table = _CONTROLLER if name == "DMPController" else {**_REGRESSOR, **_BESIDES.get(name, {})}
    names = {} if name == "DMPController" else {"feature_names_in_": _are_names}
    if not isinstance(values, dict):
        raise ValueError(f"what it learned is {values!r:.80}")
    for words, strangers in (("lacks", set(table) - set(values)), ("has an unknown", set(values) - {*table, *names})):
        if strangers:
            raise ValueError(f"it {words} {min(strangers)!r:.80}")
    decoded = {key: decode(value) for key, value in values.items()}
    for key, value in decoded.items():
        if not {**table, **names}[key](value):
            raise ValueError(f"{key} is {value!r:.80}")
    return decoded


def learned_names(name: str) -> set[str]:
    """Attributes that a fit gives an estimator of class ``name``, beside its module."""
    return {*_REGRESSOR, *_BESIDES.get(name, {}), "feature_names_in_"}


def _is_count(value: Any) -> bool:
    return type(value) is int and value > 0


def _is_number(value: Any) -> bool:
    """Also infinite, or not a number: a loss may be."""
    return type(value) is float or (type(value) is int and abs(value) < 2**1023)


def _is_finite(value: Any) -> bool:
    return _is_number(value) and bool(np.isfinite(float(value)))


def _is_positive(value: Any) -> bool:
    return _is_finite(value) and value > 0


def _is_bool(value: Any) -> bool:
    return isinstance(value, bool)


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _are_names(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == object


def _optional(kind: Kind) -> Kind:
    return lambda value: value is None or kind(value)


def _list_of(kind: Kind) -> Kind:
    return lambda value: isinstance(value, list) and all(map(kind, value))


_REGRESSOR: Mapping[str, Kind] = {
    "n_features_in_": _is_count,
    "n_outputs_": _is_count,
    "_y_is_1d": _is_bool,
    "n_iter_": _is_count,
    "loss_": _is_number,
    "loss_curve_": _list_of(_is_number),
    "converged_": _is_bool,
    "jitter_": _is_finite,
}
_BESIDES: Mapping[str, Mapping[str, Kind]] = {
    "WishartProcessRegressor": {"df_": _is_count},
    "HeteroscedasticGPRegressor": {"effective_share_": _is_finite},
}
_CONTROLLER: Mapping[str, Kind] = {
    "names_": _list_of(_is_text),
    "frame_": _optional(_is_text),
    "units_": _optional(_list_of(_is_text)),
    "time_unit_": _is_text,
    "n_demos_": _is_count,
    "n_outputs_": _is_count,
    "cutoff_": _optional(_is_positive),
    "duration_": _is_positive,
    "start_time_": _is_finite,
    "time_scale_": _is_positive,
    "reproduction_error_": _is_finite,
}
