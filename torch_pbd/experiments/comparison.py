"""Comparison of models on one data set or on recordings: fit to the data, and prediction of a demonstration."""

import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from joblib import Parallel, delayed
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from sklearn.base import clone

from torch_pbd import plotting
from torch_pbd.checks import Floats
from torch_pbd.console import format_table, steps
from torch_pbd.data import Demonstrations
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.experiments.run_folder import FinishedFits, RunFolder, fit_once
from torch_pbd.metrics import covariance_mse, mahalanobis_coverage, negative_log_likelihood, relative_frobenius_error
from torch_pbd.plotting import style

Align = Literal["auto", "none", "phase", "dtw"]
Input = Literal["time", "phase"]

_N_DRAWS = 500  # of a model's movements, of which 25 are beyond each end of the central 90 %
MOVEMENT_STATISTICS = ("deviation", "offset", "length", "largest")
"""Statistics of whole movements, of :func:`movement_statistics`."""
_LEGEND = {
    "MSE": "squared distance of Cholesky factors to the empirical covariances, units of the data (Table I)",
    "error to truth": "relative Frobenius error of the covariance",
    "fresh LL": "log-likelihood of the fresh demonstrations, nats per sample",
    "95 % of fresh": "share of their samples in the 95 % ellipse",
    "held-out LL": "log-likelihood of left-out demonstrations, nats per sample, its mean +- standard error and its "
    "median over the folds",
    "95 % holds": "share of left-out samples in the 95 % ellipse",
    "least eig.": "smallest eigenvalue of the predicted correlations",
    "joint LL": "log-likelihood of left-out demonstrations as a whole, nats each, of regressors as if samples were "
    "independent",
    "deviation": "share of these movements with a mean squared deviation in the central 90 % of draws",
    "offset": "the same of the time-averaged offset",
    "length": "of the path length",
    "largest": "of the largest deviation",
}


class Score(NamedTuple):
    """Model fitted to all the data, row of a table in which NaN is what is not known, and scores of the folds."""

    fitted: CovarianceRegressor
    row: dict[str, Any]
    folds: list[dict[str, float]]


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
) -> dict[str, Score]:
    """Fit clones of models to all the data, and without each of at most ``max_folds`` demonstrations, spread evenly.

    ``truth`` maps X (n, e) to the true covariances (n, d, d). What is left out is judged as a whole too if
    ``whole_movements``. Fits are kept in ``finished``, and not repeated if they are there.
    """
    inputs, empirical = empirical_covariances(X, y)
    true = None if truth is None else truth(inputs)
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
    scores = {}
    for name, (fitted, seconds) in fits.items():
        held_out = [next(results) for _ in folds]
        covariance, likelihoods = fitted.predict_cov(inputs), [fold["log_likelihood"] for fold in held_out]
        mean, error = mean_and_error(likelihoods)
        # Of covariances the smallest eigenvalue would tell the smallest unit: that of correlations tells singular ones.
        scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        correlation = covariance / scale[:, :, np.newaxis] / scale[:, np.newaxis]
        row = {
            "model": name,
            "MSE": np.nan if empirical is None else covariance_mse(covariance, empirical),  # that of Table I
            "error to truth": np.nan if true is None else relative_frobenius_error(covariance, true),
            "held-out LL": mean,
            "+-": error,
            "median": float(np.median(likelihoods)) if held_out else np.nan,
            "95 % holds": mean_and_error([fold["coverage"] for fold in held_out])[0],
            "folds": len(held_out),
            "least eig.": float(np.linalg.eigvalsh(correlation).min()),
            "fit [s]": seconds,
        }
        scores[name] = Score(fitted, row, held_out)
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
    """Fit without a demonstration, and score its rows, and by `judge_movement` all of it if ``whole``.

    "log_likelihood" is in nats per sample, "coverage" the share of samples within the 95 % ellipse.
    """
    left = groups == demonstration
    # Of this thread: what else runs on the machine does not count.
    start = time.thread_time()
    model, _ = fit_once(model, X[~left], y[~left], groups[~left], finished=finished)
    seconds = time.thread_time() - start
    test = X[left], y[left]
    # By rows, also of a model of movements, whose own score is that of the whole.
    row = {"log_likelihood": -negative_log_likelihood(model, *test), "coverage": mahalanobis_coverage(model, *test)}
    row["fit_seconds"] = seconds
    return row | judge_movement(model, *test) if whole else row


def movement_statistics(movements: Floats, mean: Floats, std: Floats) -> Floats:
    """Statistics of whole movements (s, n, d), by mean and std (n, d) of each step: (s, 4), as ``MOVEMENT_STATISTICS``.

    The mean squared deviation and the length of the time-averaged offset, in standard deviations of each step and
    output; the length of the path, in units of the outputs; the largest deviation, in standard deviations.
    """
    standardized = (movements - mean) / std
    offset = np.linalg.norm(standardized.mean(axis=1), axis=1)
    length = np.linalg.norm(np.diff(movements, axis=1), axis=2).sum(axis=1)
    columns = np.square(standardized).mean(axis=(1, 2)), offset, length, np.abs(standardized).max(axis=(1, 2))
    return np.stack(columns, axis=1)


def judge_movement(model: Any, X: ArrayLike, y: ArrayLike) -> dict[str, float]:
    """Joint log density, "joint", of one demonstration X (n, 1), y (n, d), in nats, and whether draws are like it.

    For each of ``MOVEMENT_STATISTICS`` there is 1.0 if the central 90 % of the draws have that of the demonstration
    among them, else 0.0.
    """
    mean, covariance = model.predict(X, return_cov=True)
    shape = covariance.shape[:2]
    if hasattr(model, "sample_demonstrations"):
        draws = model.sample_demonstrations(X, _N_DRAWS, 0)
        joint = float(model.score_demonstrations(X, y)[0])
    else:
        # Rows of a regressor are independent of each other: a movement is one draw of each.
        draws = model.sample_y(X, _N_DRAWS, 0).reshape(*shape, _N_DRAWS).transpose(2, 0, 1)
        joint = float(np.sum(model.log_likelihood(X, y)))
    moments = mean.reshape(shape), np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    low, high = np.quantile(movement_statistics(draws, *moments), [0.05, 0.95], axis=0)
    own = movement_statistics(np.reshape(y, (1, *shape)), *moments)[0]
    return {"joint": joint} | dict(zip(MOVEMENT_STATISTICS, ((low <= own) & (own <= high)).astype(float), strict=True))


def explained(rows: Sequence[Mapping[str, Any]], best: str) -> str:
    """Table of models, the one of the largest ``best`` with its margin, and a legend of the columns shown."""
    shown = [name for name in rows[0] if any(row[name] == row[name] for row in rows)]
    ranked = sorted((row for row in rows if row[best] == row[best]), key=lambda row: -row[best])
    parts = [format_table(rows), textwrap.fill("; ".join(f"{n}: {_LEGEND[n]}" for n in shown if n in _LEGEND), 80)]
    if len(ranked) > 1 and np.isfinite(gap := ranked[0][best] - ranked[1][best]):
        parts.insert(1, textwrap.fill(f"best {best}: {ranked[0]['model']}, {gap:.2f} above {ranked[1]['model']}", 80))
    return "\n\n".join(parts)


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


def prepare(demonstrations: Demonstrations, align: Align = "auto", n_steps: int | None = None) -> Demonstrations:
    """Demonstrations on one grid of ``n_steps`` points: "auto" aligns by phase what is not aligned already."""
    if align == "none" or (align == "auto" and demonstrations.is_aligned):
        return demonstrations if n_steps is None else demonstrations.resample(n_steps)
    return demonstrations.align("phase" if align == "auto" else align, n=n_steps)


def describe(demonstrations: Demonstrations, source: str) -> str:
    """One line on the data."""
    steps = sorted(set(demonstrations.n_steps))
    counts = (len(demonstrations), "demonstration"), (demonstrations.n_outputs, "output")
    demos, outputs = (f"{number} {noun}{'' if number == 1 else 's'}" for number, noun in counts)
    length = str(steps[0]) if len(steps) == 1 else f"{steps[0]} to {steps[-1]}"
    aligned = "aligned" if demonstrations.is_aligned else "not aligned"
    return f"{source}: {demos} of {length} samples, {outputs} ({', '.join(demonstrations.names)}), {aligned}"


def figure_of(model: CovarianceRegressor, demonstrations: Demonstrations, name: str, input: Input = "time") -> Figure:
    """Every output over the input with its band, beyond the data too; two outputs also in the plane."""
    n_outputs = demonstrations.n_outputs
    figure, plane, bands = style.panels(n_outputs, 2 if n_outputs == 2 else 0, Figure)
    X, y, _ = demonstrations.stack(input)
    plotting.plot_model_bands(model, X, y, bands)
    shown = demonstrations if input == "time" else demonstrations.align()
    for output, ax in enumerate(bands):
        plotting.plot_demonstrations(shown, [output], ax)
    for ax in plane:
        plotting.MovementDisplay.from_estimator(model, demonstrations, names=["model"], input=input, ax=ax)
    plotting.legend_below(figure, [*plane, *bands])
    figure.suptitle(name)
    return figure


def figure_of_recordings(demonstrations: Demonstrations, name: str) -> Figure:
    """Every output over the time, at most nine of them."""
    n = min(demonstrations.n_outputs, 9)
    figure, _, bands = style.panels(n, make=Figure)
    for output, ax in enumerate(bands):
        plotting.plot_demonstrations(demonstrations, [output], ax)
    figure.suptitle(name if n == demonstrations.n_outputs else f"{name}: 9 of {demonstrations.n_outputs} outputs")
    return figure


def run_recordings(
    models: Mapping[str, CovarianceRegressor],
    demonstrations: Demonstrations,
    folder: RunFolder,
    input: Input = "time",
    **options: Any,
) -> str:
    """Compare models by options of `compare_models`, write what was found, and return tables of rows and movements."""
    data = demonstrations.stack(input)
    scores = compare_models(models, *data, finished=folder.finished, whole_movements=True, **options)
    whole, metrics = [], []
    for name, score in scores.items():
        joint, error = mean_and_error([fold["joint"] for fold in score.folds])
        holds = {part: mean_and_error([fold[part] for fold in score.folds])[0] for part in MOVEMENT_STATISTICS}
        whole.append({"model": name, "joint LL": joint, "+- ": error, **holds})
        folds = {f"LL {i + 1}": fold["log_likelihood"] for i, fold in enumerate(score.folds)}
        metrics.append(score.row | whole[-1] | folds)
    folder.write_metrics(metrics)
    for name, score in scores.items():
        folder.write_fitted(name, score.fitted, figure_of(score.fitted, demonstrations, name, input))
    rows = [score.row for score in scores.values()]
    movements = [explained(whole, "joint LL")] if metrics[0]["folds"] else []
    return "\n\n".join([explained(rows, "held-out LL"), *movements])
