"""Estimators by name and where they live: the one table of classes that the package, its files and commands read."""

from importlib import import_module
from typing import Any

REGRESSORS = {
    "HeteroscedasticGPRegressor": "torch_pbd.estimators.heteroscedastic",
    "CholeskyCovRegressor": "torch_pbd.estimators.cholesky",
    "WishartProcessRegressor": "torch_pbd.estimators.wishart",
    "GMMBaseline": "torch_pbd.estimators.mixture",
}
"""Covariance regressors, the recommended one first."""

MOVEMENTS = {
    "TrajectoryRegressor": "torch_pbd.movement.trajectory",
    "ProMPBaseline": "torch_pbd.movement.promp",
    "KMPBaseline": "torch_pbd.movement.kmp",
}
"""Models of whole movements."""

ESTIMATORS = {**REGRESSORS, **MOVEMENTS, "DMPController": "torch_pbd.control.controller"}


def load_class(name: str) -> Any:
    """Class of an estimator; imports its module, and with it torch and scikit-learn."""
    return getattr(import_module(ESTIMATORS[name]), name)
