"""What demonstrations vary by, learned: the covariance over the phase, and the bounds of the stiffness law."""

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.estimators.demonstrations import fit_with_groups
from torch_pbd.estimators.heteroscedastic import HeteroscedasticGPRegressor
from torch_pbd.estimators.prior import prior_covariance

Floats = NDArray[np.float64]

_RESOLUTION = 1e-5  # of the extent of a movement: smaller standard deviations count as none
_ROUNDING = 1e-11  # of the largest position


def fit_covariance(
    regressor: CovarianceRegressor | None, inputs: Floats, varying: Floats, known: NDArray[np.bool_]
) -> CovarianceRegressor:
    """Fit a clone of the regressor to what varies (K, n, d) at common inputs (n, 1), where two or more know it (K, n).

    It is told the demonstrations. From one alone nothing is known of how they vary, and the others stay aligned.
    """
    fitted: CovarianceRegressor = clone(HeteroscedasticGPRegressor() if regressor is None else regressor)
    between, extent = varying - varying[:1], _extent(varying)
    if float(np.abs(between).max()) <= _RESOLUTION * extent:
        # One movement, shown again: what a smooth mean leaves of it would count as variability. It stands still
        # instead, at a distance to which the floors of regressors are relative.
        varying = extent + between
    groups, steps = np.nonzero(known & (known.sum(axis=0) > 1))
    return fit_with_groups(fitted, inputs[steps], varying[groups, steps], groups)


def with_holes(
    regressor: CovarianceRegressor, inputs: Floats, hole: Floats, far: Floats
) -> tuple[Floats, Floats, Floats]:
    """Covariances (n, d, d) without and with holes, and Type I uncertainty (n,), at inputs (n, 1).

    A regressor bridges holes that are short beside its length scale: here the share ``hole`` (n,) of what it says is
    its prior, at the input, or if that is the same everywhere what it says at ``far`` (1, 1).
    """
    known, type1 = regressor.predict_cov(inputs), regressor.predict_uncertainty(inputs).type1
    if not hole.any():
        return known, known, type1
    prior, share = getattr(regressor, "prior", None), hole[:, np.newaxis, np.newaxis]
    wide = prior_covariance(prior, inputs, known.shape[-1]) if callable(prior) else regressor.predict_cov(far)
    return known, (1.0 - share) * known + share * wide, 1.0 - (1.0 - hole) * (1.0 - type1)


def fit_law(law: StiffnessLaw | None, covariance: Floats, varying: Floats) -> StiffnessLaw:
    """Fix the bounds of a law to covariances (m, d, d) along a movement, of what varies (K, n, d)."""
    return (StiffnessLaw() if law is None else law).fitted(covariance, resolution=_RESOLUTION * _extent(varying))


def _extent(varying: Floats) -> float:
    """Diagonal of the box around (K, n, d); where nothing moves the largest position, which floors are relative to."""
    extent, largest = float(np.linalg.norm(np.ptp(varying, axis=(0, 1)))), float(np.abs(varying).max())
    return extent if extent > _ROUNDING * largest else largest or 1.0
