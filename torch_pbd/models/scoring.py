"""Training of latent values under their prior by Fisher scoring, or by L-BFGS that is preconditioned once."""

from collections.abc import Callable, Iterator
from typing import Any, Literal

import torch
from torch import Tensor

from torch_pbd.gp import LatentValues
from torch_pbd.linalg import cholesky_with_jitter
from torch_pbd.models.costs import Cost, Covariances
from torch_pbd.optim import FitReport, Progress, minimize, minimize_scoring

Solver = Literal["auto", "fisher", "lbfgs"]


class _Posterior:
    """Cost and negative log prior density as a function of whitened values, which a priori are standard normal."""

    def __init__(self, cost: Cost, latent: LatentValues, prior_weight: float) -> None:
        self.cost, self.latent, self.prior_weight = cost, latent, prior_weight
        self.share = 0.0
        """Share of the observed information in the curvature of the last step."""
        self._last: tuple[Tensor, Covariances] | None = None

    def at(self, whitened: Tensor) -> Covariances:
        """Covariances of whitened values, kept until those of others are asked for."""
        if self._last is None or self._last[0] is not whitened:
            self._last = whitened, Covariances.at(self.cost.link, self.latent(whitened))
        return self._last[1]

    def loss(self, whitened: Tensor) -> Tensor:
        """Loss alone, as the line search of Newton's method needs it."""
        return self.cost.value(self.at(whitened)) + 0.5 * self.prior_weight * whitened.square().sum()

    def differentiable(self, whitened: Tensor) -> Tensor:
        """Loss with its gradient, as L-BFGS needs it."""
        return self.cost(self.latent(whitened)) + 0.5 * self.prior_weight * whitened.square().sum()

    def newton(self, whitened: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient, and Newton's step.

        Its matrix is the expected information with as large a share of the observed one as leaves it positive
        definite: expected, it knows nothing of the bend of the valleys in which the vectors of a Wishart process turn.
        """
        point = self.at(whitened)
        gradient = self.latent.vjp(self.cost.value_and_gradient(point)[1]) + self.prior_weight * whitened
        # Without a prior the curvature is singular, as vectors may turn: Levenberg and Marquardt's damping, which
        # vanishes with the gradient (Fan and Yuan 2005).
        damping = self.prior_weight or 1e-3 * float(gradient.abs().max())
        # Quarters, from one more than in the last step downwards: each that fails costs a decomposition.
        shares = [0.25 * i for i in range(5)] if self.cost.has_exact_curvature else [0.0]
        for share in reversed([share for share in shares if share <= self.share + 0.25]):
            factors = list(self.factors(point, damping, share))
            if share == 0.0 or all(bool((factor.diagonal() > 0).all()) for _, factor in factors):
                break
        self.share = share
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

    ``latent`` starts where it is, and is left at the optimum; ``prior_weight`` is in units of the cost. The solver
    "fisher" takes Newton's steps with the curvature of the cost. "lbfgs" is ``torch.optim.LBFGS`` in coordinates in
    which the curvature at the start is the unit matrix, unless a block of it exceeds the link's ``largest_block``.
    "auto" takes the first unless it does.
    """
    posterior = _Posterior(cost, latent, prior_weight)
    start = latent.whitened.detach().clone()
    small = cost.link.block_size(len(start)) * start.shape[1] <= cost.link.largest_block
    limits: Any = {"max_iter": max_iter, "tol": tol, "callback": callback}
    if solver == "fisher" or (solver == "auto" and small):
        loss, newton = posterior.loss, posterior.newton
        found, report = minimize_scoring(loss, newton, start, relative_tol=cost.relative_tol, **limits)
    else:
        blocks = list(posterior.factors(posterior.at(start), prior_weight)) if small and prior_weight else []
        z = torch.zeros_like(start, requires_grad=True)
        report = minimize(lambda: posterior.differentiable(start + _step(z, blocks)), [z], **limits)
        found = start + _step(z.detach(), blocks)
    with torch.no_grad():
        latent.whitened.copy_(found)
    return report


def _step(z: Tensor, blocks: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Step of the whitened values, in coordinates z in which the curvature of these factors is the unit matrix."""
    if not blocks:
        return z
    # With the curvature P = F F' and step = inv(F') z the quadratic form step' P step is |z|^2.
    step = torch.zeros_like(z)
    for members, factor in blocks:
        solved = torch.linalg.solve_triangular(factor.mT, z[members].reshape(-1, 1), upper=True)
        step = step.index_copy(0, members, solved.reshape(len(members), -1))
    return step
