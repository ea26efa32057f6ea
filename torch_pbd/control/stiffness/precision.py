"""Minimal intervention stiffness: the optimal regulator whose cost of deviations is weighted by their precision.

With the cost ``e' Sigma^-1 e + r f' M^-1 f`` of deviations e and forces f of a mass, ``M e" = f``, the Riccati equation
of the gains ``f = -K e - D e'`` is ``K M^-1 K = Sigma^-1 / r`` and ``D M^-1 D = 2 K``. Its solution is the geometric
mean ``K = M # (Sigma^-1 / r)``, symmetric for every Sigma and M, and D of the damping ratio 1/sqrt(2). The effort of f
is measured by M^-1, with which one r has the same unit for positions and rotations; measured by f'f, K of a mass matrix
would not be symmetric. S. Calinon, "A tutorial on task-parameterized movement learning and retrieval", Intelligent
Service Robotics 9, 2016, has the regulator for accelerations.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.matrices import as_mass, as_semidefinite, damping_from_stiffness, masses_like
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.linalg import block_matrix, spectral_map, symmetrize

# Largest stiffness before clipping, as a multiple of the limit: axes without variance would be infinitely stiff. Those
# stiffer than a million times the limit are clipped to it anyway, and leave ten digits to the others.
_STIFFEST = 1e6


def matched_effort(mass: Float[Tensor, "*b d d"], scale: float, stiffness: float) -> float:
    """Effort r, in kg/N^2, under which a standard deviation along an axis of a mean mass gets this stiffness."""
    # k = m^1/2 / (r^1/2 scale). The mean mass is geometric, over axes and rows, which depends neither on the frame nor
    # on units.
    mean = float((torch.linalg.slogdet(mass.detach()).logabsdet / mass.shape[-1]).mean().exp())
    if scale <= 0.0:
        raise InvalidParameterError("covariance is zero: effort='match' needs deviations; give effort as a number.")
    return mean / (scale * stiffness) ** 2


def precision_stiffness(
    covariance: Float[Tensor, "*b d d"],
    mass: Float[Tensor, "*b d d"],
    effort: Float[Tensor, " d"],
    low: Float[Tensor, " d"],
    high: Float[Tensor, " d"],
) -> Float[Tensor, "*b d d"]:
    """Stiffness ``M # (W Sigma^-1 W)``, ``W = diag(effort)^-1/2``, clipped between the diagonal matrices low and high.

    Clipping uses the metric of ``E = high - low``, where time is the only unit: ``T (A # B) T' = (T A T') # (T B T')``.
    In it K is ``low + U`` with the eigenvalues of U clipped to 0 to 1.
    """
    extent = (high - low).sqrt()
    metric = torch.where(extent > 0.0, extent, high.sqrt())  # where the limits are one, any metric does
    stretch = metric * effort.sqrt()
    lighter = mass / torch.outer(metric, metric)
    least = torch.linalg.eigvalsh(lighter.detach())[..., :1]
    root = spectral_map(lighter, lambda m: m.clamp_min(torch.finfo(m.dtype).tiny).sqrt())
    inner = root @ (torch.outer(stretch, stretch) * covariance) @ root
    inverse = spectral_map(inner, lambda square: torch.maximum(square, (least / _STIFFEST) ** 2).rsqrt())
    share = root @ inverse @ root - torch.diag(low / metric**2)
    held = spectral_map(share, lambda u: u.clamp(0.0, 1.0))
    return torch.diag(low) + torch.outer(extent, extent) * held


def lqt(
    covariance: Float[Tensor, "n d d"] | Any,
    mass: Any,
    dt: float,
    *,
    effort: float = 1e-6,
    horizon: float | None = None,
) -> tuple[Float[Tensor, "n d d"], Float[Tensor, "n d d"]]:
    """Stiffness and damping (n, d, d) that minimize the expected cost over the time ahead.

    The cost is that of ``StiffnessLaw(kind="precision")``, ``e' Sigma^-1 e + r f' M^-1 f``, from each row to the end of
    its horizon, plus the infinite-horizon cost of the row there, since a free end would distort the gains before it.
    For a constant covariance this is the precision law with a damping ratio of 1/sqrt(2), without limits.

    Parameters
    ----------
    covariance : Tensor of shape (n, d, d)
        Positive definite covariances at ticks of ``dt``, each held over its tick.
    mass : float or Tensor of shape (d, d) or (n, d, d)
        Mass in kg.
    dt : float
        Length of a tick in s.
    effort : float, default=1e-6
        Weight r of the forces in kg/N^2.
    horizon : float, default=None
        Horizon of each row in s; None is to the last row.

    Returns
    -------
    stiffness, damping : Tensor of shape (n, d, d)
        Symmetric part of the optimal stiffness, which is not symmetric where axes turn, and damping; without limits.
    """
    matrix = as_semidefinite(covariance, "covariance")[0]
    if matrix.ndim != 3 or not bool((torch.linalg.eigvalsh(matrix)[:, 0] > 0.0).all()):
        raise InvalidParameterError("covariance must have shape (n, d, d) and be positive definite: lqt has no limits.")
    dt, r = checks.number(dt, "dt", above=0.0, unit="s"), checks.number(effort, "effort", above=0.0, unit="kg/N^2")
    n, d = matrix.shape[:2]
    ahead = n - 1 if horizon is None else round(checks.number(horizon, "horizon", least=0.0, unit="s") / dt)
    masses = masses_like(as_mass(mass), matrix, "covariance").expand(matrix.shape)
    precision, lightness = torch.linalg.inv(matrix), torch.linalg.inv(masses)
    still, moving = slice(0, d), slice(d, 2 * d)
    # One matrix exponential moves the state z = (e, e') and its costate P z over a tick.
    flow = matrix.new_zeros(n, 4 * d, 4 * d)
    flow[:, still, moving] = torch.eye(d).to(matrix)
    flow[:, moving, 3 * d :] = -lightness / r
    flow[:, 2 * d : 3 * d, still] = -precision
    flow[:, 3 * d :, 2 * d : 3 * d] = -torch.eye(d).to(matrix)
    back = torch.linalg.matrix_exp(-dt * flow)
    # The infinite-horizon cost under one covariance is that of the precision law: its stiffness M # (Sigma^-1 / r) is a
    # geometric mean, and so equals the damping of ratio 1/2 for the stiffness Sigma^-1 / r.
    stiffness = damping_from_stiffness(precision / r, masses, 0.5)
    damping = damping_from_stiffness(stiffness, masses, 0.5**0.5)
    cost = r * block_matrix(stiffness @ lightness @ damping, stiffness, stiffness, damping)
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


def _before(cost: Tensor, back: Tensor) -> Tensor:
    """Cost P of states at the start of a tick, given that at its end; the costate is P z at both."""
    k = cost.shape[-1]
    state = back[..., :k, :k] + back[..., :k, k:] @ cost
    costate = back[..., k:, :k] + back[..., k:, k:] @ cost
    return symmetrize(torch.linalg.solve(state.mT, costate.mT).mT)
