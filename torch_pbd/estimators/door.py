"""The door between NumPy and torch: data and parameters in standardized units, devices, and pickles without tensors."""

from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from torch import Tensor

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.estimators.validation import CONSTANT
from torch_pbd.files.memory import require_much
from torch_pbd.linalg import safe_cholesky
from torch_pbd.models import Core
from torch_pbd.models.conditional import ConditionalNormal
from torch_pbd.models.training import TrainingSet, default_prior_tril

Prior = float | list[list[float]] | str | Callable[[Any], Any] | None  # forms that YAML can express; or any array-like
Integers = NDArray[np.intp]

# Standardized numbers keep this many decimals, so that data in other units give the same numbers: an optimizer with
# flat directions would amplify a difference in the last bit.
_DECIMALS = 10
_SHORTEST_PERIOD = 1e-8  # share of the input's range: ten decimals of a standardized input leave such a phase two
# Shares of the variance of y beyond which the floor under variances shows far from data, or the prior near them.
_LOWEST, _HIGHEST = 1e-6, 1e6
_CHUNK = 1024  # rows: what a prediction needs on the way is then some tens of MB for ten outputs


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
        x_scale = or_magnitude(span, X)
        y_shift, largest = y.mean(axis=0), np.abs(y).max(axis=0)
        y_scale = (y - y_shift).std(axis=0)
        varies = y_scale > CONSTANT * largest
        if not varies.all():
            y_scale = np.where(varies, y_scale, y_scale[varies].max() if varies.any() else largest)
            y_scale = np.where(y_scale > 0, y_scale, y_scale.max() or 1.0)
        parts = (low, 0.5 * span), (y[0], (y - y[0]).mean(axis=0))
        return cls(low + 0.5 * span, x_scale, y_shift, y_scale, *parts)

    def inputs(self, X: Floats, *, exact: bool = False) -> Floats:
        """Standardized inputs, rounded; with all their digits if ``exact``."""
        standardized = (X - self.x_parts[0] - self.x_parts[1]) / self.x_scale
        return standardized if exact else standardized.round(_DECIMALS)

    def outputs(self, y: Floats, *, exact: bool = False) -> Floats:
        """Standardized outputs, rounded; with all their digits if ``exact``."""
        standardized = (y - self.y_parts[0] - self.y_parts[1]) / self.y_scale
        return standardized if exact else standardized.round(_DECIMALS)

    def in_units(self, inputs: Floats) -> Floats:
        """Inputs in the units of X."""
        return self.x_shift + self.x_scale * inputs


def or_magnitude(spread: Floats, columns: Floats) -> Floats:
    """Spread of each column, or the magnitude of a column that is constant up to rounding."""
    magnitude = np.abs(columns).max(axis=0)
    return np.where(spread > CONSTANT * magnitude, spread, np.where(magnitude > 0, magnitude, 1.0))


def row_order(X: Floats, y: Floats) -> Integers:
    """Order of rows that does not depend on the one they are given in: by the last column, then those before it."""
    order = y[:, -1].argsort()
    if (np.diff(y[order, -1]) > 0.0).all():
        return order
    return np.lexsort(np.hstack([X, y]).T)  # which takes three times as long


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


def length_scale_in_ranges(value: Any, x_scale: Floats) -> Floats | None:
    """Length scales (e,) over the ranges of the inputs, or None where they are to be learned."""
    must = "positive and in the units of its column of X"
    return _in_ranges(value, "length_scale", x_scale, lambda scales: np.isfinite(scales) & (scales > 0), must)


def period_in_ranges(value: Any, kernel: str, x_scale: Floats) -> Floats | None:
    """Periods (e,) over the ranges of the inputs, infinite where an input does not repeat, or None."""
    if value is None and kernel == "periodic":
        raise ValueError("kernel == 'periodic' needs a period, in units of X, such as period=1.0 for a phase.")
    least = f"{_SHORTEST_PERIOD:g} of its range, or of its value where it is constant"
    must = f"in the units of its column of X (or inf), no shorter than {least}"
    return _in_ranges(value, "period", x_scale, lambda periods: periods >= _SHORTEST_PERIOD * x_scale, must)


def _in_ranges(value: Any, name: str, x_scale: Floats, good: Callable[[Floats], Any], must: str) -> Floats | None:
    """One number, or one for each column of X, over the ranges of the columns (e,); None if none is given."""
    if value is None:
        return None
    numbers = _floats(value, name)
    if numbers.shape not in [(), x_scale.shape] or not good(numbers).all():
        raise checks.refusal(value, name, f"None, a number or {len(x_scale)} of them, each {must}")
    return np.asarray(numbers / x_scale)


def _floats(value: Any, name: str) -> Floats:
    """A parameter of numbers as an array of floats, of any shape."""
    try:
        array = checks.real_array(value, name)
        if array.dtype.kind == "b":
            raise TypeError("not bool")
        return array.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is {value!r}, must be numbers ({error}).") from error


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
    covariance = _floats(value, name)
    if covariance.ndim == 0 and not callable(prior):
        covariance = covariance * np.eye(n_outputs)
    covariance = checks.array(covariance, name, shape)
    remedy = "far from data it is the covariance, so give every direction some variance"
    checks.semidefinite(covariance, name, definite=True, remedy=remedy)
    return covariance


class TorchEstimator(BaseEstimator, ABC):
    """Base of estimators that learn a torch module, ``module_``, on ``device``."""

    device: str | None
    prior: Prior = None
    module_: ConditionalNormal

    _core_class: ClassVar[type[Core]]
    """Class of the core of ``module_``."""
    _learned: ClassVar[Mapping[str, Callable[[Any, str], Any]]] = {}
    """Attributes that only fits of this class learn, and how model files check them."""

    def __sklearn_is_fitted__(self) -> bool:
        return "module_" in vars(self)

    def _training_set(self, X: Floats, y: Floats) -> tuple[Standardization, TrainingSet]:
        """Standardization of validated arrays, and the rows with their distinct inputs found."""
        scaling = Standardization.fit(X, y)
        standardized = scaling.inputs(X)
        inputs, index = distinct_rows(standardized)
        outputs = self._door(scaling.outputs(y))
        rows = TrainingSet(self._door(standardized), outputs, self._door(inputs), self._door(index).long())
        return scaling, rows

    def _prior_tril(self, training: TrainingSet, scaling: Standardization) -> Tensor:
        """Standardized factor of the prior: (d, d), or (n, d, d) at the training inputs where it is callable."""
        if self.prior is None:
            return default_prior_tril(training.y)
        inputs, scale = scaling.in_units(training.inputs.cpu().numpy()), scaling.y_scale
        covariance = prior_covariance(self.prior, inputs, len(scale)) / scale[:, np.newaxis] / scale
        eigenvalues = np.linalg.eigvalsh(covariance)
        lowest, highest = float(eigenvalues.min()), float(eigenvalues.max())
        # float64 does not hold variances so far from those of y, or from each other, beside those.
        if lowest < _LOWEST * max(1.0, highest) or highest > _HIGHEST:
            checks.warn(
                f"prior has variances of {lowest:.3g} to {highest:.3g} times those of y. Below {_LOWEST:g} of these, "
                f"or of the largest, they come out larger; above {_HIGHEST:g} they show where there are data. Give the "
                "prior in squared units of y."
            )
        return safe_cholesky(self._door(covariance), name="prior")

    def _prior_tril_at(self, x: Tensor) -> tuple[Tensor, ...]:
        """Factor of the prior at x, where it depends on x; else nothing, as the module has it."""
        if not callable(self.prior):
            return ()
        covariance = prior_covariance(self.prior, x.cpu().numpy(), self.n_outputs_)
        return (safe_cholesky(self._door(covariance), name="prior(X)"),)

    def _door(self, array: Any) -> Tensor:
        """Copy of an array; contiguous, since torch takes no negative strides."""
        return torch.tensor(np.asarray(array, order="C"), dtype=torch.float64, device=self.device)

    def _arrays(self, function: Callable[[Tensor], Any], X: Floats) -> tuple[Floats, ...]:
        """Arrays that a function of tensors gives for rows, a bounded number at a time."""
        with torch.inference_mode():
            return tuple(part.cpu().numpy() for part in by_chunks(function, self._door(X)))

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


def by_chunks(function: Callable[[Any], Any], x: Tensor | NDArray[Any]) -> Any:
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
