"""The Gaussian linear model whose weights are standard normal numbers a priori."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.linalg import safe_cholesky


class Weights(NamedTuple):
    """Normal distribution of the weights of features."""

    mean: Float[Tensor, "*b p"]
    root: Float[Tensor, "*b p p"]
    """Upper triangular; the covariance is ``root @ root.mT``."""


def weights_posterior(design: Float[Tensor, "*b n p"], response: Float[Tensor, "*b n"]) -> Weights:
    """Weights given ``response = design @ weights + noise``, the noise independent and of variance one."""
    factor = _precision_factor(design)
    mean = torch.cholesky_solve(design.mT @ response.unsqueeze(-1), factor).squeeze(-1)
    return Weights(mean, _inverse_transposed(factor))


def log_evidence(design: Float[Tensor, "*b n p"], response: Float[Tensor, "*b n"]) -> Float[Tensor, "*b"]:
    """Log density of the response with the weights integrated out, but for what no design changes, in nats."""
    factor = _precision_factor(design)
    projected = torch.linalg.solve_triangular(factor, design.mT @ response.unsqueeze(-1), upper=False)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return 0.5 * projected.square().sum((-2, -1)) - log_det


def divergence_from_prior(weights: Weights) -> float:
    """Kullback-Leibler divergence of the weights' distribution from standard normal numbers, in nats."""
    size = weights.mean.numel()
    trace = float(weights.root.square().sum())
    log_det = 2.0 * float(weights.root.diagonal(dim1=-2, dim2=-1).log().sum())
    return 0.5 * (trace + float(weights.mean.square().sum()) - size - log_det)


def weights_root(design: Float[Tensor, "*b n p"]) -> Float[Tensor, "*b p p"]:
    """Root of the weights' covariance, which does not depend on the response."""
    return _inverse_transposed(_precision_factor(design))


def _precision_factor(design: Tensor) -> Tensor:
    precision = design.mT @ design + torch.eye(design.shape[-1]).to(design)
    return safe_cholesky(precision, name="the precision of the latent weights")


def _inverse_transposed(factor: Tensor) -> Tensor:
    eye = torch.eye(factor.shape[-1]).to(factor)
    return torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False).mT
