"""Simulation of a schedule on a robot, once under a given force or thousands of times under random pushes."""

from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.schedule.rows import even_step, refuse_other_units, warn_of_another_mass
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.rollout import Rollout, run_task, warn_if_far
from torch_pbd.control.simulation.rollouts import RolloutSummary, push_many
from torch_pbd.control.simulation.ticks import Task, block_length
from torch_pbd.files.memory import require_memory

Range = float | tuple[float, float]


def simulate(
    schedule: Schedule,
    force: ArrayLike | None = None,
    *,
    plant: AdmittancePlant | None = None,
    random_state: Any = None,
) -> Rollout:
    """Run a schedule, learned or loaded, on a simulated robot under a given external force.

    Each row of the schedule is a tick, which holds its gains and desired pose; a nearer last row lasts a tick too.

    Parameters
    ----------
    schedule : Schedule
        Motion and gains to follow, with evenly spaced rows, as ``schedule.resample(rate)`` makes them.
    force : array-like of shape (T, d), default=None
        External force in N, and for poses torque in Nm, in world axes, at each of the T rows; None is no force.
    plant : AdmittancePlant, default=None
        Simulated robot; None is ``AdmittancePlant(None)``, with the mass of the schedule, or 1 kg if it has none.
    random_state : int, RandomState or None, default=None
        Seed of the sensor's noise.

    Returns
    -------
    Rollout
        Run as NumPy arrays.

    Warns
    -----
    UserWarning
        If the plant's mass is not that which the schedule's damping was computed for.

    Raises
    ------
    ValueError
        If an argument is invalid, or the motion diverges.

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
    task = _task_of(schedule, plant)
    push = None if force is None else torch.tensor(checks.array(force, "force", task.velocity.shape))
    draw = checks.seed(random_state)
    sensor, generator = task.plant.sensor, None
    if sensor is not None and sensor.is_noisy:  # else nothing is drawn: None is the caller's global state
        generator = torch.Generator().manual_seed(int(draw.randint(2**31 - 1)))
    run = run_task(task, push, generator=generator).numpy()
    return replace(run, time=schedule.time[0] + run.time, units=schedule.units)


def simulate_many(
    schedule: Schedule,
    n_rollouts: int = 1000,
    *,
    plant: AdmittancePlant | None = None,
    peak: Range = 5.0,
    torque: Range = 0.0,
    duration: Range = 0.8,
    onset: tuple[float, float] | None = None,
    quantiles: tuple[float, ...] = (0.05, 0.5, 0.95),
    every: int = 1,
    random_state: Any = None,
) -> RolloutSummary:
    """Simulate many rollouts of a schedule, each with one random push.

    A push is a squared sine over its duration, in a direction uniform on the sphere of the position axes; for poses a
    torque in an independent direction acts at the same time. Pushes depend on ``random_state`` and not on the number of
    rows. Trajectories are not kept, so that memory grows with ``n_rollouts`` and not with their length.

    Parameters
    ----------
    schedule : Schedule
        Motion and gains to follow, with evenly spaced rows.
    n_rollouts : int, default=1000
        Number of rollouts R.
    plant : AdmittancePlant, default=None
        Simulated robot; None as in :func:`simulate`. With sensor or walls, many rollouts take five to ten times longer,
        with a filter ten to two hundred times.
    peak, torque, duration : float or (float, float), default=5.0, 0.0, 0.8
        Peak force of each push in N, its peak torque on a pose in Nm, and its duration in s. Pairs are drawn uniformly
        between both.
    onset : (float, float), default=None
        Start time of each push in s, drawn uniformly between both; None lets all pushes end within the schedule.
    quantiles : tuple of float, default=(0.05, 0.5, 0.95)
        Levels of the quantiles of the deviations at a tick, by linear interpolation.
    every : int, default=1
        Ticks between rows of quantiles. Sorting 10^5 rollouts takes about as long as simulating them.
    random_state : int, RandomState or None, default=None
        Seed of the pushes and of the sensor's noise.

    Warns
    -----
    UserWarning
        If the plant's mass is not that which the schedule's damping was computed for.

    Raises
    ------
    ValueError
        If an argument is invalid, or the rollouts do not fit in memory.
    """
    checks.count(n_rollouts, "n_rollouts")
    checks.count(every, "every")
    levels = checks.array(quantiles, "quantiles", ("n_quantiles",)).copy()
    checks.require((levels >= 0.0) & (levels <= 1.0), levels, "quantiles", "from 0 to 1")
    task = _task_of(schedule, plant)
    # Per rollout the block of deviations, its order, and some numbers; per tick the gains and their maps.
    d, remedy = schedule.n_outputs, "Simulate fewer at a time, with several seeds."
    needed = n_rollouts * (3 * block_length(d) + 10 * d + 16) + len(schedule) * (4 * d * d + 4 * d + len(levels))
    require_memory(8.0 * needed, what=f"n_rollouts={n_rollouts}", remedy=remedy)
    draw = checks.seed(random_state)
    begin, lasting, push = _draw_pushes(draw, n_rollouts, schedule, {"peak": peak, "torque": torque}, duration, onset)
    generators = (torch.Generator().manual_seed(int(draw.randint(2**31 - 1))) for _ in count())
    with torch.no_grad():
        pushes = torch.tensor(begin), torch.tensor(lasting), torch.tensor(push).mT.contiguous()
        tallies = push_many(task, pushes, generators, schedule.blocks, levels, every)
    shared = {"quantiles": levels, "onset": schedule.time[0] + begin, "duration": lasting}
    summary: Any = None
    for tally, units in reversed(list(zip(tallies, [schedule.units, "rad"], strict=False))):
        last_above = tally.last_above.numpy()
        returned = np.maximum(task.dt * (last_above + 1.0) - begin - lasting, 0.0)
        summary = RolloutSummary(
            time=schedule.time[::every],
            deviation=np.stack(tally.quantiles),
            peak_deviation=tally.squared_peak.sqrt().numpy(),
            return_time=np.where(last_above < len(schedule) - 1, returned, np.inf),
            push=push[:, tally.axes],
            rotation=summary,
            units=units,
            **shared,
        )
    if summary.rotation is not None:
        warn_if_far(float(summary.rotation.peak_deviation.max()))
    return summary


def _task_of(schedule: Schedule, plant: AdmittancePlant | None) -> Task:
    """Task of a plant that follows a schedule row by row; warns if its mass is not that of the schedule."""
    refuse_other_units(checks.instance(schedule, "schedule", Schedule))
    plant = checks.instance(plant, "plant", AdmittancePlant, optional=True) or AdmittancePlant(None)
    rows = (schedule.position, schedule.velocity, schedule.stiffness, schedule.damping)
    position, velocity, stiffness, damping = map(torch.tensor, rows)  # of copies: its own are read-only
    more = {"acceleration_desired": schedule.acceleration, "orientation_desired": schedule.orientation}
    given: dict[str, Any] = {name: torch.tensor(row) for name, row in more.items() if row is not None}
    given |= {"times": schedule.time, "dt": even_step(schedule.time), "own_mass": schedule.mass}
    task = plant.task(position, velocity, stiffness, damping, **given)
    if plant.mass is not None:
        warn_of_another_mass(schedule, task.mass.detach().numpy(), f"{plant} has another mass")
    return task


def _draw_pushes(
    draw: np.random.RandomState,
    n_rollouts: int,
    schedule: Schedule,
    peaks: dict[str, Range],
    duration: Range,
    onset: tuple[float, float] | None,
) -> tuple[Floats, Floats, Floats]:
    """Sorted onsets (R,) from the start of the schedule, durations (R,), and forces and torques (R, d)."""
    longest, (start, end) = schedule.duration, schedule.time[[0, -1]].tolist()
    lasting = np.asarray(draw.uniform(*_ends(duration, "duration", "s", above=0.0, most=longest), size=n_rollouts))
    share = draw.uniform(size=n_rollouts)
    if onset is None:
        begin = share * (longest - lasting)
    else:
        first, last = _ends(onset, "onset", "s", pair=True, least=start, most=end)
        begin = first + share * (last - first) - start
    units = zip(peaks.items(), ("N", "Nm"), strict=True)
    limits = [_ends(peak, name, unit, least=0.0, most=checks.LARGEST) for (name, peak), unit in units]
    if len(schedule.blocks) == 1 and limits[1] != (0.0, 0.0):
        raise checks.refusal(peaks["torque"], "torque", "0 for a schedule without orientation", unit="Nm")
    push = np.zeros((n_rollouts, schedule.n_outputs))
    for block, ends in zip(schedule.blocks, limits, strict=False):
        direction = draw.standard_normal((n_rollouts, block.stop - block.start))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        push[:, block] = np.asarray(draw.uniform(*ends, size=n_rollouts))[:, np.newaxis] * direction
    order = np.argsort(begin, kind="stable")  # rollouts of a chunk are pushed at about the same time
    return begin[order], lasting[order], push[order]


def _ends(limits: Range, name: str, unit: str, *, pair: bool = False, **bounds: Any) -> tuple[float, float]:
    """Ends of a range within bounds; one number is both, unless a pair is required."""
    low, high = checks.array(limits, name, (2,)) if pair or np.ndim(limits) else (limits, limits)
    low = checks.number(low, name, unit=unit, **bounds)
    return low, checks.number(high, name, unit=unit, **(bounds | {"least": low}))
