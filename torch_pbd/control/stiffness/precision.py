"""Stiffness of minimal intervention: what an optimal regulator does whose cost of deviations is their precision.

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
from torch_pbd.control.matrices import as_mass, check_fits
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.linalg import spectral_map

# Of the lightest mass over the heaviest stiffness: deviations of no variance would be infinitely stiff. What is stiffer
# than a million times the limit is held at the limit all the same, and leaves ten digits to what is not.
_STIFFEST = 1e6


def as_masses(mass: Any, like: Tensor) -> Tensor:
    """Masses (..., d, d) that fit matrices (..., d, d), of a number in kg or of matrices."""
    if mass is None:
        raise checks.refusal(None, "mass", "given", "the stiffness of kind='precision' depends on it")
    matrix = torch.as_tensor(as_mass(mass)).to(like)
    matrix = matrix if matrix.ndim else matrix * torch.eye(like.shape[-1]).to(like)
    check_fits(matrix, like, "covariance")
    return matrix


def matched_effort(mass: Float[Tensor, "*b d d"], scale: float, stiffness: float) -> float:
    """Effort r, in kg/N^2, under which a standard deviation along an axis of a mean mass gets this stiffness.

    ``k = m^1/2 / (r^1/2 scale)``. The mean of masses is geometric, over axes and rows: it turns with no axes, and has
    no unit to choose.
    """
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
    """Stiffness ``M # (W Sigma^-1 W)``, ``W = diag(effort)^-1/2``, held between diagonal matrices of low and high.

    In the metric of ``E = high - low``, in which nothing has a unit but time: ``T (A # B) T' = (T A T') # (T B T')``.
    There K is ``low + U``, and 0 <= U <= 1 by its eigenvalues.
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
