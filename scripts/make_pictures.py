"""Make the pictures of README and documentation: `python scripts/make_pictures.py` writes those in docs/pictures."""

import runpy
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure

from torch_pbd import DMPController
from torch_pbd.control import RotationLimits, StiffnessLaw
from torch_pbd.data import make_handwriting_demonstrations, make_pose_demonstrations
from torch_pbd.plotting import DATA, FORCE, MODEL, ROBOT, legend_below, plot_covariance_ellipses, plot_demonstrations
from torch_pbd.plotting.poses import draw_pose_schedule
from torch_pbd.plotting.style import mark_ends, panels

FOLDER = Path(__file__).parents[1] / "docs" / "pictures"
DURATION, RATE = 6.0, 500.0  # s, Hz
PUSHES, LENGTH, PEAK = (1.0, 2.7), 0.6, 2.0  # s, s, N: where the strokes differ, and where they agree
METRES_PER_NEWTON = 0.01  # of the arrows
ELLIPSE = 1e-5  # m for each N/m: how large a stiffness is drawn


def learn():
    """Demonstrations, the schedule that was learned from them, and a run with two pushes along y."""
    strokes = make_handwriting_demonstrations("S", duration=DURATION, rate=25.0, timing=0.0, random_state=3)
    controller = DMPController().fit(strokes)
    schedule = controller.schedule(RATE)
    force = np.zeros_like(schedule.position)
    for start in PUSHES:
        u = np.clip((schedule.time - start) / LENGTH, 0.0, 1.0)
        force[:, 1] += PEAK * np.sin(np.pi * u) ** 2
    return strokes, schedule, controller.simulate(force=force, rate=RATE)


def overview(strokes, schedule, run):
    """Four panels: demonstrations, covariance, stiffness, push."""
    figure = Figure(figsize=(11.0, 4.3), layout="constrained")
    axes = figure.subplots(1, 4, sharex=True, sharey=True)
    rows = np.linspace(0, len(schedule) - 1, 25).round().astype(int)
    path = schedule.position
    titles = [
        "1. Six demonstrations\nof a letter",
        "2. Covariance: where\npeople agree, where not",
        "3. Stiffness: long ellipses\nare stiff directions",
        "4. The same push early\nand in the middle",
    ]
    for ax, title in zip(axes, titles, strict=True):
        plot_demonstrations(strokes, ["x", "y"], ax)
        ax.set_title(title, fontsize=11)
        ax.set_aspect("equal")
        ax.label_outer()
    for ax in axes[1:]:
        ax.plot(*path.T, color=MODEL, lw=1.5, label="learned: mean, 2 sd")
    mark_ends(axes[0], path)
    plot_covariance_ellipses(path[rows], schedule.covariance[rows], axes[1])
    # An ellipse of K^2 has the half axes K: a long one is a stiff direction.
    stiffness = schedule.stiffness[rows]
    plot_covariance_ellipses(
        path[rows],
        ELLIPSE**2 * stiffness @ stiffness,
        axes[2],
        n_std=1.0,
        color=ROBOT,
        label="stiffness, 1 cm = 1000 N/m",
    )
    axes[3].plot(*run.position.T, "--", color=ROBOT, lw=1.8, label="robot, pushed twice", zorder=5)
    for start in PUSHES:
        _arrow(axes[3], run, int((start + 0.5 * LENGTH) * RATE), f"push, {PEAK:g} N" if start == PUSHES[0] else None)
    legend_below(figure, list(axes), 7)
    return figure


def _arrow(ax, run, row, label=None):
    """The force on the robot, with its head where the robot is."""
    ax.quiver(
        *run.position[row], *(METRES_PER_NEWTON * run.force[row]), angles="xy", scale_units="xy", scale=1.0,
        pivot="tip", color=FORCE, width=0.02, zorder=6, label=label,
    )  # fmt: skip


def animation(strokes, schedule, run, n_frames=75):
    """The robot on its way, the force on it, and its deviation and stiffness over time."""
    figure = Figure(figsize=(6.4, 3.9), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.0, 1.3))
    plane, above, below = (figure.add_subplot(place) for place in (grid[:, 0], grid[0, 1], grid[1, 1]))
    deviation = 1e3 * np.linalg.norm(run.deviation, axis=1)
    stiffness = run.stiffness[:, 1, 1]
    rows = np.linspace(0, len(run.time) - 1, n_frames).round().astype(int)

    def draw(frame):
        row = rows[frame]
        for ax in (plane, above, below):
            ax.clear()
        plot_demonstrations(strokes, ["x", "y"], plane)
        plane.plot(*schedule.position.T, color=MODEL, lw=1.2)
        plane.plot(*run.position[: row + 1].T, color=ROBOT, lw=1.8)
        plane.plot(*run.position[row], "o", color=ROBOT, ms=8, zorder=5)
        gain = ELLIPSE**2 * run.stiffness[row] @ run.stiffness[row]
        plot_covariance_ellipses(run.position[None, row], gain[None], plane, n_std=1.0, color=ROBOT)
        if np.linalg.norm(run.force[row]) > 0.05:
            _arrow(plane, run, row)
        plane.set(xlim=(-0.015, 0.085), ylim=(-0.025, 0.135), aspect="equal", title="robot, and its stiffness")
        plane.set_xticks([0.0, 0.05])
        for ax, values, top, label in (
            (above, deviation, 1.15 * deviation.max(), "deviation [mm]"),
            (below, stiffness, 1100.0, "K along y [N/m]"),
        ):
            for start in PUSHES:
                ax.axvspan(start, start + LENGTH, color=FORCE, alpha=0.25, lw=0)
            ax.plot(run.time, values, color=DATA, lw=0.8)
            ax.plot(run.time[: row + 1], values[: row + 1], color=ROBOT, lw=1.8)
            ax.set(xlim=(0.0, DURATION), ylim=(0.0, top), ylabel=label)
        above.set_title(f"pushed with {PEAK:g} N, twice", color=FORCE)
        below.set_xlabel("time [s]")

    return FuncAnimation(figure, draw, frames=n_frames)


def poses():
    """A peg that is turned and put into a hole: what was shown and learned, and the stiffness of both blocks."""
    shown = make_pose_demonstrations(12, rate=25.0, random_state=0)
    law = StiffnessLaw(stiffness_min=300.0, stiffness_max=1500.0, rotation=RotationLimits(5.0, 60.0))
    schedule = DMPController(stiffness_law=law).fit(shown).schedule(100.0)
    figure, (space,), bands = panels(4, 3, lambda size: Figure(figsize=size, layout="constrained"))
    for path in shown.to_poses()[0]:
        space.plot(*path.T, color=DATA, lw=0.8)
    space.lines[0].set_label("demonstrations")
    draw_pose_schedule(schedule, space, bands)
    legend_below(figure, [space, *bands])
    return figure


def arm():
    """An arm that is pushed on a learned pose task: the figure of the gallery."""
    runpy.run_path(str(FOLDER.parents[1] / "examples" / "plot_16_arm.py"))
    return plt.gcf()


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    learned = learn()
    overview(*learned).savefig(FOLDER / "overview.png", dpi=110)
    poses().savefig(FOLDER / "pose.png", dpi=90)
    arm().savefig(FOLDER / "arm.png", dpi=90)
    animation(*learned).save(FOLDER / "push.gif", writer=PillowWriter(fps=12), dpi=90)
