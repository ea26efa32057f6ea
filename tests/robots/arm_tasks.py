"""A made pose task within reach of the arm, pushes, and what a run is compared with."""

import numpy as np
from scipy.linalg import expm

from torch_pbd import rotations
from torch_pbd.control import Schedule
from torch_pbd.robots import HOME, inverse_kinematics, operational_inertia, panda
from torch_pbd.robots.kinematics import arm

RATE = 1000.0


def made_schedule(duration=4.0, stiffness=(200.0, 1000.0), rotational=(20.0, 100.0), turn=(0.2, -0.3, 1.2), rate=RATE):
    """From HOME along an arc, the tool turning; both blocks have turned axes and change between the limits."""
    time = np.arange(round(duration * rate) + 1) / rate
    s = time / duration
    share = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
    speed = (30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4) / duration
    rise = (60.0 * s - 180.0 * s**2 + 120.0 * s**3) / duration**2
    start = arm(panda(), "tool").at(np.array(HOME))
    way = np.concatenate([[0.15, 0.2, -0.1], turn])
    axes = rotations.matrix(rotations.exp(np.outer(s, [1.0, 0.5, -0.7])))
    gains = np.zeros((len(time), 6, 6))
    for block, (low, high), phases in (
        (slice(3), stiffness, (0.0, 1.0, 2.5)),
        (slice(3, 6), rotational, (0.5, 2.0, 3.0)),
    ):
        shares = 0.5 * (1.0 - np.cos(2.0 * np.pi * s[:, None] + phases))
        gains[:, block, block] = axes * (low + (high - low) * shares)[:, None] @ axes.swapaxes(1, 2)
    return Schedule(
        time,
        start.position + np.outer(share, way[:3]),
        np.outer(speed, way),
        gains,
        gains,  # to be replaced by that of an inertia
        np.zeros_like(gains),
        np.zeros_like(time),
        acceleration=np.outer(rise, way),
        orientation=rotations.multiply(rotations.exp(np.outer(share, turn)), start.orientation),
    )


def on_arm(schedule, model, tool="tool", start=HOME):
    """The schedule with the arm's inertia, and joint angles along it."""
    joints = inverse_kinematics(model, schedule.position, schedule.orientation, tool, start=start)
    return schedule.with_inertia(operational_inertia(model, joints, tool)), joints


def push(schedule, onset, wrench, duration=0.8):
    """Squared sine of a wrench (6,)."""
    share = np.clip((schedule.time - onset) / duration, 0.0, 1.0)
    return np.outer(np.sin(np.pi * share) ** 2, wrench)


def random_wrench(rng, force=12.0, torque=1.2):
    """A force and a torque (6,) of these sizes."""
    push, turn = rng.normal(size=(2, 3))
    return np.concatenate([force * push / np.linalg.norm(push), torque * turn / np.linalg.norm(turn)])


def deviations(schedule, wrench, transport=True):
    """Deviation (T, 6) of ``M v' + D v + K e = f``, ``e' = v + omega_d x e``, held over ticks: written anew here."""
    state, found = np.zeros(12), np.empty_like(schedule.velocity)
    step = schedule.time[1] - schedule.time[0]
    for row in range(len(schedule)):
        found[row] = state[:6]
        omega = np.zeros((6, 6))
        omega[3:, 3:] = transport * np.cross(np.eye(3), schedule.velocity[row, 3:])
        inverse = np.linalg.inv(schedule.mass[row])
        flow = np.zeros((13, 13))
        flow[:6, :12] = np.hstack([omega, np.eye(6)])
        flow[6:12] = -inverse @ np.hstack([schedule.stiffness[row], schedule.damping[row], -wrench[row, :, None]])
        state = (expm(step * flow) @ np.append(state, 1.0))[:12]
    return found


def damping_ratios(schedule, mass, every=50):
    """Smallest ratio (n,) of the modes of a schedule's gains, with other inertias (T, 6, 6)."""
    smallest = []
    parts = (schedule.stiffness, schedule.damping, mass)
    for stiffness, damping, inertia in zip(*(part[::every] for part in parts), strict=True):
        inverse = np.linalg.inv(inertia)
        flow = np.block([[np.zeros((6, 6)), np.eye(6)], [-inverse @ stiffness, -inverse @ damping]])
        roots = np.linalg.eigvals(flow)
        smallest.append((-roots.real / np.abs(roots)).min())
    return np.array(smallest)


def compared(run, plant):
    """For each block: error of the peak and of the path, over the plant's peak."""
    found = []
    for block in (slice(3), slice(3, 6)):
        own, other = (np.linalg.norm(part[:, block], axis=1).max() for part in (run, plant))
        path = np.linalg.norm((run - plant)[:, block], axis=1).max()
        found.append((abs(own / other - 1.0), path / other))
    return found
