"""Gaussian mixture regression in NumPy: of a few rows torch's dispatch takes ten times what the arithmetic does."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torch_pbd.estimators.validation import Floats
from torch_pbd.models.conditional import VARIANCE_FLOOR, ConditionalNormal

# Of standardized inputs: squares of what follows stay finite.
_LIMIT = np.finfo(np.float64).max ** (1 / 6)


@dataclass(frozen=True)
class MixtureRegression:
    """Regression of a mixture's module, with all that depends on its parameters alone worked out before.

    Of k components, e standardized inputs and d outputs in units of the data, less their shift.
    """

    arrays: list[NDArray[Any]]
    """Arrays of the module, sharing its memory, which so is used for nothing else;"""
    values: list[bytes]
    """and what they were."""
    places: list[int]
    units: list[Floats]
    """Shift and scale of the inputs, then of the outputs."""
    range: tuple[Floats, Floats]
    """Inputs beyond it are pulled back to it, as the module does."""
    affine: Floats
    """(e, k (e + d)): what each component whitens inputs by, and then its slopes."""
    offset: Floats
    """(k (e + d),): what is added to these products."""
    peak: Floats
    """(k,): log of weight times density of x at a component's mean, but for what all share."""
    minus_half_sum: Floats
    """(k e, k): minus half the sum over each component's entries."""
    covariance: Floats
    """(k, d^2), with the part of the floor that is constant."""
    floor: tuple[Floats, Floats]
    """(d^2,): the rest of it is the second of these times the sum of a covariance's entries weighted by the first."""

    @classmethod
    def from_module(cls, module: ConditionalNormal) -> Self:
        """Regression by a module, as its parameters are now."""
        core: Any = module.core
        scale_tril, mean = core.scale_tril.detach().numpy(), core.mean.detach().numpy()
        arrays = [tensor.detach().numpy() for tensor in _tensors(module)]
        n_components, e = len(mean), core.n_features
        units = [part.numpy() for part in (module.x_shift, module.x_scale, module.y_shift, module.y_scale)]
        # Component k whitens x by inv(L_xx), and says level + gain (x - centre) of y: both by one product with x.
        inverse = np.linalg.inv(scale_tril[:, :e, :e])
        gain = units[3][:, np.newaxis] * (scale_tril[:, e:, :e] @ inverse)
        centre, level = mean[:, :e, np.newaxis], units[3] * mean[:, e:]
        peak = core.log_weight.detach().numpy() - np.log(np.diagonal(scale_tril[:, :e, :e], axis1=1, axis2=2)).sum(1)
        root = units[3][:, np.newaxis] * scale_tril[:, e:, e:]
        variance = np.diag(np.square(units[3]))
        return cls(
            arrays,
            [array.tobytes() for array in arrays],
            [tensor.data_ptr() for tensor in _tensors(module)],
            units,
            (units[0] - _LIMIT * units[1], units[0] + _LIMIT * units[1]),
            np.concatenate([part.reshape(-1, e) for part in (inverse, gain)]).T.copy(),
            np.concatenate([-(inverse @ centre).ravel(), (level - (gain @ centre)[:, :, 0]).ravel()]),
            peak,
            np.repeat(-0.5 * np.eye(n_components), e, axis=0),
            (root @ root.mT + VARIANCE_FLOOR * variance).reshape(n_components, -1),
            (np.diag(1.0 / np.square(units[3])).ravel(), VARIANCE_FLOOR * variance.ravel()),
        )

    def mean(self, X: Floats) -> Floats:
        """Mean of y at X: (n, d)."""
        share, components = self._components(X)
        return self.units[2] + (share[:, np.newaxis] @ components)[:, 0]

    def moments(self, X: Floats) -> tuple[Floats, Floats]:
        """Mean (n, d), and covariance (n, d, d), symmetric to the last bit."""
        share, components = self._components(X)
        mean = share[:, np.newaxis] @ components
        components -= mean
        spread = (share[:, :, np.newaxis] * components).mT @ components
        covariance = (share @ self.covariance).reshape(spread.shape) + spread
        weights, floor = self.floor
        flat = (0.5 * (covariance + covariance.mT)).reshape(len(X), len(floor))
        flat += (flat @ weights)[:, np.newaxis] * floor
        return self.units[2] + mean[:, 0], flat.reshape(spread.shape)

    def matches(self, module: ConditionalNormal) -> bool:
        """Whether the module is as it was when this was made from it."""
        places = [tensor.data_ptr() for tensor in _tensors(module)]
        return places == self.places and [array.tobytes() for array in self.arrays] == self.values

    def _components(self, X: Floats) -> tuple[Floats, Floats]:
        """Share of each component at each row (n, k), and what it says of y (n, k, d)."""
        low, high = self.range
        x = (np.minimum(np.maximum(X, low), high) - self.units[0]) / self.units[1]
        both = x @ self.affine + self.offset
        n_whitened = len(self.minus_half_sum)
        share = np.square(both[:, :n_whitened]) @ self.minus_half_sum + self.peak
        share = np.exp(share - np.maximum.reduce(share, 1, keepdims=True))
        share /= np.add.reduce(share, 1, keepdims=True)
        return share, both[:, n_whitened:].reshape(*share.shape, len(self.units[2]))


def _tensors(module: ConditionalNormal) -> list[Tensor]:
    every: Any = [*module.core._parameters.values(), *module._buffers.values()]  # there are none that are None
    return every
