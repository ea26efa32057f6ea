"""Compare models on one data set: how well each repeats the data, and how well it predicts a demonstration."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone

from torch_pbd.checks import Floats
from torch_pbd.console import steps
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.experiments.resume import FinishedFits, fit_once
from torch_pbd.metrics import covariance_mse, mahalanobis_coverage, negative_log_likelihood, relative_frobenius_error
from torch_pbd.movement import judge_movement
from torch_pbd.movement.judging import MOVEMENT_STATISTICS


@dataclass(frozen=True)
class Score:
    """Result of one model on one data set."""

    model: str
    fitted: CovarianceRegressor
    """The model, fitted to all the data."""
    cholesky_mse: float
    """Error to the empirical covariances, squared units of y: the MSE of the paper's Table I. NaN if not aligned."""
    frobenius: float
    """Relative error to the true covariance, NaN where it is not known."""
    fold_log_likelihood: tuple[float, ...]
    """Log-likelihood of each demonstration left out, in nats per sample."""
    fold_coverage: tuple[float, ...]
    """Share of each demonstration left out that lies within the 95 % ellipse."""
    fit_seconds: float
    smallest_eigenvalue: float
    """Smallest eigenvalue of the predicted correlations, over the data."""
    fold_movement: tuple[dict[str, float], ...] = ()
    """Judgement of each demonstration left out as a whole, as :func:`~torch_pbd.movement.judge_movement` returns it."""

    def row(self) -> dict[str, Any]:
        """Row of a table."""
        folds = self.fold_log_likelihood
        mean, error = mean_and_error(folds)
        return {
            "model": self.model,
            "MSE": self.cholesky_mse,
            "error to truth": self.frobenius,
            "held-out LL": mean,
            "+-": error,
            "median": float(np.median(folds)) if folds else float("nan"),
            "95 % holds": mean_and_error(self.fold_coverage)[0],
            "folds": len(folds),
            "least eig.": self.smallest_eigenvalue,
            "fit [s]": self.fit_seconds,
        }

    def movement_row(self) -> dict[str, Any]:
        """Row of a table of whole movements."""
        joint, error = mean_and_error([fold["joint"] for fold in self.fold_movement])
        holds = {name: mean_and_error([fold[name] for fold in self.fold_movement])[0] for name in MOVEMENT_STATISTICS}
        return {"model": self.model, "joint LL": joint, "+- ": error, **holds}


def compare_models(
    models: Mapping[str, CovarianceRegressor],
    X: Floats,
    y: Floats,
    groups: NDArray[np.intp],
    *,
    truth: Callable[[Floats], Floats] | None = None,
    max_folds: int = 10,
    n_jobs: int | None = None,
    finished: FinishedFits | None = None,
    whole_movements: bool = False,
) -> list[Score]:
    """Fit every model on all the data, and once more without each of some demonstrations.

    Models are cloned; ``truth`` maps X (n, e) to the true covariances (n, d, d). At most ``max_folds`` demonstrations,
    spread evenly over all, are left out, each by itself, ``n_jobs`` of these fits at the same time; and judged as a
    whole too if ``whole_movements``. Fits are kept in ``finished``, and not repeated if they are there.
    """
    inputs, empirical = empirical_covariances(X, y)
    folds = left_out(groups, max_folds)
    # One by one, before the folds share the cores: these are the times that are reported.
    fits = {
        name: fit_once(clone(model), X, y, groups, finished=finished)
        for name, model in steps(models.items(), "fit", len(models))
    }
    jobs = (
        delayed(score_fold)(clone(model), X, y, groups, fold, finished, whole=whole_movements)
        for model in models.values()
        for fold in folds
    )
    results = steps(Parallel(n_jobs=n_jobs, return_as="generator")(jobs), "fold", len(models) * len(folds))
    scores = []
    for name, (fitted, seconds) in fits.items():
        covariance = fitted.predict_cov(inputs)
        # Of covariances the smallest eigenvalue would tell the smallest unit: that of correlations tells singular ones.
        scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        held_out = [next(results) for _ in folds]
        scores.append(
            Score(
                model=name,
                fitted=fitted,
                cholesky_mse=float("nan") if empirical is None else covariance_mse(covariance, empirical),
                frobenius=float("nan") if truth is None else relative_frobenius_error(covariance, truth(inputs)),
                fold_log_likelihood=tuple(row["log_likelihood"] for row in held_out),
                fold_coverage=tuple(row["coverage"] for row in held_out),
                fold_movement=tuple(held_out) if whole_movements else (),
                fit_seconds=seconds,
                smallest_eigenvalue=float(
                    np.linalg.eigvalsh(covariance / scale[:, :, np.newaxis] / scale[:, np.newaxis]).min()
                ),
            )
        )
    return scores


def left_out(groups: NDArray[np.intp], max_folds: int | None = None) -> NDArray[np.intp]:
    """Demonstrations to leave out, one by one: all, or some of them spread evenly; none where there is one only."""
    demos = np.unique(groups)
    n_folds = len(demos) if max_folds is None else min(max_folds, len(demos))
    if len(demos) < 2 or n_folds < 1:
        return demos[:0]
    return demos[np.unique(np.linspace(0, len(demos) - 1, n_folds).round().astype(int))]


def score_fold(
    model: CovarianceRegressor,
    X: Floats,
    y: Floats,
    groups: NDArray[np.intp],
    demonstration: int,
    finished: FinishedFits | None = None,
    *,
    whole: bool = False,
) -> dict[str, float]:
    """Fit without a demonstration, and score how well its rows are predicted, and if asked for it as a whole."""
    left = groups == demonstration
    # Of this thread: what else runs on the machine does not count.
    start = time.thread_time()
    model, _ = fit_once(model, X[~left], y[~left], groups[~left], finished=finished)
    seconds = time.thread_time() - start
    mean, covariance = model.predict(X[left], return_cov=True)
    coverage = mahalanobis_coverage(mean.reshape(len(mean), -1), covariance, y[left], level=0.95)
    # The score of a model of movements is that of the whole: here its rows are compared with those of regressors.
    is_movement = hasattr(model, "score_demonstrations")
    likelihood = -negative_log_likelihood(model, X[left], y[left]) if is_movement else model.score(X[left], y[left])
    row = {"log_likelihood": likelihood, "coverage": float(coverage), "fit_seconds": seconds}
    return row | judge_movement(model, X[left], y[left]) if whole else row


def empirical_covariances(X: Floats, y: Floats) -> tuple[Floats, Floats | None]:
    """Distinct rows of X, and the covariance of y at each (divisor K - 1), or None if a row is alone."""
    inputs, index, counts = np.unique(X, axis=0, return_inverse=True, return_counts=True)
    if counts.min() < 2:
        return inputs, None
    groups = np.split(y[np.argsort(index.ravel(), kind="stable")], np.cumsum(counts)[:-1])
    return inputs, np.stack([np.atleast_2d(np.cov(rows.T)) for rows in groups])


def mean_and_error(values: ArrayLike) -> tuple[float, float]:
    """Mean over the folds that have a result, and its standard error; NaN where those are too few."""
    known = np.asarray(values, dtype=float)
    known = known[~np.isnan(known)]
    mean = float(known.mean()) if len(known) else np.nan
    return mean, float(known.std(ddof=1) / len(known) ** 0.5) if len(known) > 1 else np.nan
