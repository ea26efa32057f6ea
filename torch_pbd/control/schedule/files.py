"""Schedules as .npz, .json and .csv: the same content and the same checksum in all three; nothing in them is executed.

Here a schedule is a dict of arrays and a dict of labels.
"""

import csv
import hashlib
import io
import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from torch_pbd.control.schedule.contents import ARRAY_DIMS, LABELS, Arrays, Labels
from torch_pbd.exceptions import ModelFileError
from torch_pbd.files.archives import read_array, read_members
from torch_pbd.files.atomic import LOADERS, replacing
from torch_pbd.files.memory import parsed_bytes, require_memory

FORMAT = "torch_pbd.schedule"
VERSION = 1
MAX_BYTES = 2**30
"""Largest file (.npz: unpacked) that is written or read: 1 GiB, as .json 24 minutes at 1 kHz with d = 3."""

Built = TypeVar("Built")
# A decoder gives the header, and then, once that is known to be of a version that can be read, the arrays.
Decoder = Callable[[bytes], Iterator[Any]]

# What parsers raise about bytes that are not what they claim to be (RecursionError is a RuntimeError).
_DAMAGE = (ArithmeticError, LookupError, MemoryError, RuntimeError, TypeError, ValueError, csv.Error)


def write_schedule(path: Path, arrays: Arrays, labels: Labels) -> None:
    """Write one file in the format of its suffix, which is there whole or not at all.

    Raises ValueError if the suffix is not known or the file would be larger than what is read again, OSError
    with the path if it cannot be written.
    """
    encode = _ENCODERS[_known_suffix(path)]
    header = {"format": FORMAT, "version": VERSION, **labels}
    content = encode({**header, "sha256": _digest(header, arrays)}, arrays)
    if len(content) > MAX_BYTES:
        raise ValueError(
            f"{path} would have {len(content)} bytes, more than the {MAX_BYTES} that are read again: "
            "resample the schedule at a lower rate, or save it in parts."
        )
    with replacing(path) as file:
        file.write(content)


def read_schedule(path: Path, build: Callable[..., Built]) -> Built:
    """What ``build`` makes of the arrays and labels, given by their names, of a file of :func:`write_schedule`.

    Raises ValueError if the suffix is not known, FileNotFoundError if there is no such file, ModelFileError if
    it is torn, changed, of a newer version, or no schedule.
    """
    suffix = _known_suffix(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist, or is not a file.")
    if path.stat().st_size > MAX_BYTES:
        raise ModelFileError(f"{path} has {path.stat().st_size} bytes; a schedule has at most {MAX_BYTES}.")
    parts = _DECODERS[suffix](path.read_bytes())
    try:
        header = next(parts)
        _check_header(header, checksum_needed=suffix != ".csv")
        arrays = next(parts)
        _check_content(header, arrays, editable=suffix == ".csv")
        return build(**arrays, **{key: header[key] for key in LABELS})
    except _DAMAGE as error:
        raise ModelFileError(f"{path} cannot be read as a schedule: {error}") from error


def _known_suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _ENCODERS:
        raise ValueError(
            f"path={str(path)!r} has the suffix {path.suffix!r}; a schedule is .npz, .json or .csv. {LOADERS}"
        )
    return suffix


def _check_header(header: Any, *, checksum_needed: bool) -> None:
    found = header.get("format") if isinstance(header, dict) else None
    if found != FORMAT:
        raise ValueError(f"its format is {found!r}, not {FORMAT!r}. {LOADERS}")
    if header.get("version") != VERSION:
        raise ValueError(f"it has version {header.get('version')!r}, this torch_pbd reads {VERSION}: upgrade it.")
    needed = {"format", "version", *LABELS, *(["sha256"] if checksum_needed else [])}
    for words, keys in [("has no", needed - set(header)), ("has an unknown", set(header) - needed - {"sha256"})]:
        if keys:
            raise ValueError(f"its header {words} {min(keys)!r}.")


def _check_content(header: Labels, arrays: Arrays, *, editable: bool) -> None:
    if set(arrays) != set(ARRAY_DIMS):
        raise ValueError(f"its arrays are {', '.join(arrays) or 'none'}; they must be {', '.join(ARRAY_DIMS)}.")
    rest = {key: value for key, value in header.items() if key != "sha256"}
    if "sha256" in header and header["sha256"] != _digest(rest, arrays):
        edited = "delete the line that starts with '# sha256:' to accept it as it is" if editable else "save it again"
        raise ValueError(f"it does not match its checksum: it is damaged, or, if it was edited on purpose, {edited}.")


def _digest(header: Labels, arrays: Arrays) -> str:
    """SHA-256 of what the file says, not of how it is written: line ends and spelling of numbers are free."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in ARRAY_DIMS:
        digest.update(f"{name} {arrays[name].shape} ".encode())
        digest.update(arrays[name].astype("<f8").tobytes())
    return digest.hexdigest()


def _require_parsed(content: bytes) -> None:
    require_memory(parsed_bytes([content]), what="what it says", remedy="Save it as .npz.")


def _parse_json(text: str) -> Any:
    def refuse(constant: str) -> None:
        raise ValueError(f"it holds {constant}: all numbers must be finite.")

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        entries = dict(pairs)
        if len(entries) < len(pairs):
            raise ValueError(f"it holds an object with two entries of one name, among {', '.join(entries):.80}.")
        return entries

    return json.loads(text, parse_constant=refuse, object_pairs_hook=unique)


def _encode_json(header: Labels, arrays: Arrays) -> bytes:
    return json.dumps({**header, "arrays": {name: arrays[name].tolist() for name in ARRAY_DIMS}}).encode()


def _decode_json(content: bytes) -> Iterator[Any]:
    _require_parsed(content)
    header = _parse_json(content.decode())
    lists = header.pop("arrays", {}) if isinstance(header, dict) else {}
    yield header
    yield {name: np.asarray(values) for name, values in dict(lists).items()}


def _encode_npz(header: Labels, arrays: Arrays) -> bytes:
    stream = io.BytesIO()
    little_endian: dict[str, Any] = {name: arrays[name].astype("<f8") for name in ARRAY_DIMS}
    np.savez(stream, header=np.array(json.dumps(header)).astype("<U"), **little_endian)
    return stream.getvalue()


def _decode_npz(content: bytes) -> Iterator[Any]:
    members = read_members(content, MAX_BYTES, remedy="Resample the schedule at a lower rate.")
    yield _parse_json(str(_read_npy("header", members.pop("header")))) if "header" in members else {}
    yield {name: _read_npy(name, member) for name, member in members.items()}


def _read_npy(name: str, content: bytes) -> NDArray[Any]:
    array = read_array(name, content)
    if array.dtype.str != "<f8" and not (name == "header" and array.dtype.kind == "U" and not array.ndim):
        raise ValueError(f"{name} is not an array of float64, it is of {array.dtype}.")
    return array


def _columns(
    names: Sequence[str] | None, n_outputs: int, between: str = "]["
) -> list[tuple[str, str, tuple[int, ...]]]:
    """Title, array and place in its rows of each column; of symmetric matrices the upper triangle."""
    labels = [str(i) for i in range(n_outputs)] if names is None else names
    axes = range(n_outputs)
    places: dict[int, list[tuple[int, ...]]] = {
        1: [()],
        2: [(i,) for i in axes],
        3: [(i, j) for i in axes for j in axes[i:]],
    }
    return [
        (f"{name}[{between.join(labels[i] for i in place)}]" if place else name, name, place)
        for name, n_dims in ARRAY_DIMS.items()
        for place in places[n_dims]
    ]


def _encode_csv(header: Labels, arrays: Arrays) -> bytes:
    columns = _columns(header["names"], arrays["position"].shape[1])
    table = np.column_stack([arrays[name].T[place] for _, name, place in columns])
    text = io.StringIO(newline="")
    text.writelines(f"# {key}: {json.dumps(value)}\n" for key, value in header.items())
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([title for title, _, _ in columns])
    writer.writerows(table.tolist())  # as the shortest decimals that come back to the last bit
    return text.getvalue().encode()


def _decode_csv(content: bytes) -> Iterator[Any]:
    _require_parsed(content)
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
    yield header
    yield _read_table(header["names"], chain([first], stream), n_lines_before=len(header))


def _read_table(names: Any, lines: Iterator[str], n_lines_before: int) -> Arrays:
    reader = csv.reader(lines)
    titles = next(reader, [])
    n_outputs = sum(title.startswith("position[") for title in titles)
    if names is not None and (not isinstance(names, list) or len(names) != n_outputs):
        raise ValueError(f"names is {names}, but there are {n_outputs} columns of positions.")
    n_columns = 2 + 2 * n_outputs + 3 * n_outputs * (n_outputs + 1) // 2
    if len(titles) != n_columns:
        raise ValueError(
            f"line {n_lines_before + 1} names {len(titles)} columns, of which {n_outputs} are positions: they must be "
            f"{n_columns}."
        )
    columns = _columns(names, n_outputs)
    expected = [title for title, _, _ in columns]
    # Files once had titles with commas, stiffness[x,y], which must be quoted.
    if titles not in (expected, [title for title, _, _ in _columns(names, n_outputs, ",")]):
        raise ValueError(f"line {n_lines_before + 1} must name the columns {','.join(expected)}.")
    rows = [_numbers(cells, expected, n_lines_before + reader.line_num) for cells in reader if cells]
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(expected))
    arrays: Arrays = {name: np.empty((len(rows), *[n_outputs] * (n - 1))) for name, n in ARRAY_DIMS.items()}
    for values, (_, name, place) in zip(table.T, columns, strict=True):
        arrays[name].T[place] = values
        arrays[name].T[place[::-1]] = values
    return arrays


def _numbers(cells: Sequence[str], titles: Sequence[str], line: int) -> list[float]:
    if len(cells) != len(titles):
        raise ValueError(f"line {line} has {len(cells)} cells, but there are {len(titles)} columns.")
    row = []
    for cell, title in zip(cells, titles, strict=True):
        try:
            value = math.nan if "_" in cell else float(cell)  # Python alone reads 1_0 as ten
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError(f"line {line}, column {title!r}: {cell!r} is not a finite number.")
        row.append(value)
    return row


_ENCODERS = {".npz": _encode_npz, ".json": _encode_json, ".csv": _encode_csv}
_DECODERS: dict[str, Decoder] = {".npz": _decode_npz, ".json": _decode_json, ".csv": _decode_csv}
