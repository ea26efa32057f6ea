"""Rotations and angles: recognized in recordings, to and from a chart around their mean, and unwrapped."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.alignment import interpolate, unit_phases
from torch_pbd.data.recordings import as_names, as_recordings, as_texts, as_units, frozen, preview
from torch_pbd.data.units import ANGLES
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.rotations import Chart, continuous, mean

ROTATION = ("rx", "ry", "rz")
QUATERNION = ("qw", "qx", "qy", "qz")

# Degrees from the reference. The chart ends at 180, where y and -y are one rotation; a normal distribution in it that
# is 15 degrees wide has two standard deviations left at 150.
_FAR, FURTHEST = 120.0, 150.0
_N_PHASES = 201  # phases of each recording in the mean, so that duration and sampling rate do not weigh in

# Four numbers rounded to three decimals: their squared sum is off by up to 2 sum |q| 0.0005, at most 0.002. What varies
# little around a point of norm 1 is a quaternion only if it keeps to the sphere far better than it varies.
_OFF_SPHERE, _OFF_SPHERE_SHARE = 2.5e-3, 0.1
_SAMPLES_ON_SPHERE = 0.9  # least share of samples of norm 1, as interpolation between q and -q leaves the sphere
# Tolerance in turns of a jump's size, and of other steps of an angle that was sampled densely enough.
_QUARTER = 0.25
_MOST_JUMPS = 0.1  # largest share of steps that jump; a signal that jumps more often is not an angle
_LARGEST_ANGLE = 1e9  # differences of far larger numbers may overflow


def as_reference(reference: Any, times: Any, positions: Any, names: Any, units: Any) -> Floats:
    """Checked reference of the chart in which the last three outputs already are, as in a file."""
    quaternion = checks.array(reference, "rotation_reference", (4,))
    if abs(float(quaternion @ quaternion) - 1.0) > checks.ROUNDING:
        raise checks.refusal(reference, "rotation_reference", "a unit quaternion w x y z")
    if len(names) < 3 or (units is not None and set(units[-3:]) != {"rad"}):
        must = f"given for outputs that end with three of a rotation in rad, not for {preview(names)}"
        raise checks.refusal(reference, "rotation_reference", must)
    _check_reach(times, [position[:, -3:] for position in positions])
    return frozen(quaternion)


def as_chart(times: Any, positions: Any, names: Any, units: Any, rotation: Any, missing: Any) -> tuple[Any, ...]:
    """Recordings and labels with four columns of quaternions as three in the chart, and its reference."""
    chosen = as_texts(rotation, "rotation")
    if not len(chosen) == len(set(chosen)) == len(set(chosen) & set(names)) == 4:
        must = f"four different ones of {preview(names)}, in the order w x y z, wherever these stand"
        raise checks.refusal(rotation, "rotation", must)
    columns = [names.index(name) for name in chosen]
    if missing == "drop":  # a tracker that saw nothing wrote zeros
        holes = [np.where(y[:, columns].any(axis=1, keepdims=True), y, np.nan) for y in positions]
        times, positions = as_recordings(times, holes, "drop")
    turns = []
    for k, position in enumerate(positions):
        norm = np.linalg.norm(position[:, columns], axis=1)
        what, remedy = f"the norm of {', '.join(chosen)} in positions[{k}]", "missing='drop' leaves zeros out"
        checks.require(np.abs(norm**2 - 1.0) <= _OFF_SPHERE, norm, what, "1", f"name a rotation; {remedy}")
        turns.append(position[:, columns] / norm[:, np.newaxis])
    kept = [i for i in range(len(names)) if i not in columns]
    if units is not None and not isinstance(units, str) and len(units) == len(names):
        units = [units[i] for i in kept]
    own = as_units(units, len(kept))
    labels = as_names([*(names[i] for i in kept), *ROTATION], len(kept) + 3)
    charts, reference = charted(times, [position[:, kept] for position in positions], turns)
    return times, charts, labels, None if own is None else (*own, "rad", "rad", "rad"), reference


def charted(
    times: Sequence[Floats], places: Sequence[Floats], quaternions: Sequence[Floats]
) -> tuple[list[Floats], Floats]:
    """Outputs (T_k, p + 3) of poses, with rotations in the chart around their Frechet mean, and that mean (4,)."""
    phases = np.linspace(0.0, 1.0, _N_PHASES)
    pairs = zip(unit_phases(times), quaternions, strict=True)
    together = np.concatenate([interpolate(own, continuous(turn), phases) for own, turn in pairs])
    reference = frozen(mean(together / np.linalg.norm(together, axis=1, keepdims=True)))
    turns = list(map(Chart(reference).log, quaternions))
    _check_reach(times, turns)
    return [np.column_stack([place, turn]) for place, turn in zip(places, turns, strict=True)], reference


def as_columns(demonstrations: Any) -> tuple[tuple[str, ...], Sequence[Floats]]:
    """Names and columns (T_k, ...) for tables of other programs, with rotations as quaternions."""
    names, columns = demonstrations.names, demonstrations.positions
    if demonstrations.rotation_reference is not None:
        names = as_names((*names[:-3], *QUATERNION), len(names) + 1)
        columns = list(map(np.hstack, zip(*demonstrations.to_poses(), strict=True)))
    taken = {"demo", "time"} & set(names)
    if taken:
        raise InvalidParameterError(f"an output named {min(taken)!r} cannot be told from other columns: rename it.")
    return names, columns


def with_whole_rotation(chosen: Sequence[str], names: Sequence[str], reference: Any) -> tuple[tuple[str, ...], Any]:
    """Chosen outputs, those of a rotation last, and its reference; None where it is not among them."""
    own = names[-3:] if reference is not None else ()
    if not set(own) & set(chosen):
        return tuple(chosen), None
    if not set(own) <= set(chosen):
        raise checks.refusal([*chosen], "outputs", f"with all of {', '.join(own)} or none, which are one rotation")
    return (*(name for name in chosen if name not in own), *own), reference


def unwrapped(times: Any, positions: Any, names: Any, units: Any, angles: Any) -> list[Floats]:
    """Outputs (T_k, d) with the named angles unwrapped, along time and from one recording to the next.

    Recordings are shifted to the turn nearest to the direction that their means have in common. All are then shifted
    back together by the turns of the median recording, so that joints keep the turn that a robot knows.
    """
    positions = [np.array(position) for position in positions]
    for name in as_texts(angles, "angles"):
        if name not in names:
            raise checks.refusal(name, "angles", f"among {preview(names)}")
        i = names.index(name)
        unit = None if units is None else units[i]
        if unit not in ANGLES:
            raise checks.refusal(name, "angles", f"in rad or deg, and is in {unit}", "give units=, one for each output")
        turn = 2.0 * math.pi / ANGLES[unit]
        curves = [np.unwrap(position[:, i], period=turn) for position in positions]
        middle = np.array([np.trapezoid(y, t) / (t[-1] - t[0]) for t, y in zip(times, curves, strict=True)])
        common = np.angle(np.exp(2j * math.pi * middle / turn).mean()) / (2.0 * math.pi) * turn
        turns = np.round((middle - common) / turn)
        turns -= np.sort(turns)[(len(turns) - 1) // 2]
        for position, curve, n in zip(positions, curves, turns, strict=True):
            position[:, i] = curve - n * turn
    return positions


def _check_reach(times: Sequence[Floats], turns: Sequence[Floats]) -> None:
    angles = [np.degrees(np.linalg.norm(turn, axis=1)) for turn in turns]
    k = int(np.argmax([angle.max() for angle in angles]))
    i = int(np.argmax(angles[k]))
    furthest = angles[k][i]
    what = f"recording {k} is {furthest:.1f} degrees from the mean rotation at {times[k][i]:.6g}"
    remedy = "leave a wrong sample out, or, as of screws, learn deviations from the mean rotation of each time"
    if furthest > FURTHEST:
        raise InvalidParameterError(f"{what}, must be at most {FURTHEST:.0f}: {remedy}.")
    if furthest > _FAR:
        checks.warn(f"{what.capitalize()}, and {FURTHEST:.0f} are refused: {remedy}.")


def find_suspects(positions: Sequence[Floats], names: Sequence[str], units: Sequence[str] | None) -> tuple[str, ...]:
    """Warnings about non-Euclidean outputs, with remedies; without units, an angle may be in rad or deg."""
    found = []
    for first in quaternions(positions):
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


def quaternions(positions: Sequence[Floats]) -> list[int]:
    """Indices of outputs that begin four columns of unit quaternions."""
    found, first = [], 0
    while first + 4 <= positions[0].shape[1]:
        four = np.concatenate([position[:, first : first + 4] for position in positions])
        four = four.clip(-_LARGEST_ANGLE, _LARGEST_ANGLE)
        off = np.abs(np.square(four).sum(axis=1) - 1.0)
        spread = np.ptp(four, axis=0).max()
        if spread > 0.0 and np.mean(off <= min(_OFF_SPHERE, _OFF_SPHERE_SHARE * spread)) >= _SAMPLES_ON_SPHERE:
            found.append(first)
        first += 4 if first in found else 1
    return found


def _wrapped(positions: Sequence[Floats], i: int, unit: str | None) -> str | None:
    """Unit in which an output jumps by a turn; None if it does not."""
    whole = max(float(y[:, i].max()) for y in positions) - min(float(y[:, i].min()) for y in positions)
    for angle in ANGLES if unit is None else {unit} & set(ANGLES):
        turn = 2.0 * math.pi / ANGLES[angle]
        # Most outputs cover less than a turn, and are not looked at step by step.
        if whole < (1.0 - _QUARTER) * turn or (unit is None and whole > 1.01 * turn):
            continue
        curves = [position[:, i].clip(-_LARGEST_ANGLE, _LARGEST_ANGLE) for position in positions]
        step = np.abs(np.concatenate(list(map(np.diff, curves))))
        jumps = np.abs(step - turn) <= _QUARTER * turn
        other = step[~jumps].max(initial=0.0)
        # An unwrapped signal continues after the jump as smoothly as elsewhere.
        smooth = np.abs(step[jumps] - turn) <= max(3.0 * other, 1e-3 * turn)
        if other < _QUARTER * turn and 0 < jumps.sum() <= _MOST_JUMPS * len(step) and smooth.all():
            return angle
    return None
