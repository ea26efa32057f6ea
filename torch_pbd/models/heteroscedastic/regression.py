"""Regressions of an output on those before it, with coefficients that are linear in features."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.linalg import safe_cholesky, symmetrize
from torch_pbd.models.heteroscedastic.linear import LARGEST_PRECISION, LinearEvidence

# Beside the scatter of standardized samples, which is one in every direction: keeps K <= d demonstrations regular.
_RIDGE = 1e-8
_NO_NEIGHBOUR = 1e-9  # of an inverse correlation's diagonal: rounding, of inputs that are no neighbours


@dataclass(frozen=True)
class Regression:
    """Regression of an output on the i standardized outputs before it, at n inputs, with coefficients (n, i).

    ``root.mT @ coefficients`` is ``response`` but for noise of the output's conditional variance,
    independent between the rows of the root: sufficient statistics of the rows at an input.
    """

    scatter: Float[Tensor, "n j j"]
    """Scatter of the i standardized outputs and, last, the output: j = i + 1."""
    whitener: Float[Tensor, "n n"] | None
    """W, that makes the rows at different inputs independent; None where they are."""

    @classmethod
    def standardize(
        cls,
        scatter: Float[Tensor, "n j j"],
        tril: Float[Tensor, "n i i"],
        whitener: Float[Tensor, "n n"] | None,
    ) -> "Regression":
        """Regression of the last output of a scatter; ``tril`` is the factor of the others' covariance."""
        size = tril.shape[-1]
        # diag(inv(T), 1) S diag(inv(T), 1)': the outputs before get unit covariance, the last one keeps its unit.
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
        """Output at the root's rows: ``inv(root)`` times its scatter with the others."""
        return torch.linalg.solve_triangular(self.root, self.scatter[:, :-1, -1:], upper=False).squeeze(-1)

    @cached_property
    def couplings(self) -> "Couplings | None":
        """What inputs have to do with themselves and their neighbours; None where it is more than with these.

        The inverse W'W of an exponential correlation along a line is zero but for neighbours, as that of a Markov
        process.
        """
        every = torch.arange(len(self.scatter), device=self.scatter.device)
        if self.whitener is None:
            return Couplings(
                every, every, 0.5 * self.before, 0.5 * self.scatter[:, :-1, -1], 0.5 * self.scatter[:, :-1, -1]
            )
        inverse = self.whitener.mT @ self.whitener
        if float(inverse.tril(-2).abs().max()) > _NO_NEIGHBOUR * float(inverse.diagonal().min()):
            return None
        left, right = torch.cat([every, every[:-1]]), torch.cat([every, every[1:]])
        weight = torch.where(left == right, 0.5, 1.0) * inverse[left, right]
        root = weight[:, None, None] * self.root[left]
        across = (root @ self.response[right].unsqueeze(-1)).squeeze(-1)
        back = weight[:, None] * (self.root[right] @ self.response[left].unsqueeze(-1)).squeeze(-1)
        return Couplings(left, right, root @ self.root[right].mT, across, back)

    def fit(self, features: Float[Tensor, "b n p"], precision: Float[Tensor, " n"]) -> LinearEvidence:
        """Posterior of the weights of b sets of features, one coefficient after another, with its log evidence.

        ``precision`` is the expected inverse of the conditional variance. Where inputs have to do with their
        neighbours at most, the precision of the weights is formed of its blocks: by way of the design, which has i
        rows an input, it would be i times the work.
        """
        if self.couplings is not None:
            blocks = self._precision_of_weights(self.couplings, features, precision)
            if float(blocks.detach().diagonal(dim1=-2, dim2=-1).amax()) < LARGEST_PRECISION:
                factor = safe_cholesky(blocks, name="the precision of the coefficients' weights")
                cross = self.couplings.cross(precision).mT @ features
                projected = torch.linalg.solve_triangular(factor, cross.flatten(1).unsqueeze(-1), upper=False)
                return LinearEvidence.from_factor(factor.mT, projected.squeeze(-1))
        return LinearEvidence.fit(*self._design(features, precision))

    def gradient(
        self, linear: LinearEvidence, features: Float[Tensor, "b n p"], precision: Float[Tensor, " n"]
    ) -> Float[Tensor, "b n p"]:
        """Gradient of the log evidence in the features.

        With the mean m and the precision P = I + X + X' of the weights, and their inner products c with the response,
        it is ``m' dc - tr((inv(P) + m m') dX)``: block (j, k) of X is the sum over coupled inputs l and r of
        ``weight_jk F_l F_r'``.
        """
        size, n_features = self._shape(features)
        if self.couplings is None:
            gradient = linear.gradient(*self._design(features, precision))
            gradient = gradient.reshape(len(features), len(precision), size, size, n_features)
            gradient = torch.einsum("mn,bmajp->bnajp", self.whitener, gradient)
            return torch.einsum("n,nja,bnajp->bnp", precision.sqrt(), self.root, gradient)
        left, right = self.couplings.left, self.couplings.right
        second = linear.covariance + linear.mean.unsqueeze(-1) * linear.mean.unsqueeze(-2)
        onto_left, onto_right = self._spread(
            self.couplings.weight(precision), second, features[:, left], features[:, right]
        )
        gradient = self.couplings.cross(precision) @ linear.mean.reshape(-1, size, n_features)
        return gradient.index_add(1, left, -onto_left).index_add(1, right, -onto_right)

    def squares(
        self, features: Float[Tensor, "n p"], mean: Float[Tensor, " ip"], covariance: Float[Tensor, "ip ip"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Sum of squared residuals from the expected coefficients, and what their error adds to it.

        ``mean`` and ``covariance`` are of the weights.
        """
        # With coefficients b the sum of squares is (-b, 1) S (-b, 1)', and tr(before cov(b)) what their error adds.
        coefficients = features @ mean.reshape(self._shape(features)).mT
        direction = torch.cat([-coefficients, torch.ones_like(coefficients[:, :1])], dim=1)
        explained = (direction.unsqueeze(1) @ self.scatter @ direction.unsqueeze(2)).flatten()
        spread, _ = self._spread(self.before, covariance[None], features[None], features[None])
        unknown = (spread[0] * features).sum(-1)
        return explained.clamp_min(0.0), unknown

    def local_squares(self) -> Float[Tensor, " n"]:
        """Sum of squared residuals from the coefficients that fit best at each input by itself."""
        return (self.scatter[:, -1, -1] - self.response.square().sum(-1)).clamp_min(0.0)

    def _precision_of_weights(self, couplings: "Couplings", features: Tensor, precision: Tensor) -> Tensor:
        """Precision (b, i * p, i * p) of the weights."""
        size, n_features = self._shape(features)
        # Of all products of two features, or pair by pair of coefficients.
        weight = couplings.weight(precision).flatten(1).mT
        left, right = features[:, couplings.left], features[:, couplings.right]
        if self._by_squares(features):
            blocks = weight @ (left.unsqueeze(-1) * right.unsqueeze(-2)).flatten(2)
        else:
            blocks = left.mT.unsqueeze(1) @ (weight.unsqueeze(-1) * right.unsqueeze(1))
        blocks = blocks.reshape(-1, size, size, n_features, n_features).transpose(2, 3)
        half = blocks.reshape(len(features), size * n_features, -1)
        return half + half.mT + torch.eye(size * n_features).to(features)

    def _spread(self, weight: Tensor, covariance: Tensor, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        """Sums over j and k of ``weight_jk`` times that block of the weights' covariance: times the features on its
        right, and its transpose times those on its left.
        """
        size, n_features = self._shape(left)
        blocks = covariance.reshape(-1, size, n_features, size, n_features).transpose(2, 3)
        blocks = blocks.reshape(-1, size * size, n_features, n_features)
        weight = weight.flatten(1)
        if self._by_squares(left):
            total = (weight @ blocks.flatten(2)).unflatten(-1, (n_features, n_features))
            onto_right = (left.unsqueeze(-2) @ total).squeeze(-2)
            return (total @ right.unsqueeze(-1)).squeeze(-1), onto_right
        weight = weight.mT.unsqueeze(-1)
        onto_left = (weight * (right.unsqueeze(1) @ blocks.mT)).sum(1)
        return onto_left, (weight * (left.unsqueeze(1) @ blocks)).sum(1)

    def _by_squares(self, features: Tensor) -> bool:
        """Whether there are more pairs of coefficients than features: one large product is then the faster way."""
        size, n_features = self._shape(features)
        return size * size > n_features

    def _shape(self, features: Tensor) -> tuple[int, int]:
        return self.scatter.shape[-1] - 1, features.shape[-1]

    def _design(self, features: Tensor, precision: Tensor) -> tuple[Tensor, Tensor]:
        """Design (b, n * i, i * p) of the rows of the root at each input, whitened, and the response."""
        # Row a at an input holds root_ja F for each coefficient j: n i rows, of which the whitener mixes the inputs.
        weight = precision.sqrt()
        design = torch.einsum("n,nja,bnp->bnajp", weight, self.root, features).flatten(-2)
        response = weight[:, None] * self.response
        if self.whitener is not None:
            design = torch.einsum("mn,bnaq->bmaq", self.whitener, design)
            response = self.whitener @ response
        return design.flatten(1, 2), response.flatten().expand(len(design), -1)


@dataclass(frozen=True)
class Couplings:
    """Pairs of m inputs whose rows have to do with each other, the earlier ones on the left; of an input with itself
    half, as both sides count.
    """

    left: Int64[Tensor, " m"]
    right: Int64[Tensor, " m"]
    scatter: Float[Tensor, "m i i"]
    """Of the outputs on the left with those on the right."""
    across: Float[Tensor, "m i"]
    """Of the outputs on the left with the response on the right."""
    back: Float[Tensor, "m i"]
    """Of the outputs on the right with the response on the left."""

    def weight(self, precision: Float[Tensor, " n"]) -> Float[Tensor, "m i i"]:
        """Scatter times the root of the precisions on both sides."""
        return self._scale(precision)[:, :, None] * self.scatter

    def cross(self, precision: Float[Tensor, " n"]) -> Float[Tensor, "n i"]:
        """Inner products of the outputs with the response at each input."""
        scale = self._scale(precision)
        total = torch.zeros(len(precision), self.across.shape[1]).to(scale)
        return total.index_add(0, self.left, scale * self.across).index_add(0, self.right, scale * self.back)

    def _scale(self, precision: Tensor) -> Float[Tensor, "m 1"]:
        root = precision.sqrt()
        return (root[self.left] * root[self.right])[:, None]
