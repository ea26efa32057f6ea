"""The prior that users give: a covariance far from data."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from torch_pbd.estimators.validation import Floats, parameter_floats

Prior = (
    float | list[list[float]] | str | Callable[[Any], Any] | None
)  # or any array-like; the type is what YAML can say

# Eigenvalues of a prior below this of the largest cannot be told from zero.
_SINGULAR = 1e-14
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
        warnings.warn(
            f"prior has variances of {lowest:.3g} to {highest:.3g} times those of y. Below {_LOWEST:g} of these, or of "
            f"the largest, they come out larger; above {_HIGHEST:g} they show where there are data. Give the prior in "
            "squared units of y.",
            UserWarning,
            stacklevel=6,
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
    if covariance.shape != shape:
        raise ValueError(
            f"{name} has shape {covariance.shape}, must have shape {shape}: a covariance in squared units of y."
        )
    _check_positive_definite(covariance.reshape(-1, n_outputs, n_outputs), name)
    return covariance


def _check_positive_definite(covariances: Floats, name: str) -> None:
    finite = np.isfinite(covariances).all(axis=(1, 2))
    if not finite.all():
        raise ValueError(f"{name} has an entry that is not finite, at index {int(np.argmin(finite))}.")
    scale = np.abs(covariances).max(axis=(1, 2))
    asymmetry = np.abs(covariances - covariances.transpose(0, 2, 1)).max(axis=(1, 2))
    if (asymmetry > 1e-9 * scale).any():
        i = int(np.argmax(asymmetry > 1e-9 * scale))
        raise ValueError(f"{name} must be symmetric; at index {i} two entries differ by {asymmetry[i]:.3g}.")
    # Units of outputs may be far apart: judge the correlations, not the covariances.
    variance = np.diagonal(covariances, axis1=1, axis2=2)
    smallest = np.linalg.eigvalsh(covariances)[:, 0]
    bad = ~(variance > 0).all(axis=1)
    if not bad.any():
        deviation = np.sqrt(variance)
        correlations = covariances / deviation[:, :, np.newaxis] / deviation[:, np.newaxis, :]
        bad = np.linalg.eigvalsh(correlations)[:, 0] <= _SINGULAR
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"{name} must be positive definite; its smallest eigenvalue is {smallest[i]:.3g}"
            + (f" at index {i}." if len(covariances) > 1 else ".")
            + " Far from data it is the covariance: give every direction some variance."
        )
