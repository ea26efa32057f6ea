"""Ticks of :class:`~torch_pbd.control.AdmittancePlant`, for open loops and with sensors, loops and filters.

With the deviation y from the desired position, ``M a = u - K y - D v``. Everything is held over a tick, in which the
matrix exponential is then exact, whatever its length; at its end the desired position moves on.

Of poses, y is the position, and the rotation of the robot R from the desired R_d as the vector ``e = Log(R R_d')``, in
world axes. In a tick, R_d stands still and e moves with the angular velocity w; at its end R_d turns by ``delta``, and
e becomes ``exp([delta]) (e - delta)``. Of a robot that turned by delta itself, so that e had become ``e + delta``, this
is exact: R and R_d are then both turned in the world, and e with them. It is the discrete form of
``e' = w - w_d + w_d x e``, to first order in e.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.filters import admittance_rate
from torch_pbd.linalg import broadcast_shapes

State = tuple[Tensor, Tensor]
"""Position and velocity (..., d)."""

# Transitions that are computed together, which bounds the memory; a power of 2, as the lengths of blocks are.
_MATRICES_AT_ONCE = 2**13


@runtime_checkable
class Environment(Protocol):
    """Surroundings of the robot."""

    def force(self, position: Tensor, velocity: Tensor) -> Tensor:
        """Force (..., p) in N on a robot at these positions in m and velocities in m/s, without the rotation."""


@dataclass(frozen=True)
class Task:
    """Checked inputs of a run: motions (..., T, d), gains and masses (..., T, d, d), and the ``plant`` that follows.

    At the end of each tick but the last, the desired pose moves on by its step. Positions of poses end in zeros, since
    their rotations are relative to the desired ``orientation`` (..., T, 4); vectors turn with it by ``transport``
    (..., T, 3, 3).
    """

    position: Tensor
    velocity: Tensor
    inertial_force: Tensor
    steps: Tensor
    stiffness: Tensor
    damping: Tensor
    mass: Tensor
    dt: float
    plant: Any
    orientation: Tensor | None = None
    transport: Tensor | None = None

    @property
    def n_ticks(self) -> int:
        """Number of ticks T."""
        return self.position.shape[-2]

    @property
    def n_positions(self) -> int:
        """Number of positions p among the d axes."""
        return self.position.shape[-1] - (0 if self.orientation is None else 3)

    @property
    def batch(self) -> torch.Size:
        """Batch dimensions of gains and desired motion."""
        parts = (self.velocity, self.inertial_force, self.steps, self.stiffness[..., 0])
        return broadcast_shapes(*(part.shape[:-2] for part in parts))

    @property
    def is_linear(self) -> bool:
        """Whether nothing acts in the loop and all rollouts of a batch share gains and desired motion."""
        plant = self.plant
        parts = (plant.sensor, plant.position_loop, plant.environment, plant.stiffness_filter)
        return not self.batch and all(part is None for part in parts)

    def carry(self, tick: int, deviation: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d"]:
        """Deviations from the desired pose after a tick instead of before it."""
        if self.transport is not None:
            turned = self.transport[..., tick, :, :] @ deviation[..., -3:].unsqueeze(-1)
            deviation = torch.cat([deviation[..., :-3], turned.squeeze(-1)], dim=-1)
        return deviation - self.steps[..., tick, :]


def open_loop(task: Task, force: Tensor, state: State) -> State:
    """Deviations and velocities (..., T, d) of a linear task under forces (..., T, d), a block of ticks at a time."""
    d, length = task.position.shape[-1], block_length(task.position.shape[-1], n_forces=32)
    now = torch.cat([state[0] - task.position[0], state[1]], dim=-1)
    batch = now.shape[:-1]
    forces = torch.nn.functional.pad(force, (0, 0, 0, -task.n_ticks % length)).flatten(-2).expand(*batch, -1)
    now, forces = now.reshape(-1, 2 * d).mT, forces.reshape(-1, forces.shape[-1]).mT  # rollouts are columns
    states = []
    for response, held in zip(block_responses(task, length), forces.split(length * d), strict=True):
        of_start, drift, of_forces = response.flatten(0, 1).split([2 * d, 1, len(held)], dim=1)
        within = drift + of_start @ now + of_forces @ held
        states.append(within[: -2 * d])
        now = within[-2 * d :]
    trace = torch.cat(states).mT.reshape(*batch, -1, 2 * d)[..., : task.n_ticks, :]
    return trace[..., :d], trace[..., d:]


def block_length(d: int, n_forces: int = 64) -> int:
    """Number of ticks in a block with at most ``n_forces`` force components, a power of 2 and at least 4.

    Longer blocks need fewer steps, but the work of each grows with the square of its length.
    """
    return 1 << max(2, (n_forces // d).bit_length() - 1)


def block_responses(task: Task, length: int) -> Iterator[Float[Tensor, "l1 m n"]]:
    """Matrix that maps the inputs of each block of L ticks to its states, for a task without a batch.

    The matrix (L + 1, 2 d, 2 d + 1 + L d) acts on the deviation and velocity at the start of the block, on 1, and on
    its forces, tick by tick. The last of the L + 1 states is that at the start of the next block; ticks beyond the
    last one of the task repeat that one.
    """
    d = task.position.shape[-1]
    unit = torch.eye(2 * d + 1 + length * d).to(task.position)
    push = (task.damping @ task.velocity.unsqueeze(-1)).squeeze(-1) + task.inertial_force
    steps = torch.nn.functional.pad(task.steps, (0, d))
    for ticks, maps in tick_maps(task, task.dt):
        if task.transport is not None:
            position, rotation, velocity = maps.split([d - 3, 3, d], dim=-2)
            maps = torch.cat([position, task.transport[ticks] @ rotation, velocity], dim=-2)
        drift = maps[..., 2 * d :] @ push[ticks].unsqueeze(-1) - steps[ticks].unsqueeze(-1)
        each = torch.cat([maps[..., : 2 * d], drift, maps[..., 2 * d :]], dim=-1)
        each = torch.cat([each, each[-1:].expand(-len(each) % length, -1, -1)]).unflatten(0, (-1, length))
        states = [unit[: 2 * d].expand(len(each), -1, -1)]
        for tick in range(length):
            held = torch.cat([unit[2 * d, None], unit[2 * d + 1 + tick * d :][:d]]).expand(len(each), -1, -1)
            states.append(each[:, tick] @ torch.cat([states[-1], held], dim=1))
        yield from torch.stack(states, dim=1)


def tick_maps(task: Task, dt: float) -> Iterator[tuple[slice, Tensor]]:
    """Stretches of n ticks, each with its maps (..., n, 2 d, 3 d) over ``dt`` under the task's gains."""
    n_together = max(1, _MATRICES_AT_ONCE // task.stiffness[..., 0, 0, 0].numel())
    for first in range(0, task.n_ticks, n_together):
        ticks = slice(first, first + n_together)
        stiffness, damping, mass = (gain[..., ticks, :, :] for gain in (task.stiffness, task.damping, task.mass))
        yield ticks, tick_map(stiffness, damping, mass, dt)


def tick_map(stiffness: Tensor, damping: Tensor, mass: Tensor, dt: float) -> Tensor:
    """Map of ``[deviation, velocity, force]`` to the deviation and velocity after a tick of ``dt`` s."""
    return torch.linalg.matrix_exp(dt * admittance_rate(stiffness, damping, mass))[..., : 2 * stiffness.shape[-1], :]
