"""Interface of the models of whole movements: fit, marginals, draws and scores from one joint law."""

import copy
import math
from abc import abstractmethod
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.demonstrations import Demonstration
from torch_pbd.estimators.base import Uncertainty, shaped_as_y
from torch_pbd.estimators.door import by_chunks
from torch_pbd.estimators.validation import checked_rows
from torch_pbd.files.memory import require_much
from torch_pbd.linalg import log_density
from torch_pbd.movement.law import MovementLaw, as_recordings, semidefinite_root


class MovementRegressor(MultiOutputMixin, RegressorMixin, MovementLaw):
    """Base of the models of whole movements; not for direct use."""

    input_: str

    def fit(self, X: Any, y: ArrayLike | None = None, *, groups: ArrayLike | None = None) -> Self:
        """Learn the law of a whole demonstration.

        Parameters
        ----------
        X : Demonstrations, or array-like of shape (n_samples, 1)
            Demonstrations are learned over time if all share their times, and over phase, 0 to 1, otherwise
            (``input_``). An array holds the time or the phase of each sample.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs), default=None
            Position of each sample, where X is an array.
        groups : array-like of shape (n_samples,), default=None
            Label of each sample's demonstration, required where X is an array; there must be two or more.

        Raises
        ------
        ValueError
            If X has more than one column, y or groups are missing, there is only one demonstration, no two overlap,
            as by stamps of a clock, or a parameter is invalid.
        """
        # Of a copy, so that a fit that fails leaves no mixture of two.
        fitted = copy.copy(self)
        fitted.__dict__.pop("_known", None)
        fitted._check_parameters()
        fitted._fit_recordings(as_recordings(fitted, X, y, groups, is_fit=True))
        self.__dict__ = fitted.__dict__
        return self

    def _fit_recordings(self, recordings: list[Demonstration]) -> None:
        """Check that these show a movement, and fit to them."""
        if len(recordings) < 2:
            raise ValueError(
                "groups has one demonstration, must have two or more: how whole movements differ is not seen in one. "
                "Record more, or use a covariance regressor by itself."
            )
        times = [time for time, _ in recordings]
        low, width = float(np.concatenate(times).min()), float(np.ptp(np.concatenate(times)))
        self._range = low, checks.number(width, "the range of X", above=0.0)
        starts, ends = (np.sort([time[i] for time in times]) for i in (0, -1))
        if (starts[1:] >= ends[:-1]).all():
            raise ValueError(
                f"X has {len(times)} demonstrations, of which no two overlap from {starts[0]:.10g} to {ends[-1]:.10g}: "
                "they would be parts of one long movement. Count the times of each from its own start."
            )
        self._fit(recordings)

    @abstractmethod
    def _check_parameters(self) -> None:
        """Check the parameters, before any work."""

    @abstractmethod
    def _fit(self, recordings: list[Demonstration]) -> None:
        """Fit to two or more demonstrations."""

    def _components(self, time: Floats) -> tuple[Floats, list[tuple[Self, Floats]]]:
        """Mixture components: weights, and for each the law and its inputs; only one unless timing is unknown."""
        return np.ones(1), [(self, time)]

    def _rows(self, time: Floats) -> tuple[Floats, Floats]:
        """Mean (n, d) and covariance (n, d, d) of each row under one component."""
        conditioned, rows = self._conditioned(time)
        return conditioned.law.mean[rows].numpy(), conditioned.law.marginal()[rows].numpy()

    def _marginals(self, time: Floats) -> tuple[Floats, Floats]:
        """Mean (n, d) and covariance (n, d, d) of each row."""
        weight, parts = self._components(time)
        return mixed(weight, [by_chunks(law._rows, own) for law, own in parts], "kia,kib->iab")

    def predict(self, X: ArrayLike, *, return_std: bool = False, return_cov: bool = False) -> Any:
        """Mean of a movement at X, and with it the standard deviations or the covariances of each row.

        Parameters
        ----------
        X : array-like of shape (n_samples, 1)
        return_std, return_cov : bool, default=False
            Also return the standard deviations, shaped like the mean, or the covariance of the outputs in each row
            (n_samples, n_outputs, n_outputs).

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs), as y was
        std or covariance : ndarray, if asked for
        """
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be True.")
        mean, covariance = self._marginals(self._times(X))
        both = shaped_as_y(mean, covariance, y_is_1d=self._y_is_1d, return_cov=return_cov)
        return both if return_cov or return_std else both[0]

    def predict_cov(self, X: ArrayLike) -> Floats:
        """Covariance of the outputs at each row of X: (n_samples, n_outputs, n_outputs), in squared units of y."""
        return self._marginals(self._times(X))[1]

    def predict_df(self, X: ArrayLike) -> Floats:
        """Degrees of freedom of the law at X: (n_samples,), infinite where it is normal."""
        return np.full(len(self._times(X)), self.df_)

    def predict_uncertainty(self, X: ArrayLike) -> Uncertainty:
        """Missing data (``type1``) and variability (``type2``) at X, separately (Section IV-C).

        ``type1`` is the regressor's for TrajectoryRegressor; the baselines cannot detect missing data and have 0 within
        the times of the fit and 1 beyond them. ``type2`` is the variability given observations.
        """
        weight, parts = self._components(self._times(X))
        type1, type2 = zip(*(by_chunks(law._uncertainty, own) for law, own in parts), strict=True)
        if len(parts) == 1:
            return Uncertainty(type1[0], type2[0])
        means = [by_chunks(law._rows, own)[0] for law, own in parts]
        variability = mixed(weight, list(zip(means, type2, strict=True)), "kia,kib->iab")[1]
        return Uncertainty(weight @ np.stack(type1), variability)

    def _uncertainty(self, time: Floats) -> tuple[Floats, Floats]:
        """Type I uncertainty and variability of each row under one component."""
        scaled = self._rounded(time)
        return ((scaled < 0.0) | (scaled > 1.0)).astype(np.float64), self._rows(time)[1]

    def predict_joint(self, X: ArrayLike) -> tuple[Floats, Floats]:
        """Joint mean and covariance of a new demonstration at the rows of X.

        Returns
        -------
        mean : ndarray of shape (n_samples, n_outputs)
        covariance : ndarray of shape (n_samples, n_outputs, n_samples, n_outputs)
            Covariance between all outputs at all rows.
        """
        time = self._times(X)
        what = f"the covariance between all {len(time)} rows and {self.n_outputs_} outputs"
        remedy = "Ask for fewer rows; to draw and to score movements no model but KMPBaseline forms it."
        require_much(4 * 8.0 * (len(time) * self.n_outputs_) ** 2, what=what, remedy=remedy)
        weight, parts = self._components(time)
        moments = []
        for model, own in parts:
            conditioned, rows = model._conditioned(own)
            law = conditioned.law.at(rows)
            moments.append((law.mean.numpy(), law.covariance().numpy()))
        return mixed(weight, moments, "kia,kjb->iajb")

    def sample_demonstrations(self, X: ArrayLike, n_samples: int = 1, random_state: Any = None) -> Floats:
        """Draw whole demonstrations at the rows of X, smooth and consistent with the observations so far.

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
        what, n_rows = f"n_samples={n_samples} at {len(time)} rows", len(time) + len(self._known.time)
        require_much(6 * 8.0 * n_samples * n_rows * self.n_outputs_, what=what, remedy="Draw fewer at a time.")
        weight, parts = self._components(time)
        counts = generator.multinomial(n_samples, weight).tolist()
        own = [law._draws(x, n, generator) for (law, x), n in zip(parts, counts, strict=True) if n]
        # Draws come component by component; shuffled, so that the first few do not all come from the same one.
        return own[0] if len(parts) == 1 else np.asarray(generator.permutation(np.concatenate(own)))

    def _draws(self, time: Floats, n_draws: int, generator: np.random.RandomState) -> Floats:
        """Demonstrations (s, n, d) from one component."""
        conditioned, rows = self._conditioned(time)
        normal = conditioned.deviations(n_draws, lambda size: torch.from_numpy(generator.standard_normal(size)))
        deviations = normal[:, rows].numpy()
        # One chi-squared variable per movement, which is unusual as a whole.
        if math.isfinite(self.df_):
            scale = np.sqrt((self.df_ - 2.0) / generator.chisquare(self.df_, n_draws))
            deviations *= scale[:, np.newaxis, np.newaxis]
        return np.asarray(conditioned.law.mean[rows].numpy() + deviations)

    def sample_y(self, X: ArrayLike, n_samples: int = 1, random_state: Any = None) -> Floats:
        """Draw y at X, independently for each row; whole movements are drawn by :meth:`sample_demonstrations`.

        Returns
        -------
        ndarray of shape (n_samples_X, n_outputs, n_samples), or (n_samples_X, n_samples) if y was 1-D
        """
        checks.count(n_samples, "n_samples")
        generator, time = checks.seed(random_state), self._times(X)
        weight, parts = self._components(time)
        size, degrees = (len(time), self.n_outputs_, n_samples), self.predict_df(X)[:, np.newaxis, np.newaxis]
        normal, samples = generator.standard_normal(size), np.empty(size)
        if np.isfinite(degrees).all():
            normal *= np.sqrt((degrees - 2.0) / generator.chisquare(degrees, (len(time), 1, n_samples)))
        drawn = generator.choice(len(weight), (len(time), 1, n_samples), p=weight)
        for number, (law, own) in enumerate(parts):
            mean, covariance = by_chunks(law._rows, own)
            np.copyto(samples, mean[..., np.newaxis] + semidefinite_root(covariance) @ normal, where=drawn == number)
        return samples[:, 0] if self._y_is_1d else samples

    def log_likelihood(self, X: ArrayLike, y: ArrayLike) -> Floats:
        """Marginal log density (n_samples,) of each row of y at X, in nats.

        With unknown timing it is that of a Student's t with the moments of the mixture.
        """
        check_is_fitted(self)
        X, targets = checked_rows(self, X, y, reset=False)
        time = self._times(X)
        mean, covariance = map(torch.from_numpy, self._marginals(time))
        root, info = torch.linalg.cholesky_ex(covariance)
        if info.any() or self._is_known(time).any():
            raise ValueError("X has a row that is known without noise, or with hardly any: it has no density there.")
        residual, degrees = torch.from_numpy(targets).reshape(mean.shape) - mean, torch.from_numpy(self.predict_df(X))
        return log_density(residual, root, degrees if degrees.isfinite().all() else None).numpy()

    def _is_known(self, time: Floats) -> NDArray[np.bool_]:
        """Whether an output is known without noise at each of these times: there is no density there."""
        return np.isin(self._rounded(time), self._rounded(self._known.time[self._known.exact.any(axis=1)]))

    def score_demonstrations(self, X: Any, y: ArrayLike | None = None, *, groups: ArrayLike | None = None) -> Floats:
        """Joint log density of each demonstration, in nats, given the observations of :meth:`condition`.

        Parameters
        ----------
        X : Demonstrations, or array-like of shape (n_samples, 1)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs), default=None
        groups : array-like of shape (n_samples,), default=None
            Label of each row's demonstration; None takes all rows as one demonstration.

        Returns
        -------
        ndarray of shape (n_demos,), in the order of their labels

        Raises
        ------
        ValueError
            If a demonstration has a time twice, or a time known without noise: no density exists there.
        """
        check_is_fitted(self)
        return np.array([self._score(*recording) for recording in as_recordings(self, X, y, groups, is_fit=False)])

    def score(
        self, X: Any, y: ArrayLike | None = None, *, groups: ArrayLike | None = None, sample_weight: None = None
    ) -> float:
        """Joint log density of the demonstrations per step, in nats: higher is better; pipelines pass the None."""
        if sample_weight is not None:
            raise checks.refusal(sample_weight, "sample_weight", "None", "weigh what score_demonstrations returns")
        check_is_fitted(self)
        recordings = as_recordings(self, X, y, groups, is_fit=False)
        return float(sum(self._score(*each) for each in recordings) / sum(len(each.time) for each in recordings))

    def _score(self, time: Floats, position: Floats) -> float:
        """Joint log density of one demonstration."""
        # A step that is known or repeated has no variance left, and so no density.
        if len(np.unique(self._rounded(time))) < len(time) or self._is_known(time).any():
            raise ValueError(
                "X has a time twice in a demonstration, or one that is known without noise: leave it out, the movement "
                "has no density there; give groups if there are several demonstrations."
            )
        conditioned, rows = self._conditioned(time)
        return conditioned.law.at(rows).log_density(torch.from_numpy(position), self.df_)


def mixed(weight: Floats, moments: list[tuple[Floats, Floats]], outer: str) -> tuple[Floats, Floats]:
    """Mean and covariance of a mixture of components with these ``moments``; ``outer`` is the einsum of deviations."""
    if len(moments) == 1:
        return moments[0]
    mean, covariance = map(np.stack, zip(*moments, strict=True))
    # Law of total covariance: the mean of the covariances, and the covariance of the means.
    whole = np.tensordot(weight, mean, 1)
    deviation = np.sqrt(weight)[:, np.newaxis, np.newaxis] * (mean - whole)
    return whole, np.tensordot(weight, covariance, 1) + np.einsum(outer, deviation, deviation)
