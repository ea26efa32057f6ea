"""Gaussian processes of low rank: weights of standard normal numbers on features of inducing inputs."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from torch_pbd.gp.observations import neighbourhoods, spacing, sum_by
from torch_pbd.kernels import correlation, differences, value_and_slope
from torch_pbd.linalg import safe_cholesky

# In ranges of the inputs: those that nearly coincide, as of two precisions, show no finer detail than this.
_SHORTEST = 1e-3
_EXACT_RESOLUTION = 0.75  # spacings of the inputs: shorter "needles" explain each input by itself
# Of a process's variance: less than this that features do not carry is the jitter of kernel matrices, and rounding.
_ROUNDING = 1e-11
_RESOLUTION = 1.0  # spacings: at this length scale features carry 0.995 of the variance between inducing inputs


@dataclass(frozen=True)
class FeatureMap:
    """Inducing inputs and kernel of a family of processes: all but their length scale.

    With the inducing inputs at all training inputs the processes are the exact ones; with fewer they are the
    "deterministic training conditional" approximation, which is exact at the inducing inputs.
    """

    inducing: Float[Tensor, "m e"]
    kernel: str = "squared_exponential"
    period: Float[Tensor, " e"] | None = None
    exact: bool = False
    """Whether the inducing inputs are all the training inputs."""
    stretch: Float[Tensor, "2 2"] | None = None
    """Length added next to the first and the last input, and the distance from it over which most of it is."""
    # Kernel matrices of smooth kernels have a condition number beyond float64: what this takes away from a process of
    # unit variance cannot be told from noise.
    jitter: ClassVar[float] = 1e-13
    """Added to the diagonal of kernel matrices, which is one."""

    def __call__(self, length_scale: Float[Tensor, "*b e"]) -> "Features":
        """Features for these length scales."""
        inducing = self.warped(self.inducing)
        gram = correlation(inducing, inducing, length_scale, self.kernel, self.period)
        gram = gram + self.jitter * torch.eye(len(self.inducing)).to(gram)
        return Features(self, length_scale, safe_cholesky(gram, name="the kernel matrix of the inducing inputs"))

    def square_differences(self, x: Float[Tensor, "n e"], other: Float[Tensor, "m e"]) -> Float[Tensor, "e n m"]:
        """Squares of the differences in each dimension; along a circle of the chords."""
        return torch.stack(differences(self.warped(x), self.warped(other), self.period), dim=-1).square().movedim(-1, 0)

    def warped(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "n e"]:
        """Inputs with length added next to the ends of their range, within which alone it is."""
        if self.stretch is None:
            return x
        (first, first_width), (last, last_width) = self.stretch
        from_first, from_last = (x + 0.5).clamp_min(0.0), (0.5 - x).clamp_min(0.0)
        return x - first * torch.expm1(-from_first / first_width) + last * torch.expm1(-from_last / last_width)

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

    @cached_property
    def shortest_length_scale(self) -> float:
        """Length scale below which the inducing inputs no longer resolve what is between them."""
        if len(self.inducing) < 2:
            return _SHORTEST
        share = _EXACT_RESOLUTION if self.exact else _RESOLUTION
        return max(_SHORTEST, min(0.5, share * spacing(self.warped(self.inducing))))


@dataclass(frozen=True)
class Features:
    """Features of a map for given length scales, at any inputs."""

    features: FeatureMap
    length_scale: Float[Tensor, "*b e"]
    factor: Float[Tensor, "*b m m"]
    """Lower Cholesky factor of the kernel matrix of the inducing inputs."""

    def __call__(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "*b n m"]:
        """Features at x: their inner products are the kernel, wherever the inducing inputs resolve it."""
        return torch.linalg.solve_triangular(self.factor, self.cross(x).mT, upper=False).mT

    def cross(self, x: Float[Tensor, "n e"]) -> Float[Tensor, "*b n m"]:
        """Kernel between x and the inducing inputs."""
        features = self.features
        inducing = features.warped(features.inducing)
        return correlation(features.warped(x), inducing, self.length_scale, features.kernel, features.period)


class FixedFeatures:
    """Features of a map at inputs that stay, for one length scale after another.

    The inducing inputs are taken each as far as possible from those before it, and no more of them than carry what
    can be told: for a smooth kernel and a long length scale these are few. The features are those of the map but
    for an orthogonal matrix, and so the same processes.

    Parameters
    ----------
    features : FeatureMap
    x : Tensor of shape (n, e)
    """

    def __init__(self, features: FeatureMap, x: Float[Tensor, "n e"]) -> None:
        self._kernel = features.kernel
        chosen = features.inducing[features.farthest_first]
        self._gram = features.square_differences(chosen, chosen)
        self._cross = features.square_differences(chosen, x)
        self._jitter = features.jitter * torch.eye(len(chosen)).to(x)

    def vjp(
        self, length_scale: Float[Tensor, "b e"], negligible: Float[Tensor, " b"]
    ) -> tuple[Float[Tensor, "b n r"], Callable[[Float[Tensor, "b n r"]], Float[Tensor, "b e"]]]:
        """Features, and the product of a gradient in them with their derivative in the logarithms of length scales.

        The gradient is to be that of a function of the features' inner products alone. Left out are features that
        carry less than ``negligible`` of the variance, which is one.
        """
        inverse_square = length_scale.reciprocal().square()
        gram, gram_slope = value_and_slope(self._gram, inverse_square, self._kernel)
        factor = safe_cholesky(gram + self._jitter, name="the kernel matrix of the inducing inputs")
        # The square of a diagonal entry is the variance at an inducing input given those before it, and given the
        # first r of them none is farther from these than the next. One feature is left in any case.
        carries = (factor.diagonal(dim1=-2, dim2=-1).square() > negligible[:, None]).any(0)
        size = int(carries.nonzero().max()) + 1 if bool(carries.any()) else 1
        factor, gram_slope = factor[:, :size, :size], gram_slope[:, :size, :size]
        gram_squares, cross_squares = self._gram[:, :size, :size], self._cross[:, :size]
        cross, cross_slope = value_and_slope(cross_squares, inverse_square, self._kernel)
        values = torch.linalg.solve_triangular(factor, cross, upper=False).mT

        # With K = L L' of the inducing inputs and C their kernel with the others the features are F' = inv(L) C, and
        # dF' = inv(L) dC - P F', where P is the lower half of S = inv(L) dK inv(L)'. P and S / 2 differ by an
        # antisymmetric matrix, a rotation of the features, which a function of inner products does not see:
        # dF' = inv(L) (dC - dK inv(K) C / 2). For a squared distance s in length scales dk = -2 s k'(s) d log(scale).
        def in_log_length_scale(gradient: Tensor) -> Tensor:
            both = torch.cat([gradient.mT, values.mT], dim=-1)
            adjoint, solved = torch.linalg.solve_triangular(factor.mT, both, upper=True).chunk(2, dim=-1)
            in_cross = (adjoint * cross_slope).flatten(1) @ cross_squares.flatten(1).mT
            in_gram = (adjoint @ solved.mT * gram_slope).flatten(1) @ gram_squares.flatten(1).mT
            return (in_gram - 2.0 * in_cross) / length_scale.square()

        return values, in_log_length_scale


def unexplained(features: Float[Tensor, "*b m"]) -> Float[Tensor, "*b"]:
    """Share of a variance of one that features do not carry: none at the inducing inputs, all far from them.

    Where y deviates by a millionth, rounding would else be a hundredth of what is predicted.
    """
    share = (1.0 - features.square().sum(-1)).clamp(0.0, 1.0)
    return share * -torch.expm1(-(share / _ROUNDING).square())  # smooth, and equal to the bit above a few of these


def inducing_inputs(inputs: Float[Tensor, "n e"], n_inducing: int) -> Float[Tensor, "m e"]:
    """The inputs themselves, or where they are too many the centres of their neighbourhoods."""
    if len(inputs) <= n_inducing:
        return inputs
    index = neighbourhoods(inputs, n_inducing)
    return sum_by(inputs, index) / torch.bincount(index).to(inputs)[:, None]
