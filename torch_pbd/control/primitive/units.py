"""From the units of recordings to metres and seconds, in which a robot's mass and forces are told."""

import warnings
from collections.abc import Sequence

import numpy as np

from torch_pbd import checks
from torch_pbd.data import Demonstrations
from torch_pbd.data.units import ANGLES, LENGTHS, TIMES


def in_seconds(time_unit: str) -> float | None:
    """Seconds of one unit of time; None where it is no unit of time, as of a phase."""
    return TIMES.get(time_unit)


def in_metres(units: Sequence[str] | None) -> float:
    """Metres of one unit of position; 1 where units are not told, differ, or are no lengths.

    Those are taken as they are: stiffness is then in N per unit, and mass in N s^2 per unit.
    """
    common = common_unit(units)
    return LENGTHS.get(common, 1.0) if common is not None else 1.0


def robot_unit(units: Sequence[str] | None) -> str | None:
    """Unit of the positions of a robot that follows recordings in these units."""
    common = common_unit(units)
    return "m" if common in LENGTHS else common


def common_unit(units: Sequence[str] | None) -> str | None:
    """The unit of all outputs; None if they have none, or several."""
    return units[0] if units is not None and len(set(units)) == 1 else None


def warn_of_units(units: Sequence[str] | None) -> None:
    """Tell what is made of positions whose units are not told, differ, or are no lengths and no angles."""
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
    """Duration of a movement in s, and seconds of one unit of the demonstrations' time.

    Parameters
    ----------
    demonstrations : Demonstrations
        Their median lasts as long as the movement.
    duration : float or None
        In s; None is theirs.

    Warns
    -----
    UserWarning
        If it is None and their times are no seconds: one unit then counts as one.
    """
    own = float(np.median([time[-1] - time[0] for time in demonstrations.times]))
    if duration is not None:
        return float(duration), duration / own
    scale = in_seconds(demonstrations.time_unit)
    if scale is None:
        warnings.warn(
            f"The times of the demonstrations are in {demonstrations.time_unit!r}, not in s: the movement is taken to "
            f"last {own:.3g} s. Give duration, in s.",
            stacklevel=3,
        )
        scale = 1.0
    return own * scale, scale


def common_start(demonstrations: Demonstrations) -> float:
    """Time at which the demonstrations start, up to a sample; 0 where they start at different times."""
    starts = np.array([time[0] for time in demonstrations.times])
    step = np.median([np.median(np.diff(time)) for time in demonstrations.times])
    return float(np.median(starts)) if np.ptp(starts) <= step else 0.0
