"""The ticks behind :class:`~torch_pbd.control.AdmittancePlant`, with and without what acts in the loop.

With the deviation y from the desired position, ``M a = u - K y - D v``. Everything is held over a tick, in which the
matrix exponential is then exact, whatever its length; at its end the desired position moves on. Of poses, y is the
position and the rotation from the desired orientation, and that moves on as :mod:`poses` says.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.filters import StiffnessFilter
from torch_pbd.control.simulation.poses import Turning
from torch_pbd.control.simulation.sensor import ForceSensor, PositionLoop

State = tuple[Tensor, Tensor]
"""Position and velocity (..., d)."""

# Transitions that are computed together, which bounds the memory; a power of 2, as the lengths of blocks are.
_MATRICES_AT_ONCE = 2**13


def admittance_rate(
    stiffness: Float[Tensor, "*b d d"], damping: Float[Tensor, "*b d d"], mass: Float[Tensor, "*m d d"]
) -> Float[Tensor, "*b n n"]:
    """Matrix of ``[deviation, velocity, force]' = rate @ [deviation, velocity, force]`` of a held force, n = 3 d."""
    d = stiffness.shape[-1]
    inverse = torch.linalg.inv(mass).expand_as(stiffness)
    rate = stiffness.new_zeros(*stiffness.shape[:-2], 3 * d, 3 * d)
    rate[..., :d, d : 2 * d] = torch.eye(d).to(stiffness)
    rate[..., d : 2 * d, :] = torch.cat([-inverse @ stiffness, -inverse @ damping, inverse], dim=-1)
    return rate


def transition(rate: Float[Tensor, "*b n n"], dt: float) -> Float[Tensor, "*b n n"]:
    """Map of ``[deviation, velocity, force]`` over a tick of ``dt`` s in which everything is held."""
    return torch.linalg.matrix_exp(rate * dt)


def mass_at(mass: Tensor, ticks: int | slice) -> Tensor:
    """Mass at some ticks, of one (d, d) or of those of all ticks (..., T, d, d)."""
    return mass if mass.ndim == 2 else mass[..., ticks, :, :]


@runtime_checkable
class Environment(Protocol):
    """Surroundings of the robot."""

    def force(self, position: Tensor, velocity: Tensor) -> Tensor:
        """Force in N on a robot at these positions, in m, and velocities (..., p); of a pose its position alone."""


@dataclass(frozen=True)
class Task:
    """Run to come, checked: motions (..., T, d), gains (..., T, d, d), and the parts that act in the loop, or None.

    The mass is one (d, d), or one for each tick (..., T, d, d). Positions of poses end in zeros: their rotations are
    counted from the desired orientation, in ``turning``.
    """

    position: Tensor
    velocity: Tensor
    inertial_force: Tensor
    stiffness: Tensor
    damping: Tensor
    mass: Tensor
    dt: float
    sensor: ForceSensor | None
    position_loop: PositionLoop | None
    environment: Environment | None
    substeps: int
    stiffness_filter: StiffnessFilter | None
    turning: Turning | None = None

    @property
    def n_ticks(self) -> int:
        """Number of ticks T."""
        return self.position.shape[-2]

    @property
    def n_positions(self) -> int:
        """Number of positions p among the d axes."""
        return self.position.shape[-1] - (0 if self.turning is None else 3)

    @property
    def motions(self) -> list[Tensor]:
        """What moves in the desired motion (..., T, d), and of poses the turns (..., T, 3)."""
        turns = [] if self.turning is None else [self.turning.turns]
        return [self.position, self.velocity, self.inertial_force, *turns]

    @property
    def is_linear(self) -> bool:
        """True if nothing acts in the loop, and all rollouts of a batch have the same gains and desired motion."""
        acting = (self.sensor, self.position_loop, self.environment, self.stiffness_filter)
        is_shared = self.stiffness.ndim == 3 and all(motion.ndim == 2 for motion in self.motions)
        return is_shared and all(part is None for part in acting)

    def carry(self, tick: int, pose: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d"]:
        """Positions, and rotations counted from the desired orientation after a tick instead of that before it."""
        if self.turning is None:
            return pose
        transport, turn = self.turning.transport[..., tick, :, :], self.turning.turns[..., tick, :]
        rotation = (transport @ pose[..., -3:].unsqueeze(-1)).squeeze(-1) - turn
        return torch.cat([pose[..., :-3].expand(*rotation.shape[:-1], -1), rotation], dim=-1)


def open_loop(task: Task, force: Tensor, state: State) -> State:
    """Poses and velocities (..., T, d) of a linear task under forces (..., T, d), a block of ticks at a time."""
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
    return trace[..., :d] + task.position, trace[..., d:]


def block_length(d: int, n_forces: int = 64) -> int:
    """Ticks of a block with up to so many components of forces, a power of 2, at least 4.

    The longer, the fewer steps, but the work of each grows with its square.
    """
    return 1 << max(2, (n_forces // d).bit_length() - 1)


def block_responses(task: Task, length: int) -> Iterator[Float[Tensor, "l1 m n"]]:
    """States at the ticks of each block of L ticks, as a matrix on what acts there, for a task without a batch.

    A matrix (L + 1, 2 d, 2 d + 1 + L d): of the deviation and velocity at the start of the block, of 1, and of its
    forces, tick by tick. The last of the L + 1 states is that at the start of the next block; ticks beyond the
    last one of the task are as that one.
    """
    d = task.position.shape[-1]
    unit = torch.eye(2 * d + 1 + length * d).to(task.position)
    push = (task.damping @ task.velocity.unsqueeze(-1)).squeeze(-1) + task.inertial_force
    steps = torch.nn.functional.pad(task.position.diff(dim=0), (0, d, 0, 1))  # none after the last tick
    if task.turning is not None:
        steps[:, d - 3 : d] += task.turning.turns
    for ticks, maps in tick_maps(task, task.dt):
        if task.turning is not None:
            position, rotation, velocity = maps.split([d - 3, 3, d], dim=-2)
            maps = torch.cat([position, task.turning.transport[ticks] @ rotation, velocity], dim=-2)
        drift = maps[..., 2 * d :] @ push[ticks].unsqueeze(-1) - steps[ticks].unsqueeze(-1)
        each = torch.cat([maps[..., : 2 * d], drift, maps[..., 2 * d :]], dim=-1)
        surplus = -len(each) % length
        each = torch.cat([each, each[-1:].expand(surplus, -1, -1)]).unflatten(0, (-1, length))
        states = [unit[: 2 * d].expand(len(each), -1, -1)]
        for tick in range(length):
            held = torch.cat([unit[2 * d, None], unit[2 * d + 1 + tick * d :][:d]]).expand(len(each), -1, -1)
            states.append(each[:, tick] @ torch.cat([states[-1], held], dim=1))
        yield from torch.stack(states, dim=1)


def tick_maps(task: Task, dt: float) -> Iterator[tuple[slice, Tensor]]:
    """Maps of stretches of ticks of the task's own gains over ``dt``, (..., n, 2 d, 3 d), and which ticks."""
    batch = max(1, task.stiffness[..., 0, 0, 0].numel())
    n_together = max(1, _MATRICES_AT_ONCE // batch)
    for first in range(0, task.n_ticks, n_together):
        ticks = slice(first, min(first + n_together, task.n_ticks))
        gains = task.stiffness[..., ticks, :, :], task.damping[..., ticks, :, :]
        yield ticks, _tick_map(*gains, mass_at(task.mass, ticks), dt)


def _tick_map(stiffness: Tensor, damping: Tensor, mass: Tensor, dt: float) -> Tensor:
    return transition(admittance_rate(stiffness, damping, mass), dt)[..., : 2 * stiffness.shape[-1], :]


def _tick_change(stiffness: Tensor, damping: Tensor, mass: Tensor, dt: float) -> Tensor:
    each = _tick_map(stiffness, damping, mass, dt)
    return each - torch.eye(each.shape[-1]).to(each)[: each.shape[-2]]


class Loop:
    """State (..., d) of a run with what acts in it, which moves on tick by tick."""

    def __init__(self, task: Task, state: State, generator: torch.Generator | None) -> None:
        self._task = task
        self._deviation, self._velocity = state[0] - task.position[..., 0, :], state[1]
        loop, sensor, wanted = task.position_loop, task.sensor, task.stiffness_filter
        self._robot = None if loop is None else loop.start(*state, task.dt)
        self._read = None if sensor is None else sensor.start(state[0], task.dt, generator)
        gains = task.stiffness, task.damping, task.mass
        self._filter = None if wanted is None else wanted.start(*gains, _tick_change)
        self._maps = (each for _, maps in tick_maps(task, task.dt / task.substeps) for each in maps.unbind(-3))

    def run(self, tick: int, force: Tensor) -> dict[str, Tensor]:
        """One tick under a force (..., d): measure, choose the gains, move; fields of a Rollout at its start."""
        task = self._task
        desired = task.position[..., tick, :]
        stiffness, damping = task.stiffness[..., tick, :, :], task.damping[..., tick, :, :]
        commanded = self._deviation + desired
        at = (commanded, self._velocity) if self._robot is None else (self._robot.position, self._robot.velocity)
        total = force + self._wall(*at)
        record = {"position": at[0], "velocity": at[1], "commanded_position": commanded, "force": total}
        if self._filter is not None:
            self._filter.select(stiffness, damping, mass_at(task.mass, tick), task.dt, self._deviation)
            stiffness, damping, record["filter_share"] = self._filter.gains
            if self._filter.tank_energy is not None:
                record["tank_energy"] = self._filter.tank_energy
        measured = total
        if self._read is not None:
            measured, record["saturated"] = self._read(total)
        push = (damping @ task.velocity[..., tick, :].unsqueeze(-1)).squeeze(-1) + task.inertial_force[..., tick, :]
        if self._filter is None:
            each = next(self._maps)
        else:
            each = _tick_map(stiffness, damping, mass_at(task.mass, tick), task.dt)
        self._move(each, (force, measured), push, desired)
        if self._robot is not None:
            self._robot(commanded)
        if tick + 1 < task.n_ticks:
            self._deviation = task.carry(tick, self._deviation) - (task.position[..., tick + 1, :] - desired)
            if self._robot is not None:
                self._robot.carry(partial(task.carry, tick))
            if self._filter is not None and task.turning is not None:
                self._filter.carry(task.turning.transport[..., tick, :, :])
        return record | {"stiffness": stiffness, "damping": damping}

    def _wall(self, position: Tensor, velocity: Tensor) -> Tensor:
        walls, p = self._task.environment, self._task.n_positions
        if walls is None:
            return torch.zeros_like(position)
        force = walls.force(position[..., :p], velocity[..., :p])
        return torch.nn.functional.pad(force, (0, position.shape[-1] - p))  # on a point: without a torque

    def _move(self, each: Tensor, forces: tuple[Tensor, Tensor], push: Tensor, desired: Tensor) -> None:
        """Move over the tick by its map and the measured force; the walls are evaluated anew in each of its parts."""
        outside, force = forces
        for part in range(self._task.substeps):
            before = self._deviation, self._velocity
            if part:
                force = outside + self._wall(before[0] + desired, before[1])
            held = (force + push).expand_as(before[0])
            state = torch.cat([*before, held], dim=-1)
            after = state @ each.mT if each.ndim == 2 else (each @ state.unsqueeze(-1)).squeeze(-1)
            self._deviation, self._velocity = after.chunk(2, dim=-1)
            if self._filter is not None:
                self._filter.settle(before, (self._deviation, self._velocity), held)
