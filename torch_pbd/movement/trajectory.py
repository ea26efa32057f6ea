"""The joint law of a demonstration, on top of any covariance regressor."""

from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy.typing import ArrayLike
from sklearn.base import clone
from torch import Tensor, nn

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.demonstrations import Demonstration
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.estimators.heteroscedastic import HeteroscedasticGPRegressor
from torch_pbd.estimators.validation import fit_with_groups
from torch_pbd.kernels import KERNELS
from torch_pbd.linalg import safe_cholesky
from torch_pbd.movement.joint import JointNormal
from torch_pbd.movement.law import as_rows, check_arrays, check_regressor
from torch_pbd.movement.time_kernel import TimeKernel
from torch_pbd.movement.time_kernel_fit import FEWEST_DF, fit_weighted, smoothest_first
from torch_pbd.movement.timed import TimedMovement, n_grid_steps, sampled

_MOST_DF = 200.0  # of the joint law: above it is normal
# Ratio of a row's degrees of freedom to a movement's: only the few demonstrations show how unusual a whole one can be,
# while a row is also seen in its neighbours. 1, 1.5, 2, 3 and 4 were tried on half of the recorded sets.
_WHOLE = 2.0


class TrajectoryLaw(nn.Module):
    """Joint law of a movement, as a torch module: differentiable in the times.

    With marginals of mean m_t and covariance ``C_t = L_t L_t'``, L_t triangular with the outputs in ``order``, the
    correlation R_j of the time kernel of each in that order and the whitened residuals z_k of K demonstrations, the
    covariance is ``Sigma = A S A'`` with ``S = w blockdiag(R_1, R_2, ...) + (1 - w) / K sum_k z_k z_k'`` and
    ``A_t = L_t chol(S_tt)^-1``, so that its blocks ``Sigma_tt`` are the marginals' C_t.
    """

    x_shift: Tensor
    x_scale: Tensor
    order: Tensor

    def __init__(
        self, marginals: nn.Module | None, time_kernel: TimeKernel, order: Tensor, x_shift: float, x_scale: float
    ) -> None:
        super().__init__()
        self.marginals, self.time_kernel = marginals, time_kernel
        self.register_buffer("order", order)
        for name, value in (("x_shift", x_shift), ("x_scale", x_scale)):
            self.register_buffer(name, torch.tensor(value, dtype=torch.float64))
        self.requires_grad_(False)

    def forward(self, x: Float[Tensor, "n 1"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d n d"]]:
        """Joint mean and covariance at times that are all different."""
        if self.marginals is None:
            raise TypeError("module_ of a regressor that is no torch module has no marginals: use predict_joint.")
        law = self.joint(x[:, 0], *self.marginals.moments(x))  # type: ignore[operator]
        return law.mean, law.covariance()

    def joint(
        self, x: Float[Tensor, " n"], mean: Float[Tensor, "n d"], covariance: Float[Tensor, "n d d"]
    ) -> JointNormal:
        """Joint law at times that are all different, of these marginals."""
        time = (x - self.x_shift) / self.x_scale
        loadings = self._loadings(time)
        factor = self.factor(loadings, covariance)
        return JointNormal.prior(mean, factor, time, self._along, self.time_kernel.share, loadings)

    def _along(self, time: Float[Tensor, "*b n"], other: Float[Tensor, "*b m"]) -> Float[Tensor, "d *b n m"]:
        return self.time_kernel.share * self.time_kernel.correlation(time, other)

    def _loadings(self, time: Float[Tensor, " m"]) -> Float[Tensor, "m d k"]:
        """Demonstrations' own correlation at times in ranges of those of the fit."""
        kernel = self.time_kernel
        return ((1.0 - kernel.share) / len(kernel.residual)).sqrt() * kernel.loadings(time)

    def factor(self, loadings: Float[Tensor, "m d k"], covariance: Float[Tensor, "m d d"]) -> Float[Tensor, "m d d"]:
        """A of steps with these loadings: it divides by the factor of S_tt, so that blocks are the marginals C_t."""
        own = loadings @ loadings.mT + self.time_kernel.share * torch.eye(len(self.order)).to(loadings)
        root = root_in_order(covariance, self.order)
        return torch.linalg.solve_triangular(torch.linalg.cholesky(own), root, upper=False, left=False)

    def covariances(self, x: Float[Tensor, "b n"], covariance: Float[Tensor, "m d d"]) -> Float[Tensor, "b n*d n*d"]:
        """Covariances of several movements, each at few times of its own."""
        time = (x - self.x_shift) / self.x_scale
        loadings = self._loadings(time.flatten())
        factor = self.factor(loadings, covariance)
        factor, common = factor.unflatten(0, x.shape), (factor @ loadings).unflatten(0, x.shape).flatten(1, 2)
        along = torch.einsum("bxia,abxy,byja->bxiyj", factor, self._along(time, time), factor)
        return along.flatten(3).flatten(1, 2) + common @ common.mT


def root_in_order(covariance: Float[Tensor, "n d d"], order: Int64[Tensor, " d"]) -> Float[Tensor, "n d d"]:
    """Roots of covariances, whose column k is what output ``order[k]`` has beyond those before it."""
    return safe_cholesky(covariance[:, order][:, :, order], name="the covariance at a step")[:, order.argsort()]


@dataclass(eq=False, repr=False)
class TrajectoryRegressor(TimedMovement):
    """Joint law of a whole demonstration: marginals of a covariance regressor and a correlation along the movement.

    The marginals stay those of the regressor. Each output, given those that are smoother, has a nugget at each step and
    a time kernel: a slow part proportional to the standard deviation at each step, and a tremor of constant size in the
    output's units. This correlation is shrunk towards that of the demonstrations themselves. Draws and scores use a
    Student's t with one chi-squared variable per movement; conditioning uses the normal formulas. Only
    :meth:`predict_joint` forms a matrix of all steps and outputs.

    Parameters
    ----------
    regressor : covariance regressor or None, default=None
        Model of the marginals over time or phase, cloned into ``regressor_``; None is ``HeteroscedasticGPRegressor()``.
    time_kernel : {"auto", "squared_exponential", "matern32", "matern52"}, default="auto"
        Kernel along the movement; "auto" takes "matern52" or "squared_exponential", whichever is likelier.
    shrinkage : float or "auto", default="auto"
        Weight of the demonstrations' own correlation, 0 to 0.95; "auto" maximizes the likelihood of demonstrations
        left out in turn.
    timing : {"none", "warp", "auto"}, default="none"
        "none" takes the phase of a movement as known. With "warp", X is the time since the start of a movement of
        unknown duration and pace, whose distribution is learned from four or more demonstrations; :meth:`condition`
        locates the movement (:meth:`predict_phase`), and predictions average over what is left of both. "auto" takes
        "warp" if left-out demonstrations are likelier than with the mean duration at an even pace, at the cost of ten
        fits; X is time in both cases.
    random_state : int, RandomState instance or None, default=0
        Not used, since the fit is as deterministic as the regressor's; present so that models are interchangeable.

    Attributes
    ----------
    regressor_ : covariance regressor
        Regressor fitted to the rows.
    module_ : TrajectoryLaw
        The fitted torch module: maps times (n, 1) to joint mean (n, d) and covariance (n, d, n, d), differentiably;
        in a copy of :meth:`condition` too, of a movement of which nothing is known.
    time_kernel_ : str
    length_scale_ : ndarray of shape (n_outputs,)
        Length scale of each output's slow deviation along the movement, in units of X.
    nugget_scale_ : ndarray of shape (n_steps, n_outputs)
        Standard deviation of the independent part at each step of the fit's grid, relative to the smooth part's.
    shrinkage_ : float
    df_ : float
        Degrees of freedom of the joint law, 3 to 200: half the median of the regressor's, or fewer where left-out
        demonstrations are likelier so, as they differ in size.
    timing_ : {"none", "warp"}
    timing_gain_ : float
        Only with timing="auto": gain of "warp" in the log-likelihood of left-out demonstrations, in nats per step, at
        steps a twelfth of a movement apart.
    input_ : {"time", "phase", "array"}
    n_features_in_, n_outputs_ : int

    Examples
    --------
    >>> from torch_pbd.data import make_tunnel_demonstrations
    >>> from torch_pbd.movement import TrajectoryRegressor
    >>> demonstrations = make_tunnel_demonstrations(random_state=0).resample(50)
    >>> model = TrajectoryRegressor().fit(demonstrations)
    >>> via = model.condition([[5.0]], [[0.01, 0.3]])
    >>> via.sample_demonstrations([[0.0], [5.0], [10.0]], n_samples=4, random_state=0).shape
    (4, 3, 2)
    """

    regressor: CovarianceRegressor | None = None
    _: KW_ONLY
    time_kernel: str = "auto"
    shrinkage: float | str = "auto"
    timing: str = "none"
    random_state: Any = 0

    _learned: ClassVar[Any] = {
        "df_": partial(checks.number, least=FEWEST_DF, most=_MOST_DF),
        "time_kernel_": partial(checks.choice, choices=tuple(KERNELS)),
    }

    def _check_parameters(self) -> None:
        checks.choice(self.time_kernel, "time_kernel", ("auto", *KERNELS))
        if self.shrinkage != "auto":
            checks.number(self.shrinkage, "shrinkage", least=0.0, most=0.95)
        checks.choice(self.timing, "timing", ("none", "warp", "auto"))
        checks.seed(self.random_state)
        check_regressor(self.regressor, "predict_df")

    def _fit(self, recordings: list[Demonstration]) -> None:
        for number, recording in enumerate(recordings):
            if len(recording.time) < 2 or not (np.diff(recording.time) > 0.0).all():
                raise ValueError(
                    f"X has a time twice in demonstration {number}, or only one: it must have two samples or more, at "
                    "different times."
                )
        self._fit_law(self._timed(recordings))

    def _fit_law(self, recordings: list[Demonstration]) -> None:
        X, y, groups = as_rows(recordings)
        regressor = HeteroscedasticGPRegressor() if self.regressor is None else clone(self.regressor)
        self.regressor_ = fit_with_groups(regressor, X, y.ravel() if self._y_is_1d else y, groups)

        self._range = low, width = float(X.min()), float(np.ptp(X))  # of phases, where timing is unknown
        grid = np.linspace(low, low + width, n_grid_steps(recordings))
        covariance = self._regressor_rows(grid)[1]
        # Deviations bend less than movements between the samples.
        at, place = np.unique(X[:, 0], return_inverse=True)
        left = y - self.regressor_.predict(at[:, np.newaxis]).reshape(len(at), -1)[place]
        each = np.split(left, np.flatnonzero(np.diff(groups)) + 1)
        own = (Demonstration(time, rows) for (time, _), rows in zip(recordings, each, strict=True))
        residual = np.stack([sampled(deviation, grid) for deviation in own])
        # z = inv(L_t) (y_t - m_t) has unit covariance at each step; only its correlation along time is to be found.
        order = smoothest_first(torch.from_numpy(residual / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))))
        root = root_in_order(torch.from_numpy(covariance), order)
        whitened = torch.linalg.solve(root, torch.from_numpy(residual).unsqueeze(-1)).squeeze(-1)
        kernels = ("matern52", "squared_exponential") if self.time_kernel == "auto" else (self.time_kernel,)
        share = None if self.shrinkage == "auto" else 1.0 - float(self.shrinkage)
        scaled, deviation = torch.from_numpy((grid - low) / width), root[:, order].diagonal(dim1=1, dim2=2)
        degrees = np.median(self.regressor_.predict_df(grid[:, np.newaxis]))
        most = float(np.clip(degrees / _WHOLE, FEWEST_DF, _MOST_DF))
        # Wide tails would blur the phase of a movement of unknown timing.
        is_even = self._timing is not None
        found, self.df_ = fit_weighted(scaled, whitened, deviation, kernels, share, most, is_even=is_even)
        self._set_law(found, order)
        self.time_kernel_ = found.kernel

    def _set_law(self, kernel: TimeKernel, order: Tensor) -> None:
        self.module_ = TrajectoryLaw(getattr(self.regressor_, "module_", None), kernel, order, *self._range)
        of_output = order.argsort()
        self.length_scale_ = self._range[1] * kernel.scales[of_output, 0].numpy()
        self.shrinkage_ = 1.0 - float(kernel.share)
        self.nugget_scale_ = np.sqrt(kernel.nugget[of_output].numpy().T)

    def predict(self, X: ArrayLike, *, return_std: bool = False, return_cov: bool = False) -> Any:
        """Prediction of the regressor, or after :meth:`condition` mean and covariance of the rest of the movement."""
        if not self._is_regressor:
            return super().predict(X, return_std=return_std, return_cov=return_cov)
        time = self._times(X)[:, np.newaxis]  # which says so before a fit
        return self.regressor_.predict(time, return_std=return_std, return_cov=return_cov)

    def predict_df(self, X: ArrayLike) -> Floats:
        """Degrees of freedom (n_samples,) of the marginals, or of the joint law after :meth:`condition`."""
        if not self._is_regressor:
            return super().predict_df(X)
        time = self._times(X)[:, np.newaxis]
        return self.regressor_.predict_df(time)

    @property
    def _is_regressor(self) -> bool:
        """Whether the marginals at X are those of the regressor."""
        return self._timing is None and not len(self._known.time)

    def _uncertainty(self, time: Floats) -> tuple[Floats, Floats]:
        union, rows, places = self._union(time, self._known.time)
        type1, type2 = self.regressor_.predict_uncertainty(union[:, np.newaxis])
        if not self._is_regressor:
            law = self._prior_at(union)
            law = replace(law, factor=self.module_.factor(law.loadings, torch.from_numpy(type2)))
            type2 = self._given(law, places).law.marginal().numpy()
        return type1[rows], type2[rows]

    def _arrays(self) -> dict[str, Floats]:
        state = self.module_.state_dict().items()
        own = {
            key.rpartition(".")[2]: value.double().numpy() for key, value in state if not key.startswith("marginals.")
        }
        return own | self._timing_arrays()

    def _restore(self, arrays: dict[str, Floats]) -> None:
        arrays = self._restore_timing(arrays)
        n_steps, d = len(np.atleast_1d(arrays["grid"])), self.n_outputs_
        shapes: dict[str, tuple[int | str, ...]] = {
            "grid": (n_steps,), "scales": (d, 2), "fine": (d, n_steps), "nugget": (d, n_steps),
            "residual": ("K", n_steps, d), "share": (), "x_shift": (), "x_scale": (), "order": (d,),
        }  # fmt: skip
        check_arrays(arrays, shapes)
        for name in ("nugget", "scales"):
            checks.require(arrays[name] > 0.0, arrays[name], name, "above 0")
        checks.require(np.diff(arrays["grid"]) > 0.0, arrays["grid"][1:], "grid", "increasing")
        checks.number(float(arrays["share"]), "share", above=0.0, most=1.0)
        order = arrays.pop("order")
        checks.require(np.sort(order) == np.arange(d), order, "order", f"each number from 0 to {d - 1} once")
        self._range = float(arrays.pop("x_shift")), float(arrays.pop("x_scale"))
        own = {name: torch.tensor(array) for name, array in arrays.items()}
        self._set_law(TimeKernel(self.time_kernel_, **own), torch.tensor(order).long())

    def _prior(self, time: Floats) -> JointNormal:
        return self.module_.joint(*map(torch.from_numpy, (time, *self._regressor_rows(time))))

    def _rows(self, time: Floats) -> tuple[Floats, Floats]:
        return self._regressor_rows(time) if self._is_regressor else super()._rows(time)

    def _regressor_rows(self, time: Floats) -> tuple[Floats, Floats]:
        if self._predicted is not None:
            at, mean, covariance = self._predicted
            return mean[rows := np.searchsorted(at, time)], covariance[rows]
        mean, covariance = self.regressor_.predict(time[:, np.newaxis], return_cov=True)
        return np.ascontiguousarray(mean.reshape(len(time), self.n_outputs_)), np.ascontiguousarray(covariance)
