"""Gains of a regulator that knows what comes: linear quadratic tracking over a horizon."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.damping import damping_from_stiffness
from torch_pbd.control.matrices import as_semidefinite
from torch_pbd.control.stiffness.precision import as_masses
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.linalg import symmetrize


def lqt(
    covariance: Float[Tensor, "n d d"] | Any,
    mass: Any,
    dt: float,
    *,
    effort: float = 1e-6,
    horizon: float | None = None,
) -> tuple[Float[Tensor, "n d d"], Float[Tensor, "n d d"]]:
    """Stiffness and damping (n, d, d) that minimize the expected cost of what is ahead, not of what is now.

    The cost is that of ``StiffnessLaw(kind="precision")``, ``e' Sigma^-1 e + r f' M^-1 f``, from each row to the end of
    its horizon, whose end cost is that of the row there, held for ever. A free end would leave nothing to do but in
    time, and stiffness grows without bound for it. Where the covariance does not change this is the precision law with
    a damping ratio of 1/sqrt(2), without limits.

    Parameters
    ----------
    covariance : Tensor of shape (n, d, d)
        Positive definite, at ticks of ``dt``, each held over its tick.
    mass : float or Tensor of shape (d, d) or (n, d, d)
        In kg.
    dt : float
        In s.
    effort : float, default=1e-6
        The r, in kg/N^2.
    horizon : float, default=None
        How far ahead each row sees, in s; None is to the last row.

    Returns
    -------
    stiffness, damping : Tensor of shape (n, d, d)
        The symmetric part of the optimal stiffness, which is not symmetric where axes turn; of no limits.
    """
    matrix = as_semidefinite(covariance, "covariance")[0]
    if matrix.ndim != 3 or not bool((torch.linalg.eigvalsh(matrix)[:, 0] > 0.0).all()):
        raise InvalidParameterError("covariance must have shape (n, d, d) and be positive definite: lqt has no limits.")
    dt, r = checks.number(dt, "dt", above=0.0, unit="s"), checks.number(effort, "effort", above=0.0, unit="kg/N^2")
    n, d = matrix.shape[:2]
    ahead = n - 1 if horizon is None else round(checks.number(horizon, "horizon", least=0.0, unit="s") / dt)
    masses = as_masses(mass, matrix).expand(matrix.shape)
    precision, lightness = torch.linalg.inv(matrix), torch.linalg.inv(masses)
    still, moving = slice(0, d), slice(d, 2 * d)
    # Over a tick the costate P z of the state z = (e, e') and the state are moved by one matrix exponential.
    flow = matrix.new_zeros(n, 4 * d, 4 * d)
    flow[:, still, moving] = torch.eye(d).to(matrix)
    flow[:, moving, 3 * d :] = -lightness / r
    flow[:, 2 * d : 3 * d, still] = -precision
    flow[:, 3 * d :, 2 * d : 3 * d] = -torch.eye(d).to(matrix)
    back = torch.linalg.matrix_exp(-dt * flow)
    cost = _stationary(precision, masses, lightness, r)
    if horizon is None:
        for row in range(n - 2, -1, -1):
            cost[row] = _before(cost[row + 1], back[row])
    else:
        rows = torch.arange(n)
        cost = cost[(rows + ahead).clamp(max=n - 1)]
        for step in range(ahead - 1, -1, -1):
            inside = rows + step < n - 1
            cost = torch.where(inside[:, None, None], _before(cost, back[(rows + step).clamp(max=n - 1)]), cost)
    return symmetrize(cost[:, moving, still]) / r, symmetrize(cost[:, moving, moving]) / r


def _before(cost: Float[Tensor, "*b k k"], back: Float[Tensor, "*b l l"]) -> Float[Tensor, "*b k k"]:
    """Cost P of states at the start of a tick, of that at its end: the costate is P z at both."""
    k = cost.shape[-1]
    state = back[..., :k, :k] + back[..., :k, k:] @ cost
    costate = back[..., k:, :k] + back[..., k:, k:] @ cost
    return symmetrize(torch.linalg.solve(state.mT, costate.mT).mT)


def _stationary(precision: Tensor, mass: Tensor, lightness: Tensor, r: float) -> Float[Tensor, "n k k"]:
    """Cost P of states for ever under one covariance: of the gains K and D of the precision law."""
    # M # (Sigma^-1 / r): the damping of a ratio of a half is the geometric mean of mass and stiffness.
    stiffness = damping_from_stiffness(precision / r, mass, 0.5)
    damping = damping_from_stiffness(stiffness, mass, 0.5**0.5)
    whole = torch.cat([stiffness @ lightness @ damping, stiffness], dim=-1)
    return r * torch.cat([whole, torch.cat([stiffness, damping], dim=-1)], dim=-2)
