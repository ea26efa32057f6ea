"""A schedule on a simulated robot, thousands of times, under random pushes."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.plant import AdmittancePlant, run_task
from torch_pbd.control.simulation.poses import warn_if_far
from torch_pbd.control.simulation.rollouts import Pushes, RolloutSummary, Tally, quantiles_in, simulate_blocks
from torch_pbd.control.simulation.run import evenly, task_of
from torch_pbd.control.simulation.ticks import Task, block_length
from torch_pbd.files.memory import require_memory

Reference = Literal["desired", "undisturbed"]
Range = float | tuple[float, float]

# A deviation has returned at a tenth of its own peak: by then a critically damped one takes four time constants.
_SHARE = 0.1


def simulate_many(
    schedule: Schedule,
    n_rollouts: int = 1000,
    *,
    plant: AdmittancePlant | None = None,
    peak: Range = 5.0,
    torque: Range = 0.0,
    duration: Range = 0.8,
    onset: tuple[float, float] | None = None,
    start_scale: float | tuple[float, float] = 0.0,
    rate: float | None = None,
    reference: Reference = "desired",
    threshold: float | tuple[float, float] | None = None,
    quantiles: tuple[float, ...] = (0.05, 0.5, 0.95),
    every: int = 1,
    random_state: Any = None,
    device: str | None = None,
) -> RolloutSummary:
    """Push a robot at random, many times over, while it follows a schedule.

    Each rollout gets one push: a squared sine over its duration, in a direction that is uniform on the sphere of the
    axes of position; and of poses, by a torque at the same time, in a direction of its own. Trajectories are not kept,
    so that memory goes with ``n_rollouts`` and not with their length. The result depends on the arguments and
    ``random_state`` only; pushes do not depend on ``rate``.

    Parameters
    ----------
    schedule : Schedule
        Motion and gains to follow, in m.
    n_rollouts : int, default=1000
        Number of rollouts R.
    plant : AdmittancePlant, default=None
        None is ``AdmittancePlant(None)``, with the mass of the schedule, or 1 kg where it tells none. With a sensor or
        walls, thousands of rollouts take five to ten times longer; with a filter, ten to two hundred times.
    peak : float or (float, float), default=5.0
        Largest force of a push, N; of two numbers, uniform between them.
    torque : float or (float, float), default=0.0
        Largest torque of a push, Nm, of poses: ``peak=0.0`` leaves pushes by torque alone.
    duration : float or (float, float), default=0.8
        Of a push, s; of two numbers, uniform between them.
    onset : (float, float), default=None
        Time at which pushes begin, uniform between these, s; None is so that they end within the schedule.
    start_scale : float, or of poses (float, float), default=0.0
        Standard deviation, in every axis, of the start around the desired one, m; of poses, m and rad.
    rate : float, default=None
        Of the ticks, Hz; None takes the rows of the schedule, which must then be evenly spaced.
    reference : {"desired", "undisturbed"}, default="desired"
        Deviation from the desired position, or from where the robot would be without push, noise and spread of the
        start: it lags behind the desired position.
    threshold : float, or of poses (float, float), default=None
        Below which a deviation is over, m, and of poses m and rad; None is a tenth of the rollout's own peak.
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
    limits = _of_blocks(threshold, "threshold", schedule, None, above=0.0)
    scales = _of_blocks(start_scale, "start_scale", schedule, 0.0, least=0.0)
    levels = checks.array(quantiles, "quantiles", ("n_quantiles",)).copy()
    checks.require((levels >= 0.0) & (levels <= 1.0), levels, "quantiles", "from 0 to 1")
    schedule = evenly(schedule, rate, "give rate, that of the ticks in Hz")
    _check_memory(n_rollouts, schedule, len(levels))
    draw = checks.seed(random_state)
    begin, lasting, push = _draw_pushes(draw, n_rollouts, schedule, [peak, torque], duration, onset)
    offset = draw.standard_normal(push.shape)
    for block, scale in zip(schedule.blocks, scales, strict=True):
        offset[:, block] *= scale
    seeds = iter(draw.randint(2**31 - 1, size=n_rollouts).tolist())  # at most so many sensors
    dt = float(schedule.time[1] - schedule.time[0])
    with torch.no_grad():
        task = task_of(schedule, plant, dt, device)
        start = task.position[0] + torch.tensor(offset, device=device), task.velocity[0].expand(n_rollouts, -1)
        pushes = Pushes(*(torch.tensor(part, device=device) for part in (begin, lasting, np.ascontiguousarray(push.T))))
        blocks = simulate_blocks(task, pushes, start, lambda: torch.Generator().manual_seed(next(seeds)))
        tallies = [
            Tally(n_rollouts, task.position, block, limit, share=_SHARE)
            for block, limit in zip(schedule.blocks, limits, strict=True)
        ]
        away = None if reference == "desired" else _undisturbed(task)
        deviations = zip(*quantiles_in(blocks, tallies, levels, every, away), strict=True)
        summaries = [
            RolloutSummary(
                schedule.time[::every],
                levels,
                np.concatenate(rows),
                **_effect(tally, schedule, dt, begin, lasting),
                onset=schedule.time[0] + begin,
                duration=lasting,
                push=push[:, tally.axes],
                units=unit,
            )
            for tally, rows, unit in zip(tallies, deviations, [schedule.units, "rad"], strict=False)
        ]
    if len(summaries) == 1:
        return summaries[0]
    warn_if_far(float(summaries[1].peak_deviation.max()))
    return replace(summaries[0], rotation=summaries[1])


def _effect(tally: Tally, schedule: Schedule, dt: float, begin: Floats, lasting: Floats) -> dict[str, Any]:
    """Fields of a summary that a tally tells; pushes begin and last (R,), from the start of the schedule on."""
    squared_peak, squared_last, peak_tick, last_above = (
        values.cpu().numpy() for values in (tally.squared_peak, tally.squared_last, tally.peak_tick, tally.last_above)
    )
    returned = np.maximum(dt * (last_above + 1.0) - begin - lasting, 0.0)
    return {
        "peak_deviation": np.sqrt(squared_peak),
        "peak_time": schedule.time[peak_tick.astype(np.intp)],
        "return_time": np.where(last_above < len(schedule) - 1, returned, np.inf),
        "final_deviation": np.sqrt(squared_last),
    }


def _draw_pushes(
    draw: np.random.RandomState,
    n_rollouts: int,
    schedule: Schedule,
    peaks: list[Range],
    duration: Range,
    onset: tuple[float, float] | None,
) -> tuple[Floats, Floats, Floats]:
    """Onsets, from the start of the schedule on and in order, durations (R,), and forces and torques (R, d)."""
    longest, (start, end) = schedule.duration, schedule.time[[0, -1]].tolist()
    lasting = np.asarray(draw.uniform(*_ends(duration, "duration", "s", above=0.0, most=longest), size=n_rollouts))
    share = draw.uniform(size=n_rollouts)
    if onset is None:
        begin = share * (longest - lasting)
    else:
        first, last = _ends(onset, "onset", "s", pair=True, least=start, most=end)
        begin = first + share * (last - first) - start
    names = [("peak", "N"), ("torque", "Nm")]
    limits = [_ends(of, *named, least=0.0, most=checks.LARGEST) for of, named in zip(peaks, names, strict=True)]
    if len(schedule.blocks) == 1 and limits[1] != (0.0, 0.0):
        raise checks.refusal(peaks[1], "torque", "0 for a schedule without orientation", unit="Nm")
    push = np.zeros((n_rollouts, schedule.n_outputs))
    for block, ends in zip(schedule.blocks, limits, strict=False):
        direction = draw.standard_normal((n_rollouts, block.stop - block.start))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        push[:, block] = np.asarray(draw.uniform(*ends, size=n_rollouts))[:, np.newaxis] * direction
    order = np.argsort(begin, kind="stable")  # rollouts of a chunk are pushed at about the same time
    return begin[order], lasting[order], push[order]


def _ends(limits: Range, name: str, unit: str, *, pair: bool = False, **bounds: Any) -> tuple[float, float]:
    """Least and largest of a range within bounds; one number is both, unless a pair is asked for."""
    low, high = checks.array(limits, name, (2,)) if pair or np.ndim(limits) else (limits, limits)
    low = checks.number(low, name, unit=unit, **bounds)
    return low, checks.number(high, name, unit=unit, **(bounds | {"least": low}))


def _of_blocks(value: Any, name: str, schedule: Schedule, nothing: float | None, **bounds: Any) -> list[Any]:
    """Number of each block of outputs, in m and rad, within bounds; ``nothing`` is that of all."""
    units = ["m", "rad"][: len(schedule.blocks)]
    several = len(units) > 1 and value != nothing
    if several and np.shape(value) != (2,):
        raise checks.refusal(value, name, f"(float, float), in m and rad, for poses, or {nothing}")
    bounds |= {"most": checks.LARGEST, "optional": nothing is None}
    numbers = value if several else [value] * len(units)
    return [checks.number(one, name, unit=unit, **bounds) for one, unit in zip(numbers, units, strict=True)]


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


def _undisturbed(task: Task) -> Tensor:
    """Deviation (d, T) of one run without push and without noise."""
    silent = None if task.sensor is None else replace(task.sensor, noise_scale=0.0)
    return run_task(replace(task, sensor=silent)).deviation.mT
