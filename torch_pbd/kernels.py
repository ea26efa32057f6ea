"""Stationary correlation functions of inputs; amplitude and noise belong to the Gaussian process."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

# Distance beyond which every correlation is zero in float64; it avoids inf * 0 for inputs at 1e300.
_FARTHEST = 1e8
_ROWS_OF_A_FUNCTION = 40.0  # of a process whose length scale is not learned


@dataclass(frozen=True)
class Kernel:
    """Correlation as a function of the squared distance in length scales."""

    value: Callable[[Tensor], Tensor]
    """Correlation at squared distances; differentiable by autograd at zero too."""
    slope: Callable[[Tensor, Tensor], Tensor]
    """Derivative of the correlation by the squared distance, from that distance and the correlation there."""
    on_nodes: bool = False
    """Whether ``4 / length_scale + 8`` Chebyshev nodes on a range of one carry it to rounding."""


# A root has no gradient at zero, which 1e-30 keeps away from; the correlation differs from one there by 1e-15.
_LEAST = 1e-30


def _matern32(square_distance: Tensor) -> Tensor:
    distance = (3.0 * square_distance).clamp_min(_LEAST).sqrt()
    return (1.0 + distance) * torch.exp(-distance)


def _matern52(square_distance: Tensor) -> Tensor:
    distance = (5.0 * square_distance).clamp_min(_LEAST).sqrt()
    return (1.0 + distance + distance.square() / 3.0) * torch.exp(-distance)


KernelName = Literal["squared_exponential", "matern32", "matern52"]
"""Names for signatures of estimators; what is below takes any name of the table."""

KERNELS: dict[str, Kernel] = {
    "squared_exponential": Kernel(lambda s: torch.exp(-0.5 * s), lambda _, k: -0.5 * k, on_nodes=True),
    "matern32": Kernel(_matern32, lambda s, _: -1.5 * torch.exp(-(3.0 * s).sqrt())),
    "matern52": Kernel(_matern52, lambda s, _: (-5.0 / 6.0) * (1.0 + (5.0 * s).sqrt()) * torch.exp(-(5.0 * s).sqrt())),
}
"""All kernels by name: the one place to add another."""


def differences(
    x: Float[Tensor, "n e"], other: Float[Tensor, "m e"], period: Float[Tensor, " e"] | None = None
) -> list[Float[Tensor, "n m"]]:
    """Differences in each input dimension; chords of a circle where its period, the circumference, is finite."""
    parts = []
    for dimension in range(x.shape[1]):
        difference = x[:, dimension : dimension + 1] - other[:, dimension]
        if period is not None and bool(torch.isfinite(period[dimension])):
            radius = period[dimension] / math.pi
            largest = torch.finfo(x.dtype).max  # the sine of infinity, many small periods away, is no number
            difference = radius * torch.sin((difference / radius).clamp(-largest, largest))
        parts.append(difference)
    return parts


def correlation(
    x: Float[Tensor, "n e"],
    other: Float[Tensor, "m e"],
    length_scale: Float[Tensor, "*b e"],
    kernel: str = "squared_exponential",
    period: Float[Tensor, " e"] | None = None,
) -> Float[Tensor, "*b n m"]:
    """Correlation of the latent values at two sets of inputs: eq. (4) with an amplitude of one.

    There is a length scale for each input dimension (automatic relevance determination), in the units of ``x``: the
    diagonal of the paper's Omega. Where a ``period`` is finite the input is a phase on a circle of that circumference,
    and distances are chords of it, which agree with the inputs' own where these are close: with the squared exponential
    this is the periodic kernel of MacKay (Rasmussen and Williams, eq. (4.31)).
    """
    scaled = (
        (difference / length_scale[..., dimension, None, None]).square()
        for dimension, difference in enumerate(differences(x, other, period))
    )
    return KERNELS[kernel].value(reduce(add, scaled).clamp_max(_FARTHEST))


def value_and_slope(
    square_differences: Float[Tensor, "e n m"], inverse_square: Float[Tensor, "b e"], kernel: str
) -> tuple[Float[Tensor, "b n m"], Float[Tensor, "b n m"]]:
    """Correlation and its derivative by the squared distance in length scales, for b sets of length scales."""
    square_distance = (inverse_square @ square_differences.flatten(1)).reshape(-1, *square_differences.shape[1:])
    square_distance = square_distance.clamp_max(_FARTHEST)
    value = KERNELS[kernel].value(square_distance)
    return value, KERNELS[kernel].slope(square_distance, value)


def default_length_scale(n_features: int, n_rows: int | None) -> float:
    """Length scale that is not learned, in ranges of the inputs: longer for several, farther apart, and for few rows.

    A length scale l has (1 + 0.8 / l)^e functions. With fewer rows for each the likeliest values explain each row by
    itself: of 120 rows of three inputs fresh ones lost 1e9 nats.
    """
    length_scale = 0.2 * n_features**0.5
    if n_rows is None:
        return length_scale
    n_functions = max(1.001, n_rows / _ROWS_OF_A_FUNCTION) ** (1.0 / n_features)
    return max(length_scale, min(0.8 / (n_functions - 1.0), n_features**0.5))
