"""Pushes of an arm under torque control in MuJoCo against the plant that foretells them, on two tasks.

``python scripts/benchmarks/arm_pushes.py FOLDER``, the folder of recordings, prints the table of `docs/arms.md`.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torch_pbd import DMPController, load_demonstrations, rotations
from torch_pbd.control import RotationLimits, Schedule, StiffnessLaw, simulate
from torch_pbd.data import make_pose_demonstrations
from torch_pbd.robots import HOME, inverse_kinematics, operational_inertia, panda
from torch_pbd.robots.mujoco import run

RATE = 1000.0
FORCE, TORQUE, DURATION = 12.0, 1.2, 0.7  # N, Nm, s


class Outcome(NamedTuple):
    """Of one push: peaks of the plant, errors of the arm's peak and path against it, and smallest damping ratios."""

    peak: tuple[float, float]  # m, rad
    peak_error: tuple[float, float]
    path_error: tuple[float, float]
    ratio: float  # where the arm is that is not pushed
    ratio_pushed: float


def peg(stiffness_min: float, *rotation: float) -> Schedule:
    """The made pose task, learned; limits of rotation in Nm/rad."""
    law = StiffnessLaw(stiffness_min, 1000.0, rotation=RotationLimits(*rotation))
    return DMPController(stiffness_law=law).fit(make_pose_demonstrations(random_state=0)).schedule(RATE)


def cube(folder: Path, stiffness_min: float) -> Schedule:
    """Recorded positions, learned, moved to where the arm reaches; the tool turns by 1.25 rad, with made gains."""
    demonstrations = load_demonstrations(folder / "kuka_cube_pick.npz")
    moved = DMPController(stiffness_law=StiffnessLaw(stiffness_min, 1000.0)).fit(demonstrations).schedule(RATE)
    moved = moved.transform([0.0, 0.0, 0.0, 1.0], [-0.08, 0.13, -0.1])
    s = moved.time / moved.duration
    share, speed = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5, (30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4) / moved.duration
    axes = rotations.matrix(rotations.exp(np.outer(s, [1.0, 0.5, -0.7])))
    levels = 5.0 + 22.5 * (1.0 - np.cos(2.0 * np.pi * s[:, None] + [0.5, 2.0, 3.0]))  # 5 to 50 Nm/rad
    gains, turn = np.zeros((len(s), 6, 6)), np.array([0.2, -0.3, 1.2])
    gains[:, :3, :3], gains[:, 3:, 3:] = moved.stiffness, axes * levels[:, None] @ axes.swapaxes(1, 2)
    velocity = np.hstack([moved.velocity, np.outer(speed, turn)])
    orientation = rotations.multiply(rotations.exp(np.outer(share, turn)), np.array([0.0, 1.0, 0.0, 0.0]))
    zero = np.zeros_like(gains)
    return Schedule(moved.time, moved.position, velocity, gains, gains, zero, moved.type1, orientation=orientation)


def pushed(schedule: Schedule, n_directions: int, random_state: int = 0) -> Iterator[Outcome]:
    """Pushes by force and torque at once, at four times, in random directions.

    What they do is compared: the plant of eq. (15) lags behind its schedule by M a, which the arm is fed.
    """
    model, random = panda(), np.random.default_rng(random_state)
    joints = inverse_kinematics(model, schedule.position, schedule.orientation, "tool", start=HOME)
    ready = schedule.with_inertia(operational_inertia(model, joints, "tool"))
    calm, calm_plant = run(model, ready, joints), _plant(ready, np.zeros_like(ready.velocity))
    for onset in np.array([0.05, 0.3, 0.5, 0.7]) * ready.duration:
        for _ in range(n_directions):
            push, turn = random.normal(size=(2, 3))
            wrench = np.concatenate([FORCE * push / np.linalg.norm(push), TORQUE * turn / np.linalg.norm(turn)])
            share = np.sin(np.pi * np.clip((ready.time - onset) / DURATION, 0.0, 1.0)) ** 2
            forces = np.outer(share, wrench)
            arm = run(model, ready, joints, wrench=forces)
            effects = arm.deviation - calm.deviation, _plant(ready, forces) - calm_plant
            yield _outcome(*effects, *(float(damping_ratios(ready, each.mass).min()) for each in (calm, arm)))


def _plant(schedule: Schedule, forces: Any) -> Any:
    return simulate(schedule, forces).deviation


def _outcome(arm: Any, plant: Any, *ratios: float) -> Outcome:
    peaks, other, paths = (
        np.array([np.linalg.norm(part, axis=1).max() for part in np.split(motion, 2, axis=1)])
        for motion in (arm, plant, arm - plant)
    )
    return Outcome(tuple(other), tuple(np.abs(peaks / other - 1.0)), tuple(paths / other), *ratios)


def damping_ratios(schedule: Schedule, mass: Any, every: int = 50) -> Any:
    """Smallest ratio (n,) of the modes of some rows, with the inertia (T, 6, 6) of where the arm really is."""
    inverse = np.linalg.inv(mass[::every])
    flow = np.zeros((len(inverse), 12, 12))
    flow[:, :6, 6:] = np.eye(6)
    flow[:, 6:, :6], flow[:, 6:, 6:] = -inverse @ schedule.stiffness[::every], -inverse @ schedule.damping[::every]
    roots = np.linalg.eigvals(flow)
    return (-roots.real / np.abs(roots)).min(axis=1)


def main(folder: Path) -> None:
    """Print the table."""
    print(
        "| task | stiffness_min | peaks | peak off by | position path | rotation path | damping ratio | pushed away |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for stiffness_min in (50.0, 200.0, 300.0):
        for name, schedule in (("made pose task", peg(stiffness_min)), ("kuka_cube_pick", cube(folder, stiffness_min))):
            found = list(pushed(schedule, n_directions=3))
            peaks = np.array([outcome.peak for outcome in found]).max(axis=0) * [1e3, 180.0 / np.pi]
            off = max(max(outcome.peak_error) for outcome in found)
            place, turn = np.array([outcome.path_error for outcome in found]).max(axis=0)
            print(
                f"| {name} | {stiffness_min:g} N/m | to {peaks[0]:.0f} mm, {peaks[1]:.0f} degrees | {off:.1%} | "
                f"{place:.1%} | {turn:.1%} | {min(outcome.ratio for outcome in found):.3f} | "
                f"{min(outcome.ratio_pushed for outcome in found):.3f} |"
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
