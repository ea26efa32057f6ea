"""The paper's cost functions, eq. (9), (11) and (12), with gradient and curvature in closed form."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from torch_pbd.linalg import scale_tril_from_root, tril_to_vector
from torch_pbd.models.cholesky import CholeskyLink
from torch_pbd.models.conditional import VARIANCE_FLOOR, with_floor
from torch_pbd.models.wishart import WishartLink

Link = CholeskyLink | WishartLink


@dataclass(frozen=True)
class Covariances:
    """Covariances at the inputs: the root without the floor, and the Cholesky factor C with it."""

    root: Float[Tensor, "n d r"]
    scale_tril: Float[Tensor, "n d d"]

    @classmethod
    def at(cls, link: Link, deviation: Float[Tensor, "n b"]) -> "Covariances":
        """Covariances of latent deviations; not differentiable."""
        root = link.root(deviation)
        # As scale_tril_from_root, without the orthogonal part, which only a gradient needs.
        upper = torch.linalg.qr(with_floor(root).mT, mode="r").R
        diagonal = upper.diagonal(dim1=-2, dim2=-1)
        return cls(root, (upper * torch.ones_like(diagonal).copysign(diagonal).unsqueeze(-1)).mT)

    @cached_property
    def inverse(self) -> Float[Tensor, "n d d"]:
        """Inverse of C."""
        return torch.linalg.inv(self.scale_tril).tril()


class _ClosedForm(torch.autograd.Function):
    """A scalar whose gradient is computed with it."""

    @staticmethod
    def forward(ctx: Any, deviation: Tensor, cost: "Cost") -> Tensor:
        value, gradient = cost.value_and_gradient(Covariances.at(cost.link, deviation))
        ctx.save_for_backward(gradient)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0] * ctx.saved_tensors[0], None


class Cost(ABC):
    """Function of the covariances at the inputs, and through a link of the latent deviations there.

    All of it is written in D, the change of a covariance over itself: dSigma = C D C'.
    """

    link: Link
    has_exact_curvature = False
    relative_tol = 0.0

    def __call__(self, deviation: Float[Tensor, "n b"]) -> Float[Tensor, ""]:
        """Cost of the deviations, differentiable once."""
        value: Tensor = _ClosedForm.apply(deviation, self)
        return value

    def at_root(self, root: Float[Tensor, "n d r"]) -> Float[Tensor, ""]:
        """Cost of any roots, differentiable by autograd: eq. (9) and (11) as printed, where L is trained too."""
        return self.value(Covariances(root, scale_tril_from_root(with_floor(root))))

    def value(self, point: Covariances) -> Float[Tensor, ""]:
        """Cost alone."""
        return self._value_and_residual(point)[0]

    def value_and_gradient(self, point: Covariances) -> tuple[Float[Tensor, ""], Float[Tensor, "n b"]]:
        """Cost, and its gradient in the deviations."""
        value, residual = self._value_and_residual(point)
        # With G the gradient in D, that in Sigma is C^-T G C^-1. Sigma is root root' and a floor that grows with the
        # trace of that, so the root's gradient is twice (C^-T G C^-1 + floor tr(C^-T G C^-1) I) root.
        in_covariance = point.inverse.mT @ self._in_change(residual, point) @ point.inverse
        by_floor = VARIANCE_FLOOR * in_covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        in_covariance.diagonal(dim1=-2, dim2=-1).add_(by_floor.unsqueeze(-1))
        return value, self.link.vjp(point.root, 2.0 * in_covariance @ point.root)

    @abstractmethod
    def _value_and_residual(self, point: Covariances) -> tuple[Tensor, Tensor]:
        """Cost, and the residual that its gradient is made of."""

    @abstractmethod
    def _in_change(self, residual: Tensor, point: Covariances) -> Tensor:
        """Gradient (n, d, d) in D, symmetric."""

    @abstractmethod
    def curvature(self, point: Covariances, share: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Second derivatives in the deviations at each input: indices of processes (m,), and their block (n, m, m).

        Positive semidefinite ones for a ``share`` of zero, exact ones for one, if there are any.
        """


class Likelihood(Cost):
    """Negative log likelihood of all rows, eq. (11) and (12), times a weight: one over their number for nats per row.

    ``scatter_root`` is a root of the sums of ``w w'`` at each distinct input, w the residuals from the mean, as
    ``TrainingSet.scatter_root`` gives it; ``counts`` are the rows there.
    """

    def __init__(
        self, link: Link, scatter_root: Float[Tensor, "n d r"], counts: Float[Tensor, " n"], weight: float
    ) -> None:
        self.link, self._scatter_root, self._weight = link, scatter_root, weight
        self._counts = counts[:, None, None]
        size = scatter_root.shape[1]
        self._identity = self._counts * torch.eye(size).to(scatter_root)
        self._constant = 0.5 * size * math.log(2 * math.pi) * counts.sum()
        self.has_exact_curvature = isinstance(link, WishartLink)

    def _value_and_residual(self, point: Covariances) -> tuple[Tensor, Tensor]:
        # Sum over all rows of w' Sigma^-1 w / 2 + log det C + d log(2 pi) / 2, the sum of squares by input.
        whitened = torch.linalg.solve_triangular(point.scale_tril, self._scatter_root, upper=False)
        log_det = self._counts[:, 0, 0] @ point.scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return self._weight * (0.5 * whitened.square().sum() + log_det + self._constant), whitened

    def _in_change(self, residual: Tensor, point: Covariances) -> Tensor:
        # (n I - Z) / 2 with Z the whitened scatter.
        return torch.baddbmm(self._identity, residual, residual.mT, beta=0.5 * self._weight, alpha=-0.5 * self._weight)

    def curvature(self, point: Covariances, share: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Expected Fisher information, and of a Wishart process a share of the observed one."""
        for members, information in self.link.information(point.root, point.inverse):
            total = information * (self._weight * self._counts)
            if share and isinstance(self.link, WishartLink):
                whitened = point.inverse @ self._scatter_root
                scatter = whitened @ whitened.mT
                observed = self.link.observed_information(point.root, point.inverse, scatter, self._counts)
                total = total.lerp(self._weight * observed, share)
            yield members, total


class FactorDistance(Cost):
    """Mean squared distance J_MSE of the vectorized Cholesky factors to a target, eq. (9).

    Its curvature is Gauss and Newton's. The target are factors of the empirical covariances.
    """

    link: WishartLink
    relative_tol = 1e-3  # at more inputs than the kernel matrix has rank no vectors reach the target

    def __init__(self, link: WishartLink, target: Float[Tensor, "n d d"]) -> None:
        self.link, self._target = link, target

    def _value_and_residual(self, point: Covariances) -> tuple[Tensor, Tensor]:
        difference = point.scale_tril - self._target
        return difference.square().sum((-2, -1)).mean(), difference

    def _in_change(self, residual: Tensor, point: Covariances) -> Tensor:
        # dC = C tril(D) with half of the diagonal.
        in_factor = (point.scale_tril.mT @ residual).tril() * (2.0 / len(residual))
        lower = in_factor - 0.5 * torch.diag_embed(in_factor.diagonal(dim1=-2, dim2=-1))
        return 0.5 * (lower + lower.mT)

    def curvature(self, point: Covariances, share: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Squares of the derivatives of the factors."""
        for members, derivative in self.link.jacobian(point.root, point.scale_tril, point.inverse):
            entries = tril_to_vector(derivative)
            yield members, 2.0 / len(entries) * entries @ entries.mT
