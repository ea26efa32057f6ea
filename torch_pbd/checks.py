"""Checks of what users pass, in one dialect: the value first, its name second; what comes back is what to go on with.

Every refusal is one sentence, ``name is 3, must be an integer of at least 4: remedy``, and one exception,
:class:`~torch_pbd.exceptions.InvalidParameterError`.
"""

import math
import sys
import unicodedata
import warnings
from collections.abc import Sequence
from contextlib import suppress
from numbers import Integral, Real
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from torch_pbd.exceptions import InvalidParameterError

Floats = NDArray[np.float64]

LARGEST = 1e100
"""Numbers no larger than this have squares, and sums of many squares, that float64 holds."""

ROUNDING = 1e-9
"""Relative: what is smaller counts as rounding of the caller's arithmetic. float64 itself makes errors of 1e-13 in
matrices of a hundred rows; files of ten digits make 1e-10."""

_NEARLY_UNIT = 1e-6  # of squared norms: quaternions of seven digits pass as unit ones
_SINGULAR = 1e-14  # an eigenvalue of correlations that rounding alone can make
_MOST = 2**53  # whole numbers above it are not all floats
_LONGEST = 80  # letters of a value that are shown


def refusal(value: Any, name: str, must: str, remedy: str = "", unit: str = "") -> InvalidParameterError:
    """Error to raise for an argument that cannot be used."""
    shown = repr(value.item() if isinstance(value, np.generic) else value)
    if len(shown) > _LONGEST or "\n" in shown:
        shown = f"of type {type(value).__name__}"
    return InvalidParameterError(
        f"{name} is {shown}{unit and ' ' + unit}, must be {must}{remedy and ': ' + remedy.rstrip('.')}."
    )


def number(
    value: Any,
    name: str,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
    unit: str = "",
    optional: bool = False,
    remedy: str = "",
) -> Any:
    """Finite real number within bounds, of which ``above`` and ``below`` are themselves not allowed; no bool, no text.

    ``unit`` and ``remedy``, what to do, are said in the message. None comes back if it is ``optional``.
    """
    if optional and value is None:
        return None
    if isinstance(value, Real) and not isinstance(value, bool | np.bool_):
        with suppress(OverflowError):  # of an integer that is no float
            real = float(value)
            too_small = (above is not None and real <= above) or (least is not None and real < least)
            too_large = (below is not None and real >= below) or (most is not None and real > most)
            if math.isfinite(real) and not (too_small or too_large):
                return real
    bounds = [
        f"{word} {bound:g}"
        for word, bound in (("above", above), ("of at least", least), ("below", below), ("at most", most))
        if bound is not None
    ]
    must = f"a finite number{' ' if bounds else ''}{' and '.join(bounds)}{' or None' if optional else ''}"
    raise refusal(value, name, must, remedy, unit)


def count(value: Any, name: str, *, least: int = 1, most: int = _MOST, remedy: str = "") -> int:
    """Whole number from ``least`` to ``most``."""
    is_whole = isinstance(value, Integral) and not isinstance(value, bool | np.bool_)
    if is_whole and least <= int(value) <= most:
        return int(value)
    upper = f" and at most {most}" if most < _MOST or (is_whole and int(value) > most) else ""
    raise refusal(value, name, f"an integer of at least {least}{upper}", remedy)


def flag(value: Any, name: str) -> bool:
    """True or False: a text, such as "no", would count as True."""
    if not isinstance(value, bool | np.bool_):
        raise refusal(value, name, "True or False")
    return bool(value)


def choice(value: Any, name: str, choices: Any) -> Any:
    """One of some strings: a sequence of them, or a ``Literal``."""
    known: tuple[str, ...] = get_args(choices) or tuple(choices)
    if not isinstance(value, str) or value not in known:
        raise refusal(value, name, f"one of {', '.join(map(repr, known))}")
    return value


def instance(value: Any, name: str, kind: type, *, optional: bool = False, remedy: str = "") -> Any:
    """Object of a class; None too, if ``optional``."""
    if not isinstance(value, kind) and not (optional and value is None):
        article = "an" if kind.__name__[0] in "AEIOUaeiou" else "a"
        raise refusal(value, name, f"{article} {kind.__name__}{' or None' if optional else ''}", remedy)
    return value


def text(value: Any, name: str, *, optional: bool = False) -> Any:
    """Text that every file can hold, UTF-8 without line ends and other controls; None too, if ``optional``."""
    if optional and value is None:
        return None
    if not isinstance(value, str):
        raise refusal(value, name, f"text{' or None' if optional else ''}")
    # Cc are control characters, Cs halves of surrogate pairs.
    if any(unicodedata.category(letter) in ("Cc", "Cs") for letter in value):
        raise InvalidParameterError(f"{name} is {value!a:.80}, must be text without control characters and surrogates.")
    return value


def seed(value: Any) -> np.random.RandomState:
    """RandomState of a seed, as scikit-learn makes it; None is NumPy's global one."""
    from sklearn.utils import check_random_state  # a second to import, which schedules and the loop need not spend

    if not isinstance(value, bool):
        with suppress(ValueError):
            return check_random_state(value)
    raise refusal(value, "random_state", "None, an integer from 0 to 2**32 - 1 or a numpy.random.RandomState")


def array(values: Any, name: str, shape: Sequence[int | str] | None) -> Floats:
    """Array of finite float64 whose squares are finite too, of a shape in which letters stand for any size.

    ``shape`` is such as ``("n", 3)``, None is any. The result is no copy where ``values`` is such an array already.
    """
    floats = real_floats(values, name)
    if shape is not None and (
        len(shape) != floats.ndim
        or any(size != own for size, own in zip(shape, floats.shape, strict=True) if not isinstance(size, str))
    ):
        expected = f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
        raise InvalidParameterError(f"{name} has shape {floats.shape}, must have shape {expected}.")
    require(np.abs(floats) <= LARGEST, floats, name, f"finite and at most {LARGEST:g} in size")
    return floats


def require(
    good: NDArray[np.bool_], values: NDArray[Any], name: str, must: str, remedy: str = "", unit: str = ""
) -> None:
    """Refuse the first value of an array that is not good, by its index."""
    if not good.all():
        index = tuple(map(int, np.argwhere(~good)[0]))
        where = f"{name}[{', '.join(map(str, index))}]" if index else name
        raise refusal(values[index], where, must, remedy, unit)


def unit_quaternions(quaternions: NDArray[Any], name: str) -> Floats:
    """Squared norms (...,) of quaternions (..., 4), refused where they are not 1 to seven digits."""
    squared = np.sum(quaternions**2, axis=-1)
    good, remedy = np.abs(squared - 1.0) <= _NEARLY_UNIT, "give unit quaternions w x y z"
    require(good, squared, f"the squared norm of {name}", "1", remedy)
    return squared


def symmetric(matrices: NDArray[Any], name: str) -> Floats:
    """Check that matrices (..., d, d) of floats are finite and symmetric to rounding; returns that of each (...,).

    It is :data:`ROUNDING` of a matrix's largest entry, or a hundred times the resolution of its dtype.
    """
    if matrices.ndim < 2 or matrices.shape[-1] != matrices.shape[-2] or not matrices.shape[-1]:
        raise InvalidParameterError(f"{name} has shape {matrices.shape}, must have shape (..., d, d).")
    scale = np.abs(matrices).max(axis=(-2, -1), initial=0.0).astype(np.float64)
    most = min(LARGEST, float(np.finfo(matrices.dtype).max) ** 0.75)  # whose products are numbers in float32 too
    require(scale <= most, scale, f"the largest entry of {name}", f"finite and at most {most:g} in size")
    rounding: Floats = max(ROUNDING, 100.0 * float(np.finfo(matrices.dtype).eps)) * scale
    skew = np.abs(matrices - np.swapaxes(matrices, -2, -1)).max(axis=(-2, -1), initial=0.0)
    require(skew <= rounding, skew, f"the asymmetry of {name}", "zero", "symmetrize it, (A + A') / 2")
    return rounding


def semidefinite(matrices: NDArray[Any], name: str, *, definite: bool = False, remedy: str = "") -> None:
    """Check that matrices (..., d, d) of floats are finite, symmetric and positive semidefinite, or definite.

    Symmetric and semidefinite to rounding, as in :func:`symmetric`. Definite is judged by the correlations, as outputs
    may have units that are far apart.
    """
    rounding, relative = symmetric(matrices, name), matrices
    # Matrices of zeros have no scale, and pass any shift.
    limit: Any = -np.where(rounding > 0.0, rounding, 1.0)
    if definite:
        deviation = np.sqrt(np.diagonal(matrices, axis1=-2, axis2=-1).clip(0.0))
        product = deviation[..., :, np.newaxis] * deviation[..., np.newaxis, :]
        # A variance of zero or less leaves zeros, which are not definite.
        relative = np.divide(matrices, product, out=np.zeros_like(matrices), where=product > 0.0)
        limit = _SINGULAR
    if not eigenvalues_above(relative, limit):
        good, own = np.linalg.eigvalsh(relative)[..., 0] >= limit, np.linalg.eigvalsh(matrices)[..., 0]
        must = "above zero, positive definite" if definite else "zero or more, positive semidefinite"
        require(good, own, f"the smallest eigenvalue of {name}", must, remedy or "build it as a product A A'")


def eigenvalues_above(matrices: NDArray[Any], bound: float | Floats) -> bool:
    """Whether all eigenvalues of symmetric matrices (..., d, d) are above a bound, or bounds (...,).

    That is whether the shifted matrices have Cholesky factors, which take a tenth of the time of eigenvalues.
    """
    try:
        np.linalg.cholesky(matrices - np.multiply.outer(bound, np.eye(matrices.shape[-1])))
    except np.linalg.LinAlgError:
        return False
    return True


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line that called this package: the first frame outside of it."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == "torch_pbd":
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def as_array(values: Any, name: str) -> NDArray[Any]:
    """``values`` as an array of any type: lists, tensors, series; a ValueError if they are ragged or masked."""
    if hasattr(values, "detach"):
        values = from_tensor(values, name)
    if np.ma.is_masked(values):
        raise ValueError(f"{name} has masked entries: leave them out, or fill them in first.")
    try:
        return np.asarray(values)
    except (RuntimeError, ValueError) as error:  # RuntimeError of a list of tensors that need gradients
        raise ValueError(f"{name} is ragged, or no array: {error}") from error


def real_array(values: Any, name: str) -> NDArray[Any]:
    """:func:`as_array` of real numbers in their own type; not checked for NaN.

    Raises TypeError for entries that are no numbers at all, and ValueError for complex numbers, text, dates or records.
    """
    array = as_array(values, name)
    kind = array.dtype.kind
    if kind in "US" or (kind == "O" and any(isinstance(entry, str | bytes) for entry in array.flat)):
        # scikit-learn's own checks ask for the words in the middle.
        raise ValueError(
            f"{name} holds text, which dtype='numeric' is not compatible with: convert it to numbers first."
        )
    if kind == "c":
        raise ValueError(f"Complex data not supported: {name} is {array.dtype}. Give real and imaginary parts apart.")
    if kind in "mM":
        nanoseconds = f".astype('{kind}8[ns]').astype('int64')"
        raise ValueError(f"{name} holds dates or durations ({array.dtype}): give numbers, as {nanoseconds} does in ns.")
    if kind not in "biufO":
        raise ValueError(f"{name} has dtype {array.dtype}: give an array of plain numbers.")
    if kind == "O":
        for place, entry in enumerate(array.flat):
            if np.ndim(entry):
                raise TypeError(f"{name} holds a {type(entry).__name__} as entry {place}: give one number for each.")
            try:
                _ = is_missing(entry) or float(entry)  # where NaN are refused, more is said of what is missing
            except TypeError as error:
                raise TypeError(f"{name} holds what is no number, as entry {place}: {error}.") from error
            except OverflowError as error:
                raise ValueError(f"{name} holds a number too large for float64, as entry {place}.") from error
    return array


def is_missing(entry: Any) -> bool:
    """Whether an object stands for a missing number: None, or NA of pandas."""
    return entry is None or type(entry).__name__ == "NAType"


def real_floats(values: Any, name: str) -> Floats:
    """Array of real numbers in float64, with missing entries as NaN; not a copy where it is such an array already."""
    array = real_array(values, name)
    if array.dtype.kind == "O":
        array = np.reshape([math.nan if is_missing(entry) else float(entry) for entry in array.flat], array.shape)
    return np.asarray(array, dtype=np.float64)


def from_tensor(values: Any, name: str) -> NDArray[Any]:
    """A torch tensor as an array, without its gradient."""
    if str(values.layout) != "torch.strided":
        raise ValueError(f"{name} is a sparse tensor: give a dense one, with .to_dense().")
    try:
        return np.asarray(values.detach().cpu().resolve_conj().resolve_neg().numpy())
    except TypeError as error:  # bfloat16 and smaller
        raise ValueError(f"{name} is a tensor of {values.dtype}, which is too coarse: record it in float64.") from error
