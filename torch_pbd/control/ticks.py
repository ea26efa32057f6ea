"""The loop over ticks behind :class:`~torch_pbd.control.AdmittancePlant`, with and without what acts in it."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.environment import Tunnel
from torch_pbd.control.passivity import ActiveFilter, StiffnessFilter
from torch_pbd.control.position_loop import PositionLoop
from torch_pbd.control.sensor import ForceSensor
from torch_pbd.control.transitions import Integrator, admittance_rate, transition

_MATRICES_AT_ONCE = 50_000  # transitions computed together: bounds the memory

State = tuple[Tensor, Tensor]
"""Position and velocity (..., d)."""


@dataclass(frozen=True)
class Task:
    """What a run is to follow, checked: motions and forces (..., T, d), gains (..., T, d, d)."""

    position: Tensor
    velocity: Tensor
    inertial_force: Tensor
    stiffness: Tensor
    damping: Tensor
    force: Tensor
    mass: Tensor
    dt: float

    @property
    def n_ticks(self) -> int:
        """Number of ticks T."""
        return self.position.shape[-2]


@runtime_checkable
class Hooks(Protocol):
    """What acts within the loop; None where there is no such thing."""

    sensor: ForceSensor | None
    position_loop: PositionLoop | None
    environment: Tunnel | None
    substeps: int
    stiffness_filter: Any
    integrator: Integrator


def open_loop(task: Task, state: State, integrator: Integrator) -> State:
    """Positions and velocities (..., T, d) where force and gains are known beforehand."""
    push = (task.damping @ task.velocity.unsqueeze(-1)).squeeze(-1) + task.inertial_force
    total = task.force + push
    deviation, velocity = state[0] - task.position[..., 0, :], state[1]
    d = deviation.shape[-1]
    states = []
    for tick, each in enumerate(_maps(task, task.dt, integrator)):
        states.append(torch.cat([deviation, velocity], dim=-1))
        deviation, velocity = _moved(each, deviation, velocity, total[..., tick, :].expand_as(deviation))
        if tick + 1 < task.n_ticks:
            deviation = deviation - (task.position[..., tick + 1, :] - task.position[..., tick, :])
    trace = torch.stack(states, dim=-2)
    return trace[..., :d] + task.position, trace[..., d:]


def _maps(task: Task, dt: float, integrator: Integrator) -> Iterator[Tensor]:
    """Map of each tick of the task's own gains over ``dt``, (..., 2 d, 3 d), computed in blocks."""
    batch = max(1, task.stiffness[..., 0, 0, 0].numel())
    block = max(1, _MATRICES_AT_ONCE // batch)
    for first in range(0, task.n_ticks, block):
        ticks = slice(first, first + block)
        yield from _tick_map(
            task.stiffness[..., ticks, :, :], task.damping[..., ticks, :, :], task.mass, dt, integrator
        ).unbind(-3)


def _tick_map(stiffness: Tensor, damping: Tensor, mass: Tensor, dt: float, integrator: Integrator) -> Tensor:
    return transition(admittance_rate(stiffness, damping, mass), dt, integrator)[..., : 2 * stiffness.shape[-1], :]


def _moved(each: Float[Tensor, "*b m n"], deviation: Tensor, velocity: Tensor, force: Tensor) -> State:
    """State after a tick, of its map (m = 2 d rows, n = 3 d columns), the state before it and the force held."""
    before = torch.cat([deviation, velocity, force], dim=-1)
    after = before @ each.mT if each.ndim == 2 else (each @ before.unsqueeze(-1)).squeeze(-1)
    d = deviation.shape[-1]
    return after[..., :d], after[..., d:]


def closed_loop(task: Task, state: State, hooks: Hooks, generator: torch.Generator | None) -> dict[str, Any]:
    """Fields of a Rollout where a sensor, walls, a position loop or a filter act within the loop."""
    loop = _Loop(task, state, hooks, generator)
    for tick in range(task.n_ticks):
        loop.run(tick)
    return loop.record()


class _Loop:
    """State of a closed-loop run, and what is recorded of it."""

    def __init__(self, task: Task, state: State, hooks: Hooks, generator: torch.Generator | None) -> None:
        self._task, self._hooks = task, hooks
        self._deviation, self._velocity = state[0] - task.position[..., 0, :], state[1]
        self._robot = None if hooks.position_loop is None else hooks.position_loop.start(*state, task.dt)
        self._read = None if hooks.sensor is None else hooks.sensor.start(state[0], task.dt, generator)
        wanted: StiffnessFilter | None = hooks.stiffness_filter
        self._filter: ActiveFilter | None = None
        if wanted is not None:
            self._filter = wanted.start(task.stiffness, task.damping, task.mass, task.dt)
        self._part = task.dt / hooks.substeps
        self._maps = _maps(task, self._part, hooks.integrator)
        self._trace: dict[str, list[Tensor]] = {}

    def run(self, tick: int) -> None:
        """One tick: measure, choose the gains, move."""
        task = self._task
        desired = task.position[..., tick, :]
        commanded = self._deviation + desired
        position, velocity = (commanded, self._velocity) if self._robot is None else (
            self._robot.position, self._robot.velocity
        )  # fmt: skip
        force = task.force[..., tick, :] + self._wall(position, velocity)
        self._note(position=position, velocity=velocity, commanded_position=commanded, force=force)
        stiffness, damping = self._gains(tick)
        push = (damping @ task.velocity[..., tick, :].unsqueeze(-1)).squeeze(-1) + task.inertial_force[..., tick, :]
        self._move(stiffness, damping, self._measured(force), push, tick)
        if self._robot is not None:
            self._robot(commanded)
        if tick + 1 < task.n_ticks:
            self._deviation = self._deviation - (task.position[..., tick + 1, :] - desired)

    def _wall(self, position: Tensor, velocity: Tensor) -> Tensor:
        environment = self._hooks.environment
        return torch.zeros_like(position) if environment is None else environment.force(position, velocity)

    def _measured(self, force: Tensor) -> Tensor:
        if self._read is None:
            return force
        reading = self._read(force)
        self._note(saturated=reading.saturated)
        return reading.force

    def _gains(self, tick: int) -> tuple[Tensor, Tensor]:
        stiffness, damping = self._task.stiffness[..., tick, :, :], self._task.damping[..., tick, :, :]
        if self._filter is not None:
            gains = self._filter.select(stiffness, damping, self._deviation, self._velocity)
            stiffness, damping = gains.stiffness, gains.damping
            self._note(filter_share=gains.share)
            if self._filter.tank_energy is not None:
                self._note(tank_energy=self._filter.tank_energy)
        self._note(stiffness=stiffness, damping=damping)
        return stiffness, damping

    def _move(self, stiffness: Tensor, damping: Tensor, measured: Tensor, push: Tensor, tick: int) -> None:
        """Move over the tick; the walls are evaluated anew in each of its parts."""
        hooks, task = self._hooks, self._task
        if self._filter is None:
            each = next(self._maps)
        else:
            each = _tick_map(stiffness, damping, task.mass, self._part, hooks.integrator)
        force = measured
        for part in range(hooks.substeps):
            before = self._deviation, self._velocity
            if part:
                wall = self._wall(before[0] + task.position[..., tick, :], before[1])
                force = task.force[..., tick, :] + wall
            held = (force + push).expand_as(before[0])
            self._deviation, self._velocity = _moved(each, *before, held)
            if self._filter is not None:
                self._filter.settle(before, (self._deviation, self._velocity), held)

    def _note(self, **values: Tensor) -> None:
        for name, value in values.items():
            self._trace.setdefault(name, []).append(value)

    def record(self) -> dict[str, Any]:
        """All that was recorded, ticks stacked behind the batch."""
        behind = {"position": 2, "velocity": 2, "force": 2, "commanded_position": 2, "stiffness": 3, "damping": 3}
        return {name: torch.stack(values, dim=-behind.get(name, 1)) for name, values in self._trace.items()}
