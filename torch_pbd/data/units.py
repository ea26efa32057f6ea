"""Units of outputs and times, and detection of non-Euclidean outputs: quaternions and wrapped angles."""

import difflib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from torch_pbd.checks import Floats, refusal

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

# Four numbers rounded to three decimals: their squared sum is off by up to 2 sum |q| 0.0005, at most 0.002. What varies
# little around a point of norm 1 is a quaternion only if it keeps to the sphere far better than it varies.
OFF_SPHERE, _OFF_SPHERE_SHARE = 2.5e-3, 0.1
_SAMPLES_ON_SPHERE = 0.9  # least share of samples of norm 1, as interpolation between q and -q leaves the sphere
# Tolerance in turns of a jump's size, and of other steps of an angle that was sampled densely enough.
_QUARTER = 0.25
_MOST_JUMPS = 0.1  # largest share of steps that jump; a signal that jumps more often is not an angle
_LARGEST_ANGLE = 1e9  # differences of far larger numbers may overflow


def check_unit(unit: str, name: str, known: dict[str, float]) -> None:
    """Raise for misspelled units such as "millimeter", "inch" and, for those ``known``, "MM".

    Units of other kinds may differ by case: "Ns" is no nanosecond.
    """
    folded = unit.strip(" .").casefold()
    forms = {folded, folded.removesuffix("s")}
    close = forms & {*known, *_SPELLED} or difflib.get_close_matches(folded, _LONG, n=1, cutoff=_CLOSE)
    if unit not in LENGTHS | ANGLES | TIMES and close:
        listed = "; ".join(", ".join(kind) for kind in (LENGTHS, ANGLES, TIMES))
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


def find_suspects(positions: Sequence[Floats], names: Sequence[str], units: Sequence[str] | None) -> tuple[str, ...]:
    """Warnings about non-Euclidean outputs, with remedies; without units, an angle may be in rad or deg."""
    found = []
    for first in quaternions(positions, len(names)):
        four = names[first : first + 4]
        order = tuple(sorted(four, key=lambda name: name[-1:]))
        known = [name[-1:] for name in order] == [*"wxyz"]
        what = f"Outputs {', '.join(four)} have the squared sum 1, as unit quaternions do, whose mean is no rotation"
        given = order if known else "(w, x, y, z), of which only you know the names"
        found.append(f"{what}: say which they are, in the order w x y z, rotation={given}, or leave them out.")
    for i, name in enumerate(names):
        angle = _wrapped(positions, i, None if units is None else units[i])
        if angle:
            what = f"Output {name} jumps by a turn, {2.0 * math.pi / ANGLES[angle]:.4g} {angle}, between two samples"
            found.append(f"{what}, and so does a mean. Say angles=[{name!r}], and that its unit is {angle!r}.")
    return tuple(found)


def quaternions(positions: Sequence[Floats], n_outputs: int) -> list[int]:
    """Indices of outputs that begin four columns of unit quaternions."""
    found, first = [], 0
    while first + 4 <= n_outputs:
        columns = [_column(positions, i) for i in range(first, first + 4)]
        off = np.abs(sum(map(np.square, columns)) - 1.0)
        spread = max(map(np.ptp, columns))
        if spread > 0.0 and np.mean(off <= min(OFF_SPHERE, _OFF_SPHERE_SHARE * spread)) >= _SAMPLES_ON_SPHERE:
            found.append(first)
        first += 4 if first in found else 1
    return found


def _column(positions: Sequence[Floats], i: int) -> Floats:
    """One output of all demonstrations, clipped so that differences do not overflow."""
    return np.concatenate([position[:, i] for position in positions]).clip(-_LARGEST_ANGLE, _LARGEST_ANGLE)


def _wrapped(positions: Sequence[Floats], i: int, unit: str | None) -> str | None:
    """Unit in which an output jumps by a turn; None if it does not."""
    whole = max(float(y[:, i].max()) for y in positions) - min(float(y[:, i].min()) for y in positions)
    for angle in ANGLES if unit is None else {unit} & set(ANGLES):
        turn = 2.0 * math.pi / ANGLES[angle]
        # Most outputs cover less than a turn, and are not looked at step by step.
        if whole < (1.0 - _QUARTER) * turn or (unit is None and whole > 1.01 * turn):
            continue
        ends = np.cumsum([len(position) for position in positions])[:-1] - 1  # between two demonstrations
        step = np.delete(np.abs(np.diff(_column(positions, i))), ends)
        jumps = np.abs(step - turn) <= _QUARTER * turn
        other = step[~jumps].max(initial=0.0)
        # An unwrapped signal continues after the jump as smoothly as elsewhere.
        smooth = np.abs(step[jumps] - turn) <= max(3.0 * other, 1e-3 * turn)
        if other < _QUARTER * turn and 0 < jumps.sum() <= _MOST_JUMPS * len(step) and smooth.all():
            return angle
    return None
