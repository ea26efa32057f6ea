"""Latent Gaussian processes: prediction from observed values, eq. (5) and (6)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd.gp.observations import Hyperparameters, Observations
from torch_pbd.kernels import KernelName, correlation
from torch_pbd.linalg import cholesky_with_jitter, safe_cholesky


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
