"""Mean by generalized least squares: Gaussian processes under noise whose covariance depends on the input."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.models.heteroscedastic.linear import Weights, log_evidence, weights_posterior
from torch_pbd.models.heteroscedastic.processes import ProcessFamily, SearchOptions, search

_CHUNK = 4096


@dataclass(frozen=True)
class LatentMean:
    """Posterior of the mean: weights of one output after another."""

    family: ProcessFamily
    theta: Float[Tensor, "d q"]
    weights: Weights

    def at(self, x: Float[Tensor, "n e"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d d"]]:
        """Expected mean at x, and the covariance of its error between the outputs."""
        features = self.family.design(x, self.theta)
        n_outputs, _, size = features.shape
        mean = torch.einsum("dnp,dp->nd", features, self.weights.mean.reshape(n_outputs, size))
        root = torch.einsum("dnp,dpr->ndr", features, self.weights.root.reshape(n_outputs, size, -1))
        unexplained = torch.diag_embed(self.family.unexplained(features, self.theta).mT)
        return mean, root @ root.mT + unexplained

    def expected(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Expected mean at x alone, a bounded number of rows at a time."""
        weights = self.weights.mean.reshape(len(self.theta), -1)
        return torch.cat(
            [torch.einsum("dnp,dp->nd", self.family.design(part, self.theta), weights) for part in x.split(_CHUNK)]
        )


def fit_mean(
    family: ProcessFamily,
    inputs: Float[Tensor, "n e"],
    means: Float[Tensor, "n d"],
    counts: Float[Tensor, " n"],
    noise_tril: Float[Tensor, "n d d"],
    whitener: Float[Tensor, "d n n"] | None,
    start: Float[Tensor, "d q"] | None,
    options: SearchOptions,
) -> LatentMean:
    """Posterior given means of ``counts`` rows, whose noise has the factor ``noise_tril``.

    Hyperparameters are chosen for each output by its own evidence, as if the others did not tell of its
    noise; the posterior is that of all outputs together.
    """
    scale = (counts.sqrt()[:, None] / noise_tril.square().sum(-1).sqrt()).mT
    response = _whiten(whitener, (scale * means.mT).unsqueeze(-1)).squeeze(-1)

    def evidence(theta: Tensor, rows: Int64[Tensor, " a"]) -> Tensor:
        chosen = None if whitener is None else whitener[rows]
        design = _whiten(chosen, scale[rows].unsqueeze(-1) * family.design(inputs, theta))
        return log_evidence(design, response[rows])

    theta = search(family, evidence, start, (means.shape[1], inputs.shape[1]), means, options)
    features = family.design(inputs, theta)
    eye = torch.eye(means.shape[1]).to(means)
    whitening = torch.linalg.solve_triangular(noise_tril, eye.expand_as(noise_tril), upper=False)
    whitening = counts.sqrt()[:, None, None] * whitening
    design = torch.einsum("nij,jnp->nijp", whitening, features).flatten(2)
    response = (whitening @ means.unsqueeze(-1)).squeeze(-1)
    if whitener is not None:
        design = torch.einsum("imn,niq->miq", whitener, design)
        response = torch.einsum("imn,ni->mi", whitener, response)
    return LatentMean(family, theta, weights_posterior(design.flatten(0, 1), response.flatten()))


def _whiten(whitener: Tensor | None, values: Tensor) -> Tensor:
    return values if whitener is None else whitener @ values
