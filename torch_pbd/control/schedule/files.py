"""Schedules as .npz, .json and .csv: the same content and the same checksum in all three; nothing in them is executed.

Here a schedule is a dict of arrays and a dict of labels.
"""

import csv
import hashlib
import io
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, combinations_with_replacement
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from torch_pbd.control.schedule.contents import LABELS, OPTIONAL, SHAPES, Arrays, Labels
from torch_pbd.exceptions import InvalidParameterError, ModelFileError
from torch_pbd.files import LOADERS, read_array, read_members, replacing
from torch_pbd.files.memory import parsed_bytes, require_memory

FORMAT = "torch_pbd.schedule"
VERSION = 2
"""Version 1 had no acceleration, no orientation and no mass that is a matrix, and loads."""
MAX_BYTES = 2**30
"""Largest file (.npz: unpacked) that is written or read: 1 GiB, as .json 24 minutes at 1 kHz with d = 3."""

Built = TypeVar("Built")
Column = tuple[str, str, tuple[int, ...]]

# Parsers raise these about bytes that are not what they claim to be (RecursionError is a RuntimeError).
_DAMAGE = (ArithmeticError, LookupError, MemoryError, RuntimeError, TypeError, ValueError, csv.Error)


def write_schedule(path: Path, arrays: Arrays, labels: Labels) -> None:
    """Write one file in the format of its suffix; see :meth:`Schedule.save`."""
    encode, _ = _FORMATS[_known_suffix(path)]
    header = {"format": FORMAT, "version": VERSION, **labels}
    content = encode({**header, "sha256": _digest(header, arrays)}, arrays)
    if len(content) > MAX_BYTES:
        raise ValueError(
            f"{path} would have {len(content)} bytes, must have at most the {MAX_BYTES} that are read again: "
            "resample the schedule at a lower rate, or save it in parts."
        )
    with replacing(path) as file:
        file.write(content)


def read_schedule(path: Path, build: Callable[..., Built]) -> Built:
    """Result of ``build`` for the arrays and labels of a file, given by their names; see :meth:`Schedule.load`."""
    suffix = _known_suffix(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist, or is not a file.")
    if path.stat().st_size > MAX_BYTES:
        raise ModelFileError(f"{path} has {path.stat().st_size} bytes; a schedule has at most {MAX_BYTES}.")
    content = path.read_bytes()
    try:
        if suffix != ".npz":
            require_memory(parsed_bytes([content]), what="what it says", remedy="Save it as .npz.")
        # The arrays are read only once the header's version is known to be readable.
        parts = _FORMATS[suffix][1](content)
        header = next(parts)
        _check_header(header, optional={"sha256"} if suffix == ".csv" else set())
        arrays = next(parts)
        if not set(SHAPES) - OPTIONAL <= set(arrays) <= set(SHAPES):
            raise ValueError(f"its arrays are {', '.join(arrays) or 'none'}, must be {', '.join(SHAPES)}.")
        expected = header.pop("sha256", None)
        if expected is not None and expected != _digest(header, arrays):
            line = "delete the line that starts with '# sha256:' to accept it"
            remedy = line if suffix == ".csv" else "save it again"
            raise ValueError(f"it does not match its checksum: it is damaged, or, if edited on purpose, {remedy}.")
        return build(**{key: header[key] for key in LABELS} | dict(arrays))
    except _DAMAGE as error:
        raise ModelFileError(f"{path} cannot be read as a schedule: {error}") from error


def _known_suffix(path: Path) -> str:
    if path.suffix.lower() not in _FORMATS:
        raise InvalidParameterError(f"{path} has the suffix {path.suffix!r}, must have .npz, .json or .csv. {LOADERS}")
    return path.suffix.lower()


def _check_header(header: Any, optional: set[str]) -> None:
    found = header.get("format") if isinstance(header, dict) else None
    if found != FORMAT:
        raise ValueError(f"its format is {found!r}, must be {FORMAT!r}. {LOADERS}")
    if header.get("version") not in (1, VERSION):
        raise ValueError(f"it has version {header.get('version')!r}, must have {VERSION} or 1: upgrade torch_pbd.")
    known = {"format", "version", "sha256", *LABELS}
    for words, keys in [("has no", known - optional - set(header)), ("has an unknown", set(header) - known)]:
        if keys:
            raise ValueError(f"its header {words} {min(keys)!r}.")


def _digest(header: Labels, arrays: Arrays) -> str:
    """SHA-256 of the content, independent of the format, line ends and spelling of numbers."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in (name for name in SHAPES if name in arrays):
        digest.update(f"{name} {arrays[name].shape} ".encode())
        digest.update(arrays[name].astype("<f8").tobytes())
    return digest.hexdigest()


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        raise ValueError(f"it holds an object with two entries of one name, among {', '.join(entries):.80}.")
    return entries


_parse_json = partial(json.loads, object_pairs_hook=_unique)


def _encode_json(header: Labels, arrays: Arrays) -> bytes:
    return json.dumps({**header, "arrays": {name: array.tolist() for name, array in arrays.items()}}).encode()


def _decode_json(content: bytes) -> Iterator[Any]:
    header = _parse_json(content.decode())
    lists = header.pop("arrays", {}) if isinstance(header, dict) else {}
    yield header
    yield {name: np.asarray(values) for name, values in dict(lists).items()}


def _encode_npz(header: Labels, arrays: Arrays) -> bytes:
    stream = io.BytesIO()
    little_endian: dict[str, Any] = {name: array.astype("<f8") for name, array in arrays.items()}
    np.savez(stream, header=np.array(json.dumps(header)).astype("<U"), **little_endian)
    return stream.getvalue()


def _decode_npz(content: bytes) -> Iterator[Any]:
    members = read_members(content, MAX_BYTES, remedy="Resample the schedule at a lower rate.")
    yield _parse_json(str(read_array("header", members.pop("header")) if "header" in members else "{}"))
    yield {name: read_array(name, member) for name, member in members.items()}


def _columns(names: Sequence[str] | None, sizes: Mapping[str, int], between: str = "][") -> list[Column]:
    """Title, array and index in its rows of each column; symmetric matrices have only their upper triangle.

    ``sizes`` has the length of the last axis of every array that is present.
    """
    named = names or [str(i) for i in range(sizes["velocity"])]
    columns: list[Column] = []
    for name, d in sizes.items():
        labels = "wxyz" if name == "orientation" else named
        for place in combinations_with_replacement(range(d), len(SHAPES[name]) - 1):
            columns.append((f"{name}[{between.join(labels[i] for i in place)}]" if place else name, name, place))
    return columns


def _encode_csv(header: Labels, arrays: Arrays) -> bytes:
    columns = _columns(header["names"], {name: array.shape[-1] for name, array in arrays.items()})
    table = np.column_stack([arrays[name].T[place] for _, name, place in columns])
    text = io.StringIO(newline="")
    text.writelines(f"# {key}: {json.dumps(value)}\n" for key, value in header.items())
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([title for title, _, _ in columns])
    writer.writerows(table.tolist())  # shortest decimals that read back to the last bit
    return text.getvalue().encode()


def _decode_csv(content: bytes) -> Iterator[Any]:
    stream = io.StringIO(content.decode("utf-8-sig"), newline="")
    header: dict[str, Any] = {}
    first = ""
    for first in stream:
        if not first.startswith("#"):
            break
        match = re.fullmatch(r"# (\w+): (.*)", first.rstrip())
        if match is None or match[1] in header:
            raise ValueError(f"line {len(header) + 1} must be '# key: value' with a new key, but is {first[:80]!r}.")
        header[match[1]] = _parse_json(match[2])
    yield dict(header)
    yield _read_table(header["names"], csv.reader(chain([first], stream)), n_lines_before=len(header))


def _read_table(names: Any, reader: Any, n_lines_before: int) -> Arrays:
    titles: list[str] = next(reader, [])
    counts = Counter(title.partition("[")[0] for title in titles)
    p, d, line = counts["position"], counts["velocity"], n_lines_before + 1
    if names is not None and (not isinstance(names, list) or len(names) != d):
        raise ValueError(f"names is {names}, but there are {d} columns of velocities.")
    there = {name: shape for name, shape in SHAPES.items() if counts[name] or name not in OPTIONAL}
    sizes = {name: {"n": 1, "p": p, "d": d, 4: 4}[shape[-1]] for name, shape in there.items()}
    # Columns are counted before they are named, since titles of thousands of outputs would take gigabytes.
    n_columns = sum(math.comb(size + len(there[name]) - 2, len(there[name]) - 1) for name, size in sizes.items())
    if len(titles) != n_columns:
        raise ValueError(
            f"line {line} names {len(titles)} columns, of which {d} are velocities, must name {n_columns}."
        )
    columns = _columns(names, sizes)
    # Files once had titles with commas, stiffness[x,y], which must be quoted.
    if not any(titles == [title for title, *_ in _columns(names, sizes, between)] for between in ("][", ",")):
        raise ValueError(f"line {line} must name the columns {','.join(title for title, *_ in columns)}.")
    rows = [_numbers(cells, titles, n_lines_before + reader.line_num) for cells in reader if cells]
    table = np.reshape(rows, (-1, n_columns))
    arrays = {name: np.empty((len(table), *[size] * (len(SHAPES[name]) - 1))) for name, size in sizes.items()}
    for values, (_, name, place) in zip(table.T, columns, strict=True):
        arrays[name].T[place] = values
        arrays[name].T[place[::-1]] = values
    return arrays


def _numbers(cells: Sequence[str], titles: Sequence[str], line: int) -> list[float]:
    if len(cells) != len(titles):
        raise ValueError(f"line {line} has {len(cells)} cells, but there are {len(titles)} columns.")
    numbers = []
    for cell, title in zip(cells, titles, strict=True):
        try:
            number = math.nan if "_" in cell else float(cell)  # Python alone reads 1_0 as ten
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise ValueError(f"line {line}, column {title!r}: {cell!r} is not a finite number.")
        numbers.append(number)
    return numbers


_FORMATS: dict[str, tuple[Callable[[Labels, Arrays], bytes], Callable[[bytes], Iterator[Any]]]] = {
    ".npz": (_encode_npz, _decode_npz),
    ".json": (_encode_json, _decode_json),
    ".csv": (_encode_csv, _decode_csv),
}
