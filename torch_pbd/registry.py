"""Lazy imports: estimators by name, from the one table of classes, and optional libraries."""

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


def optional(module: str, extra: str, what: str) -> Any:
    """Library of an extra, imported once it is needed; where it is not there, the error says for ``what``."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        library = module.partition(".")[0]
        raise ModuleNotFoundError(
            f"{what} needs {library}, which is not installed: pip install 'torch_pbd[{extra}]'."
        ) from error
