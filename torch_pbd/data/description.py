"""Description of recordings, likely mistakes in them with remedies, and a check for several modes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from torch_pbd import checks
from torch_pbd.checks import Floats
from torch_pbd.console import format_table
from torch_pbd.data.alignment import check_overlap
from torch_pbd.data.editing import Editing
from torch_pbd.data.poses import quaternions
from torch_pbd.data.recordings import preview
from torch_pbd.data.sampling import extents, still
from torch_pbd.data.units import ANGLES, LENGTHS, TIMES
from torch_pbd.exceptions import InvalidParameterError, UnimodalityWarning

_MOST_ROWS = 20
_GAP = 5.0  # median steps: two lost samples are no gap, a second of a sensor's silence is
_ENDS = 0.2  # share of the largest speed above which a recording counts as cut while moving
_UNIX = 1e8  # s: no recording is three years long
_RATES = 4.0, 5000.0  # plausible sampling rates of hands and robots in Hz
_LONGEST, _FURTHEST, _MOST_TURNED = 600.0, 10.0, 100.0  # largest plausible movement in s, m and rad

_N_STEPS, _LEAST_DEMOS = 20, 6  # steps at which modes are looked for, and fewest demonstrations that can show them
# Gain of the criterion in nats, and distance of the two means in standard deviations within the groups. The best of all
# splits of a sample from one normal distribution gains something too, and two halves of a uniform one lie 3.5 apart:
# both bounds are above that, the second more so for whole demonstrations, in which there are more directions to choose.
_WHOLE, _STEP = (8.0, 6.0), (10.0, 4.5)
# Two ways around an obstacle part for a while, and each is taken by some.
_SHARE_OF_STEPS, _SHARE_OF_DEMOS = 0.25, 0.2


@dataclass(frozen=True, repr=False)
class Description:
    """Tables of recordings and outputs, and likely mistakes in them, to be printed."""

    recordings: list[dict[str, Any]]
    """Index, samples, start, duration, rate, largest gap, and stillness at both ends of each recording."""
    outputs: list[dict[str, Any]]
    """Name, unit, minimum, maximum and extent of each output."""
    mistakes: tuple[str, ...]
    """Likely mistakes, each with its remedy; empty where nothing looks wrong."""
    rotation: str
    """Sentence about the chart of the rotations; empty if there are none."""

    def __str__(self) -> str:
        n, rows = len(self.recordings), format_table(self.recordings[:_MOST_ROWS])
        rows += f"\n... {n} recordings in all" if n > _MOST_ROWS else ""
        findings = [f"{i}. {sentence}" for i, sentence in enumerate(self.mistakes, 1)] or ["Nothing looks wrong."]
        return "\n\n".join(filter(None, [rows, format_table(self.outputs), self.rotation, "\n".join(findings)]))

    __repr__ = __str__


def describe(demonstrations: Any, notes: Mapping[str, str]) -> Description:
    """Description of `Demonstrations`; ``notes`` are mistakes on the way to them, and the options that mend these."""
    unit, names, reference = demonstrations.time_unit, demonstrations.names, demonstrations.rotation_reference
    second = 1.0 / TIMES.get(unit, 1.0)
    recordings = []
    for k, (time, position) in enumerate(demonstrations):
        steps, moves = np.diff(time), ~still(time, position, demonstrations)
        moving = time[moves] if moves.any() else time[-1:]
        row = {"#": k, "samples": len(time), f"start [{unit}]": time[0], f"lasts [{unit}]": time[-1] - time[0]}
        row |= {"rate [Hz]": second / np.median(steps), f"gap [{unit}]": steps.max()}
        recordings.append(row | {"rest before": moving[0] - time[0], "rest after": time[-1] - moving[-1]})
    together, units = np.concatenate(demonstrations.positions), demonstrations.units or ["none"] * len(names)
    outputs = [
        {"output": name, "unit": own, "least": y.min(), "largest": y.max(), "extent": np.ptp(y)}
        for name, own, y in zip(names, units, together.T, strict=True)
    ]
    rotation = ""
    if reference is not None:
        shown, furthest = ", ".join(f"{q:.4f}" for q in reference), np.linalg.norm(together[:, -3:], axis=1).max()
        rotation = f"Rotations are {', '.join(names[-3:])} around the quaternion w x y z of {shown}; the furthest is "
        rotation += f"{np.degrees(furthest):.0f} degrees from it."
    mistakes = [*notes, *_of_times(demonstrations, second), *_of_ends(demonstrations, recordings)]
    mistakes += [*demonstrations.suspects, *_of_outputs(demonstrations, outputs, notes)]
    return Description(recordings, outputs, tuple(mistakes), rotation)


def _of_times(demonstrations: Any, second: float) -> Iterator[str]:
    times, unit = demonstrations.times, demonstrations.time_unit
    step = float(np.median(np.concatenate(list(map(np.diff, times)))))
    if unit in TIMES and not _RATES[0] <= second / step <= _RATES[1]:
        meant = [other for other, size in TIMES.items() if _RATES[0] <= 1.0 / (step * size) <= _RATES[1]]
        if meant and meant[-1] != unit:
            rate = f"A sample every {step:.4g} {unit} is {second / step:.3g} Hz"
            yield f"{rate}: the times look like {meant[-1]}. Say time_unit={meant[-1]!r}."
    elif unit in TIMES and max(time[-1] - time[0] for time in times) / second > _LONGEST:
        yield "A recording is longer than ten minutes. Cut it into demonstrations: cut='pauses' or [[start, end]]."
    latest = max((time[0] / second for time in times), key=abs)
    if abs(latest) > _UNIX:
        yield f"Times start at {latest:.0f} s, as stamps since 1970 do. Count from the start: from_start=True."
    try:
        check_overlap(times, unit)
    except InvalidParameterError:
        yield "The recordings do not overlap in time. Count each from its start, from_start=True, or take a phase."
    for k, time in enumerate(times):
        own = np.diff(time) / np.median(np.diff(time))
        i = int(own.argmax())
        if own[i] > _GAP:
            gap = f"Recording {k} has a gap of {time[i + 1] - time[i]:.3g} {unit} at {time[i]:.6g}"
            yield f"{gap}, {own[i]:.0f} times the usual step. Where no other has samples, leave it out, or cut= there."


def _of_ends(demonstrations: Any, recordings: list[dict[str, Any]]) -> Iterator[str]:
    cut: dict[str, list[int]] = {"start": [], "end": []}
    for k, (time, position) in enumerate(demonstrations):
        extent = extents(position, demonstrations)
        scale = np.where(extent > 0, extent, np.inf)
        speed = np.linalg.norm(np.diff(position / scale, axis=0), axis=1) / np.diff(time)
        few = max(1, len(speed) // 50)  # one step alone is mostly noise
        for end, own in (("start", speed[:few]), ("end", speed[-few:])):
            if len(speed) >= 10 and np.median(own) > _ENDS * np.quantile(speed, 0.95):
                cut[end].append(k)
    for end, rest in (("start", "rest before"), ("end", "rest after")):
        held, longest = [row["#"] for row in recordings if row[rest] > 0.0], max(row[rest] for row in recordings)
        if held:
            lasting = f"{longest:.3g} {demonstrations.time_unit}"
            yield f"Nothing moves at the {end} of recordings {preview(held)}, for up to {lasting}: say trim='still'."
        if cut[end]:
            moving = f"At the {end}, recordings {preview(cut[end])} are moving"
            yield f"{moving}: record from rest to rest, or give settle= to schedule()."


def _of_outputs(demonstrations: Any, outputs: list[dict[str, Any]], notes: Mapping[str, str]) -> Iterator[str]:
    for place in quaternions(demonstrations.positions):
        name = f"Quaternion {', '.join(demonstrations.names[place : place + 4])}"
        each = [position[:, place : place + 4] for position in demonstrations.positions]
        flips = [k for k, q in enumerate(each) if ((q[1:] * q[:-1]).sum(axis=1) < 0.0).any() or q[0] @ each[0][0] < 0.0]
        if flips:
            yield f"{name} is -q where it was q, in recordings {preview(flips)}: rotation= takes either sign."
    covers = {row["output"]: row["extent"] for row in outputs}
    if demonstrations.units is None and "units" not in notes.values():
        largest, name = max((extent, name) for name, extent in covers.items())
        far = f" Output {name} covers {largest:.4g}: as metres that is far." if largest > _FURTHEST else ""
        yield f"The outputs have no units: give units=, as 'm', 'mm', 'rad', or one for each.{far}"
    for row in outputs:
        unit, extent = row["unit"], row["extent"]
        if LENGTHS.get(unit, 0.0) * extent > _FURTHEST or ANGLES.get(unit, 0.0) * extent > _MOST_TURNED:
            yield f"Output {row['output']} covers {extent:.4g} {unit}: another unit? Give units=."
    constant = [name for name, extent in covers.items() if extent == 0.0]
    if constant:
        yield f"{', '.join(constant)} never changes: leave it out, outputs={[n for n in covers if n not in constant]}."


def check_unimodal(demonstrations: Any) -> bool:
    """Whether ``Demonstrations``, aligned by phase if necessary, have a single mode.

    The paper assumes one mode (Section II): between two ways around an obstacle, a mean goes through it. The
    demonstrations are projected on the direction in which they differ most, as a whole and at each of 20 steps, and
    split into two groups of common variance. The split must pay by the Bayesian information criterion, with groups
    far apart. Subtle cases are missed, and fewer than six demonstrations always pass.

    Warns
    -----
    UnimodalityWarning
        If there are two groups, or one demonstration is far from all others; the result is then False.
    """
    is_recorded = isinstance(demonstrations, Editing)  # base of Demonstrations, whose import would be circular
    if not is_recorded:
        raise checks.refusal(demonstrations, "demonstrations", "a Demonstrations")
    return follow_one_way((demonstrations if demonstrations.is_aligned else demonstrations.align()).to_array())


def follow_one_way(curves: Floats) -> bool:
    """Whether aligned demonstrations (K, T, d) have a single mode, with a warning if they do not."""
    n_demos = len(curves)
    if n_demos < _LEAST_DEMOS:
        return True
    residual = curves - curves.mean(axis=0)
    deviation = residual.std(axis=(0, 1))
    residual = residual / np.where(deviation > 0, deviation, 1.0)
    gain, separation, few = _best_split(residual.reshape(n_demos, -1))
    if gain <= _WHOLE[0] or separation <= _WHOLE[1]:
        steps = np.linspace(0, residual.shape[1] - 1, _N_STEPS).astype(int)
        splits = [split for split in (_best_split(residual[:, t]) for t in steps) if split[0] > _STEP[0]]
        clear = [split for split in splits if split[1] > _STEP[1] and len(split[2]) >= _SHARE_OF_DEMOS * n_demos]
        if len(clear) < _SHARE_OF_STEPS * _N_STEPS:
            return True
        few = max(clear)[2]
    message = f"Demonstration {few[0]} is far from the other {n_demos - 1}: look at it, and leave it out if it failed."
    if len(few) > 1:
        others = f"{', '.join(map(str, sorted(few)))} differ from the others, and a mean would lie between them"
        message = f"The demonstrations seem to follow two ways: {others}. Learn each way by itself."
    checks.warn(message, UnimodalityWarning)
    return False


def _best_split(residual: Floats) -> tuple[float, float, list[int]]:
    """Best split of the rows in two along the direction in which they differ most.

    Returns the gain of the criterion, the distance of the means in standard deviations, and the smaller group's rows.
    """
    left, singular, _ = np.linalg.svd(residual, full_matrices=False)
    place = left[:, 0] * singular[0]
    order = np.argsort(place, kind="stable")
    x, n = place[order], len(place)
    total = np.square(x - x.mean()).sum()
    if total <= 1e-18 * n:
        return 0.0, 0.0, []
    # For each number of rows in the lower group: squares within both groups, of which a common variance is estimated.
    count = np.arange(1, n)
    before, squares = np.cumsum(x)[:-1], np.cumsum(x * x)[:-1]
    within = squares - before**2 / count + (x @ x - squares) - (x.sum() - before) ** 2 / (n - count)
    within = np.maximum(within, 1e-9 * total)
    # Twice the log-likelihood of two groups above that of one, less log n for each of two further parameters.
    share = count / n
    entropy = share * np.log(share) + (1 - share) * np.log(1 - share)
    gain = -n * np.log(within / total) + 2 * n * entropy - 2 * np.log(n)
    best = int(gain.argmax())
    apart = (x[best + 1 :].mean() - x[: best + 1].mean()) / np.sqrt(within[best] / n)
    few = min(order[: best + 1], order[best + 1 :], key=len)
    return float(gain[best]), float(apart), few.tolist()
