"""Contenders of covariance.py that libraries provide, each with the settings its documentation recommends."""

import math
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import numpy as np
from covariance_peers import (
    CannotError,
    Floats,
    GPMean,
    Groups,
    Peer,
    distinct,
    empirical_moments,
    log_normal,
    repeats,
    site_sums,
)
from scipy.special import logsumexp
from sklearn.mixture import GaussianMixture

_SINGULAR = 1e-10  # eigenvalue of a component, of rows of unit variance


class MixtureRegression(Peer):
    """scikit-learn's mixture over [x, y], best of five starts, and the mean and covariance of y given x.

    Parameters
    ----------
    n_components : int
    own_density : bool
        Score by the conditional density, a mixture; False: by the normal with its mean and covariance, as Gaussian
        mixture regression does. Neither is the better one everywhere.
    """

    def __init__(self, n_components: int, own_density: bool = False) -> None:
        self.n_components = n_components
        self.gaussian = not own_density

    def _fit(self, x: Floats, y: Floats, groups: Groups | None) -> None:
        joint = np.hstack([x, y])
        self._shift, spread = joint.mean(axis=0), joint.std(axis=0)
        self._scale = np.where(spread > 0, spread, 1.0)
        self._n_features = x.shape[1]
        self.mixture_ = self._mixture((joint - self._shift) / self._scale)

    def _mixture(self, joint: Floats) -> tuple[Floats, Floats, Floats]:
        """Weights, means and covariances."""
        mixture = GaussianMixture(self.n_components, tol=1e-6, max_iter=1000, n_init=5, random_state=0).fit(joint)
        return mixture.weights_, mixture.means_, mixture.covariances_

    def _moments(self, x: Floats) -> tuple[Floats, Floats]:
        log_share, means, within = self._conditional(x)
        share = np.exp(log_share)
        mean = np.einsum("nk,nkd->nd", share, means)
        apart = means - mean[:, np.newaxis]
        return mean, np.einsum("nk,kij->nij", share, within) + np.einsum("nk,nki,nkj->nij", share, apart, apart)

    def _log_density(self, x: Floats, y: Floats) -> Floats:
        if self.gaussian:
            return super()._log_density(x, y)
        log_share, means, within = self._conditional(x)
        return logsumexp(log_share + log_normal(y[:, np.newaxis] - means, within), axis=1)

    def _conditional(self, x: Floats) -> tuple[Floats, Floats, Floats]:
        """Logarithms of shares (n, k), means (n, k, d) and covariances (k, d, d) of y given x."""
        e = self._n_features
        weights, centres, covariances = self.mixture_
        offset = ((x - self._shift[:e]) / self._scale[:e])[:, np.newaxis] - centres[:, :e]
        gain = np.linalg.solve(covariances[:, :e, :e], covariances[:, :e, e:])
        log_share = np.log(weights) + log_normal(offset, covariances[:, :e, :e])
        log_share -= logsumexp(log_share, axis=1, keepdims=True)
        scale = self._scale[e:]
        means = self._shift[e:] + scale * (centres[:, e:] + np.einsum("nke,ked->nkd", offset, gain))
        within = covariances[:, e:, e:] - covariances[:, e:, :e] @ gain
        return log_share, means, 0.5 * (within + within.mT) * np.multiply.outer(scale, scale)


class GmrMixture(MixtureRegression):
    """gmr's mixture from k-means++; with its shrinkage of covariances where one becomes singular without."""

    def _mixture(self, joint: Floats) -> tuple[Floats, Floats, Floats]:
        from gmr import GMM

        for shrinkage in (False, True):
            mixture = GMM(self.n_components, random_state=0)
            options = {"init_params": "kmeans++", "n_iter": 1000, "oracle_approximating_shrinkage": shrinkage}
            try:
                with np.errstate(all="ignore"):
                    mixture.from_samples(joint, **options)
                    singular = np.linalg.eigvalsh(mixture.covariances).min() < _SINGULAR
            except (np.linalg.LinAlgError, ValueError):
                continue
            if singular and not shrinkage:
                continue
            return mixture.priors, mixture.means, mixture.covariances
        raise np.linalg.LinAlgError("a component is singular, with gmr's shrinkage too")


class SklearnFactors(Peer):
    """scikit-learn's Gaussian processes on the mean and on each entry of empirical Cholesky factors."""

    def _fit(self, x: Floats, y: Floats, groups: Groups | None) -> None:
        self._mean = self._mean_process(x, y)
        moments = empirical_moments(x, y, y if repeats(x) else y - self._mean.predict(x))
        self._entries = np.tril_indices(y.shape[1])
        self._least = 1e-3 * np.sqrt(np.diagonal(moments.covariance.mean(axis=0)))
        factors = np.linalg.cholesky(moments.covariance)
        self._factor = self._factor_process(moments.sites, factors[:, *self._entries])

    def _moments(self, x: Floats) -> tuple[Floats, Floats]:
        mean, entries = self._mean.predict(x), self._factor.predict(x)
        d = mean.shape[1]
        factor = np.zeros((len(x), d, d))
        factor[:, *self._entries] = entries
        diagonal = np.arange(d)
        factor[:, diagonal, diagonal] = np.maximum(factor[:, diagonal, diagonal], self._least)
        return mean, factor @ factor.mT

    def _mean_process(self, x: Floats, y: Floats) -> Any:
        return GPMean().fit(x, y)

    def _factor_process(self, sites: Floats, entries: Floats) -> Any:
        return GPMean().fit(sites, entries)


class GPyTorchFactors(SklearnFactors):
    """gpytorch's batch of exact Gaussian processes on the same means and entries, 100 steps of Adam at 0.1."""

    def _mean_process(self, x: Floats, y: Floats) -> Any:
        from speed.gpytorch_models import ExactBatch

        sites, index, counts = distinct(x)
        return ExactBatch(sites, site_sums(index, y, len(sites)) / counts[:, np.newaxis])

    def _factor_process(self, sites: Floats, entries: Floats) -> Any:
        from speed.gpytorch_models import ExactBatch

        return ExactBatch(sites, entries)


class VariationalFactors(Peer):
    """gpytorch's sparse variational processes for mean and factor, log-diagonal, by 1000 steps of Adam."""

    gaussian = False

    def _fit(self, x: Floats, y: Floats, groups: Groups | None) -> None:
        from speed.gpytorch_models import SampledFactors

        self._model = SampledFactors(x, y)

    def _moments(self, x: Floats) -> tuple[Floats, Floats]:
        means, factors = self._model.sample(x)
        mean = means.mean(axis=0)
        apart = means - mean
        return mean, (factors @ factors.mT).mean(axis=0) + np.einsum("sni,snj->nij", apart, apart) / len(apart)

    def _log_density(self, x: Floats, y: Floats) -> Floats:
        means, factors = self._model.sample(x)
        return logsumexp(log_normal(y - means, factors @ factors.mT), axis=0) - math.log(len(means))


class MovementPrimitive(Peer):
    """ProMP of movement_primitives with its 10 weights an output, by its own EM.

    The covariance has noise, too: the library's estimate, or what the 10 weights leave of the curves if that is
    more (the estimate is divided by the norm of the weights as well, so it comes out too small).
    """

    def _fit(self, x: Floats, y: Floats, groups: Groups | None) -> None:
        from movement_primitives.promp import ProMP

        if x.shape[1] != 1:
            raise CannotError("ProMP knows one input, time")
        if groups is None:
            raise CannotError("ProMP needs demonstrations")
        times, curves = [], []
        for group in np.unique(groups):
            rows = np.flatnonzero(groups == group)
            rows = rows[np.argsort(x[rows, 0], kind="stable")]
            times.append(x[rows, 0])
            curves.append(y[rows])
        self._promp = ProMP(y.shape[1])
        pairs = list(zip(times, curves, strict=True))
        left = [y - self._promp.trajectory_from_weights(t.copy(), self._promp.weights(t.copy(), y)) for t, y in pairs]
        self._promp.imitate([t.copy() for t in times], curves)
        self._noise = np.diag(np.maximum(np.square(np.concatenate(left)).mean(axis=0), self._promp.variance))

    def _moments(self, x: Floats) -> tuple[Floats, Floats]:
        d = self._promp.n_dims
        means, covariances = [], []
        for part in np.array_split(x[:, 0].clip(0.0, 1.0), -(-len(x) // 50)):  # it has no time beyond the end
            time = np.append(part, 1.0)  # it divides times by the last
            means.append(self._promp.mean_trajectory(time.copy())[:-1])
            steps = np.arange(len(part))
            covariance = self._promp.cov_trajectory(time.copy()).reshape(d, len(time), d, len(time))
            covariances.append(covariance[:, steps, :, steps])
        return np.concatenate(means), np.concatenate(covariances) + self._noise


class HetGP(Peer):
    """hetgpy's mleHetGP, one for each output, as independent outputs: the covariance is diagonal."""

    def _fit(self, x: Floats, y: Floats, groups: Groups | None) -> None:
        from hetgpy import hetGP

        self._models = []
        for column in y.T:
            model = hetGP()
            with redirect_stdout(StringIO()):  # it prints where it takes the homoscedastic model
                model.mle(x, column.copy(), covtype="Matern5_2")
            self._models.append(model)

    def _moments(self, x: Floats) -> tuple[Floats, Floats]:
        predictions = [model.predict(x) for model in self._models]
        mean = np.column_stack([prediction["mean"] for prediction in predictions])
        variance = np.column_stack([prediction["sd2"] + prediction["nugs"] for prediction in predictions])
        return mean, variance[:, :, np.newaxis] * np.eye(mean.shape[1])
