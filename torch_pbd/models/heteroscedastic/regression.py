"""Linear models whose weights are standard normal numbers a priori, and regressions of an output on those before it.

Whiteners are lower triangular matrices W that make correlated noise independent and of variance one. Along a line an
exponential correlation is that of a Markov process, in which a sample depends on the one before alone: W is bidiagonal
and W'W tridiagonal. W is stored as the matrix (n, n), n > 2; as its diagonal and subdiagonal (n, 2), which begins with
a zero; or as its diagonal (n, 1).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torch_pbd.linalg import log_det, safe_cholesky, symmetrize, triangular_inverse

_LARGEST_PRECISION = 1e9  # of a weight; that of its prior is one, and keeps fewer than seven digits beside a larger one
_RIDGE = 1e-8  # beside the scatter of standardized samples, which is one: keeps K <= d demonstrations regular
_ROUNDING = 1e-9  # share of a row's diagonal entry that an entry beside the two diagonals has by rounding


class NoiseCorrelation(NamedTuple):
    """Correlation of means, or of mean squares, of each output at n inputs."""

    whitener: Float[Tensor, "d n m"]
    """Makes them independent, of the variances of independent rows' ones."""
    copies: Float[Tensor, "d n"]
    """Rows at each input that count for one."""


def bidiagonal(matrix: Float[Tensor, "*b n n"]) -> Float[Tensor, "*b n m"]:
    """Whitener stored as its two diagonals, or as it is where it has more than these."""
    own, before = matrix.diagonal(dim1=-2, dim2=-1), matrix.diagonal(-1, dim1=-2, dim2=-1)
    if bool((matrix.tril(-2).abs() > _ROUNDING * own.unsqueeze(-1)).any()):
        return matrix
    return torch.stack([own, pad(before, (1, 0))], dim=-1)


def whiten(whitener: Float[Tensor, "*#b n m"], values: Float[Tensor, "*#b n p"]) -> Float[Tensor, "... n p"]:
    """Product W v."""
    if whitener.shape[-1] > 2:
        return whitener @ values
    own = whitener[..., :1] * values
    return own if whitener.shape[-1] == 1 else own + whitener[..., 1:] * values.roll(1, -2)


def whiten_vjp(whitener: Float[Tensor, "*#b n m"], gradient: Float[Tensor, "*#b n p"]) -> Float[Tensor, "... n p"]:
    """Product W'g."""
    if whitener.shape[-1] > 2:
        return whitener.mT @ gradient
    own = whitener[..., :1] * gradient
    return own if whitener.shape[-1] == 1 else own + (whitener[..., 1:] * gradient).roll(-1, -2)


def tridiagonal(whitener: Float[Tensor, "*b n m"]) -> tuple[Float[Tensor, "*b n"], Float[Tensor, "*b k"]] | None:
    """Diagonal of W'W and, k of n - 1, what is beside it; None where it has more than these."""
    if whitener.shape[-1] > 2:
        return None
    own, before = whitener[..., 0], whitener[..., 1:, 1:].flatten(-2)
    if whitener.shape[-1] == 1:
        return own.square(), before
    return own.square() + pad(before.square(), (0, 1)), before * own[..., 1:]


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
        return cls(-0.5 * square - log_det(factor), mean, factor)

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
        return 0.5 * (trace + self.mean.square().sum(-1) - self.mean.shape[-1]) + log_det(self.factor)


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


@dataclass(frozen=True)
class MixedResponses:
    """Responses at n inputs that mix i processes there, ``mixing @ values``, under noise of variance one.

    The noise is independent between the r rows of an input, and between inputs once it is whitened.
    """

    mixing: Float[Tensor, "n r i"]
    response: Float[Tensor, "n r"]
    whitener: Float[Tensor, "#r n m"]
    """W of each row, or of all."""

    @cached_property
    def whitened(self) -> Float[Tensor, "r n 1"]:
        """Responses multiplied by W."""
        return whiten(self.whitener, self.response.mT.unsqueeze(-1))

    @cached_property
    def cross(self) -> Float[Tensor, "n i"]:
        """Product of the rows at each input with the responses at all, weighted by W'W."""
        weighted = whiten_vjp(self.whitener, self.whitened).transpose(0, 1)
        return (self.mixing.mT @ weighted).squeeze(-1)

    @cached_property
    def couplings(self) -> tuple[Float[Tensor, "n i i"], Float[Tensor, "m i i"]] | None:
        """Products of the rows at one input and, m of n - 1, at one and the next, weighted by W'W.

        None where inputs are coupled with others too.
        """
        if (weights := tridiagonal(self.whitener)) is None:
            return None
        own, beside = (part.mT.unsqueeze(-1) for part in weights)
        first, after = self.mixing[: len(beside)], self.mixing[len(self.mixing) - len(beside) :]
        return self.mixing.mT @ (own * self.mixing), first.mT @ (beside * after)

    def design(self, features: Float[Tensor, "b #i n p"]) -> tuple[Float[Tensor, "b rn ip"], Float[Tensor, "b rn"]]:
        """Design of the whitened rows, and their responses."""
        features = features.expand(-1, self.mixing.shape[2], -1, -1)
        design = torch.einsum("nri,binp->brnip", self.mixing, features).flatten(3)
        return whiten(self.whitener, design).flatten(1, 2), self.whitened.flatten().expand(len(design), -1)

    def fit(self, features: Float[Tensor, "b #i n p"]) -> LinearEvidence:
        """Posterior of the weights of b sets of features, one process after another, with its log evidence.

        The block of processes j and k in D'D is the sum over inputs l and l' of ``F_jl' c F_kl'``, c their coupling. By
        way of the design D, of r rows an input, which it takes where floating point cannot hold the precision or
        couplings are too many, this would be r times the work.
        """
        if self.couplings is None:
            return LinearEvidence.fit(*self.design(features))
        (own, beside), size = self.couplings, self.mixing.shape[2]
        by_input, m = features.expand(-1, size, -1, -1).transpose(1, 2), len(beside)
        halves = []
        for j in range(size):
            right = 0.5 * own[:, j, :, None] * by_input
            right[:, :m] += beside[:, j, :, None] * by_input[:, len(own) - m :]
            halves.append(by_input[:, :, j].mT @ right.flatten(2))
        half = torch.stack(halves, dim=1).flatten(1, 2)
        precision = half + half.mT + torch.eye(half.shape[-1]).to(half)
        if float(precision.detach().diagonal(dim1=-2, dim2=-1).amax()) >= _LARGEST_PRECISION:
            return LinearEvidence.fit(*self.design(features))
        factor = safe_cholesky(precision, name="the precision of the latent weights")
        of_features = (self.cross.mT.unsqueeze(1) @ by_input.transpose(1, 2)).flatten(1).unsqueeze(-1)
        projected = torch.linalg.solve_triangular(factor, of_features, upper=False)
        mean = torch.linalg.solve_triangular(factor.mT, projected, upper=True).squeeze(-1)
        # Less y'y, as of the design, or values of a search would jump where digits end.
        square = projected.square().sum((-2, -1)) - self.whitened.square().sum()
        return LinearEvidence(0.5 * square - log_det(factor), mean, factor.mT)

    def weights(self, features: Float[Tensor, "#i n p"]) -> Weights:
        """Posterior of the weights of one set of features."""
        mean, root = self.fit(features.unsqueeze(0)).weights
        return Weights(mean[0], root[0])

    def gradient(self, linear: LinearEvidence, features: Float[Tensor, "b n p"]) -> Float[Tensor, "b n p"]:
        """Gradient of the log evidence in the features that all processes share.

        With the mean m and the precision P = I + X of the weights, and their inner products c with the response, it is
        that of ``m' c - tr((inv(P) + m m') X) / 2``: block (j, k) of X is the sum over coupled inputs l and r of
        ``weight_jk F_l F_r'``.
        """
        n_rows, size = self.mixing.shape[1:]
        if self.couplings is None:
            gradient = linear.gradient(*self.design(features.unsqueeze(1))).unflatten(1, (n_rows, -1))
            gradient = whiten_vjp(self.whitener, gradient).unflatten(3, (size, -1))
            return torch.einsum("nri,brnip->bnp", self.mixing, gradient)
        own, beside = (part.flatten(1).unsqueeze(1) for part in self.couplings)
        after, n = self.couplings[1].mT.flatten(1).unsqueeze(1), len(beside)
        second = linear.covariance + linear.mean.unsqueeze(-1) * linear.mean.unsqueeze(-2)
        in_features = []
        for mean, its_second, its_features in zip(linear.mean, second, features, strict=True):  # bounds the memory
            spread = _spread(its_second, its_features)
            weighted = own @ spread
            weighted[:n] += beside @ spread[len(spread) - n :]
            weighted[len(spread) - n :] += after @ spread[:n]
            in_features.append(self.cross @ mean.reshape(size, -1) - weighted.squeeze(1))
        return torch.stack(in_features)


@dataclass(frozen=True)
class Regression(MixedResponses):
    """Regression of an output on the i standardized outputs before it, at n inputs: coefficients are the processes.

    The mixing and the response are sufficient statistics of the rows at an input.
    """

    scatter: Float[Tensor, "n j j"]
    """Scatter of the i standardized outputs and, last, the output: j = i + 1."""
    precision: Float[Tensor, " n"]
    """Expected inverse of the output's conditional variance."""

    @classmethod
    def standardize(
        cls,
        scatter: Float[Tensor, "n j j"],
        tril: Float[Tensor, "n i i"],
        precision: Float[Tensor, " n"],
        whitener: Float[Tensor, "n m"],
    ) -> "Regression":
        """Regression of the last output of a scatter; ``tril`` is the factor of the others' covariance."""
        size = tril.shape[-1]
        # diag(inv(T), 1) S diag(inv(T), 1)': the outputs before get unit covariance, the last one keeps its unit.
        standardizing = torch.eye(size + 1).to(scatter).repeat(len(scatter), 1, 1)
        standardizing[:, :size, :size] = triangular_inverse(tril)
        scatter = symmetrize(standardizing @ scatter @ standardizing.mT)
        # Times the precision the scatter of the outputs before is R R', and that with the output R times the response.
        before = scatter[:, :size, :size] + _RIDGE * torch.eye(size).to(scatter)
        factor = safe_cholesky(before, name="the scatter of the outputs")
        root = precision.sqrt()[:, None, None] * factor
        cross = precision[:, None, None] * scatter[:, :size, size:]
        response = torch.linalg.solve_triangular(root, cross, upper=False).squeeze(-1)
        return cls(root.mT, response, whitener.unsqueeze(0), scatter, precision)

    def expected_squares(
        self, features: Float[Tensor, "n p"], mean: Float[Tensor, " ip"], covariance: Float[Tensor, "ip ip"]
    ) -> Float[Tensor, " n"]:
        """Expected sum of squared residuals, with the weights' mean and covariance."""
        # With coefficients b the sum of squares is (-b, 1) S (-b, 1)', and tr(before cov(b)) what their error adds.
        coefficients = features @ mean.reshape(-1, features.shape[1]).mT
        direction = torch.cat([-coefficients, torch.ones_like(coefficients[:, :1])], dim=1)
        explained = (direction.unsqueeze(1) @ self.scatter @ direction.unsqueeze(2)).flatten()
        spread = (self.mixing.mT @ self.mixing).flatten(1).unsqueeze(1) @ _spread(covariance, features)
        return explained.clamp_min(0.0) + (spread.squeeze(1) * features).sum(-1) / self.precision

    def local_squares(self) -> Float[Tensor, " n"]:
        """Sum of squared residuals from the coefficients that fit best at each input by itself."""
        return (self.scatter[:, -1, -1] - self.response.square().sum(-1) / self.precision).clamp_min(0.0)


def _spread(covariance: Float[Tensor, "ip ip"], features: Float[Tensor, "n p"]) -> Float[Tensor, "n ii p"]:
    """Each block of a covariance of the weights times the features of each input."""
    n_features = features.shape[-1]
    size = len(covariance) // n_features
    blocks = covariance.reshape(size, n_features, size, n_features).permute(3, 0, 2, 1)
    return (features @ blocks.flatten(1)).unflatten(-1, (size * size, n_features))
