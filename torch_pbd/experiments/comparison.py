"""Compare models on one data set: how well each repeats the data, and how well it foretells a demonstration."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from joblib import Parallel, delayed
from numpy.typing import NDArray
from sklearn.base import clone

from torch_pbd.estimators._base import CovarianceRegressor
from torch_pbd.estimators._groups import fit_by_demonstration
from torch_pbd.experiments.sweep import left_out, score_fold
from torch_pbd.metrics import covariance_mse, relative_frobenius_error
from torch_pbd.optim import Record, recorded

Floats = NDArray[np.float64]
Truth = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Score:
    """What one model does on one data set."""

    model: str
    cholesky_mse: float
    """To the empirical covariances, squared units of y: the MSE of the paper's Table I. NaN if not aligned."""
    frobenius: float
    """Relative error to the true covariance, NaN where it is not known."""
    fold_log_likelihood: tuple[float, ...]
    """Of each demonstration left out, in nats per sample."""
    fold_coverage: tuple[float, ...]
    """Share of each demonstration left out that lies within the 95 % ellipse."""
    fit_seconds: float
    smallest_eigenvalue: float = field(default=float("nan"))
    """Of the predicted correlations, over the data."""

    @property
    def log_likelihood(self) -> float:
        """Mean over the demonstrations left out."""
        return float(np.mean(self.fold_log_likelihood)) if self.fold_log_likelihood else float("nan")

    @property
    def log_likelihood_median(self) -> float:
        """Median over the demonstrations left out."""
        return float(np.median(self.fold_log_likelihood)) if self.fold_log_likelihood else float("nan")

    @property
    def log_likelihood_error(self) -> float:
        """Standard error of the mean over the demonstrations left out."""
        folds = self.fold_log_likelihood
        return float(np.std(folds, ddof=1) / len(folds) ** 0.5) if len(folds) > 1 else float("nan")

    @property
    def coverage(self) -> float:
        """Mean over the demonstrations left out."""
        return float(np.mean(self.fold_coverage)) if self.fold_coverage else float("nan")


def compare_models(
    models: Mapping[str, CovarianceRegressor],
    X: Floats,
    y: Floats,
    groups: NDArray[np.intp],
    *,
    truth: Truth | None = None,
    max_folds: int = 10,
    n_jobs: int | None = None,
) -> list[Score]:
    """Fit every model on all the data, and once more without each of some demonstrations.

    Parameters
    ----------
    models : mapping of str to covariance regressor
        Cloned, not changed.
    X, y, groups : ndarray of shapes (n_samples, n_features), (n_samples, n_outputs), (n_samples,)
        ``groups`` tells the demonstrations apart.
    truth : callable, default=None
        Maps X (n, e) to the true covariances (n, d, d).
    max_folds : int, default=10
        Largest number of demonstrations to leave out, each by itself; spread evenly over all. 0 for none.
    n_jobs : int, default=None
        Fits that run at the same time, as in scikit-learn. Times are measured before, one by one.

    Returns
    -------
    list of Score, in the order of ``models``
    """
    inputs, empirical = empirical_covariances(X, y)
    folds = left_out(groups, max_folds)
    with recorded(None):  # a fit that goes on from a checkpoint takes no time
        fits = {name: _timed_fit(clone(model), X, y, groups) for name, model in models.items()}
    results = iter(_scored_folds(models, X, y, groups, folds, n_jobs))
    scores = []
    for name, (fitted, seconds) in fits.items():
        covariance = fitted.predict_cov(inputs)
        held_out = [next(results) for _ in folds]
        scores.append(
            Score(
                model=name,
                cholesky_mse=float("nan") if empirical is None else covariance_mse(covariance, empirical),
                frobenius=float("nan") if truth is None else relative_frobenius_error(covariance, truth(inputs)),
                fold_log_likelihood=tuple(row["log_likelihood"] for row in held_out),
                fold_coverage=tuple(row["coverage"] for row in held_out),
                fit_seconds=seconds,
                smallest_eigenvalue=_smallest_eigenvalue(covariance),
            )
        )
    return scores


def _scored_folds(
    models: Mapping[str, CovarianceRegressor],
    X: Floats,
    y: Floats,
    groups: NDArray[np.intp],
    folds: NDArray[np.intp],
    n_jobs: int | None,
) -> list[dict[str, Any]]:
    """What :func:`score_fold` gives, by model and fold; folds that a checkpoint has are not fitted again."""
    pairs = [(name, fold) for name in models for fold in folds]
    data = torch.tensor(X), torch.tensor(y)
    records = [Record(f"{name} without demonstration {fold}", *data) for name, fold in pairs]
    rows = [record.state for record in records]
    left = [i for i, record in enumerate(records) if not record.ended]
    jobs = (delayed(score_fold)(clone(models[pairs[i][0]]), X, y, groups, pairs[i][1]) for i in left)
    with recorded(None):
        for i, row in zip(left, Parallel(n_jobs=n_jobs, return_as="generator")(jobs), strict=True):
            rows[i] = row
            records[i].keep(partial(dict, row), ended=True)
    return rows


def _timed_fit(
    model: CovarianceRegressor, X: Floats, y: Floats, groups: NDArray[np.intp]
) -> tuple[CovarianceRegressor, float]:
    start = time.perf_counter()
    return fit_by_demonstration(model, X, y, groups), time.perf_counter() - start


def empirical_covariances(X: Floats, y: Floats) -> tuple[Floats, Floats | None]:
    """Distinct rows of X, and the covariance of y at each (divisor K - 1), or None if a row is alone."""
    inputs, index, counts = np.unique(X, axis=0, return_inverse=True, return_counts=True)
    if counts.min() < 2:
        return inputs, None
    index = index.reshape(-1)
    covariances = np.empty((len(inputs), y.shape[1], y.shape[1]))
    order = np.argsort(index, kind="stable")
    for i, rows in enumerate(np.split(y[order], np.cumsum(counts)[:-1])):
        covariances[i] = np.cov(rows.T)
    return inputs, covariances


def _smallest_eigenvalue(covariance: Floats) -> float:
    scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return float(np.linalg.eigvalsh(covariance / scale[:, :, np.newaxis] / scale[:, np.newaxis]).min())
