"""The simulated robot under admittance control: eq. (15) with a mass, tick by tick."""

from typing import Any, Literal, final

import torch
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.matrices import as_mass, as_tensor, mass_matrix
from torch_pbd.control.simulation.position_loop import PositionLoop
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.simulation.sensor import ForceSensor
from torch_pbd.control.simulation.ticks import Environment, StiffnessFilter, Task, closed_loop, open_loop
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.files.memory import require_memory

_PARTS = ("sensor", "position_loop", "environment", "stiffness_filter")


@final
class AdmittancePlant:
    """A mass on a spring and a damper that a desired motion drags along, in d axes, batched over rollouts.

    ``M a = f + K (x_d - x) + D (v_d - v)``, eq. (15) as admittance. All inputs are held over a tick (zero-order hold),
    in which the desired position stands still; states are those at the start of ticks.

    Parameters
    ----------
    mass : float or Tensor of shape (d, d), default=1.0
        Virtual mass in kg; a matrix must be symmetric and positive definite.
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
        mass: float | Tensor | Any = 1.0,
        integrator: Literal["exact"] = "exact",
        *,
        feed_forward: bool = False,
        sensor: ForceSensor | None = None,
        position_loop: PositionLoop | None = None,
        environment: Environment | None = None,
        substeps: int = 1,
        stiffness_filter: StiffnessFilter | None = None,
    ) -> None:
        self.mass = as_mass(mass)
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
        mass = tuple(self.mass.shape) if isinstance(self.mass, Tensor) and self.mass.ndim else float(self.mass)
        acting = [f"{name}={part}" for name in _PARTS if (part := getattr(self, name)) is not None]
        return f"AdmittancePlant({', '.join([f'mass={mass} kg', *acting])})"

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
        generator: torch.Generator | Any = None,
    ) -> Rollout:
        """Run T ticks of ``dt`` seconds.

        Parameters
        ----------
        position_desired, velocity_desired : Tensor of shape (..., T, d)
            In m and m/s.
        stiffness, damping : Tensor of shape (..., T, d, d)
            In N/m and N s/m, symmetric and positive semidefinite; they need not commute.
        force : Tensor of shape (..., T, d), default=None
            External force in N; None is none. Leading dimensions are those of the batch, and broadcast.
        dt : float
            In s.
        position0, velocity0 : Tensor of shape (..., d), default=None
            State at the start; None is the desired one.
        acceleration_desired : Tensor of shape (..., T, d), default=None
            In m/s^2, for ``feed_forward``; None takes the differences of ``velocity_desired``.
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
        optional = {"acceleration_desired": acceleration_desired, "force": force}
        optional |= {"position0": position0, "velocity0": velocity0}
        given = required | gains | {name: value for name, value in optional.items() if value is not None}
        tensors = {name: as_tensor(value, name) for name, value in given.items()}
        _check_given(tensors)
        acting = {name: tensors.pop(name, None) for name in ("force", "position0", "velocity0")}
        return run_task(self.task(**tensors, dt=dt), **acting, generator=generator)

    def task(
        self,
        position_desired: Tensor,
        velocity_desired: Tensor,
        stiffness: Tensor,
        damping: Tensor,
        *,
        dt: float,
        acceleration_desired: Tensor | None = None,
    ) -> Task:
        """Task of arguments of :meth:`simulate` that were checked, as this plant is to follow it."""
        stiffness, damping = torch.broadcast_tensors(stiffness, damping)
        mass = mass_matrix(self.mass, stiffness)
        inertial = torch.zeros_like(position_desired)
        if self.feed_forward:
            if acceleration_desired is None:  # that which takes the velocity of each tick to that of the next
                difference = velocity_desired.diff(dim=-2) / dt
                still = torch.zeros_like(velocity_desired[..., :1, :])
                acceleration_desired = torch.cat([difference, still], dim=-2)
            inertial = acceleration_desired @ mass.mT
        acting = {name: getattr(self, name) for name in ("substeps", *_PARTS)}
        return Task(position_desired, velocity_desired, inertial, stiffness, damping, mass, dt, **acting)


def run_task(
    task: Task,
    force: Tensor | None = None,
    position0: Tensor | None = None,
    velocity0: Tensor | None = None,
    *,
    generator: torch.Generator | None = None,
) -> Rollout:
    """Run of a task under a force (..., T, d) and from a start (..., d) that were checked."""
    force = torch.zeros_like(task.position) if force is None else force
    start = task.position[..., 0, :] if position0 is None else position0
    speed = task.velocity[..., 0, :] if velocity0 is None else velocity0
    parts = (task.position, task.velocity, task.inertial_force, force, task.stiffness[..., 0])
    batch = torch.broadcast_shapes(*(value.shape[:-2] for value in parts), start.shape[:-1], speed.shape[:-1])
    _check_memory(batch, task)
    state = start.expand(*batch, -1), speed.expand(*batch, -1)
    if task.is_open and task.is_shared:
        position, velocity = open_loop(task, force, state)
        record: dict[str, Any] = {"position": position, "velocity": velocity, "commanded_position": position}
        record |= {"force": force.expand_as(position), "stiffness": task.stiffness, "damping": task.damping}
    else:
        record = closed_loop(task, force, state, generator)
    for name in ("stiffness", "damping"):
        record[name] = record[name].expand(*batch, *record[name].shape[-3:])
    _check_finished(record["position"], record["velocity"])
    time = torch.arange(task.n_ticks, dtype=force.dtype, device=force.device) * task.dt
    return Rollout(time, desired_position=task.position, **record)


def _check_memory(batch: torch.Size, task: Task) -> None:
    # Measured: five motions are held, and where rollouts differ in their gains, twelve matrices.
    d = task.position.shape[-1]
    of_each = 5 * d + (12 * d * d if task.stiffness.ndim > 3 or task.stiffness_filter is not None else 0)
    if task.position.device.type == "cpu":  # elsewhere torch raises by itself
        require_memory(
            of_each * batch.numel() * task.n_ticks * task.position.element_size(),
            what=f"a simulation of {batch.numel()} rollouts of {task.n_ticks} ticks",
            remedy="Simulate fewer at a time, or take simulate_many, which keeps no trajectories.",
        )


def _check_given(given: dict[str, Tensor]) -> None:
    """Check the tensors that :meth:`AdmittancePlant.simulate` was given; T and d are those of the desired position."""
    kinds = sorted({f"{value.dtype} on {value.device}" for value in given.values()})
    if len(kinds) > 1:
        raise InvalidParameterError(
            f"the inputs are of {', '.join(kinds)}, must be of one dtype and device: convert them."
        )
    shape = given["position_desired"].shape
    for name, value in given.items():
        is_gain = name in ("stiffness", "damping")
        sizes = shape[-1:] if name.endswith("0") else (*shape[-2:], *shape[-1:]) if is_gain else shape[-2:]
        if len(shape) < 2 or not value.numel() or value.shape[-len(sizes) :] != sizes:
            letters = "d" if name.endswith("0") else "T, d, d" if is_gain else "T, d"
            raise InvalidParameterError(
                f"{name} has shape {tuple(value.shape)}, must have shape (..., {letters}), none of it empty, with T "
                f"and d those of position_desired, {tuple(shape)}."
            )
        plain = value.detach().cpu()
        if is_gain:
            checks.semidefinite(plain.numpy(), name)
        else:
            checks.require(torch.isfinite(plain).numpy(), plain.numpy(), name, "finite")


def _check_finished(position: Tensor, velocity: Tensor) -> None:
    """Check that a motion did not outgrow its numbers."""
    finite = (torch.isfinite(position) & torch.isfinite(velocity)).all(-1)
    if not bool(finite.all()):
        tick = int((~finite.reshape(-1, finite.shape[-1]).all(0)).nonzero()[0])
        raise ValueError(
            f"the simulation diverged, and is not finite from tick {tick} on: take a shorter dt, or smaller stiffness, "
            "velocity and force."
        )
