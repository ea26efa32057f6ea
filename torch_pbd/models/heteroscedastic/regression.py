"""Regression of one output on the standardized ones before it, its coefficients Gaussian processes of the input."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.linalg import safe_cholesky, symmetrize
from torch_pbd.models.heteroscedastic.linear import Weights, log_evidence, weights_posterior

# Beside the scatter of standardized samples, which is one in every direction: keeps K <= d demonstrations regular.
_RIDGE = 1e-8


@dataclass(frozen=True)
class Regression:
    """What is known of the coefficients (n, i) of output i on i standardized outputs, at n inputs.

    ``root.mT @ coefficients`` is ``response`` but for noise of the output's conditional variance,
    independent between the rows of the root: sufficient statistics of the rows at an input.
    """

    root: Float[Tensor, "n i i"]
    response: Float[Tensor, "n i"]
    scatter: Float[Tensor, "n j j"]
    """Of the i standardized outputs and, last, the output: j = i + 1."""
    whitener: Float[Tensor, "n n"] | None

    @classmethod
    def of(
        cls,
        scatter: Float[Tensor, "n j j"],
        tril: Float[Tensor, "n i i"],
        whitener: Float[Tensor, "n n"] | None,
    ) -> "Regression":
        """Regression of the last output of a scatter; ``tril`` is the factor of the others' covariance."""
        size = tril.shape[-1]
        eye = torch.eye(size + 1).to(scatter)
        standardizing = eye.repeat(len(scatter), 1, 1)
        standardizing[:, :size, :size] = torch.linalg.solve_triangular(tril, eye[:size, :size], upper=False)
        scatter = symmetrize(standardizing @ scatter @ standardizing.mT)
        before = scatter[:, :-1, :-1] + _RIDGE * eye[:size, :size]
        root = safe_cholesky(before, name="the scatter of the outputs")
        response = torch.linalg.solve_triangular(root, scatter[:, :-1, -1:], upper=False).squeeze(-1)
        return cls(root, response, scatter, whitener)

    def fit(self, features: Float[Tensor, "n p"], precision: Float[Tensor, " n"]) -> Weights:
        """Posterior of the coefficients' weights, one coefficient after another.

        ``precision`` is the expected inverse of the conditional variance.
        """
        design, response = self._design(features[None], precision)
        return Weights(*weights_posterior(design[0], response))

    def evidence(self, features: Float[Tensor, "b n p"], precision: Float[Tensor, " n"]) -> Float[Tensor, " b"]:
        """Log evidence of the features, given the conditional variances, in nats."""
        design, response = self._design(features, precision)
        return log_evidence(design, response.expand(len(design), -1))

    def squares(self, features: Float[Tensor, "n p"], weights: Weights) -> tuple[Tensor, Tensor]:
        """Sum of squared residuals from the expected coefficients (n,), and what their error adds to it (n,)."""
        n_inputs, n_before = self.response.shape
        coefficients = features @ weights.mean.reshape(n_before, -1).mT
        direction = torch.cat([-coefficients, torch.ones_like(coefficients[:, :1])], dim=1)
        explained = (direction.unsqueeze(1) @ self.scatter @ direction.unsqueeze(2)).flatten()
        rows = torch.einsum("nja,np->najp", self.root, features).flatten(2)
        unknown = (rows.flatten(0, 1) @ weights.root).square().sum(-1).reshape(n_inputs, n_before).sum(-1)
        return explained.clamp_min(0.0), unknown

    def local_squares(self) -> Float[Tensor, " n"]:
        """Sum of squared residuals from the coefficients that fit best at each input by itself."""
        return (self.scatter[:, -1, -1] - self.response.square().sum(-1)).clamp_min(0.0)

    def _design(self, features: Tensor, precision: Tensor) -> tuple[Tensor, Tensor]:
        weight = precision.sqrt()
        design = torch.einsum("n,nja,bnp->bnajp", weight, self.root, features).flatten(-2)
        response = weight[:, None] * self.response
        if self.whitener is not None:
            design = torch.einsum("mn,bnaq->bmaq", self.whitener, design)
            response = self.whitener @ response
        return design.flatten(1, 2), response.flatten()
