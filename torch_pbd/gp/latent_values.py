"""Values of latent Gaussian processes at the training inputs, to be trained: the paper's U, whitened."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from torch_pbd.gp.latent import LatentGP
from torch_pbd.gp.observations import Hyperparameters
from torch_pbd.kernels import KERNELS, correlation
from torch_pbd.linalg import cholesky_with_jitter

# Directions of a kernel matrix with less than this of its largest eigenvalue carry no trained values.
_RANK_TOLERANCE = 1e-11
_MAX_PIVOTS = 128


def pivoted_root(inputs: Float[Tensor, "n e"], length_scale: Float[Tensor, " e"], kernel: str) -> Tensor | None:
    """Root (n, r) of the kernel matrix by Cholesky decomposition with pivots; None where r would be large.

    Only r columns of the matrix are ever computed. What is left of the diagonal bounds the rest: it is below a
    tenth of the eigenvalues that do not matter.
    """
    limit = min(len(inputs), _MAX_PIVOTS)
    columns = inputs.new_zeros(limit, len(inputs))
    rest = torch.ones_like(inputs[:, 0])
    scaled = inputs / length_scale
    # Column r is (K e_p - L L_p') / sqrt(rest_p) of the columns L before it: Cholesky's, with the pivot p where most of
    # the variance is left.
    for rank in range(limit):
        pivot = int(rest.argmax())
        largest = float(rest[pivot])
        if largest <= 0.1 * _RANK_TOLERANCE:
            return columns[:rank].mT
        column = KERNELS[kernel].value((scaled - scaled[pivot]).square().sum(1))
        column = column.addmv_(columns[:rank].mT, columns[:rank, pivot], alpha=-1.0).div_(largest**0.5)
        columns[rank] = column
        rest.addcmul_(column, column, value=-1.0)
        rest[pivot] = 0.0
    return columns.mT if limit == len(inputs) else None


def _orthogonal(root: Tensor) -> Tensor:
    """Root of the same matrix with orthogonal columns, without those that do not matter.

    Of each column, whose sign is arbitrary, the entry at the first input is not negative.
    """
    # With root = U S V' the matrix is U S^2 U': V is a rotation of the whitened values, which changes nothing.
    vectors, values, _ = torch.linalg.svd(root, full_matrices=False)
    basis = (vectors * values)[:, values.square() > _RANK_TOLERANCE * values[0].square()]
    return torch.where(basis[0] < 0, -basis, basis).contiguous()


class LatentValues(nn.Module):
    """Values of b latent processes at n inputs, to be trained: the paper's U, whitened.

    The deviations from the prior mean are ``amplitude * basis @ whitened`` with ``basis @ basis.mT`` the
    kernel matrix; a priori the whitened values are independent standard normal numbers, which is what
    makes them easy to train. While the hyperparameters are held, the basis is that of the eigenvectors
    which matter: far fewer than inputs for a smooth kernel.

    Parameters
    ----------
    inputs : Tensor of shape (n, e)
    deviation : Tensor of shape (b, n)
        Where training starts.
    amplitude : Tensor of shape (b,)
    length_scale : Tensor of shape (1, e) or (b, e)
    kernel : str
    train_hyperparameters : bool
        Whether amplitude and length scale, then one for each process, are trained with the values.
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
        self.whitened = nn.Parameter(self._solved(deviation / amplitude[:, None]))

    def forward(self, whitened: Float[Tensor, "b r"] | None = None) -> Float[Tensor, "n b"]:
        """Deviations from the prior mean at the training inputs; of other whitened values, if given."""
        whitened = self.whitened if whitened is None else whitened
        basis = self._basis()[0] if self.train_hyperparameters else self.basis
        deviation = (basis @ whitened.unsqueeze(-1)).squeeze(-1)
        return (self.log_amplitude.exp()[:, None] * deviation).mT

    def vjp(self, gradient: Float[Tensor, "n b"]) -> Float[Tensor, "b r"]:
        """Gradient in the whitened values, from that in the deviations."""
        scaled = self.log_amplitude.exp()[:, None] * gradient.mT
        return (self.basis.mT @ scaled.unsqueeze(-1)).squeeze(-1)

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
        whitened = self.whitened if deviation is None else self._solved(deviation / amplitude[:, None])
        weight = amplitude[:, None] * self._weight(whitened)
        counts = torch.ones_like(self.inputs[:, 0])
        value_weight = self._weight(self._solved(values))
        return LatentGP(self.inputs, weight, value_weight, hyperparameters, counts, self.kernel)

    def _basis(self) -> tuple[Tensor, float]:
        length_scale = self.log_length_scale.exp()
        if not self.train_hyperparameters and len(length_scale) == 1:
            root = pivoted_root(self.inputs, length_scale[0], self.kernel)
            if root is not None:
                return _orthogonal(root)[None], 0.0
        gram = correlation(self.inputs, self.inputs, length_scale, self.kernel)
        # Trained length scales need a basis that autograd can differentiate: a Cholesky factor, of full rank.
        if self.train_hyperparameters:
            return cholesky_with_jitter(gram, name="the kernel matrix of the training inputs")
        eigenvalue, eigenvector = torch.linalg.eigh(gram)
        # Of several length scales: directions that matter to none are left out, those of some are zero for others.
        matters = eigenvalue > _RANK_TOLERANCE * eigenvalue[..., -1:]
        root = eigenvalue.where(matters, 0.0).sqrt()
        return (eigenvector * root.unsqueeze(-2))[..., matters.any(0)], 0.0

    def _solved(self, deviation: Tensor) -> Tensor:
        """Whitened values whose deviations, over the amplitude, come nearest to these."""
        deviation = deviation.unsqueeze(-1)
        if self.train_hyperparameters:
            return torch.linalg.solve_triangular(self.basis, deviation, upper=False).squeeze(-1).contiguous()
        # Columns are orthogonal, so that least squares is one division each.
        return (self.basis.mT @ deviation / self._square()).squeeze(-1).contiguous()

    def _weight(self, whitened: Tensor) -> Tensor:
        """Inverse of the kernel matrix times the deviations, over the amplitude, of whitened values."""
        if self.train_hyperparameters:
            solved = torch.linalg.solve_triangular(self.basis.mT, whitened.unsqueeze(-1), upper=True)
            return solved.squeeze(-1).contiguous()
        return (self.basis @ (whitened.unsqueeze(-1) / self._square())).squeeze(-1).contiguous()

    def _square(self) -> Tensor:
        """Squared norm of each column of the basis, which are orthogonal; one for those that are zero."""
        square = self.basis.square().sum(-2).unsqueeze(-1)
        return square.where(square > 0, 1.0)
