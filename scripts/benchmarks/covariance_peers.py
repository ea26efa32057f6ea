"""Contenders of covariance.py behind one small interface, and those that need no library for the covariance.

A peer sees inputs scaled to 0..1 and outputs to unit variance. ``predict`` gives the mean and covariance of its
predictive density, ``log_likelihood`` its log density, a normal one unless it says otherwise.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.special import gammaln, logsumexp
from sklearn.covariance import ledoit_wolf
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

Floats = NDArray[np.float64]
Groups = NDArray[np.intp]

N_BINS = 25
_BANDWIDTHS = tuple(float(h) for h in np.geomspace(0.005, 0.6, 11))
_FLOOR = 1e-8  # least variance, of outputs of unit variance


class CannotError(Exception):
    """The method is not made for such data; the message says why."""


class Peer(ABC):
    """Scales the data, and rescales what was learned."""

    gaussian = True
    """Whether the predictive density is the normal of ``predict``."""

    def fit(self, X: Floats, y: Floats, groups: Groups | None = None) -> Self:
        """Learn from rows X (n, e), y (n, d); ``groups`` (n,) tells demonstrations apart."""
        self._x_low, self._x_range = X.min(axis=0), np.ptp(X, axis=0)
        self._y_mean, spread = y.mean(axis=0), y.std(axis=0)
        self._y_scale = np.where(spread > 0, spread, 1.0)
        self._fit(self._inputs(X), (y - self._y_mean) / self._y_scale, groups)
        return self

    def predict(self, X: Floats) -> tuple[Floats, Floats]:
        """Mean (m, d) and covariance (m, d, d) of a new row of y."""
        mean, covariance = self._moments(self._inputs(X))
        covariance = covariance * np.multiply.outer(self._y_scale, self._y_scale)
        return self._y_mean + self._y_scale * mean, 0.5 * (covariance + covariance.mT)

    def log_likelihood(self, X: Floats, y: Floats) -> Floats:
        """Log density of each row of y, in nats."""
        density = self._log_density(self._inputs(X), (y - self._y_mean) / self._y_scale)
        return density - np.log(self._y_scale).sum()

    @abstractmethod
    def _fit(self, x: Floats, y: Floats, groups: Groups | None) -> None: ...

    @abstractmethod
    def _moments(self, x: Floats) -> tuple[Floats, Floats]: ...

    def _log_density(self, x: Floats, y: Floats) -> Floats:
        mean, covariance = self._moments(x)
        return log_normal(y - mean, covariance)

    def _inputs(self, X: Floats) -> Floats:
        return (X - self._x_low) / self._x_range


def log_normal(residual: Floats, covariance: Floats) -> Floats:
    """Log density of a normal of mean zero: (..., d) and (..., d, d)."""
    factor = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(factor, residual[..., np.newaxis])[..., 0]
    log_det = np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(-1)
    return -0.5 * np.square(whitened).sum(-1) - log_det - 0.5 * residual.shape[-1] * math.log(2 * math.pi)


def distinct(x: Floats) -> tuple[Floats, NDArray[np.intp], NDArray[np.intp]]:
    """Distinct rows, the number of each row among them, and their counts."""
    sites, index, counts = np.unique(x, axis=0, return_inverse=True, return_counts=True)
    return sites, index.reshape(-1), counts


def repeats(x: Floats) -> bool:
    """Whether every row is there at least twice."""
    return bool(distinct(x)[2].min() > 1)


def interpolated(sites: Floats, means: Floats) -> Callable[[Floats], Floats]:
    """Cubic spline along one input; constant beyond the ends."""
    spline = make_interp_spline(sites[:, 0], means, k=min(3, len(sites) - 1))
    return lambda x: spline(x[:, 0].clip(sites[0, 0], sites[-1, 0]))


def site_sums(index: NDArray[np.intp], values: Floats, n_sites: int) -> Floats:
    """Sum of rows of ``values`` over each site."""
    sums = np.zeros((n_sites, *values.shape[1:]))
    np.add.at(sums, index, values)
    return sums


def scalar_gp(n_features: int, n_restarts: int = 2) -> GaussianProcessRegressor:
    """One output: squared exponential and noise by marginal likelihood, no length scale below 2 % of the range."""
    kernel = ConstantKernel(1.0, (1e-3, 1e3)) * RBF(np.full(n_features, 0.2), (0.02, 10.0))
    return GaussianProcessRegressor(
        kernel + WhiteKernel(0.1, (1e-8, 1e1)), normalize_y=True, n_restarts_optimizer=n_restarts, random_state=0
    )


class GPMean:
    """scikit-learn's Gaussian process on the mean at each distinct input, one for each output."""

    def fit(self, x: Floats, y: Floats) -> Self:
        """Fit on scaled rows."""
        sites, index, counts = distinct(x)
        means = site_sums(index, y, len(sites)) / counts[:, np.newaxis]
        self.processes = [scalar_gp(x.shape[1]).fit(sites, column) for column in means.T]
        return self

    def predict(self, x: Floats) -> Floats:
        """Means (m, d)."""
        return np.column_stack([process.predict(x) for process in self.processes])

    def degrees_of_freedom(self) -> float:
        """Trace of the smoothing matrix, the mean over outputs."""
        traces = []
        for process in self.processes:
            factor, signal = process.L_, process.kernel_.k1(process.X_train_)
            traces.append(np.trace(np.linalg.solve(factor.T, np.linalg.solve(factor, signal))))
        return float(np.mean(traces))


class ConstantCovariance(Peer):
    """One covariance around a Gaussian process mean, divided by the rows less the mean's degrees of freedom."""

    def _fit(self, x: Floats, y: Floats, groups: Groups | None) -> None:
        self._mean = GPMean().fit(x, y)
        residual = y - self._mean.predict(x)
        freedom = max(len(y) - self._mean.degrees_of_freedom(), 1.0)
        self._covariance = residual.T @ residual / freedom + _FLOOR * np.eye(y.shape[1])

    def _moments(self, x: Floats) -> tuple[Floats, Floats]:
        mean = self._mean.predict(x)
        return mean, np.broadcast_to(self._covariance, (len(mean), *self._covariance.shape))


class KernelSmoother(Peer):
    """Nadaraya-Watson mean and covariance, each with the bandwidth that foretells left-out demonstrations best.

    Residuals are those to the mean without their own demonstration (without groups: their own row), and both
    bandwidths together maximize the log-likelihood that the covariance without it gives them.

    Parameters
    ----------
    bandwidths : sequence of float
        Standard deviations of the Gaussian kernel to choose from, in ranges of the inputs.
    shrinkage : float
        Share of the pooled covariance.
    """

    def __init__(self, bandwidths: Any = _BANDWIDTHS, shrinkage: float = 0.01) -> None:
        self.bandwidths = bandwidths
        self.shrinkage = shrinkage

    def _fit(self, x: Floats, y: Floats, groups: Groups | None) -> None:
        self._sites, self._index, self._counts = distinct(x)
        labels = np.arange(len(x)) if groups is None else groups
        order = np.argsort(labels, kind="stable")
        self._rows = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
        if len(self._rows) < 2:
            raise CannotError("one demonstration: there is none to leave out")
        weights = {h: np.exp(self._exponent(self._sites, h)) for h in self.bandwidths}
        best = -np.inf
        for mean_bandwidth, mean_weights in weights.items():
            residual = y - self._without_own(mean_weights, y)
            products = residual[:, :, np.newaxis] * residual[:, np.newaxis]
            pooled = products.mean(axis=0) + _FLOOR * np.eye(y.shape[1])
            for bandwidth, own in weights.items():
                covariance = self._shrunk(self._without_own(own, products), pooled)
                score = log_normal(residual, covariance).mean()
                if score > best:
                    best, self.bandwidths_ = score, (mean_bandwidth, bandwidth)
                    self._pooled, self._products = pooled, site_sums(self._index, products, len(self._sites))
        sums = site_sums(self._index, y, len(self._sites))
        self._mean = lambda at: self._smooth(at, self.bandwidths_[0], sums)
        if repeats(x) and x.shape[1] == 1:  # no left-out row sees the steps of a narrow kernel between inputs
            self._mean = interpolated(self._sites, self._mean(self._sites))

    def _moments(self, x: Floats) -> tuple[Floats, Floats]:
        return self._mean(x), self._shrunk(self._smooth(x, self.bandwidths_[1], self._products), self._pooled)

    def _smooth(self, x: Floats, bandwidth: float, sums: Floats) -> Floats:
        exponent = self._exponent(x, bandwidth) + np.log(self._counts)
        weights = np.exp(exponent - logsumexp(exponent, axis=1, keepdims=True))  # far away: the nearest input
        return np.einsum("mt,t...->m...", weights / self._counts, sums)

    def _without_own(self, weights: Floats, values: Floats) -> Floats:
        """Weighted mean at each row over the rows of other demonstrations; over all rows where none is near."""
        flat = np.column_stack([np.ones(len(values)), values.reshape(len(values), -1)])
        total = weights @ site_sums(self._index, flat, len(self._sites))
        smoothed = total[self._index]
        for rows in self._rows:
            sites = self._index[rows]
            smoothed[rows] -= weights[np.ix_(sites, sites)] @ flat[rows]
        least = 1e-12
        return ((smoothed[:, 1:] + least * flat[:, 1:].mean(axis=0)) / (smoothed[:, :1].clip(0) + least)).reshape(
            values.shape
        )

    def _exponent(self, x: Floats, bandwidth: float) -> Floats:
        apart = x[:, np.newaxis] - self._sites
        return -0.5 * np.square(apart / bandwidth).sum(axis=-1)

    def _shrunk(self, covariance: Floats, pooled: Floats) -> Floats:
        return (1.0 - self.shrinkage) * covariance + self.shrinkage * pooled


class Moments(NamedTuple):
    """Empirical moments at distinct inputs, or in bins of the inputs."""

    sites: Floats
    mean: Floats
    covariance: Floats
    counts: Floats


def empirical_moments(x: Floats, y: Floats, residual: Floats) -> Moments:
    """Of y at each distinct input where all repeat; else of the residual in about 25 bins of 2d + 2 rows or more."""
    sites, index, counts = distinct(x)
    binned = not repeats(x)
    if binned:
        n_bins = max(1, min(N_BINS, len(x) // (2 * y.shape[1] + 2)))
        parts = _bins(x, np.arange(len(x)), max(1, int(n_bins ** (1 / x.shape[1]) + 1e-9)))
        sites = np.stack([x[part].mean(axis=0) for part in parts])
    else:
        parts = np.split(np.argsort(index, kind="stable"), np.cumsum(counts)[:-1])
    values = residual if binned else y
    return Moments(
        sites,
        np.stack([y[part].mean(axis=0) for part in parts]),
        np.stack([_covariance(values[part]) for part in parts]),
        np.array([float(len(part)) for part in parts]),
    )


def _bins(x: Floats, rows: NDArray[np.intp], n_parts: int, feature: int = 0) -> list[NDArray[np.intp]]:
    """Rows in bins of equal numbers along each input in turn."""
    if feature == x.shape[1]:
        return [rows]
    parts = np.array_split(rows[np.argsort(x[rows, feature], kind="stable")], n_parts)
    return [part for rows in parts for part in _bins(x, rows, n_parts, feature + 1)]


def _covariance(rows: Floats) -> Floats:
    """Divisor n - 1; Ledoit and Wolf's where it would be singular."""
    n, d = rows.shape
    covariance = np.atleast_2d(np.cov(rows.T)) if n > d else ledoit_wolf(rows)[0]
    return covariance + _FLOOR * np.eye(d)


class StudentReference(Peer):
    """Ten lines: scatter shrunk to the pooled covariance as an inverse Wishart would, Student-t, times 1 + 1/K."""

    gaussian = False
    _prior = 4.0

    def _fit(self, x: Floats, y: Floats, groups: Groups | None) -> None:
        process = None if repeats(x) else GPMean().fit(x, y)
        moments = empirical_moments(x, y, y if process is None else y - process.predict(x))
        free = moments.counts - 1.0
        scatter = free[:, np.newaxis, np.newaxis] * moments.covariance
        self._sites, pooled = moments.sites, scatter.sum(axis=0) / free.sum()
        divisor = self._prior + free
        covariance = (self._prior * pooled + scatter) / divisor[:, np.newaxis, np.newaxis]
        self._covariance = covariance * (1.0 + 1.0 / moments.counts)[:, np.newaxis, np.newaxis]
        self._df = self._prior + moments.counts + 1.0
        if process is None:
            self._mean = interpolated(self._sites, moments.mean)
        else:
            self._mean = process.predict

    def _moments(self, x: Floats) -> tuple[Floats, Floats]:
        return self._mean(x), np.einsum("mt,tij->mij", self._shares(x), self._covariance)

    def _log_density(self, x: Floats, y: Floats) -> Floats:
        mean, covariance = self._moments(x)
        df, d = self._shares(x) @ self._df, y.shape[1]
        factor = np.linalg.cholesky(covariance * ((df - 2.0) / df)[:, np.newaxis, np.newaxis])
        distance = np.square(np.linalg.solve(factor, (y - mean)[..., np.newaxis])[..., 0]).sum(-1)
        log_det = np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(-1)
        constant = gammaln(0.5 * (df + d)) - gammaln(0.5 * df) - 0.5 * d * np.log(df * math.pi)
        return constant - log_det - 0.5 * (df + d) * np.log1p(distance / df)

    def _shares(self, x: Floats) -> Floats:
        """Weights of the sites: linear interpolation along one input, the nearest site of several."""
        eye = np.eye(len(self._sites))
        if x.shape[1] == 1:
            return np.column_stack([np.interp(x[:, 0], self._sites[:, 0], row) for row in eye])
        return eye[np.square(x[:, np.newaxis] - self._sites).sum(axis=-1).argmin(axis=1)]
