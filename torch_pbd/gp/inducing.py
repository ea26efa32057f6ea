"""Gaussian processes of low rank: weights of standard normal numbers on features of inducing inputs."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.gp.neighbourhoods import neighbourhoods, spacing
from torch_pbd.kernels import KernelName, correlation
from torch_pbd.linalg import safe_cholesky

# Kernel matrices of smooth kernels have a condition number beyond float64: what this takes away from a
# process of unit variance cannot be told from noise.
JITTER = 1e-13

_SHORTEST = 1e-3
_EXACT_RESOLUTION = 0.75  # spacings of the inputs: shorter "needles" explain each input by itself
_RESOLUTION = 1.0  # spacings: at this length scale features carry 0.995 of the variance between inducing inputs


@dataclass(frozen=True)
class FeatureMap:
    """What spans a family of processes, but for their length scale.

    With the inducing inputs at all training inputs the processes are the exact ones; with fewer they are the
    "deterministic training conditional" approximation, which is exact at the inducing inputs.
    """

    inducing: Float[Tensor, "m e"]
    kernel: KernelName = "squared_exponential"
    period: Float[Tensor, " e"] | None = None
    exact: bool = False
    """Whether the inducing inputs are all the training inputs."""

    def __call__(self, x: Float[Tensor, "n e"], length_scale: Float[Tensor, "*b e"]) -> Float[Tensor, "*b n m"]:
        """Features at x: their inner products are the kernel, wherever the inducing inputs resolve it."""
        gram = correlation(self.inducing, self.inducing, length_scale, self.kernel, self.period)
        gram = gram + JITTER * torch.eye(len(self.inducing)).to(gram)
        factor = safe_cholesky(gram, name="the kernel matrix of the inducing inputs")
        cross = correlation(self.inducing, x, length_scale, self.kernel, self.period)
        return torch.linalg.solve_triangular(factor, cross, upper=False).mT

    @property
    def jitter(self) -> float:
        """Added to the diagonal of the kernel matrix, which is one."""
        return JITTER

    def shortest_length_scale(self) -> float:
        """Length scale below which the inducing inputs no longer resolve what is between them."""
        if len(self.inducing) < 2:
            return _SHORTEST
        share = _EXACT_RESOLUTION if self.exact else _RESOLUTION
        return max(_SHORTEST, min(0.5, share * spacing(self.inducing)))


def inducing_inputs(inputs: Float[Tensor, "n e"], n_inducing: int) -> Float[Tensor, "m e"]:
    """The inputs themselves, or where they are too many the centres of their neighbourhoods."""
    if len(inputs) <= n_inducing:
        return inputs
    index = neighbourhoods(inputs, n_inducing)
    counts = torch.bincount(index).to(inputs)
    return inputs.new_zeros(len(counts), inputs.shape[1]).index_add_(0, index, inputs) / counts[:, None]
