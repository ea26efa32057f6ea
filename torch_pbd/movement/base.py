"""What the models of whole movements share: marginals, draws, scores, and conditioning, from one joint law."""

import copy
import math
from abc import ABC, abstractmethod
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted
from torch import Tensor

from torch_pbd import checks
from torch_pbd.estimators.base import Uncertainty
from torch_pbd.estimators.validation import Floats, checked_queries, checked_rows
from torch_pbd.files.memory import require_much
from torch_pbd.movement.joint import Conditioned, JointNormal, Observed
from torch_pbd.movement.recordings import Known, Recording, as_recordings

_AT_ONCE = 1024  # rows whose marginals are found together, and whose law is kept
_RESOLUTION = 10  # decimals of a time, in ranges of those of the fit: nearer ones are equal


class MovementRegressor(MultiOutputMixin, RegressorMixin, BaseEstimator, ABC):
    """Base of the models of whole movements; not for direct use.

    A subclass has the joint law of a demonstration at any times, :meth:`_prior`, and its degrees of freedom ``df_``,
    infinite for a normal law.
    """

    df_: float
    n_outputs_: int
    input_: str
    _known: Known | None = None
    _kept: dict[str, tuple[Floats, JointNormal]]  # law at the last times, which conditioned copies share
    _y_is_1d: bool

    def fit(self, X: Any, y: ArrayLike | None = None, *, groups: ArrayLike | None = None) -> Self:
        """Learn the law of a whole demonstration.

        Parameters
        ----------
        X : Demonstrations, or array-like of shape (n_samples, 1)
            Demonstrations are learned over time if all share their times, else over phase, 0 to 1 (``input_``). An
            array has the time or the phase of each sample.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs), default=None
            Positions, where X is an array.
        groups : array-like of shape (n_samples,), default=None
            Demonstration of each sample, where X is an array: required, two or more.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If X has more than one column, y or groups are missing, there is one demonstration only, or a parameter
            cannot be used.
        """
        for name in ("_known", "_kept"):
            self.__dict__.pop(name, None)
        self._check_parameters()
        recordings = as_recordings(self, X, y, groups, is_fit=True)
        if len(recordings) < 2:
            raise ValueError(
                "groups has one demonstration, must have two or more: how whole movements differ is not seen in one. "
                "Record more, or use a covariance regressor by itself."
            )
        self._fit(recordings)
        return self

    @abstractmethod
    def _check_parameters(self) -> None:
        """Check the parameters, before any work."""

    @abstractmethod
    def _fit(self, recordings: list[Recording]) -> None:
        """Fit to two or more demonstrations."""

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

    @abstractmethod
    def _scaled(self, time: Floats) -> Floats:
        """Times in ranges of those of the fit."""

    def predict(self, X: ArrayLike, *, return_std: bool = False, return_cov: bool = False) -> Any:
        """Mean of a movement at X, and with it the standard deviations or the covariances of each row.

        Parameters
        ----------
        X : array-like of shape (n_samples, 1)
        return_std, return_cov : bool, default=False
            As of the covariance regressors; covariances (n_samples, n_outputs, n_outputs) are those of each row.

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs), as y was
        std or covariance : ndarray, if asked for
        """
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be True.")
        mean, covariance = self._marginals(self._times(X))
        shaped = mean.ravel() if self._y_is_1d else mean
        if return_cov:
            return shaped, covariance
        if not return_std:
            return shaped
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        return shaped, std.ravel() if self._y_is_1d else std

    def predict_cov(self, X: ArrayLike) -> Floats:
        """Covariance of the outputs at each row of X: (n_samples, n_outputs, n_outputs), in squared units of y."""
        return self._marginals(self._times(X))[1]

    def predict_df(self, X: ArrayLike) -> Floats:
        """Degrees of freedom of the law at X: (n_samples,), infinite where it is normal."""
        return np.full(len(self._times(X)), self.df_)

    def predict_uncertainty(self, X: ArrayLike) -> Uncertainty:
        """Both kinds of uncertainty at X, apart (Section IV-C); type2 is that of the movement, given what is known.

        Basis functions know nothing of missing data: type1 is 0 within the times of the fit, and 1 beyond them.
        """
        time = self._times(X)
        scaled = np.round(self._scaled(time), _RESOLUTION)
        beyond = (scaled < 0.0) | (scaled > 1.0)
        return Uncertainty(beyond.astype(np.float64), self._marginals(time)[1])

    def predict_joint(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """Joint mean and covariance of a new demonstration at the rows of X.

        Returns
        -------
        mean : ndarray of shape (n_samples, n_outputs)
        covariance : ndarray of shape (n_samples, n_outputs, n_samples, n_outputs)
            Between all outputs at all rows: with n_samples n_outputs squared numbers.
        """
        time = self._times(X)
        require_much(
            4 * 8.0 * (len(time) * self.n_outputs_) ** 2,
            what=f"the covariance between all {len(time)} rows and {self.n_outputs_} outputs",
            remedy="Ask for fewer rows; sample_demonstrations and score_demonstrations never form it.",
        )
        law, rows = self._law(time)
        covariance = law.covariance()[rows][:, :, rows]
        return law.mean[rows].numpy(), covariance.numpy()

    def sample_demonstrations(self, X: ArrayLike, n_samples: int = 1, random_state: Any = None) -> Floats:
        """Draw whole demonstrations at the rows of X: smooth, and passing through what is known.

        Parameters
        ----------
        X : array-like of shape (n_samples_X, 1)
        n_samples : int, default=1
        random_state : int, RandomState instance or None, default=None

        Returns
        -------
        ndarray of shape (n_samples, n_samples_X, n_outputs)
        """
        checks.count(n_samples, "n_samples")
        generator = checks.seed(random_state)
        time = self._times(X)
        require_much(
            6 * 8.0 * n_samples * (len(time) + len(self.known_times())) * self.n_outputs_,
            what=f"n_samples={n_samples} at {len(time)} rows",
            remedy="Draw fewer at a time.",
        )
        conditioned, rows = self._conditioned(time)
        n_steps, d, n_loadings, n_entries = conditioned.sizes
        sizes = (n_steps, n_samples * d), (n_loadings, n_samples), (n_entries, n_samples)
        normal = [torch.from_numpy(generator.standard_normal(size)) for size in sizes]
        deviations = conditioned.deviations(*normal)[:, rows].numpy()
        # One chi-squared a movement: it is unusual as a whole.
        if math.isfinite(self.df_):
            deviations *= np.sqrt((self.df_ - 2.0) / generator.chisquare(self.df_, n_samples))[
                :, np.newaxis, np.newaxis
            ]
        return conditioned.law.mean[rows].numpy() + deviations

    def sample_y(self, X: ArrayLike, n_samples: int = 1, random_state: Any = None) -> Floats:
        """Draw y at X, independently for each row; whole movements are drawn by :meth:`sample_demonstrations`.

        Returns
        -------
        ndarray of shape (n_samples_X, n_outputs, n_samples), or (n_samples_X, n_samples) if y was 1-D
        """
        checks.count(n_samples, "n_samples")
        generator = checks.seed(random_state)
        mean, covariance = self._marginals(self._times(X))
        values, vectors = np.linalg.eigh(covariance)  # of a row that is known the covariance is zero
        root = vectors * np.sqrt(values.clip(0.0))[:, np.newaxis]
        deviation = root @ generator.standard_normal((*mean.shape, n_samples))
        if math.isfinite(self.df_):
            squares = generator.chisquare(self.df_, (len(mean), 1, n_samples))
            deviation *= np.sqrt((self.df_ - 2.0) / squares)
        samples = mean[:, :, np.newaxis] + deviation
        return samples[:, 0] if self._y_is_1d else samples

    def log_likelihood(self, X: ArrayLike, y: ArrayLike) -> Floats:
        """Log density of each row of y at X, by itself, in nats: (n_samples,)."""
        check_is_fitted(self)
        X, targets = checked_rows(self, X, y, reset=False)
        targets = targets.reshape(len(X), -1)
        mean, covariance = self._marginals(self._times(X))
        try:
            whitened = np.linalg.solve(np.linalg.cholesky(covariance), (targets - mean)[..., np.newaxis])[..., 0]
        except np.linalg.LinAlgError as error:
            raise ValueError("X has a row that is known without noise: it has no density. Leave it out.") from error
        log_det = 2.0 * np.log(np.diagonal(np.linalg.cholesky(covariance), axis1=1, axis2=2)).sum(1)
        return student_log_density(np.square(whitened).sum(1), log_det, targets.shape[1], self.df_)

    def score_demonstrations(self, X: Any, y: ArrayLike | None = None, *, groups: ArrayLike | None = None) -> Floats:
        """Joint log density of each demonstration, in nats, given what is known.

        Parameters
        ----------
        X : Demonstrations, or array-like of shape (n_samples, 1)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs), default=None
        groups : array-like of shape (n_samples,), default=None
            Demonstration of each row; None takes all rows for one.

        Returns
        -------
        ndarray of shape (n_demos,), in the order of their labels

        Raises
        ------
        ValueError
            If a demonstration has a time twice, or one that is known without noise, where it has no density.
        """
        check_is_fitted(self)
        return np.array([self._score(recording) for recording in as_recordings(self, X, y, groups, is_fit=False)])

    def score(self, X: Any, y: ArrayLike | None = None, *, groups: ArrayLike | None = None) -> float:
        """Joint log density of the demonstrations over their number of steps: nats a step, higher is better."""
        recordings = as_recordings(self, X, y, groups, is_fit=False)
        return float(sum(map(self._score, recordings)) / sum(len(recording.time) for recording in recordings))

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
        given = ~np.isnan(value).all(axis=1)
        known = Known(time[given], value[given], np.broadcast_to(scale, value[given].shape))
        if self._known is not None:
            known = Known(*(np.concatenate(pair) for pair in zip(self._known, known, strict=True)))
        copied = copy.copy(self)
        copied._known, copied._kept = known, self.__dict__.setdefault("_kept", {})
        copied._observed(self._union(known.time[:0], known)[2])  # refuses what cannot be conditioned on
        return copied

    def _times(self, X: ArrayLike) -> Floats:
        """Times (n,) of rows to predict at."""
        check_is_fitted(self)
        return np.ascontiguousarray(checked_queries(self, X)[:, 0])

    def known_times(self) -> Floats:
        """Times (m,) at which something is known of the movement."""
        return np.empty(0) if self._known is None else self._known.time

    def _union(self, time: Floats, known: Known | None) -> tuple[Floats, NDArray[np.intp], NDArray[np.intp]]:
        """Distinct times of queries and of what is known, and the places of both among them."""
        both = np.concatenate([time, np.empty(0) if known is None else known.time])
        _, first, index = np.unique(np.round(self._scaled(both), _RESOLUTION), return_index=True, return_inverse=True)
        return both[first], index[: len(time)], index[len(time) :]

    def _observed(self, places: NDArray[np.intp]) -> Observed:
        """What is known, by the places of its times in a union of times."""
        nothing = np.empty((0, self.n_outputs_))
        known = Known(np.empty(0), nothing, nothing) if self._known is None else self._known
        return known.observed(places)

    def _conditioned(self, time: Floats) -> tuple[Conditioned, Tensor]:
        """Law of all times that matter, given what is known, and the places of ``time`` among them."""
        union, rows, places = self._union(time, self._known)
        return Conditioned(self._prior_of_last(union), self._observed(places)), torch.from_numpy(rows)

    def _prior_of_last(self, time: Floats) -> JointNormal:
        """Joint law at increasing times; those that were asked for last, with others or not, take no work again."""
        kept, scaled = self.__dict__.setdefault("_kept", {}), np.round(self._scaled(time), _RESOLUTION)
        if kept and len(time):
            known, law = kept["last"]
            place = np.searchsorted(known, scaled).clip(max=len(known) - 1)
            old = known[place] == scaled
            if old.all():
                return law if len(old) == len(known) else law.at(torch.from_numpy(place))
            if 2 * old.sum() > len(old):
                law, new = law.at(torch.from_numpy(place[old])), self._prior(time[~old])
                order = np.argsort(np.concatenate([np.flatnonzero(old), np.flatnonzero(~old)]))
                return law.joined(new, self._between(time[old], time[~old])).at(torch.from_numpy(order))
        law = self._prior(time)
        if 0 < len(time) <= _AT_ONCE:
            kept["last"] = scaled, law
        return law

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
        law, rows = self._law(recording.time)
        known = set() if self._known is None else set(rows.tolist()) & set(self._exact_places(recording.time))
        if len(set(rows.tolist())) < len(rows) or known:
            raise ValueError(
                "X has a time twice in a demonstration, or one that is known without noise: leave it out, the movement "
                "has no density there."
            )
        law = law.at(rows)
        square = law.square(torch.from_numpy(recording.position)[None])
        size = recording.position.size
        return float(student_log_density(square.numpy(), float(law.log_det()), size, self.df_)[0])

    def _exact_places(self, time: Floats) -> list[int]:
        assert self._known is not None
        places = self._union(time, self._known)[2]
        exact = ((self._known.noise == 0.0) & ~np.isnan(self._known.value)).any(axis=1)
        return [int(place) for place in places[exact]]


def student_log_density(square: Floats, log_det: Any, size: int, df: float) -> Floats:
    """Log density of a Student's t of covariance S, from x' S^-1 x and log det S; normal if df is infinite."""
    if not math.isfinite(df):
        return np.asarray(-0.5 * (square + log_det + size * math.log(2.0 * math.pi)))
    constant = gammaln(0.5 * (df + size)) - gammaln(0.5 * df) - 0.5 * size * math.log((df - 2.0) * math.pi)
    return np.asarray(constant - 0.5 * log_det - 0.5 * (df + size) * np.log1p(square / (df - 2.0)))
