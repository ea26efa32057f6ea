"""Predictions of the covariance regressors, and their priors and other parameters in the units of the data."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from sklearn.utils.validation import check_is_fitted
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.estimators.torch_estimator import TorchEstimator
from torch_pbd.estimators.validation import checked_queries, checked_rows
from torch_pbd.files.memory import require_much
from torch_pbd.linalg import gaussian_log_density, safe_cholesky, student_log_density

Prior = float | list[list[float]] | str | Callable[[Any], Any] | None  # forms that YAML can express; or any array-like

_SHORTEST_PERIOD = 1e-8  # share of the input's range: ten decimals of a standardized input leave such a phase two
# Shares of the variance of y beyond which the floor under variances shows far from data, or the prior near them.
_LOWEST, _HIGHEST = 1e-6, 1e6
_CHUNK = 1024  # rows: what a prediction needs on the way is then some tens of MB for ten outputs


class Uncertainty(NamedTuple):
    """The two kinds of uncertainty of Section IV-C, at n inputs."""

    type1: Floats
    """(n,): missing data. 0 at training inputs, 1 where only the prior speaks."""
    type2: Floats
    """(n, d, d): variability of the data, with the prior taken out; squared units of y."""


class CovarianceRegressor(TorchEstimator):
    """Base of the regressors whose covariance depends on the input; not for direct use."""

    def predict(self, X: ArrayLike, *, return_std: bool = False, return_cov: bool = False) -> Any:
        """Mean of y at X, and with it the standard deviations or the covariances.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
        return_std : bool, default=False
            Also return the standard deviation of each output, shaped like the mean.
        return_cov : bool, default=False
            Also return the covariance of the outputs in each row (n_samples, n_outputs, n_outputs), unlike
            scikit-learn's GaussianProcessRegressor, whose ``return_cov`` gives the covariances between rows.

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs), as y was
        std or covariance : ndarray, if asked for
        """
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be True.")
        inputs = checked_queries(self, X)
        if not (return_std or return_cov):
            mean = self._arrays(lambda x: (self.module_.mean(x),), inputs)[0]
            return mean.ravel() if self._y_is_1d else mean
        moments = self._arrays(lambda x: self.module_.moments(x, *self._prior_tril_at(x)), inputs)
        return shaped_as_y(*moments, y_is_1d=self._y_is_1d, return_cov=return_cov)

    def predict_cov(self, X: ArrayLike) -> Floats:
        """Covariances of the outputs at X: (n_samples, n_outputs, n_outputs), also for one output.

        They are symmetric to the last bit, positive definite, and in squared units of y.
        """
        inputs = checked_queries(self, X)
        return self._arrays(lambda x: (self.module_.covariance(x, *self._prior_tril_at(x)),), inputs)[0]

    def predict_uncertainty(self, X: ArrayLike) -> Uncertainty:
        """Missing data (``type1``) and variability (``type2``) at X, separately (Section IV-C)."""
        inputs = checked_queries(self, X)
        return Uncertainty(*self._arrays(lambda x: (self.module_.type1(x), self.module_.type2(x)), inputs))

    def predict_df(self, X: ArrayLike) -> Floats:
        """Degrees of freedom of the predictive density at X: (n_samples,), infinite where it is normal."""
        return self._degrees(checked_queries(self, X))

    def log_likelihood(self, X: ArrayLike, y: ArrayLike) -> Floats:
        """Log density of each row of y at X, in nats: (n_samples,)."""
        check_is_fitted(self)
        inputs, targets = checked_rows(self, X, y, reset=False)
        targets = targets.reshape(len(inputs), -1)
        if targets.shape[1] != self.n_outputs_:
            raise ValueError(f"y has {targets.shape[1]} outputs, but the model was fitted with {self.n_outputs_}.")

        def log_density(rows: Tensor) -> tuple[Tensor]:
            x, y = rows.tensor_split([self.n_features_in_], dim=1)
            mean, scale_tril = self.module_(x, *self._prior_tril_at(x))
            degrees = self.module_.degrees(x)
            if degrees is None:
                return (gaussian_log_density(y - mean, scale_tril),)
            return (student_log_density(y - mean, scale_tril, degrees),)

        return self._arrays(log_density, np.hstack([inputs, targets]))[0]

    def score(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> float:
        """Mean log density of the rows of y at X, in nats: higher is better.

        The R^2 score of scikit-learn's regressors ignores the covariance.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
        sample_weight : array-like of shape (n_samples,), default=None
            Weights of the rows in the mean; accepted through scikit-learn's metadata routing.
        """
        densities = self.log_likelihood(X, y)
        if sample_weight is None:
            return float(densities.mean())
        weights = checks.array(sample_weight, "sample_weight", (len(densities),))
        checks.require(weights >= 0.0, weights, "sample_weight", "at least 0")
        checks.number(weights.sum(), "the sum of sample_weight", above=0.0)
        return float(np.average(densities, weights=weights))

    def sample_y(self, X: ArrayLike, n_samples: int = 1, random_state: Any = None) -> Floats:
        """Draw y at X, independently for each row.

        Returns
        -------
        ndarray of shape (n_samples_X, n_outputs, n_samples), or (n_samples_X, n_samples) if y was 1-D
        """
        checks.count(n_samples, "n_samples", least=1)
        generator = checks.seed(random_state)
        inputs = checked_queries(self, X)
        require_much(
            4 * 8.0 * len(inputs) * self.n_outputs_ * n_samples,
            what=f"n_samples={n_samples} at {len(inputs)} rows",
            remedy="Draw fewer at a time.",
        )
        mean, scale_tril = self._arrays(lambda x: self.module_(x, *self._prior_tril_at(x)), inputs)
        normal = generator.standard_normal((*mean.shape, n_samples))
        # Student's t of this covariance: normal numbers times the root of (df - 2) over a chi-squared number, which is
        # a gamma number of shape df / 2 and scale 2.
        degrees = self._degrees(inputs)[:, np.newaxis]
        if np.isfinite(degrees).any():  # everywhere or nowhere
            squares = generator.gamma(0.5 * degrees, 2.0, size=(len(inputs), n_samples))
            normal *= np.sqrt((degrees - 2.0) / squares)[:, np.newaxis]
        samples = mean[:, :, np.newaxis] + scale_tril @ normal
        return samples[:, 0] if self._y_is_1d else samples

    def _degrees(self, X: Floats) -> Floats:
        def degrees(x: Tensor) -> tuple[Tensor]:
            found = self.module_.degrees(x)
            return (torch.full_like(x[:, 0], torch.inf) if found is None else found,)

        return self._arrays(degrees, X)[0]

    def _prior_tril_at(self, x: Tensor) -> tuple[Tensor, ...]:
        """Factor of the prior at x, where it depends on x; else nothing, as the module has it."""
        prior = getattr(self, "prior", None)
        if not callable(prior):
            return ()
        covariance = prior_covariance(prior, x.cpu().numpy(), self.n_outputs_)
        return (safe_cholesky(self._door(covariance), name="prior(X)"),)

    def _query(self, X: ArrayLike) -> Tensor:
        return self._door(checked_queries(self, X))

    def _arrays(self, function: Callable[[Tensor], Any], X: Floats) -> tuple[Floats, ...]:
        """Arrays that a function of tensors gives for rows, a bounded number at a time."""
        with torch.inference_mode():
            return tuple(part.cpu().numpy() for part in by_chunks(function, self._door(X)))


def shaped_as_y(mean: Floats, covariance: Floats, *, y_is_1d: bool, return_cov: bool) -> tuple[Floats, Floats]:
    """Mean (n, d) as y was, with the covariance (n, d, d) as it is, or with the standard deviations as y was."""
    mean = mean.ravel() if y_is_1d else mean
    if return_cov:
        return mean, covariance
    # Where an output is known its variance is zero but for rounding, which may be below.
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).clip(0.0))
    return mean, std.ravel() if y_is_1d else std


def by_chunks(function: Callable[[Any], Any], x: Tensor | Floats) -> Any:
    """Tuple of arrays that a function of rows gives for x, called for a bounded number of rows at a time."""
    if len(x) <= _CHUNK:
        return function(x)
    # What the first chunk takes tells what all will take.
    first = function(x[:_CHUNK])
    require_much(
        2.0 * len(x) / _CHUNK * sum(part.nbytes for part in first),  # in parts, and joined
        what=f"what is predicted for {len(x)} rows",
        remedy="Predict fewer at a time.",
    )
    others = (function(x[start : start + _CHUNK]) for start in range(_CHUNK, len(x), _CHUNK))
    joined: Any = torch.cat if isinstance(x, Tensor) else np.concatenate
    return tuple(joined(part) for part in zip(first, *others, strict=True))


def check_length_scale(value: Any, n_features: int) -> Floats | None:
    """Length scales as an array (n_features,), or None where they are to be learned."""
    if value is None:
        return None
    must = "positive and in the units of its column of X"
    return _of_columns(value, "length_scale", n_features, lambda scales: np.isfinite(scales) & (scales > 0), must)


def check_period(value: Any, kernel: str, x_scale: Floats) -> Floats | None:
    """Periods as an array (n_features,), infinite where an input of the range ``x_scale`` does not repeat, or None."""
    if value is None:
        if kernel == "periodic":
            raise ValueError("kernel == 'periodic' needs a period, in units of X, such as period=1.0 for a phase.")
        return None
    least = f"{_SHORTEST_PERIOD:g} of its range, or of its value where it is constant"
    must = f"in the units of its column of X (or inf), no shorter than {least}"
    return _of_columns(value, "period", len(x_scale), lambda periods: periods >= _SHORTEST_PERIOD * x_scale, must)


def _of_columns(value: Any, name: str, n_columns: int, good: Callable[[Floats], Any], must: str) -> Floats:
    """Numbers (n_columns,), one for each column of X, of one or as many that are good."""
    numbers = parameter_floats(value, name)
    if numbers.shape not in [(), (n_columns,)] or not good(numbers).all():
        raise checks.refusal(value, name, f"None, a number or {n_columns} of them, each {must}")
    return np.broadcast_to(numbers, (n_columns,)).copy()


def parameter_floats(value: Any, name: str) -> Floats:
    """A parameter of numbers as an array of floats, of any shape."""
    try:
        array = checks.real_array(value, name)
        if array.dtype.kind == "b":
            raise TypeError("not bool")
        return array.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is {value!r}, must be numbers ({error}).") from error


def standardized_prior(prior: Prior, X: Floats, y_scale: Floats) -> Floats:
    """Covariances of a prior, as :func:`prior_covariance`, over the outputs' deviations ``y_scale`` (d,).

    It warns of variances so far from those of y, or from each other, that float64 does not hold them beside those.
    """
    covariance = prior_covariance(prior, X, len(y_scale)) / y_scale[:, np.newaxis] / y_scale
    eigenvalues = np.linalg.eigvalsh(covariance)
    lowest, highest = float(eigenvalues.min()), float(eigenvalues.max())
    if lowest < _LOWEST * max(1.0, highest) or highest > _HIGHEST:
        checks.warn(
            f"prior has variances of {lowest:.3g} to {highest:.3g} times those of y. Below {_LOWEST:g} of these, or of "
            f"the largest, they come out larger; above {_HIGHEST:g} they show where there are data. Give the prior in "
            "squared units of y."
        )
    return np.asarray(covariance)


def prior_covariance(prior: Prior, X: Floats, n_outputs: int) -> Floats:
    """Covariances (n, d, d) or (d, d) that a float, array or callable prior stands for, which are positive definite."""
    name, value = "prior", prior
    shape: tuple[int, ...] = (n_outputs, n_outputs)
    if callable(prior):
        name, shape = "prior(X)", (len(X), n_outputs, n_outputs)
        try:
            value = prior(X.copy())
        except Exception as error:
            error.add_note(f"Raised by prior(X), which was asked for covariances at X of shape {X.shape}.")
            raise
    covariance = parameter_floats(value, name)
    if covariance.ndim == 0 and not callable(prior):
        covariance = covariance * np.eye(n_outputs)
    covariance = checks.array(covariance, name, shape)
    remedy = "far from data it is the covariance, so give every direction some variance"
    checks.semidefinite(covariance, name, definite=True, remedy=remedy)
    return covariance
