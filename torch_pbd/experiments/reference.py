"""Gaussian mixture regression by scikit-learn's GaussianMixture: an independent check of GMMBaseline."""

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import multivariate_normal
from sklearn.base import BaseEstimator
from sklearn.mixture import GaussianMixture

Floats = NDArray[np.float64]


class ScikitLearnGMR(BaseEstimator):
    """scikit-learn's mixture over the standardized [x, y], conditioned by Schur complements.

    Parameters
    ----------
    n_components : int, default=5
    random_state : int, default=0
    """

    def __init__(self, n_components: int = 5, random_state: int = 0) -> None:
        self.n_components = n_components
        self.random_state = random_state

    def fit(self, X: Floats, y: Floats) -> Self:
        """Fit on arrays (n, e) and (n, d), the best of three starts of k-means."""
        joint = np.hstack([X, y])
        self._shift, self._scale = joint.mean(axis=0), joint.std(axis=0)
        self.mixture_ = GaussianMixture(
            self.n_components, tol=1e-7, max_iter=1000, n_init=3, random_state=self.random_state
        ).fit((joint - self._shift) / self._scale)
        self._n_features = X.shape[1]
        return self

    def predict(self, X: Floats, return_cov: bool = False) -> Any:
        """Mean (n, d), and with it the covariances (n, d, d)."""
        e, mixture = self._n_features, self.mixture_
        x = (X - self._shift[:e]) / self._scale[:e]
        parts = list(zip(mixture.weights_, mixture.means_, mixture.covariances_, strict=True))
        log_share = np.stack(
            [np.log(w) + multivariate_normal(m[:e], c[:e, :e]).logpdf(x) for w, m, c in parts], axis=-1
        )
        share = np.exp(log_share - log_share.max(axis=-1, keepdims=True))
        share /= share.sum(axis=-1, keepdims=True)
        gains = [np.linalg.solve(c[:e, :e], c[:e, e:]) for _, _, c in parts]
        means = np.stack([m[e:] + (x - m[:e]) @ gain for (_, m, _), gain in zip(parts, gains, strict=True)], axis=1)
        within = np.stack([c[e:, e:] - c[e:, :e] @ gain for (_, _, c), gain in zip(parts, gains, strict=True)])
        mean = np.einsum("nk,nkd->nd", share, means)
        apart = means - mean[:, np.newaxis]
        covariance = np.einsum("nk,kij->nij", share, within) + np.einsum("nk,nki,nkj->nij", share, apart, apart)
        scale = self._scale[e:]
        mean = self._shift[e:] + scale * mean
        return (mean, covariance * scale[:, np.newaxis] * scale) if return_cov else mean

    def predict_cov(self, X: Floats) -> Floats:
        """Covariances (n, d, d)."""
        return np.asarray(self.predict(X, return_cov=True)[1])

    def score(self, X: Floats, y: Floats) -> float:
        """Mean log density of the rows of y."""
        mean, covariance = self.predict(X, return_cov=True)
        rows = zip(y, mean, covariance, strict=True)
        return float(np.mean([multivariate_normal(m, c).logpdf(target) for target, m, c in rows]))
