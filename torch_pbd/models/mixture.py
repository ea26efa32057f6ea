"""Gaussian mixtures over inputs and outputs together, and the regression that conditions them on inputs."""

import math
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn


@dataclass(frozen=True)
class Components:
    """k weighted Gaussians over p variables."""

    log_weight: Float[Tensor, " k"]
    mean: Float[Tensor, "k p"]
    scale_tril: Float[Tensor, "k p p"]

    def whiten(self, data: Float[Tensor, "n p"]) -> Float[Tensor, "k p n"]:
        """Each row in each component's frame, where that component is N(0, I)."""
        # Entries beyond 2e51 (in float64) are pulled back: squares of what follows stay finite, no inf - inf.
        limit = torch.finfo(data.dtype).max ** (1 / 6)
        residual = data.clamp(-limit, limit).mT - self.mean.unsqueeze(-1)
        return torch.linalg.solve_triangular(self.scale_tril, residual, upper=False)

    def log_joint(self, whitened: Float[Tensor, "k p n"]) -> Float[Tensor, "k n"]:
        """Log of weight times density, of each component at each row."""
        log_det = self.scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        peak = self.log_weight - log_det - 0.5 * self.mean.shape[-1] * math.log(2 * math.pi)
        return peak.unsqueeze(-1) - 0.5 * whitened.square().sum(1)

    def log_prob(self, data: Float[Tensor, "n p"]) -> Float[Tensor, " n"]:
        """Log density of the mixture."""
        return self.log_joint(self.whiten(data)).logsumexp(0)


@final
class GaussianMixture(nn.Module):
    """Gaussian mixture over the joint vector [x, y], inputs first.

    Calling it is Gaussian mixture regression (GMR; Calinon, Intelligent Service Robotics 9, 2016, section 5).
    Its parameters are unconstrained: any optimizer may move them.

    Parameters
    ----------
    log_weight : Tensor of shape (k,)
        Log of the components' weights; a common constant does not matter.
    mean : Tensor of shape (k, e + d)
        The components' means, in the units of the data.
    scale_tril : Tensor of shape (k, e + d, e + d)
        Lower Cholesky factors of the components' covariances.
    n_features : int
        Number of inputs e: the leading columns of the data.

    Raises
    ------
    ValueError
        If ``n_features`` leaves no input or no output, or a factor's diagonal is not positive.
    """

    def __init__(
        self,
        log_weight: Float[Tensor, " k"],
        mean: Float[Tensor, "k p"],
        scale_tril: Float[Tensor, "k p p"],
        n_features: int,
    ) -> None:
        super().__init__()
        if not 1 <= n_features < mean.shape[-1]:
            raise ValueError(f"n_features is {n_features}: it must be 1 to {mean.shape[-1] - 1}.")
        diagonal = scale_tril.diagonal(dim1=-2, dim2=-1)
        if not (diagonal > 0).all():
            raise ValueError("scale_tril has a diagonal entry that is not positive.")
        self.n_features = n_features
        self.log_weight = nn.Parameter(log_weight.detach().clone())
        self.mean = nn.Parameter(mean.detach().clone())
        self.log_diagonal = nn.Parameter(diagonal.detach().log())
        self.strict_lower = nn.Parameter(scale_tril.detach().tril(-1))
        self.log_density_floor: Tensor
        self.register_buffer("log_density_floor", mean.new_tensor(-math.inf))

    @property
    def scale_tril(self) -> Float[Tensor, "k p p"]:
        """Lower Cholesky factors of the components' covariances."""
        return self.strict_lower.tril(-1) + torch.diag_embed(self.log_diagonal.exp())

    def log_prob(self, data: Float[Tensor, "n p"]) -> Float[Tensor, " n"]:
        """Log density at each row [x, y]."""
        return self.components().log_prob(data)

    def log_prob_input(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """Log density of the inputs alone, at each row of ``x``."""
        return self.components(self.n_features).log_prob(x)

    def forward(self, x: Float[Tensor, "n e"]) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n d r"]]:
        """Mean of y given each row of ``x``, and a root of its covariance, r = k (d + 1).

        With h_k the responsibility of component k for x, and mu_k|x and Sigma_k|x what it says of y,

            mean = sum_k h_k mu_k|x,
            root @ root.mT = sum_k h_k (Sigma_k|x + (mu_k|x - mean)(mu_k|x - mean)^T).
        """
        e, scale_tril, inputs = self.n_features, self.scale_tril, self.components(self.n_features)
        whitened = inputs.whiten(x)
        log_share = inputs.log_joint(whitened).log_softmax(0).mT
        # Inputs come first, so the joint factor's lower blocks are what a Schur complement would give.
        component_mean = (self.mean[:, e:, None] + scale_tril[:, e:, :e] @ whitened).permute(2, 1, 0)
        mean = (component_mean @ log_share.exp().unsqueeze(-1)).squeeze(-1)
        root_share = (0.5 * log_share).exp()  # the gradient of sqrt(h) is infinite at h = 0
        between = root_share.unsqueeze(1) * (component_mean - mean.unsqueeze(-1))
        within = torch.einsum("nk,kij->nikj", root_share, scale_tril[:, e:, e:]).flatten(2)
        return mean, torch.cat([within, between], dim=-1)

    def type1(self, x: Float[Tensor, "n e"]) -> Float[Tensor, " n"]:
        """How far each row of ``x`` is from data: 0 on all training inputs, 1 far away.

        It is 1 - min(1, p(x) / p_min), p_min the lowest density of a training input (``log_density_floor``,
        set by the fits). A mixture knows only Type II uncertainty (paper, section IV-C): this measure is
        ours, and the covariance does *not* return to a prior where it is 1.
        """
        return -torch.expm1((self.log_prob_input(x) - self.log_density_floor).clamp(max=0.0))

    def components(self, size: int | None = None) -> Components:
        """The components, over the first ``size`` variables only where it is given."""
        log_weight = self.log_weight.log_softmax(0)
        return Components(log_weight, self.mean[:, :size], self.scale_tril[:, :size, :size])
