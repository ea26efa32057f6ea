"""Interface of the covariance regressors: rows are checked and ordered, a torch module learns them and predicts."""

import inspect
import sys
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from sklearn.base import MultiOutputMixin, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils._tags import Tags
from sklearn.utils.validation import check_is_fitted
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.console import say
from torch_pbd.estimators import validation
from torch_pbd.estimators.door import Integers, Standardization, TorchEstimator, row_order
from torch_pbd.estimators.validation import checked_queries, checked_rows
from torch_pbd.files.memory import require_much
from torch_pbd.linalg import log_density
from torch_pbd.models import Core
from torch_pbd.models.conditional import ConditionalNormal
from torch_pbd.optim.batch import FitReport, Progress, Status

Fit = tuple[Core, Standardization, FitReport, float]
"""Fitted core, the units of its inputs and outputs, how the fit ended, and the jitter."""

# What the docstrings of all regressors have in common.
COMMON = """device : str or None, default=None
    Device of the torch module.
verbose : int, default=0

Attributes
----------
module_ : ConditionalNormal
    The fitted torch module: maps x (n, e) to mean (n, d) and Cholesky factor (n, d, d), differentiably.
n_features_in_, n_outputs_ : int
n_iter_ : int
converged_ : bool
loss_curve_ : list of float"""


class Uncertainty(NamedTuple):
    """The two kinds of uncertainty of Section IV-C, at n inputs."""

    type1: Floats
    """(n,): missing data. 0 at training inputs, 1 where only the prior speaks."""
    type2: Floats
    """(n, d, d): variability of the data, with the prior taken out; squared units of y."""


class CovarianceRegressor(MultiOutputMixin, RegressorMixin, TorchEstimator):
    """Base of the regressors whose covariance depends on the input; not for direct use.

    They are dataclasses whose fields are the parameters: scikit-learn requires ``__init__`` to store them and do
    nothing else.
    """

    max_iter: int
    tol: float
    verbose: int
    n_restarts: int
    random_state: Any

    _common: ClassVar[str] = COMMON
    """What is in the place of {common} in docstrings."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.__doc__ = inspect.cleandoc(cls.__doc__ or "").replace("{common}", cls._common)

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.regressor_tags.poor_score = True  # score is a log-likelihood, not R^2
        return tags

    def fit(self, X: ArrayLike, y: ArrayLike | None = None, groups: ArrayLike | None = None) -> Self:
        """Learn mean and covariance.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_features)
            Time, phase or position of each sample. Rows that repeat exactly are aligned demonstrations.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Recorded outputs of each sample.
        groups : array-like of shape (n_samples,), default=None
            Label of each sample's demonstration. HeteroscedasticGPRegressor learns how the samples of a demonstration
            repeat each other; without labels rows count as independent, and recorded demonstrations look more certain
            than they are. Other regressors use them only to warn of too few.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If X, y, groups or a parameter is invalid; the message names it and the remedy.

        Warns
        -----
        DataRankWarning
            If there are no more demonstrations, or rows, than outputs; or if no groups are given although neighbouring
            rows are nearly equal, as samples of a demonstration are (HeteroscedasticGPRegressor).
        UnimodalityWarning
            If demonstrations over one input seem to have several modes (HeteroscedasticGPRegressor).
        ConvergenceWarning
            If the fit stopped early; the best point found is kept.
        """
        self.__dict__.pop("module_", None)  # a fit that fails leaves no mixture of two
        self._check_parameters()
        # Column-major order makes operations on each column many times as fast.
        inputs, targets = map(np.asfortranarray, checked_rows(self, X, y, ensure_min_samples=2))
        validation.check_squares(inputs, "X")
        validation.check_squares(targets, "y")
        validation.check_inputs_vary(inputs)
        inputs = validation.without_rounding(inputs)
        self._y_is_1d = targets.ndim == 1
        self.n_outputs_ = 1 if self._y_is_1d else targets.shape[1]
        targets = targets.reshape(len(inputs), -1, order="F")
        # Rows are sorted, so that results do not depend on the order in which they are given.
        order = row_order(inputs, targets)
        numbers = None if groups is None else validation.check_groups(groups, len(inputs))[order]
        with torch.inference_mode(False), torch.enable_grad():
            rows = inputs.T.take(order, axis=1).T, targets.T.take(order, axis=1).T
            core, scaling, report, self.jitter_ = self._fit(*rows, groups=numbers, order=order)
            units = scaling.x_shift, scaling.x_scale, scaling.y_shift, scaling.y_scale
            self.module_ = ConditionalNormal(core, *map(self._door, units)).requires_grad_(False)
        self.n_iter_ = max(1, report.n_iter)
        self.loss_, self.loss_curve_, self.converged_ = report.loss, list(report.loss_curve), report.converged
        if not report.converged:
            more = f"max_iter (now {self.max_iter}) or " if report.status is Status.MAX_ITER else ""
            checks.warn(
                f"{type(self).__name__} stopped early: {report.message}. The best point found is kept; "
                f"raise {more}tol (now {self.tol:g}).",
                ConvergenceWarning,
            )
        return self

    @abstractmethod
    def _fit(self, X: Floats, y: Floats, *, groups: Integers | None, order: Integers) -> Fit:
        """Fit to validated arrays (n, e) and (n, d).

        ``groups`` has the number of each row's demonstration, ``order`` the place of each in the order of recording.
        """

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

    def _progress(self) -> Callable[[Progress], None] | None:
        """Callback that prints the loss to the error output, more often for higher ``verbose``; None if it is 0."""

        def show(progress: Progress) -> None:
            count = progress.n_evaluations
            if count < 5 or count % max(1, 10 // self.verbose) in (0, 1):
                text = f"evaluation {count:5d}  loss {progress.loss:14.6f}  {progress.elapsed:7.2f} s"
                say(f"{type(self).__name__}: {text}", sys.stderr)

        return show if self.verbose else None

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

    def predict_cov(self, X: ArrayLike, *, missing_knowledge: bool = True) -> Floats:
        """Covariances of the outputs at X: (n_samples, n_outputs, n_outputs), also for one output.

        They are symmetric to the last bit, positive definite, and in squared units of y. Without ``missing_knowledge``
        they are the variability alone, ``type2`` of :meth:`predict_uncertainty`, not always definite.
        """
        if not missing_knowledge:
            return self.predict_uncertainty(X).type2
        inputs = checked_queries(self, X)
        return self._arrays(lambda x: (self.module_.covariance(x, *self._prior_tril_at(x)),), inputs)[0]

    def predict_uncertainty(self, X: ArrayLike) -> Uncertainty:
        """Missing data (``type1``) and variability (``type2``) at X, separately (Section IV-C)."""
        inputs = checked_queries(self, X)
        return Uncertainty(*self._arrays(lambda x: (self.module_.type1(x), self.module_.type2(x)), inputs))

    def predict_df(self, X: ArrayLike) -> Floats:
        """Degrees of freedom of the predictive density at X: (n_samples,), infinite where it is normal."""
        return self._arrays(lambda x: (self._degrees(x),), checked_queries(self, X))[0]

    def _degrees(self, x: Tensor) -> Tensor:
        found = self.module_.degrees(x)
        return torch.full_like(x[:, 0], torch.inf) if found is None else found

    def log_likelihood(self, X: ArrayLike, y: ArrayLike) -> Floats:
        """Log density of each row of y at X, in nats: (n_samples,)."""
        check_is_fitted(self)
        inputs, targets = checked_rows(self, X, y, reset=False)

        def at(rows: Tensor) -> tuple[Tensor]:
            x, y = rows.tensor_split([self.n_features_in_], dim=1)
            mean, scale_tril = self.module_(x, *self._prior_tril_at(x))
            return (log_density(y - mean, scale_tril, self.module_.degrees(x)),)

        return self._arrays(at, np.column_stack([inputs, targets]))[0]

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
        mean, scale_tril, degrees = self._arrays(
            lambda x: (*self.module_(x, *self._prior_tril_at(x)), self._degrees(x)[:, None]), inputs
        )
        normal = generator.standard_normal((*mean.shape, n_samples))
        # Student's t of this covariance: normal numbers times the root of (df - 2) over a chi-squared number, which is
        # a gamma number of shape df / 2 and scale 2.
        if np.isfinite(degrees).any():  # everywhere or nowhere
            squares = generator.gamma(0.5 * degrees, 2.0, size=(len(inputs), n_samples))
            normal *= np.sqrt((degrees - 2.0) / squares)[:, np.newaxis]
        samples = mean[:, :, np.newaxis] + scale_tril @ normal
        return samples[:, 0] if self._y_is_1d else samples


def shaped_as_y(mean: Floats, covariance: Floats, *, y_is_1d: bool, return_cov: bool) -> tuple[Floats, Floats]:
    """Mean (n, d) as y was, with the covariance (n, d, d) as it is, or with the standard deviations as y was."""
    mean = mean.ravel() if y_is_1d else mean
    if return_cov:
        return mean, covariance
    # Where an output is known its variance is zero but for rounding, which may be below.
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).clip(0.0))
    return mean, std.ravel() if y_is_1d else std
