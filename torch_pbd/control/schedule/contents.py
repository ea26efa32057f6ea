"""Checks of a schedule's contents: shapes, finite numbers, feasible gains, JSON-compatible labels."""

import math
import reprlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.exceptions import InvalidParameterError

SHAPES: dict[str, tuple[int | str, ...]] = {
    "time": ("n",),
    "position": ("n", "p"),
    "velocity": ("n", "d"),
    "stiffness": ("n", "d", "d"),
    "damping": ("n", "d", "d"),
    "covariance": ("n", "d", "d"),
    "type1": ("n",),
    "acceleration": ("n", "d"),
    "orientation": ("n", 4),
    "mass": ("n", "d", "d"),
}
"""Every array of a schedule with its shape: d is the number p of positions, or p + 3 with an orientation."""

OPTIONAL = frozenset({"acceleration", "orientation", "mass"})

LABELS = ("names", "units", "frame", "stiffness_limits", "covariance_of", "mass", "provenance")

_UNIT = 1e-14  # rounding of the squared norm, to which quaternions are normalized
# Deepest nesting of labels, which JSON's reader and Python's stack exceed on every system.
_DEEPEST = 100

Arrays = Mapping[str, NDArray[Any]]
Labels = Mapping[str, Any]
Limits = tuple[float, float] | tuple[tuple[float, ...], tuple[float, ...]]


def checked_fields(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Checked fields of a schedule: read-only float64 copies and immutable labels.

    Matrices are symmetric to the last bit.
    """
    position = checks.array(fields["position"], "position", ("n", "p"))
    n, p = position.shape
    if n < 2 or not p:
        raise InvalidParameterError(f"position has shape {position.shape}, must have at least 2 rows, 1 column.")
    sizes = {"n": n, "p": p, "d": p if fields["orientation"] is None else p + 3}
    mass: Any = fields["mass"]
    of_rows = mass if np.ndim(mass) else None
    if np.ndim(mass) == 2:
        of_rows = np.broadcast_to(checks.array(mass, "mass", (sizes["d"], sizes["d"])), (n, sizes["d"], sizes["d"]))
    given = {**fields, "mass": of_rows}
    arrays = {
        name: checks.array(given[name], name, [sizes.get(str(size), size) for size in shape]).copy()
        for name, shape in SHAPES.items()
        if given[name] is not None or name not in OPTIONAL
    }
    later = np.diff(arrays["time"], prepend=-np.inf) > 0.0
    remedy = "sort the rows by time and drop repeated ones"
    checks.require(later, arrays["time"], "time", "later than the time before it", remedy, "s")
    type1 = arrays["type1"]
    checks.require((type1 >= 0.0) & (type1 <= 1.0), type1, "type1", "from 0 (on data) to 1 (the prior alone)")
    for name in [name for name in arrays if len(SHAPES[name]) == 3]:
        checks.semidefinite(arrays[name], name, definite=name == "mass")
        arrays[name] = 0.5 * (arrays[name] + arrays[name].swapaxes(1, 2))
    if "orientation" in arrays:
        orientation, squared = arrays["orientation"], checks.unit_quaternions(arrays["orientation"], "orientation")
        off = np.abs(squared - 1.0) > _UNIT
        orientation[off] /= np.sqrt(squared[off])[:, np.newaxis]
        arrays["orientation"] = rotations.continuous(orientation)
    limits = _checked_limits(fields["stiffness_limits"], arrays["stiffness"])
    _check_held(arrays["stiffness"], arrays["damping"])
    for array in arrays.values():
        array.setflags(write=False)
    labels = _checked_labels({**fields, "mass": mass if of_rows is None else None}, sizes["d"])
    return {**labels, **arrays, "stiffness_limits": limits}


def _checked_limits(limits: Any, stiffness: Floats) -> Limits | None:
    """Lower and upper limits of the stiffness up to rounding, each a number or one per axis; or None."""
    if limits is None:
        return None
    if not isinstance(limits, list | tuple | np.ndarray) or len(limits) != 2:
        raise checks.refusal(limits, "stiffness_limits", "the least and the largest stiffness, or None")
    d = stiffness.shape[1]
    shape = (d,) if any(np.ndim(limit) for limit in limits) else ()
    low, high = (np.broadcast_to(checks.real_floats(limit, "stiffness_limits"), shape) for limit in limits)
    for axis in np.ndindex(shape):
        where = f"[{axis[0]}]" if axis else ""
        least = checks.number(float(low[axis]), f"stiffness_limits[0]{where}", least=0.0)
        checks.number(float(high[axis]), f"stiffness_limits[1]{where}", above=0.0, least=least)
    # K_min <= K <= K_max as matrices, both diagonal, scaled by K_max so that units of lengths and angles cancel.
    scale = 1.0 / np.sqrt(high * np.ones(d))
    relative, softest = scale[:, np.newaxis] * stiffness * scale, low / high * np.eye(d)
    bound = -checks.ROUNDING
    if not (
        checks.eigenvalues_above(relative - softest, bound) and checks.eigenvalues_above(np.eye(d) - relative, bound)
    ):
        beyond = np.maximum(np.linalg.eigvalsh(softest - relative)[:, -1], np.linalg.eigvalsh(relative)[:, -1] - 1.0)
        remedy = "limit the stiffness to them, or widen them"
        name = "the share of stiffness beyond stiffness_limits"
        checks.require(beyond <= checks.ROUNDING, beyond, name, "none", remedy)
    return (tuple(low.tolist()), tuple(high.tolist())) if shape else (float(low), float(high))


def _check_held(stiffness: Floats, damping: Floats) -> None:
    """Raise if neither stiffness nor damping acts along some axis of a row: nothing else would stop the robot."""
    scales = [checks.ROUNDING * np.abs(gain).max(axis=(1, 2)) for gain in (stiffness, damping)]
    if checks.eigenvalues_above(stiffness, scales[0]):
        return
    lowest = [np.linalg.eigvalsh(gain)[:, 0] for gain in (stiffness, damping)]
    must = "above zero where the stiffness is singular, for nothing else stops the robot"
    good = (lowest[0] > scales[0]) | (lowest[1] > scales[1])
    checks.require(good, lowest[1], "the smallest eigenvalue of damping", must, "raise one of the two")


def _checked_labels(labels: Labels, n_outputs: int) -> dict[str, Any]:
    """Checked labels of a schedule, as tuples and a copy of the provenance."""
    names = labels["names"]
    if names is not None:
        listed = list(names) if isinstance(names, list | tuple) else []
        if not (all(isinstance(name, str) for name in listed) and len(set(listed)) == len(listed) == n_outputs):
            raise checks.refusal(names, "names", f"{n_outputs} different strings, one for each output")
        # Names are column titles; other texts are stored as JSON, which can hold line ends and control characters.
        names = tuple(checks.text(name, f"names[{i}]") for i, name in enumerate(listed))
    checks.instance(labels["provenance"], "provenance", Mapping)
    return {
        "names": names,
        "units": checks.instance(labels["units"], "units", str, optional=True),
        "frame": checks.instance(labels["frame"], "frame", str, optional=True),
        "covariance_of": checks.choice(labels["covariance_of"], "covariance_of", ("position", "forcing")),
        "mass": checks.number(labels["mass"], "mass", above=0.0, unit="kg", optional=True),
        "provenance": MappingProxyType(_json_copy(labels["provenance"], "provenance")),
    }


def _json_copy(value: Any, where: str, depth: int = 0) -> Any:
    """Copy of a value that survives a JSON round trip: lists for tuples, and keys in order, as checksums have them."""
    if depth > _DEEPEST:
        raise InvalidParameterError(
            f"provenance is more than {_DEEPEST} levels deep, or holds itself, at {where:.80}...: take fewer levels."
        )
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _json_copy(entry, f"{where}[{key!r}]", depth + 1) for key, entry in sorted(value.items())}
    if isinstance(value, list | tuple):
        return [_json_copy(entry, f"{where}[{i}]", depth + 1) for i, entry in enumerate(value)]
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise InvalidParameterError(
        f"{where} is {reprlib.repr(value)}, must be what JSON can hold: text, finite numbers, lists (take .tolist()), "
        "or dicts with text for keys."
    )
