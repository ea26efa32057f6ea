"""Figures 5 to 8 of the paper, for any controller and any demonstrations."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from torch_pbd.control.controller import DMPController
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.data import Demonstrations, tunnel_center, tunnel_half_width
from torch_pbd.labels import output_label
from torch_pbd.plotting import (
    DATA,
    EMPIRICAL,
    MODEL,
    plot_covariance_ellipses,
    plot_demonstrations,
    plot_pushes,
    plot_std_band,
    plot_stiffness,
)

_N_ELLIPSES = 13
_BOX = (1.6, 0.72)  # width and height in Figure 5
_MAX_OUTPUTS = 6  # that Figure 7 shows


def framework_figure() -> Figure:
    """How demonstrations become motion and gains: Figure 5."""
    figure, ax = plt.subplots(figsize=(9.6, 3.0), layout="constrained")
    ax.set_axis_off()
    ax.set(xlim=(0.0, 9.6), ylim=(0.0, 3.0))
    boxes = [
        ("demonstrations", (0.9, 1.5)),
        ("smoothing, derivatives\nforcing, eq. (18)", (2.85, 1.5)),
        ("Gaussian process:\nmean forcing, eq. (5)", (4.8, 2.4)),
        ("covariance model\neq. (8), (13)", (4.8, 0.6)),
        ("movement primitive\neq. (16), (17)", (6.75, 2.4)),
        ("stiffness, damping\neq. (19), (20)", (6.75, 0.6)),
        ("admittance, eq. (15)\nrobot", (8.7, 1.5)),
    ]
    for text, centre in boxes:
        _box(ax, text, centre)
    for start, stop in [(0, 1), (1, 2), (1, 3), (2, 4), (3, 5), (4, 6), (5, 6)]:
        (x, y), (to_x, to_y) = boxes[start][1], boxes[stop][1]
        vertical = stop == 6  # the last box is reached from above and below
        tail = (x + _BOX[0] / 2.0, y)
        head = (to_x, to_y + np.sign(y - to_y) * _BOX[1] / 2.0) if vertical else (to_x - _BOX[0] / 2.0, to_y)
        ax.add_patch(FancyArrowPatch(tail, head, arrowstyle="-|>", mutation_scale=14, color="black", zorder=2))
    return figure


def _box(ax: Axes, text: str, centre: tuple[float, float]) -> None:
    corner = centre[0] - _BOX[0] / 2.0, centre[1] - _BOX[1] / 2.0
    box = FancyBboxPatch(
        corner, *_BOX, boxstyle="round,pad=0,rounding_size=0.06", fc="white", ec=MODEL, lw=1.4, zorder=3
    )
    ax.add_patch(box)
    ax.text(*centre, text, ha="center", va="center", fontsize=8, zorder=4)


def task_figure(
    controller: DMPController, demonstrations: Demonstrations, name: str, *, in_tunnel: bool = False
) -> Figure:
    """Demonstrations, reproduction and, of positions, the inferred variability as ellipses: Figure 6."""
    figure, ax = plt.subplots(figsize=(5.2, 6.0), layout="constrained")
    if in_tunnel:
        draw_tunnel(ax)
    if demonstrations.n_outputs == 1:
        plot_demonstrations(demonstrations, [0], ax)
    else:
        plot_demonstrations(demonstrations, [0, 1], ax)
    time = np.linspace(0.0, controller.duration_, 400)
    path = controller.reproduction_.motion(time)[0]
    across, up = (time, path[:, 0]) if path.shape[1] == 1 else path[:, :2].T
    ax.plot(across, up, color=MODEL, lw=1.8, label="reproduction", zorder=4)
    if controller.variability == "position" and path.shape[1] > 1:
        some = np.linspace(0.0, controller.duration_, _N_ELLIPSES)
        covariance = controller.covariance_.predict_cov(controller.phase(some))[:, :2, :2]
        centres = controller.reproduction_.motion(some)[0][:, :2]
        plot_covariance_ellipses(centres, covariance, ax, color=EMPIRICAL, label="inferred: 2 sd")
    ax.set_title(name, fontsize=10)
    if not in_tunnel and path.shape[1] > 1:
        ax.set_aspect("equal", adjustable="datalim")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9)
    return figure


def draw_tunnel(ax: Axes) -> None:
    """Draw the walls of the tunnel task."""
    along = np.linspace(0.0, 0.6, 200)
    for side in (-1.0, 1.0):
        wall = tunnel_center(along) + side * tunnel_half_width(along)
        ax.plot(wall, along, color="black", lw=1.5, label="wall" if side > 0 else None)


def variability_figure(controller: DMPController, demonstrations: Demonstrations, name: str) -> Figure:
    """Empirical and inferred standard deviations of what the covariance is of, and the stiffness: Figure 7."""
    movements = controller.smooth(demonstrations, 200)
    varying = controller.varying(movements)
    n_shown = min(demonstrations.n_outputs, _MAX_OUTPUTS)
    figure, axes = plt.subplots(n_shown + 1, 1, figsize=(6.4, 1.9 * (n_shown + 1)), layout="constrained", sharex=True)
    covariance = controller.covariance_.predict_cov(controller.phase(movements.time))
    centre = varying.mean(axis=0)
    deviation, inferred = varying.std(axis=0, ddof=1), np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    for output, ax in enumerate(axes[:-1]):
        if controller.variability == "position":
            for number, (time, position) in enumerate(demonstrations):
                own = (time - time[0]) / (time[-1] - time[0]) * controller.duration_
                label = None if number else "demonstrations"
                ax.plot(own, position[:, output], color=DATA, lw=0.7, alpha=0.8, zorder=1, label=label)
        else:
            lines = ax.plot(movements.time, varying[:, :, output].T, color=DATA, lw=0.7, alpha=0.8, zorder=1)
            lines[0].set_label("demonstrations")
        plot_std_band(movements.time, centre[:, output], inferred[:, output], ax, label="mean, inferred 2 sd")
        for sign in (-2.0, 2.0):
            edge = centre[:, output] + sign * deviation[:, output]
            ax.plot(movements.time, edge, color=EMPIRICAL, lw=1.0, label="empirical 2 sd" if sign > 0 else None)
        label = output_label(demonstrations, output)
        ax.set_ylabel(label if controller.variability == "position" else f"forcing {demonstrations.names[output]}")
    plot_stiffness(controller.schedule(200.0 / controller.duration_), axes[-1])
    axes[-1].legend(fontsize=8, ncols=3)
    axes[0].set_title(name, fontsize=10)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    return figure


def pushes_figure(rollout: Rollout, unpushed: Rollout, schedule: Schedule, name: str) -> Figure:
    """Deviation, force and stiffness along the first output over time: Figure 8."""
    figure, axes = plt.subplots(3, 1, figsize=(6.4, 6.0), layout="constrained", sharex=True)
    plot_pushes(rollout, schedule, 0, axes, unpushed=unpushed)
    axes[0].set_title(name, fontsize=10)
    return figure
