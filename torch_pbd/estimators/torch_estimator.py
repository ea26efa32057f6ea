"""Base of estimators with a torch module: rows are checked, ordered and standardized, and the module is pickled."""

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils._tags import Tags
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.console import say
from torch_pbd.estimators import validation
from torch_pbd.estimators.validation import CONSTANT
from torch_pbd.models import Core
from torch_pbd.models.conditional import ConditionalNormal
from torch_pbd.models.training import TrainingSet
from torch_pbd.optim import FitReport, Progress, Status

# Standardized numbers keep this many decimals, so that data in other units give the same numbers: an optimizer with
# flat directions would amplify a difference in the last bit.
_DECIMALS = 10

Integers = NDArray[np.intp]


@dataclass(frozen=True)
class Standardization:
    """Shift and scale of each column: inputs get a range of one, outputs a standard deviation of one."""

    x_shift: Floats
    x_scale: Floats
    y_shift: Floats
    y_scale: Floats
    # One value of each column, and the shift minus that value. Differences of values are exact, so that the
    # standardized numbers do not depend on the origin.
    x_parts: tuple[Floats, Floats]
    y_parts: tuple[Floats, Floats]

    @classmethod
    def fit(cls, X: Floats, y: Floats) -> "Standardization":
        """Standardization of the columns of X and y.

        A constant output gets the largest scale of the others, so that it is precise beside them. A constant
        input gets its magnitude, beside which rounding is negligible in all units.
        """
        low, span = X.min(axis=0), np.ptp(X, axis=0)
        x_scale = _or_magnitude(span, np.abs(X).max(axis=0))
        y_shift, largest = y.mean(axis=0), np.abs(y).max(axis=0)
        y_scale = (y - y_shift).std(axis=0)
        varies = y_scale > CONSTANT * largest
        if not varies.all():
            y_scale = np.where(varies, y_scale, y_scale[varies].max() if varies.any() else largest)
            y_scale = np.where(y_scale > 0, y_scale, y_scale.max() or 1.0)
        parts = (low, 0.5 * span), (y[0], (y - y[0]).mean(axis=0))
        return cls(low + 0.5 * span, x_scale, y_shift, y_scale, *parts)

    def inputs(self, X: Floats) -> Floats:
        """Standardized inputs, rounded."""
        return self.exact_inputs(X).round(_DECIMALS)

    def outputs(self, y: Floats) -> Floats:
        """Standardized outputs, rounded."""
        return self.exact_outputs(y).round(_DECIMALS)

    def exact_inputs(self, X: Floats) -> Floats:
        """Standardized inputs with all their digits."""
        return (X - self.x_parts[0] - self.x_parts[1]) / self.x_scale

    def exact_outputs(self, y: Floats) -> Floats:
        """Standardized outputs with all their digits."""
        return (y - self.y_parts[0] - self.y_parts[1]) / self.y_scale


def spread_of(columns: Floats) -> Floats:
    """Standard deviation of each column, or the magnitude of a column that is constant up to rounding."""
    return _or_magnitude(columns.std(axis=0), np.abs(columns).max(axis=0))


def _or_magnitude(spread: Floats, magnitude: Floats) -> Floats:
    return np.where(spread > CONSTANT * magnitude, spread, np.where(magnitude > 0, magnitude, 1.0))


def distinct_rows(X: Floats) -> tuple[Floats, Integers]:
    """Distinct rows of X in lexicographic order, and the index of each row of X among them.

    ``numpy.unique`` along an axis gives the same but takes up to 80 times as long.
    """
    X = X + 0.0  # minus zero is zero
    order = X[:, 0].argsort() if X.shape[1] == 1 else np.lexsort(X.T[::-1])
    ordered = X[order]
    is_first = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    index = np.empty(len(X), dtype=np.intp)
    index[order] = is_first.cumsum() - 1
    return ordered[is_first], index


class Fitted(NamedTuple):
    """Result of a subclass's ``_fit``."""

    module: ConditionalNormal
    report: FitReport
    jitter: float


class TorchEstimator(MultiOutputMixin, RegressorMixin, BaseEstimator, ABC):
    """Base of regressors whose fitted state is a torch module, ``module_``, on ``device``.

    Estimators are dataclasses whose fields are the parameters: scikit-learn requires ``__init__`` to store them
    and do nothing else.
    """

    device: str | None
    max_iter: int
    tol: float
    verbose: int
    n_restarts: int
    random_state: Any
    module_: ConditionalNormal

    _core_class: ClassVar[type[Core]]
    """Class of the core of ``module_``."""
    _learned: ClassVar[Mapping[str, Callable[[Any, str], Any]]] = {}
    """Attributes that only fits of this class learn, and how model files check them."""

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
            Recorded outputs of each sample.
        groups : array-like of shape (n_samples,), default=None
            Label of each sample's demonstration, used only to warn of too few; rows are taken as independent.

        Returns
        -------
        self

        Raises
        ------
        ValueError
            If X, y, groups or a parameter is invalid; the message names it and the remedy.
        """
        self.__dict__.pop("module_", None)  # a fit that fails leaves no mixture of two
        self._check_parameters()
        # Column-major order makes operations on each column many times as fast.
        inputs, targets = map(np.asfortranarray, validation.checked_rows(self, X, y, ensure_min_samples=2))
        validation.check_squares(inputs, "X")
        validation.check_squares(targets, "y")
        validation.check_inputs_vary(inputs)
        inputs = validation.without_rounding(inputs)
        self._y_is_1d = targets.ndim == 1
        self.n_outputs_ = 1 if self._y_is_1d else targets.shape[1]
        targets = targets.reshape(len(inputs), -1, order="F")
        # Rows are sorted, so that results do not depend on the order in which they are given.
        order = np.lexsort(np.hstack([inputs, targets]).T)
        numbers = None if groups is None else validation.check_groups(groups, len(inputs))[order]
        with torch.inference_mode(False), torch.enable_grad():
            rows = inputs.T.take(order, axis=1).T, targets.T.take(order, axis=1).T
            self.module_, report, self.jitter_ = self._fit(*rows, groups=numbers, recorded=order.argsort())
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

    def _training_set(self, X: Floats, y: Floats) -> tuple[Standardization, TrainingSet]:
        """Standardization of validated arrays, and the rows with their distinct inputs found."""
        scaling = Standardization.fit(X, y)
        standardized = scaling.inputs(X)
        inputs, index = distinct_rows(standardized)
        self._check_memory(len(inputs), X.shape[1], y.shape[1])
        outputs = self._door(scaling.outputs(y))
        rows = TrainingSet(self._door(standardized), outputs, self._door(inputs), self._door(index).long())
        return scaling, rows

    def _check_memory(self, n_distinct: int, n_features: int, n_outputs: int) -> None:
        """Check that a fit of so many distinct inputs has the memory that it needs."""

    def _progress(self) -> Callable[[Progress], None] | None:
        """Callback that prints the loss to the error output, more often for higher ``verbose``; None if it is 0."""

        def show(progress: Progress) -> None:
            count = progress.n_evaluations
            if count < 5 or count % max(1, 10 // self.verbose) in (0, 1):
                text = f"evaluation {count:5d}  loss {progress.loss:14.6f}  {progress.elapsed:7.2f} s"
                say(f"{type(self).__name__}: {text}", sys.stderr)

        return show if self.verbose else None

    def _assemble(self, core: Any, scaling: Standardization) -> ConditionalNormal:
        parts = (scaling.x_shift, scaling.x_scale, scaling.y_shift, scaling.y_scale)
        return ConditionalNormal(core, *map(self._door, parts)).requires_grad_(False)

    def _door(self, array: Any) -> Tensor:
        """Copy of an array; contiguous, since torch takes no negative strides."""
        return torch.tensor(np.asarray(array, order="C"), dtype=torch.float64, device=self.device)

    def _device_problem(self) -> str:
        """Why no tensor can be put on the device; empty if it can."""
        try:
            self._door(0.0).cpu()  # a meta tensor has no values
        except (AssertionError, OverflowError, RuntimeError, TypeError, ValueError) as error:  # by build and by device
            return str(error).partition("\n")[0].rstrip(".")
        return ""

    def __getstate__(self) -> dict[str, Any]:
        """State without tensors: arrays, and what the module is, for pickle, joblib and skops."""
        state = dict(super().__getstate__())
        if "module_" in state:
            module = state.pop("module_")
            state["_module_config"] = module.core.config()
            state["_module_arrays"] = {k: v.cpu().numpy() for k, v in module.state_dict().items()}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        state = dict(state)
        arrays, config = state.pop("_module_arrays", None), state.pop("_module_config", None)
        super().__setstate__(state)
        if arrays is not None:
            if problem := self._device_problem():
                checks.warn(
                    f"The model was fitted on device {self.device!r}, which this machine lacks ({problem}): it is now "
                    "on the CPU."
                )
                self.device = None
            with torch.inference_mode(False):  # else autograd would refuse the module
                tensors = {name: self._door(array) for name, array in arrays.items()}
                self.module_ = ConditionalNormal.restored(self._core_class, config, tensors).requires_grad_(False)
