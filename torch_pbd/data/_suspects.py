"""Outputs that are no coordinates of a flat space: unit quaternions, and angles that were wrapped."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from torch_pbd.data._units import ANGLES
from torch_pbd.data.alignment import Floats

# Four numbers rounded to three decimals: their squared sum is off by up to 2 sum |q| 0.0005, at most 0.002. What varies
# little around a point of norm 1 is a quaternion only if it keeps to the sphere far better than it varies.
_OFF_SPHERE, _OFF_SPHERE_SHARE = 2.5e-3, 0.1
# Samples on the sphere: what is interpolated between q and -q is not.
_MOST_SAMPLES = 0.9
# In turns: what is about one, and the largest other step of an angle that was sampled densely enough to follow.
_ABOUT_ONE, _OTHER_STEPS = 0.25, 0.25
# Of all steps; a signal that jumps more often is another kind of signal.
_MOST_JUMPS = 0.1
_LARGEST = 1e9  # of angles that are looked at: differences of larger numbers may overflow


def find_suspects(positions: Sequence[Floats], names: Sequence[str], units: Sequence[str] | None) -> tuple[str, ...]:
    """What is suspect about outputs, each with its remedy; none where nothing is.

    Parameters
    ----------
    positions : sequence of K ndarrays of shape (T_k, d)
    names : sequence of d str
    units : sequence of d str or None
        Full turns are looked for in outputs in rad and deg, and in those whose unit is not told.
    """
    return (*_quaternions(np.concatenate(positions), names), *_wrapped(positions, names, units))


def _quaternions(samples: Floats, names: Sequence[str]) -> Iterator[str]:
    squares = np.clip(samples, -2.0, 2.0) ** 2
    low, high = np.clip(samples.min(axis=0), -2.0, 2.0), np.clip(samples.max(axis=0), -2.0, 2.0)
    start = 0
    while start + 4 <= len(names):
        four = slice(start, start + 4)
        spread = float((high - low)[four].max())
        off = np.abs(squares[:, four].sum(axis=1) - 1.0)
        if spread > 0.0 and np.mean(off <= min(_OFF_SPHERE, _OFF_SPHERE_SHARE * spread)) >= _MOST_SAMPLES:
            yield (
                f"Outputs {', '.join(names[four])} have the squared sum 1, as unit quaternions do: q and -q are the "
                "same rotation, so their mean and their covariance are not those of rotations. Leave them out, as by "
                "outputs=[...] of load_demonstrations."
            )
            start += 3
        start += 1


def _wrapped(positions: Sequence[Floats], names: Sequence[str], units: Sequence[str] | None) -> Iterator[str]:
    within = [np.clip(position, -_LARGEST, _LARGEST) for position in positions]
    steps = np.concatenate([np.abs(np.diff(position, axis=0)) for position in within])
    extent = np.ptp(np.concatenate(within), axis=0)
    for output, name in enumerate(names):
        unit = None if units is None else units[output]
        for angle in ANGLES if unit is None else {unit} & set(ANGLES):
            turn, step = 2.0 * math.pi / ANGLES[angle], steps[:, output]
            jumps = np.abs(step - turn) <= _ABOUT_ONE * turn
            other = float(step[~jumps].max(initial=0.0))
            # What goes on behind the jump is as smooth as elsewhere.
            smooth = np.abs(step[jumps] - turn) <= max(3.0 * other, 1e-3 * turn)
            if not (0 < jumps.sum() <= _MOST_JUMPS * len(step) and other < _OTHER_STEPS * turn and smooth.all()):
                continue
            if unit is None and extent[output] > 1.01 * turn:
                continue
            yield (
                f"Output {name} jumps by a turn, {turn:.4g} {angle}, between two samples: means of such recordings are "
                "no angles, and a robot would turn back the long way. Unwrap each recording first, by numpy.unwrap("
                f"{name}{'' if angle == 'rad' else ', period=360'})."
            )
