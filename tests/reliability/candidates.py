"""The estimators whose numbers are measured, in every variant that computes in another way."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.estimators.cholesky import CholeskyCovRegressor
from torch_pbd.estimators.heteroscedastic import HeteroscedasticGPRegressor
from torch_pbd.estimators.mixture import GMMBaseline
from torch_pbd.estimators.wishart import WishartProcessRegressor

# Collinear outputs have no optimum: a likelihood of theirs goes on rising for thousands of iterations.
_SHORT: dict[str, Any] = {"max_iter": 100}
_LIKELIHOOD: dict[str, Any] = {"objective": "likelihood", **_SHORT}
_PRINTED: dict[str, Any] = {"objective": "likelihood", "latent_prior": False, "max_iter": 30}

CANDIDATES: dict[str, list[CovarianceRegressor]] = {
    "cholesky": [
        CholeskyCovRegressor(**_SHORT),
        CholeskyCovRegressor(**_SHORT, noise_scale=0.0),
        CholeskyCovRegressor(**_SHORT, kernel="matern32"),
        CholeskyCovRegressor(**_SHORT, diagonal="log", bias_correction=True),
        CholeskyCovRegressor(**_LIKELIHOOD),
        CholeskyCovRegressor(**_LIKELIHOOD, diagonal="raw", solver="lbfgs", kernel="matern52"),
        CholeskyCovRegressor(**_PRINTED),
    ],
    "wishart": [
        WishartProcessRegressor(**_SHORT),
        WishartProcessRegressor(**_SHORT, kernel="matern52"),
        WishartProcessRegressor(**_LIKELIHOOD),
        WishartProcessRegressor(**_LIKELIHOOD, solver="lbfgs", kernel="matern32"),
        WishartProcessRegressor(**_LIKELIHOOD, df=8),
        WishartProcessRegressor(**_PRINTED),
    ],
    "mixture": [
        GMMBaseline(n_components=1),
        GMMBaseline(n_components=2),
        GMMBaseline(n_components=5, n_restarts=0),
        GMMBaseline(n_components=3, solver="lbfgs"),
    ],
    "heteroscedastic": [
        HeteroscedasticGPRegressor(),
        HeteroscedasticGPRegressor(kernel="matern32"),
        HeteroscedasticGPRegressor(kernel="matern52", n_inducing=8),
        HeteroscedasticGPRegressor(kernel="periodic", period=1.0),
    ],
}


def candidate(name: str, number: int, X: NDArray[Any]) -> CovarianceRegressor:
    """Variant of an estimator, unfitted; a period is of a quarter more than the range of each input."""
    variants = CANDIDATES[name]
    estimator: CovarianceRegressor = clone(variants[number % len(variants)])
    if estimator.get_params().get("period") is not None:
        span = np.ptp(X.astype(np.float64), axis=0)
        estimator.set_params(period=np.where(span > 0, 1.25 * span, 1.0))
    return estimator


def fit_candidate(estimator: CovarianceRegressor, X: Any, y: Any, groups: Any = None) -> CovarianceRegressor:
    """Fit, telling the demonstrations to those that ask for them."""
    if groups is not None and isinstance(estimator, HeteroscedasticGPRegressor):
        return estimator.fit(X, y, groups=groups)
    return estimator.fit(X, y)
