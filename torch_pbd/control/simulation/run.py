"""A schedule on a simulated robot: once under a given force, or thousands of times under random pushes."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant, run_task
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.simulation.rollouts import Pushes, RolloutSummary, Tally, quantiles_in, simulate_blocks
from torch_pbd.control.simulation.ticks import Task, block_length
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.files.memory import require_memory

Reference = Literal["desired", "undisturbed"]
Range = float | tuple[float, float]

# A deviation has returned at a tenth of its own peak: by then a critically damped one takes four time constants.
_SHARE = 0.1
# Of a tick: rounding of times; those of an hour at 1 kHz are off by 5e-10 of it in float64.
_UNEVEN = 1e-6


def simulate_schedule(
    schedule: Schedule, plant: AdmittancePlant | None, force: ArrayLike | None, rate: float, random_state: Any
) -> Rollout:
    """Run a schedule whose rows are ticks of ``1 / rate`` s under an external force (T, d) in N."""
    shape = schedule.position.shape
    push = checks.array(np.zeros(shape) if force is None else force, "force", shape)
    robot, draw = _robot(schedule, plant), checks.seed(random_state)
    noisy = getattr(robot.sensor, "noise_scale", 0.0) != 0.0  # else nothing is drawn: None is the caller's global state
    generator = torch.Generator().manual_seed(int(draw.randint(2**31 - 1))) if noisy else None
    task = robot.task(*_motion_of(schedule), dt=1.0 / rate)
    return run_task(task, torch.tensor(push), generator=generator).numpy()


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
        Motion and gains to follow, in m.
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
    checks.count(n_rollouts, "n_rollouts")
    checks.count(every, "every")
    checks.choice(reference, "reference", Reference)
    checks.number(threshold, "threshold", above=0.0, most=checks.LARGEST, unit="m", optional=True)
    levels = checks.array(quantiles, "quantiles", ("n_quantiles",)).copy()
    checks.require((levels >= 0.0) & (levels <= 1.0), levels, "quantiles", "from 0 to 1")
    schedule = _evenly(schedule, rate)
    _check_memory(n_rollouts, schedule, len(levels))
    robot, draw = _robot(schedule, plant), checks.seed(random_state)
    begin, lasting, push = _draw_pushes(draw, n_rollouts, schedule, peak, duration, onset)
    scale = checks.number(start_scale, "start_scale", least=0.0, most=checks.LARGEST, unit="m")
    offset = torch.tensor(scale * draw.standard_normal(push.shape), device=device)
    seeds = iter(draw.randint(2**31 - 1, size=n_rollouts).tolist())  # at most so many sensors
    motion = [part.to(device) for part in _motion_of(schedule)]
    dt = float(schedule.time[1] - schedule.time[0])
    with torch.no_grad():
        task = robot.task(*motion, dt=dt)
        start = task.position[0] + offset, task.velocity[0].expand(n_rollouts, -1)
        pushes = Pushes(*(torch.tensor(part, device=device) for part in (begin, lasting, np.ascontiguousarray(push.T))))
        blocks = simulate_blocks(task, pushes, start, lambda: torch.Generator().manual_seed(next(seeds)))
        tally = Tally(n_rollouts, task.position, threshold=threshold, share=_SHARE)
        away = None if reference == "desired" else _undisturbed(task)
        deviation = np.concatenate(list(quantiles_in(blocks, tally, levels, every, away)))
    squared_peak, squared_last, peak_tick, last_above = (
        values.cpu().numpy() for values in (tally.squared_peak, tally.squared_last, tally.peak_tick, tally.last_above)
    )
    returned = np.maximum(dt * (last_above + 1.0) - begin - lasting, 0.0)
    return RolloutSummary(
        schedule.time[::every],
        levels,
        deviation,
        peak_deviation=np.sqrt(squared_peak),
        peak_time=schedule.time[peak_tick.astype(np.intp)],
        return_time=np.where(last_above < len(schedule) - 1, returned, np.inf),
        final_deviation=np.sqrt(squared_last),
        onset=schedule.time[0] + begin,
        duration=lasting,
        push=push,
    )


def _draw_pushes(
    draw: np.random.RandomState,
    n_rollouts: int,
    schedule: Schedule,
    peak: Range,
    duration: Range,
    onset: tuple[float, float] | None,
) -> tuple[Floats, Floats, Floats]:
    """Onsets, from the start of the schedule on and in order, durations (R,) and forces at the peak (R, d)."""
    longest, (start, end) = schedule.duration, schedule.time[[0, -1]].tolist()
    lasting = np.asarray(draw.uniform(*_ends(duration, "duration", above=0.0, most=longest, unit="s"), size=n_rollouts))
    share = draw.uniform(size=n_rollouts)
    if onset is None:
        begin = share * (longest - lasting)
    else:
        first, last = _ends(onset, "onset", pair=True, least=start, most=end, unit="s")
        begin = first + share * (last - first) - start
    direction = draw.standard_normal((n_rollouts, schedule.n_outputs))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    strength = np.asarray(draw.uniform(*_ends(peak, "peak", least=0.0, most=checks.LARGEST, unit="N"), size=n_rollouts))
    order = np.argsort(begin, kind="stable")  # rollouts of a chunk are pushed at about the same time
    return begin[order], lasting[order], (strength[:, np.newaxis] * direction)[order]


def _ends(limits: Range, name: str, *, pair: bool = False, **bounds: Any) -> tuple[float, float]:
    """Least and largest of a range within bounds; one number is both, unless a pair is asked for."""
    low, high = checks.array(limits, name, (2,)) if pair or np.ndim(limits) else (limits, limits)
    low = checks.number(low, name, **bounds)
    return low, checks.number(high, name, **(bounds | {"least": low}))


def _motion_of(schedule: Schedule) -> list[Tensor]:
    """Position, velocity, stiffness and damping of a schedule, whose own arrays are read-only."""
    parts = (schedule.position, schedule.velocity, schedule.stiffness, schedule.damping)
    return [torch.tensor(part) for part in parts]


def _check_memory(n_rollouts: int, schedule: Schedule, n_levels: int) -> None:
    # Per rollout the block of deviations, its order, and some numbers; per tick the gains and their maps.
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
        raise InvalidParameterError(
            f"schedule has steps from {steps.min():g} to {steps.max():g} s, must be evenly spaced: give rate, that of "
            "the ticks in Hz."
        )
    return schedule


def _robot(schedule: Schedule, plant: AdmittancePlant | None) -> AdmittancePlant:
    """Plant to simulate, with a warning where its mass is not that which the damping was computed for."""
    if plant is None:
        return AdmittancePlant(schedule.mass or 1.0)
    checks.instance(plant, "plant", AdmittancePlant, optional=True)
    if schedule.mass is not None and (np.ndim(plant.mass) or float(plant.mass) != schedule.mass):
        checks.warn(
            f"The plant's mass is {plant.mass}, but damping_ratio was met for mass={schedule.mass:g} kg: give both the "
            "same."
        )
    return plant


def _undisturbed(task: Task) -> Tensor:
    """Deviation (d, T) of one run without push and without noise."""
    silent = None if task.sensor is None else replace(task.sensor, noise_scale=0.0)
    return run_task(replace(task, sensor=silent)).deviation.mT
