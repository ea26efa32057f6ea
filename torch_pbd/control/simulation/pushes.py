"""Pushes drawn at random."""

import numpy as np
from numpy.typing import NDArray

from torch_pbd.control.matrices import check_finite
from torch_pbd.control.schedule.schedule import Schedule

Floats = NDArray[np.float64]
_LARGEST = 1e100  # squares are numbers
Range = float | tuple[float, float]


def draw_pushes(
    draw: np.random.RandomState,
    shape: tuple[int, int],
    schedule: Schedule,
    peak: Range,
    duration: Range,
    onset: tuple[float, float] | None,
) -> tuple[Floats, Floats, Floats]:
    """Onsets, from the start of the schedule on and in order, durations (R,) and forces at the peak (R, d)."""
    lasting = _uniform(draw, "duration", duration, shape[0], "s")
    if (lasting <= 0.0).any() or lasting.max() > schedule.duration:
        raise ValueError(f"duration is {duration!r} s, must be positive and at most {schedule.duration:g} s.")
    share = draw.uniform(size=shape[0])
    if onset is None:
        begin = share * (schedule.duration - lasting)
    else:
        first, last = _pair("onset", onset)
        begin = first + share * (last - first) - schedule.time[0]
        if begin.min() < 0.0 or begin.max() > schedule.duration:
            raise ValueError(f"onset is {onset!r} s, must lie in {schedule.time[0]:g} to {schedule.time[-1]:g} s.")
    direction = draw.standard_normal(shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    strength = _uniform(draw, "peak", peak, shape[0], "N")
    order = np.argsort(begin, kind="stable")  # rollouts of a chunk are pushed at about the same time
    return begin[order], lasting[order], (strength[:, np.newaxis] * direction)[order]


def _uniform(draw: np.random.RandomState, name: str, limits: Range, n: int, unit: str) -> Floats:
    low, high = _pair(name, limits if isinstance(limits, tuple) else (limits, limits))
    return np.asarray(draw.uniform(check_not_negative(name, low), high, size=n))


def _pair(name: str, limits: tuple[float, float]) -> tuple[float, float]:
    if not isinstance(limits, tuple | list) or len(limits) != 2:
        raise ValueError(f"{name} is {limits!r}, must be two numbers, the least and the largest.")
    for value in limits:
        check_finite(name, value)
        check_not_negative(name, abs(value))
    if limits[0] > limits[1]:
        raise ValueError(f"{name} is {limits!r}, must be the least and then the largest.")
    return limits


def check_not_negative(name: str, value: float) -> float:
    """Check that a parameter is a finite number of at least 0; returns it."""
    check_finite(name, value)
    if not 0.0 <= value <= _LARGEST:
        raise ValueError(f"{name} is {value:g}, must not be negative, and at most {_LARGEST:g}.")
    return value
