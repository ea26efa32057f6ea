"""Many rollouts of one task under pushes, a block of ticks at a time, of which only a summary is kept."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.checks import Floats
from torch_pbd.control.simulation.ticks import Loop, State, Task, block_length, block_responses

# Rollouts that move on together on a CPU: at d = 2 the forces, states and deviations of a block of them are 4 MB, which
# stay in its cache.
_CHUNK = 4096


@final
@dataclass(frozen=True, eq=False, repr=False)
class RolloutSummary:
    """Effect of R random pushes on a robot; NumPy arrays.

    Of poses, these are of the positions; ``rotation`` is the same of the rotation vectors. Where ``units`` are "rad",
    as there and of joints, read rad for m and Nm for N.

    Attributes
    ----------
    time : (n,), s
    quantiles : (n_quantiles,)
    deviation : (n, n_quantiles), m
        Quantiles over the rollouts of the distance from the reference at these times.
    peak_deviation : (R,), m
        Largest distance of each rollout; rollouts are in the order in which they are pushed.
    peak_time : (R,), s
    return_time : (R,), s
        From the end of the push until the distance stays below the threshold; inf where it is above it at the end.
    final_deviation : (R,), m
    onset, duration : (R,), s
        Of the push.
    push : (R, p), N
        Force at its peak.
    rotation : RolloutSummary or None
    units : str or None
        Of the schedule's positions; None where it is not known.
    """

    time: Floats
    quantiles: Floats
    deviation: Floats
    peak_deviation: Floats
    peak_time: Floats
    return_time: Floats
    final_deviation: Floats
    onset: Floats
    duration: Floats
    push: Floats
    rotation: "RolloutSummary | None" = None
    units: str | None = "m"

    @property
    def n_rollouts(self) -> int:
        """Number of rollouts R."""
        return len(self.onset)

    def __repr__(self) -> str:
        scales = {"m": (1e3, "mm"), "rad": (180.0 / math.pi, "degrees")}
        parts = [
            (part, *scales.get(part.units or "", (1.0, part.units or "units")))
            for part in (self, self.rotation)
            if part is not None
        ]
        shown = [
            f"{'/'.join(f'{scale * peak:.3g}' for peak in np.quantile(part.peak_deviation, (0.05, 0.5, 0.95)))} {unit} "
            f"at 5/50/95 %, {np.isfinite(part.return_time).mean():.0%} return"
            for part, scale, unit in parts
        ]
        return f"RolloutSummary(n_rollouts={self.n_rollouts}, peak deviation {'; '.join(shown)})"


@final
@dataclass(frozen=True)
class Pushes:
    """One push for each of R rollouts: a squared sine over time, in one direction.

    Attributes
    ----------
    onset, duration : Tensor of shape (R,), s
        From the first tick on; onsets do not decrease, so that the rollouts pushed in a block are neighbours.
    peak : Tensor of shape (d, R), N and Nm
    """

    onset: Tensor
    duration: Tensor
    peak: Tensor

    def __getitem__(self, columns: slice) -> "Pushes":
        return Pushes(self.onset[columns], self.duration[columns], self.peak[:, columns])

    def force(self, times: Float[Tensor, " l"]) -> Float[Tensor, "l d r"]:
        """Forces at times."""
        share = ((times[:, None] - self.onset) / self.duration).clamp(0.0, 1.0)
        return torch.sin(math.pi * share).square()[:, None] * self.peak


@dataclass(frozen=True)
class Deviations:
    """Deviations (d, L, r) from the desired position at some ticks, of some rollouts.

    ``over`` is whether one of their pushes is over before the next ticks, or there are no more.
    """

    ticks: slice
    columns: slice
    values: Tensor
    over: bool


def simulate_blocks(
    task: Task, pushes: Pushes, start: State, generators: Callable[[], torch.Generator]
) -> Iterator[Deviations]:
    """Deviations of R rollouts from states (R, d): blocks of ticks one after the other, of each all rollouts.

    Where nothing acts in the loop, a tick is linear in the state and the force, with matrices that all rollouts
    share: so is a block of them, and it is one product of matrices. Else the rollouts go tick by tick; each call of
    ``generators`` is for the sensor of a chunk of them.
    """
    n_rollouts, d = start[0].shape
    chunk = _CHUNK if task.position.device.type == "cpu" else n_rollouts
    columns = [slice(first, min(first + chunk, n_rollouts)) for first in range(0, n_rollouts, chunk)]
    starts = [(start[0][each], start[1][each]) for each in columns]
    runs = _Linear(task, starts, chunk) if task.is_open else _Looped(task, starts, generators)
    parts = [pushes[each] for each in columns]
    timings = [_Timing(part) for part in parts]
    length = block_length(d)
    for first in range(0, task.n_ticks, length):
        ticks = slice(first, min(first + length, task.n_ticks))
        times = task.dt * torch.arange(first, first + length).to(task.position)
        for k, (part, timing) in enumerate(zip(parts, timings, strict=True)):
            pushed = timing.pushed(task.dt * first, task.dt * ticks.stop)
            over = timing.first_end < task.dt * ticks.stop or ticks.stop == task.n_ticks
            yield Deviations(ticks, columns[k], runs.move(k, ticks, pushed, part[pushed].force(times)), over)


class _Timing:
    """Times of the pushes of a chunk, which are in the order of their onsets."""

    def __init__(self, pushes: Pushes) -> None:
        end = pushes.onset + pushes.duration
        self._onsets, self._ends = pushes.onset.tolist(), end.cummax(0).values.tolist()
        self.first_end = float(end.min())

    def pushed(self, start: float, stop: float) -> slice:
        """Rollouts from the first whose push lasts beyond ``start`` to the last whose push begins before ``stop``."""
        return slice(bisect_right(self._ends, start), bisect_left(self._onsets, stop))


class _Linear:
    """Chunks of rollouts of a linear task, columns of matrices whose memory is used again and so stays in the cache."""

    def __init__(self, task: Task, starts: list[State], chunk: int) -> None:
        d, length = task.position.shape[-1], block_length(task.position.shape[-1])
        self._states = [torch.cat([p - task.position[0], v], dim=-1).mT.contiguous() for p, v in starts]
        self._responses = block_responses(task, length)
        self._inputs = task.position.new_ones(2 * d + 1, chunk)
        self._outputs = task.position.new_empty(length * d + 2 * d, chunk)

    def move(self, k: int, ticks: slice, pushed: slice, forces: Tensor) -> Tensor:
        """Deviations (d, L, r) of chunk k at a block of ticks, valid until the next call; forces (L, d, p) act on some.

        All chunks are moved over a block, in their order, before the next one is.
        """
        state = self._states[k]
        size, r = state.shape
        if k == 0:
            each = next(self._responses)
            # Deviations axis by axis, and then the state after the block.
            response = torch.cat([each[:-1, : size // 2].transpose(0, 1).flatten(0, 1), each[-1]])
            self._free, self._forced = response[:, : size + 1].contiguous(), response[:, size + 1 :].contiguous()
        self._inputs[:size, :r] = state
        within = torch.mm(self._free, self._inputs[:, :r], out=self._outputs[:, :r])
        if forces.numel():
            within[:, pushed].addmm_(self._forced, forces.flatten(0, 1))
        state.copy_(within[-size:])
        return within[:-size].unflatten(0, (size // 2, -1))[:, : ticks.stop - ticks.start]


class _Looped:
    """Chunks of rollouts in which something acts at every tick."""

    def __init__(self, task: Task, starts: list[State], generators: Callable[[], torch.Generator]) -> None:
        self._task, self._loops = task, [Loop(task, start, generators()) for start in starts]
        self._still = [torch.zeros_like(start[0]) for start in starts]

    def move(self, k: int, ticks: slice, pushed: slice, forces: Tensor) -> Tensor:
        """Deviations (d, L, r) of chunk k at a block of ticks; forces (L, d, p) act on some."""
        deviations = []
        for tick in range(ticks.start, ticks.stop):
            force = self._still[k].clone()
            force[pushed] = forces[tick - ticks.start].mT
            deviations.append(self._loops[k].run(tick, force)["position"] - self._task.position[tick])
        return torch.stack(deviations).permute(2, 0, 1)


class Tally:
    """Squared peak of each of R rollouts in some axes, its tick, and the last above a threshold.

    It is in m or rad, as the axes, or a ``share`` of the peak.
    """

    def __init__(self, n_rollouts: int, like: Tensor, axes: slice, threshold: float | None, *, share: float) -> None:
        zero = torch.zeros(n_rollouts, dtype=like.dtype, device=like.device)
        self.squared_peak, self.peak_tick, self.last_above = zero, torch.zeros_like(zero), torch.full_like(zero, -1.0)
        self.squared_last = torch.zeros_like(zero)
        self.axes, self._threshold, self._share = axes, threshold, share

    def add(self, part: Deviations, squared: Float[Tensor, "l r"]) -> None:
        """Squared distances of a part."""
        columns = part.columns
        numbers = torch.arange(part.ticks.start, part.ticks.stop, dtype=squared.dtype, device=squared.device)[:, None]
        highest, peak, tick = squared.amax(0), self.squared_peak[columns], self.peak_tick[columns]
        higher = highest > peak
        if bool(higher.any()):
            when = torch.where(squared == highest, numbers, -1.0).amax(0)
            torch.where(higher, when, tick, out=tick)
            torch.maximum(peak, highest, out=peak)
        if part.over:
            # Of its own peak so far: what is counted before that peak is reached, the peak itself overrules.
            limit = self._share**2 * peak if self._threshold is None else torch.full_like(peak, self._threshold**2)
            if bool((highest > limit).any()):
                last = self.last_above[columns]
                torch.maximum(last, torch.where(squared > limit, numbers, -1.0).amax(0), out=last)
        self.squared_last[columns] = squared[-1]


def quantiles_in(
    blocks: Iterator[Deviations], tallies: Sequence[Tally], levels: Floats, every: int, away: Tensor | None
) -> Iterator[list[Floats]]:
    """Quantiles (L, n_quantiles) of the distances in the axes of each tally at each ``every``-th tick, noted in it."""
    n_rollouts = len(tallies[0].last_above)
    scratch, rows = torch.empty(0), list[Tensor]()
    for part in blocks:
        values = part.values if away is None else part.values - away[:, part.ticks, None]
        if not rows:  # the first part is the largest
            scratch = torch.empty_like(values[0])
            rows = [values.new_empty(values.shape[1], n_rollouts) for _ in tallies]
        squared = scratch[: values.shape[1], : values.shape[2]]
        first = -part.ticks.start % every
        n_chosen = len(range(first, len(squared), every))
        for tally, row in zip(tallies, rows, strict=True):
            own = values[tally.axes]
            torch.mul(own[0], own[0], out=squared)
            for axis in own[1:]:
                squared.addcmul_(axis, axis)
            tally.add(part, squared)
            row[:n_chosen, part.columns] = squared[first::every]
        if part.columns.stop == n_rollouts:
            yield [_quantiles(row[:n_chosen], levels) for row in rows]


def _quantiles(squares: Tensor, levels: Floats) -> Floats:
    """Quantiles (L, n_quantiles) of the roots of squares (L, R), whose rows are put in another order."""
    n_rollouts = squares.shape[1]
    place = levels * (n_rollouts - 1)
    below = np.floor(place).astype(np.intp)
    above = np.minimum(below + 1, n_rollouts - 1)
    if squares.device.type == "cpu":
        ordered = squares.numpy()
        ordered.sort(axis=1)  # ten times as fast as torch's
        ends = [ordered[:, below], ordered[:, above]]
    else:
        ranked = squares.sort(dim=1).values
        ends = [ranked[:, rank.tolist()].cpu().numpy() for rank in (below, above)]
    low, high = map(np.sqrt, ends)
    return low + (place - below) * (high - low)
