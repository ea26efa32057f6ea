"""Stiffness, damping and mass matrices: checked tensors, and damping from stiffness."""

import math
from numbers import Real
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd import checks
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.linalg import spectral_map, symmetrize

# Smallest mass in kg: gains are at most 1e100, and float64 must hold squares of gain over mass.
_LIGHTEST = 1e-50


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
        Stiffness in N/m, symmetric and positive semidefinite.
    mass : float or Tensor of shape (..., d, d), default=1.0
        Mass in kg; a matrix must be symmetric and positive definite.
    damping_ratio : float or "paper", default=1.0
        Damping ratio zeta. 1 is critical, and stabilizes any schedule whose largest stiffness is below 33.9 times its
        smallest; see :func:`required_damping_ratio`. "paper" is ``K^1/2`` for every mass: a ratio of
        ``1 / (2 sqrt(m))``, which is critical only at 0.25 kg.

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
    mass = masses_like(mass, matrix, "stiffness")
    along_mass = torch.linalg.eigh(symmetrize(mass.detach()))
    root, inverse = (spectral_map(mass, function, tuple(along_mass)) for function in (torch.sqrt, torch.rsqrt))
    return symmetrize(2.0 * ratio * root @ spectral_map(inverse @ matrix @ inverse, _root) @ root)


def required_damping_ratio(stiffness_ratio: float) -> float:
    """Damping ratio from which a robot is exponentially stable under any stiffness schedule.

    It holds for damping ``2 zeta (m K)^1/2``, however fast K changes and its axes turn, as long as its eigenvalues stay
    between ``k`` and ``stiffness_ratio * k``, with gains held over ticks of any length or linear between knots.

    The ratio is ``(R^(1/4) - R^(-1/4)) / 2`` up to R = 194: 0.82 for R = 20, and critical damping suffices up to 33.9.
    Above 194 it is larger than this, and from 1154 on the proof gives no ratio: infinity.

    Parameters
    ----------
    stiffness_ratio : float
        Ratio R of the largest to the smallest stiffness over all axes and times, at least 1.

    Raises
    ------
    ValueError
        If the ratio is below 1.

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
    # The largest u of the Notes. Up to 4 the b of zeta <= 3^(1/2) serves the interval [2, u], above it that of larger
    # zeta.
    if largest <= 4.0:
        return (root - 1.0 / root) / 2.0
    share = (largest - 2.0) / 4.0
    return math.sqrt((1.0 + share) / (1.0 - share)) if share < 1.0 else math.inf


def as_tensor(value: Any, name: str) -> Tensor:
    """Dense float32 or float64 tensor; other arrays are copied as float64. Errors contain ``name``."""
    if not isinstance(value, Tensor):
        # A copy: torch must alias no read-only array, and takes no negative strides.
        return torch.from_numpy(checks.real_floats(value, name).copy())
    whole = not (value.is_floating_point() or value.is_complex())
    dense = value.layout == torch.strided and not value.is_meta
    if not (dense and (whole or value.dtype in (torch.float32, torch.float64))):
        raise InvalidParameterError(
            f"{name} is a tensor of {value.dtype}, {value.layout}, on {value.device}, must be dense, of real numbers, "
            "in float32 or float64."
        )
    return value.double() if whole else value


def as_rows(value: Any, name: str, n_dims: int) -> Tensor:
    """Tensor of finite real floats with at least ``n_dims`` dimensions, none of them empty."""
    rows = as_tensor(value, name)
    if rows.ndim < n_dims or not rows.numel():
        shape = "..., d" if n_dims == 1 else "..., T, d"
        raise InvalidParameterError(
            f"{name} has shape {tuple(rows.shape)}, must have shape ({shape}), none of it empty."
        )
    values = rows.detach().cpu()
    # Products of what is larger overflow: 1e231 in float64, 1e28 in float32.
    most = torch.finfo(rows.dtype).max ** 0.75
    checks.require((values.abs() <= most).numpy(), values.numpy(), name, f"finite and at most {most:.0e} in size")
    return rows


def as_semidefinite(value: Any, name: str) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Positive semidefinite matrices (..., d, d) with eigenvalues (..., d) and axes; errors contain ``name``."""
    matrix = as_tensor(value, name)
    plain = matrix.detach()
    checks.semidefinite(plain.cpu().numpy(), name)
    eigenvalues, axes = torch.linalg.eigh(symmetrize(plain))
    return matrix, (eigenvalues, axes)


def as_damping_ratio(value: Any) -> float | Literal["paper"]:
    """Checked damping ratio, at least 0, or "paper", the damping K^1/2 for every mass."""
    if isinstance(value, str) and value == "paper":
        return "paper"
    # Above a million the damping overflows beside gains and masses that are still numbers.
    remedy = "1 is critical, 'paper' is the root of the stiffness"
    return checks.number(value, "damping_ratio", least=0.0, most=1e6, remedy=remedy)


def as_mass(mass: Any) -> float | Tensor:
    """Virtual mass in kg: a positive number, or a tensor of symmetric positive definite matrices (..., d, d)."""
    value = mass if isinstance(mass, Real) else as_tensor(mass, "mass")
    if isinstance(value, Tensor) and value.ndim:
        checks.semidefinite(value.detach().cpu().numpy(), "mass", definite=True)
        return value
    number = value.item() if isinstance(value, Tensor) else value
    checks.number(number, "mass", above=0.0, unit="kg")
    checked = checks.number(number, "mass", least=_LIGHTEST, most=1.0 / _LIGHTEST, unit="kg")
    return value if isinstance(value, Tensor) else checked


def masses_like(mass: float | Tensor, like: Tensor, name: str) -> Tensor:
    """Mass as matrices (..., d, d) that broadcast with ``like``, called ``name``, with its dtype and device."""
    matrix = torch.as_tensor(mass, dtype=like.dtype, device=like.device)
    matrix = matrix if matrix.ndim else matrix * torch.eye(like.shape[-1]).to(like)
    sizes = zip(reversed(matrix.shape), reversed(like.shape), strict=False)
    if matrix.shape[-1] != like.shape[-1] or not all(1 in pair or pair[0] == pair[1] for pair in sizes):
        raise InvalidParameterError(
            f"mass has shape {tuple(matrix.shape)}, but {name} has shape {tuple(like.shape)}: give a number, or "
            "matrices (d, d), one or one for each tick, which a function of time gives at any rate."
        )
    return matrix


def mass_rows(mass: Any, own: Any, times: Any, like: Tensor) -> Tensor:
    """Inertia (d, d) or (..., T, d, d), as gains ``like``; a function is of ``times``, None a schedule's or 1 kg."""
    given = mass(times) if callable(mass) else own if mass is None else mass
    rows = masses_like(as_mass(1.0 if given is None else given), like, "stiffness")
    if rows.ndim == 2:
        return rows
    # Equal rows are one mass, unless they require gradients, which are then per row.
    is_one = rows.ndim == 3 and not rows.requires_grad and bool((rows == rows[0]).all())
    return rows[0] if is_one else rows.expand(*rows.shape[:-3], *like.shape[-3:])


def _root(eigenvalue: Tensor) -> Tensor:
    # The slope of the root is infinite at zero; a free axis has no damping and gets no gradient.
    tiny = torch.finfo(eigenvalue.dtype).tiny
    return torch.where(eigenvalue > tiny, eigenvalue.clamp_min(tiny).sqrt(), 0.0)
