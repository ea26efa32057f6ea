"""Scores of predicted covariances: plain functions of arrays, and scorers ``scorer(estimator, X, y)``.

Covariances have shape (n, d, d), one matrix per row, in the squared units of y. Scorers are for ``scoring=`` of
``cross_val_score`` and ``GridSearchCV``, which prefer the highest score: select models by
:func:`log_likelihood_scorer`, and report :func:`negative_log_likelihood` and :func:`mahalanobis_coverage`.

All raise a ValueError that names the argument where shapes disagree, an entry is not finite, a matrix is not
symmetric or, where its Cholesky factor is needed, not positive definite.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from numbers import Real
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv
from sklearn.pipeline import Pipeline

from torch_pbd import checks
from torch_pbd.exceptions import InvalidParameterError

__all__ = [
    "covariance_mse",
    "gaussian_kl",
    "log_likelihood_scorer",
    "mahalanobis_coverage",
    "negative_log_likelihood",
    "relative_frobenius_error",
]

Floats = NDArray[np.floating[Any]]
_Scorer = Callable[[Any, ArrayLike, ArrayLike], float]
# Cholesky pivots below this share of the diagonal are rounding: float64 makes errors of 1e-16, which add up along a
# row of the factor.
_ZERO_PIVOT = 1e-14


def covariance_mse(estimated: ArrayLike, reference: ArrayLike, on: Literal["cholesky", "matrix"] = "cholesky") -> float:
    """Mean over the rows of the squared distance between covariances, or between their Cholesky factors.

    ``on="cholesky"`` is the error of Table I: Section IV-A takes the Euclidean norm of the difference of the
    vectorized lower factors, whose diagonals are not negative. The factor of a singular matrix is the limit of
    that of ``matrix + epsilon * I``. ``on="matrix"`` is eq. (9) as printed, the squared Frobenius norm. The units
    are those of y to the power of two and of four.

    Parameters
    ----------
    estimated, reference : array_like of shape (n, d, d)
        Covariances, positive semidefinite for ``on="cholesky"``.
    on : {"cholesky", "matrix"}, default="cholesky"
        Whether Cholesky factors or matrices are compared.
    """
    checks.choice(on, "on", ("cholesky", "matrix"))
    first = _covariances(estimated, "estimated")
    second = _covariances(reference, "reference", first.shape)
    if on == "cholesky":
        first, second = _semidefinite_factor(first, "estimated"), _semidefinite_factor(second, "reference")
    return float(np.square(first - second).sum(axis=(-2, -1)).mean())


def relative_frobenius_error(estimated: ArrayLike, reference: ArrayLike) -> float:
    """Mean over the rows of ||estimated - reference||_F / ||reference||_F for symmetric matrices, without unit.

    Parameters
    ----------
    estimated, reference : array_like of shape (n, d, d)
        Symmetric matrices; no reference may be zero.
    """
    estimated = _covariances(estimated, "estimated")
    reference = _covariances(reference, "reference", estimated.shape)
    norm = np.linalg.norm(reference, axis=(-2, -1))
    tiny = np.finfo(np.float64).tiny
    checks.require(norm > tiny, norm, "the norm of reference", "above zero", "no error is relative to zero")
    return float(np.mean(np.linalg.norm(estimated - reference, axis=(-2, -1)) / norm))


def gaussian_kl(
    reference: ArrayLike,
    estimated: ArrayLike,
    *,
    reference_mean: ArrayLike | None = None,
    estimated_mean: ArrayLike | None = None,
) -> float:
    """Mean over the rows of the Kullback-Leibler divergence KL(reference || estimated) of Gaussians, in nats.

    Expected loss in log density under the estimate for draws from the reference: zero for equal Gaussians, unit-free.

    Parameters
    ----------
    reference, estimated : array_like of shape (n, d, d)
        Positive definite covariances; mind the order.
    reference_mean, estimated_mean : array_like of shape (n, d) or (n,), default=None
        Means, both or none; None compares the covariances alone, as if the means were equal.
    """
    reference_tril = _factors(reference, "reference")
    estimated_tril = _factors(estimated, "estimated", reference_tril.shape)
    n, d, _ = reference_tril.shape
    if (reference_mean is None) != (estimated_mean is None):
        raise InvalidParameterError("reference_mean and estimated_mean go together: give both or none.")
    shift = np.zeros((n, d))
    if reference_mean is not None and estimated_mean is not None:
        shift = _rows(reference_mean, "reference_mean", n, d) - _rows(estimated_mean, "estimated_mean", n, d)
    # With reference R R' and estimate L L', the trace term is the squared norm of L^-1 R, and the distance of the means
    # that of L^-1 shift. Both are solved at once.
    whitened = np.linalg.solve(estimated_tril, np.concatenate([reference_tril, shift[..., None]], axis=-1))
    log_ratio = _log_det(estimated_tril) - _log_det(reference_tril)
    divergence = 0.5 * (np.square(whitened).sum(axis=(-2, -1)) - d) + log_ratio
    return float(divergence.clip(0.0).mean())  # rounding may make that of equal Gaussians negative


def negative_log_likelihood(mean: Any, covariance: ArrayLike, y: ArrayLike) -> float:
    """Mean over the rows of the negative log density of y, in nats; lower is better.

    ``negative_log_likelihood(mean, covariance, y)`` uses the Gaussians N(mean, covariance). The scorer
    ``negative_log_likelihood(estimator, X, y)`` uses the estimator's own predictive density, of any form, from its
    ``log_likelihood(X, y)``, which it must have, or that of a Pipeline's last step.

    Parameters
    ----------
    mean : array_like of shape (n, d) or (n,), or a fitted estimator
    covariance : array_like of shape (n, d, d), or inputs X
    y : array_like of shape (n, d) or (n,)
    """
    if hasattr(mean, "predict"):
        last = mean[-1] if isinstance(mean, Pipeline) else mean
        if not hasattr(last, "log_likelihood"):
            raise TypeError(f"{type(last).__name__} has no log_likelihood(X, y): pass a covariance regressor.")
        # A pipeline delegates score, the mean, but not log_likelihood itself.
        return -float(np.mean(mean.log_likelihood(covariance, y)) if last is mean else mean.score(covariance, y))
    whitened, scale_tril = _whitened_residual(mean, covariance, y)
    nll = 0.5 * np.square(whitened).sum(-1) + _log_det(scale_tril)
    return float(nll.mean()) + 0.5 * whitened.shape[-1] * math.log(2 * math.pi)


@overload
def mahalanobis_coverage(mean: float = ..., *, level: float = ...) -> _Scorer: ...
@overload
def mahalanobis_coverage(mean: Any, covariance: ArrayLike, y: ArrayLike, level: float = 0.95) -> float: ...
def mahalanobis_coverage(
    mean: Any = None, covariance: ArrayLike | None = None, y: ArrayLike | None = None, level: float = 0.95
) -> Any:
    """Fraction of the rows of y inside the ellipsoid that should hold ``level`` of them.

    ``mahalanobis_coverage(mean, covariance, y, level=0.95)`` takes arrays;
    ``mahalanobis_coverage(estimator, X, y, level=0.95)`` uses ``estimator.predict(X, return_cov=True)``; and
    ``mahalanobis_coverage(0.95)`` returns a picklable scorer ``(estimator, X, y)`` for that level. The ellipsoid
    is the Gaussian's: squared Mahalanobis distance up to the chi-squared quantile for d outputs.

    Parameters
    ----------
    mean : array_like of shape (n, d) or (n,), or a fitted estimator, or the level alone
    covariance : array_like of shape (n, d, d), or inputs X
    y : array_like of shape (n, d) or (n,)
    level : float, default=0.95
        Nominal coverage, between 0 and 1 exclusive.
    """
    if covariance is None and y is None and (mean is None or isinstance(mean, Real)):
        level = checks.number(level if mean is None else mean, "level", above=0.0, below=1.0)
        return partial(mahalanobis_coverage, level=level)
    if covariance is None or y is None:
        raise TypeError("mahalanobis_coverage takes mean, covariance, y; or estimator, X, y; or a level.")
    checks.number(level, "level", above=0.0, below=1.0)
    if hasattr(mean, "predict"):
        mean, covariance = mean.predict(covariance, return_cov=True)
    whitened, _ = _whitened_residual(mean, covariance, y)
    quantile = 2 * gammaincinv(0.5 * whitened.shape[-1], level)  # chi-squared quantile with d degrees of freedom
    return float(np.mean(np.square(whitened).sum(-1) <= quantile))


def log_likelihood_scorer(estimator: Any, X: ArrayLike, y: ArrayLike) -> float:
    """Mean log-likelihood in nats, ``estimator.score(X, y)``, by which to select covariance models."""
    if not hasattr(estimator, "score"):
        raise TypeError(f"estimator is {estimator!r}, must be a fitted covariance regressor.")
    return float(estimator.score(X, y))


def _whitened_residual(mean: ArrayLike, covariance: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
    """L^-1 (y - mean), and the Cholesky factors L of the covariances."""
    scale_tril = _factors(covariance, "covariance")
    n, d, _ = scale_tril.shape
    residual = _rows(y, "y", n, d) - _rows(mean, "mean", n, d)
    return np.linalg.solve(scale_tril, residual[..., None])[..., 0], scale_tril


def _covariances(values: ArrayLike, name: str, shape: Sequence[int | str] = ("n", "d", "d")) -> Floats:
    """Checked symmetric matrices (n, d, d)."""
    matrices = checks.array(values, name, shape)
    if not len(matrices):
        raise InvalidParameterError(f"{name} has shape {matrices.shape}, must have at least one row.")
    checks.symmetric(matrices, name)
    return matrices


def _rows(values: ArrayLike, name: str, n: int, d: int) -> Floats:
    """Checked rows (n, d) for n covariances of d outputs; for one output also from (n,)."""
    rows = checks.real_floats(values, name)
    return checks.array(rows[:, np.newaxis] if rows.ndim == d == 1 else rows, name, (n, d))


def _log_det(scale_tril: Floats) -> Floats:
    """Log determinants of Cholesky factors, half those of the covariances."""
    return np.log(np.diagonal(scale_tril, axis1=-2, axis2=-1)).sum(-1)


def _factors(values: ArrayLike, name: str, shape: Sequence[int | str] = ("n", "d", "d")) -> Floats:
    """Cholesky factors (n, d, d) of positive definite covariances."""
    matrices = _covariances(values, name, shape)
    try:
        return np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        checks.semidefinite(matrices, name, definite=True)  # names the first that has none
        raise


def _semidefinite_factor(matrices: Floats, name: str) -> Floats:
    """Cholesky factors of possibly singular matrices, with columns of zeros where a pivot is zero up to rounding."""
    checks.semidefinite(matrices, name)
    remainder, factor = matrices.copy(), np.zeros_like(matrices)
    rounding = _ZERO_PIVOT * np.diagonal(matrices, axis1=-2, axis2=-1)
    # Outer products: column j of the factor is that of the remaining matrix, divided by the root of its pivot.
    for j in range(matrices.shape[-1]):
        pivot = remainder[:, j, j]
        root = np.sqrt(np.where(pivot > rounding[:, j], pivot, np.inf))
        factor[:, j:, j] = remainder[:, j:, j] / root[:, None]
        remainder -= factor[:, :, j, None] * factor[:, None, :, j]
    return factor
