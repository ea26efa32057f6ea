"""A schedule on a simulated robot, once, under a given force."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.matrices import as_mass, mass_rows
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant, run_task
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.simulation.ticks import Task
from torch_pbd.exceptions import InvalidParameterError

# Of a tick: rounding of times; those of an hour at 1 kHz are off by 5e-10 of it in float64.
_UNEVEN = 1e-6
# Of a mass: a function of time is not linear between rows 10 ms apart, and a ratio that is off by half as much no harm.
_SAME_MASS = 1e-3


def simulate(
    schedule: Schedule,
    force: ArrayLike | None = None,
    *,
    plant: AdmittancePlant | None = None,
    random_state: Any = None,
) -> Rollout:
    """Run a schedule, as learned or from a file, on a simulated robot that a given force pushes.

    Each row of the schedule is a tick, which holds its gains and desired place; of a last row that is nearer, too.

    Parameters
    ----------
    schedule : Schedule
        Motion and gains to follow, whose rows are evenly spaced: else ``schedule.resample(rate)`` makes them so.
    force : array-like of shape (T, d), default=None
        External force in N, and of poses torque in Nm, in world axes, at each of the T rows; None is none.
    plant : AdmittancePlant, default=None
        None is ``AdmittancePlant(None)``, with the mass of the schedule, or 1 kg where it tells none.
    random_state : int, RandomState or None, default=None
        Of the noise of the plant's sensor.

    Returns
    -------
    Rollout
        Of arrays.

    Warns
    -----
    UserWarning
        If the plant's mass is not that which the schedule's damping was computed for.

    Raises
    ------
    ValueError
        If an argument is not as described, or the motion diverges.

    Examples
    --------
    >>> import numpy as np
    >>> from torch_pbd.control import Schedule, simulate
    >>> still, stiffness, damping = np.zeros((2000, 1)), np.full((2000, 1, 1), 50.0), np.full((2000, 1, 1), 14.0)
    >>> schedule = Schedule(np.arange(2000) / 1000, still, still, stiffness, damping, stiffness, np.zeros(2000))
    >>> run = simulate(schedule, np.full((2000, 1), 5.0))
    >>> round(float(run.deviation[-1, 0]), 4)  # 5 N on 50 N/m
    0.1
    """
    checks.instance(schedule, "schedule", Schedule)
    schedule = evenly(schedule, None, "take schedule.resample(rate)")
    shape = schedule.velocity.shape
    push = checks.array(np.zeros(shape) if force is None else force, "force", shape)
    draw = checks.seed(random_state)
    task = task_of(schedule, plant, float(schedule.time[1] - schedule.time[0]))
    noisy = task.sensor is not None and task.sensor.is_noisy  # else nothing is drawn: None is the caller's global state
    generator = torch.Generator().manual_seed(int(draw.randint(2**31 - 1))) if noisy else None
    run = run_task(task, torch.tensor(push), generator=generator).numpy()
    return replace(run, time=schedule.time[0] + run.time, units=schedule.units)


def evenly(schedule: Schedule, rate: float | None, remedy: str) -> Schedule:
    """Schedule whose rows are the ticks of a run, at a rate if one is given."""
    if rate is not None:
        return schedule.resample(rate)
    steps = np.diff(schedule.time)
    if np.ptp(steps[:-1]) > _UNEVEN * steps[0] or steps[-1] > (1.0 + _UNEVEN) * steps[0]:
        raise InvalidParameterError(
            f"schedule has steps from {steps.min():g} to {steps.max():g} s, must be evenly spaced: {remedy}."
        )
    return schedule


def task_of(schedule: Schedule, plant: AdmittancePlant | None, dt: float, device: str | None = None) -> Task:
    """Task of a plant that follows a schedule, row by row; warns where its mass is not that of the schedule."""
    plant = checks.instance(plant, "plant", AdmittancePlant, optional=True) or AdmittancePlant(None)
    rows = (schedule.position, schedule.velocity, schedule.stiffness, schedule.damping)
    motion = [torch.tensor(row, device=device) for row in rows]  # of copies: its own are read-only
    mass = plant.inertia(motion[2], schedule.time, schedule.mass)
    if schedule.mass is not None and plant.mass is not None:
        _compare(mass, mass_rows(as_mass(schedule.mass), motion[2]), plant, schedule)
    more = {"acceleration_desired": schedule.acceleration, "orientation_desired": schedule.orientation}
    given = {name: torch.tensor(row, device=device) for name, row in more.items() if row is not None}
    return plant.task(*motion, mass=mass, dt=dt, **given)


def _compare(mass: Tensor, own: Tensor, plant: AdmittancePlant, schedule: Schedule) -> None:
    """Warn where a mass is not that which the damping was computed for: by entries, in units of their axes."""
    root = own.diagonal(dim1=-2, dim2=-1).sqrt()
    off = float(((mass - own).abs() / (root.unsqueeze(-1) * root.unsqueeze(-2))).max())
    if off > _SAME_MASS:
        given: Any = plant.mass
        shown = "a function" if callable(given) else given if not np.ndim(given) else f"of shape {tuple(given.shape)}"
        met = f"mass={schedule.mass:g} kg" if isinstance(schedule.mass, float) else "that of the schedule"
        checks.warn(
            f"The plant's mass is {shown}, but damping_ratio was met for {met}, off by up to {off:.0%}: give both the "
            "same, or mass=None, which is the schedule's."
        )
