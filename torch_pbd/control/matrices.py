"""Checks of the matrices and numbers that control is given."""

import math
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor

# An eigenvalue this far below zero, relative to the largest, is no rounding error.
_NEGATIVE = 1e-9
_LIGHTEST = 1e-50  # kg, of which products with gains are numbers
_MANY = 2**53


def check_mass(mass: Any) -> None:
    """Check that a mass is a positive number, or symmetric positive definite matrices (..., d, d), in kg.

    Raises
    ------
    ValueError
        If it is not.
    """
    if not isinstance(mass, Tensor) or mass.ndim == 0:
        check_positive("mass", float(mass) if isinstance(mass, Tensor) else mass, "kg")
        if not _LIGHTEST <= float(mass) <= 1.0 / _LIGHTEST:
            raise ValueError(f"mass is {float(mass):g} kg, must be from {_LIGHTEST:g} to {1.0 / _LIGHTEST:g} kg.")
        return
    mass = as_semidefinite(mass, "mass")
    if not len(mass):
        raise ValueError(f"mass has shape {tuple(mass.shape)}: give one matrix at least.")
    smallest = float(torch.linalg.eigvalsh(mass.detach()).min())
    if smallest < _LIGHTEST:
        raise ValueError(f"mass must be positive definite; its smallest eigenvalue is {smallest:.3g} kg.")


def as_mass(mass: Any) -> float | Tensor:
    """A mass that :func:`check_mass` passes: a number, or a tensor that an array is copied to in float64."""
    if isinstance(mass, Real):
        check_mass(mass)
        return float(mass)
    value = as_tensor(mass, "mass")
    check_mass(value)
    return value


def as_tensor(value: Any, name: str) -> Tensor:
    """Tensor of real floats; arrays and integers are copied in float64.

    Raises
    ------
    ValueError
        If it is not; the message has ``name``.
    """
    if not isinstance(value, Tensor):
        return _copied(value, name)
    if value.layout != torch.strided or value.is_meta:
        raise ValueError(f"{name} is a sparse or an empty (meta) tensor: give a dense one.")
    if value.is_complex():
        raise ValueError(f"{name} is complex, must be real numbers.")
    if not value.is_floating_point():
        return value.double()
    if value.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{name} is {value.dtype}, too coarse for a control law: give float32 or float64.")
    return value


def _copied(value: Any, name: str) -> Tensor:
    mask = getattr(value, "mask", None)
    if mask is not None and not callable(mask) and bool(mask.any()):
        raise ValueError(f"{name} has masked entries: fill them in first.")
    kind = getattr(getattr(value, "dtype", None), "kind", "f")
    if kind not in "biuf":
        raise ValueError(f"{name} has dtype {value.dtype}, must be real numbers.")
    try:
        # Torch takes no negative strides, which a copy has not.
        return torch.tensor(value.copy() if hasattr(value, "strides") else value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise ValueError(f"{name} is {value!r}, must be numbers of one shape ({error}).") from error


def as_rows(value: Any, name: str, n_dims: int) -> Tensor:
    """Tensor of finite real floats with at least ``n_dims`` dimensions, none of them empty."""
    rows = as_tensor(value, name)
    if rows.ndim < n_dims or not rows.numel():
        shape = ", ".join(["...", "T", "d"][-n_dims - 1 :] if n_dims > 1 else ["...", "d"])
        raise ValueError(f"{name} has shape {tuple(rows.shape)}, must have shape ({shape}), none of it empty.")
    sound = rows.detach().abs() <= torch.finfo(rows.dtype).max ** 0.75
    if not bool(sound.all()):
        index = tuple((~sound).nonzero()[0].tolist())
        raise ValueError(f"{name} has a value that is not finite, or whose products are not, at index {index}.")
    return rows


def as_semidefinite(value: Any, name: str) -> Tensor:
    """Tensor (..., d, d) that is finite, symmetric and positive semidefinite; arrays are copied in float64.

    Raises
    ------
    ValueError
        If it is not; the message has ``name`` and the index.
    """
    matrix = as_tensor(value, name)
    if matrix.ndim < 2 or matrix.shape[-1] != matrix.shape[-2] or not matrix.shape[-1]:
        raise ValueError(f"{name} has shape {tuple(matrix.shape)}, must have shape (..., d, d).")
    flat = matrix.detach().reshape(-1, *matrix.shape[-2:])
    finite = torch.isfinite(flat).all(-1).all(-1)
    if not bool(finite.all()):
        raise ValueError(f"{name} has an entry that is not finite, at index {int((~finite).nonzero()[0])}.")
    scale = flat.abs().amax((-2, -1)) if len(flat) else flat.new_zeros(0)
    if bool((scale > torch.finfo(matrix.dtype).max ** 0.75).any()):
        raise ValueError(f"{name} has an entry of {float(scale.max()):.3g}, whose products overflow: use other units.")
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
    if isinstance(value, bool) or not isinstance(value, Real) or not is_finite(value):
        raise ValueError(f"{name} is {value!r}, must be a finite number.")


def check_device(device: Any) -> None:
    """Check that tensors can be put on a device; None is the CPU."""
    try:
        torch.empty(0, device=device)
    except (AssertionError, OverflowError, RuntimeError, TypeError, ValueError) as error:
        problem = str(error).partition("\n")[0].rstrip(".")
        raise ValueError(f"device is {device!r}, which cannot be used here: {problem}. None is the CPU.") from error


def is_finite(value: Any) -> bool:
    """Whether a real number is one that a float can hold."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def check_flag(name: str, value: Any) -> None:
    """Check that a parameter is True or False; a text would count as True."""
    if not isinstance(value, bool) and str(getattr(value, "dtype", "")) != "bool":
        raise ValueError(f"{name} is {value!r}, must be True or False.")


def check_positive(name: str, value: Any, unit: str = "") -> None:
    """Check that a parameter is a positive finite number."""
    check_finite(name, value)
    if value <= 0.0:
        raise ValueError(f"{name} is {value:g}{unit and ' ' + unit}, must be positive.")


def check_count(name: str, value: Any, least: int) -> None:
    """Check that a parameter is an integer not below ``least``."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not least <= int(value) < _MANY:
        raise ValueError(f"{name} is {value!r}, must be an integer of at least {least}.")


def broadcasts(value: Tensor, other: Tensor) -> bool:
    """Whether shapes broadcast, of the same last size."""
    sizes = zip(reversed(value.shape), reversed(other.shape), strict=False)
    return value.shape[-1] == other.shape[-1] and all(1 in pair or pair[0] == pair[1] for pair in sizes)


def run_shape(forcing: Tensor, others: dict[str, Tensor]) -> torch.Size:
    """Shape (..., T, d) of a rollout: T and d are those of the forcing, the batch is that of all."""
    shape = forcing.shape
    n_ticks, d = shape[-2:]
    for name, value in others.items():
        if value.shape[-1] != d or value.shape[-2] not in (1, n_ticks):
            raise ValueError(
                f"{name} is of {value.shape[-1]} outputs and {value.shape[-2]} ticks, must be of {d} outputs, as "
                f"forcing is, and one or {n_ticks} ticks."
            )
        shape = torch.broadcast_shapes(shape, value.shape)
    return shape
