"""A robot is pushed out of its way halfway: the rest of its movement is what people did who came by there.

Such a push is no error to undo at once. ``condition`` on where the robot is gives the movement that demonstrations make
likely from there, and how free it is: stiff at first, as soft as before farther on.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from reaching import DURATION, demonstrations

from torch_pbd import DMPController, TrajectoryRegressor
from torch_pbd.control import Schedule
from torch_pbd.plotting import EMPIRICAL, MODEL, figure_grid, legend_below, plot_demonstrations, plot_std_band

RATE, HALF = 100.0, DURATION / 2.0  # Hz, s
PUSH = np.array([0.0, 0.05])  # m


def main() -> None:
    """Learn, push, plan anew; print how far the robot is from its first plan, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("runs/examples/pushed.png"))
    path = parser.parse_args().output
    controller = DMPController(TrajectoryRegressor()).fit(demonstrations())
    plan, pushed = controller.schedule(RATE), controller.predict([[HALF]]) + PUSH
    start = time.perf_counter()
    replanned = controller.condition([HALF], pushed)
    print(f"planned anew in {1e3 * (time.perf_counter() - start):.1f} ms; from the first plan, and stiffness, along y:")
    rest = replanned.schedule(RATE)
    for at in np.linspace(HALF, DURATION, 5):
        row = round(at * RATE)
        away = 1e3 * (rest.position - plan.position)[row, 1]
        print(
            f"  {at:3.1f} s  {away:5.1f} mm  {plan.stiffness[row, 1, 1]:4.0f} -> {rest.stiffness[row, 1, 1]:4.0f} N/m"
        )
    draw(plan, rest, pushed[0], path)


def draw(plan: Schedule, rest: Schedule, pushed: np.ndarray, path: Path) -> None:
    """The plane, and y over time with what is free of it."""
    figure, ((plane, over_time),) = figure_grid(1, 2, (10.0, 4.2))
    figure.set_layout_engine("constrained")
    after = plan.time >= HALF
    plot_demonstrations(demonstrations(), [0, 1], plane)
    plot_demonstrations(demonstrations(), [1], over_time)
    plane.plot(*plan.position.T, color=EMPIRICAL, lw=1.5, label="first plan")
    over_time.plot(plan.time, plan.position[:, 1], color=EMPIRICAL, lw=1.5)
    plane.plot(*rest.position[after].T, color=MODEL, lw=2.0, label="planned anew, 2 sd")
    plot_std_band(rest.time[after], rest.position[after, 1], np.sqrt(rest.covariance[after, 1, 1]), over_time)
    arrow = {"arrowstyle": "-|>", "color": "black", "lw": 1.5, "shrinkA": 0, "shrinkB": 0}
    for ax, at in ((plane, pushed[0]), (over_time, HALF)):
        ax.annotate("", (at, pushed[1]), (at, pushed[1] - PUSH[1]), arrowprops=arrow)
        ax.annotate("pushed here", (at, pushed[1]), (-6, 2), textcoords="offset points", ha="right")
    legend_below(figure, plane)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    print(f"figure: {path}")


if __name__ == "__main__":
    main()
