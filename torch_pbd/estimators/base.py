"""What the covariance regressors share: the checks before a fit, and all that follows it."""

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import MultiOutputMixin, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils._tags import Tags
from sklearn.utils.validation import check_is_fitted
from torch import Tensor

from torch_pbd import checks
from torch_pbd.console import say
from torch_pbd.estimators.demonstrations import check_groups
from torch_pbd.estimators.prior import prior_covariance
from torch_pbd.estimators.scaling import Standardization, canonical_order
from torch_pbd.estimators.torch_estimator import TorchEstimator, by_chunks
from torch_pbd.estimators.validation import (
    Floats,
    check_inputs_vary,
    check_squares,
    check_weights,
    checked_queries,
    checked_rows,
    without_rounding,
)
from torch_pbd.files.memory import require_much
from torch_pbd.linalg import gaussian_log_density, safe_cholesky, student_log_density
from torch_pbd.models.conditional import ConditionalNormal
from torch_pbd.optim import FitReport, Progress

Integers = NDArray[np.intp]


class Uncertainty(NamedTuple):
    """The two kinds of uncertainty of Section IV-C, at n inputs."""

    type1: Floats
    """(n,): missing data. 0 at training inputs, 1 where only the prior speaks."""
    type2: Floats
    """(n, d, d): variability of the data, with the prior taken out; squared units of y."""


class Fitted(NamedTuple):
    """Result of a subclass's ``_fit``."""

    module: ConditionalNormal
    report: FitReport
    jitter: float


class CovarianceRegressor(MultiOutputMixin, RegressorMixin, TorchEstimator, ABC):
    """Base of the regressors whose covariance depends on the input; not for direct use."""

    max_iter: int
    tol: float
    verbose: int
    n_restarts: int
    random_state: Any

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.regressor_tags.poor_score = True  # score is a log-likelihood, not R^2
        return tags

    def fit(self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None) -> Self:
        """Learn mean and covariance.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Time, phase or position of each sample. Rows that repeat exactly are aligned demonstrations.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            What was recorded there.
        groups : array-like of shape (n_samples,), default=None
            Demonstration of each sample: counted, to warn of too few; rows are taken for independent.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If X, y, groups or a parameter cannot be used; the message names it and says what to do.
        """
        return self._learn(X, y, groups)

    def _learn(self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None) -> Self:
        """Check everything, fit, and keep what was learned."""
        self.__dict__.pop("module_", None)  # a fit that fails leaves no mixture of two
        self._check_parameters()
        # Columns side by side: what is asked of each is many times as fast.
        inputs, targets = map(np.asfortranarray, checked_rows(self, X, y, ensure_min_samples=2))
        check_squares(inputs, "X")
        check_squares(targets, "y")
        check_inputs_vary(inputs)
        inputs = without_rounding(inputs)
        self._y_is_1d = targets.ndim == 1
        self.n_outputs_ = 1 if self._y_is_1d else targets.shape[1]
        targets = targets.reshape(len(inputs), -1, order="F")
        order = canonical_order(inputs, targets)
        numbers = None if groups is None else check_groups(groups, len(inputs))[order]
        with torch.inference_mode(False), torch.enable_grad():
            rows = inputs.T.take(order, axis=1).T, targets.T.take(order, axis=1).T
            fitted = self._fit(*rows, groups=numbers, recorded=order.argsort())
        self.module_ = fitted.module
        report = fitted.report
        self.n_iter_ = max(1, report.n_iter)
        self.loss_ = report.loss
        self.loss_curve_ = list(report.loss_curve)
        self.converged_ = report.converged
        self.jitter_ = fitted.jitter
        self._prepare()
        if not report.converged:
            more = f"max_iter (now {self.max_iter}) or " if report.status.is_limit else ""
            checks.warn(
                f"{type(self).__name__} stopped early: {report.message}. The best point found is kept; "
                f"raise {more}tol (now {self.tol:g}).",
                ConvergenceWarning,
            )
        return self

    @abstractmethod
    def _fit(self, X: Floats, y: Floats, *, groups: Integers | None, recorded: Integers) -> Fitted:
        """Fit on validated arrays (n, e) and (n, d).

        ``groups`` has the number of each row's demonstration, ``recorded`` the rows in the order of their recording.
        """

    def __sklearn_is_fitted__(self) -> bool:
        return "module_" in vars(self)

    def _check_parameters(self) -> None:
        """Check the parameters whose values do not depend on the data; subclasses check theirs too."""
        checks.count(self.max_iter, "max_iter", least=1)
        checks.number(self.tol, "tol", above=0.0)
        checks.count(self.n_restarts, "n_restarts", least=0)
        if not isinstance(self.verbose, bool):
            checks.count(self.verbose, "verbose", least=0)
        checks.seed(self.random_state)
        if problem := self._device_problem():
            raise ValueError(f"device is {self.device!r}, which cannot be used here: {problem}. None is the CPU.")

    def predict(self, X: ArrayLike, *, return_std: bool = False, return_cov: bool = False) -> Any:
        """Mean of y at X, and with it the standard deviations or the covariances.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
        return_std : bool, default=False
            Also return the standard deviation of each output, shaped like the mean.
        return_cov : bool, default=False
            Also return the covariances of the outputs (n_samples, n_outputs, n_outputs). Not those between
            rows, which ``return_cov`` of scikit-learn's GaussianProcessRegressor are.

        Returns
        -------
        mean : ndarray of shape (n_samples,) or (n_samples, n_outputs), as y was
        std or covariance : ndarray, if asked for
        """
        if return_std and return_cov:
            raise ValueError("At most one of return_std and return_cov can be True.")
        inputs = checked_queries(self, X)
        if not (return_std or return_cov):
            mean = self._mean(inputs)
            return mean.ravel() if self._y_is_1d else mean
        mean, covariance = self._moments(inputs)
        shaped = mean.ravel() if self._y_is_1d else mean
        if return_cov:
            return shaped, covariance
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        return shaped, std.ravel() if self._y_is_1d else std

    def predict_cov(self, X: ArrayLike) -> Floats:
        """Covariances of the outputs at X: (n_samples, n_outputs, n_outputs), also for one output.

        Symmetric to the last bit, positive definite, in squared units of y.
        """
        return self._covariance(checked_queries(self, X))

    def predict_uncertainty(self, X: ArrayLike) -> Uncertainty:
        """Both kinds of uncertainty at X, apart (Section IV-C)."""
        inputs = checked_queries(self, X)
        type1 = self._arrays(lambda x: (self.module_.type1(x),), inputs)[0]
        return Uncertainty(type1, self._variability(inputs))

    def predict_df(self, X: ArrayLike) -> Floats:
        """Degrees of freedom of the predictive density at X: (n_samples,), infinite where it is normal."""
        x = self._query(X)
        degrees = self._degrees(x)
        return np.full(len(x), np.inf) if degrees is None else degrees.cpu().numpy()

    def log_likelihood(self, X: ArrayLike, y: ArrayLike) -> Floats:
        """Log density of each row of y at X, in nats: (n_samples,)."""
        x, mean, scale_tril, targets = self._scored(X, y)
        with torch.inference_mode():
            degrees = self._degrees(x)
            if degrees is None:
                return gaussian_log_density(targets - mean, scale_tril).cpu().numpy()
            return student_log_density(targets - mean, scale_tril, degrees).cpu().numpy()

    def score(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> float:
        """Mean log density of the rows of y at X, in nats: higher is better.

        R^2, which scikit-learn's regressors score, does not see the covariance.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
        sample_weight : array-like of shape (n_samples,), default=None
            Of the rows in the mean. A pipeline asks for it where metadata are routed.
        """
        densities = self.log_likelihood(X, y)
        if sample_weight is None:
            return float(densities.mean())
        return float(np.average(densities, weights=check_weights(sample_weight, len(densities))))

    def sample_y(self, X: ArrayLike, n_samples: int = 1, random_state: Any = None) -> Floats:
        """Draw y at X, independently for each row.

        Returns
        -------
        ndarray of shape (n_samples_X, n_outputs, n_samples), or (n_samples_X, n_samples) if y was 1-D
        """
        checks.count(n_samples, "n_samples", least=1)
        generator = checks.seed(random_state)
        x = self._query(X)
        require_much(
            4 * 8.0 * len(x) * self.n_outputs_ * n_samples,
            what=f"n_samples={n_samples} at {len(x)} rows",
            remedy="Draw fewer at a time.",
        )
        mean, scale_tril = (part.cpu().numpy() for part in self._tensors(self._mean_and_tril, x))
        normal = generator.standard_normal((*mean.shape, n_samples))
        degrees = self._degrees(x)
        if degrees is not None:
            each = degrees.cpu().numpy()[:, np.newaxis]
            squares = generator.gamma(0.5 * each, 2.0, size=(len(x), n_samples))
            normal *= np.sqrt((each - 2.0) / squares)[:, np.newaxis]
        samples = mean[:, :, np.newaxis] + scale_tril @ normal
        return samples[:, 0] if self._y_is_1d else samples

    def _mean(self, X: Floats) -> Floats:
        return self._arrays(lambda x: (self.module_.mean(x),), X)[0]

    def _covariance(self, X: Floats) -> Floats:
        return self._arrays(lambda x: (self.module_.covariance(x, *self._prior_tril_at(x)),), X)[0]

    def _variability(self, X: Floats) -> Floats:
        return self._arrays(lambda x: (self.module_.type2(x),), X)[0]

    def _moments(self, X: Floats) -> tuple[Floats, ...]:
        return self._arrays(lambda x: self.module_.moments(x, *self._prior_tril_at(x)), X)

    def _scored(self, X: ArrayLike, y: ArrayLike) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        check_is_fitted(self)
        inputs, targets = checked_rows(self, X, y, reset=False)
        targets = targets.reshape(len(inputs), -1)
        if targets.shape[1] != self.n_outputs_:
            raise ValueError(f"y has {targets.shape[1]} outputs, but the model was fitted with {self.n_outputs_}.")
        x = self._door(inputs)
        return x, *self._tensors(self._mean_and_tril, x), self._door(targets)

    def _degrees(self, x: Tensor) -> Tensor | None:
        """Degrees of freedom of the predictive density at x; None where it is normal."""
        if self.module_.degrees(x[:1]) is None:
            return None
        return self._tensors(lambda rows: (self.module_.degrees(rows),), x)[0]

    def _query(self, X: ArrayLike) -> Tensor:
        return self._door(checked_queries(self, X))

    def _arrays(self, function: Callable[[Tensor], Any], X: Floats) -> tuple[Floats, ...]:
        return tuple(part.cpu().numpy() for part in self._tensors(function, self._door(X)))

    def _tensors(self, function: Callable[[Tensor], Any], x: Tensor) -> Any:
        with torch.inference_mode():
            return by_chunks(function, x)

    def _mean_and_tril(self, x: Tensor) -> tuple[Tensor, ...]:
        return self.module_(x, *self._prior_tril_at(x))

    def _prior_tril_at(self, x: Tensor) -> tuple[Tensor, ...]:
        """Factor of the prior at x, where it depends on x; else nothing, as the module has it."""
        prior = getattr(self, "prior", None)
        if not callable(prior):
            return ()
        covariance = prior_covariance(prior, x.cpu().numpy(), self.n_outputs_)
        return (safe_cholesky(self._door(covariance), name="prior(X)"),)

    def _progress(self) -> Callable[[Progress], None] | None:
        """Callback that prints the loss to the error output, more often for higher ``verbose``; None if it is 0."""
        if not self.verbose:
            return None

        def show(progress: Progress) -> None:
            count = progress.n_evaluations
            if count < 5 or count % max(1, 10 // self.verbose) in (0, 1):
                text = f"evaluation {count:5d}  loss {progress.loss:14.6f}  {progress.elapsed:7.2f} s"
                say(f"{type(self).__name__}: {text}", sys.stderr)

        return show

    def _assemble(self, core: Any, scaling: Standardization) -> ConditionalNormal:
        parts = (scaling.x_shift, scaling.x_scale, scaling.y_shift, scaling.y_scale)
        return ConditionalNormal(core, *map(self._door, parts)).requires_grad_(False)
