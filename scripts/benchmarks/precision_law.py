"""The law of minimal intervention against the linear one, at equal median stiffness, under pushes.

Expected cost ``integral of e' Sigma^-1 e + r f' M^-1 f`` of what half-sine pushes do (10 N for positions, 1 Nm for
rotations, 0.2 s, at even times and along every axis, so the mean over all directions), with Sigma of the recommended
regressor, a mass of 5 kg and 0.3 kg m^2, or with ``--varying`` one that changes along the movement as that of an arm
does, and the r whose precision law has the median stiffness of the linear law, of each block. Columns: the linear law;
the precision law within the same limits, damping ratios 1 and 1/sqrt(2); without limits; and LQT, which sees what is
ahead; all relative to the first. Deviations of 0.1 mm and 1 mrad count as none. Recordings without a unit of length are
brought to 0.5 m.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import torch
from scipy.linalg import expm

from torch_pbd import Demonstrations, DMPController
from torch_pbd.console import format_table
from torch_pbd.control import RotationLimits, StiffnessLaw, damping_from_stiffness, lqt
from torch_pbd.data import (
    load_demonstrations,
    make_handwriting_demonstrations,
    make_pose_demonstrations,
    make_tunnel_demonstrations,
)
from torch_pbd.data.units import LENGTHS

DATA = Path(__file__).parents[3] / "shared" / "data"
RECORDED = (
    "kuka_cube_pick", "kuka_cshape_top", "adroit_door_palm", "handwriting_fda", "letter_G", "letter_S", "letter_Z",
)  # fmt: skip
RATE, N_PUSHES, LASTING = 200.0, 20, 0.2  # Hz, pushes a movement, s
MASS, PEAK, LEAST = {False: 5.0, True: 0.3}, {False: 10.0, True: 1.0}, {False: 1e-4, True: 1e-3}  # True: of rotations


def tasks(data, names):
    """Name and demonstrations of every task."""
    made = {
        "made: tunnel": make_tunnel_demonstrations(6, rate=50.0, random_state=0),
        "made: handwriting": make_handwriting_demonstrations("S", 8, random_state=0),
        "made: poses": make_pose_demonstrations(8, rate=50.0, random_state=0),
    }
    yield from ((name, shown) for name, shown in made.items() if not names or name in names)
    for name in RECORDED if data.is_dir() else ():
        if not names or name in names:
            shown = load_demonstrations(data / f"{name}.npz")
            if shown.units is None or shown.units[0] not in LENGTHS:
                largest = max(float(np.ptp(position, axis=0).max()) for position in shown.positions)
                scaled = [0.5 / largest * position for position in shown.positions]
                shown = Demonstrations(shown.times, scaled, time_unit=shown.time_unit, units="m")
            yield name, shown


def along(shown):
    """Covariances (n, d, d) along the movement in m and rad, at ticks of RATE, and whether outputs are rotations."""
    controller = DMPController().fit(shown)
    schedule = controller.schedule(RATE, limits=None)
    turns = np.arange(schedule.n_outputs) >= schedule.position.shape[1]
    return torch.tensor(schedule.covariance + np.diag(np.where(turns, LEAST[True], LEAST[False]) ** 2)), turns


def inertia(n, turns, is_varying):
    """Mass (d, d), or that of each row: axes of 0.4 to 2.5 times as much, coupled by half and turning on the way."""
    mass = np.diag(np.where(turns, MASS[True], MASS[False]))
    if not is_varying:
        return torch.tensor(mass)
    d, share = len(turns), np.linspace(0.0, 1.0, n)[:, None]
    skew = np.triu(np.ones((d, d)), 1)
    axes = expm(0.8 * np.sin(2.0 * np.pi * share)[:, None] * (skew - skew.T) / d)
    axes[:, np.not_equal.outer(turns, turns)] *= 0.5
    spread = 2.5 ** np.sin(2.0 * np.pi * share + np.arange(d))
    root = np.sqrt(mass) @ (axes * np.sqrt(spread)[:, None])
    return torch.tensor(root @ root.swapaxes(1, 2))


def medians(stiffness, turns):
    """Median eigenvalue of the block of positions, and of that of rotations."""
    blocks = [np.flatnonzero(turns == kind) for kind in (False, True)]
    parts = [stiffness[:, block][:, :, block] for block in blocks if len(block)]
    return [float(torch.linalg.eigvalsh(part).median()) for part in parts]


def matched(law, covariance, mass, turns, wanted):
    """Law of the precision whose medians are those wanted, by bisection of the effort of each block."""
    low, high = np.full(len(wanted), 1e-12), np.full(len(wanted), 1e6)
    for _ in range(60):
        middle = np.sqrt(low * high)
        tried = StiffnessLaw(
            law.stiffness_min, law.stiffness_max, law.sigma_low, law.sigma_high, "sigma",
            kind="precision", rotation=law.rotation, effort=middle.tolist(),
        )  # fmt: skip
        too_stiff = np.array(medians(tried(covariance, mass), turns)) > wanted
        low, high = np.where(too_stiff, middle, low), np.where(too_stiff, high, middle)
    return tried, middle


def expected_cost(stiffness, damping, covariance, mass, effort, turns):
    """Mean cost of a push, over times and axes: gains and covariances held over ticks, the motion exact."""
    n, d = stiffness.shape[:2]
    light = torch.linalg.inv(mass)
    rate = torch.zeros(n, 3 * d, 3 * d, dtype=torch.float64)  # of deviation, velocity and a force that stays
    rate[:, :d, d : 2 * d] = torch.eye(d)
    rate[:, d : 2 * d] = torch.cat([-light @ stiffness, -light @ damping, light.expand(n, d, d)], dim=-1)
    step = torch.linalg.matrix_exp(rate / RATE)[:, : 2 * d]
    gains = torch.cat([stiffness, damping], dim=-1)
    stretch = torch.diag(torch.tensor(effort**0.5))
    weight = gains.mT @ (stretch @ light @ stretch) @ gains
    weight[:, :d, :d] += torch.linalg.inv(covariance)
    state = torch.zeros(2 * d, N_PUSHES * d, dtype=torch.float64)
    axes, starts = torch.eye(d).double().repeat(1, N_PUSHES), np.repeat(np.linspace(0.05, 0.85, N_PUSHES) * n / RATE, d)
    peaks, cost = np.where(turns, PEAK[True], PEAK[False])[:, None], 0.0
    for tick in range(n):
        share = (tick / RATE - starts) / LASTING
        force = axes * torch.tensor(peaks * np.where((share > 0) & (share < 1), np.sin(np.pi * share), 0.0))
        cost += float((state * (weight[tick] @ state)).sum()) / RATE
        state = step[tick] @ torch.cat([state, force])
    return cost / (N_PUSHES * d)


def row_of(name, shown, is_varying):
    """Row of the table: median stiffness, and the expected cost of each law."""
    covariance, turns = along(shown)
    rotation = RotationLimits() if turns.any() else None
    law = StiffnessLaw(rotation=rotation).fitted(covariance)
    mass = inertia(len(covariance), turns, is_varying)
    linear = law(covariance)
    wanted = medians(linear, turns)
    precise, efforts = matched(law, covariance, mass, turns, wanted)
    effort = efforts[turns.astype(int)]
    free = StiffnessLaw(
        1e-6, 1e9, 1.0, 2.0, "sigma", kind="precision", effort=efforts.tolist(),
        rotation=rotation and RotationLimits(1e-6, 1e9, 1.0, 2.0),
    )  # fmt: skip
    within, limitless = precise(covariance, mass), free(covariance, mass)
    laws = {
        "linear": (linear, damping_from_stiffness(linear, mass)),
        "precision": (within, damping_from_stiffness(within, mass)),
        "ratio 0.71": (within, damping_from_stiffness(within, mass, 0.5**0.5)),
        "no limits": (limitless, damping_from_stiffness(limitless, mass, 0.5**0.5)),
    }
    stretch = torch.tensor(effort**0.5)  # one effort for all, in units of each block's own
    laws["LQT"] = lqt(torch.outer(stretch, stretch) * covariance, mass, 1.0 / RATE, effort=1.0)
    costs = {key: expected_cost(*gains, covariance, mass, effort, turns) for key, gains in laws.items()}
    shares = {f"{key} [%]": f"{100.0 * cost / costs['linear']:.0f}" for key, cost in costs.items()}
    del shares["linear [%]"]
    return {"task": name, "median K": " and ".join(f"{k:.3g}" for k in wanted), "linear": costs["linear"], **shares}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--tasks", nargs="+", default=[])
    parser.add_argument("--varying", action="store_true", help="a mass that changes along the movement")
    given = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of units, and of recordings that were cut while moving
    rows = []
    for name, shown in tasks(given.data, given.tasks):
        rows.append(row_of(name, shown, given.varying))
    print(format_table(rows))
    lost = [row["task"] for row in rows if float(row["precision [%]"]) >= 100.0]
    print(f"\nThe precision law's cost is lower on {'every task tried' if not lost else 'all but ' + ', '.join(lost)}.")


if __name__ == "__main__":
    main()
