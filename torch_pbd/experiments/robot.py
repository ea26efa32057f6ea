"""The robotic experiment of Section V: learn, reproduce, push twice (Figures 5 to 8), on any demonstrations."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sklearn.base import clone

from torch_pbd import plotting
from torch_pbd.checks import Floats
from torch_pbd.console import format_table, steps
from torch_pbd.control.controller import DMPController
from torch_pbd.control.primitive.outputs import in_si
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.stability.report import StabilityReport
from torch_pbd.data import Demonstrations, tunnel_center, tunnel_half_width
from torch_pbd.experiments.run_folder import FinishedFits, RunFolder, fit_once
from torch_pbd.plotting import parts, style

PUSHES = (0.2, 0.8)  # of the duration: 2 s and 8 s of the paper's 10 s
_PUSH_LENGTH = 0.08  # of the duration: 0.8 s
_N_ELLIPSES = 13  # one every 0.8 s of the paper's movement: more would cover each other
_MOST_OUTPUTS = 6  # panels of Figure 7 that a page holds


@dataclass(frozen=True)
class Run:
    """One controller on one task: what it plans, what pushes do to it, and what is guaranteed."""

    controller: DMPController
    schedule: Schedule
    rollout: Rollout
    unpushed: Rollout
    report: StabilityReport


def push_profile(time: Floats, duration: float, peak: float, n_outputs: int) -> Floats:
    """Forces (n, d) in N: pulses of a squared sine along the first output, early and late in the movement."""
    force = np.zeros((len(time), n_outputs))
    force[:, 0] = peak * sum(pulse(time / duration, centre) for centre in PUSHES)
    return force


def pulse(phase: Floats, centre: float) -> Floats:
    """Squared sine (n,) of height 1 around a phase: at the ends of a push it has neither force nor slope."""
    return np.sin(np.pi * np.clip((phase - centre) / _PUSH_LENGTH + 0.5, 0.0, 1.0)) ** 2


def run_controller(
    controller: DMPController,
    demonstrations: Demonstrations,
    *,
    peak: float = 5.0,
    rate: float = 1000.0,
    finished: FinishedFits | None = None,
) -> Run:
    """Fit, or take from the finished fits; plan, push and certify."""
    fitted, _ = fit_once(clone(controller), demonstrations, finished=finished)
    schedule = fitted.schedule(rate)
    force = push_profile(schedule.time, fitted.duration_, peak, fitted.n_outputs_)
    rollout = fitted.simulate(force=force, rate=rate)
    return Run(fitted, schedule, rollout, fitted.simulate(rate=rate), schedule.certify())


def push_row(name: str, run: Run) -> dict[str, Any]:
    """Row of the table: displacement by the two pushes, against the run without them, and stiffness there."""
    kind = style.kind_of(run.schedule.units, run.schedule.n_outputs)
    unit, scale = kind.unit, kind.scale
    time, stiffness = run.schedule.time, run.schedule.stiffness
    early, late = (int(np.searchsorted(time, centre * run.controller.duration_)) for centre in PUSHES)
    # Against the run without pushes: how far the robot lags behind by itself does not count.
    deviation = np.abs(run.rollout.position - run.unpushed.position)[:, 0]
    half = len(time) // 2
    first, second = scale * deviation[:half].max(), scale * deviation[half:].max()
    names = style.schedule_names(run.schedule)
    row = {"controller": name, f"early [{unit}]": float(first), f"late [{unit}]": float(second)}
    row |= {"ratio": float(first / second)}
    for output, label in list(enumerate(names))[:2]:
        row |= {f"K {label} early": float(stiffness[early, output, output])}
        row |= {f"K {label} late": float(stiffness[late, output, output])}
    recorded = run.controller.outputs_.units(run.controller.units_)
    row |= {f"path error [{unit}]": scale * in_si(recorded) * run.controller.reproduction_error_}
    return row


def run_robot(
    controllers: Mapping[str, DMPController],
    demonstrations: Demonstrations,
    folder: RunFolder,
    *,
    peak: float = 5.0,
    rate: float = 1000.0,
    in_tunnel: bool = False,
    metrics: str = "metrics",
) -> str:
    """Run each controller; writes figures, models, schedules, metrics, reports; returns table and reports as text."""
    table, rows, reports = [], [], []
    for name, controller in steps(controllers.items(), "controller", len(controllers)):
        run = run_controller(controller, demonstrations, peak=peak, rate=rate, finished=folder.finished)
        schedule, report = run.schedule, run.report
        rates = np.diff(schedule.stiffness, axis=0) / np.diff(schedule.time)[:, np.newaxis, np.newaxis]
        guarantees = {
            "stable": "yes" if report.stable else "NO",
            "margin": report.margin,
            "max speed": report.max_speed,
            "gain": report.gain,
            "environment": report.environment_stiffness,
            "max |dK/dt|": float(np.linalg.norm(rates, ord=2, axis=(1, 2)).max()),
        }
        table.append(push_row(name, run))
        rows.append(table[-1] | guarantees)
        reports.append(f"{name}: a movement of {schedule.duration:.3g} s\n{report}")
        folder.write_controller(
            name,
            run.controller,
            schedule,
            figure6_task=task_figure(run.controller, demonstrations, name, in_tunnel=in_tunnel),
            figure7_variability=variability_figure(run, demonstrations, name),
            figure8_pushes=pushes_figure(run, name),
        )
    folder.write_metrics(rows, metrics)
    folder.write_text("stability.txt", "\n\n".join(reports) + "\n")
    return "\n\n".join([format_table(table), *reports])


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
        covariance = controller.covariance_.predict_cov(controller.phase(some))[:, :2, :2]
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
    covariance = controller.covariance_.predict_cov(controller.phase(movements.time))
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
    plotting.plot_rollout(run.rollout, axes[:, 0], outputs=[0], names=names, unpushed=run.unpushed)
    axes[0, 0].set_title(name, fontsize=10)
    plotting.legend_below(figure, axes[:, 0])
    return figure
