"""Contents of a schedule: shapes, finite numbers, gains that can be followed, labels that JSON can hold."""

import math
import reprlib
from collections.abc import Mapping, Sequence
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

# Of the squared norm: quaternions rounded to seven digits count as unit ones, and are made so to rounding.
_NEARLY_UNIT, _UNIT = 1e-6, 1e-14
# JSON's reader and Python's own stack take more levels than this, on every system.
_DEEPEST = 100

Arrays = Mapping[str, NDArray[Any]]
Labels = Mapping[str, Any]
Limits = tuple[float, float] | tuple[tuple[float, ...], tuple[float, ...]]


def checked_fields(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a schedule that a robot can follow: read-only copies in float64, and labels that cannot change.

    Matrices are symmetric to the last bit.
    """
    position = checks.array(fields["position"], "position", ("n", "p"))
    n, p = position.shape
    if n < 2 or not p:
        raise InvalidParameterError(f"position has shape {position.shape}, must have at least 2 rows, 1 column.")
    sizes = {"n": n, "p": p, "d": p if fields["orientation"] is None else p + 3}
    given = [
        name for name in SHAPES if name not in OPTIONAL or not (fields[name] is None or np.ndim(fields[name]) == 0)
    ]
    if np.ndim(fields["mass"]) == 2:  # one for all rows
        fields = {**fields, "mass": np.broadcast_to(fields["mass"], (n, *np.shape(fields["mass"])))}
    arrays = {
        name: checks.array(fields[name], name, [sizes.get(str(size), size) for size in SHAPES[name]]).copy()
        for name in given
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
        arrays["orientation"] = _checked_orientation(arrays["orientation"])
    units = ["Nm/rad" if fields["units"] == "rad" else "N/m"] * p + ["Nm/rad"] * (sizes["d"] - p)
    limits = _checked_limits(fields["stiffness_limits"], units)
    if limits is not None:
        _check_limits(arrays["stiffness"], limits, units[0])
    _check_held(arrays["stiffness"], arrays["damping"])
    for array in arrays.values():
        array.setflags(write=False)
    mass = fields["mass"]
    labels = _checked_labels(
        {name: fields[name] for name in LABELS} | {"mass": mass if "mass" not in arrays else None}, sizes["d"]
    )
    return {**labels, **arrays, "stiffness_limits": limits}


def _checked_orientation(orientation: Floats) -> Floats:
    squared = np.sum(orientation**2, axis=1)
    remedy = "give unit quaternions w x y z"
    checks.require(np.abs(squared - 1.0) <= _NEARLY_UNIT, squared, "the squared norm of orientation", "1", remedy)
    off = np.abs(squared - 1.0) > _UNIT
    orientation[off] /= np.sqrt(squared[off])[:, np.newaxis]
    return rotations.continuous(orientation)


def _checked_limits(limits: Any, units: Sequence[str]) -> Limits | None:
    """Two numbers, or two tuples of one for each axis, of these units; None stays None."""
    if limits is None:
        return None
    if not isinstance(limits, list | tuple | np.ndarray) or len(limits) != 2:
        raise checks.refusal(limits, "stiffness_limits", "the least and the largest stiffness, or None")
    of_each = any(np.ndim(limit) for limit in limits)
    low, high = (
        np.broadcast_to(checks.real_floats(limit, "stiffness_limits"), (len(units),) if of_each else ())
        for limit in limits
    )
    for i, (least, most) in enumerate(zip(low.reshape(-1), high.reshape(-1), strict=True)):
        axis = f"[{i}]" if of_each else ""
        lowest = checks.number(float(least), f"stiffness_limits[0]{axis}", least=0.0, unit=units[i])
        checks.number(float(most), f"stiffness_limits[1]{axis}", above=0.0, least=lowest, unit=units[i])
    return (tuple(low.tolist()), tuple(high.tolist())) if of_each else (float(low), float(high))


def _check_limits(stiffness: Floats, limits: Limits, unit: str) -> None:
    """Refuse a stiffness beyond the limits, as matrices and to rounding.

    ``K_min <= K <= K_max``, diagonal both, in units of K_max: those of lengths and angles then do not matter.
    """
    low, high = map(np.asarray, limits)
    scale = 1.0 / np.sqrt(high * np.ones(stiffness.shape[1]))
    relative = scale[:, np.newaxis] * stiffness * scale
    least = low / high * np.eye(stiffness.shape[1])
    if checks.eigenvalues_above(relative - least, -checks.ROUNDING) and checks.eigenvalues_above(
        -relative, -1.0 - checks.ROUNDING
    ):
        return
    remedy = "limit the stiffness to them, or widen them"
    if low.ndim:
        beyond = np.maximum(np.linalg.eigvalsh(least - relative)[:, -1], np.linalg.eigvalsh(relative)[:, -1] - 1.0)
        checks.require(
            beyond <= checks.ROUNDING, beyond, "the share of stiffness beyond stiffness_limits", "none", remedy
        )
    eigenvalues = np.linalg.eigvalsh(stiffness)
    good = (eigenvalues >= low - checks.ROUNDING * high) & (eigenvalues <= high + checks.ROUNDING * high)
    must = f"within stiffness_limits, {low:g} and {high:g} {unit}"
    checks.require(good, eigenvalues, "the eigenvalue of stiffness", must, remedy, unit)


def _check_held(stiffness: Floats, damping: Floats) -> None:
    """Refuse rows in which neither stiffness nor damping acts along some axis: nothing else would stop the robot."""
    scales = [checks.ROUNDING * np.abs(gain).max(axis=(1, 2)) for gain in (stiffness, damping)]
    if checks.eigenvalues_above(stiffness, scales[0]):
        return
    lowest = [np.linalg.eigvalsh(gain)[:, 0] for gain in (stiffness, damping)]
    must = "above zero where the stiffness is singular, for nothing else stops the robot"
    good = (lowest[0] > scales[0]) | (lowest[1] > scales[1])
    checks.require(good, lowest[1], "the smallest eigenvalue of damping", must, "raise one of the two")


def _checked_labels(labels: Labels, n_outputs: int) -> dict[str, Any]:
    """Labels of a schedule that are sound, as tuples and a copy of the provenance."""
    names = labels["names"]
    if names is not None:
        listed = list(names) if isinstance(names, list | tuple) else []
        if not (all(isinstance(name, str) for name in listed) and len(set(listed)) == len(listed) == n_outputs):
            raise checks.refusal(names, "names", f"{n_outputs} different strings, one for each output")
        # Names are titles of columns; other texts stand in JSON, which can hold line ends and controls too.
        names = tuple(checks.text(name, f"names[{i}]") for i, name in enumerate(listed))
    for name in ("units", "frame"):
        checks.instance(labels[name], name, str, optional=True)
    checks.choice(labels["covariance_of"], "covariance_of", ("position", "forcing"))
    checks.instance(labels["provenance"], "provenance", Mapping)
    return {
        **labels,
        "names": names,
        "mass": checks.number(labels["mass"], "mass", above=0.0, unit="kg", optional=True),
        "provenance": MappingProxyType(_json_copy(labels["provenance"], "provenance")),
    }


def _json_copy(value: Any, where: str, depth: int = 0) -> Any:
    """Copy of what comes back from JSON as it was; tuples come back as lists."""
    if depth > _DEEPEST:
        raise InvalidParameterError(
            f"provenance is nested more than {_DEEPEST} levels deep, or holds itself, down by {where:.80}..., must be "
            "what JSON can hold, in fewer levels."
        )
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _json_copy(entry, f"{where}[{key!r}]", depth + 1) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_json_copy(entry, f"{where}[{i}]", depth + 1) for i, entry in enumerate(value)]
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise InvalidParameterError(
        f"{where} is {reprlib.repr(value)}, must be what JSON can hold, such as text, finite numbers, lists and dicts "
        "with text for keys: convert arrays with .tolist()."
    )
