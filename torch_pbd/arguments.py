"""What users pass as numbers: anything else is refused by its name, before NumPy makes wrong numbers of it."""

import math
import unicodedata
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def as_array(values: Any, name: str) -> NDArray[Any]:
    """``values`` as an array of real numbers, in their own type: lists, tensors, series; not checked for NaN.

    Raises
    ------
    TypeError
        If an entry is no number at all.
    ValueError
        If ``values`` is ragged, masked, complex, or holds text, dates or records.
    """
    if hasattr(values, "detach"):
        values = from_tensor(values, name)
    if np.ma.is_masked(values):
        raise ValueError(f"{name} has masked entries: leave them out, or fill them in first.")
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name} is ragged, its rows have different lengths: {error}") from error
    except RuntimeError as error:  # a list of tensors that need gradients
        raise ValueError(f"{name} cannot be made an array: {error}") from error
    check_real(array, name)
    return array


def as_floats(values: Any, name: str) -> Floats:
    """The same in float64, with missing entries as NaN; not a copy where it is such an array already."""
    array = as_array(values, name)
    if array.dtype.kind == "O":
        array = np.reshape([math.nan if _is_missing(entry) else float(entry) for entry in array.flat], array.shape)
    return np.asarray(array, dtype=np.float64)


def from_tensor(values: Any, name: str) -> NDArray[Any]:
    """A torch tensor as an array, without its gradient."""
    if str(values.layout) != "torch.strided":
        raise ValueError(f"{name} is a sparse tensor: give a dense one, with .to_dense().")
    try:
        return np.asarray(values.detach().cpu().resolve_conj().resolve_neg().numpy())
    except TypeError as error:  # bfloat16 and smaller
        raise ValueError(f"{name} is a tensor of {values.dtype}, which is too coarse: record it in float64.") from error
    except (NotImplementedError, RuntimeError) as error:
        raise ValueError(f"{name} is a tensor that holds no numbers: {error}") from error


def check_real(array: NDArray[Any], name: str) -> None:
    """Check that an array holds real numbers, or objects that are."""
    kind = array.dtype.kind
    if kind in "biuf":
        return
    if kind in "US" or (kind == "O" and any(isinstance(entry, str | bytes) for entry in array.flat)):
        raise ValueError(
            f"{name} holds text, which dtype='numeric' is not compatible with: convert it to numbers first."
        )
    if kind == "c":
        raise ValueError(f"Complex data not supported: {name} is {array.dtype}. Give real and imaginary parts apart.")
    if kind in "mM":
        raise ValueError(f"{name} holds dates or durations ({array.dtype}): give numbers, such as seconds since then.")
    if kind != "O":
        raise ValueError(f"{name} has dtype {array.dtype}: give an array of plain numbers.")
    for place, entry in enumerate(array.flat):
        _check_entry(entry, name, place)


def check_finite(array: NDArray[Any], name: str, column: Any = None) -> None:
    """Check that the columns of an array of floats (n, ...) have no NaN and no infinity, in scikit-learn's words."""
    if array.dtype.kind != "f" or bool(np.isfinite(array).all()):
        return
    row, *place = map(int, np.argwhere(~np.isfinite(array))[0])
    what = "NaN" if np.isnan(array[row, *place]) else "infinity or a value too large for dtype('float64')"
    within = place[0] if place else column
    where = f"row {row}" if within is None else f"row {row}, column {within}"
    raise ValueError(f"Input {name} contains {what}. The first is in {where}: leave such rows out, or fill them in.")


def as_finite(values: Any, name: str) -> Floats:
    """Floats of any shape, all of them finite."""
    array = as_floats(values, name)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has a value that is not finite.")
    return array


def check_kind(value: Any, name: str, kind: type) -> None:
    """Check that an argument is of a class."""
    if not isinstance(value, kind) or isinstance(value, bool):
        raise ValueError(f"{name} is a {type(value).__name__}, must be a {kind.__name__}.")


def check_text(value: Any, name: str) -> None:
    """Check that a name or a unit is text that every file can hold: UTF-8 without line ends and other controls."""
    if not isinstance(value, str):
        raise ValueError(f"{name} is {value!r}, must be text.")
    wrong = next((letter for letter in value if unicodedata.category(letter) in ("Cc", "Cs")), None)
    if wrong is not None:
        kind = "a control character" if unicodedata.category(wrong) == "Cc" else "half of a surrogate pair"
        raise ValueError(
            f"{name} is {value!a:.80}, with {kind} (U+{ord(wrong):04X}) that not every file can hold: leave it out."
        )


def is_finite(value: Any) -> bool:
    """Whether a real number is one that a float can hold."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def _is_missing(entry: Any) -> bool:
    return entry is None or type(entry).__name__ == "NAType"


def _check_entry(entry: Any, name: str, place: int) -> None:
    if _is_missing(entry):
        return  # a missing value, of which more is said where NaN are refused
    if np.ndim(entry):
        raise TypeError(f"{name} holds a {type(entry).__name__} as entry {place}: give one number for each.")
    try:
        float(entry)
    except TypeError as error:
        raise TypeError(f"{name} holds what is no number, as entry {place}: {error}.") from error
    except OverflowError as error:
        raise ValueError(f"{name} holds a number too large for float64, as entry {place}.") from error
