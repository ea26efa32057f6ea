"""The paper's likelihoods, eq. (11) and (12), and their maximization over latent values under their prior."""

import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from torch_pbd.gp.observations import Basis, Hyperparameters, LatentGP, Observations, levels_on_nodes
from torch_pbd.kernels import correlation
from torch_pbd.linalg import cholesky_with_jitter, log_det
from torch_pbd.models import VARIANCE_FLOOR
from torch_pbd.models.links import Blocks, Covariances, Link
from torch_pbd.optim.batch import FitReport, Progress
from torch_pbd.optim.descent import minimize, minimize_scoring

Solver = Literal["auto", "fisher", "lbfgs"]

# Directions of a kernel matrix with less than this of its largest eigenvalue carry no trained values.
_RANK_TOLERANCE = 1e-11


class LatentValues(nn.Module):
    """Values of b latent processes at n inputs, to be trained: the paper's U, whitened.

    The deviations from the prior mean are ``amplitude * basis @ whitened`` with ``basis @ basis.mT`` the kernel matrix;
    a priori the whitened values are independent standard normal numbers, which is what makes them easy to train. While
    the hyperparameters are held, the basis is that of the eigenvectors which matter: few for a smooth kernel.

    Training starts at ``deviation``. Amplitude and length scale, then one for each process, are trained with the values
    if ``train_hyperparameters``.
    """

    inputs: Tensor
    basis: Tensor

    def __init__(
        self,
        inputs: Float[Tensor, "n e"],
        deviation: Float[Tensor, "b n"],
        amplitude: Float[Tensor, " b"],
        length_scale: Float[Tensor, "g e"],
        *,
        kernel: str = "squared_exponential",
        train_hyperparameters: bool = False,
    ) -> None:
        super().__init__()
        self.kernel, self.train_hyperparameters = kernel, train_hyperparameters
        if train_hyperparameters:
            length_scale = length_scale.expand(len(amplitude), -1)
        self.register_buffer("inputs", inputs)
        self.log_amplitude = nn.Parameter(amplitude.log(), requires_grad=train_hyperparameters)
        self.log_length_scale = nn.Parameter(length_scale.log(), requires_grad=train_hyperparameters)
        basis, self.jitter = self._basis()
        self.register_buffer("basis", basis.detach())
        self.whitened = nn.Parameter(self._whiten(deviation / amplitude[:, None]))

    def forward(self, whitened: Float[Tensor, "b r"] | None = None) -> Float[Tensor, "n b"]:
        """Deviations from the prior mean at the training inputs; of other whitened values, if given."""
        whitened = self.whitened if whitened is None else whitened
        basis = self._basis()[0] if self.train_hyperparameters else self.basis
        return (self.log_amplitude.exp()[:, None] * _product(basis, whitened)).mT

    def vjp(self, gradient: Float[Tensor, "n b"]) -> Float[Tensor, "b r"]:
        """Gradient in the whitened values, from that in the deviations."""
        return _product(self.basis.mT, self.log_amplitude.exp()[:, None] * gradient.mT)

    def normal_matrix(self, members: Int64[Tensor, " m"], weight: Float[Tensor, "n m m"]) -> Float[Tensor, "k k"]:
        """Second derivatives in the whitened values of some processes, of ``1/2 sum_t u_t' weight_t u_t``.

        ``u_t`` are those processes' deviations at input t; ``k`` counts their whitened values one after the other.
        Only the blocks on the diagonal and below are computed: above there are zeros.
        """
        # Process i has the deviations a_i B_i w_i: block (i, j) is the sum over t of a_i a_j weight_ij B_i' B_j.
        amplitude = self.log_amplitude.detach().exp()[members]
        weight = weight * (amplitude[:, None] * amplitude)
        weight = weight.permute(1, 2, 0).contiguous()
        basis = self.basis.expand(len(self.whitened), -1, -1)
        rank, transposed = basis.shape[-1], self.basis.mT.contiguous()
        matrix = weight.new_zeros(len(members), rank, len(members), rank)
        for row in range(len(members)):
            right = transposed if len(transposed) == 1 else transposed[members[: row + 1]]
            left = weight[row, : row + 1].unsqueeze(1) * right
            block = left.flatten(0, 1) @ basis[members[row]]
            matrix[row, :, : row + 1] = block.reshape(row + 1, rank, rank).permute(2, 0, 1)
        return matrix.reshape(len(members) * rank, -1)

    def trained(self) -> list[Tensor]:
        """The parameters an optimizer may change."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    @torch.no_grad()
    def interpolate(self, values: Float[Tensor, "b n"], deviation: Float[Tensor, "b n"] | None = None) -> LatentGP:
        """Gaussian processes through ``deviation``, by None the present one, and without a prior through ``values``."""
        if self.train_hyperparameters:
            self.basis, self.jitter = self._basis()
        amplitude = self.log_amplitude.exp()
        hyperparameters = Hyperparameters(self.log_length_scale.exp(), amplitude.clone(), torch.zeros_like(amplitude))
        whitened = self.whitened if deviation is None else self._whiten(deviation / amplitude[:, None])
        weights = amplitude[:, None] * self._weight(whitened), self._weight(self._whiten(values))
        return LatentGP(self.inputs, *weights, hyperparameters, torch.ones_like(self.inputs[:, 0]), self.kernel)

    def _basis(self) -> tuple[Tensor, float]:
        """Root of the kernel matrix, and its jitter: a Cholesky factor, or eigenvectors that matter."""
        length_scale, inputs = self.log_length_scale.exp(), self.inputs
        # Trained length scales need a basis that autograd can differentiate.
        if self.train_hyperparameters:
            gram = correlation(inputs, inputs, length_scale, self.kernel)
            return cholesky_with_jitter(gram, name="the kernel matrix of the training inputs")
        levels = levels_on_nodes(inputs, self.kernel, len(inputs))
        n_nodes = next((size for shortest, size in levels if shortest <= float(length_scale.min())), None)
        once = Observations(inputs, inputs.new_zeros(0, len(inputs)), torch.ones_like(inputs[:, 0]))
        few = Basis(once, n_nodes)
        gram = few.covariance(correlation(few.nodes, few.nodes, length_scale, self.kernel))
        eigenvalue, eigenvector = torch.linalg.eigh(gram)
        # Of several length scales: directions that matter to none are left out, those of some are zero for others.
        matters = eigenvalue > _RANK_TOLERANCE * eigenvalue[..., -1:]
        root = eigenvalue.where(matters, 0.0).sqrt()
        basis = (eigenvector * root.unsqueeze(-2))[..., matters.any(0)]
        return (basis if few.orthogonal is None else few.orthogonal @ basis).contiguous(), 0.0

    def _whiten(self, deviation: Tensor) -> Tensor:
        """Whitened values whose deviations, over the amplitude, come nearest to these."""
        if self.train_hyperparameters:
            return torch.linalg.solve_triangular(self.basis, deviation.unsqueeze(-1), upper=False)[..., 0].contiguous()
        # Columns are orthogonal, so that least squares is one division each.
        return _product(self.basis.mT, deviation) / self._square()

    def _weight(self, whitened: Tensor) -> Tensor:
        """Inverse of the kernel matrix times the deviations, over the amplitude, of whitened values."""
        if self.train_hyperparameters:
            return torch.linalg.solve_triangular(self.basis.mT, whitened.unsqueeze(-1), upper=True)[..., 0].contiguous()
        return _product(self.basis, whitened / self._square())

    def _square(self) -> Float[Tensor, "g r"]:
        """Squared norm of each column of the basis; one for those that are zero."""
        square = self.basis.square().sum(-2)
        return square.where(square > 0, 1.0)


def _product(matrix: Float[Tensor, "g m n"], vectors: Float[Tensor, "b n"]) -> Float[Tensor, "b m"]:
    return (matrix @ vectors.unsqueeze(-1)).squeeze(-1).contiguous()


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
