"""Pauses in recordings, in which nothing moves."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd.checks import Floats

# Within a pause all outputs stay within this share of their extent in the recording: a hand that waits trembles.
_STILL = 0.02


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
