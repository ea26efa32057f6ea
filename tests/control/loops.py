"""Schedules and loops for the tests of the real-time controller."""

from dataclasses import replace

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from torch_pbd.control.realtime import RealTimeAdmittance
from torch_pbd.control.schedule import Schedule

MASS = 0.5

USED = {
    "stiffness": "stiffness",
    "damping": "damping",
    "position": "desired_position",
    "velocity": "desired_velocity",
}


def as_schedule(time, stiffness, damping, position=None, velocity=None, **labels):
    """Schedule of these rows, at rest at the origin where no motion is given."""
    still = np.zeros(np.shape(stiffness)[:2])
    motion = still if position is None else position, still if velocity is None else velocity
    return Schedule(time, *motion, stiffness, damping, stiffness, np.zeros(len(still)), **labels)


def make_schedule(d=2, *, rate=1000.0, duration=0.3, coupled=0.0, offset=0.0):
    """Stiffness of 50..1e4 N/m that turns and swings, on a moving path."""
    time = np.arange(round(duration * rate) + 1) / rate
    swing = np.sin(np.outer(20.0 * time, 1.0 + np.arange(d)) + np.arange(d))
    values = np.sqrt(50.0 * 1e4) * np.sqrt(1e4 / 50.0) ** swing
    axes = np.stack([expm(5.0 * t * (np.eye(d, k=1) - np.eye(d, k=-1))) for t in time])
    stiffness, damping = (axes * gain[:, None, :] @ axes.mT for gain in (values, 1.4 * np.sqrt(MASS * values)))
    damping = damping + coupled * np.diag(30.0 * np.arange(d))
    gains = {"stiffness": 0.5 * (stiffness + stiffness.mT), "damping": 0.5 * (damping + damping.mT)}
    position, velocity = 0.1 * np.cumsum(swing, axis=0) / rate, 0.1 * swing
    return as_schedule(offset + time, position=position, velocity=velocity, **gains)


def arm_inertia(time):
    """Inertia (n, 6, 6) of a tool on an arm, as in robots.md: 5 to 19 kg and 0.1 to 0.9 kg m2, coupled, that turns."""
    grows = 0.5 - 0.5 * np.cos(3.0 * time)
    values = np.array([5.0, 8.0, 19.0, 0.1, 0.3, 0.9]) * (1.0 + 0.3 * np.outer(grows, [1, -1, 1, -1, 1, -1]))
    factors = np.sqrt(values)[:, :, None] * np.eye(6)
    coupling = np.eye(6) + 0.2 * np.eye(6, k=-3) * np.array([0.3, -0.2, 0.4, 0.0, 0.0, 0.0])
    turns = Rotation.from_rotvec(np.outer(time, [0.3, 0.5, -0.4])).as_matrix()
    whole = np.zeros((len(time), 6, 6))
    whole[:, :3, :3] = whole[:, 3:, 3:] = turns
    factors = whole @ coupling @ factors
    return factors @ factors.mT


def pose_motion(time, size=0.1, angle=0.5):
    """Position, orientation, and twist of a tool that swings and turns; in closed form."""
    rates, phases = np.array([1.7, 2.3, 1.1]), np.array([0.0, 1.0, 2.0])
    swing = np.outer(time, rates) + phases
    position, velocity = size * np.sin(swing), size * rates * np.cos(swing)
    # R = Exp(a) Exp(b), of vectors along fixed axes: w = a' + Exp(a) b'.
    first, second = np.array([0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0])
    a, b = angle * np.sin(1.9 * time)[:, None] * first, angle * np.sin(2.7 * time + 0.5)[:, None] * second
    a_rate, b_rate = 1.9 * angle * np.cos(1.9 * time)[:, None] * first, 2.7 * angle * np.cos(2.7 * time + 0.5)
    turn = Rotation.from_rotvec(a)
    spin = a_rate + turn.apply(b_rate[:, None] * second)
    orientation = (turn * Rotation.from_rotvec(b)).as_quat(scalar_first=True)
    return position, orientation, np.concatenate([velocity, spin], axis=1)


def make_pose_schedule(duration=0.5, *, rate=1000.0, inertia=arm_inertia, coupled=0.0, still=False):
    """300..1500 N/m and 10..80 Nm/rad along axes that turn with the tool, critically damped for an inertia."""
    time = np.arange(round(duration * rate) + 1) / rate
    position, orientation, velocity = pose_motion(0.0 * time if still else time)
    velocity = velocity * (not still)
    turns = Rotation.from_quat(orientation, scalar_first=True).as_matrix()
    stiffness = np.zeros((len(time), 6, 6))
    swing = np.sin(np.outer(4.0 * time, [1.0, 1.3, 0.8]) + np.array([0.0, 2.0, 4.0]))
    stiffness[:, :3, :3] = turns @ (700.0 * 2.0 ** swing[:, :, None] * np.eye(3)) @ turns.mT
    stiffness[:, 3:, 3:] = turns @ (30.0 * 2.5 ** swing[:, :, None] * np.eye(3)) @ turns.mT
    stiffness = 0.5 * (stiffness + stiffness.mT)
    rows = Schedule(
        time, position, velocity, stiffness, stiffness, stiffness, 0.0 * time, orientation=orientation, units="m"
    )
    rows = rows.with_inertia(inertia(time) if callable(inertia) else inertia)
    return replace(rows, damping=rows.damping + coupled * np.diag([0.0, 5.0, 10.0, 0.0, 0.1, 0.3]))


def constant(stiffness, damping, *, position=0.0, velocity=0.0, duration=1.0):
    stiffness, damping = np.atleast_2d(stiffness), np.atleast_2d(damping)
    rows = {"stiffness": np.stack([stiffness] * 2), "damping": np.stack([damping] * 2)}
    motion = {"position": np.full((2, len(damping)), position), "velocity": np.full((2, len(damping)), velocity)}
    return as_schedule([0.0, duration], **rows, **motion)


def one_axis(**options):
    """100 N/m, 10 N s/m, 1 kg, at rest at 0."""
    controller = RealTimeAdmittance(constant(100.0, 10.0), **{"soft_start": 0.0, **options})
    controller.start(0.0)
    return controller


def run(controller, times, forces):
    """Positions and velocities after each tick, and statuses."""
    status = [controller.tick(now, force) for now, force in zip(times, forces, strict=True)]
    return np.array(controller.position), np.array(controller.velocity), status
