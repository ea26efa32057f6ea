"""The robot's inner position loop, by which it follows a commanded position late."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks


@final
@dataclass(frozen=True, repr=False)
class PositionLoop:
    """A critically damped loop of second order behind a delay of whole ticks.

    ``x'' = w^2 (x_commanded - x) - 2 w x'`` with ``w = 2 pi bandwidth``: it follows a ramp ``2 / w``, the
    delay, and half a tick of hold late.

    Parameters
    ----------
    bandwidth : float, default=20.0
        In Hz.
    delay_steps : int, default=1
        Ticks between a command and its effect, at least 0.
    """

    bandwidth: float = 20.0
    delay_steps: int = 1

    def __post_init__(self) -> None:
        checks.number(self.bandwidth, "bandwidth", above=0.0, unit="Hz")
        checks.count(self.delay_steps, "delay_steps", least=0)

    def __repr__(self) -> str:
        return f"PositionLoop(bandwidth={self.bandwidth:g} Hz, delay_steps={self.delay_steps})"

    def transition(self, dt: float, like: Tensor) -> Float[Tensor, "2 3"]:
        """Exact map of ``[position, velocity, command]`` to the position and velocity a tick later."""
        # For a held command c, x - c = e^-wt ((1 + w t) (x_0 - c) + t v_0): critical damping has one root, twice.
        w = 2.0 * math.pi * self.bandwidth
        decay = math.exp(-w * dt)
        rows = [
            [(1.0 + w * dt) * decay, dt * decay, 1.0 - (1.0 + w * dt) * decay],
            [-w * w * dt * decay, (1.0 - w * dt) * decay, w * w * dt * decay],
        ]
        return torch.tensor(rows, dtype=like.dtype, device=like.device)

    def start(self, position: Float[Tensor, "*b d"], velocity: Float[Tensor, "*b d"], dt: float) -> "_Following":
        """State of a loop at rest with its commands: the robot is at ``position``."""
        return _Following(self.transition(dt, position), position, velocity, [position] * self.delay_steps)


class _Following:
    """Position and velocity of the robot; called with a command, it moves on by a tick."""

    def __init__(self, transition: Tensor, position: Tensor, velocity: Tensor, waiting: list[Tensor]) -> None:
        self.position, self.velocity = position, velocity
        self._transition, self._waiting = transition, list(waiting)

    def carry(self, change: Callable[[Tensor], Tensor]) -> None:
        """Count position and waiting commands from another origin."""
        self.position, self._waiting = change(self.position), [change(each) for each in self._waiting]

    def __call__(self, command: Tensor) -> None:
        self._waiting.append(command)
        state = torch.stack([self.position, self.velocity, self._waiting.pop(0)], dim=-1)
        self.position, self.velocity = (state @ self._transition.mT).unbind(-1)
