"""Units of outputs and of times: the known ones, and words that were meant to be one of them."""

import difflib
import math

import numpy as np
from numpy.typing import NDArray

LENGTHS = {"km": 1e3, "m": 1.0, "dm": 1e-1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
"""Metres of one unit."""

ANGLES = {"rad": 1.0, "deg": math.pi / 180.0}
"""Radians of one unit."""

TIMES = {"h": 3600.0, "min": 60.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds of one unit."""

_KNOWN = {**LENGTHS, **ANGLES, **TIMES}
_PREFIXES = ("", "kilo", "deci", "centi", "milli", "micro", "nano")
_SPELLED = {prefix + stem for prefix in _PREFIXES for stem in ("meter", "metre", "second", "radian")}
_SPELLED |= {"inch", "inches", "in", "foot", "feet", "ft", "yard", "mile", "micron", "μm", "degree", "°"}
_SPELLED |= {"sec", "msec", "usec", "μsec", "nsec", "μs", "minute", "hour", "hr"}
# Of long words a letter may be wrong or lacking; of short ones that would be another word.
_LONG, _CLOSE = [word for word in _SPELLED if len(word) >= 5], 0.9
# Seconds since 1970 are 1.7e9, and 1.7e18 in ns; no movement is counted in so many of anything coarser.
_LIKE_NS = 1e14


def check_unit(unit: str, argument: str, known: dict[str, float]) -> None:
    """Refuse what was meant to be a known unit but is none, as "millimeter", "inch" and, of those ``known``, "MM".

    Those of other kinds may be other units in other cases: "Ns" is no nanosecond.
    """
    folded = unit.strip(" .").casefold()
    forms = {folded, folded.removesuffix("s")}
    close = forms & {*known, *_SPELLED} or difflib.get_close_matches(folded, _LONG, n=1, cutoff=_CLOSE)
    if unit not in _KNOWN and close:
        listed = "; ".join(", ".join(kind) for kind in (LENGTHS, ANGLES, TIMES))
        raise ValueError(
            f"{argument} is {unit!r}, must be written as one of the known units, {listed}: convert what is in others, "
            "such as inches. A word like none of them, such as 'pixels', is taken for a unit of its own."
        )


def exact(time: float | int) -> str:
    """A time to its last digit: numbers that differ are never written alike."""
    return str(int(time)) if abs(time) >= _LIKE_NS and time == int(time) else str(time)


def nanoseconds_hint(times: NDArray[np.generic] | float | int) -> str:
    """Sentence on the unit of times that look like ns; empty for others."""
    stamps = np.asarray(times)
    largest = float(np.abs(stamps.astype(np.float64)).max())
    if not _LIKE_NS <= largest < math.inf or (stamps != np.round(stamps)).any():
        return ""
    coarse = (
        f", of which float64 tells {np.spacing(largest):.0f} apart: give integers" if stamps.dtype.kind == "f" else ""
    )
    return f" Whole numbers above {_LIKE_NS:g} look like ns (time_unit='ns'){coarse}."
