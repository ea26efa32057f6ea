"""A simulated run: states, forces and gains over time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, final

import torch
from torch import Tensor
from torch.nn.functional import pad

from torch_pbd import checks, rotations
from torch_pbd.control.simulation.ticks import State, Task, open_loop, tick_map, tick_maps
from torch_pbd.files.memory import require_memory
from torch_pbd.linalg import broadcast_shapes

# Angle in rad beyond which a run warns: there the path of a push errs by a quarter of its largest angle.
_FAR = 0.5 * math.pi
# Number of dimensions of a run's values after the batch, ticks alone or what is listed.
_N_DIMS = {"deviation": 2, "commanded": 2, "velocity": 2, "force": 2, "stiffness": 3, "damping": 3}


@final
@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """States at the start of each tick of a simulated run, as tensors or, by ``numpy()``, arrays.

    Runs of positions have p = d. Runs of poses have p = d - 3, the last three axes being rotations in world axes, in
    rad/s, Nm, Nm/rad and Nm s/rad.

    Attributes
    ----------
    time : (T,), s
    position, velocity : (..., T, p), m, and (..., T, d), m/s
    force : (..., T, d), N
        External force on the robot, including that of walls.
    stiffness, damping : (..., T, d, d), N/m and N s/m
        Gains in effect during the tick, after the filter.
    desired_position : (..., T, p), m
    deviation : (..., T, d), m
        Position minus desired position, and for poses the rotation vector e from the desired orientation in world
        axes, ``R = exp([e]) R_d``.
    commanded_position : (..., T, p), m
        Command of the admittance to the robot's position loop; ``position`` if there is no loop.
    filter_share : (..., T) or None
        Share of the stiffness step that a filter passed, 1 where it did not intervene.
    tank_energy : (..., T) or None
        Energy in the tank during the tick, J.
    saturated : (..., T) of bool or None
        Whether the force sensor was saturated.
    orientation, desired_orientation, commanded_orientation : (..., T, 4) or None
        Unit quaternions w x y z in runs of poses.
    units : str or None
        Units of the schedule's positions, None if unknown. For "rad" (joints), read rad for m and Nm for N above.
    """

    time: Any
    position: Any
    velocity: Any
    force: Any
    stiffness: Any
    damping: Any
    desired_position: Any
    deviation: Any
    commanded_position: Any
    filter_share: Any = None
    tank_energy: Any = None
    saturated: Any = None
    orientation: Any = None
    desired_orientation: Any = None
    commanded_orientation: Any = None
    units: str | None = "m"

    def __repr__(self) -> str:
        *batch, n_ticks, d = self.velocity.shape
        p = self.position.shape[-1]
        turned = "" if d == p else f" and {float(abs(self.deviation[..., p:]).max()):.3g} rad"
        return (
            f"Rollout({f'batch={tuple(batch)}, ' if batch else ''}n_ticks={n_ticks}, n_outputs={d}, "
            f"time={float(self.time[0]):.6g}..{float(self.time[-1]):.6g} s, "
            f"deviation up to {float(abs(self.deviation[..., :p]).max()):.3g} {self.units or 'units'}{turned})"
        )

    def numpy(self) -> "Rollout":
        """Copy of the run as NumPy arrays."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays: dict[str, Any] = {k: v.detach().cpu().numpy() for k, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **arrays)

    def plot(self, *, unpushed: "Rollout | None" = None, names: Sequence[str] | None = None) -> Any:
        """Plot deviation, external force and stiffness over time, of a single run, in a new figure.

        Parameters
        ----------
        unpushed : Rollout, default=None
            The same run without pushes, drawn in the background.
        names : sequence of d str, default=None
            Names of the outputs; None calls them y0, y1, ...

        Returns
        -------
        list of three matplotlib Axes, or for poses of six: three of positions, then three of rotations
        """
        from torch_pbd.plotting.display import plot_pushes  # here: it needs matplotlib, a run does not

        return plot_pushes(self, unpushed, names)

    @property
    def interventions(self) -> Any:
        """Times (n,) in s at which a filter held back the stiffness of a single run; batches have ``filter_share``."""
        return self.time[:0] if self.filter_share is None else self.time[self.filter_share < 1.0]


class Loop:
    """State (..., d) of a run with sensor, loop, walls and filter, advanced tick by tick."""

    def __init__(self, task: Task, state: State, generator: torch.Generator | None) -> None:
        self._task, plant, loop = task, task.plant, task.plant.position_loop
        # What is commanded, the robot behind its loop, and the commands that it has yet to follow are all deviations.
        self._command = self._robot = state[0] - task.position[..., 0, :], state[1]
        self._follow = loop and loop.transition(task.dt, state[0])
        self._waiting = [self._command[0]] * (loop.delay_steps if loop else 0)
        self._read = plant.sensor and plant.sensor.start(state[0], task.dt, generator)
        gains = task.stiffness, task.damping, task.mass
        self._filter = plant.stiffness_filter and plant.stiffness_filter.start(*gains)
        self._maps = (each for _, maps in tick_maps(task, task.dt / plant.substeps) for each in maps.unbind(-3))

    def run(self, tick: int, force: Tensor) -> dict[str, Tensor]:
        """Fields of a Rollout at the start of a tick under a force (..., d), and the deviation that is commanded."""
        task, commanded = self._task, self._command[0]
        desired = task.position[..., tick, :]
        stiffness, damping, mass = (gain[..., tick, :, :] for gain in (task.stiffness, task.damping, task.mass))
        away, speed = self._command if self._follow is None else self._robot
        measured = total = force + self._wall(away + desired, speed)
        record = {"deviation": away, "commanded": commanded, "velocity": speed, "force": total}
        if self._read is not None:
            measured, record["saturated"] = self._read(total)
        if self._filter is None:
            each = next(self._maps)
        else:
            self._filter.select(stiffness, damping, mass, task.dt, commanded)
            stiffness, damping, record["filter_share"] = self._filter.gains
            if self._filter.tank_energy is not None:
                record["tank_energy"] = self._filter.tank_energy
            each = tick_map(stiffness, damping, mass, task.dt)
        push = (damping @ task.velocity[..., tick, :].unsqueeze(-1)).squeeze(-1) + task.inertial_force[..., tick, :]
        for part in range(task.plant.substeps):
            before = self._command
            if part:  # the walls are evaluated anew in each part of the tick
                measured = force + self._wall(before[0] + desired, before[1])
            held = (measured + push).expand_as(before[0])
            state = torch.cat([*before, held], dim=-1)
            after = state @ each.mT if each.ndim == 2 else (each @ state.unsqueeze(-1)).squeeze(-1)
            self._command = after[..., : held.shape[-1]], after[..., held.shape[-1] :]
            if self._filter is not None:
                self._filter.settle(before, self._command, held)
        self._move_on(tick, commanded)
        return record | {"stiffness": stiffness, "damping": damping}

    def _move_on(self, tick: int, commanded: Tensor) -> None:
        """Let the robot follow its command, and express all relative to the next tick's desired pose."""
        task = self._task
        self._command = task.carry(tick, self._command[0]), self._command[1]
        if self._follow is not None:
            self._waiting.append(commanded)
            state = torch.stack([*self._robot, self._waiting.pop(0)], dim=-1)
            away, speed = (state @ self._follow.mT).unbind(-1)
            self._robot = task.carry(tick, away), speed
            self._waiting = [task.carry(tick, each) for each in self._waiting]
        if self._filter is not None and task.transport is not None:
            self._filter.carry(task.transport[..., tick, :, :])

    def _wall(self, position: Tensor, velocity: Tensor) -> Tensor:
        walls, p = self._task.plant.environment, self._task.n_positions
        if walls is None:
            return torch.zeros_like(position)
        force = walls.force(position[..., :p], velocity[..., :p])
        return pad(force, (0, position.shape[-1] - p))  # on a point: without a torque


def run_task(
    task: Task,
    force: Tensor | None = None,
    position0: Tensor | None = None,
    velocity0: Tensor | None = None,
    orientation0: Tensor | None = None,
    *,
    generator: torch.Generator | None = None,
) -> Rollout:
    """Run of a task under a checked force (..., T, d) from a checked start (..., p), (..., d), (..., 4)."""
    force = torch.zeros_like(task.velocity) if force is None else force
    p, start = task.n_positions, _start(task, position0, orientation0)
    speed = task.velocity[..., 0, :] if velocity0 is None else velocity0
    batch = broadcast_shapes(task.batch, force.shape[:-2], start.shape[:-1], speed.shape[:-1])
    state = start.expand(*batch, -1), speed.expand(*batch, -1)
    _check_memory(task, batch.numel())
    if task.is_linear:
        record: dict[str, Any] = {"force": force, "stiffness": task.stiffness, "damping": task.damping}
        record["deviation"], record["velocity"] = open_loop(task, force, state)
        record["commanded"] = record["deviation"]
    else:
        loop = Loop(task, state, generator)
        ticks = [loop.run(tick, force[..., tick, :]) for tick in range(task.n_ticks)]
        record = {name: torch.stack([each[name] for each in ticks], dim=-_N_DIMS.get(name, 1)) for name in ticks[0]}
    record = {name: value.expand(*batch, *value.shape[-_N_DIMS.get(name, 1) :]) for name, value in record.items()}
    finite = torch.isfinite(record["deviation"] + record["velocity"]).all(-1)
    if not bool(finite.all()):
        tick = int((~finite.reshape(-1, task.n_ticks).all(0)).nonzero()[0])
        raise ValueError(
            f"the simulation diverged, and is not finite from tick {tick} on: take a shorter dt, or smaller stiffness, "
            "velocity and force."
        )
    at, commanded = record["deviation"], record.pop("commanded")
    if task.orientation is not None:
        warn_if_far(float(torch.linalg.vector_norm(at.detach()[..., p:], dim=-1).max()))
        record["desired_orientation"] = task.orientation
        record["orientation"], record["commanded_orientation"] = (
            rotations.multiply(rotations.exp(each[..., p:]), task.orientation) for each in (at, commanded)
        )
    desired = task.position[..., :p]
    record["position"], record["commanded_position"] = (each[..., :p] + desired for each in (at, commanded))
    time = torch.arange(task.n_ticks, dtype=force.dtype, device=force.device) * task.dt
    return Rollout(time, desired_position=desired, **record)


def _start(task: Task, position0: Tensor | None, orientation0: Tensor | None) -> Tensor:
    """Initial pose (..., d) in the coordinates of :class:`Task`."""
    p, start = task.n_positions, task.position[..., 0, :]
    if position0 is not None:
        start = pad(position0, (0, start.shape[-1] - p))
    if task.orientation is None or orientation0 is None:
        return start
    return start + pad(rotations.between(task.orientation[..., 0, :], orientation0), (p, 0))


def _check_memory(task: Task, n_rollouts: int) -> None:
    if task.position.device.type != "cpu":  # torch raises by itself on other devices
        return
    # Measured: eight motions are held, tick by tick fourteen, of poses one more and two orientations, and where
    # rollouts differ in their gains, twelve matrices.
    d = task.position.shape[-1]
    own_gains = task.stiffness.ndim > 3 or task.plant.stiffness_filter is not None
    of_each = (8 if task.is_linear else 14) * d + (12 * d * d if own_gains else 0)
    of_each += 0 if task.orientation is None else d + 8
    needed = of_each * n_rollouts * task.n_ticks * task.position.element_size()
    remedy = "Simulate fewer at a time, or take simulate_many, which keeps no trajectories."
    require_memory(needed, what=f"a simulation of {n_rollouts} rollouts of {task.n_ticks} ticks", remedy=remedy)


def warn_if_far(angle: float) -> None:
    """Warn where the robot is too far from the desired orientation for the linear model."""
    if angle > _FAR:
        checks.warn(
            f"The robot is turned by up to {angle:.2g} rad from the desired orientation, where the linear plant "
            "is off by a quarter of the path or more: push less, or raise the stiffness of rotations."
        )
