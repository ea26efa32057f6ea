"""Blocks of outputs that share a unit: limits of their stiffness, and the standard deviations from which they hold."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, NamedTuple, final

from torch import Tensor

from torch_pbd import checks
from torch_pbd.exceptions import InvalidParameterError

Limit = float | Sequence[float]

# On the tunnel task these spread K_xx over 50 to 1000 N/m, and it rises at 214 N/m/s: at 1155 with the paper's bounds.
_QUANTILES = (0.1, 0.9)
# Smallest deviation that counts: squares of smaller ones are no numbers.
_SMALLEST = 1e-150


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
        check_stiffness(self.stiffness_min, self.stiffness_max, unit="Nm/rad")


class Block(NamedTuple):
    """Outputs of one unit, the limits of their stiffness, and the bounds of their standard deviation as given."""

    outputs: slice
    stiffness_min: float
    stiffness_max: float
    sigma_low: float | None
    sigma_high: float | None
    name: str = ""

    def of(self, matrix: Tensor) -> Tensor:
        """Part (..., k, k) of matrices (..., d, d)."""
        return matrix[..., self.outputs, self.outputs]


def of_outputs(blocks: Sequence[Block], values: Iterable[Any]) -> list[Any]:
    """Values of blocks, each as often as its block has outputs."""
    sizes = [block.outputs.stop - block.outputs.start for block in blocks]
    return [value for value, size in zip(values, sizes, strict=True) for _ in range(size)]


def plain(value: Any, name: str) -> Any:
    """Number as it is, or as many as there are outputs as a tuple of floats."""
    if value is None or isinstance(value, Real | str):
        return value
    return tuple(checks.array(value, name, ("d",)).tolist())


def check_stiffness(low: Any, high: Any, *, unit: str) -> None:
    """Refuse limits of stiffness, numbers or one for each output, that are not 0 < low <= high."""
    for (low_name, least), (high_name, most) in _pairs(low, high, "stiffness_min", "stiffness_max"):
        checks.number(least, low_name, above=0.0, unit=unit)
        checks.number(most, high_name, least=least, unit=unit)


def check_scales(low: Any, high: Any, prefix: str = "") -> None:
    """Refuse bounds of standard deviations, numbers or one for each output, that are not 0 <= low < high."""
    remedy = "or let bounds='quantile' take both from the covariances"
    for (low_name, least), (high_name, most) in _pairs(low, high, f"{prefix}sigma_low", f"{prefix}sigma_high"):
        above = checks.number(least, low_name, least=0.0, remedy=remedy)
        checks.number(most, high_name, above=above, remedy=remedy)


def _pairs(low: Any, high: Any, low_name: str, high_name: str) -> list[tuple[tuple[str, Any], tuple[str, Any]]]:
    sides = [
        [(f"{name}[{i}]", entry) for i, entry in enumerate(value)] if isinstance(value, tuple) else [(name, value)]
        for name, value in ((low_name, low), (high_name, high))
    ]
    size = max(map(len, sides))
    if any(len(side) not in (1, size) for side in sides):
        raise InvalidParameterError(
            f"{low_name} has {len(sides[0])} numbers and {high_name} has {len(sides[1])}, must have as many: one for "
            "each output, or one for all."
        )
    return list(zip(*(side * (size // len(side)) for side in sides), strict=True))


def quantiles(variances: Tensor, resolution: float = 0.0, name: str = "") -> tuple[float, float]:
    """Bounds of the standard deviation as quantiles of those along all axes, of which smaller count as ``resolution``.

    Warns where the standard deviations, of outputs of a ``name``, do not vary.
    """
    if not variances.numel():
        raise InvalidParameterError(
            "covariance is empty, must have at least one matrix: bounds='quantile' takes quantiles of them."
        )
    scales = variances.clamp_min(0.0).sqrt().clamp_min(resolution).flatten().sort().values
    low, high = (_quantile(scales, share) for share in _QUANTILES)
    # Quantiles that differ by rounding only would make a step of the line between them.
    if high > low * (1.0 + checks.ROUNDING):
        return low, high
    checks.warn(
        f"The covariances {f'of {name} ' if name else ''}do not vary: their standard deviations have quantiles "
        f"{low:.3g} and {high:.3g}. Every direction counts as precise, and gets stiffness_max; give "
        "sigma_low and sigma_high with bounds='sigma' to say what is precise."
    )
    precise = max(high * (1.0 + 1e-6), _SMALLEST) if high else 1.0
    return precise, 2.0 * precise


def _quantile(ordered: Tensor, share: float) -> float:
    """Linear interpolation between order statistics, of more than the 2^24 values that ``torch.quantile`` takes."""
    place = share * (len(ordered) - 1)
    below = min(int(place), len(ordered) - 2) if len(ordered) > 1 else 0
    above = min(below + 1, len(ordered) - 1)
    low, high = float(ordered[below]), float(ordered[above])
    return low + (place - below) * (high - low)
