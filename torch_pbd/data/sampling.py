"""Samples of a recording in time: how far apart they are, where they lack or rest, and the smooth curve they show."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_smoothing_spline

from torch_pbd.checks import Floats

# A movement is known up to 2.5 spacings from a sample, as in a dropout of three whose neighbours jitter, and no longer
# at five. Of a finer sampling five count as a 40th of the movement.
KNOWN, LOST = 2.5, 5.0
_FINEST = 200
# Within a pause all outputs stay within this share of their extent in the recording: a hand that waits trembles.
_STILL = 0.02
LEAST_SAMPLES = 5
"""Fewest samples of which there is a smoothing spline."""


def spacing_of(time: Floats) -> float:
    """Distance of neighbouring samples: the median of those that a 400th of the recording tells apart.

    Of recordings finer than 200 samples it is a 200th: their shortest hole is then a matter of the movement.
    """
    lasting = time[-1] - time[0]
    _, first = np.unique(np.floor(2 * _FINEST * ((time - time[0]) / lasting)), return_index=True)
    return max(float(np.median(np.diff(time[first]))), lasting / _FINEST)


def holes_of(time: Floats) -> NDArray[np.intp]:
    """Indices (m,) of the samples before a hole: 7.5 spacings or more, whose middle is unknown."""
    return np.flatnonzero(np.diff(time) > (KNOWN + LOST) * spacing_of(time))


def smoothing_spline(time: Floats, position: Floats, cutoff: float) -> BSpline:
    """Cubic smoothing spline of a recording that halves amplitudes at ``cutoff``, in cycles per unit of its time.

    At even sampling it is a Butterworth filter of second order run forward and backward; it takes the times as they
    are, even or not.
    """
    # Weights by the spacing make the sum an integral: lam = 1 / w^4 then halves the amplitude at w. In units of
    # the mean spacing and of each output's spread, which keeps the spline's equations well conditioned. A sample
    # beside a hole stands for no more time than others: it would count as free of noise.
    between = np.diff(time)
    between[holes_of(time)] = spacing_of(time)
    spacing = np.gradient(np.r_[0.0, np.cumsum(between)])
    unit = spacing.mean()
    offset = position.mean(axis=0)
    spread = np.ptp(position, axis=0)
    scale = np.where(spread > 0.0, spread, 1.0)
    weight = 1.0 / (2.0 * np.pi * cutoff * unit) ** 4
    smoothed = make_smoothing_spline(time / unit, (position - offset) / scale, spacing / unit, weight)
    return BSpline(smoothed.t * unit, smoothed.c * scale + offset, smoothed.k)


def extents(position: Floats, demonstrations: Any) -> Floats:
    """Extent (d,) of each output in a recording; of a rotation the largest of the three for all of them.

    A tool that turns about one axis trembles about the others, and all axes are as good.
    """
    extent = np.ptp(position, axis=0)
    if demonstrations.rotation_reference is not None:
        extent[-3:] = extent[-3:].max()
    return extent


def still(time: Floats, position: Floats, extent: Floats, pause: float) -> NDArray[np.bool_]:
    """Samples (T,) in a stretch of at least ``pause`` in which no output leaves 2 % of its extent (d,)."""
    result = np.zeros(len(time), dtype=bool)
    if not extent.any() or time[-1] - time[0] < pause:
        return result
    # Evenly spaced, as windows are of samples; ten of them in a pause.
    n = int(min(max(np.ceil(10.0 * (time[-1] - time[0]) / pause), len(time)), 100_000))
    grid = np.linspace(time[0], time[-1], n)
    width = max(2, int(np.ceil(pause / (grid[1] - grid[0]))) + 1)
    if width > n:
        return result
    quiet = np.ones(n - width + 1, dtype=bool)
    for values, whole in zip(position.T, extent, strict=True):
        windows = np.lib.stride_tricks.sliding_window_view(np.interp(grid, time, values), width)
        quiet &= np.ptp(windows, axis=1) <= _STILL * whole
    # A sample is still where any of the windows that hold it is quiet.
    marks = np.zeros(n + 1)
    np.add.at(marks, np.flatnonzero(quiet), 1.0)
    np.add.at(marks, np.flatnonzero(quiet) + width, -1.0)
    return np.interp(time, grid, np.cumsum(marks[:-1]) > 0.0) > 0.5
