"""Limits of the stiffness of outputs that share a unit, and the standard deviations from which they hold."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, final

from torch import Tensor

from torch_pbd import checks
from torch_pbd.exceptions import InvalidParameterError

Limit = float | Sequence[float]


class Block(NamedTuple):
    """Outputs of one unit, with the limits of their stiffness, the bounds of their deviation and their effort."""

    outputs: slice
    name: str
    stiffness_min: float
    stiffness_max: float
    sigma_low: Any
    sigma_high: Any
    effort: Any = "match"

    def of(self, matrix: Tensor) -> Tensor:
        """Part (..., k, k) of matrices (..., d, d)."""
        return matrix[..., self.outputs, self.outputs]


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
        check_limits(self, "rotations")


def check_limits(own: Any, name: str, bounds: str | None = None) -> None:
    """Check limits called by ``name``: 0 < stiffness_min <= stiffness_max, 0 <= sigma_low < sigma_high."""
    of, unit = f" of {name}" if name else "", {"": "N/m", "positions": "N/m", "rotations": "Nm/rad"}.get(name, "")
    least = checks.number(own.stiffness_min, f"stiffness_min{of}", above=0.0, unit=unit)
    checks.number(own.stiffness_max, f"stiffness_max{of}", least=least, unit=unit)
    if bounds == "quantile" and (own.sigma_low, own.sigma_high) != (None, None):
        raise InvalidParameterError(
            f"sigma_low={own.sigma_low} and sigma_high={own.sigma_high}{of} are standard deviations: give "
            "bounds='sigma' with them, or 'variance'; 'quantile' takes its own."
        )
    if bounds in ("sigma", "variance"):
        remedy = "or let bounds='quantile' take both from the covariances"
        low = checks.number(own.sigma_low, f"sigma_low{of}", least=0.0, remedy=remedy)
        checks.number(own.sigma_high, f"sigma_high{of}", above=low, remedy=remedy)


def of_outputs(blocks: Sequence[Block], name: str, like: Tensor) -> Tensor:
    """Values (d,) of blocks, each repeated for every output of its block."""
    return like.new_tensor(
        [getattr(block, name) for block in blocks for _ in range(block.outputs.start, block.outputs.stop)]
    )
