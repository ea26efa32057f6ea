"""Many rollouts of one task under pushes, computed in blocks of ticks and kept only as a summary."""

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.checks import Floats
from torch_pbd.control.simulation.rollout import Loop
from torch_pbd.control.simulation.ticks import Task, block_length, block_responses

# Rollouts advanced together: at d = 2 the forces, states and deviations of a block of them are 4 MB, which fit a
# processor's cache.
_CHUNK = 4096
# A deviation has returned at this share of its peak, which takes a critically damped one four time constants.
_SHARE = 0.1


@final
@dataclass(frozen=True, eq=False, repr=False)
class RolloutSummary:
    """Effect of R random pushes on a robot, as NumPy arrays.

    For poses this is of the positions, and ``rotation`` of the rotation vectors. Where ``units`` are "rad", as for
    rotations and joints, read rad for m and Nm for N.

    Attributes
    ----------
    time : (n,), s
    quantiles : (n_quantiles,)
    deviation : (n, n_quantiles), m
        Quantiles over the rollouts of the distance from the reference at each time.
    peak_deviation : (R,), m
        Largest distance of each rollout; rollouts are ordered by the onset of their push.
    return_time : (R,), s
        Time from the end of the push until the distance stays below a tenth of its peak; inf if it never does.
    onset, duration : (R,), s
        Start and duration of each push.
    push : (R, p), N
        Peak force of each push.
    rotation : RolloutSummary or None
    units : str or None
        Units of the schedule's positions, None if unknown.
    """

    time: Floats
    quantiles: Floats
    deviation: Floats
    peak_deviation: Floats
    return_time: Floats
    onset: Floats
    duration: Floats
    push: Floats
    rotation: "RolloutSummary | None" = None
    units: str | None = "m"

    def __repr__(self) -> str:
        scales = {"m": (1e3, "mm"), "rad": (180.0 / math.pi, "degrees")}
        shown = []
        for part in (self, self.rotation):
            if part is not None:
                scale, unit = scales.get(part.units or "", (1.0, part.units or "units"))
                peaks = "/".join(f"{scale * each:.3g}" for each in np.quantile(part.peak_deviation, (0.05, 0.5, 0.95)))
                shown.append(f"{peaks} {unit} at 5/50/95 %, {np.isfinite(part.return_time).mean():.0%} return")
        return f"RolloutSummary(n_rollouts={len(self.onset)}, peak deviation {'; '.join(shown)})"


@final
class Chunk:
    """Rollouts that are advanced together as columns, each under one push, a squared sine over time.

    Onsets and durations (r,) are in s from the first tick on. Onsets are sorted, so that the rollouts that are pushed
    in a block of ticks are neighbours. Peaks (d, r) are in N and Nm.
    """

    def __init__(self, columns: slice, onset: Tensor, duration: Tensor, peak: Tensor) -> None:
        self.columns = columns
        self._onset, self._duration, self._peak = onset, duration, peak
        end = onset + duration
        self._onsets, self._ends = onset.tolist(), end.cummax(0).values.tolist()
        self.first_end = float(end.min())

    def __len__(self) -> int:
        return len(self._onsets)

    def forces(self, times: Float[Tensor, " l"]) -> tuple[slice, Float[Tensor, "l d p"]]:
        """Rollouts that are pushed in a block of ticks at these times, and their forces."""
        pushed = slice(bisect_right(self._ends, float(times[0])), bisect_right(self._onsets, float(times[-1])))
        share = ((times[:, None] - self._onset[pushed]) / self._duration[pushed]).clamp(0.0, 1.0)
        return pushed, torch.sin(math.pi * share).square()[:, None] * self._peak[:, pushed]


Part = tuple[slice, Chunk, Float[Tensor, "d l r"]]
"""Ticks, rollouts, and their deviations then from the desired position, valid until the next part."""


def _blocks(task: Task) -> Iterator[tuple[slice, Tensor]]:
    """Ticks of each block, and times of a whole block's ticks."""
    length = block_length(task.position.shape[-1])
    for first in range(0, task.n_ticks, length):
        times = task.dt * torch.arange(first, first + length).to(task.position)
        yield slice(first, min(first + length, task.n_ticks)), times


def _linear(task: Task, chunks: Sequence[Chunk]) -> Iterator[Part]:
    """Deviations where nothing acts in the loop, block by block for all chunks.

    A tick is linear in the state and the force, with matrices that all rollouts share. So is a block of ticks, which
    is thus a single matrix product.
    """
    d, length = task.position.shape[-1], block_length(task.position.shape[-1])
    start = torch.nn.functional.pad(task.velocity[0], (d, 0))[:, None]
    states = [start.repeat(1, len(chunk)) for chunk in chunks]
    # Buffers are reused, so that they stay in the cache.
    inputs, outputs = start.new_ones(2 * d + 1, len(chunks[0])), start.new_empty(length * d + 2 * d, len(chunks[0]))
    for (ticks, times), each in zip(_blocks(task), block_responses(task, length), strict=True):
        # Deviations axis by axis, and then the state after the block.
        response = torch.cat([each[:-1, :d].transpose(0, 1).flatten(0, 1), each[-1]])
        of_start, of_forces = (part.contiguous() for part in response.split([2 * d + 1, length * d], dim=1))
        for chunk, state in zip(chunks, states, strict=True):
            pushed, forces = chunk.forces(times)
            inputs[: 2 * d, : len(chunk)] = state
            within = torch.mm(of_start, inputs[:, : len(chunk)], out=outputs[:, : len(chunk)])
            if forces.numel():
                within[:, pushed].addmm_(of_forces, forces.flatten(0, 1))
            state.copy_(within[-2 * d :])
            yield ticks, chunk, within[: -2 * d].unflatten(0, (d, -1))[:, : ticks.stop - ticks.start]


def _looped(task: Task, chunks: Sequence[Chunk], generators: Iterator[torch.Generator]) -> Iterator[Part]:
    """Deviations tick by tick, where something acts in the loop."""
    starts = [(task.position[0].expand(len(chunk), -1), task.velocity[0].expand(len(chunk), -1)) for chunk in chunks]
    loops = [Loop(task, start, next(generators)) for start in starts]
    for ticks, times in _blocks(task):
        for chunk, loop in zip(chunks, loops, strict=True):
            pushed, forces = chunk.forces(times)
            force = times.new_zeros(ticks.stop - ticks.start, len(chunk), task.position.shape[-1])
            force[:, pushed] = forces[: len(force)].mT
            away = [loop.run(tick, each)["deviation"] for tick, each in enumerate(force, start=ticks.start)]
            yield ticks, chunk, torch.stack(away).permute(2, 0, 1)


class Tally:
    """Quantiles of the distances of R rollouts in some axes, squares of their peaks, and last ticks above a share."""

    def __init__(self, n_rollouts: int, axes: slice) -> None:
        self.axes, self.quantiles = axes, list[Floats]()
        self.squared_peak = torch.zeros(n_rollouts, dtype=torch.float64)
        self.last_above = torch.full_like(self.squared_peak, -1.0)

    def add(self, ticks: slice, columns: slice, squared: Float[Tensor, "l r"], *, is_over: bool) -> None:
        """Record squared distances at some ticks; ``is_over`` if a push may be over by then."""
        highest, peak, last = squared.amax(0), self.squared_peak[columns], self.last_above[columns]
        torch.maximum(peak, highest, out=peak)
        # The limit is a share of the peak so far; ticks counted before the peak are superseded by later ones.
        limit = _SHARE**2 * peak
        if is_over and bool((highest > limit).any()):
            numbers = torch.arange(ticks.start, ticks.stop, dtype=squared.dtype)[:, None]
            torch.maximum(last, torch.where(squared > limit, numbers, -1.0).amax(0), out=last)


def push_many(
    task: Task,
    pushes: tuple[Tensor, Tensor, Tensor],
    generators: Iterator[torch.Generator],
    blocks: Sequence[slice],
    levels: Floats,
    every: int,
) -> list[Tally]:
    """Distances from the desired position, in the axes of each block, of R rollouts under pushes.

    Pushes are onsets (R,), durations (R,) and peaks (d, R); quantiles (n_quantiles,) are of each ``every``-th tick.
    """
    n_rollouts = len(pushes[0])
    columns = [slice(first, first + _CHUNK) for first in range(0, n_rollouts, _CHUNK)]
    chunks = [Chunk(some, *(part[..., some] for part in pushes)) for some in columns]
    tallies = [Tally(n_rollouts, block) for block in blocks]
    scratch, rows = torch.empty(0), list[Tensor]()
    for ticks, chunk, values in _linear(task, chunks) if task.is_linear else _looped(task, chunks, generators):
        if not rows:  # the first part is the largest
            scratch = torch.empty_like(values[0])
            rows = [values.new_empty(values.shape[1], n_rollouts) for _ in tallies]
        is_over = chunk.first_end < task.dt * ticks.stop or ticks.stop == task.n_ticks
        squared = scratch[: values.shape[1], : values.shape[2]]
        chosen = slice(-ticks.start % every, None, every)
        for tally, row in zip(tallies, rows, strict=True):
            own = values[tally.axes]
            torch.mul(own[0], own[0], out=squared)
            for axis in own[1:]:
                squared.addcmul_(axis, axis)
            tally.add(ticks, chunk.columns, squared, is_over=is_over)
            row[: len(squared[chosen]), chunk.columns] = squared[chosen]
            if chunk is chunks[-1]:
                tally.quantiles.extend(_quantiles(row[: len(squared[chosen])].numpy(), levels))
    return tallies


def _quantiles(squares: Floats, levels: Floats) -> Floats:
    """Quantiles (L, n_quantiles) of the roots of squares (L, R), whose rows are sorted in place."""
    place = levels * (squares.shape[1] - 1)
    below = np.floor(place).astype(np.intp)
    squares.sort(axis=1)  # ten times as fast as torch's
    low, high = (np.sqrt(squares[:, rank]) for rank in (below, np.minimum(below + 1, squares.shape[1] - 1)))
    quantiles: Floats = low + (place - below) * (high - low)
    return quantiles
