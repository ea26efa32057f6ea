"""Linear models whose weights are standard normal numbers a priori, and regressions of an output on those before it."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.linalg import safe_cholesky, symmetrize, triangular_inverse

# Of a weight; that of its prior is one, of which a sum with a larger one keeps fewer than seven digits.
_LARGEST_PRECISION = 1e9

# Beside the scatter of standardized samples, which is one in every direction: keeps K <= d demonstrations regular.
_RIDGE = 1e-8
_NO_NEIGHBOUR = 1e-9  # share of an inverse correlation's diagonal that is rounding between inputs that do not adjoin


class Weights(NamedTuple):
    """Normal distribution of the weights of features."""

    mean: Float[Tensor, "*b p"]
    root: Float[Tensor, "*b p p"]
    """Upper triangular; the covariance is ``root @ root.mT``."""


@dataclass(frozen=True)
class LinearEvidence:
    """Log density of ``response = design @ weights + noise`` with the weights integrated out, in nats.

    But for what no design changes. The noise is independent and of variance one. With the design D the posterior of the
    weights has the precision P = I + D'D and the mean m = inv(P) D'y, and the value is (m'P m - y'y - log|P|) / 2,
    without y'y where the response is not known.
    """

    value: Float[Tensor, "*b"]
    mean: Float[Tensor, "*b p"]
    factor: Float[Tensor, "*b p p"]
    """Upper triangular; ``factor.mT @ factor`` is P."""

    @classmethod
    def fit(cls, design: Float[Tensor, "*b n p"], response: Float[Tensor, "*b n"]) -> "LinearEvidence":
        """Evidence of b designs."""
        factor, projected = weights_factor(design, response)
        mean = torch.linalg.solve_triangular(factor, projected.unsqueeze(-1), upper=True).squeeze(-1)
        # m'P m - y'y = -|y - D m|^2 - m'm: where the noise is small the left hand side is a difference of numbers of
        # 1e13, and the right one of residuals; an error of m changes it by no more than its square.
        residual = response - (design @ mean.unsqueeze(-1)).squeeze(-1)
        square = residual.square().sum(-1) + mean.square().sum(-1)
        return cls(-0.5 * square - _log_det(factor), mean, factor)

    @cached_property
    def covariance(self) -> Float[Tensor, "*b p p"]:
        """Posterior covariance of the weights."""
        return torch.cholesky_inverse(self.factor, upper=True)

    @cached_property
    def weights(self) -> Weights:
        """Posterior of the weights."""
        return Weights(self.mean, triangular_inverse(self.factor, upper=True))

    def gradient(self, design: Float[Tensor, "*b n p"], response: Float[Tensor, "*b n"]) -> Float[Tensor, "*b n p"]:
        """Gradient of the value in the design: (y - D m) m' - D inv(P)."""
        residual = response.unsqueeze(-1) - design @ self.mean.unsqueeze(-1)
        return residual * self.mean.unsqueeze(-2) - design @ self.covariance

    def divergence_from_prior(self) -> Float[Tensor, "*b"]:
        """Kullback-Leibler divergence of the weights' posterior from standard normal numbers, in nats."""
        trace = self.covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        return 0.5 * (trace + self.mean.square().sum(-1) - self.mean.shape[-1]) + _log_det(self.factor)


def _log_det(factor: Float[Tensor, "*b p p"]) -> Float[Tensor, "*b"]:
    return factor.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)


def weights_factor(design: Tensor, response: Tensor) -> tuple[Tensor, Tensor]:
    """Upper factor R of the precision ``R' R`` of the weights, and the response projected: ``R mean = projected``.

    Where the noise is small beside what the features carry the precision, one on its diagonal beside their
    squares, cannot be formed in floating point; then by a QR decomposition, which is slower.
    """
    eye = torch.eye(design.shape[-1]).to(design)
    precision = design.mT @ design + eye
    if float(precision.diagonal(dim1=-2, dim2=-1).detach().amax()) < _LARGEST_PRECISION:
        lower = safe_cholesky(precision, name="the precision of the latent weights")
        projected = torch.linalg.solve_triangular(lower, design.mT @ response.unsqueeze(-1), upper=False)
        return lower.mT, projected.squeeze(-1)
    orthogonal, upper = torch.linalg.qr(torch.cat([design, eye.expand(*design.shape[:-2], -1, -1)], dim=-2))
    return upper, (orthogonal[..., : design.shape[-2], :].mT @ response.unsqueeze(-1)).squeeze(-1)


class Couplings(NamedTuple):
    """Scatters of the i outputs at an input with these and, last, the response, of coupled inputs: weighted by W'W."""

    own: Float[Tensor, "n i j"]
    """With those at the same input."""
    after: Float[Tensor, "m i j"]
    """With those at the next input: m = n - 1, or none where inputs are coupled with themselves alone."""
    before: Float[Tensor, "m i j"]
    """Of all inputs but the first, with those at the input before."""

    def scaled(self, precision: Float[Tensor, " n"]) -> "Couplings":
        """Scatters times the roots of the precisions on both sides."""
        root, n = precision.sqrt()[:, None, None], len(self.after)
        beside = root[:n] * root[len(root) - n :]
        return Couplings(precision[:, None, None] * self.own, beside * self.after, beside * self.before)

    def response(self) -> Float[Tensor, "n i"]:
        """Sum over the coupled inputs of the scatters with the response."""
        return _at_inputs(self.own[..., -1], self.after[..., -1], self.before[..., -1])

    def precision(self, features: Float[Tensor, "b n p"]) -> Float[Tensor, "b ip ip"]:
        """Precision of the weights: all pairs of coefficients by all products of two features."""
        own, after = self.own[..., :-1].flatten(1), self.after[..., :-1].flatten(1)
        first, last = features[:, : len(after)], features[:, len(own) - len(after) :]
        half = 0.5 * own.mT @ _products(features, features) + after.mT @ _products(first, last)
        size, n_features = self.own.shape[1], features.shape[-1]
        half = half.reshape(-1, size, size, n_features, n_features).transpose(2, 3)
        half = half.reshape(len(features), size * n_features, -1)
        return half + half.mT + torch.eye(size * n_features).to(features)

    def weighted(self, spread: Float[Tensor, "n ii p"]) -> Float[Tensor, "n p"]:
        """Sum over the coupled inputs and the pairs of outputs."""
        n = len(self.after)
        parts = zip(self, (spread, spread[len(spread) - n :], spread[:n]), strict=True)
        return _at_inputs(*((part[..., :-1].flatten(1).unsqueeze(1) @ each).squeeze(1) for part, each in parts))


def _products(left: Float[Tensor, "b m p"], right: Float[Tensor, "b m p"]) -> Float[Tensor, "b m pp"]:
    """All products of a feature on the left and one on the right."""
    return (left.unsqueeze(-1) * right.unsqueeze(-2)).flatten(2)


def _at_inputs(own: Float[Tensor, "n p"], after: Float[Tensor, "m p"], before: Float[Tensor, "m p"]) -> Tensor:
    """Sum at each input of what it has with itself, with the next one and with the one before."""
    none = own.new_zeros(len(own) - len(after), own.shape[1])
    return own + torch.cat([after, none]) + torch.cat([none, before])


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
        cls, scatter: Float[Tensor, "n j j"], tril: Float[Tensor, "n i i"], whitener: Float[Tensor, "n n"] | None
    ) -> "Regression":
        """Regression of the last output of a scatter; ``tril`` is the factor of the others' covariance."""
        size = tril.shape[-1]
        # diag(inv(T), 1) S diag(inv(T), 1)': the outputs before get unit covariance, the last one keeps its unit.
        standardizing = torch.eye(size + 1).to(scatter).repeat(len(scatter), 1, 1)
        standardizing[:, :size, :size] = triangular_inverse(tril)
        return cls(symmetrize(standardizing @ scatter @ standardizing.mT), whitener)

    @property
    def size(self) -> int:
        """Number i of outputs before."""
        return self.scatter.shape[-1] - 1

    @cached_property
    def before(self) -> Float[Tensor, "n i i"]:
        """Scatter of the i standardized outputs."""
        return self.scatter[:, :-1, :-1] + _RIDGE * torch.eye(self.size).to(self.scatter)

    @cached_property
    def root(self) -> Float[Tensor, "n i i"]:
        """Lower factor of the scatter of the i outputs."""
        return safe_cholesky(self.before, name="the scatter of the outputs")

    @cached_property
    def response(self) -> Float[Tensor, "n i"]:
        """Output at the root's rows: ``inv(root)`` times its scatter with the others."""
        return torch.linalg.solve_triangular(self.root, self.scatter[:, :-1, -1:], upper=False).squeeze(-1)

    @cached_property
    def couplings(self) -> Couplings | None:
        """Couplings of inputs with themselves and their neighbours; None where they are coupled with others too.

        The inverse W'W of an exponential correlation along a line is zero but for neighbours, as that of a Markov
        process.
        """
        # At each input the root's rows: of the outputs before, and of the response.
        rows = torch.cat([self.root.mT, self.response.unsqueeze(-1)], dim=-1)
        if self.whitener is None:
            return Couplings(torch.cat([self.before, self.scatter[:, :-1, -1:]], dim=-1), rows[:0], rows[:0])
        inverse = self.whitener.mT @ self.whitener
        if float(inverse.tril(-2).abs().max()) > _NO_NEIGHBOUR * float(inverse.diagonal().min()):
            return None
        own, beside = inverse.diagonal()[:, None, None], inverse.diagonal(1)[:, None, None]
        after, before = self.root[:-1] @ rows[1:], self.root[1:] @ rows[:-1]
        return Couplings(own * (self.root @ rows), beside * after, beside * before)

    def fit(self, features: Float[Tensor, "b n p"], precision: Float[Tensor, " n"]) -> LinearEvidence:
        """Posterior of the weights of b sets of features, one coefficient after another, with its log evidence.

        ``precision`` is the expected inverse of the conditional variance. Where inputs have to do with their
        neighbours at most, the precision of the weights is formed of its blocks: by way of the design, which has i
        rows an input, it would be i times the work.
        """
        if self.couplings is not None:
            couplings = self.couplings.scaled(precision)
            blocks = couplings.precision(features)
            if float(blocks.detach().diagonal(dim1=-2, dim2=-1).amax()) < _LARGEST_PRECISION:
                factor = safe_cholesky(blocks, name="the precision of the coefficients' weights")
                cross = (couplings.response().mT @ features).flatten(1).unsqueeze(-1)
                projected = torch.linalg.solve_triangular(factor, cross, upper=False)
                mean = torch.linalg.solve_triangular(factor.mT, projected, upper=True).squeeze(-1)
                return LinearEvidence(0.5 * projected.square().sum((-2, -1)) - _log_det(factor), mean, factor.mT)
        return LinearEvidence.fit(*self._design(features, precision))

    def gradient(
        self, linear: LinearEvidence, features: Float[Tensor, "b n p"], precision: Float[Tensor, " n"]
    ) -> Float[Tensor, "b n p"]:
        """Gradient of the log evidence in the features.

        With the mean m and the precision P = I + X of the weights, and their inner products c with the response, it is
        that of ``m' c - tr((inv(P) + m m') X) / 2``: block (j, k) of X is the sum over coupled inputs l and r of
        ``weight_jk F_l F_r'``.
        """
        n_inputs, n_features = features.shape[1:]
        if self.couplings is None:
            gradient = linear.gradient(*self._design(features, precision))
            gradient = gradient.reshape(len(features), n_inputs, self.size, self.size, n_features)
            gradient = torch.einsum("mn,bmajp->bnajp", self.whitener, gradient)
            return torch.einsum("n,nja,bnajp->bnp", precision.sqrt(), self.root, gradient)
        couplings = self.couplings.scaled(precision)
        response = couplings.response()
        second = linear.covariance + linear.mean.unsqueeze(-1) * linear.mean.unsqueeze(-2)
        in_features = []
        for mean, its_second, its_features in zip(linear.mean, second, features, strict=True):  # bounds the memory
            spread = self._spread(its_second, its_features)
            in_features.append(response @ mean.reshape(self.size, n_features) - couplings.weighted(spread))
        return torch.stack(in_features)

    def expected_squares(
        self, features: Float[Tensor, "n p"], mean: Float[Tensor, " ip"], covariance: Float[Tensor, "ip ip"]
    ) -> Float[Tensor, " n"]:
        """Expected sum of squared residuals, with the weights' mean and covariance."""
        # With coefficients b the sum of squares is (-b, 1) S (-b, 1)', and tr(before cov(b)) what their error adds.
        coefficients = features @ mean.reshape(self.size, -1).mT
        direction = torch.cat([-coefficients, torch.ones_like(coefficients[:, :1])], dim=1)
        explained = (direction.unsqueeze(1) @ self.scatter @ direction.unsqueeze(2)).flatten()
        spread = self.before.flatten(1).unsqueeze(1) @ self._spread(covariance, features)
        return explained.clamp_min(0.0) + (spread.squeeze(1) * features).sum(-1)

    def local_squares(self) -> Float[Tensor, " n"]:
        """Sum of squared residuals from the coefficients that fit best at each input by itself."""
        return (self.scatter[:, -1, -1] - self.response.square().sum(-1)).clamp_min(0.0)

    def _spread(self, covariance: Tensor, features: Tensor) -> Float[Tensor, "n ii p"]:
        """Each block of a covariance of the weights times the features (n, p) of each input."""
        size, n_features = self.size, features.shape[-1]
        blocks = covariance.reshape(size, n_features, size, n_features).permute(3, 0, 2, 1)
        return (features @ blocks.flatten(1)).unflatten(-1, (size * size, n_features))

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
