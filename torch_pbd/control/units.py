"""From the units of recordings to metres and seconds, in which a robot's mass and forces are told."""

import warnings
from collections.abc import Sequence

import numpy as np

from torch_pbd.data import Demonstrations

_METRES = {"m": 1.0, "dm": 1e-1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}


def in_seconds(time_unit: str) -> float | None:
    """Seconds of one unit of time; None where it is no unit of time, as of a phase."""
    return _SECONDS.get(time_unit)


def in_metres(units: Sequence[str] | None) -> float:
    """Metres of one unit of position; 1 where units are not told, differ, or are no lengths.

    Those are taken as they are: stiffness is then in N per unit, and mass in N s^2 per unit.
    """
    common = common_unit(units)
    return _METRES.get(common, 1.0) if common is not None else 1.0


def robot_unit(units: Sequence[str] | None) -> str | None:
    """Unit of the positions of a robot that follows recordings in these units."""
    common = common_unit(units)
    return "m" if common in _METRES else common


def common_unit(units: Sequence[str] | None) -> str | None:
    """The unit of all outputs; None if they have none, or several."""
    return units[0] if units is not None and len(set(units)) == 1 else None


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
