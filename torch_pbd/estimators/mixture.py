"""Gaussian mixture regression, the baseline of the paper."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sklearn.cluster import KMeans
from sklearn.neighbors import NearestNeighbors

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.estimators.base import CovarianceRegressor, Fit
from torch_pbd.estimators.door import Integers, Standardization, distinct_rows, or_magnitude
from torch_pbd.estimators.validation import warn_if_few
from torch_pbd.exceptions import DataRankWarning
from torch_pbd.files.memory import require_much
from torch_pbd.models.mixture import GaussianMixture, expectation_maximization, refine

# Least residual scale of an output, as a share of its whole spread.
_SMALLEST_RESIDUAL = 1e-6
# Decimals kept of rows with unit variance: k-means works on squared distances, and float64 has 16 digits.
_DECIMALS = 7


@dataclass(kw_only=True, eq=False, repr=False)
class GMMBaseline(CovarianceRegressor):
    """Gaussian mixture over [x, y] and Gaussian mixture regression.

    The mean and covariance of y given x are the moments of the mixture's conditional density, so the covariance
    includes the spread between components. Far from data there is no prior to return to: the nearest component
    decides, and the mean continues in a straight line.

    Parameters
    ----------
    n_components : int, default=5
    solver : {"em", "lbfgs"}, default="em"
        "em" runs expectation maximization from k-means; "lbfgs" then adds L-BFGS on the likelihood.
    reg_covar : float, default=1e-6
        Regularization of every component's variances, relative to the variance of each input and to the variance
        of each output between neighbouring inputs. An absolute value would swamp small variances.
    max_iter : int, default=1000
    tol : float, default=1e-7
        Smallest rise of the mean log-likelihood, in nats per row, that continues the fit.
    n_restarts : int, default=2
        Extra k-means starts after the first; the likeliest mixture is kept.
    random_state : int, RandomState instance or None, default=0
        Seed of k-means.
    {common}
    loss_ : float
        Negative mean log-likelihood of the standardized rows [x, y], in nats.
    jitter_ : float
        ``reg_covar``.

    Notes
    -----
    ``predict_uncertainty`` takes ``type1`` from the density of the inputs, since a mixture's variance does not
    grow where data are missing (Section IV-C); ``type2`` is the whole covariance.

    References
    ----------
    Calinon, "A tutorial on task-parameterized movement learning and retrieval", Intelligent Service
    Robotics 9, 2016.
    """

    _core_class = GaussianMixture

    n_components: int = 5
    solver: str = "em"
    reg_covar: float = 1e-6
    max_iter: int = 1000
    tol: float = 1e-7
    n_restarts: int = 2
    random_state: Any = 0
    device: str | None = None
    verbose: int = 0

    def _check_parameters(self) -> None:
        super()._check_parameters()
        checks.count(self.n_components, "n_components", least=1)
        checks.choice(self.solver, "solver", ("em", "lbfgs"))
        checks.number(self.reg_covar, "reg_covar", above=0.0)

    def _fit(self, X: Floats, y: Floats, *, groups: Integers | None, order: Integers) -> Fit:
        # Rows [x, y] with unit variance, told apart where k-means can.
        joint = np.hstack([X, y])
        above = joint - joint[0]
        points = np.round((above - above.mean(axis=0)) / or_magnitude(joint.std(axis=0), joint), _DECIMALS)
        n_distinct, n_components = len(distinct_rows(points)[0]), int(self.n_components)
        if n_distinct < self.n_components:
            raise ValueError(
                f"n_components is {self.n_components}, must not be above the number of distinct samples, which is "
                f"{n_distinct} of n_samples = {len(X)}."
            )
        require_much(
            # Measured: responsibilities, and the rows centred at and whitened by each component.
            8.0 * n_components * (len(X) * (3 * points.shape[1] + 4) + n_components),
            what=f"n_components={self.n_components} for {len(X)} rows",
            remedy="Take fewer components.",
        )
        if not (np.ptp(y, axis=0) > 0).any():
            checks.warn(
                "y is constant: its covariance is zero, and the smallest that can be told from it is used.",
                DataRankWarning,
            )
        warn_if_few(n_distinct, y.shape[1], groups, rows="distinct rows", decides="reg_covar")
        scaling = _by_residual(X, y)
        data = self._door(np.hstack([scaling.inputs(X, exact=True), scaling.outputs(y, exact=True)]))
        generator = checks.seed(self.random_state)
        limits: dict[str, Any] = {"reg_covar": self.reg_covar, "tol": self.tol, "max_iter": self.max_iter}
        runs = []
        for _ in range(1 + self.n_restarts):
            kmeans = KMeans(n_components, n_init=1, random_state=generator.randint(2**31 - 1)).fit(points)
            responsibilities = self._door(np.eye(n_components)[kmeans.labels_])
            runs.append(expectation_maximization(data, responsibilities, n_features=X.shape[1], **limits))
        mixture, report = min(runs, key=lambda run: run[1].loss)
        if self.solver == "lbfgs":
            report = refine(mixture, data, callback=self._progress(), **limits)
        return mixture, scaling, report, float(self.reg_covar)


def _by_residual(X: Floats, y: Floats) -> Standardization:
    """Standardization of inputs by their standard deviation, and of outputs by that between neighbouring inputs.

    A regularization of the joint covariance is then relative to the size of the covariance of y given x,
    and not to how far y moves.
    """
    whole = Standardization.fit(X, y)
    x_scale = or_magnitude(X.std(axis=0), X)
    # Standardized, so that neighbours at equal distances are equally far in all units.
    scaled = replace(whole, x_scale=x_scale).inputs(X)
    # Neighbour at the same or the nearest input: the row itself may come first or second among equals.
    neighbour = NearestNeighbors(n_neighbors=2).fit(scaled).kneighbors(scaled, return_distance=False)
    other = np.where(neighbour[:, 0] == np.arange(len(X)), neighbour[:, 1], neighbour[:, 0])
    residual = np.sqrt(0.5 * np.square((y - y[other]) / whole.y_scale).mean(axis=0))
    y_scale = whole.y_scale * np.clip(residual, _SMALLEST_RESIDUAL, 1.0)
    return replace(whole, x_scale=x_scale, y_scale=y_scale)
