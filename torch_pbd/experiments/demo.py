"""The main job without arguments: six made demonstrations of the tunnel task, what the models learn, the robot."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from torch_pbd import plotting
from torch_pbd.console import format_table
from torch_pbd.control.controller import DMPController
from torch_pbd.data import Demonstrations, make_tunnel_demonstrations, save_demonstrations
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.experiments.comparison import compare_models
from torch_pbd.experiments.recordings import write_fitted
from torch_pbd.experiments.robot import draw_tunnel, run_robot
from torch_pbd.experiments.run_folder import RunFolder
from torch_pbd.metrics import mahalanobis_coverage
from torch_pbd.plotting import style

_N_FRESH = 300  # demonstrations that stand for the truth: their covariance is known to 8 %
_RATE = 25.0  # Hz; the movement has nothing of use above a few
_EVERY = 10  # of their samples are scored: those 40 ms apart are nearly copies


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
    times = demonstrations.times[0][::_EVERY, np.newaxis]
    positions = fresh[:, ::_EVERY].reshape(_N_FRESH * len(times), -1)
    rows = []
    for name, (model, row, _) in scores.items():
        mean, covariance = model.predict(times, return_cov=True)
        tiled = np.tile(mean, (_N_FRESH, 1)), np.tile(covariance, (_N_FRESH, 1, 1))
        row["95 % of fresh"] = mahalanobis_coverage(*tiled, positions)
        row["fresh LL"] = model.score(np.tile(times, (_N_FRESH, 1)), positions)
        columns = ("model", "MSE", "error to truth", "fresh LL", "95 % of fresh", "least eig.", "fit [s]")
        rows.append({column: row[column] for column in columns})
        write_fitted(model, demonstrations, folder, name, "time")
    folder.write_figure(
        _tunnel_figure({name: score.fitted for name, score in scores.items()}, demonstrations), "tunnel"
    )
    folder.write_metrics(rows)
    name, model = next(iter(models.items()))
    title = "A robot under its control, pushed with 5 N along x at 2 s and 8 s:\ndisplacement, and stiffness in N/m"
    pushed = run_robot({name: DMPController(model)}, demonstrations, folder, in_tunnel=True, metrics="pushes")
    return "\n\n".join([format_table(rows), title, pushed])


def _tunnel_figure(models: Mapping[str, CovarianceRegressor], demonstrations: Demonstrations) -> Figure:
    """Mean and covariance of each model in the tunnel: the paper's Figure 6."""
    figure, axes = style.figure_grid(1, len(models), (3.2 * len(models), 5.4), sharey=True)
    duration = demonstrations.times[0][-1]
    query, few = np.linspace(0.0, duration, 200)[:, np.newaxis], np.linspace(0.0, duration, 13)[:, np.newaxis]
    for ax, (name, model) in zip(axes[0], models.items(), strict=True):
        draw_tunnel(ax)
        plotting.plot_demonstrations(demonstrations, [0, 1], ax)
        # The spread along y is of micrometres: the ellipses show as lines across the path.
        plotting.plot_covariance_ellipses(*model.predict(few, return_cov=True), ax, label="model: 2 sd, every 0.8 s")
        ax.plot(*model.predict(query).T, color=plotting.MODEL, lw=1.5, label="model: mean")
        ax.set_title(name)
        ax.label_outer()
    plotting.legend_below(figure, axes[0, 0])
    return figure
