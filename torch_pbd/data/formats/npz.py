"""Demonstrations as NumPy's .npz: arrays, and a JSON object that describes them."""

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from torch_pbd.data.demonstrations import Demonstrations, Missing
from torch_pbd.data.recordings import preview
from torch_pbd.exceptions import DataFormatError
from torch_pbd.files.archives import read_array, read_members
from torch_pbd.files.atomic import LOADERS
from torch_pbd.files.memory import parsed_bytes, require_memory


def read(
    path: Path, max_bytes: int, missing: Missing, units: Any = None, time_unit: str | None = None
) -> Demonstrations:
    """Read the format of `torch_pbd.data.load_demonstrations`."""
    try:
        members = read_members(path.read_bytes(), max_bytes, remedy=f"Raise max_bytes={max_bytes} to read it.")
    except ValueError as error:
        raise DataFormatError(f"{path}: {error}") from error
    meta = _read_meta(path, members)
    if "t" in members:
        times: Any = _read(path, members, "t")
        positions: Any = _read(path, members, "x")
        if positions.ndim != 3:
            raise DataFormatError(f"{path}: x has shape {positions.shape}, must have shape (K, T, d).")
    else:
        numbers = range(_count(path, members))
        times = [_read(path, members, f"t_{k}") for k in numbers]
        positions = [_read(path, members, f"x_{k}") for k in numbers]
    try:
        demonstrations = Demonstrations(
            times,
            positions,
            names=meta.get("dims"),
            units=_units(meta) if units is None else units,
            frame=_text(meta, "frame"),
            time_unit=time_unit or _text(meta, "time_unit") or _without_remark(_text(meta, "t_unit")) or "s",
            alignment=meta.get("alignment"),
            missing=missing,
        )
    except (ValueError, TypeError) as error:
        raise DataFormatError(f"{path}: {error}") from error
    for key, count in {"K": len(demonstrations), "d": demonstrations.n_outputs}.items():
        if meta.get(key, count) != count:
            raise DataFormatError(f"{path}: meta says {key} = {meta[key]}, but the arrays have {count}.")
    return demonstrations


def write(demonstrations: Demonstrations, handle: BinaryIO) -> None:
    """Write the format of `torch_pbd.data.load_demonstrations`."""
    aligned, lengths = demonstrations.is_aligned, demonstrations.n_steps
    meta = {
        "K": len(demonstrations),
        "T": lengths[0] if aligned else [min(lengths), max(lengths)],
        "d": demonstrations.n_outputs,
        "aligned": aligned,
        "dims": demonstrations.names,
        "units": demonstrations.units,
        "time_unit": demonstrations.time_unit,
        "frame": demonstrations.frame,
        "alignment": demonstrations.alignment,
    }
    arrays: dict[str, Any] = {"meta": np.array(json.dumps(meta))}
    if aligned:
        arrays |= {"t": demonstrations.times[0], "x": demonstrations.to_array()}
    else:
        for k, (time, position) in enumerate(demonstrations):
            arrays |= {f"t_{k}": time, f"x_{k}": position}
    np.savez_compressed(handle, **arrays)


def _read(path: Path, members: Mapping[str, bytes], name: str) -> NDArray[Any]:
    if name not in members:
        raise DataFormatError(f"{path} has no array {name!r}; it has: {_listed(members)}.")
    try:
        return read_array(name, members[name])
    except ValueError as error:
        raise DataFormatError(f"{path}: array {name!r} cannot be read: {error}") from error


def _read_meta(path: Path, members: Mapping[str, bytes]) -> dict[str, Any]:
    if "meta" not in members:
        return {}
    text = _read(path, members, "meta")
    try:
        if text.ndim:
            raise ValueError(f"it has shape {text.shape}")
        require_memory(parsed_bytes([members["meta"]]), what="it", remedy="Leave out what is not read.")
        meta = json.loads(text.item())
        if not isinstance(meta, dict):
            raise TypeError(f"it is a {type(meta).__name__}")
    except (ValueError, TypeError, RecursionError) as error:
        raise DataFormatError(f"{path}: meta must be a 0-d string with a JSON object: {error}") from error
    return meta


def _count(path: Path, files: Iterable[str]) -> int:
    numbers = {int(match[1]) for name in files if (match := re.fullmatch(r"[tx]_(\d+)", name))}
    if not numbers:
        raise DataFormatError(
            f"{path} has neither arrays t and x nor t_0, x_0, ...; it has: {_listed(files)}. {LOADERS}"
        )
    missing = set(range(len(numbers))) - numbers
    if missing:
        raise DataFormatError(f"{path} has demonstration {max(numbers)} but no t_{min(missing)}, x_{min(missing)}.")
    return len(numbers)


def _listed(names: Iterable[str]) -> str:
    return f"{', '.join(names):.200}" or "none"


def _text(meta: dict[str, Any], name: str) -> str | None:
    value = meta.get(name)
    if not isinstance(value, str | None):
        raise ValueError(f"meta says {name} = {value!r:.80}, it must be text")
    return value


def _units(meta: dict[str, Any]) -> Any:
    units = meta.get("units")
    if isinstance(units, dict):
        missing = [name for name in meta.get("dims") or () if name not in units]
        if missing:
            raise ValueError(f"units in meta has no entry for output {missing[0]!r}; it has {preview([*units])}.")
        return [units[name] for name in meta.get("dims") or ()]
    return units if units is not None else _without_remark(meta.get("unit"))


def _without_remark(unit: Any) -> Any:
    """Unit before the remark in brackets that some recordings add to it."""
    return unit.partition(" (")[0] if isinstance(unit, str) else unit
