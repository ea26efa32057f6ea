"""A point that must be met: the movement bends there as demonstrations make likely, and the robot is stiff there.

Where people were free the robot is soft. A point that is given leaves nothing free where it is, and little beside it:
the covariance, given the point, is small there, and what is small gets a high stiffness.
"""

import argparse
from pathlib import Path

import numpy as np
from reaching import DURATION, demonstrations

from torch_pbd import DMPController, TrajectoryRegressor
from torch_pbd.control import Schedule
from torch_pbd.plotting import (
    EMPIRICAL,
    MODEL,
    figure_grid,
    legend_below,
    plot_covariance_ellipses,
    plot_demonstrations,
)

RATE, AT = 100.0, 0.4 * DURATION  # Hz, s
ASIDE = np.array([0.0, 0.04])  # m, of the point from the path


def main() -> None:
    """Learn, and plan with a via point and without; print how it is met and the stiffness, and draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("runs/examples/via_point.png"))
    path = parser.parse_args().output
    controller = DMPController(TrajectoryRegressor()).fit(demonstrations())
    point = controller.predict([[AT]])[0] + ASIDE
    plain, bent = controller.schedule(RATE), controller.schedule(RATE, via=[(AT, point)])
    missed = 1e3 * np.linalg.norm(bent.position[round(AT * RATE)] - point)
    print(f"the point is missed by {missed:.3f} mm; stiffness along y without it, and with it:")
    for at in AT + np.array([-1.2, -0.6, -0.2, 0.0, 0.2, 0.6, 1.2]):
        gains = [schedule.stiffness[round(at * RATE), 1, 1] for schedule in (plain, bent)]
        print(f"  {at:3.1f} s  {gains[0]:4.0f} -> {gains[1]:4.0f} N/m")
    draw(plain, bent, point, path)


def draw(plain: Schedule, bent: Schedule, point: np.ndarray, path: Path) -> None:
    """The plane, with what is free of the movement, and stiffness over time."""
    figure, ((plane, over_time),) = figure_grid(1, 2, (10.0, 4.2))
    figure.set_layout_engine("constrained")
    plot_demonstrations(demonstrations(), [0, 1], plane)
    some = slice(10, None, 15)
    plot_covariance_ellipses(bent.position[some], bent.covariance[some], plane, label="2 sd")
    for schedule, color, label in ((plain, EMPIRICAL, "without the point"), (bent, MODEL, "through the point")):
        plane.plot(*schedule.position.T, color=color, lw=1.8, label=label)
        over_time.plot(schedule.time, schedule.stiffness[:, 1, 1], color=color, lw=1.8)
    plane.plot(*point, "o", color="black", ms=6, zorder=5, label="via point")
    over_time.axvline(AT, color="black", lw=0.8, ls=":")
    over_time.set(xlabel="time [s]", ylabel="stiffness along y [N/m]", ylim=(0.0, None))
    legend_below(figure, plane, 5)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    print(f"figure: {path}")


if __name__ == "__main__":
    main()
