"""Gaussian processes of low rank: weights of standard normal numbers on features of inducing inputs."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int64
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
        return self.prepared(length_scale)(x)

    def prepared(self, length_scale: Float[Tensor, "*b e"]) -> "PreparedFeatures":
        """Features for these length scales, at any inputs."""
        gram = correlation(self.inducing, self.inducing, length_scale, self.kernel, self.period)
        gram = gram + JITTER * torch.eye(len(self.inducing)).to(gram)
        factor = safe_cholesky(gram, name="the kernel matrix of the inducing inputs")
        return PreparedFeatures(self, length_scale, factor)

    @property
    def jitter(self) -> float:
        """Added to the diagonal of the kernel matrix, which is one."""
        return JITTER

    def square_differences(self, x: Float[Tensor, "n e"], other: Float[Tensor, "m e"]) -> Float[Tensor, "e n m"]:
        """Squares of the differences in each dimension; along a circle of the chords."""
        difference = x.mT.unsqueeze(2) - other.mT.unsqueeze(1)
        if self.period is not None:
            radius = self.period[:, None, None] / math.pi
            difference = torch.where(radius.isfinite(), radius * torch.sin(difference / radius), difference)
        return difference.square()

    @cached_property
    def farthest_first(self) -> Int64[Tensor, " m"]:
        """Order of the inducing inputs in which each is the farthest from those before it, begun at the middle."""
        distance = self.square_differences(self.inducing, self.inducing).sum(0)
        number = int(distance.sum(0).argmin())
        nearest = torch.full_like(distance[0], math.inf)
        order = []
        for _ in range(len(distance)):
            order.append(number)
            nearest = torch.minimum(nearest, distance[number])
            nearest[number] = -1.0
            number = int(nearest.argmax())
        return torch.tensor(order, device=distance.device)

    def shortest_length_scale(self) -> float:
        """Length scale below which the inducing inputs no longer resolve what is between them."""
        return self._shortest

    @cached_property
    def _shortest(self) -> float:
        if len(self.inducing) < 2:
            return _SHORTEST
        share = _EXACT_RESOLUTION if self.exact else _RESOLUTION
        return max(_SHORTEST, min(0.5, share * spacing(self.inducing)))


@dataclass(frozen=True)
class PreparedFeatures:
    """Features whose length scales are known, with what does not depend on the inputs computed."""

    features: FeatureMap
    length_scale: Float[Tensor, "*b e"]
    factor: Float[Tensor, "*b m m"]
    """Lower, of the kernel matrix of the inducing inputs."""

    def __call__(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "*b n m"]:
        """Features at x."""
        return torch.linalg.solve_triangular(self.factor, self.cross(x).mT, upper=False).mT

    def cross(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "*b n m"]:
        """Kernel between x and the inducing inputs."""
        features = self.features
        return correlation(x, features.inducing, self.length_scale, features.kernel, features.period)


def inducing_inputs(inputs: Float[Tensor, "n e"], n_inducing: int) -> Float[Tensor, "m e"]:
    """The inputs themselves, or where they are too many the centres of their neighbourhoods."""
    if len(inputs) <= n_inducing:
        return inputs
    index = neighbourhoods(inputs, n_inducing)
    counts = torch.bincount(index).to(inputs)
    return inputs.new_zeros(len(counts), inputs.shape[1]).index_add_(0, index, inputs) / counts[:, None]
