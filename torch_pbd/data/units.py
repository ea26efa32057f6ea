"""Units of outputs and times, and how times are told."""

import difflib
import math
from typing import Any

import numpy as np

from torch_pbd.checks import refusal

LENGTHS = {"km": 1e3, "m": 1.0, "dm": 1e-1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
"""Metres of one unit."""

ANGLES = {"rad": 1.0, "deg": math.pi / 180.0}
"""Radians of one unit."""

TIMES = {"h": 3600.0, "min": 60.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds of one unit."""

_PREFIXES = ("", "kilo", "deci", "centi", "milli", "micro", "nano")
_SPELLED = {prefix + stem for prefix in _PREFIXES for stem in ("meter", "metre", "second", "radian")}
_SPELLED |= {"inch", "inches", "in", "foot", "feet", "ft", "yard", "mile", "micron", "μm", "degree", "°"}
_SPELLED |= {"sec", "msec", "usec", "μsec", "nsec", "μs", "minute", "hour", "hr"}
# Long words may have a wrong or missing letter; in short ones that would be another word.
_LONG, _CLOSE = [word for word in _SPELLED if len(word) >= 5], 0.9
# Seconds since 1970 are 1.7e9, and 1.7e18 in ns; no movement is counted in so many of anything coarser.
_LIKE_NS = 1e14


def check_unit(unit: str, name: str, known: dict[str, float]) -> None:
    """Raise for misspelled units such as "millimeter", "inch" and, for those ``known``, "MM".

    Units of other kinds may differ by case: "Ns" is no nanosecond.
    """
    folded = unit.strip(" .").casefold()
    forms = {folded, folded.removesuffix("s")}
    close = forms & {*known, *_SPELLED} or difflib.get_close_matches(folded, _LONG, n=1, cutoff=_CLOSE)
    kinds = (TIMES,) if known is TIMES else (LENGTHS, ANGLES, TIMES)
    if not any(unit in kind for kind in kinds) and (close or unit in LENGTHS | ANGLES):  # "m" for minutes
        listed = "; ".join(", ".join(kind) for kind in kinds)
        remedy = "convert what is in others; words like none of them, such as 'pixels', are units of their own"
        raise refusal(unit, name, f"written as one of the known units, {listed}", remedy)


def exact(time: float | int) -> str:
    """Text of a time with all digits, so that different numbers have different texts."""
    return str(int(time)) if abs(time) >= _LIKE_NS and time == int(time) else str(time)


def nanoseconds_hint(times: Any) -> str:
    """Hint at the unit of times that look like ns; empty for others."""
    stamps = np.asarray(times)
    largest = float(np.abs(stamps.astype(np.float64)).max())
    if not _LIKE_NS <= largest < math.inf or (stamps != np.round(stamps)).any():
        return ""
    coarse = f", float64 tells {np.spacing(largest):.0f} apart: give integers" if stamps.dtype.kind == "f" else ""
    return f" Whole numbers above {_LIKE_NS:g} look like ns (time_unit='ns'){coarse}."
