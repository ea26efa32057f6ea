"""The robotic experiment of Section V, Figures 5 to 8, on any demonstrations, of a tool that turns too."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sklearn.base import clone

from torch_pbd import plotting, rotations
from torch_pbd.checks import Floats
from torch_pbd.console import format_table, steps
from torch_pbd.control.controller import DMPController
from torch_pbd.data import Demonstrations, tunnel_center, tunnel_half_width
from torch_pbd.exceptions import ConfigError
from torch_pbd.experiments.pushes import KINDS, TOOL, Run, damping_ratio, guarantees, push, push_row, push_rows
from torch_pbd.experiments.run_folder import RunFolder, fit_once
from torch_pbd.plotting import parts, poses, style

_N_ELLIPSES = 13  # one every 0.8 s of the paper's movement: more would cover each other
_MOST_OUTPUTS = 6  # panels of Figure 7 that a page holds
_N_STEPS = 101  # steps at which demonstrations of poses are compared


def run_robot(
    controllers: Mapping[str, DMPController],
    demonstrations: Demonstrations,
    folder: RunFolder,
    *,
    in_tunnel: bool = False,
    metrics: str = "metrics",
    **options: Any,
) -> str:
    """Learn, push by options of `push` and certify with each controller; write all, and return tables and reports."""
    of_poses = demonstrations.rotation_reference is not None
    if of_poses:
        if demonstrations.n_outputs != 6:
            raise ConfigError(
                f"data: a pose has three positions and a rotation, not the outputs {demonstrations.names}."
            )
        axes = poses.draw_poses(demonstrations, poses.draw_recorded_poses, 3, Figure)
        folder.write_figure(axes[0].figure, "figure6_task")
    table: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    reports = []
    for name, controller in steps(controllers.items(), "controller", len(controllers)):
        fitted, _ = fit_once(clone(controller), demonstrations, finished=folder.finished)
        run = push(fitted, **options)
        inertia = ""
        if of_poses:
            rows += [row for kind in KINDS for row in push_rows(name, run, kind)]
            inertia = f"; {_inertia(run)}"
            figures = {
                "figure7_variability": pose_variability_figure(run, demonstrations, name),
                "figure8_pushes": pose_pushes_figure(run, name),
            }
        else:
            table.append(push_row(name, run))
            rows.append(table[-1] | guarantees(run))
            figures = {
                "figure6_task": task_figure(fitted, demonstrations, name, in_tunnel=in_tunnel),
                "figure7_variability": variability_figure(run, demonstrations, name),
                "figure8_pushes": pushes_figure(run, name),
            }
        reports.append(f"{name}: a movement of {run.schedule.duration:.3g} s{inertia}\n{run.report}")
        folder.write_controller(name, fitted, run.schedule, **figures)
    folder.write_metrics(rows, metrics)
    folder.write_text("stability.txt", "\n\n".join(reports) + "\n")
    tables = [_pose_table(rows, kind) for kind in KINDS] if of_poses else [format_table(table)]
    return "\n\n".join([*tables, *reports])


def _inertia(run: Run) -> str:
    mass = np.asarray(run.controller.mass_)
    low, high = (f"{mass if mass.ndim == 0 else mass[i, i]:.3g}" for i in (0, -1))
    if run.schedule is run.planned:
        return f"of {low} kg and {high} kg m^2"
    plain = damping_ratio(run.schedule, run.planned.damping)
    return f"a damping made for {low} kg and {high} kg m^2 would have a ratio of {plain:.2f} here"


def _pose_table(rows: Sequence[Mapping[str, Any]], kind: style.Kind) -> str:
    """Table of pushes of one kind."""
    units = {"early": kind.unit, "late": kind.unit, "K early": kind.stiffness_unit, "K late": kind.stiffness_unit}
    names = {key: f"{key} [{unit}]" for key, unit in units.items()} | {"axis": f"{kind.push} {kind.where}"}
    own = [row for row in rows if row["push"] == kind.push]
    hidden = ("push", "unit")  # which stand in the header
    return format_table([{names.get(key, key): row[key] for key in row if key not in hidden} for row in own])


_BOXES = (
    ("demonstrations", (0.9, 1.5)),
    ("smoothing, derivatives\nforcing, eq. (18)", (2.85, 1.5)),
    ("Gaussian process:\nmean forcing, eq. (5)", (4.8, 2.4)),
    ("covariance model\neq. (8), (13)", (4.8, 0.6)),
    ("movement primitive\neq. (16), (17)", (6.75, 2.4)),
    ("stiffness, damping\neq. (19), (20)", (6.75, 0.6)),
    ("admittance, eq. (15)\nrobot", (8.7, 1.5)),
)
_ARROWS = ((0, 1), (1, 2), (1, 3), (2, 4), (3, 5), (4, 6), (5, 6))


def framework_figure() -> Figure:
    """Way from demonstrations to motion and gains: Figure 5."""
    figure, ((ax,),) = style.figure_grid(1, 1, (9.6, 3.0))
    ax.set_axis_off()
    ax.set(xlim=(0.0, 9.6), ylim=(0.0, 3.0))
    frame = {"boxstyle": "round,pad=0.5", "fc": "white", "ec": plotting.MODEL, "lw": 1.4}
    boxes = [ax.text(*at, text, ha="center", va="center", fontsize=8, bbox=frame) for text, at in _BOXES]
    for start, stop in _ARROWS:
        ends = {"patchA": boxes[start].get_bbox_patch(), "patchB": boxes[stop].get_bbox_patch()}
        ax.annotate("", _BOXES[stop][1], _BOXES[start][1], arrowprops={"arrowstyle": "-|>", **ends})
    return figure


def task_figure(
    controller: DMPController, demonstrations: Demonstrations, name: str, *, in_tunnel: bool = False
) -> Figure:
    """Demonstrations, reproduction and, of positions, the inferred variability as ellipses: Figure 6."""
    figure, ((ax,),) = style.figure_grid(1, 1, (5.2, 6.0))
    if in_tunnel:
        draw_tunnel(ax)
    plotting.plot_demonstrations(demonstrations, range(min(demonstrations.n_outputs, 2)), ax)
    time = np.linspace(0.0, controller.duration_, 400)
    path = controller.reproduction_.motion(time)[0]
    in_plane = path.shape[1] > 1
    across, up = path[:, :2].T if in_plane else (time, path[:, 0])
    ax.plot(across, up, color=plotting.MODEL, lw=1.8, label="reproduction", zorder=4)
    if controller.variability == "position" and in_plane:
        some = np.linspace(0.0, controller.duration_, _N_ELLIPSES)
        covariance = controller.covariance_.predict_cov(controller.reproduction_.phase(some))[:, :2, :2]
        centres = controller.reproduction_.motion(some)[0][:, :2]
        plotting.plot_covariance_ellipses(centres, covariance, ax, label="inferred: 2 sd")
    ax.set_title(name, fontsize=10)
    if in_plane and not in_tunnel:
        style.equal_scales(ax)
    plotting.legend_below(figure, ax, 2)
    return figure


def draw_tunnel(ax: Axes) -> None:
    """Draw the walls of the tunnel task."""
    along = np.linspace(0.0, 0.6, 200)
    for side in (-1.0, 1.0):
        wall = tunnel_center(along) + side * tunnel_half_width(along)
        ax.plot(wall, along, color="black", lw=1.5, label="wall" if side > 0 else None)


def variability_figure(run: Run, demonstrations: Demonstrations, name: str) -> Figure:
    """Empirical and inferred standard deviations of positions or of forcing, and the stiffness: Figure 7."""
    controller = run.controller
    movements = controller.smooth(demonstrations, 200)
    varying = controller.varying(movements)
    in_position = controller.variability == "position"
    n_shown = min(demonstrations.n_outputs, _MOST_OUTPUTS)
    figure, grid = style.figure_grid(n_shown + 1, 1, (6.4, 1.9 * (n_shown + 1)), sharex=True)
    axes = grid[:, 0]
    covariance = controller.covariance_.predict_cov(controller.reproduction_.phase(movements.time))
    centre, deviation = varying.mean(axis=0), varying.std(axis=0, ddof=1)
    inferred = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    for output, ax in enumerate(axes[:-1]):
        curves = [(movements.time, one[:, output]) for one in varying]
        if in_position:  # as recorded, not as smoothed
            duration = controller.duration_
            curves = [((t - t[0]) / (t[-1] - t[0]) * duration, position[:, output]) for t, position in demonstrations]
        for time, curve in curves:
            ax.plot(time, curve, color=plotting.DATA, lw=0.7, alpha=0.8, zorder=1)
        ax.lines[0].set_label("demonstrations")
        plotting.plot_std_band(movements.time, centre[:, output], inferred[:, output], ax, label="mean, inferred 2 sd")
        parts.draw_edges(movements.time, centre[:, output], deviation[:, output], ax, "empirical 2 sd")
        name_of = demonstrations.names[output]
        ax.set_ylabel(style.output_label(demonstrations, output) if in_position else f"forcing {name_of}")
    plotting.plot_stiffness(run.schedule.resample(200.0 / controller.duration_), axes[-1])
    axes[0].set_title(name, fontsize=10)
    plotting.legend_below(figure, [axes[0], axes[-1]])
    return figure


def pushes_figure(run: Run, name: str) -> Figure:
    """Deviation, force and stiffness along the first output over time: Figure 8."""
    figure, axes = style.figure_grid(3, 1, (6.4, 6.0), sharex=True)
    names = style.schedule_names(run.schedule)
    plotting.plot_rollout(run.pushes["force"][0], axes[:, 0], outputs=[0], names=names, unpushed=run.unpushed)
    axes[0, 0].set_title(name, fontsize=10)
    plotting.legend_below(figure, axes[:, 0])
    return figure


def pose_variability_figure(run: Run, demonstrations: Demonstrations, name: str) -> Figure:
    """Planned path, deviations and empirical ones in principal axes, and stiffness there, of both blocks: Figure 7."""
    figure, (space,), bands = style.panels(4, 3, Figure)
    plotting.plot_demonstrations(demonstrations, [0, 1, 2], space)
    poses.draw_pose_schedule(run.schedule, space, bands)
    phase, covariances = pose_covariances(demonstrations)
    for kind, band in zip(KINDS, bands, strict=False):
        deviation = kind.scale * np.sqrt(np.linalg.eigvalsh(covariances[:, kind.outputs, kind.outputs]).clip(0.0))
        parts.plot_outputs(
            run.schedule.duration * phase, deviation, band, ["empirical", "_", "_"], [plotting.EMPIRICAL]
        )
    bands[0].set_title(name, fontsize=10)
    plotting.legend_below(figure, [space, *bands])
    return figure


def pose_covariances(demonstrations: Demonstrations) -> tuple[Floats, Floats]:
    """Phases (n,) and empirical covariances (n, 6, 6) of recorded poses there, at their mean, in world axes."""
    aligned = demonstrations.align(n=_N_STEPS)
    places, turns = map(np.array, aligned.to_poses())
    means = np.stack([rotations.mean(turns[:, i]) for i in range(_N_STEPS)])
    deviations = np.concatenate([places - places.mean(axis=0), rotations.between(means, turns)], axis=-1)
    return aligned.times[0], np.einsum("kni,knj->nij", deviations, deviations) / (len(demonstrations) - 1)


def pose_pushes_figure(run: Run, name: str) -> Figure:
    """Deviation, push and stiffness in each axis of the tool over time, of forces and of torques: Figure 8."""
    figure, grid = style.figure_grid(3, 2, (9.6, 6.6), sharex=True)
    time, labels = run.schedule.time, [f"tool {letter}" for letter in TOOL]
    for kind, (above, middle, below) in zip(KINDS, grid.T, strict=True):
        parts.plot_outputs(time, run.moved(kind), above, labels)
        above.set_ylabel(f"moved [{kind.unit}]")
        size = np.linalg.norm(run.pushes[kind.push][0].force, axis=1)
        middle.plot(time, size, color=plotting.FORCE, lw=1.5, label="push")
        middle.set_ylabel(f"{kind.push} [{kind.push_unit}]")
        parts.plot_outputs(time, run.along(run.schedule.stiffness, kind), below, labels)
        below.set(xlabel="time [s]", ylabel=f"stiffness [{kind.stiffness_unit}]", ylim=(0.0, None))
        above.set_title(f"{name}: pushed {kind.where} each axis", fontsize=10)
    plotting.legend_below(figure, grid[:, 0])
    return figure
