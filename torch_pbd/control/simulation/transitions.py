"""What one tick does to an admittance: linear maps of its state, exact and by the usual integrators."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Integrator = Literal["exact", "semi_implicit_euler", "rk4", "trapezoid"]


def admittance_rate(
    stiffness: Float[Tensor, "*b d d"], damping: Float[Tensor, "*b d d"], mass: Float[Tensor, "*m d d"]
) -> Float[Tensor, "*b n n"]:
    """Matrix of ``[deviation, velocity, force]' = rate @ [deviation, velocity, force]``, n = 3 d.

    Of ``M a = u - K y - D v`` with the deviation y from the desired position and a constant force u.
    """
    d = stiffness.shape[-1]
    inverse = torch.linalg.inv(mass).expand_as(stiffness)
    rate = stiffness.new_zeros(*stiffness.shape[:-2], 3 * d, 3 * d)
    rate[..., :d, d : 2 * d] = torch.eye(d).to(stiffness)
    rate[..., d : 2 * d, :d] = -inverse @ stiffness
    rate[..., d : 2 * d, d : 2 * d] = -inverse @ damping
    rate[..., d : 2 * d, 2 * d :] = inverse
    return rate


def transition(rate: Float[Tensor, "*b n n"], dt: float, integrator: Integrator = "exact") -> Float[Tensor, "*b n n"]:
    """Map of ``[deviation, velocity, force]`` over a tick of ``dt`` s in which everything is held.

    "exact" is the matrix exponential: with stiffness, damping, force and desired motion held over the tick
    (zero-order hold) it is the solution, for any tick. The others are what simulators use:
    "semi_implicit_euler" (velocity first), "rk4" (order 4) and "trapezoid" (order 2, stable for any tick).
    """
    step = rate * dt
    identity = torch.eye(step.shape[-1]).to(step)
    if integrator == "exact":
        return torch.linalg.matrix_exp(step)
    if integrator == "trapezoid":
        return torch.linalg.solve(identity - 0.5 * step, identity + 0.5 * step)
    if integrator == "rk4":
        return identity + step @ (identity + step @ (identity + step @ (identity + step / 4.0) / 3.0) / 2.0)
    d = step.shape[-1] // 3
    kick, drift = identity.expand_as(step).clone(), identity.expand_as(step).clone()
    kick[..., d : 2 * d, :] += step[..., d : 2 * d, :]
    drift[..., :d, :] += step[..., :d, :]
    return drift @ kick
