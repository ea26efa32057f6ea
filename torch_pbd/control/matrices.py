"""Checks of the matrices and numbers that control is given."""

import math
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor

# An eigenvalue this far below zero, relative to the largest, is no rounding error.
_NEGATIVE = 1e-9


def check_mass(mass: Any) -> None:
    """Check that a mass is a positive number, or symmetric positive definite matrices (..., d, d), in kg.

    Raises
    ------
    ValueError
        If it is not.
    """
    if not isinstance(mass, Tensor) or mass.ndim == 0:
        check_positive("mass", float(mass), "kg")
        return
    as_semidefinite(mass, "mass")
    smallest = float(torch.linalg.eigvalsh(mass.detach()).min())
    if smallest <= 0.0:
        raise ValueError(f"mass must be positive definite; its smallest eigenvalue is {smallest:.3g} kg.")


def as_mass(mass: Any) -> float | Tensor:
    """A mass that :func:`check_mass` passes: a number, or a tensor that an array is copied to in float64."""
    if isinstance(mass, Real):
        check_mass(mass)
        return float(mass)
    value = mass if isinstance(mass, Tensor) else torch.tensor(mass, dtype=torch.float64)
    check_mass(value)
    return value


def as_semidefinite(value: Any, name: str) -> Tensor:
    """Tensor (..., d, d) that is finite, symmetric and positive semidefinite; arrays are copied in float64.

    Raises
    ------
    ValueError
        If it is not; the message has ``name`` and the index.
    """
    matrix = value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float64)
    if matrix.ndim < 2 or matrix.shape[-1] != matrix.shape[-2] or not matrix.shape[-1]:
        raise ValueError(f"{name} has shape {tuple(matrix.shape)}, must have shape (..., d, d).")
    flat = matrix.detach().reshape(-1, *matrix.shape[-2:])
    finite = torch.isfinite(flat).all(-1).all(-1)
    if not bool(finite.all()):
        raise ValueError(f"{name} has an entry that is not finite, at index {int((~finite).nonzero()[0])}.")
    scale = flat.abs().amax((-2, -1)) if len(flat) else flat.new_zeros(0)
    tolerance = max(_NEGATIVE, 100.0 * torch.finfo(matrix.dtype).eps)
    skewed = (flat - flat.mT).abs().amax((-2, -1)) > tolerance * scale if len(flat) else scale > 0
    if bool(skewed.any()):
        raise ValueError(f"{name} must be symmetric; at index {int(skewed.nonzero()[0])} it is not: symmetrize it.")
    smallest = torch.linalg.eigvalsh(flat)[:, 0] if len(flat) else scale
    indefinite = smallest < -tolerance * scale
    if bool(indefinite.any()):
        index = int(indefinite.nonzero()[0])
        raise ValueError(
            f"{name} must be positive semidefinite; at index {index} its smallest eigenvalue is "
            f"{float(smallest[index]):.3g}."
        )
    return matrix


def check_finite(name: str, value: Any, *, optional: bool = False) -> None:
    """Check that a parameter is a finite number, or None where that is allowed."""
    if optional and value is None:
        return
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise ValueError(f"{name} == {value!r}, must be a finite number.")


def check_positive(name: str, value: Any, unit: str = "") -> None:
    """Check that a parameter is a positive finite number."""
    check_finite(name, value)
    if value <= 0.0:
        raise ValueError(f"{name} == {value:g}{unit and ' ' + unit}, must be positive.")


def check_count(name: str, value: Any, least: int) -> None:
    """Check that a parameter is an integer not below ``least``."""
    if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < least:
        raise ValueError(f"{name} == {value!r}, must be an integer of at least {least}.")
