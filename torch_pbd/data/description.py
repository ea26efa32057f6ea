"""Contents of recordings, and likely mistakes in them, each with its remedy."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torch_pbd.data.alignment import check_overlap
from torch_pbd.data.sampling import extents, still
from torch_pbd.data.units import ANGLES, LENGTHS, TIMES, quaternions
from torch_pbd.exceptions import InvalidParameterError

_MOST_ROWS = 20
_PAUSE = 0.5  # s; shorter stillness is part of a movement
_GAP = 5.0  # median steps: two lost samples are no gap, a second of a sensor's silence is
_ENDS = 0.2  # of the largest speed: a recording that is cut while moving
_UNIX = 1e8  # s: no recording is three years long
_RATES = 4.0, 5000.0  # Hz, in which hands and robots are recorded
_LONGEST, _FURTHEST = 600.0, 10.0  # s and m of one movement


@dataclass(frozen=True, repr=False)
class Description:
    """Tables of recordings and outputs, and sentences on likely mistakes.

    Attributes
    ----------
    recordings : list of dict
        Number, samples, start, duration, rate, largest gap, and stillness at both ends, of each recording.
    outputs : list of dict
        Name, unit, least, largest and extent of each output.
    mistakes : tuple of str
        Each with its remedy; empty where nothing looks wrong.
    rotation : str
        Sentence on the chart of the rotations; empty where there are none.
    """

    recordings: list[dict[str, Any]] = field(default_factory=list)
    outputs: list[dict[str, Any]] = field(default_factory=list)
    mistakes: tuple[str, ...] = ()
    rotation: str = ""

    def __str__(self) -> str:
        rows = _table(self.recordings[:_MOST_ROWS])
        if len(self.recordings) > _MOST_ROWS:
            rows += f"\n... {len(self.recordings)} recordings in all"
        findings = [f"{i + 1}. {sentence}" for i, sentence in enumerate(self.mistakes)] or ["Nothing looks wrong."]
        return "\n\n".join(
            [rows, _table(self.outputs), *([self.rotation] if self.rotation else []), "\n".join(findings)]
        )

    __repr__ = __str__


def describe(demonstrations: Any, notes: Sequence[str] = ()) -> Description:
    """Description of `torch_pbd.data.Demonstrations`; ``notes`` are mistakes that were found on the way to them."""
    unit = demonstrations.time_unit
    second = 1.0 / TIMES.get(unit, 1.0)
    recordings = []
    for k, (time, position) in enumerate(demonstrations):
        steps = np.diff(time)
        moves = ~still(time, position, extents(position, demonstrations), _PAUSE * second)
        moving = time[moves] if moves.any() else time[-1:]
        row = {"#": k, "samples": len(time), f"start [{unit}]": time[0], f"lasts [{unit}]": time[-1] - time[0]}
        row |= {"rate [Hz]": second / np.median(steps), f"gap [{unit}]": steps.max()}
        recordings.append(row | {"rest before": moving[0] - time[0], "rest after": time[-1] - moving[-1]})
    units = demonstrations.units or ["none"] * demonstrations.n_outputs
    outputs = [
        {"output": name, "unit": own, "least": y.min(), "largest": y.max(), "extent": np.ptp(y)}
        for name, own, y in zip(demonstrations.names, units, np.concatenate(demonstrations.positions).T, strict=True)
    ]
    mistakes = [*notes, *_of_times(demonstrations, second), *_of_ends(demonstrations, recordings, unit)]
    mistakes += [*demonstrations.suspects, *_flips(demonstrations), *_of_outputs(demonstrations.units, outputs, notes)]
    return Description(recordings, outputs, tuple(mistakes), _rotation(demonstrations))


def _rotation(demonstrations: Any) -> str:
    if demonstrations.rotation_reference is None:
        return ""
    furthest = max(np.linalg.norm(position[:, -3:], axis=1).max() for position in demonstrations.positions)
    reference = ", ".join(f"{number:.4f}" for number in demonstrations.rotation_reference)
    return (
        f"Rotations are {', '.join(demonstrations.names[-3:])} around the quaternion w x y z of {reference}; the "
        f"furthest is {np.degrees(furthest):.0f} degrees from it."
    )


def _of_times(demonstrations: Any, second: float) -> Iterator[str]:
    times, unit = demonstrations.times, demonstrations.time_unit
    starts = np.array([time[0] for time in times]) / second
    steps = np.concatenate([np.diff(time) for time in times])
    rate = 1.0 / np.median(steps)
    apart = False
    try:
        check_overlap(times, unit)
    except InvalidParameterError:
        apart = True
    if unit in TIMES and not _RATES[0] <= rate * second <= _RATES[1]:
        meant = [other for other, size in TIMES.items() if _RATES[0] <= rate / size <= _RATES[1]]
        if meant and meant[-1] != unit:
            yield (
                f"A sample every {1 / rate:.4g} {unit} is {rate * second:.3g} Hz: the times look like {meant[-1]}. Say "
                f"time_unit={meant[-1]!r}."
            )
    elif unit in TIMES and max(time[-1] - time[0] for time in times) / second > _LONGEST:
        yield "A recording is longer than ten minutes. Cut it into demonstrations: cut='pauses' or [[start, end]]."
    latest = starts[np.abs(starts).argmax()]
    if np.abs(latest) > _UNIX:
        yield f"Times start at {latest:.0f} s, as stamps since 1970 do. Count from the start: from_start=True."
    if apart and len(times) > 1:
        yield "The recordings do not overlap in time. Count each from its start, from_start=True, or take a phase."
    for k, time in enumerate(times):
        step = np.diff(time)
        i = int(step.argmax())
        if step[i] > _GAP * np.median(step):
            yield (
                f"Recording {k} has a gap of {step[i]:.3g} {unit} at {time[i]:.6g}, {step[i] / np.median(step):.0f} "
                "times the usual step. Where others have samples they are used; else leave it out, or cut= there."
            )


def _of_ends(demonstrations: Any, recordings: list[dict[str, Any]], unit: str) -> Iterator[str]:
    for end, rest in (("start", "rest before"), ("end", "rest after")):
        held = [row["#"] for row in recordings if row[rest] > 0.0]
        if held:
            longest = max(row[rest] for row in recordings)
            yield f"Nothing moves at the {end} of {_numbers(held)}, for up to {longest:.3g} {unit}: say trim='still'."
    cut: dict[str, list[int]] = {"start": [], "end": []}
    for k, (time, position) in enumerate(demonstrations):
        extent = extents(position, demonstrations)
        scale = np.where(extent > 0, extent, np.inf)
        speed = np.linalg.norm(np.diff(position / scale, axis=0), axis=1) / np.diff(time)
        few = max(1, len(speed) // 50)  # one step alone is mostly noise
        for end, own in (("start", speed[:few]), ("end", speed[-few:])):
            if len(speed) >= 10 and np.median(own) > _ENDS * np.quantile(speed, 0.95):
                cut[end].append(k)
    for end, numbers in cut.items():
        if numbers:
            yield (
                f"At the {end}, {_numbers(numbers)} {'is' if len(numbers) == 1 else 'are'} moving: it was cut there. "
                "Record from rest to rest, or give settle= to schedule()."
            )


def _of_outputs(units: Any, outputs: list[dict[str, Any]], notes: Sequence[str]) -> Iterator[str]:
    extents = {row["output"]: row["extent"] for row in outputs}
    if units is None and not any("units=" in note for note in notes):
        name, largest = max(extents.items(), key=lambda entry: entry[1])
        far = f" Output {name} covers {largest:.4g}: as metres that is far, 'mm'?" if largest > _FURTHEST else ""
        yield f"The outputs have no units: give units=, as 'm', 'mm', 'rad', or one for each.{far}"
    for row in outputs:
        metres = LENGTHS.get(row["unit"], 0.0) * row["extent"]
        if metres > _FURTHEST or ANGLES.get(row["unit"], 0.0) * row["extent"] > 100.0:
            yield f"Output {row['output']} covers {row['extent']:.4g} {row['unit']}: another unit? Give units=."
    constant = [name for name, extent in extents.items() if extent == 0.0]
    if constant:
        yield f"{', '.join(constant)} never changes: leave it out, outputs={[n for n in extents if n not in constant]}."


def _flips(demonstrations: Any) -> Iterator[str]:
    """Unit quaternions, of which nobody named the order, or of which some are -q where others are q."""
    for place in quaternions(demonstrations.positions, demonstrations.n_outputs):
        columns = demonstrations.names[place : place + 4]
        name = f"Quaternion {', '.join(columns)}"
        if {column[-1] for column in columns} != set("wxyz"):
            yield f"{name} has an order that nobody named: w may be first or last. Say it by rotation=, w x y z."
        each = [position[:, place : place + 4] for position in demonstrations.positions]
        flips = [k for k, q in enumerate(each) if ((q[1:] * q[:-1]).sum(axis=1) < 0.0).any() or q[0] @ each[0][0] < 0.0]
        if flips:
            yield f"{name} is -q where it was q, in {_numbers(flips)}: rotation= takes either sign."


def _numbers(numbers: list[int]) -> str:
    shown = ", ".join(map(str, numbers[:6])) + (f", ... ({len(numbers)} in all)" if len(numbers) > 6 else "")
    return f"recording{'' if len(numbers) == 1 else 's'} {shown}"


def _table(rows: list[dict[str, Any]]) -> str:
    """Text of rows with the same keys, at most 80 letters wide."""
    cells = [[*rows[0]], *([f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    widths[0] = min(widths[0], max(80 - sum(widths[1:]) - 2 * (len(widths) - 1), 8))
    lines = ([row[0][: widths[0]].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])] for row in cells)
    return "\n".join("  ".join(line).rstrip() for line in lines)
