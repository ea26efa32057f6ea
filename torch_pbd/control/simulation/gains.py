"""Gains in effect during a run, and what stands between them and those of the schedule."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from torch_pbd.linalg import symmetrize

State = tuple[Tensor, Tensor]
"""Position and velocity (..., d)."""


@dataclass(frozen=True)
class Gains:
    """Stiffness and damping in effect, (..., d, d), and the share (...) of the step towards the wanted ones."""

    stiffness: Tensor
    damping: Tensor
    share: Tensor


class ActiveFilter(ABC):
    """Filter of the gains in a run, of a robot of a mass (d, d), or of one for each tick (..., T, d, d)."""

    tank_energy: Tensor | None = None
    _gains: Gains | None = None
    _turn: Tensor | None = None
    _tick = -1

    def __init__(self, mass: Tensor) -> None:
        self._mass = mass

    @abstractmethod
    def select(self, stiffness: Tensor, damping: Tensor, deviation: Tensor) -> Gains:
        """Gains for this tick, of the wanted ones (..., d, d) and the deviation (..., d) at its start."""

    def carry(self, turn: Tensor) -> None:
        """Take the gains along where the desired orientation turns, by a matrix (..., 3, 3), at the end of a tick."""
        self._turn = turn

    def _begin(self) -> tuple[Gains | None, Gains | None]:
        """Gains of the last tick, as they were and as they are held on to in this one, that now begins."""
        self._tick += 1
        last, turn = self._gains, self._turn
        if last is None or turn is None:
            return last, last
        d = last.stiffness.shape[-1]
        whole = torch.eye(d).to(turn).repeat(*turn.shape[:-2], 1, 1)
        whole[..., d - 3 :, d - 3 :] = turn
        held = [symmetrize(whole @ gain @ whole.mT) for gain in (last.stiffness, last.damping)]
        return last, Gains(held[0], held[1], last.share)

    def settle(self, before: State, after: State, force: Tensor) -> None:  # noqa: B027 - most have nothing to note
        """Take note of the tick: (deviation, velocity) at its start and end, and the force held in it."""


@runtime_checkable
class StartFilter(Protocol):
    """Begin of a run of a filter."""

    def __call__(self, stiffness: Tensor, damping: Tensor, mass: Tensor, dt: float) -> ActiveFilter:
        """Begin a run over the wanted gains (..., T, d, d), of a mass (d, d) or (..., T, d, d)."""


def mass_at(mass: Tensor, ticks: int | slice) -> Tensor:
    """Mass at some ticks, of one (d, d) or of those of all ticks (..., T, d, d)."""
    return mass if mass.ndim == 2 else mass[..., ticks, :, :]
