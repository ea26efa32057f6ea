"""Values of latent Gaussian processes that are to be trained: the paper's U."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from torch_pbd.gp.observations import Basis, Hyperparameters, LatentGP, Observations, levels_on_nodes
from torch_pbd.kernels import correlation
from torch_pbd.linalg import cholesky_with_jitter

# Directions of a kernel matrix with less than this of its largest eigenvalue carry no trained values.
_RANK_TOLERANCE = 1e-11


class LatentValues(nn.Module):
    """Values of b latent processes at n inputs, to be trained: the paper's U, whitened.

    The deviations from the prior mean are ``amplitude * basis @ whitened`` with ``basis @ basis.mT`` the
    kernel matrix; a priori the whitened values are independent standard normal numbers, which is what
    makes them easy to train. While the hyperparameters are held, the basis is that of the eigenvectors
    which matter: far fewer than inputs for a smooth kernel.

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
