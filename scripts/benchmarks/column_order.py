"""What the order of the columns of positions, and the axes of their frame, change of the gains that are learned.

The first six and the first 25 demonstrations of recorded positions are learned as they are, with their columns reversed
and with their frame turned at random, and what is learned is turned back: ratio of the variances of each output along
the movement, smallest and largest, and change of the stiffness, largest and median. Table of docs/control.md.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np

from torch_pbd import DMPController, load_demonstrations
from torch_pbd.data import Demonstrations

DATA = Path(__file__).parents[3] / "shared" / "data"
SETS = ("adroit_door_palm", "kuka_cube_pick", "kuka_cshape_top")


def changes(name, n_demos, seed):
    """Rows of the table for a set."""
    shown = load_demonstrations(DATA / f"{name}.npz")
    times, positions = shown.times[:n_demos], shown.positions[:n_demos]

    def schedule(axes):
        turned = [position @ axes.T for position in positions]
        return DMPController().fit(Demonstrations(times, turned, units="m")).schedule(100.0)

    plain = schedule(np.eye(3))
    drawn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    for label, axes in (("columns reversed", np.eye(3)[::-1]), ("frame turned", drawn * np.linalg.det(drawn))):
        other = schedule(axes)
        covariance, stiffness = (axes.T @ part @ axes for part in (other.covariance, other.stiffness))
        ratio = np.diagonal(covariance, axis1=1, axis2=2) / np.diagonal(plain.covariance, axis1=1, axis2=2)
        change = np.linalg.norm(stiffness - plain.stiffness, 2, axis=(1, 2))
        cells = f"{ratio.min():.2f} to {ratio.max():.2f} | {change.max():.0f} | {np.median(change):.0f}"
        print(f"| {name} | {len(times)} | {label} | {cells} |")


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="of the turned frame")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print("| set | demonstrations | change | variances | stiffness, most [N/m] | median |\n|" + " --- |" * 6)
    for name in SETS:
        for n_demos in (6, 25):
            changes(name, n_demos, options.seed)


if __name__ == "__main__":
    main()
