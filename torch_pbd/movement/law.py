"""Base of the models of whole movements: recordings, observations of a movement, and its joint law given them."""

import copy
import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.alignment import TIMING_REMOVED
from torch_pbd.data.demonstrations import Demonstration, Demonstrations
from torch_pbd.estimators.validation import check_groups, checked_queries, checked_rows
from torch_pbd.files.memory import require_much
from torch_pbd.movement.joint import Conditioned, JointNormal

_DECIMALS = 10  # decimals kept of a time over the range of the fit's times, so that 0.1 + 0.2 and 0.3 are equal
_MOST_KEPT = 2048  # most times whose law is cached: a chunk of predictions, and what is known beside it


class Known(NamedTuple):
    """Observations of a movement: times (m,), values (m, d) along axes, NaN where not given, and noise (m, d)."""

    time: Floats
    value: Floats
    noise: Floats

    def and_also(self, *other: Floats) -> "Known":
        """These observations and others after them."""
        pairs = zip(self, other, strict=True)
        return Known(*(np.concatenate([own.reshape(-1, *new.shape[1:]), new]) for own, new in pairs))

    def joined(self, rounded: Floats) -> "Known":
        """Those at one of the ``rounded`` times in one row, unless an entry is given twice.

        A step whose outputs came one by one is then conditioned on as a whole.
        """
        _, first, place = np.unique(rounded, return_index=True, return_inverse=True)
        rows, outputs = (~np.isnan(self.value)).nonzero()
        if len(first) == len(rounded) or len(np.unique(np.stack([place[rows], outputs]), axis=1).T) < len(rows):
            return self
        value, noise = np.full((len(first), self.value.shape[1]), np.nan), np.zeros((len(first), self.value.shape[1]))
        value[place[rows], outputs], noise[place[rows], outputs] = self.value[rows, outputs], self.noise[rows, outputs]
        return Known(self.time[first], value, noise)

    @property
    def exact(self) -> NDArray[np.bool_]:
        """Entries (m, d) that are given without noise."""
        return ~np.isnan(self.value) & (self.noise == 0.0)


class MovementLaw(BaseEstimator, ABC):
    """Law of a movement at any times, given observations of it."""

    df_: float = math.inf  # degrees of freedom; infinite for a normal law
    n_outputs_: int
    _range: tuple[float, float]  # first of the times of the fit, and their range
    _known: Known = Known(np.empty(0), np.empty((0, 1)), np.empty((0, 1)))
    _axes: Floats | None = None  # axes of the coordinates of observations; None are the outputs
    _kept: dict[str, Any]  # cached last times and their law, shared by conditioned copies
    _y_is_1d: bool

    @abstractmethod
    def _prior(self, time: Floats) -> JointNormal:
        """Joint law at times (n,), all different, before anything is known of the movement."""

    @abstractmethod
    def _arrays(self) -> dict[str, Floats]:
        """Arrays of the law for model files, without the regressor's."""

    @abstractmethod
    def _restore(self, arrays: dict[str, Floats]) -> None:
        """Restore the law from finite arrays of a model file; wrong shapes raise a ValueError."""

    def _scaled(self, time: Floats) -> Floats:
        """Times in ranges of those of the fit."""
        return np.asarray((time - self._range[0]) / self._range[1])

    def _rounded(self, time: Floats) -> Floats:
        """Times rounded so that those that count as one are equal."""
        return np.round(self._scaled(time), _DECIMALS)

    @property
    def _observed_axes(self) -> Floats:
        return np.eye(self.n_outputs_) if self._axes is None else self._axes

    def observed_along(self, axes: Floats | None) -> Self:
        """Copy whose :meth:`condition` takes rows and noise of ``axes @ y``, axes (d, d); None are the outputs."""
        copied = self._copy()
        copied._axes = axes
        return copied

    def condition(self, X: ArrayLike, y: ArrayLike, *, noise_scale: ArrayLike = 0.0) -> Self:
        """Fitted copy, conditioned on passing y at X: a start, a goal, via points or the part observed so far.

        The normal formulas apply to the joint covariance; the degrees of freedom stay. A copy can be conditioned again
        and pickled, but not saved in a model file.

        Parameters
        ----------
        X : array-like of shape (n_points, 1)
            Times or phases, as in the fit.
        y : array-like of shape (n_points, n_outputs), or (n_points,) if y was 1-D
            Observed outputs, NaN where one is not given.
        noise_scale : float or array-like of shape (n_outputs,), default=0.0
            Standard deviation of the error of y, in its units. At 0 the movement passes y exactly.

        Raises
        ------
        ValueError
            If a time without noise is given twice or was known before.
        """
        time = self._times(X)
        value = checks.real_floats(y, "y")
        value = value[:, np.newaxis] if value.ndim == 1 and self._y_is_1d else value
        if value.shape != (len(time), self.n_outputs_) or np.isinf(value).any():
            raise ValueError(
                f"y has shape {np.shape(y)}, must have a finite row of {self.n_outputs_} outputs, NaN where not given, "
                f"for each of the {len(time)} rows of X."
            )
        scale = checks.real_floats(noise_scale, "noise_scale")
        if scale.shape not in ((), (self.n_outputs_,)):
            must = f"must be one number or have shape ({self.n_outputs_},): give one for each output"
            raise ValueError(f"noise_scale has shape {scale.shape}, {must}.")
        checks.require((scale >= 0.0) & np.isfinite(scale), scale, "noise_scale", "a finite number of at least 0")
        some = ~np.isnan(value).all(axis=1)
        copied = self._copy()
        known = self._known.and_also(time[some], value[some], np.broadcast_to(scale, value[some].shape))
        copied._known = known = known.joined(self._rounded(known.time))
        rows, outputs = known.exact.nonzero()
        if len(set(zip(self._rounded(known.time)[rows], outputs, strict=True))) < len(rows):
            raise ValueError("X has a time that is given twice, or is known already, without noise: leave it out.")
        n_single = int((~np.isnan(known.value) & ~known.exact.all(axis=1, keepdims=True)).sum())
        what = f"conditioning on {n_single} entries with noise or beside NaN"
        require_much(12 * 8.0 * n_single**2, what=what, remedy="Give fewer times, or whole rows with noise_scale=0.")
        return copied

    def _times(self, X: ArrayLike) -> Floats:
        """Times (n,) of query rows."""
        time = np.ascontiguousarray(checked_queries(self, X)[:, 0])
        # One lost sample turns a model over time into one over phase, and nothing else would say so.
        if self.input_ == "phase" and ((time < -checks.ROUNDING) | (time > 1.0 + checks.ROUNDING)).any():
            checks.warn(
                f"X goes from {time.min():.6g} to {time.max():.6g}, but the demonstrations' times differ, so X is a "
                "phase from 0, the start, to 1, the end: divide the time since the start by the movement's duration."
            )
        return time

    def _union(self, time: Floats, known: Floats) -> tuple[Floats, NDArray[np.intp], NDArray[np.intp]]:
        """Distinct times of queries and observations, and the indices of both among them."""
        both = np.concatenate([time, known])
        _, first, index = np.unique(self._rounded(both), return_index=True, return_inverse=True)
        return both[first], index[: len(time)], index[len(time) :]

    def _conditioned(self, time: Floats) -> tuple[Conditioned, Tensor]:
        """Law at query and observation times given the observations, and the indices of ``time`` among them."""
        union, rows, places = self._union(time, self._known.time)
        return self._given(self._prior_at(union), places), torch.from_numpy(rows)

    def _given(self, law: JointNormal, places: NDArray[np.intp]) -> Conditioned:
        """Law given the observations, which are at these indices among its steps."""
        value, noise = (torch.from_numpy(part.reshape(-1, self.n_outputs_)) for part in self._known[1:])
        return Conditioned(law, torch.from_numpy(places), value, noise, torch.from_numpy(self._observed_axes))

    def _prior_at(self, time: Floats) -> JointNormal:
        """Joint law at distinct times; the last one is cached."""
        if len(time) > _MOST_KEPT:
            return self._prior(time)
        kept = self.__dict__.setdefault("_kept", {})
        last = kept.get("last")  # times and law in one, as copies in other threads share it
        if last is None or not np.array_equal(last[0], time):
            last = kept["last"] = time, self._prior(time)
        law: JointNormal = last[1]
        return law

    def _copy(self) -> Self:
        """Copy that shares the unconditioned law and its cache."""
        copied = copy.copy(self)
        copied._kept = self.__dict__.setdefault("_kept", {})
        return copied

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in super().__getstate__().items() if name != "_kept"}


def as_recordings(model: Any, X: Any, y: Any, groups: Any, *, is_fit: bool) -> list[Demonstration]:
    """Demonstrations from the arguments of a model of movements, each in the order of its times.

    A fit sets the kind of its input, ``input_``, and the number of outputs, ``n_outputs_``.
    """
    if isinstance(X, Demonstrations):
        if y is not None or groups is not None:
            raise ValueError("y and groups must be None beside Demonstrations, which have both.")
        X, y, groups = _stacked(model, X, is_fit=is_fit)
    elif is_fit:
        model.input_ = "array"
        if groups is None:
            raise ValueError("groups is None, must be the demonstration of each row of X: whole movements are learned.")
    else:
        model._times(X)
    if y is None:
        raise ValueError("y is None, must be the positions (n_samples, n_outputs) at the rows of X.")
    inputs, targets = checked_rows(model, X, y, reset=is_fit, ensure_min_samples=1)
    if inputs.shape[1] != 1:
        raise ValueError(
            f"X has {inputs.shape[1]} columns, must have one, the time or phase: a movement runs along one input."
        )
    if is_fit:
        model._y_is_1d, model.n_outputs_ = targets.ndim == 1, targets[0].size
    numbers = np.zeros(len(inputs), dtype=np.intp) if groups is None else check_groups(groups, len(inputs))
    order = np.lexsort([inputs[:, 0], numbers])
    parts = np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1)
    return [Demonstration(inputs[rows, 0], targets[rows].reshape(len(rows), -1)) for rows in parts]


def _stacked(model: Any, shown: Demonstrations, *, is_fit: bool) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Rows over the kind of input of the fit, which a fit sets."""
    timed = getattr(model, "timing", "none") != "none"
    if is_fit:
        model.input_ = "time" if timed or shown.is_aligned else "phase"
        if shown.alignment == "dtw":
            checks.warn(TIMING_REMOVED)
    elif model.input_ == "array" and not timed:
        raise ValueError("X is Demonstrations, but the fit was of arrays: give X, y, groups as they were made for it.")
    X, y, groups = shown.stack(input="phase" if timed else model.input_)
    if timed:  # demonstrations of different durations would otherwise be stacked over phase
        X = np.concatenate(shown.from_start().times)[:, np.newaxis]
    return X, y, groups


def as_rows(recordings: list[Demonstration]) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Rows of recordings for a regressor: X (n, 1), y (n, d) and their numbers (n,)."""
    times, positions = zip(*recordings, strict=True)
    numbers = np.repeat(np.arange(len(recordings)), [len(time) for time in times])
    return np.concatenate(times)[:, np.newaxis], np.concatenate(positions), numbers


def semidefinite_root(covariance: Floats) -> Floats:
    """Roots, times their transposes the covariances (..., d, d), of which some directions may have no variance."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(values.clip(0.0))[..., np.newaxis, :])


def check_arrays(arrays: dict[str, Floats], shapes: dict[str, tuple[int | str, ...]]) -> None:
    """Check that the arrays of a model file have these names and shapes."""
    if set(arrays) != set(shapes):
        raise ValueError(f"its arrays are {', '.join(arrays)}, must be {', '.join(shapes)}")
    for name, shape in shapes.items():
        checks.array(arrays[name], name, shape)


def check_regressor(regressor: Any, method: str) -> None:
    """Check that a parameter is None or an estimator that has a method."""
    if regressor is not None and (isinstance(regressor, type) or not hasattr(regressor, method)):
        raise checks.refusal(regressor, "regressor", "a covariance regressor or None")
