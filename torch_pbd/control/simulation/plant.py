"""The simulated robot under admittance control: eq. (15) with a mass, tick by tick."""

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal, final

import torch
from torch import Tensor
from torch.nn.functional import pad

from torch_pbd import checks, rotations
from torch_pbd.checks import Floats
from torch_pbd.control.filters import StiffnessFilter
from torch_pbd.control.matrices import as_mass, as_tensor, mass_rows
from torch_pbd.control.simulation.rollout import Rollout, run_task
from torch_pbd.control.simulation.sensor import ForceSensor, PositionLoop
from torch_pbd.control.simulation.ticks import Environment, Task
from torch_pbd.exceptions import InvalidParameterError

_PARTS = {
    "sensor": ForceSensor,
    "position_loop": PositionLoop,
    "environment": Environment,
    "stiffness_filter": StiffnessFilter,
}
# Shapes of arguments after the batch dimensions; arguments not listed are motions of all axes, (T, d).
_SHAPES = {
    "position_desired": "Tp",
    "orientation_desired": "T4",
    "stiffness": "Tdd",
    "damping": "Tdd",
    "position0": "p",
    "orientation0": "4",
    "velocity0": "d",
}


@final
@dataclass(eq=False, repr=False)
class AdmittancePlant:
    """Mass, spring and damper in d axes, pulled along a desired motion and batched over rollouts.

    ``M a = f + K (x_d - x) + D (v_d - v)``, eq. (15) as admittance. All inputs are held over a tick, in which the
    desired position stands still. For poses, ``x - x_d`` is ``(p - p_d, Log(R R_d'))`` in world axes and v the twist.
    The model is linear in the deviation from the desired orientation, which itself may turn arbitrarily: peaks under
    pushes are right to 1 % up to 1 rad, while the paths to them err by 3 % at 0.2 rad and 16 % at 1 rad.

    Parameters
    ----------
    mass : float, Tensor of shape (d, d) or (..., T, d, d), callable or None, default=1.0
        Virtual mass or robot inertia in kg, for poses also kg m and kg m^2, constant or per tick; its changes leave
        the velocity as it is. Matrices must be symmetric and positive definite. A function maps times (T,) in s
        to such matrices. None is the mass of the schedule, or 1 kg where it has none.
    integrator : {"exact"}, default="exact"
        Integrator of a tick; "exact" is exact for any length.
    feed_forward : bool, default=False
        Add ``M a_d``, which eq. (15) lacks: the robot then lags by only half a tick's motion, the mean lag of a
        desired position that stands still in each tick.
    sensor : ForceSensor, default=None
        Sensor between the external force and the admittance; None measures the force exactly.
    position_loop : PositionLoop, default=None
        Position loop between the admittance and the robot; None follows at once.
    environment : Tunnel, default=None
        Walls, or any object with a method ``force(position, velocity)``, whose force adds to the external one.
    substeps : int, default=1
        Evaluations of the walls per tick: a wall of 1e5 N/m needs about 4 at 1 kHz. Sensors, position loops and
        filters act once per tick, and require 1.
    stiffness_filter : RateLimit or EnergyTank, default=None
        Filter that holds back stiffness changes that would feed energy into the robot.
    """

    mass: float | Tensor | Callable[[Floats], Any] | Any | None = 1.0
    integrator: Literal["exact"] = "exact"
    _: KW_ONLY
    feed_forward: bool = False
    sensor: ForceSensor | None = None
    position_loop: PositionLoop | None = None
    environment: Environment | None = None
    substeps: int = 1
    stiffness_filter: StiffnessFilter | None = None

    def __post_init__(self) -> None:
        if self.mass is not None and not callable(self.mass):
            self.mass = as_mass(self.mass)
        checks.choice(self.integrator, "integrator", ("exact",))
        checks.flag(self.feed_forward, "feed_forward")
        for name, kind in _PARTS.items():
            checks.instance(getattr(self, name), name, kind, optional=True)
        checks.count(self.substeps, "substeps")
        if any(part is not None for part in (self.sensor, self.position_loop, self.stiffness_filter)):
            remedy = "sensors, position loops and filters act once a tick; shorten dt instead"
            checks.count(self.substeps, "substeps", most=1, remedy=remedy)

    def __repr__(self) -> str:
        mass: Any = self.mass
        if isinstance(mass, float | Tensor):
            mass = f"{tuple(mass.shape) if isinstance(mass, Tensor) and mass.ndim else float(mass)} kg"
        acting = [f"{name}={part}" for name in _PARTS if (part := getattr(self, name)) is not None]
        return f"AdmittancePlant({', '.join([f'mass={mass}', *acting])})"

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
        """Run T ticks of ``dt`` seconds, of d = p axes, or of poses with ``orientation_desired``.

        Poses have d = p + 3 axes, the last three being rotations in world axes, in rad/s, rad/s^2, Nm, Nm/rad and
        Nm s/rad.

        Parameters
        ----------
        position_desired, velocity_desired : Tensor of shape (..., T, p) and (..., T, d)
            Desired motion in m and m/s. Leading dimensions of all arguments are batch dimensions and broadcast.
        stiffness, damping : Tensor of shape (..., T, d, d)
            Gains in N/m and N s/m, symmetric and positive semidefinite; they need not commute.
        force : Tensor of shape (..., T, d), default=None
            External force in N; None is no force.
        dt : float
            Length of a tick in s.
        position0, velocity0, orientation0 : Tensor of shape (..., p), (..., d) and (..., 4), default=None
            Initial state; None is the desired one.
        acceleration_desired : Tensor of shape (..., T, d), default=None
            Desired acceleration in m/s^2, for ``feed_forward``; None takes the differences of ``velocity_desired``.
        orientation_desired : Tensor of shape (..., T, 4), default=None
            Desired unit quaternions w x y z, for runs of poses.
        generator : torch.Generator, default=None
            Source of the sensor's noise.

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
        given = {"position_desired": position_desired, "velocity_desired": velocity_desired}
        given |= {"stiffness": stiffness, "damping": damping}
        optional = {"acceleration_desired": acceleration_desired, "orientation_desired": orientation_desired}
        optional |= {"force": force, "position0": position0, "velocity0": velocity0, "orientation0": orientation0}
        given |= {name: value for name, value in optional.items() if value is not None}
        tensors = {name: as_tensor(value, name) for name, value in given.items()}
        _check(tensors)
        acting = {name: tensors.pop(name, None) for name in ("force", "position0", "velocity0", "orientation0")}
        times = dt * torch.arange(tensors["stiffness"].shape[-3]).double()
        return run_task(self.task(**tensors, times=times.numpy(), dt=dt), **acting, generator=generator)

    def task(
        self,
        position_desired: Tensor,
        velocity_desired: Tensor,
        stiffness: Tensor,
        damping: Tensor,
        *,
        times: Floats,
        dt: float,
        own_mass: Any = None,
        acceleration_desired: Tensor | None = None,
        orientation_desired: Tensor | None = None,
    ) -> Task:
        """Task of this plant from checked arguments of :meth:`simulate`, the times of ticks and a schedule's mass."""
        mass = mass_rows(self.mass, own_mass, times, stiffness)
        inertial = torch.zeros_like(velocity_desired)
        if self.feed_forward:
            if acceleration_desired is None:  # that which takes the velocity of each tick to that of the next
                acceleration_desired = pad(velocity_desired.diff(dim=-2) / dt, (0, 0, 0, 1))
            inertial = (mass @ acceleration_desired.unsqueeze(-1)).squeeze(-1)
        pose, transport, steps = position_desired, None, pad(position_desired.diff(dim=-2), (0, 0, 0, 1))
        if orientation_desired is not None:
            turns = rotations.between(orientation_desired[..., :-1, :], orientation_desired[..., 1:, :])
            turns = pad(turns, (0, 0, 0, 1))
            transport = torch.linalg.matrix_exp(rotations.cross_matrix(turns))
            pose, steps = pad(pose, (0, 3)), pad(steps, (0, 3)) + pad(turns, (pose.shape[-1], 0))
        motions = pose, velocity_desired, inertial, steps
        stiffness, damping, mass = torch.broadcast_tensors(stiffness, damping, mass)
        return Task(*motions, stiffness, damping, mass, dt, self, orientation_desired, transport)


def _check(given: dict[str, Tensor]) -> None:
    """Check that dtypes and shapes of the arguments agree, and that their values are feasible."""
    kinds = sorted({f"{value.dtype} on {value.device}" for value in given.values()})
    if len(kinds) > 1:
        raise InvalidParameterError(
            f"the inputs are of {', '.join(kinds)}, must be of one dtype and device: convert them."
        )
    shape, is_pose = given["position_desired"].shape, "orientation_desired" in given
    if "orientation0" in given and not is_pose:
        raise InvalidParameterError("orientation0 is given, must come with orientation_desired: give both, or none.")
    n_ticks, p = shape[-2:] if len(shape) > 1 else (0, 0)
    sizes = {"T": n_ticks, "p": p, "d": p + 3 if is_pose else p, "4": 4}
    for name, value in given.items():
        letters = _SHAPES.get(name, "Td")
        if not n_ticks or not value.numel() or value.shape[-len(letters) :] != tuple(map(sizes.__getitem__, letters)):
            raise InvalidParameterError(
                f"{name} has shape {tuple(value.shape)}, must have shape (..., {', '.join(letters)}), none of it "
                f"empty, with T and p those of position_desired, {tuple(shape)}, and d = {'p + 3' if is_pose else 'p'}."
            )
        plain = value.detach().cpu()
        if name in ("stiffness", "damping"):
            checks.semidefinite(plain.numpy(), name)
            continue
        checks.require(torch.isfinite(plain).numpy(), plain.numpy(), name, "finite")
        if name.startswith("orientation"):
            checks.unit_quaternions(plain.numpy(), name)
