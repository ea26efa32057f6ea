"""Latent Gaussian processes: prediction from observed values, eq. (5) and (6), and values that are to be trained.

Several observations of one input enter as their mean and their count: the noise of a mean is the noise over the
root of the count. Targets are those from which the prior mean is subtracted.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from torch_pbd.gp.observations import Basis, Hyperparameters, Observations, levels_on_nodes
from torch_pbd.kernels import correlation
from torch_pbd.linalg import cholesky_with_jitter, safe_cholesky

# Directions of a kernel matrix with less than this of its largest eigenvalue carry no trained values.
_RANK_TOLERANCE = 1e-11


class LatentGP(nn.Module):
    """b independent Gaussian processes with the same training inputs, conditioned on their values.

    Parameters
    ----------
    inputs : Tensor of shape (n, e)
        Training inputs, or nodes that stand for them.
    weight : Tensor of shape (b, n)
        Weights of the correlations with the inputs in eq. (5): the inverse of the matrix there, times the squared
        amplitude and the observed deviations from the prior mean.
    value_weight : Tensor of shape (b, n)
        Weights of the values without a prior, see :meth:`values`.
    hyperparameters : Hyperparameters
        Hyperparameters of the b processes; ``length_scale`` has the shape (1, e) where all share it.
    counts : Tensor of shape (n,)
        Number of observations of each value, which divides the noise variance.
    kernel : str
    root : Tensor of shape (r, n), default=None
        Linear combinations of the values that were observed, where the inputs are nodes.
    """

    inputs: Tensor
    value_weight: Tensor
    length_scale: Tensor
    amplitude: Tensor
    noise_ratio: Tensor
    counts: Tensor
    root: Tensor | None

    def __init__(
        self,
        inputs: Float[Tensor, "n e"],
        weight: Float[Tensor, "b n"],
        value_weight: Float[Tensor, "b n"],
        hyperparameters: Hyperparameters,
        counts: Float[Tensor, " n"],
        kernel: str = "squared_exponential",
        root: Float[Tensor, "r n"] | None = None,
    ) -> None:
        super().__init__()
        self.kernel = kernel
        self.weight = nn.Parameter(weight)
        self.register_buffer("inputs", inputs)
        self.register_buffer("value_weight", value_weight)
        self.register_buffer("length_scale", hyperparameters.length_scale)
        self.register_buffer("amplitude", hyperparameters.amplitude)
        self.register_buffer("noise_ratio", hyperparameters.noise_ratio)
        self.register_buffer("counts", counts)
        self.register_buffer("root", root)

    def forward(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Mean at x less the prior mean: eq. (5)."""
        return self._weighted(x, self.weight)[0]

    def values(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Mean at x of the processes of ``value_weight``, whose prior mean is zero: what data alone say."""
        return self._weighted(x, self.value_weight)[0]

    def both(self, x: Float[Tensor, "m e"]) -> list[Float[Tensor, "m b"]]:
        """Results of :meth:`forward` and :meth:`values`, by one matrix of correlations."""
        return self._weighted(x, self.weight, self.value_weight)

    def _weighted(self, x: Tensor, *weights: Tensor) -> list[Tensor]:
        cross = correlation(x, self.inputs, self.length_scale, self.kernel)
        # Processes that share their length scales share the correlations.
        if len(cross) == 1:
            return [cross[0] @ weight.mT for weight in weights]
        return [(cross @ weight.unsqueeze(-1)).squeeze(-1).mT for weight in weights]

    def variance(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Variance of the latent value at x: eq. (6)."""
        return (self.amplitude.square()[:, None] * self._reduced(x, self.noise_ratio)).mT

    def type1(self, x: Float[Tensor, "m e"]) -> Float[Tensor, " m"]:
        """Type I uncertainty: 0 at the training inputs, 1 where only the prior speaks.

        It is the variance of eq. (6) without noise, over the squared amplitude: the average over the processes with
        their squared amplitudes for weights.
        """
        reduced = self._reduced(x, torch.zeros_like(self.noise_ratio))
        if len(reduced) == 1:
            return reduced[0]
        share = self.amplitude.square().clamp_min(torch.finfo(self.amplitude.dtype).tiny)
        return ((share / share.sum()) @ reduced).clamp(max=1.0)

    def _reduced(self, x: Tensor, noise_ratio: Tensor) -> Tensor:
        """Eq. (6) over the squared amplitude: (b, m), or (1, m) where no noise tells the processes apart."""
        gram = correlation(self.inputs, self.inputs, self.length_scale, self.kernel)
        cross = correlation(self.inputs, x, self.length_scale, self.kernel)
        if self.root is not None:
            gram, cross = self.root @ gram @ self.root.mT, self.root @ cross
        if bool((noise_ratio > 0).any()):
            gram = gram + torch.diag_embed(noise_ratio[:, None] / self.counts)
        # 1 - k' inv(K + ratio / counts) k, by the factor of the matrix.
        factor = safe_cholesky(gram, name="the kernel matrix of the training inputs")
        whitened = torch.linalg.solve_triangular(factor, cross, upper=False)
        return (1.0 - whitened.square().sum(-2)).clamp(0.0, 1.0)


def condition(
    observations: Observations,
    hyperparameters: Hyperparameters,
    kernel: str = "squared_exponential",
    values: Float[Tensor, "b n"] | None = None,
    *,
    basis: Basis | None = None,
) -> tuple[LatentGP, float]:
    """Gaussian processes conditioned on noisy observations, and the relative jitter that needed.

    ``values`` are those whose prior mean is zero, if they are others than the targets. The nodes of a ``basis`` that
    carries the processes, by default all inputs, become the inputs of the processes.
    """
    values = observations.targets if values is None else values
    basis = Basis(observations) if basis is None else basis
    targets, _ = basis.project(torch.cat([observations.targets, values]))
    gram = basis.covariance(correlation(basis.nodes, basis.nodes, hyperparameters.length_scale, kernel))
    gram = gram + hyperparameters.noise_ratio[:, None, None] * torch.eye(gram.shape[-1]).to(gram)
    factor, jitter = cholesky_with_jitter(gram, name="the kernel matrix of the training inputs")
    solved = torch.cholesky_solve(targets.reshape(2, -1, gram.shape[-1]).permute(1, 2, 0), factor)
    weight, value_weight = basis.node_weights(solved).unbind(-1)
    root = None if basis.root is None else basis.root.clone(memory_format=torch.contiguous_format)
    weights = weight.contiguous(), value_weight.contiguous()
    return LatentGP(basis.nodes.clone(), *weights, hyperparameters, basis.counts.clone(), kernel, root), jitter


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
