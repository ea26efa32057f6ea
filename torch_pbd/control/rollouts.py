"""Many rollouts of one task under pushes, a block of ticks at a time: no trajectory is kept."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.ticks import Hooks, Loop, State, Task, block_length, block_responses
from torch_pbd.control.transitions import Integrator

_CHUNK = 4096  # rollouts moved on together on a CPU: what they need stays in its cache


@final
@dataclass(frozen=True)
class Pushes:
    """One push for each of R rollouts: a squared sine over time, in one direction.

    Attributes
    ----------
    onset, duration : Tensor of shape (R,), s
        From the first tick on.
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

    def span(self) -> tuple[float, float]:
        """When the first begins and the last ends."""
        return float(self.onset.min()), float((self.onset + self.duration).max())


@dataclass(frozen=True)
class Deviations:
    """Deviations (d, L, r) from the desired position at some ticks, of some rollouts."""

    ticks: slice
    columns: slice
    values: Tensor


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
    spans = [part.span() for part in parts]
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
        for columns, run, part, (begin, end) in zip(chunks, runs, parts, spans, strict=True):
            pushed = begin < task.dt * ticks.stop and end > task.dt * first
            yield Deviations(ticks, columns, run.move(ticks, part.force(times) if pushed else None))


class _Product:
    """What a block does to a chunk of rollouts, in memory that is used again and again and so stays in the cache."""

    def __init__(self, task: Task, integrator: Integrator, chunk: int) -> None:
        d, length = task.position.shape[-1], block_length(task.position.shape[-1])
        self._responses, self._first = block_responses(task, integrator, length), -1
        self._inputs = task.position.new_ones(2 * d + 1 + length * d, chunk)
        self._outputs = task.position.new_empty(length * d + 2 * d, chunk)

    def __call__(self, first: int, state: Tensor, forces: Tensor | None) -> Tensor:
        """Deviations (L d, r), axis by axis, in the block from a tick on, and then the state (2 d, r) after it."""
        if first != self._first:
            each, d = next(self._responses), len(state) // 2
            self._response = torch.cat([each[:-1, :d].transpose(0, 1).flatten(0, 1), each[-1]])
            self._first = first
        size, r = state.shape
        self._inputs[:size, :r] = state
        used = size + 1  # before the first push and after the last, most of the time, no columns of forces
        if forces is not None:
            self._inputs[used:, :r] = forces.flatten(0, 1)
            used = len(self._inputs)
        return torch.mm(self._response[:, :used], self._inputs[:used, :r], out=self._outputs[:, :r])


class _Linear:
    """Rollouts of a linear task: columns of a matrix."""

    def __init__(self, task: Task, start: State, product: _Product) -> None:
        self._state = torch.cat([start[0] - task.position[0], start[1]], dim=-1).mT.contiguous()
        self._product = product

    def move(self, ticks: slice, forces: Tensor | None) -> Tensor:
        """Deviations (d, L, r) at a block of ticks under forces (L, d, r), until the next call for any rollouts."""
        size = len(self._state)
        within = self._product(ticks.start, self._state, forces)
        self._state.copy_(within[-size:])
        return within[:-size].unflatten(0, (size // 2, -1))[:, : ticks.stop - ticks.start]


class _Looped:
    """Rollouts in which something acts at every tick."""

    def __init__(self, task: Task, start: State, hooks: Hooks, generator: torch.Generator) -> None:
        self._task, self._loop = task, Loop(task, start, hooks, generator)
        self._still = torch.zeros_like(start[0])

    def move(self, ticks: slice, forces: Tensor | None) -> Tensor:
        """Deviations (d, L, r) at a block of ticks under forces (L, d, r)."""
        deviations = []
        for tick in range(ticks.start, ticks.stop):
            force = self._still if forces is None else forces[tick - ticks.start].mT
            deviations.append(self._loop.run(tick, force)["position"] - self._task.position[tick])
        return torch.stack(deviations).permute(2, 0, 1)


class Tally:
    """What is kept of each of R rollouts: peak of the deviation, when, and the last tick above a limit.

    The limit is ``threshold`` in m, or else ``share`` of the rollout's own peak.
    """

    def __init__(self, n_rollouts: int, like: Tensor, *, threshold: float | None, share: float) -> None:
        zero = torch.zeros(n_rollouts, dtype=like.dtype, device=like.device)
        self.squared_peak, self.peak_tick, self.last_above = zero, torch.zeros_like(zero), torch.full_like(zero, -1.0)
        self.squared_last = torch.zeros_like(zero)
        self._threshold, self._share = threshold, share

    def add(self, ticks: slice, columns: slice, squared: Float[Tensor, "l r"]) -> None:
        """Squared deviations at further ticks, of some rollouts."""
        numbers = torch.arange(ticks.start, ticks.stop, dtype=squared.dtype, device=squared.device)[:, None]
        highest, peak, tick = squared.amax(0), self.squared_peak[columns], self.peak_tick[columns]
        higher = highest > peak
        if bool(higher.any()):
            when = torch.where(squared == highest, numbers, -1.0).amax(0)
            torch.where(higher, when, tick, out=tick)
            torch.maximum(peak, highest, out=peak)
        # Of its own peak so far: what is counted before that peak is reached, the peak itself overrules.
        limit = self._share**2 * peak if self._threshold is None else torch.full_like(peak, self._threshold**2)
        if bool((highest > limit).any()):
            last = self.last_above[columns]
            torch.maximum(last, torch.where(squared > limit, numbers, -1.0).amax(0), out=last)
        self.squared_last[columns] = squared[-1]
