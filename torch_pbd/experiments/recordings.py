"""Fit and compare models on recorded demonstrations."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from torch_pbd import plotting
from torch_pbd.console import format_table
from torch_pbd.data import Demonstrations
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.experiments.comparison import compare_models, mean_and_error
from torch_pbd.experiments.run_folder import RunFolder, slug
from torch_pbd.movement.judging import MOVEMENT_STATISTICS
from torch_pbd.plotting import style

Align = Literal["auto", "none", "phase", "dtw"]
Input = Literal["time", "phase"]


def prepare(demonstrations: Demonstrations, align: Align = "auto", n_steps: int | None = None) -> Demonstrations:
    """Demonstrations on one grid: "auto" aligns by phase what is not aligned already.

    ``n_steps`` is the number of points of the grid; None keeps that of aligned data, and else takes the
    median length, at most 200.
    """
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
    figure, axes = _panels(n_outputs + (n_outputs == 2), 3.3)
    X, y, _ = demonstrations.stack(input)
    plotting.plot_model_bands(model, X, y, axes[:n_outputs])
    for output, ax in enumerate(axes[:n_outputs]):
        if input == "time":
            plotting.plot_demonstrations(demonstrations, [output], ax)
        else:
            ax.set(xlabel="phase", ylabel=style.output_label(demonstrations, output))
    plotting.legend_below(figure, axes[0])
    if n_outputs == 2:
        plotting.plot_demonstrations(demonstrations, [0, 1], axes[2])
        query = np.linspace(X.min(), X.max(), 15)[:, np.newaxis]
        plotting.plot_covariance_ellipses(*model.predict(query, return_cov=True), axes[2])
        style.equal_scales(axes[2])
        axes[2].set_title("2 sd ellipses", fontsize=10)
    figure.suptitle(name)
    return figure


def figure_of_recordings(demonstrations: Demonstrations, name: str) -> Figure:
    """Every output over the time, at most nine of them."""
    n = min(demonstrations.n_outputs, 9)
    figure, axes = _panels(n, 2.6)
    for output, ax in enumerate(axes):
        plotting.plot_demonstrations(demonstrations, [output], ax)
    figure.suptitle(name if n == demonstrations.n_outputs else f"{name}: 9 of {demonstrations.n_outputs} outputs")
    return figure


def _panels(n: int, height: float) -> tuple[Figure, list[Any]]:
    """Figure with n Axes in three columns, 4 by ``height`` inches each."""
    n_columns = min(3, n)
    n_rows = -(-n // n_columns)
    figure, grid = style.figure_grid(n_rows, n_columns, (4.0 * n_columns, height * n_rows))
    for ax in grid.flat[n:]:
        ax.set_visible(False)
    return figure, list(grid.flat[:n])


def run_recordings(
    models: Mapping[str, CovarianceRegressor],
    demonstrations: Demonstrations,
    folder: RunFolder,
    input: Input = "time",
    **options: Any,
) -> str:
    """Compare models on demonstrations, with options of ``compare_models``.

    Writes metrics, folds, models and figures; returns the tables, of rows and of whole movements, as text.
    """
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
        write_fitted(score.fitted, demonstrations, folder, name, input)
    rows = [score.row for score in scores.values()]
    return "\n\n".join(map(format_table, [rows, whole] if metrics[0]["folds"] else [rows]))


def write_fitted(
    model: CovarianceRegressor, demonstrations: Demonstrations, folder: RunFolder, name: str, input: Input
) -> tuple[Path, Path]:
    """Write a fitted model and its figure."""
    figure = figure_of(model, demonstrations, name, input)
    return folder.write_model(model, slug(name)), folder.write_figure(figure, slug(name))
