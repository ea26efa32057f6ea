"""The paper's cost functions with gradient and curvature in closed form, and their training by Fisher scoring."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from torch_pbd.gp import LatentValues
from torch_pbd.linalg import cholesky_with_jitter, tril_to_vector
from torch_pbd.models.cholesky import CholeskyLink
from torch_pbd.models.floor import VARIANCE_FLOOR, with_floor
from torch_pbd.models.wishart import WishartLink
from torch_pbd.optim import FitReport, Progress, minimize, minimize_scoring

Solver = Literal["auto", "fisher", "lbfgs"]


class _ClosedForm(torch.autograd.Function):
    """A scalar whose gradient is computed with it."""

    @staticmethod
    def forward(ctx: Any, deviation: Tensor, cost: "Cost") -> Tensor:
        point = Covariances(cost.link, deviation)
        value, gradient = cost.value_and_gradient(point)
        ctx.save_for_backward(gradient)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return gradients[0] * ctx.saved_tensors[0], None


class Covariances:
    """Covariances at the inputs with their floor: what all derivatives there are made of.

    Parameters
    ----------
    link : CholeskyLink or WishartLink
    deviation : Tensor of shape (n, b)
    """

    def __init__(self, link: CholeskyLink | WishartLink, deviation: Float[Tensor, "n b"]) -> None:
        self.root = link.root(deviation)
        # scale_tril_from_root without the orthogonal part
        upper = torch.linalg.qr(with_floor(self.root).mT, mode="r").R
        diagonal = upper.diagonal(dim1=-2, dim2=-1)
        self.scale_tril = (upper * torch.ones_like(diagonal).copysign(diagonal).unsqueeze(-1)).mT

    @cached_property
    def inverse(self) -> Tensor:
        """Of the factors."""
        return torch.linalg.inv(self.scale_tril).tril()


class Cost(ABC):
    """Function of the covariances at the inputs, and through a link of the latent deviations there.

    All of it is written in D, the change of a covariance over itself: dSigma = C D C', C its factor.
    """

    link: CholeskyLink | WishartLink
    has_exact_curvature = False
    relative_tol = 0.0

    def __call__(self, deviation: Float[Tensor, "n b"]) -> Float[Tensor, ""]:
        """Cost of the deviations, differentiable once."""
        value: Tensor = _ClosedForm.apply(deviation, self)
        return value

    def value(self, point: Covariances) -> Float[Tensor, ""]:
        """Cost alone."""
        return self._value_and_residual(point)[0]

    def value_and_gradient(self, point: Covariances) -> tuple[Float[Tensor, ""], Float[Tensor, "n b"]]:
        """Cost, and its gradient in the deviations."""
        value, residual = self._value_and_residual(point)
        # The covariance is root root' and a floor that grows with the trace of that.
        in_covariance = point.inverse.mT @ self._in_change(residual, point) @ point.inverse
        of_floor = VARIANCE_FLOOR * in_covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        in_covariance.diagonal(dim1=-2, dim2=-1).add_(of_floor.unsqueeze(-1))
        return value, self.link.pulled_back(point.root, 2.0 * in_covariance @ point.root)

    @abstractmethod
    def _value_and_residual(self, point: Covariances) -> tuple[Tensor, Tensor]:
        """Cost, and what its gradient is made of."""

    @abstractmethod
    def _in_change(self, residual: Tensor, point: Covariances) -> Tensor:
        """Gradient (n, d, d) in D, symmetric."""

    @abstractmethod
    def curvature(self, point: Covariances, share: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Second derivatives in the deviations at each input: indices of processes (m,), and their block (n, m, m).

        Positive semidefinite ones for a ``share`` of zero, exact ones for one, if there are any.
        """


class Likelihood(Cost):
    """Negative log likelihood, eq. (11) and (12), times a weight; its curvature is the expected information.

    Parameters
    ----------
    link : CholeskyLink or WishartLink
    scatter_root, counts
        As for :func:`torch_pbd.models.objectives.gaussian_nll`.
    weight : float
        One over the number of rows gives nats per row.
    """

    def __init__(
        self,
        link: CholeskyLink | WishartLink,
        scatter_root: Float[Tensor, "n d r"],
        counts: Float[Tensor, " n"],
        weight: float,
    ) -> None:
        self.link, self._scatter_root, self._weight = link, scatter_root, weight
        self._counts = counts[:, None, None]
        size = scatter_root.shape[1]
        self._identity = self._counts * torch.eye(size).to(scatter_root)
        self._constant = 0.5 * size * math.log(2 * math.pi) * counts.sum()
        self.has_exact_curvature = isinstance(link, WishartLink)

    def _value_and_residual(self, point: Covariances) -> tuple[Tensor, Tensor]:
        whitened = torch.linalg.solve_triangular(point.scale_tril, self._scatter_root, upper=False)
        log_det = self._counts[:, 0, 0] @ point.scale_tril.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return self._weight * (0.5 * whitened.square().sum() + log_det + self._constant), whitened

    def _in_change(self, residual: Tensor, point: Covariances) -> Tensor:
        return torch.baddbmm(self._identity, residual, residual.mT, beta=0.5 * self._weight, alpha=-0.5 * self._weight)

    def curvature(self, point: Covariances, share: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Expected Fisher information, and of a Wishart process a share of the observed one."""
        for members, information in self.link.information(point.root, point.inverse):
            total = information * (self._weight * self._counts)
            if share and isinstance(self.link, WishartLink):
                whitened = point.inverse @ self._scatter_root
                observed = self.link.observed_information(
                    point.root, point.inverse, whitened @ whitened.mT, self._counts
                )
                total = total.lerp(self._weight * observed, share)
            yield members, total


class FactorDistance(Cost):
    """Mean squared distance of the vectorized Cholesky factors, eq. (9); its curvature is Gauss and Newton's.

    Parameters
    ----------
    link : WishartLink
    target : Tensor of shape (n, d, d)
        Lower Cholesky factors.
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


class _Posterior:
    """Cost and prior as a function of whitened values."""

    def __init__(self, cost: Cost, latent: LatentValues, prior_weight: float) -> None:
        self.cost, self.latent, self.prior_weight = cost, latent, prior_weight
        self._share = 0.0
        self._last: tuple[Tensor, Covariances] | None = None

    def at(self, whitened: Tensor) -> Covariances:
        """Covariances of whitened values, kept until those of others are asked for."""
        if self._last is None or self._last[0] is not whitened:
            self._last = whitened, Covariances(self.cost.link, self.latent(whitened))
        return self._last[1]

    def loss(self, whitened: Tensor) -> Tensor:
        return self.cost.value(self.at(whitened)) + 0.5 * self.prior_weight * whitened.square().sum()

    def differentiable(self, whitened: Tensor) -> Tensor:
        """The loss, with its gradient in closed form."""
        return self.cost(self.latent(whitened)) + 0.5 * self.prior_weight * whitened.square().sum()

    def newton(self, whitened: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient, and Newton's step.

        Its matrix is the expected information with as large a share of the observed one as leaves it positive
        definite: expected, it knows nothing of the bend of the valleys in which the vectors of a Wishart process turn.
        """
        point = self.at(whitened)
        gradient = self.latent.pulled_back(self.cost.value_and_gradient(point)[1]) + self.prior_weight * whitened
        # Without a prior the curvature is singular, as vectors may turn: Levenberg and Marquardt's damping, which
        # vanishes with the gradient (Fan and Yuan 2005).
        damping = self.prior_weight or 1e-3 * float(gradient.abs().max())
        shares = [0.25 * i for i in range(5)] if self.cost.has_exact_curvature else [0.0]
        for share in reversed([share for share in shares if share <= self._share + 0.25]):
            factors = list(self.factors(point, damping, share))
            if share == 0.0 or all(bool((factor.diagonal() > 0).all()) for _, factor in factors):
                break
        self._share = share
        step = torch.empty_like(gradient)
        for members, factor in factors:
            solved = torch.cholesky_solve(gradient[members].reshape(-1, 1), factor)
            step[members] = -solved.reshape(len(members), -1)
        return gradient, step

    def factors(self, point: Covariances, damping: float, share: float = 0.0) -> Iterator[tuple[Tensor, Tensor]]:
        """Cholesky factors of the curvature: indices of the processes, and the factor of their block.

        One that is not positive definite, as can be for a ``share`` above zero, has zeros for a factor.
        """
        for members, weight in self.cost.curvature(point, share):
            matrix = self.latent.normal_matrix(members, weight)
            matrix.diagonal().add_(damping)
            factor, info = torch.linalg.cholesky_ex(matrix)
            if info > 0:
                name = "the information of the latent values"
                factor = torch.zeros_like(matrix) if share else cholesky_with_jitter(matrix, name=name)[0]
            yield members, factor


class _Unit:
    """Coordinates z of whitened values in which the curvature at the start is the unit matrix, and z = 0 is the start.

    Without blocks the coordinates are the whitened values less their start.
    """

    def __init__(self, start: Tensor, blocks: list[tuple[Tensor, Tensor]]) -> None:
        self.start, self.blocks = start, blocks

    def whitened(self, z: Tensor) -> Tensor:
        if not self.blocks:
            return self.start + z
        step = torch.zeros_like(z)
        for members, factor in self.blocks:
            solved = torch.linalg.solve_triangular(factor.mT, z[members].reshape(-1, 1), upper=True)
            step = step.index_copy(0, members, solved.reshape(len(members), -1))
        return self.start + step


def train_by_scoring(
    cost: Cost,
    latent: LatentValues,
    *,
    prior_weight: float,
    solver: Solver = "auto",
    max_iter: int,
    tol: float,
    callback: Callable[[Progress], None] | None = None,
) -> FitReport:
    """Minimize ``cost`` plus the negative log prior density of the latent values, hyperparameters held.

    Parameters
    ----------
    cost : Cost
    latent : LatentValues
        Starts where it is, and is left at the optimum.
    prior_weight : float
        Of the prior density, in units of the cost.
    solver : {"auto", "fisher", "lbfgs"}, default="auto"
        "fisher" takes Newton's steps with the curvature of the cost. "lbfgs" is ``torch.optim.LBFGS`` in coordinates
        in which the curvature at the start is the unit matrix, unless a block of it exceeds the link's
        ``largest_block``. "auto" takes the first unless it does.
    max_iter, tol, callback
        As in :func:`torch_pbd.optim.minimize`.
    """
    posterior = _Posterior(cost, latent, prior_weight)
    start = latent.whitened.detach().clone()
    small = cost.link.block_size(len(start)) * start.shape[1] <= cost.link.largest_block
    if solver == "fisher" or (solver == "auto" and small):
        found, report = minimize_scoring(
            posterior.loss,
            posterior.newton,
            start,
            max_iter=max_iter,
            tol=tol,
            relative_tol=cost.relative_tol,
            callback=callback,
        )
    else:
        blocks = list(posterior.factors(posterior.at(start), prior_weight)) if small and prior_weight else []
        unit, z = _Unit(start, blocks), torch.zeros_like(start, requires_grad=True)
        report = minimize(
            lambda: posterior.differentiable(unit.whitened(z)), [z], max_iter=max_iter, tol=tol, callback=callback
        )
        found = unit.whitened(z.detach())
    with torch.no_grad():
        latent.whitened.copy_(found)
    return report
