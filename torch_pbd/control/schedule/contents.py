"""What a schedule must be: shapes, finite numbers, symmetric gains, labels that JSON can hold."""

import math
import reprlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks

ARRAY_DIMS = {"time": 1, "position": 2, "velocity": 2, "stiffness": 3, "damping": 3, "covariance": 3, "type1": 1}
"""Every array of a schedule with its number of axes: (n,), (n, d) or (n, d, d)."""

LABELS = ("names", "units", "frame", "stiffness_limits", "covariance_of", "mass", "provenance")

ROUNDING = 1e-9
"""Relative: what is smaller counts as rounding of the caller's arithmetic."""

_DEEPEST = 100  # levels of a provenance, of which JSON and Python's own stack take more
_LARGEST = 1e100  # squares and sums of what is smaller do not overflow

Floats = NDArray[np.float64]
Arrays = Mapping[str, NDArray[Any]]
Labels = Mapping[str, Any]


def checked_fields(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a schedule, if they are sound: read-only copies in float64, and labels that cannot change."""
    copies = {name: as_floats(fields[name], name, n_dims) for name, n_dims in ARRAY_DIMS.items()}
    _check_shapes(copies)
    _check_rows(copies["time"], copies["type1"])
    for name in ("stiffness", "damping", "covariance"):
        copies[name] = _symmetrized(copies[name], name)
    labels = _checked_labels({name: fields[name] for name in LABELS}, n_outputs=copies["position"].shape[1])
    _check_gains(copies["stiffness"], copies["damping"], labels["stiffness_limits"])
    for copy in copies.values():
        copy.setflags(write=False)
    return {**copies, **labels}


def check_positive(name: str, value: Any) -> None:
    """Refuse what is not a positive number."""
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float | np.integer | np.floating)
        or not (value > 0.0 and checks.is_finite(value))
    ):
        raise ValueError(f"{name} is {value!r}, it must be a positive number.")


def _check_shapes(arrays: Arrays) -> None:
    n, d = arrays["position"].shape
    for name, array in arrays.items():
        expected = (n, d, d)[: array.ndim]
        if array.shape != expected or n < 2 or d < 1:
            raise ValueError(
                f"{name} has shape {array.shape}, it must be {expected}: position has {n} rows (at least 2 are needed) "
                f"and {d} outputs (at least 1)."
            )


def _check_rows(time: Floats, type1: Floats) -> None:
    later = np.diff(time, prepend=-np.inf) > 0.0
    require(later, time, "time", "it must increase strictly. Sort the rows by time and drop repeated ones.")
    require((type1 >= 0.0) & (type1 <= 1.0), type1, "type1", "it must be within 0 (on data) and 1 (the prior alone).")


def _check_gains(stiffness: Floats, damping: Floats, limits: tuple[float, float] | None) -> None:
    """Refuse stiffness outside its limits, and motion on which neither stiffness nor damping acts."""
    spectrum, losses = np.linalg.eigvalsh(stiffness), np.linalg.eigvalsh(damping)
    held = spectrum[:, 0] > ROUNDING * spectrum[:, -1]
    damped = losses[:, 0] > ROUNDING * losses[:, -1]
    remedy = "where the stiffness is singular, the damping must be positive definite. Raise one of the two."
    require(held | damped, losses[:, 0], "the smallest eigenvalue of damping", remedy)
    if limits is not None:
        low, high = limits
        within = (spectrum >= low - ROUNDING * high) & (spectrum <= high + ROUNDING * high)
        remedy = f"stiffness_limits are {low:g} and {high:g} N/m. Limit the stiffness to them, or widen them."
        require(within, spectrum, "the eigenvalue of stiffness", remedy)


def _checked_labels(labels: Labels, n_outputs: int) -> dict[str, Any]:
    """The labels of a schedule as tuples, strings and a copy of the provenance, if they are sound."""
    names, limits = labels["names"], labels["stiffness_limits"]
    listed = list(names) if isinstance(names, list | tuple) else []
    strings = [name for name in listed if isinstance(name, str)]
    if names is not None and not len(set(strings)) == len(listed) == n_outputs:
        raise ValueError(f"names is {names!r}, it must be {n_outputs} different strings, one for each output.")
    for i, name in enumerate(strings):  # which are titles of columns; the others stand in JSON, which holds any text
        checks.text(name, f"names[{i}]")
    for name in ("units", "frame"):
        if not isinstance(labels[name], str | None):
            raise ValueError(f"{name} is {labels[name]!r}, it must be a string or None.")
    if labels["covariance_of"] not in ("position", "forcing"):
        raise ValueError(f"covariance_of is {labels['covariance_of']!r}, it must be 'position' or 'forcing'.")
    if labels["mass"] is not None:
        check_positive("mass", labels["mass"])
    if not isinstance(labels["provenance"], Mapping):
        raise ValueError(f"provenance is {reprlib.repr(labels['provenance'])}, it must be a mapping.")
    return {
        **labels,
        "names": None if names is None else tuple(listed),
        "stiffness_limits": None if limits is None else _checked_limits(limits),
        "provenance": MappingProxyType(_json_copy(labels["provenance"], "provenance")),
    }


def as_floats(values: Any, name: str, n_dims: int) -> Floats:
    """Copy as float64 of an array whose entries are finite and whose squares are too."""
    if np.ma.is_masked(values):
        raise ValueError(f"{name} has masked entries: fill them in first.")
    if hasattr(values, "detach"):
        values = checks.from_tensor(values, name)
    try:
        given = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name} is ragged, its rows have different lengths: {error}") from error
    if given.dtype.kind not in "fiu" or given.ndim != n_dims:
        raise ValueError(f"{name} has dtype {given.dtype} and shape {given.shape}: give real numbers, {n_dims}-D.")
    copy = np.array(given, dtype=np.float64, order="C")
    require(np.abs(copy) <= _LARGEST, copy, name, f"it must be finite and at most {_LARGEST:g} in size.")
    return copy


def require(good: NDArray[np.bool_], values: NDArray[Any], name: str, must: str) -> None:
    """Refuse the first value that is not good, by its row and its place in it."""
    if not good.all():
        row, *place = map(int, np.argwhere(~good)[0])
        where = f"row {row}, entry {tuple(place)}" if place else f"row {row}"
        raise ValueError(f"{name} is {values[row, *place]!s} at {where}: {must}")


def _symmetrized(matrices: Floats, name: str) -> Floats:
    skew = matrices - matrices.swapaxes(1, 2)
    scale = np.abs(matrices).max(axis=(1, 2), keepdims=True)
    remedy = "it must be that of the entry across the diagonal. Symmetrize the matrix: (A + A') / 2."
    require(np.abs(skew) <= ROUNDING * scale, matrices, name, remedy)
    symmetric: Floats = 0.5 * (matrices + matrices.swapaxes(1, 2))
    spectrum = np.linalg.eigvalsh(symmetric)
    sound = spectrum[:, 0] >= -ROUNDING * np.abs(spectrum).max(axis=1)
    remedy = "it must not be negative: build the matrix as Q diag(q >= 0) Q', or as a product A A'."
    require(sound, spectrum[:, 0], f"the smallest eigenvalue of {name}", remedy)
    return symmetric


def _checked_limits(limits: Any) -> tuple[float, float]:
    bounds = as_floats(limits, "stiffness_limits", 1).tolist()
    if len(bounds) != 2 or not 0.0 <= bounds[0] <= bounds[1] or bounds[1] == 0.0:
        raise ValueError(
            f"stiffness_limits is {bounds}, it must be (least, largest) in N/m, 0 <= least <= largest > 0."
        )
    return bounds[0], bounds[1]


def _json_copy(value: Any, where: str, depth: int = 0) -> Any:
    """Copy of what comes back from JSON as it was; tuples come back as lists."""
    if depth > _DEEPEST:
        raise ValueError(
            f"provenance is nested more than {_DEEPEST} levels deep, or holds itself: it must be what JSON can hold, "
            f"in fewer levels. It goes down by {where[:80]}..."
        )
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _json_copy(entry, f"{where}[{key!r}]", depth + 1) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_json_copy(entry, f"{where}[{i}]", depth + 1) for i, entry in enumerate(value)]
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise ValueError(
        f"{where} is {reprlib.repr(value)}, it must be what JSON can hold: text, finite numbers, lists, dicts with "
        "text for keys. Convert arrays with .tolist()."
    )
