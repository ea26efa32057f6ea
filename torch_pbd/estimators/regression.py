"""Gaussian mixture regression in NumPy: of a few rows torch's dispatch takes ten times what the arithmetic does."""

from typing import Any

import numpy as np
from torch import Tensor

from torch_pbd.checks import Floats
from torch_pbd.models.conditional import VARIANCE_FLOOR, ConditionalNormal

# Of standardized inputs: squares of what follows stay finite.
_LIMIT = np.finfo(np.float64).max ** (1 / 6)


class MixtureRegression:
    """Regression of a mixture's module, with all that depends on its parameters alone worked out before.

    Of k components, e standardized inputs and d outputs in units of the data, less their shift.
    """

    def __init__(self, module: ConditionalNormal) -> None:
        core: Any = module.core
        # Arrays that share the module's memory, and so are used for nothing else than to see whether it has changed.
        self._arrays = [tensor.detach().numpy() for tensor in _tensors(module)]
        self._values = [array.tobytes() for array in self._arrays]
        self._places = [tensor.data_ptr() for tensor in _tensors(module)]
        scale_tril, mean = core.scale_tril.detach().numpy(), core.mean.detach().numpy()
        n_components, e = len(mean), core.n_features
        units = [part.numpy() for part in (module.x_shift, module.x_scale, module.y_shift, module.y_scale)]
        self._x_shift, self._x_scale, self._y_shift, y_scale = units
        # Inputs beyond this range are pulled back to it, as the module does.
        self._range = self._x_shift - _LIMIT * self._x_scale, self._x_shift + _LIMIT * self._x_scale
        # Component k whitens x by inv(L_xx), and says level + gain (x - centre) of y: both by one product with x, whose
        # columns (k (e + d)) are first those of the whitened inputs.
        inverse = np.linalg.inv(scale_tril[:, :e, :e])
        gain = y_scale[:, np.newaxis] * (scale_tril[:, e:, :e] @ inverse)
        centre, level = mean[:, :e, np.newaxis], y_scale * mean[:, e:]
        self._affine = np.concatenate([part.reshape(-1, e) for part in (inverse, gain)]).T.copy()
        self._offset = np.concatenate([-(inverse @ centre).ravel(), (level - (gain @ centre)[:, :, 0]).ravel()])
        # Log of weight times density of x at a component's mean, but for what all share; and what sums -1/2 of squares.
        log_det = np.log(np.diagonal(scale_tril[:, :e, :e], axis1=1, axis2=2)).sum(1)
        self._peak = core.log_weight.detach().numpy() - log_det
        self._minus_half_sum = np.repeat(-0.5 * np.eye(n_components), e, axis=0)
        # Covariances (k, d^2) with the part of the floor that is constant. The rest of it is variances times the sum of
        # a covariance's entries, weighted by one over them.
        root, variance = y_scale[:, np.newaxis] * scale_tril[:, e:, e:], np.diag(np.square(y_scale))
        self._covariance = (root @ root.mT + VARIANCE_FLOOR * variance).reshape(n_components, -1)
        self._floor = np.diag(1.0 / np.square(y_scale)).ravel(), VARIANCE_FLOOR * variance.ravel()

    def mean(self, X: Floats) -> Floats:
        """Mean of y at X: (n, d)."""
        share, components = self._components(X)
        return self._y_shift + (share[:, np.newaxis] @ components)[:, 0]

    def moments(self, X: Floats) -> tuple[Floats, Floats]:
        """Mean (n, d), and covariance (n, d, d), symmetric to the last bit."""
        share, components = self._components(X)
        mean = share[:, np.newaxis] @ components
        components -= mean
        spread = (share[:, :, np.newaxis] * components).mT @ components
        covariance = (share @ self._covariance).reshape(spread.shape) + spread
        weights, floor = self._floor
        flat = (0.5 * (covariance + covariance.mT)).reshape(len(X), len(floor))
        flat += (flat @ weights)[:, np.newaxis] * floor
        return self._y_shift + mean[:, 0], flat.reshape(spread.shape)

    def matches(self, module: ConditionalNormal) -> bool:
        """Whether the module is as it was when this was made from it."""
        places = [tensor.data_ptr() for tensor in _tensors(module)]
        return places == self._places and [array.tobytes() for array in self._arrays] == self._values

    def _components(self, X: Floats) -> tuple[Floats, Floats]:
        """Share of each component at each row (n, k), and what it says of y (n, k, d)."""
        low, high = self._range
        x = (np.minimum(np.maximum(X, low), high) - self._x_shift) / self._x_scale
        both = x @ self._affine + self._offset
        n_whitened = len(self._minus_half_sum)
        share = np.square(both[:, :n_whitened]) @ self._minus_half_sum + self._peak
        share = np.exp(share - np.maximum.reduce(share, 1, keepdims=True))
        share /= np.add.reduce(share, 1, keepdims=True)
        return share, both[:, n_whitened:].reshape(*share.shape, len(self._y_shift))


def _tensors(module: ConditionalNormal) -> list[Tensor]:
    every: Any = [*module.core._parameters.values(), *module._buffers.values()]  # there are none that are None
    return every
