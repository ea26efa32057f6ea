"""Many rollouts of one task under pushes, a block of ticks at a time: no trajectory is kept."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.simulation.ticks import Hooks, Loop, State, Task, block_length, block_responses
from torch_pbd.control.simulation.transitions import Integrator

_CHUNK = 4096  # rollouts moved on together on a CPU: what they need stays in its cache


@final
@dataclass(frozen=True)
class Pushes:
    """One push for each of R rollouts: a squared sine over time, in one direction.

    Attributes
    ----------
    onset, duration : Tensor of shape (R,), s
        From the first tick on; onsets do not decrease.
    peak : Tensor of shape (d, R), N
    """

    onset: Tensor
    duration: Tensor
    peak: Tensor

    def force(self, times: Float[Tensor, " l"]) -> Float[Tensor, "l d r"]:
        """Forces at times."""
        share = ((times[:, None] - self.onset) / self.duration).clamp(0.0, 1.0)
        return torch.sin(math.pi * share).square()[:, None] * self.peak

    def within(self, columns: slice) -> "Pushes":
        """Those of some rollouts."""
        return Pushes(self.onset[columns], self.duration[columns], self.peak[:, columns])


class _Timing:
    """Which rollouts are pushed when: they are in the order of the onsets, so that those of a block are neighbours."""

    def __init__(self, pushes: Pushes) -> None:
        end = pushes.onset + pushes.duration
        self._onsets, self._ends = pushes.onset.tolist(), end.cummax(0).values.tolist()
        self.first_end = float(end.min())

    def pushed(self, start: float, stop: float) -> slice:
        """Rollouts from the first that is pushed between these times to the last, and none that is not before these."""
        return slice(bisect_right(self._ends, start), bisect_left(self._onsets, stop))


@dataclass(frozen=True)
class Deviations:
    """Deviations (d, L, r) from the desired position at some ticks, of some rollouts.

    ``over`` tells whether one of their pushes is over before the next ticks, or there are no more.
    """

    ticks: slice
    columns: slice
    values: Tensor
    over: bool


def march(
    task: Task, hooks: Hooks, pushes: Pushes, start: State, generators: Callable[[], torch.Generator]
) -> Iterator[Deviations]:
    """Deviations of R rollouts from states (R, d): blocks of ticks one after the other, of each all rollouts.

    Where nothing acts in the loop, a tick is linear in the state and the force, with matrices that all rollouts
    share: so is a block of them, and it is one product of matrices. Else the rollouts go tick by tick; each call of
    ``generators`` is for the sensor of a chunk of them.
    """
    n_rollouts, d = start[0].shape
    chunk = _CHUNK if task.position.device.type == "cpu" else n_rollouts
    chunks = [slice(first, min(first + chunk, n_rollouts)) for first in range(0, n_rollouts, chunk)]
    parts = [pushes.within(columns) for columns in chunks]
    timings = [_Timing(part) for part in parts]
    states = [(start[0][columns], start[1][columns]) for columns in chunks]
    acting = (hooks.sensor, hooks.position_loop, hooks.environment, hooks.stiffness_filter)
    runs: Sequence[_Linear | _Looped]
    if all(hook is None for hook in acting):
        product = _Product(task, hooks.integrator, chunk)
        runs = [_Linear(task, state, product) for state in states]
    else:
        runs = [_Looped(task, state, hooks, generators()) for state in states]
    length = block_length(d)
    for first in range(0, task.n_ticks, length):
        ticks = slice(first, min(first + length, task.n_ticks))
        times = task.dt * torch.arange(first, first + length).to(task.position)
        since, until = task.dt * first, task.dt * ticks.stop
        for columns, run, part, timing in zip(chunks, runs, parts, timings, strict=True):
            pushed = timing.pushed(since, until)
            over = timing.first_end < until or ticks.stop == task.n_ticks
            values = run.move(ticks, pushed, part.within(pushed).force(times))
            yield Deviations(ticks, columns, values, over)


class _Product:
    """What a block does to a chunk of rollouts, in memory that is used again and again and so stays in the cache."""

    def __init__(self, task: Task, integrator: Integrator, chunk: int) -> None:
        d, length = task.position.shape[-1], block_length(task.position.shape[-1])
        self._responses, self._first = block_responses(task, integrator, length), -1
        self._inputs = task.position.new_ones(2 * d + 1, chunk)
        self._outputs = task.position.new_empty(length * d + 2 * d, chunk)

    def __call__(self, first: int, state: Tensor, pushed: slice, forces: Tensor) -> Tensor:
        """Deviations (L d, r), axis by axis, in the block from a tick on, and then the state (2 d, r) after it."""
        size, r = state.shape
        if first != self._first:
            each = next(self._responses)
            response = torch.cat([each[:-1, : size // 2].transpose(0, 1).flatten(0, 1), each[-1]])
            self._free, self._forced = response[:, : size + 1].contiguous(), response[:, size + 1 :].contiguous()
            self._first = first
        self._inputs[:size, :r] = state
        within = torch.mm(self._free, self._inputs[:, :r], out=self._outputs[:, :r])
        if forces.numel():
            within[:, pushed].addmm_(self._forced, forces.flatten(0, 1))
        return within


class _Linear:
    """Rollouts of a linear task: columns of a matrix."""

    def __init__(self, task: Task, start: State, product: _Product) -> None:
        self._state = torch.cat([start[0] - task.position[0], start[1]], dim=-1).mT.contiguous()
        self._product = product

    def move(self, ticks: slice, pushed: slice, forces: Tensor) -> Tensor:
        """Deviations (d, L, r) at a block of ticks, valid until another block is asked for of any rollouts.

        Forces (L, d, p) act on some of them.
        """
        size = len(self._state)
        within = self._product(ticks.start, self._state, pushed, forces)
        self._state.copy_(within[-size:])
        return within[:-size].unflatten(0, (size // 2, -1))[:, : ticks.stop - ticks.start]


class _Looped:
    """Rollouts in which something acts at every tick."""

    def __init__(self, task: Task, start: State, hooks: Hooks, generator: torch.Generator) -> None:
        self._task, self._loop = task, Loop(task, start, hooks, generator)
        self._still = torch.zeros_like(start[0])

    def move(self, ticks: slice, pushed: slice, forces: Tensor) -> Tensor:
        """Deviations (d, L, r) at a block of ticks; forces (L, d, p) act on some of them."""
        deviations = []
        for tick in range(ticks.start, ticks.stop):
            force = self._still.clone()
            force[pushed] = forces[tick - ticks.start].mT
            deviations.append(self._loop.run(tick, force)["position"] - self._task.position[tick])
        return torch.stack(deviations).permute(2, 0, 1)


class Tally:
    """What is kept of each of R rollouts: peak of the deviation, when, and the last tick above a limit after the push.

    The limit is ``threshold`` in m, or else ``share`` of the rollout's own peak.
    """

    def __init__(self, n_rollouts: int, like: Tensor, *, threshold: float | None, share: float) -> None:
        zero = torch.zeros(n_rollouts, dtype=like.dtype, device=like.device)
        self.squared_peak, self.peak_tick, self.last_above = zero, torch.zeros_like(zero), torch.full_like(zero, -1.0)
        self.squared_last = torch.zeros_like(zero)
        self._threshold, self._share = threshold, share

    def add(self, part: Deviations, squared: Float[Tensor, "l r"]) -> None:
        """Squared deviations of a part."""
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
