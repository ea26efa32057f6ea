"""The prior that users give: a covariance far from data."""

from collections.abc import Callable
from typing import Any

import numpy as np

from torch_pbd import checks
from torch_pbd.estimators.validation import Floats, parameter_floats

Prior = (
    float | list[list[float]] | str | Callable[[Any], Any] | None
)  # or any array-like; the type is what YAML can say

# Of the variance of y: beyond these the floor under variances shows far from data, or the prior near them.
_LOWEST, _HIGHEST = 1e-6, 1e6


def standardized_prior(prior: Prior, X: Floats, y_scale: Floats) -> Floats:
    """What :func:`prior_covariance` gives, in units in which the outputs have the deviations ``y_scale`` (d,).

    Warns
    -----
    UserWarning
        If its variances are so far from those of y, or from each other, that float64 does not hold them beside those.
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
    """Covariances (n, d, d) or (d, d) that a float, array or callable prior stands for.

    Raises
    ------
    ValueError
        If they are not of that shape, finite, symmetric and positive definite.
    """
    shape: tuple[int, ...] = (n_outputs, n_outputs)
    if callable(prior):
        try:
            value = prior(X.copy())
        except Exception as error:
            error.add_note(f"Raised by prior(X), which was asked for covariances at X of shape {X.shape}.")
            raise
        covariance = parameter_floats(value, "prior(X)")
        name, shape = "prior(X)", (len(X), *shape)
    else:
        covariance = parameter_floats(prior, "prior")
        name = "prior"
        if covariance.ndim == 0:
            covariance = covariance * np.eye(n_outputs)
    covariance = checks.array(covariance, name, shape)
    remedy = "far from data it is the covariance, so give every direction some variance"
    checks.semidefinite(covariance, name, definite=True, remedy=remedy)
    return covariance
