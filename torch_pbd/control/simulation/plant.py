"""The simulated robot under admittance control: eq. (15) with a mass, tick by tick."""

from typing import Any, final, get_args

import torch
from torch import Tensor

from torch_pbd.control.matrices import as_mass, as_semidefinite, as_tensor, check_count, check_flag, check_positive
from torch_pbd.control.simulation.filters import EnergyTank, RateLimit
from torch_pbd.control.simulation.position_loop import PositionLoop
from torch_pbd.control.simulation.rollout import Rollout
from torch_pbd.control.simulation.sensor import ForceSensor
from torch_pbd.control.simulation.ticks import Task, closed_loop, open_loop
from torch_pbd.control.simulation.transitions import Integrator
from torch_pbd.control.simulation.walls import Tunnel
from torch_pbd.files.memory import require_memory


@final
class AdmittancePlant:
    """A mass on a spring and a damper that a desired motion drags along, in d axes, batched over rollouts.

    ``M a = f + K (x_d - x) + D (v_d - v)``, eq. (15) as admittance: the robot moves as the measured force and
    the impedance ask. All inputs are held over a tick (zero-order hold) and the desired position stands still
    in it; states are those at the start of ticks.

    Parameters
    ----------
    mass : float or Tensor of shape (d, d), default=1.0
        Virtual mass in kg; a matrix must be symmetric and positive definite.
    integrator : {"exact", "semi_implicit_euler", "rk4", "trapezoid"}, default="exact"
        "exact" solves the tick, whatever its length; the others are for comparison.
    feed_forward : bool, default=False
        Add ``M a_d``, which eq. (15) lacks: the robot then follows but for half a tick's motion, the mean lag of
        a desired position that stands still in each tick.
    sensor : ForceSensor, default=None
        What the admittance measures of the external force; None measures it as it is.
    position_loop : PositionLoop, default=None
        How the robot follows the admittance; None follows at once.
    environment : Tunnel, default=None
        Walls, whose force adds to the external one.
    substeps : int, default=1
        Times a tick that walls are evaluated. A wall of 1e5 N/m needs about 4 at 1 kHz. The sensor is read once
        a tick: with one, and with a position loop, as on a real robot, it must be 1.
    stiffness_filter : RateLimit or EnergyTank, default=None
        Holds back what would feed energy into the robot.

    Raises
    ------
    ValueError
        If a parameter is not as described.

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
        integrator: Integrator = "exact",
        *,
        feed_forward: bool = False,
        sensor: ForceSensor | None = None,
        position_loop: PositionLoop | None = None,
        environment: Tunnel | None = None,
        substeps: int = 1,
        stiffness_filter: RateLimit | EnergyTank | None = None,
    ) -> None:
        if integrator not in get_args(Integrator):
            raise ValueError(
                f"integrator is {integrator!r}, must be one of {', '.join(map(repr, get_args(Integrator)))}."
            )
        check_count("substeps", substeps, 1)
        check_flag("feed_forward", feed_forward)
        parts = {
            "sensor": (sensor, "start"),
            "position_loop": (position_loop, "start"),
            "environment": (environment, "force"),
            "stiffness_filter": (stiffness_filter, "start"),
        }
        for name, (part, method) in parts.items():
            if isinstance(part, type):
                raise ValueError(f"{name} is the class {part.__name__}, must be an object of it.")
            if part is not None and not callable(getattr(part, method, None)):
                raise ValueError(f"{name}={part!r} has no method {method!r}; see the docstring for what it may be.")
        if substeps > 1 and (sensor is not None or position_loop is not None):
            raise ValueError(
                f"substeps is {substeps}, must be 1 with a sensor or a position loop: they act once a tick. "
                "Shorten dt instead."
            )
        if stiffness_filter is not None and (integrator != "exact" or substeps > 1):
            raise ValueError(
                f"stiffness_filter keeps its invariant with integrator='exact' and substeps=1 only; got {integrator!r} "
                f"and {substeps}."
            )
        self.mass = as_mass(mass)
        self.integrator: Integrator = integrator
        self.feed_forward = feed_forward
        self.sensor = sensor
        self.position_loop = position_loop
        self.environment = environment
        self.substeps = substeps
        self.stiffness_filter = stiffness_filter

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
            External force in N, held over each tick; None is none. Leading dimensions are those of the batch,
            and broadcast.
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
            With the state at the start of each tick; differentiable in all inputs.

        Raises
        ------
        ValueError
            If shapes disagree, a value is not finite, a matrix is not positive semidefinite, or the rollouts do
            not fit in memory.
        """
        task = self.task(
            position_desired, velocity_desired, stiffness, damping, dt=dt, acceleration_desired=acceleration_desired
        )
        position_desired, velocity_desired = task.position, task.velocity
        force = torch.zeros_like(position_desired) if force is None else as_tensor(force, "force")
        _check_motion({"position_desired": position_desired, "force": force})
        position0, velocity0 = _starts(position_desired, position0=position0, velocity0=velocity0)
        stiffness, damping = task.stiffness, task.damping
        start = position_desired[..., 0, :] if position0 is None else position0
        speed = velocity_desired[..., 0, :] if velocity0 is None else velocity0
        parts = (position_desired, velocity_desired, task.inertial_force, force, stiffness[..., 0])
        batch = torch.broadcast_shapes(*(value.shape[:-2] for value in parts), start.shape[:-1], speed.shape[:-1])
        self._check_memory(batch, task)
        state = start.expand(*batch, -1), speed.expand(*batch, -1)
        hooks = (self.sensor, self.position_loop, self.environment, self.stiffness_filter)
        if generator is not None and not isinstance(generator, torch.Generator):
            raise ValueError(f"generator is {generator!r}, must be a torch.Generator or None.")
        if all(hook is None for hook in hooks):
            position, velocity = open_loop(task, force, state, self.integrator)
            record: dict[str, Any] = {"position": position, "velocity": velocity, "commanded_position": position}
            gains = (*batch, *stiffness.shape[-3:])
            record |= {"stiffness": stiffness.expand(gains), "damping": damping.expand(gains)}
            record |= {"force": force.expand_as(position)}
        else:
            record = closed_loop(task, force, state, self, generator)
        _check_finished(record["position"], record["velocity"])
        time = torch.arange(force.shape[-2], dtype=force.dtype, device=force.device) * dt
        return Rollout(time, desired_position=position_desired, **record)

    def task(
        self,
        position_desired: Tensor | Any,
        velocity_desired: Tensor | Any,
        stiffness: Tensor | Any,
        damping: Tensor | Any,
        *,
        dt: float | Any,
        acceleration_desired: Tensor | Any = None,
    ) -> Task:
        """Arguments of :meth:`simulate` as this plant is to follow them, checked; it raises as that does."""
        motion = {"position_desired": position_desired, "velocity_desired": velocity_desired}
        if acceleration_desired is not None:
            motion["acceleration_desired"] = acceleration_desired
        check_positive("dt", dt, "s")
        motion = {name: as_tensor(value, name) for name, value in motion.items()}
        _check_motion(motion)
        position_desired, velocity_desired, *given = motion.values()
        stiffness, damping = as_tensor(stiffness, "stiffness"), as_tensor(damping, "damping")
        _check_gains(position_desired, stiffness=stiffness, damping=damping)
        stiffness, damping = torch.broadcast_tensors(stiffness, damping)
        mass = self._mass_matrix(stiffness)
        inertial = torch.zeros_like(position_desired)
        if self.feed_forward:
            inertial = _accelerations(velocity_desired, given[0] if given else None, dt) @ mass.mT
        return Task(position_desired, velocity_desired, inertial, stiffness, damping, mass, dt)

    def _check_memory(self, batch: torch.Size, task: Task) -> None:
        """Measured: five motions are held, and where rollouts differ in their gains, twelve matrices."""
        d = task.position.shape[-1]
        of_each = 5 * d + (12 * d * d if task.stiffness.ndim > 3 or self.stiffness_filter is not None else 0)
        if task.position.device.type == "cpu":  # elsewhere torch raises by itself
            require_memory(
                of_each * batch.numel() * task.n_ticks * task.position.element_size(),
                what=f"a simulation of {batch.numel()} rollouts of {task.n_ticks} ticks",
                remedy="Simulate fewer at a time, or take simulate_many, which keeps no trajectories.",
            )

    def _mass_matrix(self, like: Tensor) -> Tensor:
        if isinstance(self.mass, Tensor) and self.mass.ndim:
            if self.mass.shape != like.shape[-2:]:
                raise ValueError(
                    f"mass has shape {tuple(self.mass.shape)}, must be a number or have shape {tuple(like.shape[-2:])}."
                )
            return self.mass.to(like)
        return self.mass * torch.eye(like.shape[-1]).to(like)


def _accelerations(velocity: Tensor, acceleration: Tensor | None, dt: float) -> Tensor:
    """Those given, or those that take the velocity of each tick to that of the next."""
    if acceleration is not None:
        return acceleration
    difference = velocity.diff(dim=-2) / dt
    return torch.cat([difference, torch.zeros_like(velocity[..., :1, :])], dim=-2)


def _check_motion(motion: dict[str, Tensor]) -> None:
    """Check motions and forces (..., T, d), the first of which is the desired position."""
    expected = motion["position_desired"].shape[-2:]
    _check_kinds(*motion.values())
    for name, value in motion.items():
        if value.ndim < 2 or value.shape[-2:] != expected or not value.numel():
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}, must have shape (..., T, d), with T >= 1 and d those of "
                f"position_desired, {tuple(motion['position_desired'].shape)}."
            )
        if not bool(torch.isfinite(value.detach().sum())):  # or the sum overflows: look at each
            finite = torch.isfinite(value).all(-1).reshape(-1, expected[0]).all(0)
            if not bool(finite.all()):
                raise ValueError(f"{name} has a value that is not finite, at tick {int((~finite).nonzero()[0])}.")


def _check_gains(position: Tensor, **gains: Tensor) -> None:
    expected = position.shape[-2:]
    _check_kinds(position, *gains.values())
    for name, value in gains.items():
        if value.shape[-3:] != (*expected, expected[-1]):
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}, must have shape (..., T, d, d) with T, d = {tuple(expected)}."
            )
        as_semidefinite(value, name)


def _check_kinds(*values: Tensor) -> None:
    kinds = {(value.dtype, value.device) for value in values}
    if len(kinds) > 1:
        raise ValueError(f"the inputs are of several dtypes or devices, {sorted(map(str, kinds))}: bring them to one.")


def _starts(like: Tensor, **starts: Tensor | Any) -> list[Tensor | None]:
    """States (..., d) at the start, or None where none is given."""
    checked: list[Tensor | None] = []
    for name, given in starts.items():
        value = None if given is None else as_tensor(given, name)
        if value is not None and (value.shape[-1:] != like.shape[-1:] or not bool(torch.isfinite(value).all())):
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}, must have shape (..., {like.shape[-1]}), all of it finite."
            )
        if value is not None:
            _check_kinds(like, value)
        checked.append(value)
    return checked


def _check_finished(position: Tensor, velocity: Tensor) -> None:
    """Check that a motion did not outgrow its numbers."""
    if bool(torch.isfinite(position.detach().sum() + velocity.detach().sum())):
        return
    finite = (torch.isfinite(position) & torch.isfinite(velocity)).all(-1).reshape(-1, position.shape[-2]).all(0)
    if not bool(finite.all()):
        raise ValueError(
            f"the simulation diverged, and is not finite from tick {int((~finite).nonzero()[0])} on: take a shorter "
            "dt, integrator='exact', or smaller stiffness, velocity and force."
        )
