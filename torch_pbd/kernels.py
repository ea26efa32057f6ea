"""Stationary correlation functions of inputs; an amplitude and a noise are the Gaussian process's matter."""

import math
from collections.abc import Callable
from functools import reduce
from operator import add
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

KernelName = Literal["squared_exponential", "matern32", "matern52"]

# Beyond it every correlation here is zero in float64; keeps inf * 0 away from inputs at 1e300.
_FARTHEST = 1e8


def _squared_exponential(square_distance: Tensor) -> Tensor:
    return torch.exp(-0.5 * square_distance)


def _matern32(square_distance: Tensor) -> Tensor:
    distance = (3.0 * square_distance).clamp_min(1e-30).sqrt()  # the root has no gradient at zero
    return (1.0 + distance) * torch.exp(-distance)


def _matern52(square_distance: Tensor) -> Tensor:
    distance = (5.0 * square_distance).clamp_min(1e-30).sqrt()
    return (1.0 + distance + distance.square() / 3.0) * torch.exp(-distance)


def _matern32_slope(square_distance: Tensor) -> Tensor:
    return -1.5 * torch.exp(-(3.0 * square_distance).sqrt())


def _matern52_slope(square_distance: Tensor) -> Tensor:
    distance = (5.0 * square_distance).sqrt()
    return (-5.0 / 6.0) * (1.0 + distance) * torch.exp(-distance)


KERNELS: dict[str, Callable[[Tensor], Tensor]] = {
    "squared_exponential": _squared_exponential,
    "matern32": _matern32,
    "matern52": _matern52,
}


def correlation(
    x: Float[Tensor, "n e"],
    other: Float[Tensor, "m e"],
    length_scale: Float[Tensor, "*b e"],
    kernel: KernelName = "squared_exponential",
    period: Float[Tensor, " e"] | None = None,
) -> Float[Tensor, "*b n m"]:
    """Correlation of the latent values at two sets of inputs: eq. (4) with an amplitude of one.

    Parameters
    ----------
    x, other : Tensor of shapes (n, e) and (m, e)
    length_scale : Tensor of shape (..., e)
        One per input dimension (automatic relevance determination), in the units of ``x``: the diagonal
        of the paper's Omega.
    kernel : {"squared_exponential", "matern32", "matern52"}, default="squared_exponential"
    period : Tensor of shape (e,), default=None
        Where it is finite the input is a phase on a circle of that circumference, and distances are chords
        of it, which agree with the inputs' own where these are close: with the squared exponential this is
        the periodic kernel of MacKay (Rasmussen and Williams, eq. (4.31)).
    """

    def square(dimension: int) -> Tensor:
        difference = x[:, dimension : dimension + 1] - other[:, dimension]
        if period is not None and bool(torch.isfinite(period[dimension])):
            radius = period[dimension] / math.pi
            largest = torch.finfo(x.dtype).max  # the sine of infinity, many small periods away, is no number
            difference = radius * torch.sin((difference / radius).clamp(-largest, largest))
        return (difference / length_scale[..., dimension, None, None]).square()

    square_distance = reduce(add, map(square, range(x.shape[1])))
    return KERNELS[kernel](square_distance.clamp_max(_FARTHEST))


def value_and_slope(
    square_distance: Float[Tensor, "*b n m"], kernel: KernelName = "squared_exponential"
) -> tuple[Float[Tensor, "*b n m"], Float[Tensor, "*b n m"]]:
    """Correlation at squared distances in length scales, and its derivative by them."""
    square_distance = square_distance.clamp_max(_FARTHEST)
    value = KERNELS[kernel](square_distance)
    if kernel == "squared_exponential":
        return value, -0.5 * value
    slope = _matern32_slope if kernel == "matern32" else _matern52_slope
    return value, slope(square_distance)
