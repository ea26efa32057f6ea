"""Sampling of recordings: spacing, gaps, stillness and smoothing."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_smoothing_spline

from torch_pbd.checks import Floats
from torch_pbd.data.units import TIMES

# A movement is known up to 2.5 spacings from a sample, as in a dropout of three whose neighbours jitter, and no longer
# at five. Of a finer sampling five count as a 40th of the movement.
KNOWN, LOST = 2.5, 5.0
_FINEST = 200
# Shorter stillness, in s, is part of a movement. Within a pause all outputs stay within a share of their extent in the
# recording: a hand that waits trembles.
_PAUSE, _STILL = 0.5, 0.02
LEAST_SAMPLES = 5
"""Fewest samples of which there is a smoothing spline."""


def spacing_of(time: Floats) -> float:
    """Spacing of neighbouring samples: the median over samples at least a 400th of the recording apart.

    It is at least a 200th of the recording, so that the shortest gap of denser ones depends on the movement alone.
    """
    lasting = time[-1] - time[0]
    _, first = np.unique(np.floor(2 * _FINEST * ((time - time[0]) / lasting)), return_index=True)
    return max(float(np.median(np.diff(time[first]))), lasting / _FINEST)


def holes_of(time: Floats) -> NDArray[np.intp]:
    """Indices (m,) of the samples before a gap of 7.5 spacings or more, whose middle is unknown."""
    return np.flatnonzero(np.diff(time) > (KNOWN + LOST) * spacing_of(time))


def smoothing_spline(time: Floats, position: Floats, cutoff: float) -> BSpline:
    """Cubic smoothing spline of a recording that halves amplitudes at ``cutoff``, in cycles per unit of its time.

    At even sampling it is a second-order Butterworth filter run forward and backward; times may be uneven.
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
    """Extent (d,) of each output in a recording; the three of a rotation share the largest one.

    A tool that turns about one axis trembles about the others, and the choice of axes is arbitrary.
    """
    extent = np.ptp(position, axis=0)
    if demonstrations.rotation_reference is not None:
        extent[-3:] = extent[-3:].max()
    return extent


def still(time: Floats, position: Floats, demonstrations: Any) -> NDArray[np.bool_]:
    """Samples (T,) in a stretch of at least half a second in which no output leaves 2 % of its extent."""
    pause = _PAUSE / TIMES.get(demonstrations.time_unit, 1.0)
    # Resampled evenly, as windows count samples, with at least ten samples per pause.
    n = int(min(max(np.ceil(10.0 * (time[-1] - time[0]) / pause), len(time)), 100_000))
    grid = np.linspace(time[0], time[-1], n)
    width, extent = max(2, int(np.ceil(pause / (grid[1] - grid[0]))) + 1), extents(position, demonstrations)
    if width > n or not extent.any():
        return np.zeros(len(time), dtype=bool)
    quiet = np.ones(n - width + 1, dtype=bool)
    for values, whole in zip(position.T, extent, strict=True):
        windows = np.lib.stride_tricks.sliding_window_view(np.interp(grid, time, values), width)
        quiet &= np.ptp(windows, axis=1) <= _STILL * whole
    # A sample is still where any of the windows that hold it is quiet.
    return np.interp(time, grid, np.convolve(quiet, np.ones(width)) > 0.5) > 0.5
