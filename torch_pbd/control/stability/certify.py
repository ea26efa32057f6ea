"""Guarantees of a stiffness schedule, each by its name, and what it may touch.

With the deviation y from the desired motion, ``M y'' + D y' + K y = f``: a rise of K feeds energy in.
"""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.damping import required_damping_ratio
from torch_pbd.control.matrices import as_mass, mass_matrix
from torch_pbd.control.schedule.schedule import Schedule
from torch_pbd.control.simulation.position_loop import PositionLoop
from torch_pbd.control.simulation.ticks import admittance_rate, transition
from torch_pbd.control.stability.lyapunov import Knots, has_common_function, held_growth
from torch_pbd.control.stability.report import StabilityReport
from torch_pbd.linalg import spectral_map, symmetrize

# Parts of the schedule that are followed at a time for their gain.
_MAX_BEGINNINGS = 400
# N/m; stiffer than anything there is.
_STIFFEST = 1e9
# Knots of a schedule that are coupled to an environment, each of which takes 60 eigenvalues of a matrix of 5 + delay.
_MAX_KNOTS = 200
_BISECTIONS = 60


def certify(
    schedule: Schedule | Any,
    *,
    mass: Any = 1.0,
    speed: float = 1.0,
    position_loop: PositionLoop | Any = None,
    force_cutoff: float | None = 500.0,
    dt: float = 0.001,
) -> StabilityReport:
    """Check the stability of a schedule.

    Parameters
    ----------
    schedule : Schedule
        Whose times and gains are checked.
    mass : float or array_like of shape (d, d), default=1.0
        Virtual mass of the admittance, kg.
    speed : float, default=1.0
        Replay speed: 2 is twice as fast.
    position_loop : PositionLoop, default=None
        For the stiffest environment; None is 20 Hz behind one tick.
    force_cutoff : float, default=500.0
        Of the force sensor's low-pass, Hz; None is none.
    dt : float, default=0.001
        Tick of the controller, s.

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
    checks.instance(position_loop, "position_loop", PositionLoop, optional=True)
    checks.instance(schedule, "schedule", Schedule)
    # An axis that is free never returns: nothing is to be certified of it.
    checks.semidefinite(schedule.stiffness, "stiffness", definite=True)
    time, stiffness, damping = map(torch.tensor, (schedule.time, schedule.stiffness, schedule.damping))
    checked = as_mass(mass)
    inertia, is_number = mass_matrix(checked, stiffness).detach(), not (isinstance(checked, Tensor) and checked.ndim)
    knots = Knots(time / speed, stiffness, damping, inertia)
    alpha, margin, worst = knots.certificate()
    ratio, required, at_any_schedule, smallest = _damping_rule(stiffness, damping, inertia)
    rate = admittance_rate(stiffness[:-1], damping[:-1], inertia)[..., : 2 * inertia.shape[0], : 2 * inertia.shape[0]]
    maps = transition(rate * (time / speed).diff()[:, None, None], 1.0)
    loop = PositionLoop() if position_loop is None else position_loop
    return StabilityReport(
        damping_ratio=smallest,
        stiffness_ratio=ratio,
        required_damping_ratio=required,
        stable_at_any_schedule=at_any_schedule,
        alpha=alpha,
        margin=margin,
        margin_time=float(time[worst]),
        held_growth=held_growth(maps, stiffness, damping, inertia, alpha),
        max_speed=speed * knots.max_speed(),
        gain=_gain(maps, stiffness, inertia),
        environment_stiffness=stiffest_environment(stiffness, damping, inertia, loop, force_cutoff, dt),
        speed=float(speed),
        mass=float(inertia[0, 0]) if is_number else tuple(map(tuple, inertia.tolist())),
    )


def _damping_rule(stiffness: Tensor, damping: Tensor, mass: Tensor) -> tuple[float, float, bool, float]:
    """Stiffness ratio, damping ratio it requires, whether one function falls at all knots, and the smallest ratio."""
    inverse = spectral_map(mass, torch.rsqrt)
    stiff, damp = (symmetrize(inverse @ gain @ inverse) for gain in (stiffness, damping))
    eigenvalues = torch.linalg.eigvalsh(stiff)
    ratio = float(eigenvalues.max() / eigenvalues.min())
    root = spectral_map(stiff, lambda value: value.pow(-0.25))
    ratios = torch.linalg.eigvalsh(symmetrize(root @ damp @ root)) / 2.0
    return ratio, required_damping_ratio(ratio), has_common_function(stiff, damp), float(ratios.min())


def _gain(maps: Float[Tensor, "m n n"], stiffness: Float[Tensor, "k d d"], mass: Tensor) -> float:
    """Largest ``||P_j^1/2 Phi(j, i) P_i^-1/2||`` over i < j, with P = diag(K, M) and the exact maps Phi."""
    energy = torch.stack([torch.block_diag(each, mass) for each in stiffness])
    root = torch.linalg.cholesky(energy).mT
    maps = torch.linalg.solve_triangular(root[:-1], root[1:] @ maps, upper=True, left=False)
    begun, identity = maps[:0], torch.eye(maps.shape[-1]).to(maps)
    largest = 1.0
    for each in maps:
        begun = each @ torch.cat([begun, identity[None]])
        squared = begun.mT @ begun
        # A part that has not grown so far gains no more than one that begins here. Whether all eigenvalues are below
        # a limit is seen sooner than what they are.
        grown = torch.linalg.cholesky_ex((1.0 + 1e-12) * identity - squared).info > 0
        begun, squared = begun[grown], squared[grown]
        record = torch.linalg.cholesky_ex(largest * (1.0 + 1e-12) * identity - squared).info > 0
        if bool(record.any()):
            largest = float(torch.linalg.eigvalsh(squared[record]).max())
        if len(begun) > _MAX_BEGINNINGS:
            begun = begun[torch.linalg.matrix_norm(begun).topk(_MAX_BEGINNINGS).indices]
    return math.sqrt(largest)


def stiffest_environment(
    stiffness: Float[Tensor, "n d d"],
    damping: Float[Tensor, "n d d"],
    mass: Float[Tensor, "d d"],
    position_loop: PositionLoop,
    force_cutoff: float | None = 500.0,
    dt: float = 0.001,
) -> float:
    """Stiffest spring, N/m, that the robot can press on without vibrating, the least over the gains given.

    The robot reads the force through a low-pass of ``force_cutoff`` Hz, and follows the admittance by its
    position loop: the closed loop along an axis of the damping, tick by tick, is a matrix, and the spring is the
    stiffest up to which its eigenvalues stay within the unit circle; about ``damping / (lag of loop and sensor)``.
    Gains are held, and axes taken one by one; of more than 200 knots, 200 are looked at and those with the least
    damping and stiffness.
    """
    chosen = torch.linspace(0, len(stiffness) - 1, min(len(stiffness), _MAX_KNOTS)).round().long()
    softest = [torch.linalg.eigvalsh(gain)[:, 0].argmin() for gain in (stiffness, damping)]
    chosen = torch.cat([chosen.to(stiffness.device), torch.stack(softest)])
    axes = torch.linalg.eigh(symmetrize(damping[chosen])).eigenvectors
    along = [
        (axes * (matrix @ axes)).sum(-2).reshape(-1, 1, 1) for matrix in (stiffness[chosen], damping[chosen], mass)
    ]
    ticks = transition(admittance_rate(*along), dt)[:, :2]
    low, high = torch.zeros_like(along[0][:, 0, 0]), torch.full_like(along[0][:, 0, 0], 2.0 * _STIFFEST)
    for _ in range(_BISECTIONS):
        # By the logarithm while that is wide: the answer may lie anywhere between a feather and a wall.
        middle = torch.where(high > 1e3 * low.clamp_min(1.0), (low.clamp_min(1.0) * high).sqrt(), 0.5 * (low + high))
        closed = _closed_loop(ticks, position_loop, force_cutoff, dt, middle)
        stable = torch.linalg.eigvals(closed).abs().amax(-1) < 1.0
        low, high = torch.where(stable, middle, low), torch.where(stable, high, middle)
        lasting = low <= high.min()  # the others are not the least
        low, high, ticks = low[lasting], high[lasting], ticks[lasting]
    least = float(low.min())
    return math.inf if least > _STIFFEST else least


def _closed_loop(
    ticks: Float[Tensor, "n 2 3"],
    position_loop: PositionLoop,
    force_cutoff: float | None,
    dt: float,
    environment: Float[Tensor, " n"],
) -> Float[Tensor, "n m m"]:
    """Matrices of [admittance position, velocity; robot position, velocity; filtered force; commands waiting]."""
    n_waiting = position_loop.delay_steps
    closed = ticks.new_zeros(len(ticks), 5 + n_waiting, 5 + n_waiting)
    robot, filtered, waiting = 2, 4, 5
    if force_cutoff is None:
        closed[:, :2, robot] = -environment[:, None] * ticks[:, :, 2]
    else:
        gain = -math.expm1(-2.0 * math.pi * force_cutoff * dt)
        closed[:, :2, filtered] = ticks[:, :, 2]
        closed[:, filtered, filtered] = 1.0 - gain
        closed[:, filtered, robot] = -environment * gain
    closed[:, :2, :2] = ticks[:, :, :2]
    follow = position_loop.transition(dt, ticks)
    closed[:, robot : robot + 2, robot : robot + 2] = follow[:, :2]
    closed[:, robot : robot + 2, waiting if n_waiting else 0] = follow[:, 2]
    for step in range(n_waiting):  # the oldest command comes first
        closed[:, waiting + step, 0 if step == n_waiting - 1 else waiting + step + 1] = 1.0
    return closed
