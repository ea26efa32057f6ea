"""Models on synthetic data of known truth: the paper's simulation (Table I, Figures 1 to 3), and the demo's tunnel."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torch_pbd import plotting
from torch_pbd.checks import Floats
from torch_pbd.console import format_table, steps
from torch_pbd.control.controller import DMPController
from torch_pbd.data import Demonstrations, make_tunnel_demonstrations, save_demonstrations
from torch_pbd.data.synthetic import Reading, make_paper_simulation, paper_covariance, paper_mean
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.experiments.comparison import compare_models, empirical_covariances, explained, figure_of
from torch_pbd.experiments.robot import draw_tunnel, run_robot
from torch_pbd.experiments.run_folder import RunFolder
from torch_pbd.metrics import mahalanobis_coverage
from torch_pbd.plotting import style

# Table I: mean squared error on Cholesky entries, and seconds on "a standard laptop in Matlab".
PAPER_TABLE_1 = {"CD": (3.54e-13, 0.167), "WP": (0.0206, 8.64), "GMM 8": (1.05, 0.515), "GMM 5": (7.71, 0.237)}
_MEDIANS = ("MSE", "error to truth", "held-out LL", "fit [s]")
_BEYOND = 0.5  # margin around the inputs as a share of their range, so that the prior is visible
_LEAST_XI = -149.0  # eq. (14) has a covariance above xi = -150 only
_N_FRESH = 300  # demonstrations that stand for the truth: their covariance is known to 8 %
_RATE = 25.0  # Hz; the movement has nothing of use above a few
_EVERY = 10  # every tenth sample is scored, since those 40 ms apart are nearly copies


def run_simulation(
    models: Mapping[str, CovarianceRegressor],
    folder: RunFolder,
    readings: Sequence[Reading],
    *,
    n_seeds: int,
    n_inputs: int,
    n_demos: int,
    **options: Any,
) -> str:
    """Table I, as text, for each reading of eq. (14): medians over ``n_seeds`` seeds, and the paper's figures beside.

    Compares by options of `compare_models`; writes metrics, and of each model, fitted to the data of the first reading
    and seed 0, the file and the figure.
    """
    rows: list[dict[str, Any]] = []
    for reading in readings:
        found: dict[str, list[dict[str, Any]]] = {name: [] for name in models}
        for seed in steps(range(n_seeds), f"simulation ({reading})", n_seeds):
            data = make_paper_simulation(n_inputs, n_demos, reading=reading, random_state=seed)
            truth = partial(paper_covariance, reading=reading)
            scores = compare_models(models, *data, truth=truth, finished=folder.finished, **options)
            for name, score in scores.items():
                found[name].append(score.row)
            if not rows and not seed:
                first = data, scores
        for name, several in found.items():
            median = {column: float(np.median([row[column] for row in several])) for column in _MEDIANS}
            row = {"reading": reading, "model": name, "MSE": median.pop("MSE")}
            paper_mse, paper_seconds = PAPER_TABLE_1.get(name, (np.nan, np.nan))
            rows.append(row | {"paper's MSE": paper_mse} | median | {"paper's [s]": paper_seconds})
    folder.write_metrics(rows)
    (X, y, _), scores = first
    for name, score in scores.items():
        folder.write_fitted(name, score.fitted, _simulation_figure(score.fitted, X, y, name, readings[0]))
    return format_table(rows)


def _simulation_figure(model: CovarianceRegressor, X: Floats, y: Floats, name: str, reading: Reading) -> Figure:
    """One of Figures 1 to 3: the outputs over xi, and the covariances at the inputs, beyond the data too."""
    figure, ((*bands, plane),) = style.figure_grid(1, 3, (12.0, 4.2))

    def truth(xi: Floats) -> tuple[Floats, Floats]:
        variance = np.diagonal(paper_covariance(xi.clip(_LEAST_XI), reading=reading), axis1=1, axis2=2)
        return paper_mean(xi), np.where(xi > _LEAST_XI, np.sqrt(variance), np.nan)

    plotting.plot_model_bands(model, X, y, bands, beyond=_BEYOND, true_std=truth)
    for output, ax in enumerate(bands):
        ax.set(xlabel="input xi", ylabel=f"output y{output + 1}")
    inputs, empirical = empirical_covariances(X, y)
    true = paper_mean(inputs), paper_covariance(inputs, reading=reading)
    plotting.plot_covariance_ellipses(*true, plane, color=plotting.TRUTH, label="truth")
    if empirical is not None:
        centres = np.stack([y[X[:, 0] == xi].mean(axis=0) for xi in inputs[:, 0]])
        plotting.plot_covariance_ellipses(centres, empirical, plane, color=plotting.EMPIRICAL, label="empirical")
    plotting.plot_covariance_ellipses(*model.predict(inputs, return_cov=True), plane, label="model")
    plane.set(xlabel="output y1", ylabel="output y2", title="2 sd ellipses at the inputs")
    plotting.legend_below(figure, bands[0])
    figure.suptitle(f'{name} on eq. (14), reading "{reading}"')
    return figure


def run_demo(models: Mapping[str, CovarianceRegressor], folder: RunFolder, *, n_demos: int = 6, seed: int = 0) -> str:
    """Fit each model once, judge it by 300 fresh demonstrations, and push a robot that the first of them controls.

    No demonstration is left out: there are fresh ones to predict. Returns the tables and the stability report as text.
    """
    demonstrations = make_tunnel_demonstrations(n_demos, rate=_RATE, random_state=seed)
    save_demonstrations(demonstrations, folder.path / "demonstrations.csv")
    fresh = make_tunnel_demonstrations(_N_FRESH, rate=_RATE, random_state=seed + 1).to_array()
    true_covariance = np.einsum("kti,ktj->tij", *(2 * [fresh - fresh.mean(axis=0)])) / (_N_FRESH - 1)
    data = demonstrations.stack()
    scores = compare_models(models, *data, truth=lambda _: true_covariance, max_folds=0, finished=folder.finished)
    times = np.tile(demonstrations.times[0][::_EVERY], _N_FRESH)[:, np.newaxis]
    fresh_rows = times, fresh[:, ::_EVERY].reshape(len(times), -1)
    rows = []
    for name, (model, row, _) in scores.items():
        row |= {"95 % of fresh": mahalanobis_coverage(model, *fresh_rows), "fresh LL": model.score(*fresh_rows)}
        columns = ("model", "MSE", "error to truth", "fresh LL", "95 % of fresh", "least eig.", "fit [s]")
        rows.append({column: row[column] for column in columns})
        folder.write_fitted(name, model, figure_of(model, demonstrations, name))
    fitted = {name: score.fitted for name, score in scores.items()}
    folder.write_figure(_tunnel_figure(fitted, demonstrations), "tunnel")
    folder.write_metrics(rows)
    name, model = next(iter(models.items()))
    title = "A robot under its control, pushed with 5 N along x at 2 s and 8 s:\ndisplacement, and stiffness in N/m"
    pushed = run_robot({name: DMPController(model)}, demonstrations, folder, in_tunnel=True, metrics="pushes")
    return "\n\n".join([explained(rows, "fresh LL"), title, pushed])


def _tunnel_figure(models: Mapping[str, CovarianceRegressor], demonstrations: Demonstrations) -> Figure:
    """Mean and covariance of each model in the tunnel: the paper's Figure 6."""
    figure, axes = style.figure_grid(1, len(models), (2.6 * len(models), 5.6), sharey=True)
    for ax, (name, model) in zip(axes[0], models.items(), strict=True):
        draw_tunnel(ax)
        # The spread along y is of micrometres: the ellipses show as lines across the path.
        plotting.MovementDisplay.from_estimator(model, demonstrations, names=["model"], ax=ax)
        ax.set_title(name)
        ax.label_outer()
    plotting.legend_below(figure, axes[0, 0])
    return figure
