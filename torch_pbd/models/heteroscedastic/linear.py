"""The Gaussian linear model whose weights are standard normal numbers a priori."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.linalg import safe_cholesky

_LARGEST_PRECISION = 1e9


class Weights(NamedTuple):
    """Normal distribution of the weights of features."""

    mean: Float[Tensor, "*b p"]
    root: Float[Tensor, "*b p p"]
    """Upper triangular; the covariance is ``root @ root.mT``."""


def weights_posterior(design: Float[Tensor, "*b n p"], response: Float[Tensor, "*b n"]) -> Weights:
    """Weights given ``response = design @ weights + noise``, the noise independent and of variance one."""
    factor, projected = _triangular(design, response)
    mean = torch.linalg.solve_triangular(factor, projected.unsqueeze(-1), upper=True).squeeze(-1)
    return Weights(mean, _inverse(factor))


def log_evidence(design: Float[Tensor, "*b n p"], response: Float[Tensor, "*b n"]) -> Float[Tensor, "*b"]:
    """Log density of the response with the weights integrated out, but for what no design changes, in nats."""
    factor, projected = _triangular(design, response)
    log_det = factor.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
    return 0.5 * projected.square().sum(-1) - log_det


def divergence_from_prior(weights: Weights) -> float:
    """Kullback-Leibler divergence of the weights' distribution from standard normal numbers, in nats."""
    size = weights.mean.numel()
    trace = float(weights.root.square().sum())
    log_det = 2.0 * float(weights.root.diagonal(dim1=-2, dim2=-1).abs().log().sum())
    return 0.5 * (trace + float(weights.mean.square().sum()) - size - log_det)


def weights_root(design: Float[Tensor, "*b n p"]) -> Float[Tensor, "*b p p"]:
    """Root of the weights' covariance, which does not depend on the response."""
    return _inverse(_triangular(design, torch.zeros_like(design[..., 0]))[0])


def _triangular(design: Tensor, response: Tensor) -> tuple[Tensor, Tensor]:
    """Upper factor R of the precision ``R' R``, and the response projected: ``R mean = projected``.

    Where the noise is small beside what the features carry the precision, one on its diagonal beside their
    squares, cannot be formed in floating point; then by a QR decomposition, which is slower.
    """
    precision = design.mT @ design + torch.eye(design.shape[-1]).to(design)
    if float(precision.diagonal(dim1=-2, dim2=-1).detach().amax()) < _LARGEST_PRECISION:
        lower = safe_cholesky(precision, name="the precision of the latent weights")
        projected = torch.linalg.solve_triangular(lower, design.mT @ response.unsqueeze(-1), upper=False)
        return lower.mT, projected.squeeze(-1)
    eye = torch.eye(design.shape[-1]).to(design).expand(*design.shape[:-2], -1, -1)
    orthogonal, upper = torch.linalg.qr(torch.cat([design, eye], dim=-2))
    return upper, (orthogonal[..., : design.shape[-2], :].mT @ response.unsqueeze(-1)).squeeze(-1)


def _inverse(upper: Tensor) -> Tensor:
    return torch.linalg.solve_triangular(upper, torch.eye(upper.shape[-1]).to(upper).expand_as(upper), upper=True)
