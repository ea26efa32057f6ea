"""The covariance's latent processes, and expectations over them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.models.heteroscedastic.linear import Weights
from torch_pbd.models.heteroscedastic.processes import Processes, ProcessFamily


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

    @property
    def resolved(self) -> bool:
        """Whether the inducing inputs resolve all length scales with room to spare, or are all the inputs."""
        of_log_variance = self.log_variance_family.resolved(self.log_variance_theta)
        return of_log_variance and self.coefficient_family.resolved(self.coefficient_theta)

    @cached_property
    def log_variances(self) -> Processes:
        """Processes of the logarithms of the conditional variances."""
        return self.log_variance_family.prepared(self.log_variance_theta)

    @cached_property
    def rows(self) -> Processes:
        """Processes of the coefficients: one for those of each output but the first."""
        return self.coefficient_family.prepared(self.coefficient_theta)

    def log_variance_of(self, values: Float[Tensor, "d n m"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d"]]:
        """Means and variances of the log variances, from the features of unit variance."""
        features = self.log_variance_family.scaled(values, self.log_variances.amplitude)
        mean = (features @ self.log_variance.mean.unsqueeze(-1)).squeeze(-1).mT
        variance = (features @ self.log_variance.root).square().sum(-1)
        return mean, (variance + self.log_variances.unexplained(features)).mT

    def at(self, x: Float[Tensor, "n e"]) -> "FactorMoments":
        """Moments of the entries of the factor at x."""
        return self.of_features(self.log_variances.features(x), self.rows.features(x) if self.coefficients else None)

    def of_features(self, values: Float[Tensor, "d n m"], of_rows: Float[Tensor, "d-1 n m"] | None) -> "FactorMoments":
        """The same, from the features of unit variance of the log variances and of the coefficients."""
        mean, variance = self.log_variance_of(values)
        below = torch.zeros(*mean.shape, mean.shape[1]).to(mean)
        below_variance = torch.zeros_like(below)
        if of_rows is not None:
            features = self.coefficient_family.scaled(of_rows, self.rows.amplitude)
            unexplained = self.rows.unexplained(features)
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

    def draw(self, x: Float[Tensor, "n e"], normal: Sequence[Float[Tensor, "*s _"]]) -> Float[Tensor, "*s n d d"]:
        """Factor at x of functions of the posterior, each made of standard normal numbers for each output's
        log variance and then for each output's coefficients.
        """
        n_outputs = len(self.log_variance.mean)
        features = self.log_variances(x)
        diagonal = []
        for i in range(n_outputs):
            weights = self.log_variance.mean[i] + normal[i] @ self.log_variance.root[i].mT
            diagonal.append(torch.exp(0.5 * (weights @ features[i].mT)))
        factor = torch.diag_embed(torch.stack(diagonal, dim=-1))
        if self.coefficients:
            features = self.rows(x)
        for i, posterior in enumerate(self.coefficients, start=1):
            weights = posterior.mean + normal[n_outputs + i - 1] @ posterior.root.mT
            factor[..., i, :i] = features[i - 1] @ weights.unflatten(-1, (i, -1)).mT
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
