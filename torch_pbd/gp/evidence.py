"""Evidence of Gaussian processes, and its gradient in closed form.

Several observations of one input enter as their mean and their count: the noise of a mean is the noise over the
root of the count. Targets are those from which the prior mean is subtracted.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.gp.observations import Hyperparameters, Observations
from torch_pbd.gp.projection import FULL, Basis, Projection
from torch_pbd.kernels import correlation, value_and_slope


def negative_log_evidence(
    observations: Observations, hyperparameters: Hyperparameters, kernel: str = "squared_exponential"
) -> Float[Tensor, " b"]:
    """Negative log marginal likelihood of each process, in nats (Rasmussen and Williams, eq. (2.30)).

    Differentiable by autograd; NaN where the covariance is not positive definite.
    """
    basis = Basis.of(observations, FULL)
    whole = basis.project(observations.targets)
    covariance = basis.covariance(correlation(basis.nodes, basis.nodes, hyperparameters.length_scale, kernel))
    covariance = covariance + torch.diag_embed(hyperparameters.noise_ratio[:, None].expand(-1, whole.n_inputs))
    factor, info = torch.linalg.cholesky_ex(covariance)
    whitened = torch.linalg.solve_triangular(factor, whole.targets.unsqueeze(-1), upper=False).squeeze(-1)
    log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    loss = negative_log_density(whitened.square().sum(-1), log_det, hyperparameters.amplitude.square(), whole)
    return torch.where(info == 0, loss, math.nan)


def negative_log_density(quadratic: Tensor, log_det: Tensor, variance: Tensor, of: Projection) -> Tensor:
    """In nats, from the quadratic form and the log determinant of the covariance over the squared amplitude."""
    constant = of.n_inputs * math.log(2.0 * math.pi) - of.sum_log_counts
    return 0.5 * (quadratic / variance + log_det + of.n_inputs * variance.log() + constant)


def best_variance(quadratic: Tensor, n_inputs: int) -> Tensor:
    """Squared amplitude that maximizes the evidence, given the rest; tiny for targets that are all zero."""
    return (quadratic / n_inputs).clamp_min(1e-200)


class Gradient(NamedTuple):
    """Of the negative log evidence by logarithms."""

    log_length_scale: Float[Tensor, "a e"]
    log_noise_ratio: Float[Tensor, " a"]


@dataclass(frozen=True)
class Evidence:
    """Negative log evidence of b processes as a function of length scales and noise ratio alone.

    The squared amplitude is the best one, or where ``noise_scale`` (b,) is given that which the noise ratio
    leaves.
    """

    projection: Projection
    kernel: str
    noise_scale: Float[Tensor, " b"] | None
    square_difference: Float[Tensor, "e mm"]
    """Of the nodes, in each dimension."""

    @classmethod
    def of(cls, projection: Projection, kernel: str, noise_scale: Tensor | None) -> "Evidence":
        """Evidence of observations; a ``noise_scale`` of zero is no noise, and leaves the amplitude free."""
        nodes = projection.basis.nodes.mT
        difference = (nodes[:, :, None] - nodes[:, None, :]).square().flatten(1)
        held = noise_scale if noise_scale is not None and bool((noise_scale > 0).all()) else None
        return cls(projection, kernel, held, difference)

    def __call__(
        self, length_scale: Float[Tensor, "a e"], noise_ratio: Float[Tensor, " a"], rows: Int64[Tensor, " a"]
    ) -> tuple[Float[Tensor, " a"], Gradient]:
        """In nats, for a of the processes, with its gradient; both NaN where there is none.

        With M = A^-1 - alpha alpha' / variance and alpha = A^-1 y, a change of the covariance A over the squared
        amplitude changes it by tr(M dA) / 2: the best amplitude changes nothing to first order.
        """
        data, basis = self.projection, self.projection.basis
        n_nodes, inverse_square = len(basis.nodes), length_scale.square().reciprocal()
        squares = self.square_difference.unflatten(1, (n_nodes, n_nodes))
        correlation, slope = value_and_slope(squares, inverse_square, self.kernel)
        covariance = basis.covariance(correlation)
        covariance.diagonal(dim1=-2, dim2=-1).add_(noise_ratio[:, None])
        inverse, log_det = _inverse_and_log_det(covariance)
        targets = data.targets[rows].unsqueeze(-1)
        alpha = inverse @ targets
        quadratic = (targets * alpha).sum((-2, -1))
        if data.n_outside:
            outside = data.remainder[rows] / noise_ratio
            quadratic = quadratic + outside
            log_det = log_det + data.n_outside * noise_ratio.log()
        variance = self.variance(quadratic, noise_ratio, rows)
        loss = negative_log_density(quadratic, log_det, variance, data)
        matrix = inverse - (alpha / variance[:, None, None]) @ alpha.mT
        # The squared distance is inversely proportional to the square of the length scale.
        by_distance = (basis.pulled_back(matrix) * slope).flatten(1)
        by_length = (by_distance @ self.square_difference.mT) * -inverse_square
        by_ratio = noise_ratio * matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
        if data.n_outside:
            by_ratio = by_ratio + (data.n_outside - outside / variance)
        if self.noise_scale is not None:  # the variance is inversely proportional to the ratio
            by_ratio = by_ratio + (quadratic / variance - data.n_inputs)
        return loss, Gradient(by_length, 0.5 * by_ratio)

    def variance(self, quadratic: Tensor, noise_ratio: Tensor, rows: Tensor) -> Tensor:
        """Squared amplitude of the processes ``rows``."""
        if self.noise_scale is None:
            return best_variance(quadratic, self.projection.n_inputs)
        return self.noise_scale[rows].square() / noise_ratio

    def table(self, length_scales: Float[Tensor, "s e"], noise_ratios: Float[Tensor, " q"]) -> Float[Tensor, "b s q"]:
        """In nats, of all processes at all pairs; infinite where the covariance is near singular.

        One eigendecomposition of a length scale serves all processes and all noise ratios.
        """
        data, n_nodes = self.projection, len(self.projection.basis.nodes)
        squares = self.square_difference.unflatten(1, (n_nodes, n_nodes))
        correlation, _ = value_and_slope(squares, length_scales.square().reciprocal(), self.kernel)
        eigenvalue, eigenvector = torch.linalg.eigh(data.basis.covariance(correlation))
        square = (data.targets @ eigenvector).square()  # (s, b, r)
        spectrum = eigenvalue.clamp_min(0.0).unsqueeze(1) + noise_ratios[:, None]  # (s, q, r)
        rounding = 10 * n_nodes * torch.finfo(spectrum.dtype).eps
        sound = eigenvalue[:, :1] + noise_ratios > rounding * spectrum[..., -1]
        quadratic = square @ (1.0 / spectrum.clamp_min(1e-300)).mT  # (s, b, q)
        log_det = spectrum.clamp_min(1e-300).log().sum(-1).unsqueeze(1)
        if data.n_outside:
            quadratic = quadratic + data.remainder[:, None] / noise_ratios
            log_det = log_det + data.n_outside * noise_ratios.log()
        variance = best_variance(quadratic, data.n_inputs)
        if self.noise_scale is not None:
            variance = (self.noise_scale.square()[:, None] / noise_ratios).expand_as(quadratic)
        loss = negative_log_density(quadratic, log_det, variance, data)
        return loss.where(sound.unsqueeze(1), math.inf).transpose(0, 1)

    def residual(self, length_scale: Float[Tensor, "b e"], noise_ratio: Float[Tensor, " b"]) -> Float[Tensor, "b n"]:
        """What each process leaves of its weighted observations."""
        data, orthogonal = self.projection, self.projection.basis.orthogonal
        assert orthogonal is not None
        left = noise_ratio[:, None] * self._solved(length_scale, noise_ratio, slice(None))
        return data.weighted - (data.targets - left) @ orthogonal.mT

    def best_variance_at(
        self, length_scale: Float[Tensor, "a e"], noise_ratio: Float[Tensor, " a"], rows: Int64[Tensor, " a"]
    ) -> Float[Tensor, " a"]:
        """Squared amplitude; that of the targets themselves where the covariance is singular."""
        targets = self.projection.targets[rows]
        quadratic = (targets * self._solved(length_scale, noise_ratio, rows)).sum(-1)
        if self.projection.n_outside:
            quadratic = quadratic + self.projection.remainder[rows] / noise_ratio
        variance = self.variance(quadratic, noise_ratio, rows)
        return torch.where(variance.isnan(), targets.square().mean(1).clamp_min(1e-200), variance)

    def _solved(self, length_scale: Tensor, noise_ratio: Tensor, rows: Tensor | slice) -> Float[Tensor, "a r"]:
        """Inverse of the covariance over the squared amplitude times the targets; NaN where it is singular."""
        basis = self.projection.basis
        covariance = basis.covariance(correlation(basis.nodes, basis.nodes, length_scale, self.kernel))
        covariance.diagonal(dim1=-2, dim2=-1).add_(noise_ratio[:, None])
        factor, info = torch.linalg.cholesky_ex(covariance)
        solved = torch.cholesky_solve(self.projection.targets[rows].unsqueeze(-1), factor).squeeze(-1)
        return torch.where(info[:, None] == 0, solved, math.nan)


def _inverse_and_log_det(matrix: Float[Tensor, "a r r"]) -> tuple[Tensor, Tensor]:
    """Of positive definite matrices; the log determinant of others is NaN."""
    factor, info = torch.linalg.cholesky_ex(matrix)
    log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    if bool(info.any()):
        log_det = torch.where(info == 0, log_det, math.nan)
        factor = torch.where((info > 0)[:, None, None], torch.eye(factor.shape[-1]).to(factor), factor)
    return torch.cholesky_inverse(factor), log_det
