"""Kernelized movement primitives (KMP): kernel regression through a reference of means and covariances."""

from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.linalg import block_diag, solve_triangular
from sklearn.base import clone

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.demonstrations import Demonstration
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.estimators.door import Standardization
from torch_pbd.estimators.mixture import GMMBaseline
from torch_pbd.estimators.validation import fit_with_groups
from torch_pbd.files.memory import require_much
from torch_pbd.linalg import safe_cholesky
from torch_pbd.movement.base import MovementRegressor
from torch_pbd.movement.joint import Conditioned, JointNormal
from torch_pbd.movement.law import as_rows, check_arrays, check_regressor

_ARRAYS = ("reference.time", "reference.mean", "reference.covariance", "range", "shift", "scale")  # in model files
_BETWEEN = "the covariance between rows, of which lambda_cov or nugget is too small,"
_NOTHING = 1e6  # variance of an output of which nothing is said, of standardized outputs
_LEAST = 1e-6  # least variance in the reference, of standardized outputs; the paper's of a point without noise


@dataclass(eq=False, repr=False)
class KMPBaseline(MovementRegressor):
    """Kernelized movement primitive through the reference of a Gaussian mixture regression.

    With the reference's means mu_i and covariances S_i at N times, block diagonal S, the mean at t is
    ``k_t (K + lambda_mean S)^-1 mu`` and the covariance between t and t' is
    ``N / lambda_cov (k(t, t') I - k_t (K + lambda_cov S)^-1 k_t')``, of standardized outputs, since the kernel's
    variance is 1 and the mean returns to 0 far from the reference. Via points are added to the reference, or replace
    its points that are nearer than half their spacing, as in the reference paper; this is not the law of a conditioned
    movement, and passes them nearly.

    Parameters
    ----------
    regressor : covariance regressor or None, default=None
        Model of the reference, cloned into ``regressor_``; None is ``GMMBaseline()``.
    n_reference : int, default=100
        Number of times in the reference.
    length_scale : float, default=0.144
        Length scale of the squared exponential kernel, in ranges of X; the paper's ``kh = 6`` in 2 s.
    lambda_mean, lambda_cov : float, default=1.0 and 60.0
        Regularization of the mean and of the covariance; defaults are the paper's.
    nugget : float, default=1e-4
        Variance of an independent part of each step, relative to the outputs' variance; without it a movement of a
        squared exponential kernel has no density.
    random_state : int, RandomState instance or None, default=0
        Not used, since the regressor has its own seed.

    Attributes
    ----------
    regressor_ : covariance regressor
    df_ : float
        Degrees of freedom; infinite, as the law is normal.
    n_features_in_, n_outputs_ : int

    References
    ----------
    Huang, Rozo, Silverio, Caldwell, "Kernelized movement primitives", International Journal of Robotics Research 38,
    2019.
    """

    regressor: CovarianceRegressor | None = None
    _: KW_ONLY
    n_reference: int = 100
    length_scale: float = 0.144
    lambda_mean: float = 1.0
    lambda_cov: float = 60.0
    nugget: float = 1e-4
    random_state: Any = 0

    _learned: ClassVar[Any] = {}

    def _check_parameters(self) -> None:
        checks.count(self.n_reference, "n_reference", least=2)
        for name in ("length_scale", "lambda_mean", "lambda_cov", "nugget"):
            checks.number(getattr(self, name), name, above=0.0)
        checks.seed(self.random_state)
        check_regressor(self.regressor, "predict")

    def _fit(self, recordings: list[Demonstration]) -> None:
        X, y, groups = as_rows(recordings)
        regressor = GMMBaseline() if self.regressor is None else clone(self.regressor)
        self.regressor_ = fit_with_groups(regressor, X, y, groups)
        scaling = Standardization.fit(X, y)
        self._shift, self._scale = shift, scale = scaling.y_shift, scaling.y_scale
        time = np.linspace(X.min(), X.max(), int(self.n_reference))
        mean, covariance = self.regressor_.predict(time[:, np.newaxis], return_cov=True)
        # An output that is constant, or a copy of another, would leave no factor of K + lambda S.
        values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
        covariance = vectors * values.clip(_LEAST)[:, np.newaxis] @ vectors.transpose(0, 2, 1)
        self._reference = time, (mean - shift) / scale, covariance

    def _arrays(self) -> dict[str, Floats]:
        arrays = *self._reference, np.array(self._range), self._shift, self._scale
        return dict(zip(_ARRAYS, arrays, strict=True))

    def _restore(self, arrays: dict[str, Floats]) -> None:
        n, d = len(np.atleast_1d(arrays["reference.time"])), self.n_outputs_
        check_arrays(arrays, dict(zip(_ARRAYS, [(n,), (n, d), (n, d, d), (2,), (d,), (d,)], strict=True)))
        time, mean, covariance, (low, width), self._shift, self._scale = (arrays[name] for name in _ARRAYS)
        checks.require(self._scale > 0.0, self._scale, "scale", "above 0")
        checks.semidefinite(covariance, "reference.covariance", definite=True)
        self._reference = time, mean, covariance
        self._range = float(low), checks.number(width, "the range of X", above=0.0)

    def _prior(self, time: Floats) -> JointNormal:
        n, d = len(time), self.n_outputs_
        what = f"the covariance between {n} rows and {d} outputs"
        require_much(4 * 8.0 * (n * d) ** 2, what=what, remedy="Ask for fewer rows.")
        mean, whitened, level = self._through_reference(time)
        explained = whitened.transpose(0, 2, 1).reshape(n * d, whitened.shape[1])
        # Time by time, all outputs of each: the kernel of the times acts on each output separately.
        gram = np.kron(self._kernel(time, time), np.eye(d))
        # With half of the nugget it has a Cholesky factor, at a fifth of the cost of its eigenvectors.
        smooth = level * (gram - explained @ explained.T) + 0.5 * self.nugget * np.eye(n * d)
        root = safe_cholesky(torch.from_numpy(smooth), name=_BETWEEN).numpy()
        root = root.reshape(n, d, n * d) * self._scale[:, np.newaxis]
        own = np.sqrt(0.5 * self.nugget) * self._scale
        return JointNormal.with_noise(*map(torch.from_numpy, (time, mean, root, own)))

    def _rows(self, time: Floats) -> tuple[Floats, Floats]:
        # Each row alone: the covariance between rows would cost the cube of their number to factorize.
        mean, whitened, level = self._through_reference(time)
        explained = whitened.transpose(0, 2, 1) @ whitened
        own = (level + self.nugget) * np.eye(self.n_outputs_) - 0.5 * level * (explained + explained.transpose(0, 2, 1))
        return mean, np.outer(self._scale, self._scale) * own

    def _through_reference(self, time: Floats) -> tuple[Floats, Floats, float]:
        """Mean (n, d), unitless ``V_t = L^-1 k_t'`` (n, N d, d), ``L L' = K + lambda_cov S``; ``N / lambda_cov``.

        This N is of the fit: via points make nothing elsewhere more variable.
        """
        reference, means, covariances = self._with_via_points()
        n_reference, d = means.shape
        require_much(
            4 * 8.0 * (n_reference * d) ** 2, what=f"{n_reference} points of {d} outputs", remedy="Give fewer."
        )
        gram, noise = np.kron(self._kernel(reference, reference), np.eye(d)), block_diag(*covariances)
        weights = np.linalg.solve(gram + self.lambda_mean * noise, means.ravel()).reshape(n_reference, d)
        root = np.linalg.cholesky(gram + self.lambda_cov * noise)
        inverse = solve_triangular(root, np.eye(len(root)), lower=True).reshape(-1, n_reference, d)
        cross = self._kernel(time, reference)
        mean = self._shift + self._scale * (cross @ weights)
        return mean, np.tensordot(cross, inverse, axes=(1, 1)), len(self._reference[0]) / self.lambda_cov

    def _kernel(self, time: Floats, other: Floats) -> Floats:
        difference = self._scaled(time)[:, np.newaxis] - self._scaled(other)
        return np.asarray(np.exp(-0.5 * np.square(difference / self.length_scale)))

    def _with_via_points(self) -> tuple[Floats, Floats, Floats]:
        """Standardized reference with via points, in place of times that are near; outputs that are not given stay."""
        if not len(self._known.time):
            return self._reference
        axes, shift = self._observed_axes * self._scale, self._observed_axes @ self._shift
        reference, means, covariances = self._reference
        at, value, noise = self._known
        given, distance = ~np.isnan(value), np.abs(at[:, np.newaxis] - reference)
        nearest = distance.argmin(axis=1)
        is_near = distance.min(axis=1) <= (0.5 + checks.ROUNDING) * (reference[1] - reference[0])
        taken = np.zeros_like(means, dtype=bool)
        np.logical_or.at(taken, nearest[is_near], given[is_near])
        # An output that is given takes the place of the reference's; what is not said has a variance without bound.
        unit = np.square(axes).sum(axis=1)
        covariances = axes @ covariances @ axes.T * ~taken[:, np.newaxis] * ~taken[:, :, np.newaxis]
        covariances += (_NOTHING * unit * taken)[:, np.newaxis] * np.eye(len(unit))
        own = np.where(given, np.maximum(np.square(noise), _LEAST * unit), _NOTHING * unit)[:, np.newaxis] * np.eye(
            len(unit)
        )
        back, kept = np.linalg.inv(axes), ~taken.all(axis=1)
        means = np.concatenate([(means @ axes.T)[kept], np.where(given, value - shift, 0.0)])
        covariances = back @ np.concatenate([covariances[kept], own]) @ back.T
        return np.concatenate([reference[kept], at]), means @ back.T, covariances

    def _conditioned(self, time: Floats) -> tuple[Conditioned, torch.Tensor]:
        # Via points are in the reference, so nothing is conditioned on.
        union, rows, none = self._union(time, time[:0])
        nothing = torch.empty(0, self.n_outputs_, dtype=torch.float64)
        steps, axes = torch.from_numpy(none), torch.from_numpy(self._observed_axes)
        return Conditioned(self._prior(union), steps, nothing, nothing, axes), torch.from_numpy(rows)
