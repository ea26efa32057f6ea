"""What demonstrations vary by, learned: the covariance over the phase, and the bounds of the stiffness law."""

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from torch_pbd.control.stiffness import StiffnessLaw
from torch_pbd.estimators._base import CovarianceRegressor
from torch_pbd.estimators._groups import fit_by_demonstration
from torch_pbd.estimators.heteroscedastic import HeteroscedasticGPRegressor

Floats = NDArray[np.float64]

_RESOLUTION = 1e-5  # of the extent of a movement: smaller standard deviations count as none
_ROUNDING = 1e-11  # of the largest position


def fit_covariance(regressor: CovarianceRegressor | None, inputs: Floats, varying: Floats) -> CovarianceRegressor:
    """Fit a clone of the regressor to what varies (K, n, d) at common inputs (n, 1); it is told the demonstrations."""
    fitted: CovarianceRegressor = clone(HeteroscedasticGPRegressor() if regressor is None else regressor)
    n_demos, n_steps, n_outputs = varying.shape
    between, extent = varying - varying[:1], _extent(varying)
    if float(np.abs(between).max()) <= _RESOLUTION * extent:
        # One movement, shown again: what a smooth mean leaves of it would count as variability. It stands still
        # instead, at a distance to which the floors of regressors are relative.
        varying = extent + between
    groups = np.repeat(np.arange(n_demos), n_steps)
    return fit_by_demonstration(fitted, np.tile(inputs, (n_demos, 1)), varying.reshape(-1, n_outputs), groups)


def fit_law(law: StiffnessLaw | None, covariance: Floats, varying: Floats) -> StiffnessLaw:
    """Fix the bounds of a law to covariances (m, d, d) along a movement, of what varies (K, n, d)."""
    return (StiffnessLaw() if law is None else law).fitted(covariance, resolution=_RESOLUTION * _extent(varying))


def _extent(varying: Floats) -> float:
    """Diagonal of the box around (K, n, d); where nothing moves the largest position, which floors are relative to."""
    extent, largest = float(np.linalg.norm(np.ptp(varying, axis=(0, 1)))), float(np.abs(varying).max())
    return extent if extent > _ROUNDING * largest else largest or 1.0
