"""Standardization of inputs and outputs, and the rows that share an input."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torch_pbd.estimators.validation import CONSTANT, Floats

# Standardized numbers keep this many decimals, so that other units are the same numbers: an optimizer with flat
# directions would turn a difference in the last bit into digits.
_DECIMALS = 10


@dataclass(frozen=True)
class Standardization:
    """Shift and scale of each column: inputs get a range of one, outputs a standard deviation of one."""

    x_shift: Floats
    x_scale: Floats
    y_shift: Floats
    y_scale: Floats
    x_parts: tuple[Floats, Floats]
    """A value that the column has, and the shift less that value. A difference of values is exact, so that what is
    made of these two is the same numbers wherever the origin is."""
    y_parts: tuple[Floats, Floats]

    @classmethod
    def fit(cls, X: Floats, y: Floats) -> "Standardization":
        """Standardization of the columns of X and y.

        A constant output gets the largest scale of the others, so that it is precise beside them; a
        constant input its magnitude, beside which rounding is nothing, in all units.
        """
        low, high = X.min(axis=0), X.max(axis=0)
        span = high - low
        x_scale = _or_magnitude(span, np.maximum(np.abs(low), np.abs(high)))
        y_shift = y.mean(axis=0)
        y_scale = (y - y_shift).std(axis=0)
        largest = np.abs(y).max(axis=0)
        varies = y_scale > CONSTANT * largest
        if not varies.all():
            y_scale = np.where(varies, y_scale, y_scale[varies].max() if varies.any() else largest)
            y_scale = np.where(y_scale > 0, y_scale, y_scale.max() or 1.0)
        parts = (low, 0.5 * span), (y[0], (y - y[0]).mean(axis=0))
        return cls(low + 0.5 * span, x_scale, y_shift, y_scale, *parts)

    def inputs(self, X: Floats) -> Floats:
        """Inputs standardized."""
        return rounded(self.exact_inputs(X))

    def outputs(self, y: Floats) -> Floats:
        """Outputs standardized."""
        return rounded(self.exact_outputs(y))

    def exact_inputs(self, X: Floats) -> Floats:
        """Inputs standardized with all their digits."""
        return (X - self.x_parts[0] - self.x_parts[1]) / self.x_scale

    def exact_outputs(self, y: Floats) -> Floats:
        """Outputs standardized with all their digits."""
        return (y - self.y_parts[0] - self.y_parts[1]) / self.y_scale


def rounded(standardized: Floats) -> Floats:
    """Standardized numbers, the same in all units."""
    return np.asarray(np.round(standardized, _DECIMALS))


def spread_of(columns: Floats) -> Floats:
    """Standard deviation of each column; the magnitude of one that is constant but for rounding."""
    return _or_magnitude(columns.std(axis=0), np.abs(columns).max(axis=0))


def _or_magnitude(spread: Floats, magnitude: Floats) -> Floats:
    return np.where(spread > CONSTANT * magnitude, spread, np.where(magnitude > 0, magnitude, 1.0))


def canonical_order(X: Floats, y: Floats) -> NDArray[np.intp]:
    """Order of the rows that does not depend on the one they come in, so that no result does."""
    order = y[:, -1].argsort()
    ordered = y[order, -1]
    if (ordered[1:] > ordered[:-1]).all():
        return order
    return np.lexsort(np.hstack([X, y]).T)  # where values repeat the other columns decide, which takes longer


def distinct_rows(X: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Distinct rows of X in lexicographic order, and the index of each row's own among them."""
    X = X + 0.0  # minus zero is zero
    order = X[:, 0].argsort() if X.shape[1] == 1 else np.lexsort(X.T[::-1])
    ordered = X[order]
    is_first = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    index = np.empty(len(X), dtype=np.intp)
    index[order] = is_first.cumsum() - 1
    return ordered[is_first], index
