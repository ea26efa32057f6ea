"""The floor under every covariance: relative to the data, inside the losses as well as in predictions."""

import torch
from jaxtyping import Float
from torch import Tensor

VARIANCE_FLOOR = 1e-12
"""Added to every variance, relative to one plus the sum of the variances; outputs have unit variance."""


def with_floor(root: Float[Tensor, "*b d r"]) -> Float[Tensor, "*b d s"]:
    """Root of a covariance with the floor added: positive definite, whatever ``root`` is."""
    floor = (VARIANCE_FLOOR * (1.0 + root.square().sum((-2, -1), keepdim=True))).sqrt()
    return torch.cat([root, floor * torch.eye(root.shape[-2], dtype=root.dtype, device=root.device)], dim=-1)


def beside_prior(
    root: Float[Tensor, "*n d r"], values: Float[Tensor, "*n d r"], prior: Float[Tensor, "*m d r"]
) -> Float[Tensor, "*n d r"]:
    """Root of a covariance whose part beside ``values``, those without prior, is kept between nothing and the prior.

    It is the prior times one less an interpolation of ones, which swings to 1.14 between two inputs: of a prior far
    above the values, as of a movement of many standard deviations, it would take more away than there is.
    """
    return values + (root - values).clamp(prior.clamp_max(0.0), prior.clamp_min(0.0))
