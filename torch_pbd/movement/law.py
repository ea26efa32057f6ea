"""Joint law of a movement, and what is known of it: the part that models of whole movements are made of."""

import copy
import math
from abc import ABC, abstractmethod
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.estimators.validation import checked_queries
from torch_pbd.movement.joint import Conditioned, JointNormal
from torch_pbd.movement.recordings import Known, Recording

_AT_ONCE = 1024  # rows whose marginals are found together, and whose law is kept
RESOLUTION = 10
"""Decimals of a time, in ranges of those of the fit: nearer ones are equal."""


class MovementLaw(BaseEstimator, ABC):
    """Law of a movement at any times, given what is known of it.

    A subclass has the joint law of a demonstration, :meth:`_prior`, and its degrees of freedom ``df_``, infinite for a
    normal law.
    """

    df_: float
    n_outputs_: int
    _range: tuple[float, float]
    """First of the times of the fit, and their range."""
    _known: Known | None = None
    _axes: Floats | None = None  # of the coordinates of observations; None: the outputs
    _kept: dict[str, tuple[Floats, JointNormal]]  # last times and their law, which conditioned copies share
    _y_is_1d: bool

    @abstractmethod
    def _prior(self, time: Floats) -> JointNormal:
        """Joint law at times (n,), all different, before anything is known of the movement."""

    def _between(self, time: Floats, other: Floats) -> Tensor:
        """Correlation between other times, that of :class:`JointNormal`: noise has none."""
        return torch.zeros(len(time), len(other), dtype=torch.float64)

    @abstractmethod
    def _arrays(self) -> dict[str, Floats]:
        """Arrays that the law consists of, beside the regressor, for model files."""

    @abstractmethod
    def _restore(self, arrays: dict[str, Floats]) -> None:
        """Take up such arrays, whose numbers are finite; a ValueError tells of shapes that do not fit."""

    def _scaled(self, time: Floats) -> Floats:
        """Times in ranges of those of the fit."""
        return np.asarray((time - self._range[0]) / self._range[1])

    def _restored(self, arrays: dict[str, Floats], shapes: dict[str, tuple[int | str, ...]]) -> dict[str, Floats]:
        """Arrays of a model file, which have these names and shapes and no others."""
        if set(arrays) != set(shapes):
            raise ValueError(f"its arrays are {', '.join(arrays)}, must be {', '.join(shapes)}")
        return {name: checks.array(arrays[name], name, shape) for name, shape in shapes.items()}

    def observed_along(self, axes: Floats | None) -> Self:
        """Copy whose :meth:`condition` takes rows, noise and NaN of ``axes @ y``, axes (d, d); None are the outputs."""
        copied = copy.copy(self)
        copied._axes, copied._kept = axes, self.__dict__.setdefault("_kept", {})
        return copied

    def condition(self, X: ArrayLike, y: ArrayLike, *, noise_scale: ArrayLike = 0.0) -> Self:
        """Fitted copy, of a movement that is at y at X: a start, a goal, a via point, the part seen so far.

        Normal formulas on the joint covariance; the degrees of freedom stay. A copy can be conditioned again.

        Parameters
        ----------
        X : array-like of shape (n_points, 1)
            Times or phases, as in the fit.
        y : array-like of shape (n_points, n_outputs), or (n_points,) if y was 1-D
            NaN where an output is not given.
        noise_scale : float or array-like of shape (n_outputs,), default=0.0
            Standard deviation of the error of y, in its units. Without noise the movement passes there exactly.

        Raises
        ------
        ValueError
            If a time is given twice, or is known already, without noise.
        """
        time = self._times(X)
        value = checks.real_floats(y, "y")
        value = value[:, np.newaxis] if value.ndim == 1 and self._y_is_1d else value
        if value.shape != (len(time), self.n_outputs_) or np.isinf(value).any():
            raise ValueError(
                f"y has shape {np.shape(y)}, must have a finite row of {self.n_outputs_} outputs, NaN where not given, "
                f"for each of the {len(time)} rows of X."
            )
        scale = np.broadcast_to(checks.real_floats(noise_scale, "noise_scale"), (self.n_outputs_,))
        checks.require((scale >= 0.0) & np.isfinite(scale), scale, "noise_scale", "a finite number of at least 0")
        # Rows of which nothing is given say nothing.
        given = ~np.isnan(value).all(axis=1)
        new = Known(time[given], value[given], np.broadcast_to(scale, value[given].shape))
        known = self._observations.and_also(new)
        copied = copy.copy(self)
        # The law before conditioning is the same for all copies.
        copied._known, copied._kept = known, self.__dict__.setdefault("_kept", {})
        known.check(self._union(known.time[:0], known)[2])
        return copied

    def _times(self, X: ArrayLike) -> Floats:
        """Times (n,) of rows to predict at."""
        return np.ascontiguousarray(checked_queries(self, X)[:, 0])

    def known_times(self) -> Floats:
        """Times (m,) at which something is known of the movement."""
        return self._observations.time

    @property
    def _observations(self) -> Known:
        """All that is known of the movement; no rows where nothing is."""
        nothing = np.empty((0, self.n_outputs_))
        return Known(np.empty(0), nothing, nothing) if self._known is None else self._known

    def _union(self, time: Floats, known: Known | None) -> tuple[Floats, NDArray[np.intp], NDArray[np.intp]]:
        """Distinct times of queries and of what is known, and the places of both among them."""
        both = np.concatenate([time, np.empty(0) if known is None else known.time])
        # In ranges of the fit, and rounded: 0.1 + 0.2 is the time 0.3.
        _, first, index = np.unique(np.round(self._scaled(both), RESOLUTION), return_index=True, return_inverse=True)
        return both[first], index[: len(time)], index[len(time) :]

    def _conditioned(self, time: Floats) -> tuple[Conditioned, Tensor]:
        """Law of all times that matter, given what is known, and the places of ``time`` among them."""
        union, rows, places = self._union(time, self._known)
        law, index = self._prior_with(union)
        return Conditioned(law, *self._observations.tensors(index[places], self._axes)), torch.from_numpy(index[rows])

    def _prior_with(self, time: Floats) -> tuple[JointNormal, NDArray[np.intp]]:
        """Joint law at increasing times, maybe at others too, and their places in it.

        Times that were asked for last take no work again.
        """
        kept = self.__dict__.setdefault("_kept", {})
        if kept and len(time):
            last, law = kept["last"]
            known, scaled = (np.round(self._scaled(each), RESOLUTION) for each in (last, time))
            place = np.searchsorted(known, scaled).clip(max=len(known) - 1)
            old = known[place] == scaled
            if 2 * old.sum() > len(old):
                if 2 * old.sum() < len(known):
                    last, law, place[old] = time[old], law.at(torch.from_numpy(place[old])), np.arange(old.sum())
                new = time[~old]
                if len(new):
                    place[~old] = len(last) + np.arange(len(new))
                    law = law.joined(self._prior(new), self._between(last, new))
                return law, place
        law = self._prior(time)
        if 0 < len(time) <= _AT_ONCE:
            kept["last"] = time, law
        return law, np.arange(len(time))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in super().__getstate__().items() if name != "_kept"}

    def _law(self, time: Floats) -> tuple[JointNormal, Tensor]:
        conditioned, rows = self._conditioned(time)
        return conditioned.law, rows

    def _marginals(self, time: Floats) -> tuple[Floats, Floats]:
        """Mean (n, d) and covariance (n, d, d) of each row."""
        parts = []
        for start in range(0, max(1, len(time)), _AT_ONCE):  # rows need no correlation with each other
            law, rows = self._law(time[start : start + _AT_ONCE])
            parts.append((law.mean[rows].numpy(), law.marginal()[rows].numpy()))
        mean, covariance = zip(*parts, strict=True)
        return np.concatenate(mean), np.concatenate(covariance)

    def _score(self, recording: Recording) -> float:
        """Joint log density of one demonstration."""
        # Of a step that is known, or is there twice, no variance is left, and so no density.
        known = self._observations
        exact = ((known.noise == 0.0) & ~np.isnan(known.value)).any(axis=1)
        own, others = (np.round(self._scaled(time), RESOLUTION) for time in (recording.time, known.time[exact]))
        if len(np.unique(own)) < len(own) or np.isin(own, others).any():
            raise ValueError(
                "X has a time twice in a demonstration, or one that is known without noise: leave it out, the movement "
                "has no density there."
            )
        law, rows = self._law(recording.time)
        law = law.at(rows)
        square, log_det = float(law.square(torch.from_numpy(recording.position)[None])), float(law.log_det())
        df, size = self.df_, recording.position.size
        if not math.isfinite(df):
            return -0.5 * (square + log_det + size * math.log(2.0 * math.pi))
        # As of linalg.student_log_density, whose factor of the covariance is not formed here.
        constant = math.lgamma(0.5 * (df + size)) - math.lgamma(0.5 * df) - 0.5 * size * math.log((df - 2.0) * math.pi)
        return constant - 0.5 * log_det - 0.5 * (df + size) * math.log1p(square / (df - 2.0))
