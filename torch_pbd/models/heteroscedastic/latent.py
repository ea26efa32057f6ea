"""The covariance's latent processes, and expectations over them."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.models.heteroscedastic.linear import Weights
from torch_pbd.models.heteroscedastic.processes import ProcessFamily


@dataclass(frozen=True)
class LatentCovariance:
    """Posterior of the lower factor of a covariance.

    The diagonal is the root of the conditional variances, whose logarithms are d processes; row i below it
    holds the coefficients of output i on the standardized outputs before it, which are i more.
    """

    log_variance_family: ProcessFamily
    coefficient_family: ProcessFamily
    log_variance_theta: Float[Tensor, "d q"]
    log_variance: Weights
    coefficient_theta: Float[Tensor, "d-1 q"]
    coefficients: Sequence[Weights]
    """Of outputs 1, 2, ...; the weights of one coefficient after another."""

    def at(self, x: Float[Tensor, "n e"]) -> "FactorMoments":
        """Moments of the entries of the factor at x."""
        features = self.log_variance_family.design(x, self.log_variance_theta)
        mean = (features @ self.log_variance.mean.unsqueeze(-1)).squeeze(-1).mT
        variance = (features @ self.log_variance.root).square().sum(-1)
        variance = (variance + self.log_variance_family.unexplained(features, self.log_variance_theta)).mT
        below = torch.zeros(*mean.shape, mean.shape[1]).to(mean)
        below_variance = torch.zeros_like(below)
        if self.coefficients:
            features = self.coefficient_family.design(x, self.coefficient_theta)
            unexplained = self.coefficient_family.unexplained(features, self.coefficient_theta)
            rows, variances = [], []
            for i, weights in enumerate(self.coefficients, start=1):
                pad = (0, mean.shape[1] - i)
                own = features[i - 1]
                rows.append(torch.nn.functional.pad(own @ weights.mean.reshape(i, -1).mT, pad))
                blocks = weights.root.reshape(i, own.shape[1], -1)
                known = (own @ blocks).square().sum(-1).mT
                variances.append(torch.nn.functional.pad(known + unexplained[i - 1, :, None], pad))
            below = torch.stack([below[:, 0], *rows], dim=1)
            below_variance = torch.stack([below_variance[:, 0], *variances], dim=1)
        return FactorMoments(mean, variance, below, below_variance)

    def draw(self, x: Float[Tensor, "n e"], normal: Sequence[Float[Tensor, " _"]]) -> Float[Tensor, "n d d"]:
        """Factor at x of one function of the posterior, made of standard normal numbers for each output's
        log variance and then for each output's coefficients.
        """
        n_outputs = len(self.log_variance.mean)
        features = self.log_variance_family.design(x, self.log_variance_theta)
        diagonal = []
        for i in range(n_outputs):
            weights = self.log_variance.mean[i] + self.log_variance.root[i] @ normal[i]
            diagonal.append(torch.exp(0.5 * (features[i] @ weights)))
        factor = torch.diag_embed(torch.stack(diagonal, dim=1))
        if self.coefficients:
            features = self.coefficient_family.design(x, self.coefficient_theta)
        for i, posterior in enumerate(self.coefficients, start=1):
            weights = posterior.mean + posterior.root @ normal[n_outputs + i - 1]
            factor[:, i, :i] = features[i - 1] @ weights.reshape(i, -1).mT
        return factor


@dataclass(frozen=True)
class FactorMoments:
    """Moments of the entries of the lower factor of a covariance at n inputs, as independent normal numbers."""

    log_variance: Float[Tensor, "n d"]
    log_variance_variance: Float[Tensor, "n d"]
    below: Float[Tensor, "n d d"]
    """Entries below the diagonal."""
    below_variance: Float[Tensor, "n d d"]

    def tril(self) -> Float[Tensor, "n d d"]:
        """The factor at the means of the latent processes."""
        return self.below + torch.diag_embed(torch.exp(0.5 * self.log_variance))

    def expected_root(self, most: float) -> Float[Tensor, "n d 2*d"]:
        """Root of the expected covariance.

        No log variance has a variance above ``most`` in it: of what is not known the expectation of a
        variance has little to say.
        """
        variance = self.log_variance_variance / (1.0 + self.log_variance_variance / most)
        deviation = torch.exp(0.5 * self.log_variance + 0.125 * variance)
        excess = deviation.square() * torch.expm1(0.25 * variance) + self.below_variance.sum(-1)
        return torch.cat([self.below + torch.diag_embed(deviation), torch.diag_embed(excess.sqrt())], dim=-1)
