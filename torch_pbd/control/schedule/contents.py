"""Contents of a schedule: shapes, finite numbers, gains that can be followed, labels that JSON can hold."""

import math
import reprlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.exceptions import InvalidParameterError

ARRAY_DIMS = {"time": 1, "position": 2, "velocity": 2, "stiffness": 3, "damping": 3, "covariance": 3, "type1": 1}
"""Every array of a schedule with its number of axes: (n,), (n, d) or (n, d, d)."""

LABELS = ("names", "units", "frame", "stiffness_limits", "covariance_of", "mass", "provenance")

# JSON's reader and Python's own stack take more levels than this, on every system.
_DEEPEST = 100

Arrays = Mapping[str, NDArray[Any]]
Labels = Mapping[str, Any]


def checked_fields(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a schedule that a robot can follow: read-only copies in float64, and labels that cannot change.

    Matrices are symmetric to the last bit.
    """
    limits = fields["stiffness_limits"]
    if limits is not None:
        low, high = checks.array(limits, "stiffness_limits", (2,)).tolist()
        low = checks.number(low, "stiffness_limits[0]", least=0.0, unit="N/m")
        limits = low, checks.number(high, "stiffness_limits[1]", above=0.0, least=low, unit="N/m")
    position = checks.array(fields["position"], "position", ("n", "d"))
    n, d = position.shape
    if n < 2 or not d:
        raise InvalidParameterError(f"position has shape {position.shape}, must have at least 2 rows, 1 column.")
    arrays = {name: checks.array(fields[name], name, (n, d, d)[:n_dims]).copy() for name, n_dims in ARRAY_DIMS.items()}
    later = np.diff(arrays["time"], prepend=-np.inf) > 0.0
    remedy = "sort the rows by time and drop repeated ones"
    checks.require(later, arrays["time"], "time", "later than the time before it", remedy)
    type1 = arrays["type1"]
    checks.require((type1 >= 0.0) & (type1 <= 1.0), type1, "type1", "from 0 (on data) to 1 (the prior alone)")
    for name in [name for name, n_dims in ARRAY_DIMS.items() if n_dims == 3]:
        checks.semidefinite(arrays[name], name)
        arrays[name] = 0.5 * (arrays[name] + arrays[name].swapaxes(1, 2))
    if limits is not None:
        _check_limits(arrays["stiffness"], limits)
    _check_held(arrays["stiffness"], arrays["damping"])
    for array in arrays.values():
        array.setflags(write=False)
    labels = _checked_labels({name: fields[name] for name in LABELS}, n_outputs=d)
    return {**arrays, **labels, "stiffness_limits": limits}


def _check_limits(stiffness: Floats, limits: tuple[float, float]) -> None:
    """Refuse eigenvalues of the stiffness beyond the limits, to rounding."""
    low, high = limits
    least, most = low - checks.ROUNDING * high, high + checks.ROUNDING * high
    if checks.eigenvalues_above(stiffness, least) and checks.eigenvalues_above(-stiffness, -most):
        return
    eigenvalues = np.linalg.eigvalsh(stiffness)
    good = (eigenvalues >= least) & (eigenvalues <= most)
    must = f"within stiffness_limits, {low:g} and {high:g} N/m"
    checks.require(good, eigenvalues, "the eigenvalue of stiffness", must, "limit the stiffness to them, or widen them")


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
