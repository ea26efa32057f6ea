"""From the units of recordings to metres, radians and seconds, those of a robot; and what no robot does in them."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, final

import numpy as np

from torch_pbd import checks
from torch_pbd.data import Demonstrations
from torch_pbd.data.units import ANGLES, LENGTHS, TIMES

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


def check_motion(limits: Any, units: Sequence[str] | None, time_unit: str, **found: float) -> None:
    """Refuse a duration, distance or speed, by name, beyond the limits, in units of length or without units."""
    checks.instance(limits, "limits", MotionLimits, optional=True)
    for name, value in found.items() if limits is not None and counts_as_metres(units) else ():
        most, unit = getattr(limits, name), _UNITS[name]
        if value > most:
            raise ValueError(
                f"the {name} of the schedule is {value:.4g} {unit}, must be at most limits.{name}, {most:g} {unit}: "
                f"correct units ({', '.join(units or ['none'])}) or time_unit ({time_unit}) of the recordings, or give "
                f"limits=MotionLimits({name}=...) or None."
            )


def common_unit(units: Sequence[str] | None) -> str | None:
    """The unit of all outputs; None if they have none, or several."""
    return units[0] if units is not None and len(set(units)) == 1 else None


def in_si(units: Sequence[str] | None) -> float:
    """Metres, or radians, of one unit of position; 1 where units are not known, differ, or are neither.

    Those are taken as they are: stiffness is then in N per unit, and mass in N s^2 per unit.
    """
    return (LENGTHS | ANGLES).get(common_unit(units) or "", 1.0)


def robot_unit(units: Sequence[str] | None) -> str | None:
    """Unit of the positions of a robot that follows recordings in these units."""
    common = common_unit(units)
    return "m" if common in LENGTHS else "rad" if common in ANGLES else common


def counts_as_metres(units: Sequence[str] | None) -> bool:
    """True if schedules of recordings in these units are in m, which is also assumed where there are none."""
    return units is None or robot_unit(units) == "m"


def warn_of_units(units: Sequence[str] | None) -> None:
    """Warn of what becomes of positions whose units are not given, differ, or are no lengths and no angles."""
    common = common_unit(units)
    if units is None:
        text = "The demonstrations tell no units: positions are taken to be in m. Say so, or in what else: units='m'."
    elif common is None:
        text = (
            f"The outputs are in different units, {', '.join(units)}: their principal axes mix them, and nothing is "
            "converted to m. Bring them to one unit, or control them apart."
        )
    elif common not in LENGTHS | ANGLES:
        text = (
            f"The positions are in {common!r}, which is no known length or angle ({', '.join(LENGTHS | ANGLES)}): "
            "stiffness is in N per that unit, and no limits of motion apply."
        )
    else:
        return
    checks.warn(text)


def duration_of(demonstrations: Demonstrations, duration: float | None) -> tuple[float, float]:
    """Duration of a movement in s, None for the median of the demonstrations; and seconds of one unit of their time.

    Warns where it is None and their times are no seconds: one unit then counts as one.
    """
    own = float(np.median([time[-1] - time[0] for time in demonstrations.times]))
    if duration is not None:
        return float(duration), duration / own
    scale = TIMES.get(demonstrations.time_unit)  # none of a phase
    if scale is None:
        checks.warn(
            f"The times of the demonstrations are in {demonstrations.time_unit!r}, not in s: the movement is taken to "
            f"last {own:.3g} s. Give duration, in s."
        )
        scale = 1.0
    return own * scale, scale


def common_start(demonstrations: Demonstrations) -> float:
    """Time at which the demonstrations start, up to a sample; 0 where they start at different times."""
    starts = np.array([time[0] for time in demonstrations.times])
    step = np.median([np.median(np.diff(time)) for time in demonstrations.times])
    return float(np.median(starts)) if np.ptp(starts) <= step else 0.0
