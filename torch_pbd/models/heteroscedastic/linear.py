"""The Gaussian linear model whose weights are standard normal numbers a priori."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.linalg import safe_cholesky

# Of a weight; that of its prior is one, of which a sum with a larger one keeps fewer than seven digits.
LARGEST_PRECISION = 1e9


class Weights(NamedTuple):
    """Normal distribution of the weights of features."""

    mean: Float[Tensor, "*b p"]
    root: Float[Tensor, "*b p p"]
    """Upper triangular; the covariance is ``root @ root.mT``."""


@dataclass(frozen=True)
class LinearEvidence:
    """Log density of ``response = design @ weights + noise`` with the weights integrated out, in nats.

    But for what no design changes. The noise is independent and of variance one. With the design D the posterior of the
    weights has the precision P = I + D'D and the mean m = inv(P) D'y, and the value is m'P m / 2 - log|P| / 2.
    """

    value: Float[Tensor, "*b"]
    mean: Float[Tensor, "*b p"]
    """Posterior mean of the weights."""
    factor: Float[Tensor, "*b p p"]
    """Upper triangular; ``factor.mT @ factor`` is the precision of the weights' posterior."""

    @classmethod
    def fit(cls, design: Float[Tensor, "*b n p"], response: Float[Tensor, "*b n"]) -> "LinearEvidence":
        """Evidence of b designs."""
        return cls.from_factor(*_triangular(design, response))

    @classmethod
    def from_factor(cls, factor: Float[Tensor, "*b p p"], projected: Float[Tensor, "*b p"]) -> "LinearEvidence":
        """Evidence of b designs, where ``factor @ mean = projected``."""
        mean = torch.linalg.solve_triangular(factor, projected.unsqueeze(-1), upper=True).squeeze(-1)
        log_det = factor.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
        return cls(0.5 * projected.square().sum(-1) - log_det, mean, factor)

    @cached_property
    def covariance(self) -> Float[Tensor, "*b p p"]:
        """Posterior covariance of the weights."""
        return torch.cholesky_inverse(self.factor, upper=True)

    def gradient(self, design: Float[Tensor, "*b n p"], response: Float[Tensor, "*b n"]) -> Float[Tensor, "*b n p"]:
        """Gradient of the value in the design: (y - D m) m' - D inv(P)."""
        residual = response.unsqueeze(-1) - design @ self.mean.unsqueeze(-1)
        return residual * self.mean.unsqueeze(-2) - design @ self.covariance

    def weights(self) -> Weights:
        """The posterior."""
        return Weights(self.mean, inverse(self.factor))

    def divergence_from_prior(self) -> Float[Tensor, "*b"]:
        """Kullback-Leibler divergence of the weights' posterior from standard normal numbers, in nats."""
        trace = self.covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        log_det = 2.0 * self.factor.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
        return 0.5 * (trace + self.mean.square().sum(-1) - self.mean.shape[-1] + log_det)


def weights_factor(design: Float[Tensor, "*b n p"]) -> Float[Tensor, "*b p p"]:
    """Upper factor of the precision of the weights, which does not depend on the response."""
    return _triangular(design, torch.zeros_like(design[..., 0]))[0]


def _triangular(design: Tensor, response: Tensor) -> tuple[Tensor, Tensor]:
    """Upper factor R of the precision ``R' R``, and the response projected: ``R mean = projected``.

    Where the noise is small beside what the features carry the precision, one on its diagonal beside their
    squares, cannot be formed in floating point; then by a QR decomposition, which is slower.
    """
    precision = design.mT @ design + torch.eye(design.shape[-1]).to(design)
    if float(precision.diagonal(dim1=-2, dim2=-1).detach().amax()) < LARGEST_PRECISION:
        lower = safe_cholesky(precision, name="the precision of the latent weights")
        projected = torch.linalg.solve_triangular(lower, design.mT @ response.unsqueeze(-1), upper=False)
        return lower.mT, projected.squeeze(-1)
    eye = torch.eye(design.shape[-1]).to(design).expand(*design.shape[:-2], -1, -1)
    orthogonal, upper = torch.linalg.qr(torch.cat([design, eye], dim=-2))
    return upper, (orthogonal[..., : design.shape[-2], :].mT @ response.unsqueeze(-1)).squeeze(-1)


def inverse(upper: Float[Tensor, "*b p p"]) -> Float[Tensor, "*b p p"]:
    """Inverse of upper triangular matrices."""
    return torch.linalg.solve_triangular(upper, torch.eye(upper.shape[-1]).to(upper).expand_as(upper), upper=True)
