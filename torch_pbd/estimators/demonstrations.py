"""Demonstrations among rows: their labels, and warnings where something is amiss with them."""

from contextvars import ContextVar
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import has_fit_parameter
from torch import Tensor

from torch_pbd import checks
from torch_pbd.data import Demonstrations, check_unimodal
from torch_pbd.estimators.validation import Floats
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.models.heteroscedastic import HeteroscedasticFit, are_copies
from torch_pbd.models.training import TrainingSet

# Whether a fit is not to warn of several ways; of the context, so that other threads are warned as before.
_unimodality_reported: ContextVar[bool] = ContextVar("_unimodality_reported", default=False)
_COVERED = 0.5  # of the range of the input, by a demonstration that is compared with others


def check_groups(groups: Any, n_samples: int) -> NDArray[np.intp]:
    """Number of each row's demonstration, from labels of any kind, none of which is missing."""
    if hasattr(groups, "detach"):
        groups = checks.from_tensor(groups, "groups")
    if np.ma.is_masked(groups):
        raise ValueError("groups has masked entries: say of every row which demonstration it is of.")
    if isinstance(groups, list | tuple) and len({isinstance(label, str) for label in groups}) > 1:
        groups = np.fromiter(groups, dtype=object, count=len(groups))  # NumPy would make text of the numbers
    try:
        labels = np.asarray(groups)
    except ValueError as error:
        raise ValueError(f"groups is ragged: give one label for each row of X ({error}).") from error
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
    """Warn where demonstrations are too few to tell their correlation or covariance, or seem to follow several ways.

    The ways are looked for along one input, among demonstrations that cover most of it.
    """
    counts = np.bincount(groups)
    if len(counts) < 2:
        checks.warn(
            "groups has one demonstration: how far its samples repeat each other cannot be told from it, and they "
            "count as independent. What is predicted is its noise, not how demonstrations differ.",
            DataRankWarning,
        )
    elif len(y) > y.shape[1]:
        warn_if_few_demonstrations(groups, y.shape[1])
    if _unimodality_reported.get() or X.shape[1] > 1 or len(counts) < 2 or counts.min() < 2:
        return
    # Each time of a demonstration once: of two rows at one time the first counts.
    times, positions = [], []
    for rows in np.split(np.argsort(groups, kind="stable"), np.cumsum(counts)[:-1]):
        time, first = np.unique(X[rows, 0], return_index=True)
        times.append(time)
        positions.append(y[rows][first])
    if min(len(time) for time in times) > 1 and min(np.ptp(time) for time in times) > _COVERED * np.ptp(X):
        check_unimodal(Demonstrations(times, positions))


def warn_if_few(n_rows: int, n_outputs: int, groups: NDArray[np.intp] | None = None) -> None:
    """Warn of no more rows than outputs, whose covariance is singular; or of no more demonstrations."""
    if n_rows <= n_outputs:
        checks.warn(
            f"y has {n_rows} rows but {n_outputs} outputs: they leave directions of the covariance undetermined, "
            "which the prior decides. Record more.",
            DataRankWarning,
        )
    else:
        warn_if_few_demonstrations(groups, n_outputs)


def warn_if_few_demonstrations(groups: NDArray[np.intp] | None, n_outputs: int) -> None:
    """Warn of no more demonstrations than outputs: samples of one repeat each other, however many there are."""
    if groups is not None and (n_demos := int(groups.max()) + 1) <= n_outputs:
        checks.warn(
            f"y has {n_demos} demonstrations but {n_outputs} outputs: they leave open how the outputs vary together. "
            f"Record {n_outputs + 1} or more, or learn fewer outputs at a time.",
            DataRankWarning,
        )


def warn_if_identical(training: TrainingSet) -> None:
    """Warn of outputs that never vary where inputs repeat, or nowhere if none does; but for rounding."""
    repeated = len(training.y) - len(training.inputs)
    squares = training.squares() if repeated else (training.y - training.y.mean(0)).square()
    if float(squares.sum(0).max()) < 1e-18 * max(1, repeated or len(training.y) - 1):
        checks.warn(
            "The demonstrations are identical: their covariance is zero, and the smallest that can be told "
            "from it is used.",
            DataRankWarning,
        )


def warn_of_residuals(fit: HeteroscedasticFit, given: Tensor) -> None:
    """Warn where rows, ``given`` in this order without groups, are of demonstrations; or the mean misses a signal."""
    if fit.group is None and are_copies(fit.whitened(), fit.training, given):
        message = (
            "y has rows that nearly repeat those beside them along X, as samples of a demonstration do. Without groups "
            "they count as independent, and what is predicted is far too certain. Give groups, the demonstration of "
            "each row, to fit; cross_val_score takes params={'groups': groups}, and a search passes them on where "
            "metadata routing is enabled and set_fit_request(groups=True) asks for them."
        )
        checks.warn(message, DataRankWarning)
    elif bool((missed := fit.missed()).any()):
        message = (
            f"The mean does not follow y in outputs {missed.nonzero().flatten().tolist()}: what is left is no noise, "
            "but counts as such. Raise n_inducing and max_inputs; give groups if the rows are of demonstrations."
        )
        checks.warn(message)


def fit_with_groups(regressor: Any, X: ArrayLike, y: ArrayLike, groups: ArrayLike) -> Any:
    """Regressor fitted with the demonstrations' numbers, if its ``fit`` takes them: what users bring along need not.

    That the demonstrations follow several ways is not said here: whoever has them as demonstrations says it once.
    """
    if not has_fit_parameter(regressor, "groups"):
        return regressor.fit(X, y)
    token = _unimodality_reported.set(True)
    try:
        return regressor.fit(X, y, groups=groups)
    finally:
        _unimodality_reported.reset(token)
