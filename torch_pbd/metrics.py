"""Scores of predicted covariances: plain functions of arrays, and scorers ``scorer(estimator, X, y)``.

Covariances have shape (n, d, d), one matrix a row, in the squared units of y. Scorers go to ``scoring=`` of
``cross_val_score`` and ``GridSearchCV``, which take the highest score for the best: select models by
:func:`log_likelihood_scorer`; :func:`negative_log_likelihood` and :func:`mahalanobis_coverage` are to report.
"""

import math
from collections.abc import Callable
from functools import partial
from numbers import Real
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv
from sklearn.pipeline import Pipeline

from torch_pbd.covariance_arrays import (
    Floats,
    covariances,
    definite_factor,
    log_det,
    matching_covariances,
    rows_beside,
    semidefinite_factor,
)

_Scorer = Callable[[Any, ArrayLike, ArrayLike], float]


def covariance_mse(
    estimated: ArrayLike,
    reference: ArrayLike,
    on: Literal["cholesky", "matrix"] = "cholesky",
    *,
    reduce: Literal["sum", "mean"] = "sum",
) -> float:
    """Mean over the rows of the squared distance between covariances, or between their Cholesky factors.

    ``on="cholesky"`` is the error of Table I: section IV-A takes the Euclidean norm of the difference of the
    vectorized lower factors, diagonals not negative. A singular matrix has the factor that
    ``matrix + epsilon * I`` tends to. ``on="matrix"`` is (9) as printed, the squared Frobenius norm. Their
    units are those of y to the power of two and of four.

    Parameters
    ----------
    estimated, reference : array_like of shape (n, d, d)
        Positive semidefinite for ``on="cholesky"``.
    on : {"cholesky", "matrix"}, default="cholesky"
        What is compared.
    reduce : {"sum", "mean"}, default="sum"
        Over the entries of one row, d (d + 1) / 2 of a factor and d^2 of a matrix: their sum is the squared
        norm; their mean is what code that averages everything reports. The paper does not say which it is.

    Raises
    ------
    ValueError
        If shapes disagree, an entry is not finite, a matrix is not symmetric or has a negative eigenvalue.
    """
    _check_choice("on", on, ("cholesky", "matrix"))
    _check_choice("reduce", reduce, ("sum", "mean"))
    pair = matching_covariances(estimated, reference, names=("estimated", "reference"))
    d = pair[0].shape[-1]
    n_entries = d * d
    if on == "cholesky":
        pair = (semidefinite_factor("estimated", pair[0]), semidefinite_factor("reference", pair[1]))
        n_entries = d * (d + 1) // 2
    squared = np.square(pair[0] - pair[1]).sum(axis=(-2, -1))
    return float(squared.mean()) / (n_entries if reduce == "mean" else 1)


def relative_frobenius_error(estimated: ArrayLike, reference: ArrayLike) -> float:
    """Mean over the rows of ||estimated - reference||_F / ||reference||_F, of symmetric matrices; it has no unit.

    Parameters
    ----------
    estimated, reference : array_like of shape (n, d, d)

    Raises
    ------
    ValueError
        If shapes disagree, an entry is not finite, a matrix is not symmetric or a reference is zero.
    """
    estimated, reference = matching_covariances(estimated, reference, names=("estimated", "reference"))
    norm = np.linalg.norm(reference, axis=(-2, -1))
    if (norm <= np.finfo(np.float64).tiny).any():
        raise ValueError(f"reference[{int(np.argmin(norm))}] is zero: no error is relative to it.")
    return float(np.mean(np.linalg.norm(estimated - reference, axis=(-2, -1)) / norm))


def gaussian_kl(
    reference: ArrayLike,
    estimated: ArrayLike,
    *,
    reference_mean: ArrayLike | None = None,
    estimated_mean: ArrayLike | None = None,
) -> float:
    """Mean over the rows of the Kullback-Leibler divergence KL(reference || estimated) of Gaussians, in nats.

    What a draw from the reference loses under the estimate: zero for equal Gaussians, whatever their units.

    Parameters
    ----------
    reference, estimated : array_like of shape (n, d, d)
        Positive definite covariances; mind the order.
    reference_mean, estimated_mean : array_like of shape (n, d) or (n,), default=None
        Both or none: None compares the covariances alone, as if the means were equal.

    Raises
    ------
    ValueError
        If shapes disagree, an entry is not finite, a matrix is not symmetric and positive definite, or one
        mean is given without the other.
    """
    reference, estimated = matching_covariances(reference, estimated, names=("reference", "estimated"))
    n, d, _ = reference.shape
    if (reference_mean is None) != (estimated_mean is None):
        raise ValueError("reference_mean and estimated_mean go together: give both or none.")
    shift: Floats = np.zeros((n, d))
    if reference_mean is not None and estimated_mean is not None:
        shift = rows_beside("reference_mean", reference_mean, n, d) - rows_beside(
            "estimated_mean", estimated_mean, n, d
        )
    reference_tril, estimated_tril = definite_factor("reference", reference), definite_factor("estimated", estimated)
    whitened = np.linalg.solve(estimated_tril, np.concatenate([reference_tril, shift[..., None]], axis=-1))
    log_ratio = log_det(estimated_tril) - log_det(reference_tril)
    divergence = 0.5 * (np.square(whitened).sum(axis=(-2, -1)) - d) + log_ratio
    return float(np.mean(np.maximum(divergence, 0.0)))  # equal ones may round to below zero


def negative_log_likelihood(mean: Any, covariance: ArrayLike, y: ArrayLike) -> float:
    """Mean over the rows of the negative log density of y, in nats; lower is better.

    As ``negative_log_likelihood(mean, covariance, y)``, under the Gaussians N(mean, covariance). As a scorer,
    ``negative_log_likelihood(estimator, X, y)``, under the estimator's own predictive density, whatever its
    form: from its ``log_likelihood(X, y)``, or that of a Pipeline's last step.

    Parameters
    ----------
    mean : array_like of shape (n, d) or (n,), or a fitted estimator
    covariance : array_like of shape (n, d, d), or inputs X
    y : array_like of shape (n, d) or (n,)

    Raises
    ------
    ValueError
        If shapes disagree, an entry is not finite, or a covariance is not symmetric and positive definite.
    TypeError
        If the estimator has no ``log_likelihood``.
    """
    if _is_estimator(mean):
        return -_mean_log_likelihood(mean, covariance, y)
    whitened, scale_tril = _whitened_residual(mean, covariance, y)
    nll = 0.5 * np.square(whitened).sum(-1) + log_det(scale_tril)
    return float(nll.mean()) + 0.5 * whitened.shape[-1] * math.log(2 * math.pi)


@overload
def mahalanobis_coverage(mean: float = 0.95) -> _Scorer: ...
@overload
def mahalanobis_coverage(*, level: float) -> _Scorer: ...
@overload
def mahalanobis_coverage(mean: Any, covariance: ArrayLike, y: ArrayLike, level: float = 0.95) -> float: ...
def mahalanobis_coverage(
    mean: Any = None, covariance: ArrayLike | None = None, y: ArrayLike | None = None, level: float = 0.95
) -> Any:
    """Fraction of the rows of y inside the ellipsoid that should hold ``level`` of them.

    Three forms: ``mahalanobis_coverage(mean, covariance, y, level=0.95)`` of arrays;
    ``mahalanobis_coverage(estimator, X, y, level=0.95)`` of ``estimator.predict(X, return_cov=True)``; and
    ``mahalanobis_coverage(0.95)``, the scorer ``(estimator, X, y)`` for that level, which pickles. The
    ellipsoid is the Gaussian's: squared Mahalanobis distance up to chi-squared's quantile for d outputs.

    Parameters
    ----------
    mean : array_like of shape (n, d) or (n,), or a fitted estimator, or the level alone
    covariance : array_like of shape (n, d, d), or inputs X
    y : array_like of shape (n, d) or (n,)
    level : float, default=0.95
        Between 0 and 1, both excluded.

    Raises
    ------
    ValueError
        If ``level`` is out of range, shapes disagree, an entry is not finite, or a covariance is not
        symmetric and positive definite.
    TypeError
        If ``covariance`` or ``y`` is missing.
    """
    if covariance is None and y is None and (mean is None or isinstance(mean, Real)):
        return partial(mahalanobis_coverage, level=_check_level(level if mean is None else mean))
    if covariance is None or y is None:
        raise TypeError("mahalanobis_coverage takes mean, covariance, y; or estimator, X, y; or a level.")
    _check_level(level)
    if _is_estimator(mean):
        mean, covariance = mean.predict(covariance, return_cov=True)
    whitened, _ = _whitened_residual(mean, covariance, y)
    quantile = 2 * gammaincinv(0.5 * whitened.shape[-1], level)  # of chi-squared, d degrees of freedom
    return float(np.mean(np.square(whitened).sum(-1) <= quantile))


def log_likelihood_scorer(estimator: Any, X: ArrayLike, y: ArrayLike) -> float:
    """``estimator.score(X, y)``, the mean log-likelihood in nats: what to select covariance models by."""
    if hasattr(estimator, "score"):
        return float(estimator.score(X, y))
    raise TypeError(f"estimator is {estimator!r}, must be a fitted covariance regressor.")


def _is_estimator(candidate: Any) -> bool:
    return hasattr(candidate, "log_likelihood") or hasattr(candidate, "predict")


def _mean_log_likelihood(estimator: Any, X: ArrayLike, y: ArrayLike) -> float:
    last = estimator[-1] if isinstance(estimator, Pipeline) else estimator
    if not hasattr(last, "log_likelihood"):
        raise TypeError(f"{type(last).__name__} has no log_likelihood(X, y): pass a covariance regressor.")
    # A pipeline passes on score, its mean, and not log_likelihood itself.
    return float(np.mean(last.log_likelihood(X, y)) if last is estimator else estimator.score(X, y))


def _check_level(level: Any) -> float:
    if isinstance(level, bool) or not isinstance(level, Real) or not 0 < float(level) < 1:
        raise ValueError(f"level is {level!r}: it must be between 0 and 1, both excluded.")
    return float(level)


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} is {value!r}: it must be one of {', '.join(map(repr, choices))}.")


def _whitened_residual(mean: ArrayLike, covariance: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
    """L^-1 (y - mean) and the Cholesky factors L of the covariances."""
    covariance = covariances("covariance", covariance)
    n, d, _ = covariance.shape
    residual = rows_beside("y", y, n, d) - rows_beside("mean", mean, n, d)
    scale_tril = definite_factor("covariance", covariance)
    return np.linalg.solve(scale_tril, residual[..., None])[..., 0], scale_tril
