"""Mean by generalized least squares: Gaussian processes under noise whose covariance depends on the input."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.gp.inducing import FixedFeatures
from torch_pbd.models.heteroscedastic.linear import LinearEvidence, Weights, weights_posterior
from torch_pbd.models.heteroscedastic.processes import Processes, ProcessFamily
from torch_pbd.models.heteroscedastic.search import Gradient, Search

_CHUNK = 1024


@dataclass(frozen=True)
class LatentMean:
    """Posterior of the mean: weights of one output after another."""

    family: ProcessFamily
    theta: Float[Tensor, "d q"]
    weights: Weights

    @cached_property
    def processes(self) -> Processes:
        """Of all outputs."""
        return self.family.prepared(self.theta)

    def at(self, x: Float[Tensor, "n e"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d d"]]:
        """Expected mean at x, and the covariance of its error between the outputs."""
        return self.of_features(self.processes.features(x))

    def of_features(self, values: Float[Tensor, "d n m"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d d"]]:
        """The same, from the features of unit variance there."""
        features = self.family.scaled(values, self.processes.amplitude)
        n_outputs, _, size = features.shape
        mean = self.expectation(values)
        root = (features @ self.weights.root.reshape(n_outputs, size, -1)).transpose(0, 1)
        unexplained = torch.diag_embed(self.processes.unexplained(features).mT)
        return mean, root @ root.mT + unexplained

    def expectation(self, values: Float[Tensor, "d n m"]) -> Float[Tensor, "n d"]:
        """Expected mean, from the features of unit variance."""
        features = self.family.scaled(values, self.processes.amplitude)
        return (features @ self.weights.mean.reshape(len(features), -1, 1)).squeeze(-1).mT

    def expected(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n d"]:
        """Expected mean at x alone, a bounded number of rows at a time."""
        processes = self.processes
        weights = processes.amplitude[:, None] * self.weights.mean.reshape(len(self.theta), -1)
        # Of the kernel with the inducing inputs, from those of the features: no equations are solved for each row.
        weights = torch.linalg.solve_triangular(processes.features.factor.mT, weights.unsqueeze(-1), upper=True)
        return torch.cat([(processes.features.cross(part) @ weights).squeeze(-1).mT for part in x.split(_CHUNK)])


def fit_mean(
    search: Search,
    inputs: Float[Tensor, "n e"],
    means: Float[Tensor, "n d"],
    counts: Float[Tensor, " n"],
    noise_tril: Float[Tensor, "n d d"],
    whitener: Float[Tensor, "d n n"] | None,
) -> LatentMean:
    """Posterior given means of ``counts`` rows, whose noise has the factor ``noise_tril``.

    Hyperparameters are chosen for each output by its own evidence, as if the others did not tell of its
    noise; the posterior is that of all outputs together.
    """
    scale = (counts.sqrt()[:, None] / noise_tril.square().sum(-1).sqrt()).mT.unsqueeze(-1)
    noise_whitener = scale if whitener is None else whitener * scale.mT
    response = _times(whitener, scale * means.mT.unsqueeze(-1)).squeeze(-1)
    information = noise_whitener.square().sum((-2, -1))
    family = search.family
    fixed = FixedFeatures(family.features, inputs)

    def evidence(theta: Tensor, rows: Int64[Tensor, " a"]) -> tuple[Tensor, Gradient]:
        chosen = None if whitener is None else whitener[rows]
        design, vjp = family.design_vjp(fixed, theta, information[rows])
        whitened = _times(chosen, scale[rows] * design)
        linear = LinearEvidence.of(whitened, response[rows])

        def gradient() -> Tensor:
            of_whitened = linear.gradient(whitened, response[rows])
            return vjp(scale[rows] * _times(None if chosen is None else chosen.mT, of_whitened))

        return linear.value, gradient

    theta = search.run(evidence, means)
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


def _times(matrix: Tensor | None, values: Tensor) -> Tensor:
    return values if matrix is None else matrix @ values
