"""Checks of rows and demonstrations before a fit, and warnings about suspicious data."""

from contextvars import ContextVar
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import issparse
from sklearn.utils.validation import check_is_fitted, has_fit_parameter, validate_data

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data import Demonstrations
from torch_pbd.data.alignment import interpolate, unit_phases
from torch_pbd.data.description import follow_one_way
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.models.training import TrainingSet

ALIKE = "The demonstrations are identical: their covariance is zero, and the smallest that can be told from it is used."
CONSTANT = 1e-11
"""A column whose spread is below this share of its largest value differs only by rounding."""

# Largest distance of values that are made equal, in usual distances, and the share of such values that warns.
_NEAR, _MANY = 1e-3, 0.1
_LARGEST = 1e140  # largest magnitude of a value: float64 holds the sum of a thousand squares
_MOST_PHASES = 200  # largest number of phases on which demonstrations are compared
_COVERED = 0.5  # least share of the input's range that a demonstration covers to be compared with others
# Whether the warning about several modes is suppressed in this context; other threads still warn.
_unimodality_reported: ContextVar[bool] = ContextVar("_unimodality_reported", default=False)


def checked_values(values: Any, name: str) -> Any:
    """``values``, checked to be finite numbers, with a torch tensor turned into an array.

    A type too coarse for their spread raises an error: unix time in float32 has steps of 128 s.
    """
    if isinstance(values, Demonstrations):
        raise checks.refusal(values, name, "an array", "use X, y, groups = demonstrations.stack()")
    if hasattr(values, "detach"):
        values = checks.from_tensor(values, name)
    if hasattr(values, "columns"):
        labels = list(getattr(values, "column_names", values.columns))  # pyarrow's columns are arrays
        if twice := {label for label in labels if labels.count(label) > 1}:
            raise ValueError(
                f"{name} has several columns {min(twice, key=str)!r}, must have one of each name: rename the others."
            )
        for label in labels:
            _check_numbers(checks.real_array(values[label], f"column {label} of {name}"), f"{name}[{label!r}]")
    elif not issparse(values):  # scikit-learn has a better message for sparse matrices
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
        what, must = f"the resolution of {array.dtype} in {name}", "at most a thousandth of its range"
        remedy = "subtract an offset before storing it, or record it in float64"
        checks.require(fine, np.asarray(step), what, must, remedy)


def checked_rows(estimator: Any, X: ArrayLike, y: ArrayLike | None, **options: Any) -> tuple[Floats, Floats]:
    """X (n, e) and y (n,) or (n, d) in float64, checked by scikit-learn and by this package.

    Where ``reset`` is False the estimator is fitted, and y must have as many outputs as in the fit.
    """
    if issparse(y):
        raise TypeError("Sparse data was passed for y, but dense data is required. Use '.toarray()'.")
    X, y = checked_values(X, "X"), checked_values(y, "y")
    if y is not None and not np.asarray(y).ndim:
        raise ValueError(f"y is {y!r}, must be an array: one row for each row of X.")
    checked: Any = validate_data(estimator, X, y, dtype=np.float64, y_numeric=True, multi_output=True, **options)
    inputs, targets = checked[0], np.asarray(checked[1], dtype=np.float64)
    if not options.get("reset", True) and targets[0].size != estimator.n_outputs_:
        raise ValueError(f"y has {targets[0].size} outputs, but the model was fitted with {estimator.n_outputs_}.")
    return inputs, targets


def checked_queries(estimator: Any, X: ArrayLike) -> Floats:
    """Query rows (n, e) in float64; n = 0 is allowed, though scikit-learn requires one row."""
    if _is_plain(X, vars(estimator)):
        return np.asarray(X)
    check_is_fitted(estimator)
    X = checked_values(X, "X")
    least = 0 if getattr(X, "shape", (1,))[0] == 0 and np.ndim(X) == 2 else 1
    return validate_data(estimator, X, dtype=np.float64, reset=False, ensure_min_samples=least)


def _is_plain(X: Any, fitted: dict[str, Any]) -> bool:
    """Whether scikit-learn's checks, which take longer than predicting a row, would return X unchanged.

    ``fitted`` are the attributes of the estimator; one fitted to a data frame must compare column names.
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
    """Check that float64 holds the variances of the columns of ``array``."""
    largest = np.asarray(np.abs(array).max(axis=0), dtype=np.float64)  # which holds the bounds
    fine = (largest == 0) | ((largest >= 1.0 / _LARGEST) & (largest <= _LARGEST))
    must = f"zero, or between {1.0 / _LARGEST:g} and {_LARGEST:g} as its square is"
    checks.require(fine, largest, f"the largest value of {name}", must, "use other units")


def check_inputs_vary(X: Floats) -> None:
    """Check that the rows of X differ, and warn of columns that are constant or combinations of others.

    The data do not determine the length scale of such a column.
    """
    spread = np.ptp(X, axis=0)
    constant = spread <= CONSTANT * np.abs(X).max(axis=0)
    if constant.all():
        raise ValueError(
            f"X is constant: its columns have the same value in all {len(X)} rows, so nothing can depend on X. Give "
            "the time, phase or position of each row."
        )
    # Columns are scaled by their ranges, so that the rank does not depend on units.
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
    """X, with values of a column that differ only by rounding to float32 made equal.

    Such values are within float32's resolution of the range, or one is the other rounded, and far nearer than usual in
    the column. Many, as in recordings of two precisions, raise a warning; irregular inputs have a few by chance.
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
        # Values that follow each other closely all take the first.
        first = np.maximum.accumulate(np.where(np.append(False, near[:-1]), 0, np.arange(len(value))))
        column[:] = value[first[index]]
        # Phases of recordings of several lengths differ by a rounding to float64, of which nobody need know.
        if (near & (gap > 8.0 * np.spacing(np.abs(value).max()))).mean() > _MANY:
            checks.warn(
                f"X has {int(near.sum())} values in column {number} that differ from others by a rounding to float32, "
                "and are taken for equal. Store all recordings in one precision."
            )
    return X


def check_groups(groups: Any, n_samples: int) -> NDArray[np.intp]:
    """Number of each row's demonstration, from labels of any type; missing labels raise an error."""
    if isinstance(groups, list | tuple) and len({isinstance(label, str) for label in groups}) > 1:
        groups = np.fromiter(groups, dtype=object, count=len(groups))  # NumPy would make text of the numbers
    labels = checks.as_array(groups, "groups")
    if labels.shape != (n_samples,):
        raise ValueError(
            f"groups has shape {labels.shape}, must have shape ({n_samples},): the demonstration of each row of X."
        )
    if labels.dtype.kind == "f" and not np.isfinite(labels).all():
        raise ValueError(f"groups has a label that is not finite, at index {int(np.argmin(np.isfinite(labels)))}.")
    if labels.dtype.kind in "mMO":
        for i, label in enumerate(labels):
            if checks.is_missing(label) or label != label:  # NaN and NaT are not equal to themselves
                raise ValueError(f"groups has no label at index {i}: say of every row which demonstration it is of.")
        if len(kinds := sorted({type(label).__name__ for label in labels})) > 1:
            raise ValueError(f"groups has labels of several types ({', '.join(kinds)}): use one, as 1 is not '1'.")
    return np.unique(labels, return_inverse=True)[1]


def check_demonstrations(X: Floats, y: Floats, groups: Any) -> None:
    """Warn of demonstrations too few to estimate their correlation or covariance, or with several modes.

    Modes are looked for along a single input, among demonstrations that cover half of its range or more.
    """
    counts = np.bincount(groups)
    if len(counts) < 2:
        checks.warn(
            "groups has one demonstration: how far its samples repeat each other cannot be told from it, and they "
            "count as independent. What is predicted is its noise, not how demonstrations differ.",
            DataRankWarning,
        )
    else:
        warn_if_few(len(y), y.shape[1], groups)
    if _unimodality_reported.get() or X.shape[1] > 1 or len(counts) < 2 or counts.min() < 2:
        return
    # Of rows of a demonstration at the same time only the first counts.
    times, positions = [], []
    for rows in np.split(np.argsort(groups, kind="stable"), np.cumsum(counts)[:-1]):
        time, first = np.unique(X[rows, 0], return_index=True)
        times.append(time)
        positions.append(y[rows][first])
    if min(len(time) for time in times) > 1 and min(np.ptp(time) for time in times) > _COVERED * np.ptp(X):
        phases, grid = unit_phases(times), np.linspace(0.0, 1.0, min(_MOST_PHASES, round(float(np.median(counts)))))
        follow_one_way(np.stack([interpolate(phase, own, grid) for phase, own in zip(phases, positions, strict=True)]))


def warn_if_few(
    n_rows: int, n_outputs: int, groups: Any = None, *, rows: str = "rows", decides: str = "the prior"
) -> None:
    """Warn if there are no more rows, or no more demonstrations, than outputs: their covariance is singular."""
    if n_rows <= n_outputs:
        checks.warn(
            f"y has {n_rows} {rows} but {n_outputs} outputs: they leave directions of the covariance undetermined, "
            f"which {decides} decides. Record more.",
            DataRankWarning,
        )
    elif groups is not None and (n_demos := int(groups.max()) + 1) <= n_outputs:  # whose samples repeat each other
        checks.warn(
            f"y has {n_demos} demonstrations but {n_outputs} outputs: they leave open how the outputs vary together. "
            f"Record {n_outputs + 1} or more, or learn fewer outputs at a time."
            if n_outputs > 1
            else "y has one demonstration, which leaves open how demonstrations vary. Record two or more.",
            DataRankWarning,
        )


def warn_if_identical(training: TrainingSet) -> bool:
    """Warn of outputs that, up to rounding, never vary where inputs repeat; whether all inputs do, and none varies.

    Outputs are constant where no input repeats.
    """
    repeated = len(training.y) - len(training.inputs)
    squares = training.squares if repeated else (training.y - training.y.mean(0)).square()
    identical = float(squares.sum(0).max()) < 1e-18 * max(1, repeated or len(training.y) - 1)
    if repeated:  # a row or two that were written twice say nothing of the others
        identical &= bool((training.counts > 1).double().mean() >= 0.5)
    if identical:
        checks.warn(ALIKE, DataRankWarning)
    return identical and bool(training.counts.min() > 1)


def fit_with_groups(regressor: Any, X: ArrayLike, y: ArrayLike, groups: ArrayLike) -> Any:
    """Regressor fitted with the demonstrations' numbers if its ``fit`` accepts ``groups``; a user's need not.

    The warning about several modes is suppressed here: the caller has the demonstrations and warns once.
    """
    if not has_fit_parameter(regressor, "groups"):
        return regressor.fit(X, y)
    token = _unimodality_reported.set(True)
    try:
        return regressor.fit(X, y, groups=groups)
    finally:
        _unimodality_reported.reset(token)
