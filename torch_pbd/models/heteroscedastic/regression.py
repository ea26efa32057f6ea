"""Linear models whose weights are standard normal numbers a priori, and regressions of an output on those before it.

Whiteners are lower triangular matrices W that make correlated noise independent and of variance one. Along a line an
exponential correlation is that of a Markov process, in which a sample depends on the one before alone: W is bidiagonal
and W'W tridiagonal. W is stored as the matrix (n, n), n > 2; as its diagonal and subdiagonal (n, 2), which begins with
a zero; or as its diagonal (n, 1).
"""

from dataclasses import dataclass, replace
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

    @classmethod
    def fit_blocks(
        cls,
        own: Float[Tensor, "n i i"],
        beside: Float[Tensor, "m i i"],
        features: Float[Tensor, "b i n p"],
        response: Float[Tensor, "n i"],
    ) -> "LinearEvidence | None":
        """Evidence, but for y'y, of b sets of i processes; None where floating point cannot hold their precision.

        The block of processes j and k in D'D is the sum over inputs l and l' of ``F_jl' c F_kl'``, with c from ``own``
        where they are the same, from ``beside``, m of n - 1, where l' is the next, and zero else. The ``response`` is
        D'y but for the features. By way of D, of i rows an input, this would be i times the work.
        """
        n_sets, size, n, n_features = features.shape
        by_input, m, halves = features.transpose(1, 2), len(beside), []
        for j in range(size):
            right = 0.5 * own[:, j, :, None] * by_input
            right[:, :m] += beside[:, j, :, None] * by_input[:, n - m :]
            halves.append(features[:, j].mT @ right.flatten(2))
        half = torch.stack(halves, dim=1).reshape(n_sets, size * n_features, -1)
        precision = half + half.mT + torch.eye(size * n_features).to(half)
        if float(precision.detach().diagonal(dim1=-2, dim2=-1).amax()) >= _LARGEST_PRECISION:
            return None
        factor = safe_cholesky(precision, name="the precision of the latent weights")
        of_features = (response.mT.unsqueeze(1) @ features).flatten(1).unsqueeze(-1)
        projected = torch.linalg.solve_triangular(factor, of_features, upper=False)
        mean = torch.linalg.solve_triangular(factor.mT, projected, upper=True).squeeze(-1)
        return cls(0.5 * projected.square().sum((-2, -1)) - log_det(factor), mean, factor.mT)

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
class Regression:
    """Regression of an output on the i standardized outputs before it, at n inputs, with coefficients (n, i).

    ``root.mT @ coefficients`` is ``response`` but for noise of variance one, independent between the rows of the root:
    sufficient statistics of the rows at an input.
    """

    scatter: Float[Tensor, "n j j"]
    """Scatter of the i standardized outputs and, last, the output: j = i + 1."""
    precision: Float[Tensor, " n"]
    """Expected inverse of the output's conditional variance."""
    whitener: Float[Tensor, "n m"]
    """W, that makes the rows at different inputs independent."""

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
        return cls(symmetrize(standardizing @ scatter @ standardizing.mT), precision, whitener)

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
        """Lower factor of the scatter of the i outputs times the precision."""
        factor = safe_cholesky(self.before, name="the scatter of the outputs")
        return self.precision.sqrt()[:, None, None] * factor

    @cached_property
    def response(self) -> Float[Tensor, "n i"]:
        """Output at the root's rows: ``inv(root)`` times its scatter with the others and the precision."""
        cross = self.precision[:, None, None] * self.scatter[:, :-1, -1:]
        return torch.linalg.solve_triangular(self.root, cross, upper=False).squeeze(-1)

    @cached_property
    def cross(self) -> Float[Tensor, "n i"]:
        """Product of the root's rows at each input with the responses at all, weighted by W'W."""
        weighted = whiten_vjp(self.whitener, whiten(self.whitener, self.response))
        return (self.root @ weighted.unsqueeze(-1)).squeeze(-1)

    @cached_property
    def couplings(self) -> tuple[Float[Tensor, "n i i"], Float[Tensor, "m i i"]] | None:
        """Products of the root's rows at one input and, m of n - 1, at one and the next, weighted by W'W.

        None where inputs are coupled with others too.
        """
        if (weights := tridiagonal(self.whitener)) is None:
            return None
        (own, beside), n = weights, len(self.root)
        after = self.root[n - len(beside) :].mT
        return own[:, None, None] * (self.root @ self.root.mT), beside[:, None, None] * (
            self.root[: len(after)] @ after
        )

    def fit(self, features: Float[Tensor, "b n p"]) -> LinearEvidence:
        """Posterior of the weights of b sets of features, one coefficient after another, with its log evidence."""
        if self.couplings is not None:
            of_each = features.unsqueeze(1).expand(-1, self.size, -1, -1)
            if (linear := LinearEvidence.fit_blocks(*self.couplings, of_each, self.cross)) is not None:
                # Less y'y, as of the design, or values of a search would jump where digits end.
                return replace(linear, value=linear.value - 0.5 * whiten(self.whitener, self.response).square().sum())
        return LinearEvidence.fit(*self._design(features))

    def gradient(self, linear: LinearEvidence, features: Float[Tensor, "b n p"]) -> Float[Tensor, "b n p"]:
        """Gradient of the log evidence in the features.

        With the mean m and the precision P = I + X of the weights, and their inner products c with the response, it is
        that of ``m' c - tr((inv(P) + m m') X) / 2``: block (j, k) of X is the sum over coupled inputs l and r of
        ``weight_jk F_l F_r'``.
        """
        if self.couplings is None:
            gradient = linear.gradient(*self._design(features)).unflatten(1, (-1, self.size)).flatten(2)
            gradient = whiten_vjp(self.whitener, gradient).unflatten(2, (self.size, self.size, -1))
            return torch.einsum("nja,bnajp->bnp", self.root, gradient)
        own, beside = (part.flatten(1).unsqueeze(1) for part in self.couplings)
        after, n = self.couplings[1].mT.flatten(1).unsqueeze(1), len(beside)
        second = linear.covariance + linear.mean.unsqueeze(-1) * linear.mean.unsqueeze(-2)
        in_features = []
        for mean, its_second, its_features in zip(linear.mean, second, features, strict=True):  # bounds the memory
            spread = self._spread(its_second, its_features)
            weighted = own @ spread
            weighted[:n] += beside @ spread[len(spread) - n :]
            weighted[len(spread) - n :] += after @ spread[:n]
            in_features.append(self.cross @ mean.reshape(self.size, -1) - weighted.squeeze(1))
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
        return (self.scatter[:, -1, -1] - self.response.square().sum(-1) / self.precision).clamp_min(0.0)

    def _spread(self, covariance: Tensor, features: Tensor) -> Float[Tensor, "n ii p"]:
        """Each block of a covariance of the weights times the features (n, p) of each input."""
        size, n_features = self.size, features.shape[-1]
        blocks = covariance.reshape(size, n_features, size, n_features).permute(3, 0, 2, 1)
        return (features @ blocks.flatten(1)).unflatten(-1, (size * size, n_features))

    def _design(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Design (b, n * i, i * p) of the rows of the root at each input, whitened, and the response."""
        # Row a at an input holds root_ja F for each coefficient j: n i rows, of which the whitener mixes the inputs.
        design = torch.einsum("nja,bnp->bnajp", self.root, features).flatten(2)
        response = whiten(self.whitener, self.response).flatten().expand(len(design), -1)
        return whiten(self.whitener, design).unflatten(2, (self.size, -1)).flatten(1, 2), response
