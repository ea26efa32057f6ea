"""The main job without arguments: six made demonstrations of the tunnel task, what the models learn, the robot."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from torch_pbd.control.controller import DMPController
from torch_pbd.data import Demonstrations, make_tunnel_demonstrations
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.experiments.comparison import compare_models
from torch_pbd.experiments.recordings import score_row, write_fitted
from torch_pbd.experiments.robot import run_robot
from torch_pbd.experiments.robot_figures import draw_tunnel
from torch_pbd.experiments.run_folder import RunFolder, check_names, format_table
from torch_pbd.metrics import mahalanobis_coverage
from torch_pbd.plotting import MODEL, plot_covariance_ellipses, plot_demonstrations

_N_FRESH = 300  # demonstrations that stand for the truth
_RATE = 25.0  # Hz; the movement has nothing of use above a few


def run_demo(models: Mapping[str, CovarianceRegressor], folder: RunFolder, *, n_demos: int = 6, seed: int = 0) -> str:
    """Fit the models, judge them by 300 fresh demonstrations, and push a robot that the first of them controls.

    Returns the tables and the stability report as text.
    """
    check_names(models, "models")
    demonstrations = make_tunnel_demonstrations(n_demos, rate=_RATE, random_state=seed)
    fresh = make_tunnel_demonstrations(_N_FRESH, rate=_RATE, random_state=seed + 1).to_array()
    true_covariance = np.einsum("kti,ktj->tij", *(2 * [fresh - fresh.mean(axis=0)])) / (_N_FRESH - 1)
    X, y, groups = demonstrations.stack()
    scores = compare_models(models, X, y, groups, truth=lambda _: true_covariance, finished=folder.finished)
    rows = []
    for score in scores:
        rows.append(score_row(score) | {"95 % of fresh": _coverage(score.fitted, demonstrations, fresh)})
        write_fitted(score.fitted, demonstrations, folder, score.model, "time")
    figure = _tunnel_figure({score.model: score.fitted for score in scores}, demonstrations)
    folder.write_figure(figure, "tunnel")
    plt.close(figure)
    folder.write_metrics(rows)
    name, model = next(iter(models.items()))
    title = "A robot under its control, pushed with 5 N along x at 2 s and 8 s: displacement, and stiffness in N/m"
    pushed = run_robot({name: DMPController(model)}, demonstrations, folder, in_tunnel=True, metrics="pushes")
    return "\n\n".join([format_table(rows), title, pushed])


def _coverage(model: CovarianceRegressor, demonstrations: Demonstrations, fresh: Any) -> float:
    mean, covariance = model.predict(demonstrations.times[0][:, np.newaxis], return_cov=True)
    return float(np.mean([mahalanobis_coverage(mean, covariance, demo, level=0.95) for demo in fresh]))


def _tunnel_figure(models: Mapping[str, CovarianceRegressor], demonstrations: Demonstrations) -> Figure:
    """What each model learned, in the tunnel: the paper's Figure 6."""
    figure, axes = plt.subplots(
        1, len(models), figsize=(3.6 * len(models), 6), layout="constrained", sharey=True, squeeze=False
    )
    duration = demonstrations.times[0][-1]
    query = np.linspace(0.0, duration, 13)[:, np.newaxis]
    for ax, (name, model) in zip(axes[0], models.items(), strict=True):
        draw_tunnel(ax)
        plot_demonstrations(demonstrations, [0, 1], ax)
        mean, covariance = model.predict(query, return_cov=True)
        # The spread along y is of micrometres: the ellipses show as lines across the path.
        plot_covariance_ellipses(mean, covariance, ax, label="model: 2 sd, every 0.8 s")
        path = model.predict(np.linspace(0.0, duration, 200)[:, np.newaxis])
        ax.plot(path[:, 0], path[:, 1], color=MODEL, lw=1.5, label="model: mean")
        ax.set_title(name)
    for ax in axes[0, 1:]:
        ax.set_ylabel("")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    return figure
