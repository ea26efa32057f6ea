"""Demonstrations as CSV text with one line per sample."""

import csv
import io
import re
from array import array
from collections import Counter
from contextlib import suppress
from math import isfinite, nan
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.data.poses import as_columns
from torch_pbd.data.recordings import preview
from torch_pbd.data.wanted import UNNAMED, Arguments, Wanted
from torch_pbd.files import LOADERS

_DELIMITERS = (",", ";", "\t")
_LONGEST_HEADER = 2**17  # characters, of thousands of columns; a file without line ends would be one header
_MOST_COMMENTS = 1000  # lines before the header
_MISSING = ("", "nan", "+nan", "-nan", "nat", "na", "null", "none")
_CLOCK = re.compile(r"(?:([\d-]{10})[T ])?(\d\d?):(\d\d?)(?::(\d\d))?(?:[.,](\d{1,9}))?(?:Z|([+-]\d\d):?(\d\d)?)?")
_WHOLE = re.compile(r"[+-]?\d{16,19}")  # stamps in ns, which float64 does not hold


def read(path: Path, wanted: Wanted, delimiter: str | None = None, decimal: str = ".") -> Arguments:
    """Read a CSV file with the options of `torch_pbd.data.load_demonstrations`."""
    checks.choice(decimal, "decimal", (".", ","))
    if delimiter is not None and (not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter == decimal):
        raise checks.refusal(delimiter, "delimiter", f"one character, and not the decimal mark {decimal!r}")
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            table = _Table(file, delimiter, decimal, wanted)
            return wanted.read_rows(table.chosen, table.read_at_once() or table.read_lines())
        except UnicodeDecodeError as error:
            raise ValueError(f"it is not text in UTF-8: {error}.") from error


def write(demonstrations: Demonstrations, handle: BinaryIO) -> None:
    """Write columns ``demo,time,<names>`` with the shortest decimals that read back to the last bit."""
    names, columns = as_columns(demonstrations)
    for name in names:
        if name != name.strip() or name in UNNAMED:
            raise ValueError(f"an output named {name!r} cannot be read back from the header of a CSV file: rename it.")
    text = io.TextIOWrapper(handle, encoding="utf-8", newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["demo", "time", *names])
    for k, (time, values) in enumerate(zip(demonstrations.times, columns, strict=True)):
        writer.writerows([k, t, *row] for t, row in zip(time.tolist(), values.tolist(), strict=True))
    text.detach()


class _Table:
    """A CSV file whose header has been read, by the delimiter that yields the wanted and then the most columns."""

    def __init__(self, file: TextIO, delimiter: str | None, decimal: str, wanted: Wanted) -> None:
        self.file, self.decimal, self.missing = file, decimal, wanted.missing
        first, self.n_before = _header_line(file)
        if excel := re.fullmatch(r'"?sep=([^"\r\n]?)"?\s*', first):
            delimiter, first, self.n_before = delimiter or excel[1], file.readline(_LONGEST_HEADER), self.n_before + 1
        candidates = [delimiter] if delimiter else [mark for mark in _DELIMITERS if mark != decimal]
        try:
            if first.startswith("# format:"):
                raise ValueError(f"no columns of demonstrations, but {first.strip()!r:.80}. {LOADERS}")
            headers = [[name.strip() for name in next(csv.reader([first], delimiter=c), [])] for c in candidates]
            # A mark that is not the delimiter finds one column, or cuts names that hold it.
            sought = {wanted.demo, wanted.time or "time", *(wanted.outputs or ())}
            self.header = max(headers, key=lambda names: (len(sought & set(names)), len(names)))
            cells = [name.replace(decimal, ".") for name in self.header]
            if cells and all(_is_number(c) or _CLOCK.fullmatch(c) or c.lower() in _MISSING[1:] for c in cells):
                raise ValueError(f"it must name the columns, and has numbers: {preview(self.header)}.")
            if len(self.header) == 1 and wanted.rate is None:
                what = f"no columns but one, {self.header[0]!r:.80}, by {candidates} and the decimal mark {decimal!r}"
                raise ValueError(f"{what}: say what parts them by delimiter=, or rate= (in Hz) if there are no times.")
            twice = [name for name, count in Counter(self.header).items() if name and count > 1]
            if twice:
                raise ValueError(f"there are two columns {twice[0]!r}.")
            self.chosen = wanted.choose({name: (name,) for name in self.header}, demo="demo", time="time")
        except (ValueError, csv.Error) as error:
            raise ValueError(f"line {self.n_before}: {str(error).rstrip('.')}.") from error
        self.delimiter, self.start = candidates[headers.index(self.header)], file.tell()
        self.demo, self.time = (place and place[0] for place in (self.chosen.demo, self.chosen.time))
        self.kind: str | None = None  # of the times

    def read_at_once(self) -> dict[str, NDArray[Any]] | None:
        """Same as :meth:`read_lines` in a sixth of the time; None if some cell needs special treatment."""
        numbers = {self.time, *self.chosen.names}
        kinds = ["S8" if name == self.demo else "f8" if name in numbers else "S1" for name in self.header]
        if self.decimal != "." or not self.file.readline().strip():
            return None
        self.file.seek(self.start)
        dtype = [(str(i), kind) for i, kind in enumerate(kinds)]
        try:
            rows = np.loadtxt(self.file, dtype, delimiter=self.delimiter, quotechar='"', comments=None, ndmin=1)
        except ValueError:
            return None
        signals = {name: rows[str(i)] for i, name in enumerate(self.header) if kinds[i] == "f8"}
        # Larger ones may be stamps that float64 does not hold; not below is NaN, too.
        sound = all((np.abs(values) < 2**53).all() for values in signals.values())
        if self.demo is not None:
            signals[self.demo] = np.char.strip(rows[str(self.header.index(self.demo))])
            lengths = np.char.str_len(signals[self.demo])
            sound = sound and bool(0 < lengths.min() <= lengths.max() < 8)  # eight letters may have been more
        return signals if sound else None

    def read_lines(self) -> dict[str, NDArray[Any]]:
        """Chosen columns by name: numbers of the demonstrations, times as integers where all are, and outputs."""
        numbers: dict[str, int] = {}

        def number_of(label: str) -> int:
            if not label.strip():
                raise ValueError("the cell is blank.")
            return numbers.setdefault(label.strip(), len(numbers))

        converters: dict[Any, Any] = dict.fromkeys(self.chosen.names, self._read_number)
        converters |= {self.demo: number_of, self.time: self._read_time}
        converters.pop(None, None)
        # Arrays of numbers take 8 bytes for each, where lists take 32.
        columns: dict[Any, Any] = {name: [] if name == self.time else array("d") for name in converters}
        self.file.seek(self.start)
        reader, line, name = csv.reader(self.file, delimiter=self.delimiter), self.n_before + 1, None
        try:
            for cells in reader:
                if cells and len(cells) != len(self.header):
                    marks = f"delimiter {self.delimiter!r}, decimal mark {self.decimal!r}"
                    raise ValueError(f"{len(cells)} cells under {len(self.header)} column names ({marks}).")
                if cells:
                    row = dict(zip(self.header, cells, strict=True))
                    for name, convert in converters.items():
                        columns[name].append(convert(row[name]))
                # A quoted cell may go on for several lines: the first is told.
                line, name = self.n_before + reader.line_num + 1, None
        except UnicodeDecodeError:
            raise
        except (ValueError, csv.Error) as error:
            place = "" if name is None else f", column {name!r}"
            raise ValueError(f"line {line}{place}: {error}") from error
        if self.kind not in (None, "a number"):  # blanks of dates are NaT
            columns[self.time] = [np.datetime64("NaT") if stamp != stamp else stamp for stamp in columns[self.time]]
        return {name: np.array(values) for name, values in columns.items()}

    def _read_number(self, cell: str) -> float:
        text, value = cell.strip(), nan
        if self.missing == "drop" and text.lower() in _MISSING:
            return nan
        with suppress(ValueError):
            # Python reads 1_0 as ten.
            if "_" not in text and (self.decimal == "." or "." not in text):
                value = float(text.replace(self.decimal, "."))
        if not isfinite(value):
            what = f"{text!r} is not a finite number" if text else "the cell is blank"
            remedy = "missing='drop' does without lines with blanks and nan, outputs= without columns"
            raise ValueError(f"{what} (decimal mark {self.decimal!r}): {remedy}.")
        return value

    def _read_time(self, cell: str) -> Any:
        """Time of a cell: stamps in ns as integers, dates and times of day since 1970 or midnight as those of NumPy."""
        match = _CLOCK.fullmatch(cell.strip())
        kind = "a number" if match is None else "a date" if match[1] else "a time of day"
        if cell.strip().lower() not in _MISSING:
            if kind != (self.kind or kind):
                what = kind if match or _is_number(cell.replace(self.decimal, ".")) else "no date or time"
                raise ValueError(f"{cell!r} is {what}, must be {self.kind} as those above: write all in one way.")
            self.kind = kind
        if match is None:
            return int(cell) if _WHOLE.fullmatch(cell.strip()) else self._read_number(cell)
        day, hours, minutes, seconds, fraction, east, more = match.groups()
        if seconds is None and (fraction or not day):
            raise ValueError(f"{cell!r} is hh:mm or mm:ss, must be hh:mm:ss: write 00: before it, or :00 behind.")
        ahead = int(east or 0) * 60 + int((east or "+")[0] + (more or "0"))  # minutes of local time before UTC
        whole = (int(hours) * 60 + int(minutes) - ahead) * 60 + int(seconds or 0)
        clock = np.timedelta64(whole * 10**9 + int((fraction or "0").ljust(9, "0")), "ns")
        return np.datetime64(day or "1970-01-01", "ns") + clock


def _header_line(file: TextIO) -> tuple[str, int]:
    """Header line and its number: the first that is no comment, or a comment directly above numbers."""
    comment = ""
    for number in range(1, _MOST_COMMENTS + 1):
        here = file.tell()
        line = file.readline(_LONGEST_HEADER)
        if not line.startswith(("#", "%")) or line.startswith("# format:"):
            if comment and _is_number(re.split(r"[,;\t]", line)[0]):
                file.seek(here)
                return comment.lstrip("#% "), number - 1
            return line, number
        comment = line
    raise ValueError(f"its first {_MOST_COMMENTS} lines are comments.")


def _is_number(cell: str) -> bool:
    return re.fullmatch(r"\s*[+-]?[\d.]+(e[+-]?\d+)?\s*", cell, re.IGNORECASE) is not None
