"""Schedules and loops for the tests of the real-time controller."""

import numpy as np
from scipy.linalg import expm

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
