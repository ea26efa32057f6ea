"""Features of inducing inputs at inputs that stay, for one length scale after another, with closed-form gradients."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torch_pbd.gp.inducing import JITTER, FeatureMap
from torch_pbd.kernels import KERNELS
from torch_pbd.linalg import safe_cholesky

_FARTHEST = 1e8  # a squared distance beyond which every correlation is zero

# Of a squared distance s and the correlation k there: s times this is the derivative of k in the logarithm of the
# length scale, -2 s dk/ds.
_SLOPES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "squared_exponential": lambda s, k: k,
    "matern32": lambda s, k: 3.0 * torch.exp(-(3.0 * s).sqrt()),
    "matern52": lambda s, k: 5.0 / 3.0 * (1.0 + (5.0 * s).sqrt()) * torch.exp(-(5.0 * s).sqrt()),
}


@dataclass(frozen=True)
class FeaturesAt:
    """Features for b length scales at the inputs of a :class:`FixedFeatures`."""

    values: Float[Tensor, "b n r"]
    factor: Float[Tensor, "b r r"]
    gram: tuple[Tensor, Tensor]
    """Slopes of the kernel between inducing inputs (b, r, r), and squared distances (e, r, r)."""
    cross: tuple[Tensor, Tensor]
    """The same between these and the inputs: (b, r, n) and (e, r, n)."""
    length_scale: Float[Tensor, "b e"]

    def pull(self, gradient: Float[Tensor, "b n r"]) -> Float[Tensor, "b e"]:
        """Gradient in the logarithms of the length scales, from that in the features.

        Of a function of the features' inner products alone. With K = L L' of the inducing inputs and C their
        kernel with the others the features are F' = inv(L) C, and dF' = inv(L) dC - P F', where P is the lower half
        of S = inv(L) dK inv(L)'. P and S / 2 differ by an antisymmetric matrix, a rotation of the features, which
        such a function does not see: dF' = inv(L) (dC - dK inv(K) C / 2).
        """
        n_inputs = gradient.shape[1]
        both = torch.cat([gradient.mT, self.values.mT], dim=-1)
        adjoint, solved = torch.linalg.solve_triangular(self.factor.mT, both, upper=True).split(n_inputs, dim=-1)
        of_gram, of_cross = adjoint @ solved.mT, adjoint
        total = _contract(of_cross, *self.cross) - 0.5 * _contract(of_gram, *self.gram)
        return total / self.length_scale.square()


def _contract(gradient: Tensor, slope: Tensor, squares: Tensor) -> Tensor:
    return (gradient * slope).flatten(1) @ squares.flatten(1).mT


class FixedFeatures:
    """Features of a map at the same inputs.

    The inducing inputs are taken each as far as possible from those before it, and no more of them than carry what
    can be told: for a smooth kernel and a long length scale these are few. The features are those of the map but
    for an orthogonal matrix, and so the same processes.

    Parameters
    ----------
    features : FeatureMap
    x : Tensor of shape (n, e)
    """

    def __init__(self, features: FeatureMap, x: Float[Tensor, "n e"]) -> None:
        self.kernel = features.kernel
        chosen = features.inducing[features.farthest_first]
        self._gram = features.square_differences(chosen, chosen)
        self._cross = features.square_differences(chosen, x)
        self._jitter = JITTER * torch.eye(len(chosen)).to(x)

    @property
    def n_features(self) -> int:
        """Dimensions of the inputs."""
        return len(self._cross)

    def at(self, length_scale: Float[Tensor, "b e"], negligible: Float[Tensor, " b"]) -> FeaturesAt:
        """Features, but for those that carry less than ``negligible`` of the variance, which is one."""
        kernel, gram_slope = self._correlation(self._gram, length_scale)
        factor = safe_cholesky(kernel + self._jitter, name="the kernel matrix of the inducing inputs")
        # The square of a diagonal entry is the variance at an inducing input given those before it, and given the
        # first r of them none is farther from these than the next.
        carried = factor.diagonal(dim1=-2, dim2=-1).square()
        told = (carried > negligible[:, None]).any(0)
        told[0] = True  # where nothing can be told of any process, one feature says so
        size = int(told.nonzero().max()) + 1
        factor = factor[:, :size, :size]
        squares = self._cross[:, :size]
        cross, cross_slope = self._correlation(squares, length_scale)
        values = torch.linalg.solve_triangular(factor, cross, upper=False).mT
        gram = (gram_slope[:, :size, :size], self._gram[:, :size, :size])
        return FeaturesAt(values, factor, gram, (cross_slope, squares), length_scale)

    def _correlation(self, squares: Tensor, length_scale: Tensor) -> tuple[Tensor, Tensor]:
        distance = length_scale.reciprocal().square() @ squares.flatten(1)
        distance = distance.reshape(-1, *squares.shape[1:]).clamp_max(_FARTHEST)
        kernel = KERNELS[self.kernel](distance)
        return kernel, _SLOPES[self.kernel](distance, kernel)
