"""Tensors of what control is given: motions, gains, masses."""

from numbers import Real
from typing import Any, Literal

import torch
from torch import Tensor

from torch_pbd import checks
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.linalg import symmetrize

# kg. Gains are at most 1e100, and float64 ends at 1e308: squares of gain over mass must be numbers still.
_LIGHTEST = 1e-50


def as_tensor(value: Any, name: str) -> Tensor:
    """Tensor of real floats; what is no tensor is copied in float64.

    Raises
    ------
    ValueError, TypeError
        If it is not; the message has ``name``.
    """
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
        shape = ", ".join(["...", "T", "d"][-n_dims - 1 :] if n_dims > 1 else ["...", "d"])
        raise InvalidParameterError(
            f"{name} has shape {tuple(rows.shape)}, must have shape ({shape}), none of it empty."
        )
    values = rows.detach().cpu()
    # Products of what is larger overflow: 1e231 in float64, 1e28 in float32.
    most = torch.finfo(rows.dtype).max ** 0.75
    checks.require((values.abs() <= most).numpy(), values.numpy(), name, f"finite and at most {most:.0e} in size")
    return rows


def as_mass(mass: Any) -> float | Tensor:
    """Virtual mass in kg: a positive number, or a tensor of symmetric positive definite matrices (..., d, d)."""
    value = mass if isinstance(mass, Real) else as_tensor(mass, "mass")
    if isinstance(value, Tensor) and value.ndim:
        checks.semidefinite(value.detach().cpu().numpy(), "mass", definite=True)
        return value
    number = value.item() if isinstance(value, Tensor) else value
    checked = checks.number(number, "mass", least=_LIGHTEST, most=1.0 / _LIGHTEST, unit="kg")
    return value if isinstance(value, Tensor) else checked


def as_damping_ratio(value: Any) -> float | Literal["paper"]:
    """Damping ratio, at least 0; or "paper", the damping K^1/2 whatever the mass."""
    if isinstance(value, str) and value == "paper":
        return "paper"
    # Above a million the damping overflows beside gains and masses that are still numbers.
    remedy = "1 is critical, 'paper' is the root of the stiffness"
    return checks.number(value, "damping_ratio", least=0.0, most=1e6, remedy=remedy)


def mass_matrix(mass: float | Tensor, like: Tensor) -> Tensor:
    """Virtual mass as a matrix (d, d), of the size, dtype and device of gains (..., d, d)."""
    identity = torch.eye(like.shape[-1]).to(like)
    matrix = torch.as_tensor(mass, dtype=like.dtype, device=like.device)
    matrix = matrix if matrix.ndim else matrix * identity
    if matrix.shape != identity.shape:
        expected = tuple(identity.shape)
        raise InvalidParameterError(f"mass has shape {tuple(matrix.shape)}, must be a number or have shape {expected}.")
    return matrix


def mass_rows(mass: float | Tensor, like: Tensor) -> Tensor:
    """Inertia as a matrix (d, d), or as one for each tick, that broadcast with gains (..., T, d, d)."""
    if not isinstance(mass, Tensor) or mass.ndim < 3:
        return mass_matrix(mass, like)
    rows = mass.to(like)
    if rows.shape[-3:] != like.shape[-3:] or not _fit(rows, like):
        one, each = tuple(like.shape[-2:]), ", ".join(map(str, like.shape[-3:]))
        raise InvalidParameterError(
            f"mass has shape {tuple(rows.shape)}, must be a number or have shape {one} or (..., {each}), one for each "
            "tick: a function of time fits ticks of any rate."
        )
    # Rows that are all the same are one mass; those that want gradients get them row by row.
    is_one = rows.ndim == 3 and not rows.requires_grad and bool((rows == rows[0]).all())
    return rows[0] if is_one else rows


def check_fits(mass: Tensor, like: Tensor, name: str) -> None:
    """Refuse masses (..., d, d) that do not broadcast with the matrices (..., d, d) of this name."""
    if not _fit(mass, like):
        raise InvalidParameterError(
            f"mass has shape {tuple(mass.shape)}, but {name} has shape {tuple(like.shape)}: give a number, or "
            "matrices (d, d) of as many axes."
        )


def _fit(mass: Tensor, like: Tensor) -> bool:
    sizes = zip(reversed(mass.shape), reversed(like.shape), strict=False)
    return mass.shape[-1] == like.shape[-1] and all(1 in pair or pair[0] == pair[1] for pair in sizes)


def as_semidefinite(value: Any, name: str) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Positive semidefinite matrices (..., d, d), and the eigenvalues (..., d) and axes that show that they are.

    Raises
    ------
    ValueError
        If a matrix is not finite, symmetric and positive semidefinite; the message has ``name`` and the index.
    """
    matrix = as_tensor(value, name)
    plain = matrix.detach()
    checks.semidefinite(plain.cpu().numpy(), name)
    eigenvalues, axes = torch.linalg.eigh(symmetrize(plain))
    return matrix, (eigenvalues, axes)
