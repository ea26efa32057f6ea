"""Checks of what users pass to an estimator, before any work starts: rows, parameters, the prior."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import issparse
from sklearn.utils.validation import check_is_fitted, validate_data

from torch_pbd import checks
from torch_pbd.exceptions import DataRankWarning

Floats = NDArray[np.float64]
# A column whose spread is below this of its largest value differs only by rounding.
CONSTANT = 1e-11
# Distance of values that are made equal, in usual distances; and of all, how many are worth saying.
_NEAR, _MANY = 1e-3, 0.1
_SHORTEST_PERIOD = 1e-8  # of the range: standardized inputs have ten decimals, and so this phase two
# Of a value, so that its square, and a thousand of them added up, is a number.
_LARGEST = 1e140

Prior = float | list[list[float]] | str | Callable[[Any], Any] | None  # what YAML can say; or any array-like

# Of the variance of y: beyond these the floor under variances shows far from data, or the prior near them.
_LOWEST, _HIGHEST = 1e-6, 1e6


def checked_values(values: Any, name: str) -> Any:
    """``values``, all of them finite numbers, a torch tensor turned into an array.

    They are refused where their type is too coarse for their spread: unix time in float32 has steps of 128 s.
    """
    if hasattr(values, "detach"):
        values = checks.from_tensor(values, name)
    if hasattr(values, "columns"):
        for label in values.columns:
            _check_numbers(checks.real_array(values[label], f"column {label} of {name}"), f"{name}[{label!r}]")
    elif not issparse(values):  # of which scikit-learn says more
        _check_numbers(checks.real_array(values, name), name)
    return values


def _check_numbers(array: NDArray[Any], name: str) -> None:
    """Check that rows (n, ...) are finite, and differ by more than their type resolves."""
    if not (array.ndim and array.size):
        return  # of which scikit-learn says more
    floats = checks.real_floats(array, name)
    remedy = "leave such rows out, or fill them in"
    checks.require(np.isfinite(floats), floats, name, "finite, no NaN and no infinity", remedy)
    if array.dtype in (np.float16, np.float32):
        step, spread = np.finfo(array.dtype).eps * np.abs(floats).max(axis=0), np.ptp(floats, axis=0)
        fine = np.asarray((step <= 1e-3 * spread) | (spread == 0))
        must, remedy = "a thousandth of its range", "subtract an offset before storing it, or record it in float64"
        checks.require(fine, np.asarray(step), f"the resolution of {array.dtype} in {name}", must, remedy)


def checked_rows(estimator: Any, X: ArrayLike, y: ArrayLike, **options: Any) -> tuple[Floats, Floats]:
    """X (n, e) and y (n,) or (n, d) in float64, checked by scikit-learn and by us."""
    if issparse(y):
        raise TypeError("Sparse data was passed for y, but dense data is required. Use '.toarray()'.")
    X, y = checked_values(X, "X"), checked_values(y, "y")
    if y is not None and not np.asarray(y).ndim:
        raise ValueError(f"y is {y!r}, must be an array: one row for each row of X.")
    checked: Any = validate_data(estimator, X, y, dtype=np.float64, y_numeric=True, multi_output=True, **options)
    return checked[0], np.asarray(checked[1], dtype=np.float64)


def checked_queries(estimator: Any, X: ArrayLike) -> Floats:
    """Rows to predict at (n, e) in float64; none at all is allowed, though scikit-learn asks for one."""
    if _is_plain(X, vars(estimator)):
        return np.asarray(X)
    check_is_fitted(estimator)
    X = checked_values(X, "X")
    least = 0 if getattr(X, "shape", (1,))[0] == 0 and np.ndim(X) == 2 else 1
    return validate_data(estimator, X, dtype=np.float64, reset=False, ensure_min_samples=least)


def _is_plain(X: Any, fitted: dict[str, Any]) -> bool:
    """Whether scikit-learn's checks, which take longer than predicting a row, would give X back as it is.

    ``fitted`` are the attributes of the estimator. One that was fitted to a data frame compares names.
    """
    return (
        type(X) is np.ndarray
        and X.dtype == np.float64
        and X.ndim == 2
        and len(X) > 0
        and X.shape[1] == fitted.get("n_features_in_")
        and "module_" in fitted
        and "feature_names_in_" not in fitted
        and bool(np.isfinite(X).all())
    )


def check_squares(array: Floats, name: str) -> None:
    """Check that variances of the columns of ``array`` are numbers that float64 holds."""
    largest = np.asarray(np.abs(array).max(axis=0), dtype=np.float64)  # which holds the bounds
    fine = (largest == 0) | ((largest >= 1.0 / _LARGEST) & (largest <= _LARGEST))
    must = f"zero, or between {1.0 / _LARGEST:g} and {_LARGEST:g} as its square is"
    checks.require(fine, largest, f"the largest value of {name}", must, "use other units")


def check_inputs_vary(X: Floats) -> None:
    """Check that X tells rows apart; warn of columns that are constant or combinations of others.

    The length scale of such a column is not determined.
    """
    spread = np.ptp(X, axis=0)
    constant = spread <= CONSTANT * np.abs(X).max(axis=0)
    if constant.all():
        raise ValueError(
            f"X is constant: its columns have the same value in all {len(X)} rows, so nothing can depend on X. Give "
            "the time, phase or position of each row."
        )
    # In their own ranges, so that the rank is the same in all units.
    centred = (X - X.mean(axis=0)) / np.where(constant, 1.0, spread)
    rank = np.linalg.matrix_rank(centred[:, ~constant], tol=1e-9 * np.sqrt(len(X)))
    if constant.any() or rank < X.shape[1] - constant.sum():
        what = f"column {int(np.argmax(constant))} is constant" if constant.any() else "its columns are collinear"
        checks.warn(
            f"X has {X.shape[1]} columns but varies in {rank} directions only: {what}. The covariance is "
            "learned along these directions; leave the column out.",
            DataRankWarning,
        )


def without_rounding(X: Floats) -> Floats:
    """X with values of a column made equal that a rounding to float32 has told apart.

    They are within its resolution of the range, or one is the other rounded, and far nearer than usual in the column.
    Of many, as of recordings of two precisions, it warns; in many irregular inputs some come as near by chance.
    """
    X = X.copy()
    for number, column in enumerate(X.T):
        value, index = np.unique(column, return_inverse=True)
        gap = np.diff(value, append=np.inf)
        with np.errstate(over="ignore"):
            single = value.astype(np.float32)
        near = gap <= np.finfo(np.float32).eps * np.ptp(value)
        near[:-1] |= (single[1:] == value[:-1]) | (single[:-1] == value[1:])
        near &= gap < _NEAR * np.quantile(gap, 0.9, method="lower")
        # Of values that follow each other closely all take the first.
        first = np.maximum.accumulate(np.where(np.append(False, near[:-1]), 0, np.arange(len(value))))
        column[:] = value[first[index]]
        if near.mean() > _MANY:
            checks.warn(
                f"X has {int(near.sum())} values in column {number} that differ from others by a rounding to float32, "
                "and are taken for equal. Store all recordings in one precision."
            )
    return X


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
    must = f"in the units of its column of X (or inf), no shorter than {_SHORTEST_PERIOD:g} of its range"
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
