"""Random pushes by the thousand: how far they displace a robot that follows a schedule, and for how long."""

import copy
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.matrices import check_count, check_device, check_positive
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant
from torch_pbd.control.simulation.pushes import Range, check_not_negative, draw_pushes
from torch_pbd.control.simulation.rollouts import Pushes, Tally, march
from torch_pbd.control.simulation.run import check_plant, warn_of_mass
from torch_pbd.control.simulation.summary import RolloutSummary, quantiles_in
from torch_pbd.control.simulation.ticks import block_length
from torch_pbd.files.memory import require_memory

Floats = NDArray[np.float64]
Reference = Literal["desired", "undisturbed"]

_SHARE = 0.1  # of its own peak, to which a deviation returns
_UNEVEN = 1e-6  # of a tick: what rounding makes of evenly spaced times


def simulate_many(
    schedule: Schedule,
    n_rollouts: int = 1000,
    *,
    plant: AdmittancePlant | None = None,
    peak: Range = 5.0,
    duration: Range = 0.8,
    onset: tuple[float, float] | None = None,
    start_scale: float = 0.0,
    rate: float | None = None,
    reference: Reference = "desired",
    threshold: float | None = None,
    quantiles: tuple[float, ...] = (0.05, 0.5, 0.95),
    every: int = 1,
    random_state: Any = None,
    device: str | None = None,
) -> RolloutSummary:
    """Push a robot at random, many times over, while it follows a schedule.

    Each rollout gets one push: a squared sine over its duration, in a direction that is uniform on the sphere of
    the d axes. Trajectories are not kept, so that memory goes with ``n_rollouts`` and not with their length.
    The result depends on the arguments and ``random_state`` only; pushes do not depend on ``rate``.

    Parameters
    ----------
    schedule : Schedule
        What the robot follows, in m.
    n_rollouts : int, default=1000
        Number of rollouts R.
    plant : AdmittancePlant, default=None
        None is ``AdmittancePlant(mass)`` with the mass of the schedule, or 1 kg where it tells none. With a sensor or
        walls, thousands of rollouts take five to ten times longer; with a filter, ten to two hundred times.
    peak : float or (float, float), default=5.0
        Largest force of a push, N; of two numbers, uniform between them.
    duration : float or (float, float), default=0.8
        Of a push, s; of two numbers, uniform between them.
    onset : (float, float), default=None
        Time at which pushes begin, uniform between these, s; None is so that they end within the schedule.
    start_scale : float, default=0.0
        Standard deviation, in every axis, of the start around the desired one, m.
    rate : float, default=None
        Of the ticks, Hz; None takes the rows of the schedule, which must then be evenly spaced.
    reference : {"desired", "undisturbed"}, default="desired"
        Deviation from the desired position, or from where the robot would be without push, noise and spread of the
        start: it lags behind the desired position.
    threshold : float, default=None
        Below which a deviation is over, m; None is a tenth of the rollout's own peak.
    quantiles : tuple of float, default=(0.05, 0.5, 0.95)
        Of the deviations at a tick, by linear interpolation.
    every : int, default=1
        Ticks from one row of quantiles to the next. To order 10^5 rollouts takes about as long as to simulate them.
    random_state : int, RandomState or None, default=None
        Of pushes, starts and the sensor's noise.
    device : str, default=None
        Where to compute, as for torch; None is the CPU.

    Returns
    -------
    RolloutSummary

    Warns
    -----
    UserWarning
        If the plant's mass is not that which the schedule's damping was computed for.

    Raises
    ------
    ValueError
        If an argument is not as described, or the rollouts do not fit in memory.

    Examples
    --------
    >>> from torch_pbd.control import DMPController, simulate_many
    >>> from torch_pbd.data import make_tunnel_demonstrations
    >>> schedule = DMPController().fit(make_tunnel_demonstrations(random_state=0)).schedule()
    >>> summary = simulate_many(schedule, 200, random_state=0)
    >>> summary.deviation.shape, bool((summary.peak_deviation > 0.0).all())
    ((10001, 3), True)
    """
    checks.instance(schedule, "schedule", Schedule)
    check_device(device)
    check_count("n_rollouts", n_rollouts, 1)
    check_count("every", every, 1)
    levels = _check_choices(reference, threshold, quantiles)
    schedule = _evenly(schedule, rate)
    _check_memory(n_rollouts, schedule, len(levels))
    robot, draw = _robot(schedule, plant), checks.seed(random_state)
    begin, lasting, push = draw_pushes(draw, (n_rollouts, schedule.n_outputs), schedule, peak, duration, onset)
    offset = check_not_negative("start_scale", start_scale) * draw.standard_normal(push.shape)
    seeds = iter(draw.randint(2**31 - 1, size=n_rollouts).tolist())  # at most so many sensors

    def tensor(values: Floats) -> Tensor:
        return torch.tensor(values, dtype=torch.float64, device=device)

    motion = [tensor(part) for part in (schedule.position, schedule.velocity, schedule.stiffness, schedule.damping)]
    dt = float(schedule.time[1] - schedule.time[0])
    with torch.no_grad():
        task = robot.task(*motion, dt=dt)
        start = task.position[0] + tensor(offset), task.velocity[0].expand(n_rollouts, -1)
        pushes = Pushes(tensor(begin), tensor(lasting), tensor(push).mT.contiguous())
        blocks = march(task, robot, pushes, start, lambda: torch.Generator().manual_seed(next(seeds)))
        tally = Tally(n_rollouts, task.position, threshold=threshold, share=_SHARE)
        away = None if reference == "desired" else _undisturbed(robot, motion, dt)
        deviation = np.concatenate(list(quantiles_in(blocks, tally, levels, every, away)))
    squared_peak, squared_last, peak_tick, last_above = (
        values.cpu().numpy() for values in (tally.squared_peak, tally.squared_last, tally.peak_tick, tally.last_above)
    )
    returned = np.maximum(dt * (last_above + 1.0) - begin - lasting, 0.0)
    first = schedule.time[0]
    return RolloutSummary(
        schedule.time[::every],
        levels,
        deviation,
        peak_deviation=np.sqrt(squared_peak),
        peak_time=schedule.time[peak_tick.astype(np.intp)],
        return_time=np.where(last_above < len(schedule) - 1, returned, np.inf),
        final_deviation=np.sqrt(squared_last),
        onset=first + begin,
        duration=lasting,
        push=push,
    )


def _check_choices(reference: str, threshold: float | None, quantiles: tuple[float, ...]) -> Floats:
    if reference not in get_args(Reference):
        raise ValueError(f"reference is {reference!r}, must be one of {', '.join(map(repr, get_args(Reference)))}.")
    if threshold is not None:
        check_positive("threshold", check_not_negative("threshold", threshold), "m")
    levels = np.array(checks.real_floats(quantiles, "quantiles"))
    if levels.ndim != 1 or not len(levels) or not ((levels >= 0.0) & (levels <= 1.0)).all():
        raise ValueError(f"quantiles is {quantiles!r}, must be one or more numbers from 0 to 1.")
    return levels


def _check_memory(n_rollouts: int, schedule: Schedule, n_levels: int) -> None:
    """Per rollout the block of deviations, its order, and some numbers; per tick the gains and their maps."""
    d = schedule.n_outputs
    of_each = 3 * block_length(d) + 10 * d + 16
    of_ticks = len(schedule) * (4 * d * d + 4 * d + n_levels)
    require_memory(
        8.0 * (n_rollouts * of_each + of_ticks),
        what=f"n_rollouts={n_rollouts}",
        remedy="Simulate fewer at a time, with several seeds.",
    )


def _evenly(schedule: Schedule, rate: float | None) -> Schedule:
    if rate is not None:
        return schedule.resample(rate)
    steps = np.diff(schedule.time)
    if np.ptp(steps[:-1]) > _UNEVEN * steps[0] or steps[-1] > (1.0 + _UNEVEN) * steps[0]:
        raise ValueError(
            f"schedule has steps from {steps.min():g} to {steps.max():g} s, must be evenly spaced: give rate, that of "
            "the ticks in Hz."
        )
    return schedule


def _robot(schedule: Schedule, plant: AdmittancePlant | None) -> AdmittancePlant:
    if plant is None:
        return AdmittancePlant(schedule.mass or 1.0)
    check_plant(plant)
    if schedule.mass is not None:
        warn_of_mass(plant, schedule.mass, stacklevel=4)
    return plant


def _undisturbed(robot: AdmittancePlant, motion: list[Tensor], dt: float) -> Tensor:
    """Deviation (d, T) of one run without push and without noise."""
    silent = copy.copy(robot)
    if robot.sensor is not None:
        silent.sensor = replace(robot.sensor, noise_scale=0.0)
    return silent.simulate(*motion, dt=dt).deviation.mT
