"""The stiffest environment that a robot can press on without vibrating, behind its position loop."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.simulation.sensor import PositionLoop
from torch_pbd.control.simulation.ticks import admittance_rate, transition
from torch_pbd.linalg import least_eigenvalue, symmetrize

# N/m; stiffer than anything there is.
_STIFFEST = 1e9
# Knots of a schedule that are coupled to an environment.
_MAX_KNOTS = 200
_BISECTIONS = 60


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
    identity = torch.eye(stiffness.shape[-1]).to(stiffness)
    softest = [
        least_eigenvalue(lambda rows, q, p, gain=gain: q * gain[rows] + p * identity, len(gain))[1]
        for gain in (stiffness, damping)
    ]
    chosen = torch.cat([chosen, torch.tensor(softest)])
    axes = torch.linalg.eigh(symmetrize(damping[chosen])).eigenvectors
    along = [
        (axes * (matrix @ axes)).sum(-2).reshape(-1, 1, 1) for matrix in (stiffness[chosen], damping[chosen], mass)
    ]
    ticks = transition(admittance_rate(*along), dt)[:, :2]

    def is_stable(each: Tensor, environment: float) -> Tensor:
        closed = _closed_loop(each, position_loop, force_cutoff, dt, environment)
        return torch.linalg.eigvals(closed).abs().amax(-1) < 1.0

    # Most axes are never the least: after that which is damped least, those for which what it bears is too much.
    least, ticks = 2.0 * _STIFFEST, ticks[along[1].flatten().argsort()]
    while len(ticks):
        low, high = 0.0, least
        for _ in range(_BISECTIONS):
            # By the logarithm while that is wide: the answer may lie anywhere between a feather and a wall.
            middle = math.sqrt(max(low, 1.0) * high) if high > 1e3 * max(low, 1.0) else 0.5 * (low + high)
            low, high = (middle, high) if is_stable(ticks[:1], middle) else (low, middle)
        least = low
        ticks = ticks[1:][~is_stable(ticks[1:], least)]
    return math.inf if least > _STIFFEST else least


def _closed_loop(
    ticks: Float[Tensor, "n 2 3"],
    position_loop: PositionLoop,
    force_cutoff: float | None,
    dt: float,
    environment: float,
) -> Float[Tensor, "n m m"]:
    """Matrices of [admittance position, velocity; robot position, velocity; filtered force; commands waiting]."""
    n_waiting = position_loop.delay_steps
    closed = ticks.new_zeros(len(ticks), 5 + n_waiting, 5 + n_waiting)
    robot, filtered, waiting = 2, 4, 5
    if force_cutoff is None:
        closed[:, :2, robot] = -environment * ticks[:, :, 2]
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
