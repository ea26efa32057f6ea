"""Damping from stiffness and mass."""

import math
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.control.matrices import as_semidefinite, check_finite, check_mass
from torch_pbd.linalg import spectral_map, symmetrize


def damping_from_stiffness(
    stiffness: Float[Tensor, "*b d d"] | Any,
    mass: float | Float[Tensor, "*m d d"] = 1.0,
    damping_ratio: float | Literal["paper"] = 1.0,
) -> Float[Tensor, "*b d d"]:
    """Damping in N s/m that gives every mode of mass and stiffness the same damping ratio.

    ``2 zeta M^1/2 (M^-1/2 K M^-1/2)^1/2 M^1/2``, which is ``2 zeta (m K)^1/2`` for one mass (A. Albu-Schaeffer,
    C. Ott, U. Frese, G. Hirzinger, "Cartesian impedance control of redundant robots", ICRA 2003).

    Parameters
    ----------
    stiffness : Tensor of shape (..., d, d)
        In N/m, symmetric and positive semidefinite.
    mass : float or Tensor of shape (..., d, d), default=1.0
        In kg; a matrix must be symmetric and positive definite.
    damping_ratio : float or "paper", default=1.0
        1 is critical. With one mass, any schedule of stiffness is stable for a ratio of at least
        ``(R^(1/4) - R^(-1/4)) / 2``, R the ratio of the largest to the smallest stiffness: 1 up to R = 33.9.
        "paper" is ``K^1/2`` whatever the mass: a ratio of ``1 / (2 sqrt(m))``, critical at 0.25 kg only.

    Raises
    ------
    ValueError
        If a matrix is not symmetric and positive (semi)definite, or the ratio is negative.
    """
    matrix = as_semidefinite(stiffness, "stiffness")
    if damping_ratio == "paper":
        return spectral_map(matrix, _root)
    if isinstance(damping_ratio, str):
        raise ValueError(f"damping_ratio == {damping_ratio!r}, must be a number or 'paper'.")
    check_finite("damping_ratio", damping_ratio)
    if damping_ratio < 0.0:
        raise ValueError(f"damping_ratio == {damping_ratio:g}, must not be negative: the motion would gain energy.")
    if not isinstance(mass, Tensor) or mass.ndim == 0:
        check_mass(mass)
        return 2.0 * damping_ratio * math.sqrt(float(mass)) * spectral_map(matrix, _root)
    check_mass(mass)
    root = spectral_map(mass.to(matrix), torch.sqrt)
    inverse = spectral_map(mass.to(matrix), torch.rsqrt)
    return symmetrize(2.0 * damping_ratio * root @ spectral_map(inverse @ matrix @ inverse, _root) @ root)


def _root(eigenvalue: Tensor) -> Tensor:
    # The slope of the root is infinite at zero; a free axis has no damping and gets no gradient.
    tiny = torch.finfo(eigenvalue.dtype).tiny
    return torch.where(eigenvalue > tiny, eigenvalue.clamp_min(tiny).sqrt(), 0.0)
