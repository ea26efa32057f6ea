"""Outputs that are no coordinates of a flat space: unit quaternions, and angles that were wrapped."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from torch_pbd.data.alignment import Floats
from torch_pbd.data.units import ANGLES

# Four numbers rounded to three decimals: their squared sum is off by up to 2 sum |q| 0.0005, at most 0.002. What varies
# little around a point of norm 1 is a quaternion only if it keeps to the sphere far better than it varies.
_OFF_SPHERE, _OFF_SPHERE_SHARE = 2.5e-3, 0.1
_SAMPLES_ON_SPHERE = 0.9  # what is interpolated between q and -q is off it
# In turns: how far off one a jump may be, and how large other steps of an angle that was sampled densely enough.
_QUARTER = 0.25
_MOST_JUMPS = 0.1  # of all steps; a signal that jumps more often is another kind of signal
_LARGEST = 1e9  # angle that is looked at: differences of larger numbers may overflow


def find_suspects(positions: Sequence[Floats], names: Sequence[str], units: Sequence[str] | None) -> tuple[str, ...]:
    """What is suspect about outputs, each with its remedy; turns where the unit is rad or deg, or is not told."""
    within = [np.clip(position, -_LARGEST, _LARGEST) for position in positions]
    return (*_quaternions(np.concatenate(within), names), *_wrapped(within, names, units))


def _quaternions(samples: Floats, names: Sequence[str]) -> Iterator[str]:
    extent, first = np.ptp(samples, axis=0), 0
    while first + 4 <= len(names):
        four = slice(first, first + 4)
        off = np.abs(np.square(samples[:, four]).sum(axis=1) - 1.0)
        spread = extent[four].max()
        found = spread > 0.0 and np.mean(off <= min(_OFF_SPHERE, _OFF_SPHERE_SHARE * spread)) >= _SAMPLES_ON_SPHERE
        first += 4 if found else 1
        if found:
            yield (
                f"Outputs {', '.join(names[four])} have the squared sum 1, as unit quaternions do: q and -q are the "
                "same rotation, so their mean and their covariance are not those of rotations. Leave them out, as by "
                "outputs=[...] of load_demonstrations."
            )


def _wrapped(positions: Sequence[Floats], names: Sequence[str], units: Sequence[str] | None) -> Iterator[str]:
    steps = np.abs(np.concatenate([np.diff(position, axis=0) for position in positions]))
    extent = np.ptp(np.concatenate(positions), axis=0)
    told: Sequence[str | None] = units or [None] * len(names)
    for name, unit, step, whole in zip(names, told, steps.T, extent, strict=True):
        for angle in ANGLES if unit is None else {unit} & set(ANGLES):
            turn = 2.0 * math.pi / ANGLES[angle]
            jumps = np.abs(step - turn) <= _QUARTER * turn
            other = step[~jumps].max(initial=0.0)
            # What goes on behind the jump is as smooth as elsewhere.
            smooth = np.abs(step[jumps] - turn) <= max(3.0 * other, 1e-3 * turn)
            dense = other < _QUARTER * turn and 0 < jumps.sum() <= _MOST_JUMPS * len(step)
            if dense and smooth.all() and (unit is not None or whole <= 1.01 * turn):
                yield (
                    f"Output {name} jumps by a turn, {turn:.4g} {angle}, between two samples: means of such recordings "
                    "are no angles, and a robot would turn back the long way. Unwrap each recording first, by "
                    f"numpy.unwrap({name}{'' if angle == 'rad' else ', period=360'})."
                )
