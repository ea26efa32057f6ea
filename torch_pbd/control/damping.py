"""Damping from stiffness and mass."""

import math
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.control.matrices import as_damping_ratio, as_mass, as_semidefinite, check_fits
from torch_pbd.linalg import spectral_map, symmetrize


def damping_from_stiffness(
    stiffness: Float[Tensor, "*b d d"] | Any,
    mass: float | Float[Tensor, "*m d d"] | Any = 1.0,
    damping_ratio: float | Literal["paper"] | Any = 1.0,
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
        1 is critical, and makes any schedule stable whose largest stiffness is below 33.9 times its smallest; see
        :func:`required_damping_ratio`.
        "paper" is ``K^1/2`` whatever the mass: a ratio of ``1 / (2 sqrt(m))``, critical at 0.25 kg only.

    Raises
    ------
    ValueError
        If a matrix is not symmetric and positive (semi)definite, or the ratio is negative.
    """
    ratio = as_damping_ratio(damping_ratio)
    if ratio == "paper":
        ratio, mass = 0.5, 1.0  # whose damping is K^1/2
    matrix, spectrum = as_semidefinite(stiffness, "stiffness")
    mass = as_mass(mass)
    if not isinstance(mass, Tensor) or mass.ndim == 0:
        return 2.0 * ratio * mass**0.5 * spectral_map(matrix, _root, spectrum)
    check_fits(mass, matrix, "stiffness")
    mass = mass.to(matrix)
    along_mass = torch.linalg.eigh(symmetrize(mass.detach()))
    root, inverse = (spectral_map(mass, function, tuple(along_mass)) for function in (torch.sqrt, torch.rsqrt))
    return symmetrize(2.0 * ratio * root @ spectral_map(inverse @ matrix @ inverse, _root) @ root)


def required_damping_ratio(stiffness_ratio: float) -> float:
    """Damping ratio from which a robot is exponentially stable under any schedule of stiffness whatever.

    For damping ``2 zeta (m K)^1/2``, however fast K changes and its axes turn, as long as its eigenvalues stay between
    ``k`` and ``stiffness_ratio * k``; held over ticks of any length, or blends of such pairs (linear between knots).

    ``(R^(1/4) - R^(-1/4)) / 2`` up to R = 194: 0.82 for R = 20, and critical damping does up to 33.9. Above 194
    more is needed than this, and from 1154 on the proof gives no ratio: infinity.

    Parameters
    ----------
    stiffness_ratio : float
        R, the largest stiffness over the smallest, of all axes and times; at least 1.

    Raises
    ------
    ValueError
        If it is below 1.

    Notes
    -----
    With the frequency w, ``w^2 = k R^(1/2) / m``, the function ``V = w^2 |y|^2 + 2 b w y'v + |v|^2``, 0 < b < 1, does
    not depend on axes. Along an axis of stiffness ``m w^2 s^2``, ``R^(-1/4) <= s <= R^(1/4)``, its derivative is a
    quadratic form, negative definite if and only if ``(u - 2 b zeta)^2 < 4 (1 - b^2)`` with ``u = s + 1 / s``, which
    lies between 2 and ``R^(1/4) + R^(-1/4)``. The b that serves the most of these is ``zeta / (1 + zeta^2)^(1/2)`` up
    to ``zeta = 3^(1/2)``, and ``2 zeta / (1 + zeta^2)``, where u = 2 is the limit, above.
    """
    checks.number(stiffness_ratio, "stiffness_ratio", least=1.0, remedy="it is the largest over the smallest")
    root = stiffness_ratio**0.25
    largest = root + 1.0 / root
    # Of u in the Notes. Up to 4 the b of zeta <= 3^(1/2) serves the interval [2, u], above it that of larger zeta.
    if largest <= 4.0:
        return (root - 1.0 / root) / 2.0
    share = (largest - 2.0) / 4.0
    return math.sqrt((1.0 + share) / (1.0 - share)) if share < 1.0 else math.inf


def _root(eigenvalue: Tensor) -> Tensor:
    # The slope of the root is infinite at zero; a free axis has no damping and gets no gradient.
    tiny = torch.finfo(eigenvalue.dtype).tiny
    return torch.where(eigenvalue > tiny, eigenvalue.clamp_min(tiny).sqrt(), 0.0)
