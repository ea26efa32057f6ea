"""Demonstrations as CSV text: one line a sample."""

import csv
import io
import re
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isnan, nan
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data.demonstrations import Demonstrations, Missing
from torch_pbd.data.recordings import as_texts, preview
from torch_pbd.data.units import nanoseconds_hint
from torch_pbd.files.atomic import LOADERS

DELIMITERS = (",", ";", "\t")
_LONGEST_HEADER = 2**17  # characters, of thousands of columns; a file without line ends would be one header
_FEWEST_COUNTED = 5  # rows; fewer rise by one by chance


def read(
    path: Path,
    max_bytes: int,
    missing: Missing,
    demo: str | None = "demo",
    time: str = "time",
    outputs: Sequence[str] | None = None,
    delimiter: str | None = None,
    decimal: str = ".",
    units: str | Sequence[str] | None = None,
    frame: str | None = None,
    time_unit: str = "s",
) -> Demonstrations:
    """Read the format of `torch_pbd.data.load_demonstrations`, which describes the options."""
    checks.choice(decimal, "decimal", (".", ","))
    checks.text(demo, "demo", optional=True)
    checks.text(time, "time")
    named = None if outputs is None else as_texts(outputs, "outputs")
    if delimiter is not None and (not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter == decimal):
        raise checks.refusal(delimiter, "delimiter", f"one character, and not the decimal mark {decimal!r}")
    wanted = [time] if demo is None else [demo, time]
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            table = _open_table(file, delimiter, decimal, missing, wanted)
            names = table.output_names(named, wanted)
            times, positions = table.recordings(demo, [time, *names])
        except UnicodeDecodeError as error:
            raise ValueError(f"it is not text in UTF-8: {error}.") from error
    if outputs is None and positions:
        _check_movements(names, positions)
    return Demonstrations(times, positions, names=names, units=units, frame=frame, time_unit=time_unit, missing=missing)


def write(demonstrations: Demonstrations, handle: BinaryIO) -> None:
    """Write columns ``demo,time,<names>``; the shortest decimals that come back to the last bit."""
    unusable = [name for name in demonstrations.names if name in ("demo", "time") or name != name.strip()]
    if unusable:
        raise ValueError(f"an output named {unusable[0]!r} cannot be told from the other columns: rename it.")
    text = io.TextIOWrapper(handle, encoding="utf-8", newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["demo", "time", *demonstrations.names])
    for k, (time, position) in enumerate(demonstrations):
        rows = zip(time.tolist(), position.tolist(), strict=True)
        writer.writerows([k, t, *values] for t, values in rows)
    text.detach()


@dataclass(frozen=True)
class _Table:
    """A CSV file whose header has been read: its numbers, with the lines they stand in."""

    file: TextIO
    header: list[str]
    delimiter: str
    decimal: str
    missing: Missing

    def output_names(self, outputs: Sequence[str] | None, taken: Sequence[str]) -> list[str]:
        """Columns of the outputs, in their order."""
        names = [name for name in self.header if name not in taken] if outputs is None else list(outputs)
        if outputs is None and "" in names:
            raise ValueError(
                f"line 1: column {self.header.index('') + 1} has no name, as the index of a table that was written "
                f"without index=False. Leave it out, or say outputs={[*filter(None, names)]}."
            )
        known = set(self.header)
        absent = [name for name in names if name not in known]
        if absent or not names:
            what = f"no column {absent[0]!r}" if absent else "no column of outputs"
            raise ValueError(f"line 1: {what} among {preview(self.header)}.")
        return names

    def recordings(self, demo: str | None, columns: Sequence[str]) -> tuple[list[NDArray[Any]], list[NDArray[Any]]]:
        """Times, as integers where all are, and the other columns of each demonstration, as they first appear."""
        places = {name: place for place, name in enumerate(self.header)}
        indices = [places[name] for name in columns]
        recorded: dict[str, array[float]] = {}
        stamps: dict[str, array[int]] = {}
        last: dict[str, float] = {}
        for line, cells in self._rows():
            label = "" if demo is None else cells[places[demo]].strip()
            if demo is not None and not label:
                raise ValueError(f"line {line}, column {demo!r}: the cell is blank.")
            row = [self._number(cells[i], line, self.header[i]) for i in indices]
            now, before = _exact_time(cells[indices[0]], row[0]), last.get(label, -inf)
            if now <= before:
                raise ValueError(
                    f"line {line}, column {columns[0]!r}: {now!r} comes after {before!r} in demonstration {label!r}: "
                    "times must increase strictly. Sort the lines by time and drop repeated ones."
                    f"{nanoseconds_hint(now)}"
                )
            # Arrays of numbers take 8 bytes for each, where lists take 32.
            recorded.setdefault(label, array("d")).extend(row)
            whole = stamps.setdefault(label, array("q"))
            if isinstance(now, int):
                whole.append(now)
            last[label] = before if isnan(now) else now
        rows = {label: np.array(values).reshape(-1, len(columns)) for label, values in recorded.items()}
        times = [np.array(stamps[k]) if len(stamps[k]) == len(values) else values[:, 0] for k, values in rows.items()]
        return times, [values[:, 1:] for values in rows.values()]

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        reader = csv.reader(self.file, delimiter=self.delimiter)
        while True:
            line = reader.line_num + 2  # of its beginning: a quoted cell may go on for several
            try:
                cells = next(reader, None)
            except csv.Error as error:
                raise ValueError(f"line {line}: {error}.") from error
            if cells is None:
                return
            if cells and len(cells) != len(self.header):
                raise ValueError(
                    f"line {line}: {len(cells)} cells under {len(self.header)} column names (delimiter "
                    f"{self.delimiter!r}, decimal mark {self.decimal!r})."
                )
            if cells:
                yield line, cells

    def _number(self, cell: str, line: int, column: str) -> float:
        text, foreign = cell.strip(), "_" if self.decimal == "." else "_."
        if self.missing == "drop" and text.lower() in ("", "nan", "+nan", "-nan"):
            return nan
        try:
            # Python reads 1_0 as ten.
            value = nan if any(mark in text for mark in foreign) else float(text.replace(self.decimal, "."))
        except ValueError:
            value = nan
        if not isfinite(value):
            what = f"{text!r} is not a finite number" if text else "the cell is blank"
            raise ValueError(
                f"line {line}, column {column!r}: {what} (decimal mark {self.decimal!r}). Drop the line "
                "(missing='drop' does, where the cell is blank or nan), or fill the value in."
            )
        return value


def _open_table(file: TextIO, delimiter: str | None, decimal: str, missing: Missing, wanted: list[str]) -> _Table:
    """Read the header; the delimiter is the one that finds the columns wanted, and most columns."""
    first = file.readline(_LONGEST_HEADER)
    if len(first) == _LONGEST_HEADER:
        raise ValueError(f"line 1: it is longer than {_LONGEST_HEADER} characters; it must name the columns.")
    candidates = [delimiter] if delimiter else [mark for mark in DELIMITERS if mark != decimal]
    try:
        headers = [[name.strip() for name in next(csv.reader([first], delimiter=c), [])] for c in candidates]
    except csv.Error as error:
        raise ValueError(f"line 1: {error}.") from error
    # A mark that is not the delimiter finds one column, or cuts names that hold it.
    header = max(headers, key=lambda names: (set(wanted) <= set(names), len(names)))
    absent = [name for name in wanted if name not in header]
    if absent:
        raise ValueError(
            f"line 1: no column {absent[0]!r} among {preview(header)}. Name the columns by the options demo=, time= "
            "and outputs= (demo=None: one demonstration), or give the delimiter."
            f"{' ' + LOADERS if first.startswith('# format:') else ''}"
        )
    twice = [name for name, count in Counter(header).items() if name and count > 1]
    if twice:
        raise ValueError(f"line 1: there are two columns {twice[0]!r}.")
    return _Table(file, header, candidates[headers.index(header)], decimal, missing)


def _exact_time(cell: str, time: float) -> float | int:
    """Time of a cell, an integer where float64 does not hold it, as of stamps in ns."""
    stamp = int(cell) if abs(time) >= 2**53 and re.fullmatch(r"\s*[+-]?\d{16,19}\s*", cell) else 0
    return stamp if 2**53 <= abs(stamp) < 2**63 else time


def _check_movements(names: Sequence[str], positions: Sequence[NDArray[np.float64]]) -> None:
    """Refuse columns that count rows or number tasks, which nobody named as outputs."""
    steps, rows = np.vstack([np.diff(position, axis=0) for position in positions]), np.vstack(positions)
    for name, step, values in zip(names, steps.T, np.sort(rows, axis=0).T, strict=True):
        # A count of all rows is so too where rows of several demonstrations are mixed.
        counts = (step == 1.0).all() or ((step > 0.0).all() and (np.diff(values) == 1.0).all())
        numbers = name.endswith(("_index", "_id")) and not step.any()
        if len(values) >= _FEWEST_COUNTED and (values == np.round(values)).all() and (counts or numbers):
            raise ValueError(
                f"column {name!r}: it {'counts rows' if counts else 'numbers demonstrations'}, and is no movement. "
                f"Leave it out, or say which columns are: outputs={[n for n in names if n != name]}."
            )
