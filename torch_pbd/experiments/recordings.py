"""Fit and compare models on recorded demonstrations."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from torch_pbd.data import Demonstrations
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.experiments.comparison import Score, compare_models
from torch_pbd.experiments.run_folder import RunFolder, check_names, format_table, slug
from torch_pbd.labels import output_label
from torch_pbd.plotting import MODEL, plot_covariance_ellipses, plot_demonstrations, plot_model_bands

Align = Literal["auto", "none", "phase", "dtw"]
Input = Literal["time", "phase"]


def prepare(demonstrations: Demonstrations, align: Align = "auto", n_steps: int | None = None) -> Demonstrations:
    """Bring demonstrations onto one grid: "auto" aligns by phase what is not aligned already.

    ``n_steps`` is the number of points of the grid; None keeps that of aligned data, and else takes the
    median length, at most 200.
    """
    if align == "none":
        return demonstrations if n_steps is None else demonstrations.resample(n_steps)
    if align == "auto":
        if not demonstrations.is_aligned:
            return demonstrations.align("phase", n=n_steps)
        return demonstrations if n_steps is None else demonstrations.resample(n_steps)
    return demonstrations.align(align, n=n_steps)


def describe(demonstrations: Demonstrations, source: str) -> str:
    """One line: what the data are."""
    steps = demonstrations.n_steps
    length = str(steps[0]) if len(set(steps)) == 1 else f"{min(steps)} to {max(steps)}"
    aligned = "aligned" if demonstrations.is_aligned else "not aligned"
    return (
        f"{source}: {_counted(len(demonstrations), 'demonstration')} of {length} samples, "
        f"{_counted(demonstrations.n_outputs, 'output')} "
        f"({', '.join(demonstrations.names)}), {aligned}"
    )


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def figure_of(model: CovarianceRegressor, demonstrations: Demonstrations, name: str, input: Input = "time") -> Figure:
    """Every output over the input with its band, beyond the data too; two outputs also in the plane."""
    n_outputs = demonstrations.n_outputs
    in_plane = n_outputs == 2
    n_panels = n_outputs + in_plane
    n_columns = min(3, n_panels)
    n_rows = -(-n_panels // n_columns)
    figure, grid = plt.subplots(
        n_rows, n_columns, figsize=(4.4 * n_columns, 3.6 * n_rows), layout="constrained", squeeze=False
    )
    axes = list(grid.flat)
    X, y, _ = demonstrations.stack(input)
    if input == "time":
        for output in range(n_outputs):
            plot_demonstrations(demonstrations, [output], axes[output])
    plot_model_bands(model, X, y, axes[:n_outputs])
    for output in range(n_outputs):
        axes[output].set_ylabel(output_label(demonstrations, output))
        if input == "phase":
            axes[output].set_xlabel("phase")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    if in_plane:
        plot_demonstrations(demonstrations, [0, 1], axes[n_outputs])
        query = np.linspace(X.min(), X.max(), 15)[:, np.newaxis]
        mean, covariance = model.predict(query, return_cov=True)
        plot_covariance_ellipses(mean, covariance, axes[n_outputs], color=MODEL)
        axes[n_outputs].set_aspect("equal", adjustable="datalim")
        axes[n_outputs].set_title("2 sd ellipses", fontsize=10)
    for ax in axes[n_panels:]:
        ax.set_visible(False)
    figure.suptitle(name)
    return figure


def score_row(score: Score) -> dict[str, Any]:
    """Row of the table, for a model on one data set."""
    return {
        "model": score.model,
        "MSE": score.cholesky_mse,
        "error to truth": score.frobenius,
        "held-out LL": score.log_likelihood,
        "+-": score.log_likelihood_error,
        "median": score.log_likelihood_median,
        "95 % holds": score.coverage,
        "folds": len(score.fold_log_likelihood),
        "least eig.": score.smallest_eigenvalue,
        "fit [s]": score.fit_seconds,
    }


def run_recordings(
    models: Mapping[str, CovarianceRegressor],
    demonstrations: Demonstrations,
    folder: RunFolder,
    *,
    input: Input = "time",
    max_folds: int = 10,
    n_jobs: int | None = None,
) -> str:
    """Compare models on demonstrations; writes metrics, folds, models and figures, returns the table."""
    check_names(models, "models")
    X, y, groups = demonstrations.stack(input)
    scores = compare_models(models, X, y, groups, max_folds=max_folds, n_jobs=n_jobs, finished=folder.finished)
    rows = [score_row(score) for score in scores]
    folds = {f"LL {i + 1}": [s.fold_log_likelihood[i] for s in scores] for i in range(rows[0]["folds"])}
    folder.write_metrics([row | {key: values[j] for key, values in folds.items()} for j, row in enumerate(rows)])
    for score in scores:
        write_fitted(score.fitted, demonstrations, folder, score.model, input)
    return format_table(rows)


def write_fitted(
    model: CovarianceRegressor, demonstrations: Demonstrations, folder: RunFolder, name: str, input: Input
) -> tuple[Path, Path]:
    """Write a fitted model and its figure."""
    figure = figure_of(model, demonstrations, name, input)
    paths = folder.write_model(model, slug(name)), folder.write_figure(figure, slug(name))
    plt.close(figure)
    return paths
