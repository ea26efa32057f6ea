"""What no robot does: movements beyond it are recordings in other units than they say."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, final

from torch_pbd import checks
from torch_pbd.control.primitive.units import robot_unit

_UNITS = {"duration": "s", "distance": "m", "speed": "m/s"}


@final
@dataclass(frozen=True)
class MotionLimits:
    """What is beyond what robots do, so that a schedule is refused: its units cannot be right.

    Parameters
    ----------
    duration : float, default=600.0
        Of the movement, s.
    distance : float, default=10.0
        Diagonal of the box around the path, m; where it lies does not matter.
    speed : float, default=10.0
        In m/s.
    """

    duration: float = 600.0
    distance: float = 10.0
    speed: float = 10.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            checks.number(value, name, above=0.0, unit=_UNITS[name])


def counts_as_metres(units: Sequence[str] | None) -> bool:
    """Whether schedules of recordings in these units are in m, or in what is taken for it where none are told."""
    return units is None or robot_unit(units) == "m"


def check_motion(limits: Any, units: Sequence[str] | None, time_unit: str, **found: float) -> None:
    """Refuse a duration, distance or speed, by name, beyond the limits, in units of length or without units."""
    if not isinstance(limits, MotionLimits | None):
        raise ValueError(f"limits is {limits!r}, must be MotionLimits or None.")
    for name, value in found.items() if limits is not None and counts_as_metres(units) else ():
        if value > getattr(limits, name):
            told, unit = ", ".join(units or ["none"]), _UNITS[name]
            raise ValueError(
                f"the schedule has a {name} of {value:.4g} {unit}, more than limits.{name} == "
                f"{getattr(limits, name):g} {unit}: are units ({told}) and time_unit ({time_unit}) of the recordings "
                f"right? If so, give limits=MotionLimits({name}=...) or None."
            )
