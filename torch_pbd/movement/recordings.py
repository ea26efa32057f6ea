"""Arguments of models of movements: demonstrations to learn from, and observations of a movement."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data import Demonstrations
from torch_pbd.data.alignment import TIMING_REMOVED
from torch_pbd.estimators.demonstrations import check_groups
from torch_pbd.estimators.validation import checked_rows

# Steps on which the correlation is learned: the nuggets' iterations are cubic in them, and movements are smooth.
_MOST_STEPS = 200
_GAP = 2.0  # sample spacings of a recording: a step farther than that from its samples was not seen in it
_MOST_ENTRIES = 4096  # conditioned on one by one: a matrix of their size squared is factorized


class Recording(NamedTuple):
    """One demonstration: increasing times (T,) and positions (T, d)."""

    time: Floats
    position: Floats


class Known(NamedTuple):
    """Observations of a movement: times (m,), values (m, d), NaN where not given, and noise (m, d)."""

    time: Floats
    value: Floats
    noise: Floats

    def and_also(self, other: "Known") -> "Known":
        """These observations and others after them."""
        return Known(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def check(self, places: NDArray[np.intp]) -> None:
        """Refuse an entry that is known twice without noise, by the places of the times, or too many one by one."""
        exact = ~np.isnan(self.value) & (self.noise == 0.0)
        rows, outputs = np.nonzero(exact)
        if len(np.unique(places[rows] * self.value.shape[1] + outputs)) < len(rows):
            raise ValueError("X has a time that is given twice, or is known already, without noise: leave it out.")
        n_single = int((~np.isnan(self.value) & ~exact.all(axis=1, keepdims=True)).sum())
        if n_single > _MOST_ENTRIES:
            raise ValueError(
                f"y has {n_single} entries with noise or beside NaN, must be at most {_MOST_ENTRIES} with those known "
                "already: give fewer times, or whole rows with noise_scale=0."
            )

    def tensors(
        self, places: NDArray[np.intp], axes: Floats | None = None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Observations at steps of a law, as :class:`~torch_pbd.movement.joint.Conditioned` takes them."""
        steps, value, noise = map(torch.from_numpy, (places, self.value, self.noise))
        return steps, value, noise, None if axes is None else torch.from_numpy(axes)


def as_recordings(model: Any, X: Any, y: Any, groups: Any, *, is_fit: bool) -> list[Recording]:
    """Demonstrations of what was passed to a model of movements, each in the order of its times.

    A fit learns from them what its input is, and how many outputs there are: ``input_``, ``n_outputs_``.
    """
    if isinstance(X, Demonstrations):
        if y is not None or groups is not None:
            raise ValueError("y and groups must be None beside Demonstrations, which have both.")
        X, y, groups = _stacked(model, X, is_fit=is_fit)
    elif is_fit:
        model.input_ = "array"
        if groups is None:
            raise ValueError("groups is None, must be the demonstration of each row of X: whole movements are learned.")
    if y is None:
        raise ValueError("y is None, must be the positions (n_samples, n_outputs) at the rows of X.")
    inputs, targets = checked_rows(model, X, y, reset=is_fit, ensure_min_samples=1)
    if inputs.shape[1] != 1:
        raise ValueError(
            f"X has {inputs.shape[1]} columns, must have one, the time or phase: a movement runs along one input."
        )
    if is_fit:
        model._y_is_1d = targets.ndim == 1
        model.n_outputs_ = 1 if model._y_is_1d else targets.shape[1]
    targets = targets.reshape(len(inputs), -1)
    if targets.shape[1] != model.n_outputs_:
        raise ValueError(f"y has {targets.shape[1]} outputs, but the model was fitted with {model.n_outputs_}.")
    numbers = np.zeros(len(inputs), dtype=np.intp) if groups is None else check_groups(groups, len(inputs))
    recordings = []
    for number in range(numbers.max() + 1):
        rows = np.flatnonzero(numbers == number)
        rows = rows[np.argsort(inputs[rows, 0], kind="stable")]
        recordings.append(Recording(inputs[rows, 0], targets[rows]))
    return recordings


def _stacked(model: Any, X: Demonstrations, *, is_fit: bool) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Rows of demonstrations, over what ``input_`` of the model says."""
    timed = getattr(model, "timing", "none") != "none"
    if is_fit:
        model.input_ = "time" if timed or X.is_aligned else "phase"
        if X.alignment == "dtw":
            checks.warn(TIMING_REMOVED)
    if not timed:
        return X.stack(input=model.input_)
    _, y, groups = X.stack(input="phase")  # durations may have little in common
    return np.concatenate(X.from_start().times)[:, np.newaxis], y, groups


def as_rows(recordings: list[Recording]) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Rows of recordings for a regressor: X (n, 1), y (n, d) and their numbers (n,)."""
    X = np.concatenate([recording.time for recording in recordings])[:, np.newaxis]
    y = np.concatenate([recording.position for recording in recordings])
    return X, y, np.repeat(np.arange(len(recordings)), [len(recording.time) for recording in recordings])


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
