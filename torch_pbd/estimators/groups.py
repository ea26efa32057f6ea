"""Fits to rows of which it is known which demonstration they are of."""

from typing import TypeVar

from numpy.typing import ArrayLike
from sklearn.utils.validation import has_fit_parameter

from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.estimators.demonstrations import ways_are_told

Regressor = TypeVar("Regressor", bound=CovarianceRegressor)


def fit_by_demonstration(regressor: Regressor, X: ArrayLike, y: ArrayLike, groups: ArrayLike) -> Regressor:
    """Fit with the demonstrations' numbers, if it takes them: what users bring along need not.

    That the demonstrations follow several ways is not said here: whoever has them as demonstrations says it once.
    """
    if not has_fit_parameter(regressor, "groups"):
        return regressor.fit(X, y)
    with ways_are_told():
        return regressor.fit(X, y, groups=groups)
