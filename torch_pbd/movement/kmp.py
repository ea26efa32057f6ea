"""Kernelized movement primitives (KMP): a kernel through a reference of means and covariances."""

from typing import Any, ClassVar

import numpy as np
import torch
from scipy.linalg import block_diag
from sklearn.base import clone

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.estimators.demonstrations import fit_with_groups
from torch_pbd.estimators.mixture import GMMBaseline
from torch_pbd.files.memory import require_much
from torch_pbd.movement.base import MovementRegressor
from torch_pbd.movement.joint import Conditioned, JointNormal, Observed
from torch_pbd.movement.recordings import Known, Recording, as_rows


class KMPBaseline(MovementRegressor):
    """Kernelized movement primitive through the reference of a Gaussian mixture regression.

    With the reference's means mu_i and covariances S_i at N times, block diagonal S, the mean at t is
    ``k_t (K + lambda_mean S)^-1 mu`` and the covariance between t and t' is
    ``N / lambda_cov (k(t, t') I - k_t (K + lambda_cov S)^-1 k_t')``. Via points are put into the reference, in place
    of what is nearest to them, as its authors do: the law is not that of a conditioned movement.

    Parameters
    ----------
    regressor : covariance regressor or None, default=None
        Cloned into ``regressor_``; None is ``GMMBaseline()``.
    n_reference : int, default=100
        Times of the reference.
    length_scale : float, default=0.144
        Of the squared exponential kernel, in ranges of X; the authors' ``kh = 6`` in 2 s.
    lambda_mean, lambda_cov : float, default=1.0 and 60.0
        Regularizations of the mean and the covariance, the authors' values.
    nugget : float, default=1e-4
        Variance of an independent part of each step, relative to the outputs'; without one a movement of a squared
        exponential kernel has no density.
    random_state : int, RandomState instance or None, default=0
        Not used: the seed is the regressor's.

    Attributes
    ----------
    regressor_ : covariance regressor
    df_ : float
        Infinite: the law is normal.
    n_features_in_, n_outputs_ : int

    References
    ----------
    Huang, Rozo, Silverio, Caldwell, "Kernelized movement primitives", International Journal of Robotics Research 38,
    2019.
    """

    df_ = float("inf")

    _learned: ClassVar[Any] = {}

    def __init__(
        self,
        regressor: CovarianceRegressor | None = None,
        *,
        n_reference: int = 100,
        length_scale: float = 0.144,
        lambda_mean: float = 1.0,
        lambda_cov: float = 60.0,
        nugget: float = 1e-4,
        random_state: Any = 0,
    ) -> None:
        self.regressor = regressor
        self.n_reference = n_reference
        self.length_scale = length_scale
        self.lambda_mean = lambda_mean
        self.lambda_cov = lambda_cov
        self.nugget = nugget
        self.random_state = random_state

    def _check_parameters(self) -> None:
        checks.count(self.n_reference, "n_reference", least=2)
        for name in ("length_scale", "lambda_mean", "lambda_cov", "nugget"):
            checks.number(getattr(self, name), name, above=0.0)
        checks.seed(self.random_state)

    def _fit(self, recordings: list[Recording]) -> None:
        X, y, groups = as_rows(recordings)
        regressor = GMMBaseline() if self.regressor is None else clone(self.regressor)
        self.regressor_ = fit_with_groups(regressor, X, y, groups)
        self._range = float(X.min()), float(np.ptp(X))
        self._scale = y.std(axis=0)
        time = np.linspace(X.min(), X.max(), int(self.n_reference))
        self._reference = time, *self.regressor_.predict(time[:, np.newaxis], return_cov=True)

    def _arrays(self) -> dict[str, Floats]:
        names = ("time", "mean", "covariance")
        arrays = {f"reference.{name}": part for name, part in zip(names, self._reference, strict=True)}
        return arrays | {"range": np.array(self._range), "deviation": self._scale}

    def _restore(self, arrays: dict[str, Floats]) -> None:
        n, d = len(np.atleast_1d(arrays["reference.time"])), self.n_outputs_
        shapes: dict[str, tuple[int | str, ...]] = {
            "reference.time": (n,), "reference.mean": (n, d), "reference.covariance": (n, d, d), "range": (2,),
            "deviation": (d,),
        }  # fmt: skip
        *reference, span, self._scale = self._restored(arrays, shapes).values()
        checks.semidefinite(reference[2], "reference.covariance", definite=True)
        self._reference = reference[0], reference[1], reference[2]
        self._range = float(span[0]), checks.number(float(span[1]), "the range of X", above=0.0)

    def _prior(self, time: Floats) -> JointNormal:
        n, d = len(time), self.n_outputs_
        reference, means, covariances = self._reference if self._known is None else self._with_via_points(self._known)
        n_reference, unit = len(reference), np.eye(d)
        require_much(
            4 * 8.0 * ((n * d) ** 2 + (n_reference * d) ** 2),
            what=f"the covariance between {n} rows and {d} outputs",
            remedy="Ask for fewer rows.",
        )
        # All outputs of one time after another: the kernel of the times, for each output by itself.
        gram, cross = (np.kron(self._kernel(self._scaled(other), reference), unit) for other in (reference, time))
        noise = block_diag(*covariances)
        mean = cross @ np.linalg.solve(gram + self.lambda_mean * noise, means.ravel())
        explained = cross @ np.linalg.solve(gram + self.lambda_cov * noise, cross.T)
        covariance = (np.kron(self._kernel(self._scaled(time), time), unit) - explained) * n_reference / self.lambda_cov
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        root = (vectors * np.sqrt(values.clip(0.0))).reshape(n, d, -1)
        # The nugget is relative to the outputs, which so are the units of the structured law.
        scale = np.sqrt(self.nugget) * np.where(self._scale > 0.0, self._scale, 1.0)
        loadings = torch.from_numpy(root / scale[:, np.newaxis])
        factor = torch.from_numpy(np.diag(scale)).expand(n, d, d)
        return JointNormal(
            torch.from_numpy(mean.reshape(n, d)), factor, torch.eye(n).double(), loadings, loadings[:, :, :0]
        )

    def _kernel(self, scaled: Floats, time: Floats) -> Floats:
        difference = scaled[:, np.newaxis] - self._scaled(time)
        return np.asarray(np.exp(-0.5 * np.square(difference / self.length_scale)))

    def _with_via_points(self, known: Known) -> tuple[Floats, Floats, Floats]:
        """Reference with what is known in place of its nearest times; outputs that are not given stay."""
        time, means, covariances = (part.copy() for part in self._reference)
        least = np.square(1e-3 * self._scale)  # a point without noise, of whose variance the authors take 1e-6
        for at, value, noise in zip(known.time, known.value, known.noise, strict=True):
            nearest = int(np.abs(self._reference[0] - at).argmin())
            given = ~np.isnan(value)
            time[nearest] = at
            means[nearest, given] = value[given]
            covariances[nearest][given] = covariances[nearest][:, given] = 0.0
            covariances[nearest][given, given] = np.maximum(np.square(noise), least)[given]
        return time, means, covariances

    def _conditioned(self, time: Floats) -> tuple[Conditioned, torch.Tensor]:
        """Law through the reference with the via points, without conditioning on them."""
        union, rows, _ = self._union(time, None)
        empty = torch.empty(0, dtype=torch.int64), torch.empty(0, self.n_outputs_).double()
        nothing = Observed(*empty, empty[0], empty[0], empty[1][:, 0], empty[1][:, 0])
        return Conditioned(self._prior(union), nothing), torch.from_numpy(rows)
