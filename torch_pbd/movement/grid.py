"""Grids on which recordings are compared."""

import numpy as np

from torch_pbd.estimators.validation import Floats
from torch_pbd.movement.base import Recording

# Steps on which the correlation is learned: the nuggets' iterations are cubic in them, and movements are smooth.
_MOST_STEPS = 200
_GAP = 2.0  # sample spacings of a recording: a step farther than that from its samples was not seen in it


def n_grid_steps(recordings: list[Recording]) -> int:
    """Steps of the grid on which recordings are compared: their median number of samples, at most 200."""
    return max(2, min(_MOST_STEPS, round(float(np.median([len(recording.time) for recording in recordings])))))


def sampled(recording: Recording, grid: Floats) -> Floats:
    """Positions of a recording at the steps of a grid, linear between samples; NaN where it has no sample near."""
    time, position = recording
    columns = [np.interp(grid, time, column) for column in position.T]
    right = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
    nearest = np.minimum(np.abs(grid - time[right - 1]), np.abs(time[right] - grid))
    seen = nearest <= _GAP * np.median(np.diff(time))
    return np.where(seen[:, np.newaxis], np.stack(columns, axis=1), np.nan)
