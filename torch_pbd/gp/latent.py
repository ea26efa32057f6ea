"""Latent Gaussian processes: prediction from observed values, eq. (5) and (6), and values to be trained."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd.gp.observations import Hyperparameters, Observations
from torch_pbd.kernels import KernelName, correlation
from torch_pbd.linalg import cholesky_with_jitter, safe_cholesky

# Directions of a kernel matrix with less than this of its largest eigenvalue carry no trained values.
_RANK_TOLERANCE = 1e-11


class LatentGP(nn.Module):
    """b independent Gaussian processes with the same training inputs, conditioned on their values.

    Parameters
    ----------
    inputs : Tensor of shape (n, e)
    weight : Tensor of shape (b, n)
        What eq. (5) multiplies the correlations with the inputs by: the inverse of the matrix there, times
        the squared amplitude and the observed deviations from the prior mean.
    value_weight : Tensor of shape (b, n)
        The same for what the model reads off without a prior: see :meth:`values`.
    hyperparameters : Hyperparameters
        Of the b processes; ``length_scale`` of shape (1, e) where all share it.
    counts : Tensor of shape (n,)
        Observations behind each value; they divide the noise variance.
    kernel : KernelName
    """

    inputs: Tensor
    value_weight: Tensor
    length_scale: Tensor
    amplitude: Tensor
    noise_ratio: Tensor
    counts: Tensor

    def __init__(
        self,
        inputs: Float[Tensor, "n e"],
        weight: Float[Tensor, "b n"],
        value_weight: Float[Tensor, "b n"],
        hyperparameters: Hyperparameters,
        counts: Float[Tensor, " n"],
        kernel: KernelName = "squared_exponential",
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

    def forward(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Mean at x less the prior mean: eq. (5)."""
        return self._weighted(x, self.weight)

    def values(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Mean at x of the processes of ``value_weight``, whose prior mean is zero: what data alone say."""
        return self._weighted(x, self.value_weight)

    def _weighted(self, x: Tensor, weight: Tensor) -> Tensor:
        cross = correlation(x, self.inputs, self.length_scale, self.kernel)
        if len(cross) == 1:
            return cross[0] @ weight.mT
        return (cross @ weight.unsqueeze(-1)).squeeze(-1).mT

    def variance(self, x: Float[Tensor, "m e"]) -> Float[Tensor, "m b"]:
        """Variance of the latent value at x: eq. (6)."""
        return (self.amplitude.square()[:, None] * self._reduced(x, self.noise_ratio)).mT

    def type1(self, x: Float[Tensor, "m e"]) -> Float[Tensor, " m"]:
        """Type I uncertainty: 0 at the training inputs, 1 where only the prior speaks.

        The variance of eq. (6) without noise, over the squared amplitude; the average over the processes
        has their squared amplitudes for weights.
        """
        reduced = self._reduced(x, torch.zeros_like(self.noise_ratio))
        share = self.amplitude.square().clamp_min(torch.finfo(self.amplitude.dtype).tiny)
        if len(reduced) == 1:
            return reduced[0]
        return ((share / share.sum()) @ reduced).clamp(max=1.0)

    def _reduced(self, x: Tensor, noise_ratio: Tensor) -> Tensor:
        """Eq. (6) over the squared amplitude: (b, m), or (1, m) where no noise tells the processes apart."""
        gram = correlation(self.inputs, self.inputs, self.length_scale, self.kernel)
        if bool((noise_ratio > 0).any()):
            gram = gram + torch.diag_embed(noise_ratio[:, None] / self.counts)
        factor = safe_cholesky(gram, name="the kernel matrix of the training inputs")
        cross = correlation(self.inputs, x, self.length_scale, self.kernel)
        whitened = torch.linalg.solve_triangular(factor, cross, upper=False)
        return (1.0 - whitened.square().sum(-2)).clamp(0.0, 1.0)


def condition(
    observations: Observations,
    hyperparameters: Hyperparameters,
    kernel: KernelName = "squared_exponential",
    values: Float[Tensor, "b n"] | None = None,
) -> tuple[LatentGP, float]:
    """Gaussian processes conditioned on noisy observations, and the relative jitter that needed.

    ``values`` are those whose prior mean is zero, if they are others than the targets.
    """
    gram = correlation(observations.inputs, observations.inputs, hyperparameters.length_scale, kernel)
    gram = gram + torch.diag_embed(hyperparameters.noise_ratio[:, None] / observations.counts)
    factor, jitter = cholesky_with_jitter(gram, name="the kernel matrix of the training inputs")
    values = observations.targets if values is None else values
    weight, value_weight = torch.cholesky_solve(torch.stack([observations.targets, values], dim=-1), factor).unbind(-1)
    gp = LatentGP(observations.inputs, weight, value_weight.contiguous(), hyperparameters, observations.counts, kernel)
    return gp, jitter


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
    kernel : KernelName
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
        kernel: KernelName = "squared_exponential",
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

    def forward(self) -> Float[Tensor, "n b"]:
        """Deviations from the prior mean at the training inputs."""
        basis = self._basis()[0] if self.train_hyperparameters else self.basis
        deviation = (basis @ self.whitened.unsqueeze(-1)).squeeze(-1)
        return (self.log_amplitude.exp()[:, None] * deviation).mT

    def trained(self) -> list[Tensor]:
        """The parameters an optimizer may change."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    @torch.no_grad()
    def interpolate(self, values: Float[Tensor, "b n"]) -> LatentGP:
        """The Gaussian processes through the present deviations, and without a prior through ``values``."""
        self.basis, self.jitter = self._basis()
        amplitude = self.log_amplitude.exp()
        hyperparameters = Hyperparameters(self.log_length_scale.exp(), amplitude.clone(), torch.zeros_like(amplitude))
        weight = amplitude[:, None] * self._weight(self.whitened)
        counts = torch.ones_like(self.inputs[:, 0])
        value_weight = self._weight(self._solved(values))
        return LatentGP(self.inputs, weight, value_weight, hyperparameters, counts, self.kernel)

    def _basis(self) -> tuple[Tensor, float]:
        gram = correlation(self.inputs, self.inputs, self.log_length_scale.exp(), self.kernel)
        if self.train_hyperparameters:
            return cholesky_with_jitter(gram, name="the kernel matrix of the training inputs")
        eigenvalue, eigenvector = torch.linalg.eigh(gram)
        matters = eigenvalue > _RANK_TOLERANCE * eigenvalue[..., -1:]
        root = eigenvalue.where(matters, 0.0).sqrt()
        return (eigenvector * root.unsqueeze(-2))[..., matters.any(0)], 0.0

    def _solved(self, deviation: Tensor) -> Tensor:
        """Whitened values whose deviations, over the amplitude, come nearest to these."""
        deviation = deviation.unsqueeze(-1)
        if self.train_hyperparameters:
            return torch.linalg.solve_triangular(self.basis, deviation, upper=False).squeeze(-1).contiguous()
        return (self.basis.mT @ deviation / self._square()).squeeze(-1).contiguous()

    def _weight(self, whitened: Tensor) -> Tensor:
        """Inverse of the kernel matrix times the deviations, over the amplitude, of whitened values."""
        if self.train_hyperparameters:
            solved = torch.linalg.solve_triangular(self.basis.mT, whitened.unsqueeze(-1), upper=True)
            return solved.squeeze(-1).contiguous()
        return (self.basis @ (whitened.unsqueeze(-1) / self._square())).squeeze(-1).contiguous()

    def _square(self) -> Tensor:
        """Of each column of the basis, which are orthogonal; one for those that do not matter and are zero."""
        square = self.basis.square().sum(-2).unsqueeze(-1)
        return square.where(square > 0, 1.0)
