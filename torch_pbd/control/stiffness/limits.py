"""Limits of the stiffness of outputs that share a unit, and the standard deviations from which they hold."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, final

from torch import Tensor

from torch_pbd import checks
from torch_pbd.exceptions import InvalidParameterError

Limit = float | Sequence[float]


@final
@dataclass(frozen=True)
class RotationLimits:
    """Limits of the last three outputs, which are a rotation: a block of its own in a :class:`StiffnessLaw`.

    Parameters
    ----------
    stiffness_min, stiffness_max : float, default=2.5, 50.0
        In Nm/rad, 0 < stiffness_min <= stiffness_max: what 50 to 1000 N/m are at a lever of 0.22 m. Arms take 1 to 300.
    sigma_low, sigma_high : float, default=None
        Bounds of the standard deviation in rad, or of the variance, as ``bounds`` of the law says; None with quantiles,
        which are those of the rotation alone.
    """

    stiffness_min: float = 2.5
    stiffness_max: float = 50.0
    sigma_low: float | None = None
    sigma_high: float | None = None

    def __post_init__(self) -> None:
        check_stiffness(self, "Nm/rad")


class Block(NamedTuple):
    """Outputs of one unit, the limits of their stiffness, and what decides between these: see `StiffnessLaw`."""

    outputs: slice
    stiffness_min: float
    stiffness_max: float
    sigma_low: Any
    sigma_high: Any
    name: str
    effort: float = math.nan

    def of(self, matrix: Tensor) -> Tensor:
        """Part (..., k, k) of matrices (..., d, d)."""
        return matrix[..., self.outputs, self.outputs]


def of_outputs(blocks: Sequence[Block], name: str) -> list[Any]:
    """Values of blocks, each as often as its block has outputs."""
    return [getattr(block, name) for block in blocks for _ in range(block.outputs.start, block.outputs.stop)]


def check_stiffness(law: Any, unit: str) -> None:
    """Refuse limits of stiffness, numbers or one for each output, that are not 0 < min <= max."""
    for (low_name, low), (high_name, high) in _pairs(law, "stiffness_min", "stiffness_max"):
        checks.number(low, low_name, above=0.0, unit=unit)
        checks.number(high, high_name, least=low, unit=unit)


def check_scales(law: Any, prefix: str) -> None:
    """Refuse bounds of standard deviations, numbers or one for each output, that are not 0 <= low < high."""
    remedy = "or let bounds='quantile' take both from the covariances"
    for (low_name, low), (high_name, high) in _pairs(law, "sigma_low", "sigma_high", prefix):
        above = checks.number(low, low_name, least=0.0, remedy=remedy)
        checks.number(high, high_name, above=above, remedy=remedy)


def _pairs(law: Any, low_name: str, high_name: str, prefix: str = "") -> list[Any]:
    """Names and values of two limits, output by output where one of them is of each."""
    sides = []
    for name in (low_name, high_name):
        value, name = getattr(law, name), prefix + name
        of_each = isinstance(value, tuple)
        sides.append([(f"{name}[{i}]", entry) for i, entry in enumerate(value)] if of_each else [(name, value)])
    size = max(map(len, sides))
    if any(len(side) not in (1, size) for side in sides):
        raise InvalidParameterError(
            f"{low_name} has {len(sides[0])} numbers and {high_name} has {len(sides[1])}, must have as many: one for "
            "each output, or one for all."
        )
    return list(zip(*(side * (size // len(side)) for side in sides), strict=True))
