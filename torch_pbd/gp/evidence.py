"""Evidence of Gaussian processes in closed form, with its gradient, and the options of its search."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.gp.observations import Basis, Hyperparameters, Observations
from torch_pbd.kernels import correlation, value_and_slope

MIN_NOISE_RATIO, MAX_NOISE_RATIO = 1e-10, 1e5
"""Bounds of a learned noise variance over the variance of the process; a fixed noise may be far lower."""

_LEAST_VARIANCE = 1e-200  # squared amplitude of targets that are all zero


@dataclass(frozen=True)
class EvidenceSearch:
    """Bounds, held values and limits of a search for hyperparameters, in ranges of the inputs and in nats."""

    kernel: str = "squared_exponential"
    length_scale_bounds: tuple[float, float] = (1e-3, 1e1)
    """A lower one at the spacing of the inputs keeps out "needles", which explain every point by itself."""
    length_scale: Tensor | None = None
    """(e,), held there if given."""
    noise_scale: Tensor | None = None
    """Deviation (b,) of the noise of one observation, held if given: zero for all processes, or above it for all."""
    max_inputs: int | None = None
    """Number above which neighbours are merged, for length scales too short for a lower rank."""
    n_restarts: int = 2
    """Number of the grid's valleys to descend into besides the deepest."""
    max_iter: int = 100
    tol: float = 0.005


class Evidence:
    """Negative log evidence (nats) of b processes as a function of length scales and noise ratio alone.

    For n observations y with the covariance ``v A``, A the correlation plus the noise ratio r on the diagonal, it is
    ``(y' inv(A) y / v + log |A| + n log(2 pi v)) / 2`` (Rasmussen and Williams, eq. (2.30)), less half the sum of
    the logarithms of the counts, as the observations are weighted by their roots. Its minimum in v is at
    ``v = y' inv(A) y / n``; or v is what a given ``noise_scale`` above zero leaves, ``noise_scale^2 / r``. What is
    outside of the basis has a covariance of v r alone.
    """

    def __init__(
        self, basis: Basis, targets: Float[Tensor, "b n"], kernel: str, noise_scale: Float[Tensor, " b"] | None
    ) -> None:
        self.basis, self.kernel = basis, kernel
        self.targets, self.remainder = basis.project(targets)
        self.weighted = targets * basis.observations.counts.sqrt()
        self.noise_scale = noise_scale if noise_scale is not None and bool((noise_scale > 0).all()) else None
        nodes = basis.nodes.mT
        self.square_difference = (nodes[:, :, None] - nodes[:, None, :]).square()
        self.n_inputs = targets.shape[1]
        self.n_outside = self.n_inputs - self.targets.shape[1]
        self._constant = self.n_inputs * math.log(2.0 * math.pi) - float(basis.observations.counts.log().sum())

    def __call__(
        self, length_scale: Float[Tensor, "a e"], noise_ratio: Float[Tensor, " a"], rows: Int64[Tensor, " a"]
    ) -> tuple[Float[Tensor, " a"], Float[Tensor, "a e+1"]]:
        """Value for a of the processes, and gradient by the logarithms of length scales and, last, noise ratio.

        Both NaN where the covariance is not positive definite.
        """
        inverse_square = length_scale.square().reciprocal()
        correlated, slope = value_and_slope(self.square_difference, inverse_square, self.kernel)
        covariance = self.basis.covariance(correlated)
        covariance.diagonal(dim1=-2, dim2=-1).add_(noise_ratio[:, None])
        factor, info = torch.linalg.cholesky_ex(covariance)
        log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        if bool(info.any()):
            log_det = torch.where(info == 0, log_det, math.nan)
            factor = torch.where((info > 0)[:, None, None], torch.eye(factor.shape[-1]).to(factor), factor)
        inverse = torch.cholesky_inverse(factor)
        targets = self.targets[rows].unsqueeze(-1)
        alpha = inverse @ targets
        loss, quadratic, variance = self._density((targets * alpha).sum((-2, -1)), log_det, noise_ratio, rows)
        # With M = inv(A) - alpha alpha' / v and alpha = inv(A) y, a change of A changes the value by tr(M dA) / 2: the
        # best amplitude changes nothing to first order. The squared distance s is inversely proportional to the square
        # of the length scale, ds = -2 s d log(scale).
        matrix = inverse - (alpha / variance[:, None, None]) @ alpha.mT
        by_distance = (self.basis.covariance_vjp(matrix) * slope).flatten(1)
        by_length = (by_distance @ self.square_difference.flatten(1).mT) * -inverse_square
        by_ratio = noise_ratio * matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
        if self.n_outside:
            by_ratio = by_ratio + (self.n_outside - self.remainder[rows] / noise_ratio / variance)
        if self.noise_scale is not None:  # the variance is inversely proportional to the ratio
            by_ratio = by_ratio + (quadratic / variance - self.n_inputs)
        return loss, torch.cat([by_length, 0.5 * by_ratio[:, None]], dim=1)

    def table(self, length_scales: Float[Tensor, "s e"], noise_ratios: Float[Tensor, " q"]) -> Float[Tensor, "b s q"]:
        """Values of all processes at all pairs; infinite where the covariance is near singular.

        With the eigenvectors E and eigenvalues w of the correlation A has the same E, and w + r: one decomposition
        of a length scale serves all processes and all noise ratios.
        """
        correlated, _ = value_and_slope(self.square_difference, length_scales.square().reciprocal(), self.kernel)
        eigenvalue, eigenvector = torch.linalg.eigh(self.basis.covariance(correlated))
        square = (self.targets @ eigenvector).square()  # (s, b, r)
        spectrum = eigenvalue.clamp_min(0.0).unsqueeze(1) + noise_ratios[:, None]  # (s, q, r)
        rounding = 10 * len(self.basis.nodes) * torch.finfo(spectrum.dtype).eps
        sound = eigenvalue[:, :1] + noise_ratios > rounding * spectrum[..., -1]
        quadratic = square @ (1.0 / spectrum.clamp_min(1e-300)).mT  # (s, b, q)
        log_det = spectrum.clamp_min(1e-300).log().sum(-1).unsqueeze(1)
        loss, _, _ = self._density(quadratic, log_det, noise_ratios, (slice(None), None))
        return loss.where(sound.unsqueeze(1), math.inf).transpose(0, 1)

    def residual(self, length_scale: Float[Tensor, "b e"], noise_ratio: Float[Tensor, " b"]) -> Float[Tensor, "b n"]:
        """Weighted observations less what each process explains; only in a basis of nodes."""
        orthogonal = self.basis.orthogonal
        assert orthogonal is not None
        left = noise_ratio[:, None] * self._solved(length_scale, noise_ratio, slice(None))
        return self.weighted - (self.targets - left) @ orthogonal.mT

    def best_variance(
        self, length_scale: Float[Tensor, "a e"], noise_ratio: Float[Tensor, " a"], rows: Int64[Tensor, " a"]
    ) -> Float[Tensor, " a"]:
        """Squared amplitude; that of the targets themselves where the covariance is singular."""
        targets = self.targets[rows]
        quadratic = (targets * self._solved(length_scale, noise_ratio, rows)).sum(-1)
        _, _, variance = self._density(quadratic, torch.zeros_like(quadratic), noise_ratio, rows)
        return torch.where(variance.isnan(), targets.square().mean(1).clamp_min(_LEAST_VARIANCE), variance)

    def _density(
        self, quadratic: Tensor, log_det: Tensor, noise_ratio: Tensor, rows: Tensor | tuple[slice, None]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Value, quadratic form and variance, from quadratic form and log determinant within the basis."""
        if self.n_outside:
            quadratic = quadratic + self.remainder[rows] / noise_ratio
            log_det = log_det + self.n_outside * noise_ratio.log()
        if self.noise_scale is None:
            variance = (quadratic / self.n_inputs).clamp_min(_LEAST_VARIANCE)
        else:
            variance = (self.noise_scale[rows].square() / noise_ratio).expand_as(quadratic)
        value = 0.5 * (quadratic / variance + log_det + self.n_inputs * variance.log() + self._constant)
        return value, quadratic, variance

    def _solved(self, length_scale: Tensor, noise_ratio: Tensor, rows: Tensor | slice) -> Float[Tensor, "a r"]:
        """``inv(A) y``; NaN where A is singular."""
        nodes = self.basis.nodes
        covariance = self.basis.covariance(correlation(nodes, nodes, length_scale, self.kernel))
        covariance.diagonal(dim1=-2, dim2=-1).add_(noise_ratio[:, None])
        factor, info = torch.linalg.cholesky_ex(covariance)
        solved = torch.cholesky_solve(self.targets[rows].unsqueeze(-1), factor).squeeze(-1)
        return torch.where(info[:, None] == 0, solved, math.nan)


class Coordinates:
    """Unbounded coordinates of the hyperparameters that are searched; the rest are fixed or closed-form.

    A cosine folds each onto its bounds: unlike a sigmoid it reaches them, so an optimum there is found.
    """

    def __init__(
        self, evidence: Evidence, fixed: Tensor | None, shortest: float, longest: Tensor, lowest_ratio: float
    ) -> None:
        n_features = evidence.basis.nodes.shape[1]
        self._evidence, self._fixed, self._noisy = evidence, fixed, lowest_ratio > 0.0
        # Columns of (log length scales, log noise ratio) that are searched.
        self._free = slice(0 if fixed is None else n_features, n_features + self._noisy)
        low = [math.log(shortest)] * n_features + [math.log(lowest_ratio or 1.0)]
        high = [longest.log()] * n_features + [torch.full_like(longest, MAX_NOISE_RATIO).log()]
        self._low = longest.new_tensor(low).expand(len(longest), -1)[:, self._free]
        self._half_width = 0.5 * (torch.stack(high, dim=1)[:, self._free] - self._low)

    def decode(self, z: Float[Tensor, "a p"], rows: Int64[Tensor, " a"]) -> tuple[Tensor, Tensor]:
        """Length scales (a, e) and noise ratio (a,)."""
        values = (self._low[rows] + self._half_width[rows] * (1.0 - torch.cos(z))).exp()
        n_features = self._evidence.basis.nodes.shape[1]
        length_scale = values[:, :n_features] if self._fixed is None else self._fixed.expand(len(z), -1)
        return length_scale, values[:, -1] if self._noisy else z.new_zeros(len(z))

    def encode(self, length_scale: Float[Tensor, "a e"], noise_ratio: Float[Tensor, " a"], rows: Tensor) -> Tensor:
        """Coordinates (a, p), off the bounds by a little: there they have no slope."""
        logs = torch.cat([length_scale, noise_ratio[:, None]], dim=1)[:, self._free].log()
        share = 0.5 * (logs - self._low[rows]) / self._half_width[rows].clamp_min(1e-9)
        return torch.acos(1.0 - 2.0 * share.clamp(0.01, 0.99))

    def loss(self, z: Float[Tensor, "a p"], rows: Int64[Tensor, " a"]) -> tuple[Tensor, Tensor]:
        """Negative log evidence in nats, and its gradient."""
        loss, gradient = self._evidence(*self.decode(z, rows), rows)
        return loss, gradient[:, self._free] * self._half_width[rows] * torch.sin(z)


def negative_log_evidence(
    observations: Observations, hyperparameters: Hyperparameters, kernel: str = "squared_exponential"
) -> Float[Tensor, " b"]:
    """Negative log evidence of processes with noise, in nats; NaN where the covariance is not positive definite."""
    noise_scale = hyperparameters.amplitude * hyperparameters.noise_ratio.sqrt()
    evidence = Evidence(Basis(observations), observations.targets, kernel, noise_scale)
    length_scale = hyperparameters.length_scale.expand(len(noise_scale), -1)
    rows = torch.arange(len(noise_scale), device=noise_scale.device)
    return evidence(length_scale, hyperparameters.noise_ratio, rows)[0]
