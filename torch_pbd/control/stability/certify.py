"""Stability guarantees of a stiffness schedule, and the stiffest environment it may touch."""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks, rotations
from torch_pbd.control.matrices import mass_rows, required_damping_ratio
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.sensor import PositionLoop
from torch_pbd.control.simulation.ticks import tick_map
from torch_pbd.control.stability.common_function import common_function
from torch_pbd.control.stability.dynamics import ErrorDynamics, largest_gain
from torch_pbd.control.stability.lyapunov import Knots, held_growth
from torch_pbd.control.stability.report import StabilityReport
from torch_pbd.linalg import evenly, symmetrize

# Upper bound of environment stiffnesses in N/m, above anything real.
_STIFFEST = 1e9
# Most knots of a schedule that are coupled to an environment.
_MAX_KNOTS = 200
_BISECTIONS = 60


def certify(
    schedule: Schedule | Any,
    *,
    mass: Any = None,
    speed: float = 1.0,
    position_loop: PositionLoop | Any = None,
    force_cutoff: float | None = 500.0,
    dt: float = 0.001,
) -> StabilityReport:
    """Check the stability of a schedule.

    Parameters
    ----------
    schedule : Schedule
        Schedule whose times, gains and, for poses, angular velocities are checked.
    mass : float, array_like of shape (d, d) or (n, d, d), or callable, default=None
        Virtual mass of the admittance, or inertia of the arm at each row, in kg, for poses also kg m and kg m^2; or a
        function of times (n,) in s. None is the schedule's own, or 1 kg.
    speed : float, default=1.0
        Replay speed: 2 is twice as fast.
    position_loop : PositionLoop, default=None
        Position loop of the robot, for the stiffest environment; None is 20 Hz after a delay of one tick.
    force_cutoff : float, default=500.0
        Corner frequency of the force sensor's low-pass in Hz; None is no filter.
    dt : float, default=0.001
        Tick of the controller in s.

    Raises
    ------
    ValueError
        If the mass or speed is not positive, or a stiffness is not positive definite.

    References
    ----------
    K. Kronander, A. Billard, "Stability considerations for variable impedance control", IEEE Transactions on
    Robotics 32, 2016.
    """
    checks.number(speed, "speed", above=0.0)
    checks.number(dt, "dt", above=0.0, unit="s")
    checks.number(force_cutoff, "force_cutoff", above=0.0, unit="Hz", optional=True)
    loop = checks.instance(position_loop, "position_loop", PositionLoop, optional=True) or PositionLoop()
    checks.instance(schedule, "schedule", Schedule)
    # A free axis never returns, so that nothing can be certified.
    checks.semidefinite(schedule.stiffness, "stiffness", definite=True)
    time, stiffness, damping = map(torch.tensor, (schedule.time, schedule.stiffness, schedule.damping))
    inertia = mass_rows(mass, schedule.mass, schedule.time, stiffness).detach()
    inertia = inertia if inertia.ndim == 3 else inertia[None]  # one for all rows
    transport = None
    if schedule.orientation is not None and schedule.velocity[:, -3:].any():
        transport = torch.zeros_like(stiffness)
        transport[:, -3:, -3:] = torch.tensor(speed * rotations.cross_matrix(schedule.velocity[:, -3:]))
    dynamics = ErrorDynamics(time / speed, stiffness, damping, inertia, transport)
    knots, maps = Knots(dynamics), dynamics.tick_maps()
    alpha, margin, worst = knots.certificate()
    rate, fastest = common_function(dynamics)
    # The rule holds for isotropic functions, and so for one inertia and outputs of one unit.
    squared = dynamics.modes[0]
    ratio = float(squared.max() / squared.min()) if len(inertia) == 1 and schedule.orientation is None else math.nan
    pressed = [math.nan] * 2
    if len(inertia) == 1:  # an inertia that varies is an arm's own: there is no position loop
        for i, block in enumerate((slice(None), block, block) for block in schedule.blocks):
            gains = stiffness[block], damping[block], inertia[block][0]
            pressed[i] = stiffest_environment(*gains, loop, force_cutoff, dt)
    eigenvalues = [torch.linalg.eigvalsh(inertia[:, block, block]) for block in schedule.blocks]
    return StabilityReport(
        damping_ratio=_damping_ratio(dynamics),
        stiffness_ratio=ratio,
        required_damping_ratio=math.nan if math.isnan(ratio) else required_damping_ratio(ratio),
        stable_at_any_schedule=not math.isnan(rate),
        any_schedule_rate=rate,
        any_schedule_speed=speed * fastest,
        alpha=alpha,
        margin=margin,
        margin_time=float(schedule.time[worst]),
        held_growth=held_growth(dynamics, maps, alpha) if margin >= 0.0 else math.nan,
        max_speed=speed * knots.max_speed(),
        gain=largest_gain(maps),
        environment_stiffness=pressed[0],
        environment_rotation=pressed[1],
        speed=float(speed),
        inertia=tuple((float(each.min()), float(each.max())) for each in eigenvalues),
        is_constant=len(inertia) == 1,
        units=tuple("Nm/rad" if i or schedule.units == "rad" else "N/m" for i in range(len(schedule.blocks))),
    )


def _damping_ratio(dynamics: ErrorDynamics) -> float:
    """Smallest damping ratio of all rows, each with its own mass."""
    squared, _, damping = dynamics.modes
    root = squared.pow(-0.25)
    if damping.ndim == 2:
        return 0.5 * float((root * damping * root).min())
    return 0.5 * float(torch.linalg.eigvalsh(root[:, :, None] * damping * root[:, None, :]).min())


def stiffest_environment(
    stiffness: Float[Tensor, "n d d"],
    damping: Float[Tensor, "n d d"],
    mass: Float[Tensor, "d d"],
    position_loop: PositionLoop,
    force_cutoff: float | None,
    dt: float,
) -> float:
    """Stiffest spring in N/m that the robot can press on without vibrating, the minimum over the given gains.

    The robot reads the force through a low-pass and follows the admittance by its position loop. Along an axis of the
    damping, one tick of the closed loop is a matrix, and the result is the stiffest spring up to which its eigenvalues
    stay within the unit circle, about ``damping / (lag of loop and sensor)``. Gains are held, and axes are independent;
    of more than 200 knots, 200 are checked together with those of the least damping and stiffness.
    """
    softest = [torch.linalg.eigvalsh(gain)[:, :1].argmin(0) for gain in (stiffness, damping)]
    chosen = torch.cat([evenly(len(stiffness), _MAX_KNOTS), *softest])
    stiffness, damping = stiffness[chosen], damping[chosen]
    axes = torch.linalg.eigh(symmetrize(damping)).eigenvectors
    along = [(axes * (matrix @ axes)).sum(-2).reshape(-1, 1, 1) for matrix in (stiffness, damping, mass)]
    ticks = tick_map(along[0], along[1], along[2], dt)

    def is_stable(each: Tensor, environment: float) -> Tensor:
        closed = _closed_loop(each, position_loop, force_cutoff, dt, environment)
        return torch.linalg.eigvals(closed).abs().amax(-1) < 1.0

    # Few axes are ever the weakest: after the least damped one, only those that its stiffest spring destabilizes.
    least, ticks = 2.0 * _STIFFEST, ticks[along[1].flatten().argsort()]
    while len(ticks):
        low, high = 0.0, least
        for _ in range(_BISECTIONS):
            # Wide intervals are bisected by logarithm, as the answer may have any magnitude.
            middle = math.sqrt(max(low, 1.0) * high) if high > 1e3 * max(low, 1.0) else 0.5 * (low + high)
            low, high = (middle, high) if is_stable(ticks[:1], middle) else (low, middle)
        least = low
        ticks = ticks[1:][~is_stable(ticks[1:], least)]
    return math.inf if least > _STIFFEST else least


def _closed_loop(
    ticks: Float[Tensor, "n 2 3"], loop: PositionLoop, force_cutoff: float | None, dt: float, environment: float
) -> Float[Tensor, "n m m"]:
    """Matrices that advance the state of admittance, robot, force filter and waiting commands by a tick."""
    identity = torch.eye(5 + loop.delay_steps).to(ticks).expand(len(ticks), -1, -1)
    # Each variable is a row of the identity, so that each expression for the next state is a row of the matrix.
    position, velocity, robot, robot_velocity, filtered, *waiting = identity.unbind(1)
    commands, force = [*waiting, position], -environment * robot
    read, after = force, 0.0 * filtered
    if force_cutoff is not None:
        gain = -math.expm1(-2.0 * math.pi * force_cutoff * dt)
        read, after = filtered, torch.lerp(filtered, force, gain)
    moved = ticks @ torch.stack([position, velocity, read], dim=1)
    followed = loop.transition(dt, ticks) @ torch.stack([robot, robot_velocity, commands[0]], dim=1)
    return torch.cat([moved, followed, torch.stack([after, *commands[1:]], dim=1)], dim=1)
