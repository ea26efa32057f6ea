"""Demonstrations as CSV text: one line a sample."""

import csv
import io
import re
from array import array
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from math import inf, isfinite, isnan, nan
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.data.poses import as_columns
from torch_pbd.data.recordings import preview
from torch_pbd.data.units import nanoseconds_hint
from torch_pbd.data.wanted import Arguments, Chosen, Wanted, heads_of, rows_of
from torch_pbd.files import LOADERS

DELIMITERS = (",", ";", "\t")
_LONGEST_HEADER = 2**17  # characters, of thousands of columns; a file without line ends would be one header
_MOST_COMMENTS = 1000  # lines before the header
_MISSING = ("", "nan", "+nan", "-nan", "na", "null", "none")
_CLOCK = re.compile(r"(?:(\d{4}-\d\d-\d\d)[T ])?(\d{1,2}):(\d\d)(?::(\d\d)(?:[.,](\d{1,9}))?)?(?:Z|\+00:?00)?")


def read(path: Path, wanted: Wanted, delimiter: str | None = None, decimal: str = ".") -> Arguments:
    """Read the format of `torch_pbd.data.load_demonstrations`, which describes the options."""
    checks.choice(decimal, "decimal", (".", ","))
    if delimiter is not None and (not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter == decimal):
        raise checks.refusal(delimiter, "delimiter", f"one character, and not the decimal mark {decimal!r}")
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            table = _open_table(file, delimiter, decimal, wanted)
            signals = table.read_at_once() or table.read_lines()
        except UnicodeDecodeError as error:
            raise ValueError(f"it is not text in UTF-8: {error}.") from error
    return wanted.read_rows(table.chosen, signals)


def write(demonstrations: Demonstrations, handle: BinaryIO) -> None:
    """Write columns ``demo,time,<names>``; the shortest decimals that come back to the last bit."""
    names, columns = as_columns(demonstrations)
    unusable = [name for name in names if name in ("demo", "time") or name != name.strip()]
    if unusable:
        raise ValueError(f"an output named {unusable[0]!r} cannot be told from the other columns: rename it.")
    text = io.TextIOWrapper(handle, encoding="utf-8", newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["demo", "time", *names])
    for k, (time, values) in enumerate(zip(demonstrations.times, columns, strict=True)):
        rows = zip(time.tolist(), values.tolist(), strict=True)
        writer.writerows([k, t, *row] for t, row in rows)
    text.detach()


@dataclass(frozen=True)
class _Table:
    """A CSV file whose header has been read: its numbers, with the lines they stand in."""

    file: TextIO
    header: list[str]
    n_before: int  # lines up to the header
    delimiter: str
    decimal: str
    chosen: Chosen
    wanted: Wanted

    def read_at_once(self) -> dict[str, NDArray[Any]] | None:
        """Result of :meth:`read_lines`, in a sixth of the time; None where a line needs to be looked at."""
        start = self.file.tell()
        first = next(csv.reader([self.file.readline(_LONGEST_HEADER)], delimiter=self.delimiter), [])
        self.file.seek(start)
        demo, time, outputs = self._columns()
        kinds = dict.fromkeys(range(len(self.header)), "S1") | dict.fromkeys(outputs, "f8")
        if len(first) != len(self.header) or (time is not None and _is_clock(first[time])):
            return None
        if time is not None:
            kinds[time] = "i8" if re.fullmatch(r"[+-]?\d{16,19}", first[time].strip()) else "f8"
        if demo is not None:
            kinds[demo] = "S8" if len(first[demo]) < 5 else "S16"  # with what is longer further down cut short
        lines = self.file if self.decimal == "." else (line.translate({44: ".", 46: "!"}) for line in self.file)
        try:
            rows = np.loadtxt(
                lines,
                dtype=[(str(i), kinds[i]) for i in range(len(self.header))],
                delimiter=self.delimiter,
                quotechar='"',
                comments=None,
                ndmin=1,
            )
        except ValueError:
            rows = np.empty(0)
        self.file.seek(start)
        if not len(rows):
            return None
        signals: dict[str, NDArray[Any]] = {self.header[i]: rows[str(i)] for i in outputs}
        if time is not None:  # a copy, not a view of all columns, which recordings would keep
            signals[self.header[time]] = rows[str(time)].copy()
        sound = all(np.isfinite(values).all() for values in signals.values())
        own = np.zeros(len(rows), np.int32) if demo is None else _numbered(rows[str(demo)])
        if own is None or not sound:
            return None
        if demo is not None:
            signals[self.header[demo]] = own
        moments = signals[self.header[time]] if time is not None else np.arange(len(rows))
        return signals if all((np.diff(moments[each]) > 0).all() for each in rows_of(own)) else None

    def read_lines(self) -> dict[str, NDArray[Any]]:
        """Columns by name; times as integers, where all are."""
        demo, time, outputs = self._columns()
        numbers: dict[str, int] = {}
        last: dict[str, float] = {}
        # Arrays of numbers take 8 bytes for each, where lists take 32.
        own, stamps, times, values = array("q"), array("q"), array("d"), array("d")
        clocks = 0
        for line, cells in self._rows():
            place = demo or 0
            try:
                label = "" if demo is None else _filled(cells[demo].strip())
                own.append(numbers.setdefault(label, len(numbers)))
                for place in outputs:
                    values.append(self._number(cells[place]))
                if time is None:
                    continue
                place, before = time, last.get(label, -inf)
                now = self._time(cells[time], before, label)
            except ValueError as error:
                raise ValueError(f"line {line}, column {self.header[place]!r}: {error}") from error
            clocks += _is_clock(cells[time])
            last[label] = before if isnan(now) else now
            times.append(float(now))
            stamps.extend([now] if isinstance(now, int) else ())
        rows = np.array(values).reshape(len(own), len(outputs))
        signals = {} if demo is None else {self.header[demo]: np.array(own)}
        signals |= {self.header[i]: column for i, column in zip(outputs, rows.T, strict=True)}
        if time is not None:
            if 0 < clocks < len(own):
                raise ValueError(f"column {self.header[time]!r}: {clocks} of {len(own)} times are dates or clocks.")
            found = np.array(stamps) if len(stamps) == len(own) else np.array(times)
            signals[self.header[time]] = found.astype("M8[ns]") if clocks else found
        return signals

    def _columns(self) -> tuple[int | None, int | None, list[int]]:
        """Numbers of the columns of demonstration, time and outputs."""
        place, chosen = self.header.index, self.chosen
        time = None if chosen.time is None else place(chosen.time[0])
        return None if chosen.demo is None else place(chosen.demo), time, [place(name) for name in chosen.names]

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Cells of each line that has some, with the number of the line: a quoted cell may go on for several."""
        reader, line = csv.reader(self.file, delimiter=self.delimiter), self.n_before + 1
        try:
            for cells in reader:
                if cells and len(cells) != len(self.header):
                    raise ValueError(
                        f"line {line}: {len(cells)} cells under {len(self.header)} column names (delimiter "
                        f"{self.delimiter!r}, decimal mark {self.decimal!r})."
                    )
                if cells:
                    yield line, cells
                line = self.n_before + reader.line_num + 1
        except csv.Error as error:
            raise ValueError(f"line {line}: {error}.") from error

    def _time(self, cell: str, before: float, label: str) -> float | int:
        """Time of a cell: an integer where float64 does not hold it, as of stamps in ns, and of dates and clocks."""
        now: float | int = _clock_ns(cell) if _is_clock(cell) else self._number(cell)
        if abs(now) >= 2**53 and re.fullmatch(r"[+-]?\d{16,19}", cell.strip()) and abs(int(cell)) < 2**63:
            now = int(cell)
        if now <= before:
            apart = "" if self.chosen.demo else ", or name the column that tells the demonstrations apart, demo="
            raise ValueError(
                f"{now!r} comes after {before!r} in demonstration {label!r}: times must increase strictly. Sort the "
                f"lines by time and drop repeated ones{apart}.{nanoseconds_hint(now)}"
            )
        return now

    def _number(self, cell: str) -> float:
        text, foreign = cell.strip(), "_" if self.decimal == "." else "_."
        if self.wanted.missing == "drop" and text.lower() in _MISSING:
            return nan
        value = nan
        with suppress(ValueError):
            # Python reads 1_0 as ten.
            value = nan if any(mark in text for mark in foreign) else float(text.replace(self.decimal, "."))
        if not isfinite(value):
            what = f"{text!r} is not a finite number" if text else "the cell is blank"
            raise ValueError(
                f"{what} (decimal mark {self.decimal!r}). Drop the line (missing='drop' does, where the cell is blank "
                "or nan), fill the value in, or leave the column out by outputs=."
            )
        return value


def _filled(label: str) -> str:
    if not label:
        raise ValueError("the cell is blank.")
    return label


def _numbered(labels: NDArray[Any]) -> NDArray[np.int32] | None:
    """Number of each label; None where one is blank, or may be cut short."""
    heads = heads_of(labels)
    each = np.char.strip(labels[heads])
    lengths = np.char.str_len(each)
    if not 0 < lengths.min() <= lengths.max() < labels.dtype.itemsize:
        return None
    return np.repeat(np.unique(each, return_inverse=True)[1].astype(np.int32), np.diff(np.r_[heads, len(labels)]))


def _open_table(file: TextIO, delimiter: str | None, decimal: str, wanted: Wanted) -> _Table:
    """Read the header; the delimiter is the one that finds the columns wanted, and most columns."""
    first, n_before = _header_line(file)
    candidates = [delimiter] if delimiter else [mark for mark in DELIMITERS if mark != decimal]
    try:
        if len(first) == _LONGEST_HEADER:
            raise ValueError(f"it is longer than {_LONGEST_HEADER} characters; it must name the columns.")
        headers = [[name.strip() for name in next(csv.reader([first], delimiter=c), [])] for c in candidates]
        # A mark that is not the delimiter finds one column, or cuts names that hold it.
        sought = {wanted.demo, wanted.time or "time", *(wanted.outputs or ())}
        header = max(headers, key=lambda names: (len(sought & set(names)), len(names)))
        if first.startswith("# format:"):
            raise ValueError(f"no columns of demonstrations, but {first.strip()!r:.80}. {LOADERS}")
        twice = [name for name, count in Counter(header).items() if name and count > 1]
        if twice:
            raise ValueError(f"there are two columns {twice[0]!r}.")
        chosen = wanted.choose({name: (name,) for name in header}, demo="demo", time="time")
        if any(map(_is_number, header)):
            raise ValueError(f"it must name the columns, and has numbers: {preview(header)}.")
    except (ValueError, csv.Error) as error:
        raise ValueError(f"line {n_before}: {str(error).rstrip('.')}.") from error
    return _Table(file, header, n_before, candidates[headers.index(header)], decimal, chosen, wanted)


def _header_line(file: TextIO) -> tuple[str, int]:
    """The line that names the columns, and its number: the first that is no comment, or the comment above numbers."""
    comment, number = "", 0
    while number < _MOST_COMMENTS:
        here = file.tell()
        line, number = file.readline(_LONGEST_HEADER), number + 1
        if not line.startswith(("#", "%")) or line.startswith("# format:"):
            if comment and _is_number(re.split(r"[,;\t]", line)[0]):
                file.seek(here)
                return comment.lstrip("#% "), number - 1
            return line, number
        comment = line
    raise ValueError(f"its first {_MOST_COMMENTS} lines are comments.")


def _is_number(cell: str) -> bool:
    return re.fullmatch(r"\s*[+-]?[\d.]+(e[+-]?\d+)?\s*", cell, re.IGNORECASE) is not None


def _is_clock(cell: str) -> bool:
    return _CLOCK.fullmatch(cell.strip()) is not None


def _clock_ns(cell: str) -> int:
    """Nanoseconds of a date and time of day, since 1970, or of a time of day, since midnight."""
    day, hours, minutes, seconds, fraction = _CLOCK.fullmatch(cell.strip()).groups()  # type: ignore[union-attr]
    days = int(np.datetime64(day or "1970-01-01", "D").astype(int))
    whole = days * 86_400 + int(hours) * 3600 + int(minutes) * 60 + int(seconds or 0)
    return whole * 10**9 + int((fraction or "0").ljust(9, "0"))
