"""Regression of one output on the standardized ones before it, its coefficients Gaussian processes of the input."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.linalg import safe_cholesky, symmetrize
from torch_pbd.models.heteroscedastic.linear import LARGEST_PRECISION, LinearEvidence

# Beside the scatter of standardized samples, which is one in every direction: keeps K <= d demonstrations regular.
_RIDGE = 1e-8


@dataclass(frozen=True)
class Regression:
    """What is known of the coefficients (n, i) of output i on i standardized outputs, at n inputs.

    ``root.mT @ coefficients`` is ``response`` but for noise of the output's conditional variance,
    independent between the rows of the root: sufficient statistics of the rows at an input.
    """

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
        return cls(symmetrize(standardizing @ scatter @ standardizing.mT), whitener)

    @cached_property
    def before(self) -> Float[Tensor, "n i i"]:
        """Scatter of the i standardized outputs."""
        before = self.scatter[:, :-1, :-1]
        return before + _RIDGE * torch.eye(before.shape[-1]).to(before)

    @cached_property
    def root(self) -> Float[Tensor, "n i i"]:
        """Lower factor of the scatter of the i outputs."""
        return safe_cholesky(self.before, name="the scatter of the outputs")

    @cached_property
    def response(self) -> Float[Tensor, "n i"]:
        """What the root's rows of the output are."""
        return torch.linalg.solve_triangular(self.root, self.scatter[:, :-1, -1:], upper=False).squeeze(-1)

    def fit(self, features: Float[Tensor, "b n p"], precision: Float[Tensor, " n"]) -> LinearEvidence:
        """Posterior of the weights of b sets of features, one coefficient after another, with its log evidence.

        ``precision`` is the expected inverse of the conditional variance. Where inputs are independent, the
        precision of the weights is formed of its blocks: by way of the design, which has i rows an input, it would
        be i times the work.
        """
        if self.whitener is None:
            blocks = self._precision_of_weights(features, precision)
            if float(blocks.detach().diagonal(dim1=-2, dim2=-1).amax()) < LARGEST_PRECISION:
                factor = safe_cholesky(blocks, name="the precision of the coefficients' weights")
                cross = (precision[:, None] * self.scatter[:, :-1, -1]).mT @ features
                projected = torch.linalg.solve_triangular(factor, cross.flatten(1).unsqueeze(-1), upper=False)
                return LinearEvidence.of_factor(factor.mT, projected.squeeze(-1))
        return LinearEvidence.of(*self._design(features, precision))

    def gradient(
        self, linear: LinearEvidence, features: Float[Tensor, "b n p"], precision: Float[Tensor, " n"]
    ) -> Float[Tensor, "b n p"]:
        """Of the log evidence in the features.

        With the precision P of the weights, its blocks ``F' diag(precision * before_jk) F`` and one, and their mean
        B as (i, p), it is at input n, where inputs are independent,
        ``precision (cross - before B F_n)' B - sum over j, k of precision before_jk inv(P)_jk F_n``.
        """
        size, n_features = self._shape(features)
        if self.whitener is not None:
            gradient = linear.gradient(*self._design(features, precision))
            gradient = gradient.reshape(len(features), len(precision), size, size, n_features)
            gradient = torch.einsum("mn,bmajp->bnajp", self.whitener, gradient)
            return torch.einsum("n,nja,bnajp->bnp", precision.sqrt(), self.root, gradient)
        weights = linear.mean.reshape(-1, size, n_features)
        expected = (self.before @ (features @ weights.mT).unsqueeze(-1)).squeeze(-1)
        told = precision[:, None] * (self.scatter[:, :-1, -1] - expected)
        return told @ weights - precision[:, None] * self._spread(linear.covariance, features)

    def squares(
        self, features: Float[Tensor, "n p"], mean: Float[Tensor, " ip"], covariance: Float[Tensor, "ip ip"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Sum of squared residuals from the expected coefficients, and what their error adds to it.

        ``mean`` and ``covariance`` are of the weights.
        """
        coefficients = features @ mean.reshape(self._shape(features)).mT
        direction = torch.cat([-coefficients, torch.ones_like(coefficients[:, :1])], dim=1)
        explained = (direction.unsqueeze(1) @ self.scatter @ direction.unsqueeze(2)).flatten()
        unknown = (self._spread(covariance[None], features[None])[0] * features).sum(-1)
        return explained.clamp_min(0.0), unknown

    def local_squares(self) -> Float[Tensor, " n"]:
        """Sum of squared residuals from the coefficients that fit best at each input by itself."""
        return (self.scatter[:, -1, -1] - self.response.square().sum(-1)).clamp_min(0.0)

    def _precision_of_weights(self, features: Tensor, precision: Tensor) -> Tensor:
        """(b, i * p, i * p)."""
        size, n_features = self._shape(features)
        weight = (precision[:, None, None] * self.before).flatten(1).mT
        if self._by_squares(features):
            blocks = weight @ _squares(features)
        else:
            blocks = features.mT.unsqueeze(1) @ (weight.unsqueeze(-1) * features.unsqueeze(1))
        blocks = blocks.reshape(-1, size, size, n_features, n_features).transpose(2, 3)
        return blocks.reshape(len(features), size * n_features, -1) + torch.eye(size * n_features).to(features)

    def _spread(self, covariance: Tensor, features: Tensor) -> Tensor:
        """Sum over j and k of ``before_jk`` times that block of the weights' covariance times the features."""
        size, n_features = self._shape(features)
        blocks = covariance.reshape(-1, size, n_features, size, n_features).transpose(2, 3)
        blocks = blocks.reshape(-1, size * size, n_features, n_features)
        if self._by_squares(features):
            total = (self.before.flatten(1) @ blocks.flatten(2)).unflatten(-1, (n_features, n_features))
            return (total @ features.unsqueeze(-1)).squeeze(-1)
        return (self.before.flatten(1).mT.unsqueeze(-1) * (features.unsqueeze(1) @ blocks)).sum(1)

    def _by_squares(self, features: Tensor) -> bool:
        """Whether there are more pairs of coefficients than features: one large product is then the faster way."""
        size, n_features = self._shape(features)
        return size * size > n_features

    def _shape(self, features: Tensor) -> tuple[int, int]:
        return self.scatter.shape[-1] - 1, features.shape[-1]

    def _design(self, features: Tensor, precision: Tensor) -> tuple[Tensor, Tensor]:
        weight = precision.sqrt()
        design = torch.einsum("n,nja,bnp->bnajp", weight, self.root, features).flatten(-2)
        response = weight[:, None] * self.response
        if self.whitener is not None:
            design = torch.einsum("mn,bnaq->bmaq", self.whitener, design)
            response = self.whitener @ response
        return design.flatten(1, 2), response.flatten().expand(len(design), -1)


def _squares(features: Float[Tensor, "b n p"]) -> Float[Tensor, "b n pp"]:
    return (features.unsqueeze(-1) * features.unsqueeze(-2)).flatten(2)
