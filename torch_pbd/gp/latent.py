"""Latent Gaussian processes: prediction from observed values, eq. (5) and (6)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torch_pbd.gp.observations import Hyperparameters, Observations
from torch_pbd.gp.projection import Basis, basis_for
from torch_pbd.kernels import correlation
from torch_pbd.linalg import cholesky_with_jitter, safe_cholesky


class LatentGP(nn.Module):
    """b independent Gaussian processes with the same training inputs, conditioned on their values.

    Parameters
    ----------
    inputs : Tensor of shape (n, e)
        Training inputs, or nodes that stand for them.
    weight : Tensor of shape (b, n)
        What eq. (5) multiplies the correlations with the inputs by: the inverse of the matrix there, times
        the squared amplitude and the observed deviations from the prior mean.
    value_weight : Tensor of shape (b, n)
        The same for what the model reads off without a prior: see :meth:`values`.
    hyperparameters : Hyperparameters
        Of the b processes; ``length_scale`` of shape (1, e) where all share it.
    counts : Tensor of shape (n,)
        Observations behind each value; they divide the noise variance.
    kernel : str
    root : Tensor of shape (r, n), default=None
        Where the inputs are nodes: what was observed are r combinations of the values there.
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
        """What :meth:`forward` and :meth:`values` give, by one matrix of correlations."""
        return self._weighted(x, self.weight, self.value_weight)

    def _weighted(self, x: Tensor, *weights: Tensor) -> list[Tensor]:
        cross = correlation(x, self.inputs, self.length_scale, self.kernel)
        if len(cross) == 1:
            return [cross[0] @ weight.mT for weight in weights]
        return [(cross @ weight.unsqueeze(-1)).squeeze(-1).mT for weight in weights]

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
        cross = correlation(self.inputs, x, self.length_scale, self.kernel)
        noise = noise_ratio[:, None].expand(-1, len(self.inputs)) / self.counts
        if self.root is not None:
            gram, cross = self.root @ gram @ self.root.mT, self.root @ cross
        if bool((noise_ratio > 0).any()):
            gram = gram + torch.diag_embed(noise)
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

    ``values`` are those whose prior mean is zero, if they are others than the targets. Of a ``basis`` that carries
    the processes (by default the smallest), the nodes are the inputs of what is returned.
    """
    values = observations.targets if values is None else values
    if basis is None:
        basis = basis_for(observations, hyperparameters.length_scale, hyperparameters.noise_ratio, kernel)
    targets = basis.project(torch.cat([observations.targets, values])).targets
    gram = basis.covariance(correlation(basis.nodes, basis.nodes, hyperparameters.length_scale, kernel))
    gram = gram + hyperparameters.noise_ratio[:, None, None] * torch.eye(gram.shape[-1]).to(gram)
    factor, jitter = cholesky_with_jitter(gram, name="the kernel matrix of the training inputs")
    solved = torch.cholesky_solve(targets.reshape(2, -1, gram.shape[-1]).permute(1, 2, 0), factor)
    weight, value_weight = basis.lowered(solved).unbind(-1)
    root = None if basis.root is None else basis.root.clone(memory_format=torch.contiguous_format)
    parts = (weight.contiguous(), value_weight.contiguous(), hyperparameters, basis.counts.clone(), kernel, root)
    return LatentGP(basis.nodes.clone(), *parts), jitter
