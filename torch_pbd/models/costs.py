"""The paper's likelihoods, eq. (11) and (12), and their maximization over latent values under their prior."""

import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.gp.latent import LatentValues
from torch_pbd.linalg import cholesky_with_jitter, log_det
from torch_pbd.models import VARIANCE_FLOOR
from torch_pbd.models.links import Blocks, Covariances, Link
from torch_pbd.optim.batch import FitReport, Progress
from torch_pbd.optim.descent import minimize, minimize_scoring

Solver = Literal["auto", "fisher", "lbfgs"]


class Likelihood:
    """Negative log likelihood of all rows, eq. (11) and (12), times a weight: one over their number for nats per row.

    It is a function of the covariances at the inputs, and through a link of the latent deviations there. Of the rows it
    takes their ``counts`` and a root of the sums of ``w w'`` at each input, w the residuals from the mean. Derivatives
    are written in D, the change of a covariance over itself: dSigma = C D C'.
    """

    def __init__(
        self, link: Link, scatter_root: Float[Tensor, "n d r"], counts: Float[Tensor, " n"], weight: float
    ) -> None:
        self.link, self.weight = link, weight
        self._rows = scatter_root, counts[:, None, None]
        self._constant = 0.5 * scatter_root.shape[1] * math.log(2 * math.pi) * counts.sum()

    def __call__(self, deviation: Float[Tensor, "n b"]) -> Float[Tensor, ""]:
        """Value at deviations; differentiable by autograd, in the link's scale matrix too."""
        return self.at_root(self.link.root(deviation))

    def covariances(self, deviation: Float[Tensor, "n b"]) -> Covariances:
        """Covariances at deviations, and the rows there."""
        return Covariances(self.link.root(deviation), *self._rows)

    def at_root(self, root: Float[Tensor, "n d r"]) -> Float[Tensor, ""]:
        """Value of any roots."""
        # Sum over all rows of w' Sigma^-1 w / 2 + log det C + d log(2 pi) / 2, the sum of squares by input.
        scatter_root, counts = self._rows
        scale_tril = Covariances(root, *self._rows).scale_tril
        whitened = torch.linalg.solve_triangular(scale_tril, scatter_root, upper=False)
        return self.weight * (0.5 * whitened.square().sum() + counts[:, 0, 0] @ log_det(scale_tril) + self._constant)

    def gradient(self, point: Covariances) -> Float[Tensor, "n b"]:
        """Gradient in the deviations, in closed form."""
        # In D it is G = (n I - Z) / 2 with Z the whitened scatter, and in Sigma C^-T G C^-1. Sigma is root root' and a
        # floor that grows with the trace of that, so the root's gradient is twice
        # (C^-T G C^-1 + floor tr(C^-T G C^-1) I) root.
        in_change = 0.5 * self.weight * (point.expected_scatter - point.scatter)
        in_covariance = point.inverse.mT @ in_change @ point.inverse
        by_floor = VARIANCE_FLOOR * in_covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        in_covariance.diagonal(dim1=-2, dim2=-1).add_(by_floor.unsqueeze(-1))
        return self.link.vjp(point.root, 2.0 * in_covariance @ point.root)

    def curvature(self, point: Covariances, share: float) -> Blocks:
        """Fisher information in the deviations at each input: the expected one, and a share of the observed one."""
        for members, information in self.link.information(point):
            total = information * (self.weight * point.counts)
            if share:
                total = total.lerp(self.weight * self.link.observed_information(point), share)
            yield members, total


class _Posterior:
    """Negative log posterior density of whitened values, which a priori are standard normal, times the weight."""

    def __init__(self, likelihood: Likelihood, latent: LatentValues) -> None:
        self._likelihood, self._latent = likelihood, latent
        self._share = 0.0  # of the observed information in the curvature of the last step

    def __call__(self, whitened: Tensor) -> Tensor:
        """Loss, differentiable by autograd."""
        return self._likelihood(self._latent(whitened)) + 0.5 * self._likelihood.weight * whitened.square().sum()

    def newton(self, whitened: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient, and Newton's step.

        Its matrix is the expected information with as large a share of the observed one as leaves it positive
        definite: expected, it knows nothing of the bend of the valleys in which the vectors of a Wishart process turn.
        """
        point = self._likelihood.covariances(self._latent(whitened))
        gradient = self._latent.vjp(self._likelihood.gradient(point)) + self._likelihood.weight * whitened
        # Quarters, from one more than in the last step downwards: each that fails costs a decomposition.
        self._share = min(self._likelihood.link.largest_share, self._share + 0.25)
        factors = self.factors(point, self._share)
        while not factors:
            self._share -= 0.25
            factors = self.factors(point, self._share)
        step = torch.empty_like(gradient)
        for members, factor in factors:
            solved = torch.cholesky_solve(gradient[members].reshape(-1, 1), factor)
            step[members] = -solved.reshape(len(members), -1)
        return gradient, step

    def factors(self, point: Covariances, share: float = 0.0) -> list[tuple[Tensor, Tensor]]:
        """Indices of processes, and Cholesky factors of their curvature; none where a share leaves it indefinite."""
        factors = []
        for members, weight in self._likelihood.curvature(point, share):
            matrix = self._latent.normal_matrix(members, weight)
            matrix.diagonal().add_(self._likelihood.weight)
            factor, info = torch.linalg.cholesky_ex(matrix)
            if info > 0 and share > 0.0:
                return []
            if info > 0:
                factor = cholesky_with_jitter(matrix, name="the information of the latent values")[0]
            factors.append((members, factor))
        return factors

    def preconditioned(self, start: Tensor) -> Callable[[Tensor], Tensor]:
        """Whitened values of coordinates in which the curvature at a start, which is zero there, is the unit matrix."""
        with torch.no_grad():
            blocks = self.factors(self._likelihood.covariances(self._latent(start)))

        # With the curvature P = F F' and step = inv(F') z the quadratic form step' P step is |z|^2.
        def whitened(z: Tensor) -> Tensor:
            step = torch.zeros_like(z)
            for members, factor in blocks:
                solved = torch.linalg.solve_triangular(factor.mT, z[members].reshape(-1, 1), upper=True)
                step = step.index_copy(0, members, solved.reshape(len(members), -1))
            return start + step

        return whitened


def train(
    likelihood: Likelihood,
    latent: LatentValues,
    solver: Solver,
    max_iter: int,
    tol: float,
    callback: Callable[[Progress], None] | None = None,
) -> FitReport:
    """Maximize a likelihood times the prior density of latent values, in place, hyperparameters held.

    Latent values with hyperparameters that are trained, and the link's scale matrix with them, maximize the likelihood
    alone, as printed, by L-BFGS.

    Else the solver "fisher" takes Newton's steps. "lbfgs" is ``torch.optim.LBFGS`` in coordinates in which the
    curvature at the start is the unit matrix, unless a block of it exceeds the link's ``largest_block``. "auto" takes
    the first unless it does.
    """
    limits: Any = {"max_iter": max_iter, "tol": tol, "callback": callback}
    if latent.train_hyperparameters:
        matrix = likelihood.link.scale_matrix_tril
        trained = [*latent.trained(), *([] if matrix is None else [matrix])]
        return minimize(lambda: likelihood(latent()), trained, **limits)
    posterior = _Posterior(likelihood, latent)
    start = latent.whitened.detach().clone()
    small = likelihood.link.block_size * start.shape[1] <= likelihood.link.largest_block
    if solver == "fisher" or (solver == "auto" and small):
        found, report = minimize_scoring(posterior, posterior.newton, start, **limits)
    else:
        whitened = posterior.preconditioned(start) if small else start.add
        z = torch.zeros_like(start, requires_grad=True)
        report = minimize(lambda: posterior(whitened(z)), [z], **limits)
        found = whitened(z.detach())
    with torch.no_grad():
        latent.whitened.copy_(found)
    return report
