"""What the arguments of the real-time controller must be."""

import math
import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.control.realtime.steps import Vector

LARGEST = 1e100  # squares and sums of what is smaller do not overflow
Numbers = Sequence[float] | NDArray[np.float64]


def number(name: str, value: float, unit: str, *, zero: bool = False) -> float:
    """A finite number above 0, or from 0 on."""
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not (real and checks.is_finite(value) and value >= 0.0 and (value or zero)):
        least = "of at least 0" if zero else "above 0"
        raise ValueError(f"{name}={value!r} must be a finite number {least}, in {unit}.")
    return float(value)


def mass_of(schedule: object, mass: float | None) -> float:
    """Virtual mass, told where it is another than that for which the schedule was damped."""
    own = getattr(schedule, "mass", None)
    value = number("mass", (own or 1.0) if mass is None else mass, "kg, the same in all directions: no matrix")
    if not 1e-50 <= value <= 1e50:
        raise ValueError(f"mass={mass!r} must be a finite number from 1e-50 to 1e50 kg.")
    if own is not None and value != own:
        warnings.warn(
            f"mass is {mass}, but damping_ratio was met for mass={own:g} kg: give both the same.", stacklevel=3
        )
    return value


def limit(name: str, value: float | None, unit: str) -> float:
    """A number above 0; none at all is infinite."""
    return math.inf if value is None else number(name, value, f"{unit}, or None")


def whole(name: str, value: int, least: int) -> int:
    """A number of ticks."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name}={value!r} must be an integer of at least {least}: a number of ticks.")
    return int(value)


def moment(name: str, value: float) -> float:
    """A finite time in s."""
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not (real and checks.is_finite(value)):
        raise ValueError(f"{name}={value!r} must be a finite time in s.")
    return float(value)


def vector(name: str, values: Numbers, d: int) -> Vector:
    """Finite floats, d of them, whose squares are finite too."""
    try:
        vector = tuple(map(float, values))
    except (TypeError, ValueError, OverflowError):
        vector = ()
    if len(vector) != d or not all(abs(value) <= LARGEST for value in vector):
        raise ValueError(
            f"{name}={values!r} must be {d} finite numbers, one for each axis of the schedule, of at most {LARGEST:g}."
        )
    return vector
