"""Outputs that turn: four columns of a quaternion as three in a chart around the mean rotation, and back; angles."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.data.alignment import interpolate, unit_phases
from torch_pbd.data.recordings import as_names, as_recordings, as_texts, as_units, frozen, preview
from torch_pbd.data.units import ANGLES, OFF_SPHERE
from torch_pbd.exceptions import InvalidParameterError
from torch_pbd.rotations import Chart, continuous, mean

ROTATION = ("rx", "ry", "rz")
QUATERNION = ("qw", "qx", "qy", "qz")

# Degrees from the reference. The chart ends at 180, where y and -y are one rotation; a normal distribution in it that
# is 15 degrees wide has two standard deviations left at 150.
_FAR, _FURTHEST = 120.0, 150.0
_N_PHASES = 201  # of each recording in the mean: it does not hang on how long or how densely each was sampled


class Outputs(NamedTuple):
    """Recordings and labels as `torch_pbd.data.Demonstrations` holds them."""

    times: tuple[Floats, ...]
    positions: tuple[Floats, ...]
    names: tuple[str, ...]
    units: tuple[str, ...] | None
    rotation_reference: Floats | None


def as_outputs(
    times: Any, positions: Any, names: Any, units: Any, rotation: Any, rotation_reference: Any, missing: Any
) -> Outputs:
    """Recordings with their labels; a rotation is three outputs in the last places."""
    times_, positions_ = as_recordings(times, positions, missing)
    names_ = as_names(names, positions_[0].shape[1])
    if rotation is None:
        outputs = Outputs(times_, positions_, names_, as_units(units, len(names_)), None)
        return outputs if rotation_reference is None else _in_chart(outputs, rotation_reference)
    if rotation_reference is not None:
        raise checks.refusal(rotation_reference, "rotation_reference", "None where rotation= names quaternions")
    chosen = as_texts(rotation, "rotation")
    if not len(chosen) == len(set(chosen)) == len(set(chosen) & set(names_)) == 4:
        must = f"four different ones of {preview(names_)}, in the order w x y z, wherever these stand"
        raise checks.refusal(rotation, "rotation", must)
    columns = [names_.index(name) for name in chosen]
    lost = [~position[:, columns].any(axis=1, keepdims=True) for position in positions_]
    if missing == "drop" and any(map(np.any, lost)):  # a tracker that saw nothing wrote zeros
        holes = [np.where(gone, np.nan, position) for gone, position in zip(lost, positions_, strict=True)]
        times_, positions_ = as_recordings(times_, holes, "drop")
    turns = [_unit(position[:, columns], k, chosen) for k, position in enumerate(positions_)]
    kept = [i for i in range(len(names_)) if i not in columns]
    if units is not None and not isinstance(units, str) and len(units) == len(names_):
        units = [units[i] for i in kept]
    own = () if units is not None and not kept else as_units(units, len(kept))
    labels = (*(names_[i] for i in kept), *ROTATION)
    reference = mean_rotation(times_, turns)
    return Outputs(
        *as_recordings(times_, charted(times_, [y[:, kept] for y in positions_], turns, reference), "raise"),
        as_names(labels, len(labels)),
        own if own is None else (*own, "rad", "rad", "rad"),
        frozen(reference),
    )


def mean_rotation(times: Sequence[Floats], quaternions: Sequence[Floats]) -> Floats:
    """Frechet mean (4,) of recorded rotations (T_k, 4), each at evenly spaced phases."""
    phases = np.linspace(0.0, 1.0, _N_PHASES)
    pairs = zip(unit_phases(times), quaternions, strict=True)
    together = np.concatenate([interpolate(own, continuous(turn), phases) for own, turn in pairs])
    return mean(together / np.linalg.norm(together, axis=1, keepdims=True))


def charted(
    times: Sequence[Floats], places: Sequence[Floats], quaternions: Sequence[Floats], reference: Floats
) -> list[Floats]:
    """Outputs (T_k, p + 3) of poses, the rotations in the chart around a reference; refuses those far from it."""
    turns = list(map(Chart(reference).log, quaternions))
    _check_reach(times, turns)
    return [np.column_stack([place, turn]) for place, turn in zip(places, turns, strict=True)]


def as_columns(demonstrations: Any) -> tuple[tuple[str, ...], Sequence[Floats]]:
    """Names and columns (T_k, ...) for tables: what other programs read, a rotation as its quaternion."""
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
    """Outputs (T_k, d) of which the named angles go on over a turn, along time, and from one recording to the next.

    Recordings are brought to the turn nearest to the direction that their means have in common. All of them are then
    turned back together by what the median recording was turned by: joints keep the turn that a robot knows.
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


def _in_chart(outputs: Outputs, rotation_reference: Any) -> Outputs:
    """Outputs whose last three were in the chart around a reference before, as in a file."""
    reference = checks.array(rotation_reference, "rotation_reference", (4,))
    if abs(float(reference @ reference) - 1.0) > checks.ROUNDING:
        raise checks.refusal(rotation_reference, "rotation_reference", "a unit quaternion w x y z")
    if len(outputs.names) < 3 or (outputs.units is not None and set(outputs.units[-3:]) != {"rad"}):
        must = f"given for outputs that end with three of a rotation in rad, not for {preview(outputs.names)}"
        raise checks.refusal(rotation_reference, "rotation_reference", must)
    _check_reach(outputs.times, [position[:, -3:] for position in outputs.positions])
    return outputs._replace(rotation_reference=frozen(reference))


def _unit(quaternion: Floats, k: int, names: Sequence[str]) -> Floats:
    """Quaternions (T, 4) of norm one of recorded ones, which are rounded."""
    square = np.square(quaternion).sum(axis=1)
    wrong = np.flatnonzero(np.abs(square - 1.0) > OFF_SPHERE)
    if len(wrong):
        i = int(wrong[0])
        what = f"the quaternion {', '.join(names)} has norm {math.sqrt(square[i]):.4g} at sample {i} of recording {k}"
        remedy = "missing='drop' leaves such samples out" if square[i] == 0.0 else "name the columns of a rotation"
        raise InvalidParameterError(f"{what}, must have 1: {remedy}.")
    return quaternion / np.sqrt(square)[:, np.newaxis]


def _check_reach(times: Sequence[Floats], turns: Sequence[Floats]) -> None:
    angles = [np.degrees(np.linalg.norm(turn, axis=1)) for turn in turns]
    k = int(np.argmax([angle.max() for angle in angles]))
    i = int(np.argmax(angles[k]))
    what = f"ecording {k} is {angles[k][i]:.1f} degrees from the mean rotation at {times[k][i]:.6g}"
    remedy = "leave a wrong sample out, or, as of screws, learn deviations from the mean rotation of each time"
    if angles[k][i] > _FURTHEST:
        raise InvalidParameterError(f"r{what}, must be at most {_FURTHEST:.0f}: {remedy}.")
    if angles[k][i] > _FAR:
        checks.warn(f"R{what}, and {_FURTHEST:.0f} are refused: {remedy}.")
