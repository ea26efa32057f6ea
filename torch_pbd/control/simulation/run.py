"""A schedule on a simulated robot."""

import warnings
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from torch_pbd import checks
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.rollout import Rollout


def simulate_schedule(
    schedule: Schedule,
    robot: AdmittancePlant,
    force: ArrayLike | None,
    rate: float,
    random_state: Any,
    *,
    mass: float,
) -> Rollout:
    """Run a schedule whose rows are ticks of ``1 / rate`` s under an external force (T, d) in N.

    Warns
    -----
    UserWarning
        If the robot's mass is not that which the schedule's damping was computed for.

    Raises
    ------
    ValueError
        If the force has not one row for each tick.
    """
    shape = schedule.position.shape
    push = np.zeros(shape) if force is None else checks.real_floats(force, "force")
    if push.shape != shape:
        raise ValueError(
            f"force has shape {push.shape}, must have shape {shape}: one row in N for each tick of "
            f"schedule(rate={rate:g})."
        )
    check_plant(robot)
    warn_of_mass(robot, mass, stacklevel=4)
    parts = (schedule.position, schedule.velocity, schedule.stiffness, schedule.damping, push)
    draw = checks.seed(random_state)
    noisy = getattr(robot.sensor, "noise_scale", 0.0) != 0.0  # else nothing is drawn: None is the caller's global state
    generator = torch.Generator().manual_seed(int(draw.randint(2**31 - 1))) if noisy else None
    return robot.simulate(*map(_tensor, parts), dt=1.0 / rate, generator=generator).numpy()


def check_plant(plant: Any) -> None:
    """Check that a plant is one."""
    if not isinstance(plant, AdmittancePlant):
        raise ValueError(f"plant is {plant!r}, must be an AdmittancePlant or None.")


def warn_of_mass(robot: AdmittancePlant, mass: float, *, stacklevel: int) -> None:
    """Warn where the robot's mass is not that which the damping of a schedule was computed for."""
    if np.ndim(robot.mass) or float(robot.mass) != float(mass):
        warnings.warn(
            f"The plant's mass is {robot.mass}, but damping_ratio was met for mass={mass:g} kg: give both the same.",
            stacklevel=stacklevel,
        )


def _tensor(values: NDArray[np.float64]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)
