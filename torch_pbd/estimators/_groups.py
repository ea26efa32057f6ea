"""Tell a regressor which rows are of one demonstration, if it takes that."""

from typing import TypeVar

from numpy.typing import ArrayLike
from sklearn.utils.validation import has_fit_parameter

from torch_pbd.estimators._base import CovarianceRegressor
from torch_pbd.estimators._demonstrations import ways_are_told

Regressor = TypeVar("Regressor", bound=CovarianceRegressor)


def fit_by_demonstration(regressor: Regressor, X: ArrayLike, y: ArrayLike, groups: ArrayLike) -> Regressor:
    """Fit, with the demonstrations' numbers where ``fit`` takes them.

    That the demonstrations follow several ways is not said here: whoever has them as demonstrations says it once.
    """
    if not has_fit_parameter(regressor, "groups"):
        return regressor.fit(X, y)
    with ways_are_told():
        return regressor.fit(X, y, groups=groups)  # type: ignore[call-arg]
