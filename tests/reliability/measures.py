"""What is measured of a fitted model: how far its covariances are from singular, and what units do to it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.estimators.door import Standardization
from torch_pbd.estimators.validation import CONSTANT

Floats = NDArray[np.float64]
Fit = Callable[[Floats, Floats], CovarianceRegressor]

_BEYOND = 1e6  # ranges of the inputs


class Smallest(NamedTuple):
    """Smallest eigenvalues over many covariances, blind to the units of the outputs."""

    of_correlation: float
    """Of the covariance scaled to unit variances. What a Cholesky factorization or a solution loses is told by it
    alone (J. Demmel, LAPACK working note 14, 1989): that one output is more precise than another costs no digit."""
    of_standardized: float
    """Of the covariance in the units in which the model computes, over its own largest eigenvalue: how precise the
    most precise direction is beside the least precise one."""


class Discrepancy(NamedTuple):
    """Largest difference between two models that should be one."""

    mean: float
    """In deviations of each output in the data."""
    covariance: float
    """Of an entry, over the two predicted deviations it belongs to."""


def queries(X: NDArray[Any], n: int, seed: int) -> Floats:
    """Inputs (n, e): training rows, between and beside them, up to a million ranges away, and at 1e300."""
    rng = np.random.default_rng(seed)
    X = X.astype(np.float64)
    low, span = X.min(axis=0), np.ptp(X, axis=0)
    reach = 10.0 ** rng.uniform(0.0, np.log10(_BEYOND), size=(n, 1)) * rng.choice([-1.0, 1.0], size=(n, X.shape[1]))
    x = low + span * np.where(rng.random((n, 1)) < 0.5, rng.uniform(-0.3, 1.3, size=(n, X.shape[1])), reach)
    on_data = min(len(X), n // 4)
    x[:on_data] = X[rng.permutation(len(X))[:on_data]]
    x[-2:] = np.sign(reach[-2:]) * np.stack([_BEYOND * span, np.full_like(span, 1e300)])
    return x


def smallest_eigenvalues(covariance: Floats, y_scale: Floats) -> Smallest:
    """Of covariances (n, d, d) of a model whose units are ``y_scale`` (d,)."""
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    correlation = covariance / deviation[:, :, np.newaxis] / deviation[:, np.newaxis, :]
    of_standardized = np.linalg.eigvalsh(covariance / y_scale[:, np.newaxis] / y_scale)
    ratio = of_standardized[:, 0] / of_standardized[:, -1]
    return Smallest(float(np.linalg.eigvalsh(correlation)[:, 0].min()), float(ratio.min()))


def scale_of(X: Floats, y: Floats) -> Floats:
    """Deviation of each output, and of one that is constant what stands for it."""
    return Standardization.fit(X, y).y_scale


def discrepancy(
    reference: tuple[Floats, Floats], other: tuple[Floats, Floats], y_scale: Floats, *, resolved: float = 0.0
) -> Discrepancy:
    """Of two means (n, d) and covariances (n, d, d); no predicted deviation counts for less than ``resolved``.

    That is in deviations of the output in the data.
    """
    deviation = np.maximum(np.sqrt(np.diagonal(reference[1], axis1=1, axis2=2)), resolved * y_scale)
    of_covariance = np.abs(other[1] - reference[1]) / deviation[:, :, np.newaxis] / deviation[:, np.newaxis, :]
    return Discrepancy(float((np.abs(other[0] - reference[0]) / y_scale).max()), float(of_covariance.max()))


def of_units(fit: Fit, X: Floats, y: Floats, seed: int) -> tuple[Discrepancy, bool]:
    """What units from 1e-9 to 1e9 change, another for each column; and whether both fits converged.

    Constant outputs have no scale of their own: where there are some all outputs change their units alike, and zeros
    alone none. Of a predicted deviation below 1e-4 of that in the data nothing is asked: where eq. (6) is a difference
    from one, a float64 holds its square, 1e-8, to eight digits.
    """
    rng = np.random.default_rng(seed)
    x_factor, y_factor = (np.power(10.0, rng.integers(-9, 10, size=part.shape[1])) for part in (X, y))
    if not _varies(y).all():
        y_factor[:] = y_factor[0] if y.any() else 1.0
    x, model, other = beside(X, seed), fit(X, y), fit(X * x_factor, y * y_factor)
    mean, covariance = other.predict(x * x_factor, return_cov=True)
    found = (mean / y_factor, covariance / y_factor[:, np.newaxis] / y_factor)
    reference = model.predict(x, return_cov=True)
    return discrepancy(reference, found, scale_of(X, y), resolved=1e-4), model.converged_ and other.converged_


def of_origin(fit: Fit, X: Floats, y: Floats, seed: int, *, ranges: float = 1e6) -> tuple[Discrepancy, bool]:
    """What an origin changes that is so many ranges away for X, and a million for y; and whether both fits converged.

    A float64 holds such an output to 1e-10 of its range only. So compared are the same numbers, with and without the
    offset, and of a predicted deviation below a thousandth of that in the data nothing is asked.
    """
    x_shift = ranges * np.where(_varies(X), np.ptp(X, axis=0), 0.0)
    y_shift = 1e6 * np.where(_varies(y), np.ptp(y, axis=0), 0.0)
    x = beside(X, seed) + x_shift
    model, other = fit((X + x_shift) - x_shift, (y + y_shift) - y_shift), fit(X + x_shift, y + y_shift)
    mean, covariance = other.predict(x, return_cov=True)
    reference, found = model.predict(x - x_shift, return_cov=True), (mean - y_shift, covariance)
    return discrepancy(reference, found, scale_of(X, y), resolved=1e-3), model.converged_ and other.converged_


def _varies(columns: Floats) -> NDArray[np.bool_]:
    return columns.std(axis=0) > CONSTANT * np.abs(columns).max(axis=0)


def beside(X: Floats, seed: int) -> Floats:
    """Training rows, and others within a fifth of the range of them."""
    rng = np.random.default_rng(seed)
    varies = _varies(X)
    between = X.min(axis=0) + rng.uniform(-0.2, 1.2, size=(10, X.shape[1])) * np.ptp(X, axis=0)
    return np.vstack([X[:: max(1, len(X) // 10)], np.where(varies, between, X[0])])
