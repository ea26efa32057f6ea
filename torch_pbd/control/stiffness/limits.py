"""Limits of the stiffness of outputs that share a unit, and the standard deviations from which they hold."""

import math
from collections.abc import Iterator, Sequence
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
        Limits in Nm/rad, 0 < min <= max: 50 to 1000 N/m at a lever of 0.22 m. Robot arms accept 1 to 300.
    sigma_low, sigma_high : float, default=None
        Bounds of the standard deviation in rad, or of the variance, by ``bounds`` of the law; None for quantiles, which
        are taken over the rotation alone.
    """

    stiffness_min: float = 2.5
    stiffness_max: float = 50.0
    sigma_low: float | None = None
    sigma_high: float | None = None

    def __post_init__(self) -> None:
        check_stiffness(self, "Nm/rad")


class Block(NamedTuple):
    """Outputs of one unit, with the limits of their stiffness and the bounds of their standard deviation."""

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
    """Values of blocks, each repeated for every output of its block."""
    return [getattr(block, name) for block in blocks for _ in range(block.outputs.start, block.outputs.stop)]


def check_stiffness(law: Any, unit: str) -> None:
    """Check that limits of the stiffness, numbers or one per output, satisfy 0 < min <= max."""
    for low_name, low, high_name, high in _pairs(law, "stiffness_min", "stiffness_max"):
        checks.number(low, low_name, above=0.0, unit=unit)
        checks.number(high, high_name, least=low, unit=unit)


def check_scales(law: Any, prefix: str) -> None:
    """Check that bounds of standard deviations, numbers or one per output, satisfy 0 <= low < high."""
    remedy = "or let bounds='quantile' take both from the covariances"
    for low_name, low, high_name, high in _pairs(law, "sigma_low", "sigma_high"):
        above = checks.number(low, prefix + low_name, least=0.0, remedy=remedy)
        checks.number(high, prefix + high_name, above=above, remedy=remedy)


def _pairs(law: Any, *names: str) -> Iterator[tuple[str, Any, str, Any]]:
    """Name and value of the lower and the upper limit, once, or per output where one is a tuple."""
    sides = [value if isinstance(value, tuple) else (value,) for value in (getattr(law, name) for name in names)]
    size = max(map(len, sides))
    if any(len(side) not in (1, size) for side in sides):
        raise InvalidParameterError(
            f"{names[0]} has {len(sides[0])} numbers and {names[1]} has {len(sides[1])}, must have as many: one for "
            "each output, or one for all."
        )
    for i in range(size):
        each = zip(names, sides, strict=True)
        low, high = ((f"{name}[{i}]", side[i]) if len(side) > 1 else (name, side[0]) for name, side in each)
        yield *low, *high
