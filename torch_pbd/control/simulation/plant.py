"""The simulated robot under admittance control: eq. (15) with a mass, tick by tick."""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, final

import torch
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.control.filters import StiffnessFilter
from torch_pbd.control.matrices import as_mass, as_tensor, mass_rows
from torch_pbd.control.simulation.filters import started
from torch_pbd.control.simulation.given import check_given
from torch_pbd.control.simulation.poses import exp, multiply, rotation_between, turning, warn_if_far
from torch_pbd.control.simulation.position_loop import PositionLoop
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.simulation.sensor import ForceSensor
from torch_pbd.control.simulation.ticks import Environment, Task, closed_loop, open_loop
from torch_pbd.files.memory import require_memory
from torch_pbd.linalg import broadcast_shapes

_PARTS = ("sensor", "position_loop", "environment", "stiffness_filter")


@final
class AdmittancePlant:
    """A mass on a spring and a damper that a desired motion drags along, in d axes, batched over rollouts.

    ``M a = f + K (x_d - x) + D (v_d - v)``, eq. (15) as admittance. All inputs are held over a tick (zero-order hold),
    in which the desired position stands still; states are those at the start of ticks. Of poses, ``x - x_d`` is
    ``(p - p_d, Log(R R_d'))`` in world axes, v the twist. That is linear in the rotation away from the desired
    orientation, which itself may turn as it likes: peaks under pushes are right to 1 % up to 1 rad away, the paths to
    them off by 3 % at 0.2 rad and 16 % at 1 rad.

    Parameters
    ----------
    mass : float, Tensor of shape (d, d) or (..., T, d, d), callable or None, default=1.0
        Virtual mass in kg, or inertia of the robot, for poses in kg, kg m and kg m^2, at all ticks or at each: it
        does not change the velocity when it changes. Matrices must be symmetric and positive definite. A function
        maps times (T,) in s to such matrices. None is the mass of the schedule, or 1 kg where there is none.
    integrator : {"exact"}, default="exact"
        It solves the tick, whatever its length.
    feed_forward : bool, default=False
        Add ``M a_d``, which eq. (15) lacks: the robot then follows but for half a tick's motion, the mean lag of
        a desired position that stands still in each tick.
    sensor : ForceSensor, default=None
        Between the external force and the admittance; None measures it as it is.
    position_loop : PositionLoop, default=None
        Between the admittance and the robot; None follows at once.
    environment : Tunnel, default=None
        Walls, whose force adds to the external one; or any object with a method ``force(position, velocity)``.
    substeps : int, default=1
        Times a tick that walls are evaluated. A wall of 1e5 N/m needs about 4 at 1 kHz. Sensors, position loops and
        filters act once a tick, as on a real robot: with one of them it must be 1.
    stiffness_filter : RateLimit or EnergyTank, default=None
        Holds back what would feed energy into the robot.

    Examples
    --------
    >>> import torch
    >>> from torch_pbd.control import AdmittancePlant, damping_from_stiffness
    >>> still, push = torch.zeros(2000, 1).double(), torch.full((2000, 1), 5.0).double()
    >>> stiffness = torch.full((2000, 1, 1), 50.0).double()
    >>> run = AdmittancePlant().simulate(still, still, stiffness, damping_from_stiffness(stiffness), push, dt=0.001)
    >>> round(float(run.position[-1]), 4)  # 5 N on 50 N/m
    0.1
    """

    def __init__(
        self,
        mass: float | Tensor | Callable[[Floats], Any] | Any | None = 1.0,
        integrator: Literal["exact"] = "exact",
        *,
        feed_forward: bool = False,
        sensor: ForceSensor | None = None,
        position_loop: PositionLoop | None = None,
        environment: Environment | None = None,
        substeps: int = 1,
        stiffness_filter: StiffnessFilter | None = None,
    ) -> None:
        self.mass = mass if mass is None or callable(mass) else as_mass(mass)
        self.integrator = checks.choice(integrator, "integrator", ("exact",))
        self.feed_forward = checks.flag(feed_forward, "feed_forward")
        self.sensor = checks.instance(sensor, "sensor", ForceSensor, optional=True)
        self.position_loop = checks.instance(position_loop, "position_loop", PositionLoop, optional=True)
        self.environment = checks.instance(environment, "environment", Environment, optional=True)
        self.stiffness_filter = checks.instance(stiffness_filter, "stiffness_filter", StiffnessFilter, optional=True)
        self.substeps = checks.count(substeps, "substeps")
        if any(part is not None for part in (sensor, position_loop, stiffness_filter)):
            remedy = "sensors, position loops and filters act once a tick; shorten dt instead"
            checks.count(substeps, "substeps", most=1, remedy=remedy)

    def __repr__(self) -> str:
        mass: Any = self.mass
        is_matrix = isinstance(mass, Tensor) and mass.ndim
        shown = (
            f"{tuple(mass.shape)} kg" if is_matrix else mass if mass is None or callable(mass) else f"{float(mass)} kg"
        )
        acting = [f"{name}={part}" for name in _PARTS if (part := getattr(self, name)) is not None]
        return f"AdmittancePlant({', '.join([f'mass={shown}', *acting])})"

    def simulate(
        self,
        position_desired: Tensor | Any,
        velocity_desired: Tensor | Any,
        stiffness: Tensor | Any,
        damping: Tensor | Any,
        force: Tensor | Any = None,
        *,
        dt: float | Any,
        position0: Tensor | Any = None,
        velocity0: Tensor | Any = None,
        acceleration_desired: Tensor | Any = None,
        orientation_desired: Tensor | Any = None,
        orientation0: Tensor | Any = None,
        generator: torch.Generator | Any = None,
    ) -> Rollout:
        """Run T ticks of ``dt`` seconds.

        Of positions, d = p; or with ``orientation_desired`` of poses, d = p + 3: the last three of all axes are then
        of rotation, in world axes, in rad/s, rad/s^2, Nm, Nm/rad and Nm s/rad.

        Parameters
        ----------
        position_desired : Tensor of shape (..., T, p)
            In m.
        velocity_desired : Tensor of shape (..., T, d)
            In m/s.
        stiffness, damping : Tensor of shape (..., T, d, d)
            In N/m and N s/m, symmetric and positive semidefinite; they need not commute.
        force : Tensor of shape (..., T, d), default=None
            External force in N; None is none. Leading dimensions are those of the batch, and broadcast.
        dt : float
            In s.
        position0, velocity0, orientation0 : Tensor of shape (..., p), (..., d) and (..., 4), default=None
            State at the start; None is the desired one.
        acceleration_desired : Tensor of shape (..., T, d), default=None
            In m/s^2, for ``feed_forward``; None takes the differences of ``velocity_desired``.
        orientation_desired : Tensor of shape (..., T, 4), default=None
            Unit quaternions w x y z, for poses.
        generator : torch.Generator, default=None
            For the noise of the sensor.

        Returns
        -------
        Rollout
            Differentiable in all inputs.

        Raises
        ------
        ValueError
            If shapes disagree, a value is not finite, a matrix is not positive semidefinite, the rollouts do not fit in
            memory, or they diverge.
        """
        checks.number(dt, "dt", above=0.0, unit="s")
        checks.instance(generator, "generator", torch.Generator, optional=True)
        required = {"position_desired": position_desired, "velocity_desired": velocity_desired}
        gains = {"stiffness": stiffness, "damping": damping}
        optional = {"acceleration_desired": acceleration_desired, "orientation_desired": orientation_desired}
        optional |= {"force": force, "position0": position0, "velocity0": velocity0, "orientation0": orientation0}
        given = required | gains | {name: value for name, value in optional.items() if value is not None}
        tensors = {name: as_tensor(value, name) for name, value in given.items()}
        check_given(tensors)
        acting = {name: tensors.pop(name, None) for name in ("force", "position0", "velocity0", "orientation0")}
        times = dt * torch.arange(tensors["stiffness"].shape[-3]).double()
        mass = self.inertia(tensors["stiffness"], times.numpy())
        return run_task(self.task(**tensors, mass=mass, dt=dt), **acting, generator=generator)

    def inertia(self, like: Tensor, times: Any, own: Any = None) -> Tensor:
        """Mass (d, d) or (..., T, d, d) at times (T,) in s, for gains (..., T, d, d); None is a schedule's own."""
        mass = self.mass(times) if callable(self.mass) else self.mass
        if mass is None:
            mass = 1.0 if own is None else own
        return mass_rows(as_mass(mass), like)

    def task(
        self,
        position_desired: Tensor,
        velocity_desired: Tensor,
        stiffness: Tensor,
        damping: Tensor,
        *,
        mass: Tensor,
        dt: float,
        acceleration_desired: Tensor | None = None,
        orientation_desired: Tensor | None = None,
    ) -> Task:
        """Task of arguments of :meth:`simulate` that were checked, as this plant is to follow it."""
        if mass.ndim > 2:
            stiffness, damping, mass = torch.broadcast_tensors(stiffness, damping, mass)
        else:
            stiffness, damping = torch.broadcast_tensors(stiffness, damping)
        inertial = torch.zeros_like(velocity_desired)
        if self.feed_forward:
            if acceleration_desired is None:  # that which takes the velocity of each tick to that of the next
                difference = velocity_desired.diff(dim=-2) / dt
                still = torch.zeros_like(velocity_desired[..., :1, :])
                acceleration_desired = torch.cat([difference, still], dim=-2)
            along = acceleration_desired
            inertial = along @ mass.mT if mass.ndim == 2 else (mass @ along.unsqueeze(-1)).squeeze(-1)
        turns = None if orientation_desired is None else turning(orientation_desired)
        pose = position_desired if turns is None else torch.nn.functional.pad(position_desired, (0, 3))
        acting = {name: getattr(self, name) for name in ("substeps", *_PARTS)}
        if self.stiffness_filter is not None:
            acting["stiffness_filter"] = partial(started, self.stiffness_filter)
        return Task(pose, velocity_desired, inertial, stiffness, damping, mass, dt, **acting, turning=turns)


def run_task(
    task: Task,
    force: Tensor | None = None,
    position0: Tensor | None = None,
    velocity0: Tensor | None = None,
    orientation0: Tensor | None = None,
    *,
    generator: torch.Generator | None = None,
) -> Rollout:
    """Run of a task under a force (..., T, d) and from a start (..., d) that were checked."""
    force = torch.zeros_like(task.velocity) if force is None else force
    start, speed = _start(task, position0, orientation0), task.velocity[..., 0, :] if velocity0 is None else velocity0
    parts = [task.position, task.velocity, task.inertial_force, force, task.stiffness[..., 0]]
    parts += [] if task.turning is None else [task.turning.turns]
    batch = broadcast_shapes(*(value.shape[:-2] for value in parts), start.shape[:-1], speed.shape[:-1])
    _check_memory(batch, task)
    state = start.expand(*batch, -1), speed.expand(*batch, -1)
    if task.is_open and task.is_shared:
        position, velocity = open_loop(task, force, state)
        record: dict[str, Any] = {"position": position, "velocity": velocity, "commanded_position": position}
        record |= {"force": force.expand_as(position), "stiffness": task.stiffness, "damping": task.damping}
    else:
        record = closed_loop(task, force, state, generator)
    for name, n_dims in {"stiffness": 3, "damping": 3, "filter_share": 1}.items():
        if name in record:
            record[name] = record[name].expand(*batch, *record[name].shape[-n_dims:])
    _check_finished(record["position"], record["velocity"])
    time = torch.arange(task.n_ticks, dtype=force.dtype, device=force.device) * task.dt
    return Rollout(time, **_poses(task, record))


def _start(task: Task, position0: Tensor | None, orientation0: Tensor | None) -> Tensor:
    """Pose at the start, as :class:`Task` has them."""
    start = task.position[..., 0, :] if position0 is None else position0
    if task.turning is None:
        return start
    desired = task.turning.orientation[..., 0, :]
    rotation = torch.zeros_like(desired[..., 1:]) if orientation0 is None else rotation_between(desired, orientation0)
    position = start[..., : task.n_positions]
    batch = broadcast_shapes(position.shape[:-1], rotation.shape[:-1])
    return torch.cat([position.expand(*batch, -1), rotation.expand(*batch, -1)], dim=-1)


def _poses(task: Task, record: dict[str, Tensor]) -> dict[str, Any]:
    """Fields of a Rollout, whose poses are positions and orientations."""
    if task.turning is None:
        return record | {"desired_position": task.position}
    record["pose_deviation"] = record["position"] - task.position
    desired, p = task.turning.orientation, task.n_positions
    warn_if_far(float(torch.linalg.vector_norm(record["position"].detach()[..., p:], dim=-1).max()))
    rotation, commanded = (record[name][..., p:] for name in ("position", "commanded_position"))
    record |= {name: record[name][..., :p] for name in ("position", "commanded_position")}
    record |= {"desired_position": task.position[..., :p], "desired_orientation": desired}
    turned = {
        "orientation": multiply(exp(rotation), desired),
        "commanded_orientation": multiply(exp(commanded), desired),
    }
    return record | turned


def _check_memory(batch: torch.Size, task: Task) -> None:
    # Measured: five motions are held, of poses six and two orientations, and where rollouts differ in their gains,
    # twelve matrices.
    d = task.position.shape[-1]
    of_each = 5 * d + (12 * d * d if task.stiffness.ndim > 3 or task.stiffness_filter is not None else 0)
    of_each += 0 if task.turning is None else d + 8
    if task.position.device.type == "cpu":  # elsewhere torch raises by itself
        require_memory(
            of_each * batch.numel() * task.n_ticks * task.position.element_size(),
            what=f"a simulation of {batch.numel()} rollouts of {task.n_ticks} ticks",
            remedy="Simulate fewer at a time, or take simulate_many, which keeps no trajectories.",
        )


def _check_finished(position: Tensor, velocity: Tensor) -> None:
    """Check that a motion did not outgrow its numbers."""
    finite = (torch.isfinite(position) & torch.isfinite(velocity)).all(-1)
    if not bool(finite.all()):
        tick = int((~finite.reshape(-1, finite.shape[-1]).all(0)).nonzero()[0])
        raise ValueError(
            f"the simulation diverged, and is not finite from tick {tick} on: take a shorter dt, or smaller stiffness, "
            "velocity and force."
        )
