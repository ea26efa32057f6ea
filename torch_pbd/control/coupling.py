"""What a robot under admittance control may touch: a stiff environment closes a loop through its lags."""

import math

import torch
from torch import Tensor

from torch_pbd.control.position_loop import PositionLoop
from torch_pbd.control.transitions import admittance_rate, transition
from torch_pbd.linalg import symmetrize

_STIFFEST = 1e9  # N/m; stiffer than anything there is


def stiffest_environment(
    stiffness: Tensor,
    damping: Tensor,
    mass: Tensor,
    position_loop: PositionLoop,
    force_cutoff: float | None = 500.0,
    dt: float = 0.001,
) -> float:
    """Stiffest spring, N/m, that the robot can press on without vibrating, over all gains (n, d, d) given.

    The robot reads the force through a low-pass of ``force_cutoff`` Hz, and follows the admittance by its
    position loop: the closed loop of one axis, tick by tick, is a matrix, and the spring is the stiffest for
    which its eigenvalues stay within the unit circle. The axis is that of the least damping; about
    ``damping / (lag of loop and sensor)``.
    """
    axes, softest = _softest_axis(damping)
    spring = float(axes @ stiffness[softest] @ axes)
    damper = float(axes @ damping[softest] @ axes)
    inertia = float(axes @ mass @ axes)
    low, high = 0.0, 1.0
    one = torch.tensor([[inertia]], dtype=stiffness.dtype), torch.tensor([[damper]], dtype=stiffness.dtype)
    tick = transition(admittance_rate(torch.tensor([[spring]]).to(one[0]), one[1], one[0]), dt)[:2]

    def is_stable(environment: float) -> bool:
        closed = _closed_loop(tick, position_loop, force_cutoff, dt, environment)
        return float(torch.linalg.eigvals(closed).abs().max()) < 1.0

    while is_stable(high):
        low, high = high, 2.0 * high
        if high > _STIFFEST:
            return math.inf
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return low


def _softest_axis(damping: Tensor) -> tuple[Tensor, int]:
    values, vectors = torch.linalg.eigh(symmetrize(damping))
    index = int(values[:, 0].argmin())
    return vectors[index, :, 0], index


def _closed_loop(
    tick: Tensor, position_loop: PositionLoop, force_cutoff: float | None, dt: float, environment: float
) -> Tensor:
    """Matrix of [admittance position, velocity; robot position, velocity; filtered force; commands waiting]."""
    n_waiting = position_loop.delay_steps
    closed = tick.new_zeros(5 + n_waiting, 5 + n_waiting)
    robot, filtered, waiting = 2, 4, 5
    if force_cutoff is None:
        closed[:2, robot] = -environment * tick[:, 2]
    else:
        gain = -math.expm1(-2.0 * math.pi * force_cutoff * dt)
        closed[:2, filtered] = tick[:, 2]
        closed[filtered, filtered], closed[filtered, robot] = 1.0 - gain, -environment * gain
    closed[:2, :2] = tick[:, :2]
    follow = position_loop.transition(dt, tick)
    closed[robot : robot + 2, robot : robot + 2] = follow[:, :2]
    closed[robot : robot + 2, waiting if n_waiting else 0] = follow[:, 2]
    for step in range(n_waiting):  # the oldest command comes first
        closed[waiting + step, 0 if step == n_waiting - 1 else waiting + step + 1] = 1.0
    return closed
