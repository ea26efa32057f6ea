"""Demonstrations as NumPy's .npz: arrays, and a JSON object that describes them."""

import json
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from torch_pbd.data._checks import preview
from torch_pbd.data.demonstrations import Demonstrations, Missing
from torch_pbd.exceptions import DataFormatError


def read_npz(path: Path, max_bytes: int, missing: Missing) -> Demonstrations:
    """Read the format of `torch_pbd.data.load_demonstrations`."""
    _check_archive(path, max_bytes)
    with np.load(path, allow_pickle=False) as archive:
        meta = _read_meta(path, archive)
        if "t" in archive.files:
            times: Any = _read(path, archive, "t")
            positions: Any = _read(path, archive, "x")
            if positions.ndim != 3:
                raise DataFormatError(f"{path}: x has shape {positions.shape}, it must be (K, T, d).")
        else:
            n_demos = _count(path, archive.files)
            times = [_read(path, archive, f"t_{k}") for k in range(n_demos)]
            positions = [_read(path, archive, f"x_{k}") for k in range(n_demos)]
    try:
        demonstrations = Demonstrations(
            times,
            positions,
            names=meta.get("dims"),
            units=_units(meta),
            frame=meta.get("frame"),
            time_unit=str(meta.get("time_unit") or _without_remark(meta.get("t_unit")) or "s"),
            missing=missing,
        )
    except (ValueError, TypeError) as error:
        raise DataFormatError(f"{path}: {error}") from error
    _check_counts(path, meta, demonstrations)
    return demonstrations


def write_npz(demonstrations: Demonstrations, handle: BinaryIO) -> None:
    """Write the format of `torch_pbd.data.load_demonstrations`."""
    aligned = demonstrations.is_aligned
    lengths = demonstrations.n_steps
    meta = {
        "K": len(demonstrations),
        "T": lengths[0] if aligned else [min(lengths), max(lengths)],
        "d": demonstrations.n_outputs,
        "aligned": aligned,
        "dims": demonstrations.names,
        "units": demonstrations.units,
        "time_unit": demonstrations.time_unit,
        "frame": demonstrations.frame,
    }
    arrays: dict[str, Any] = {"meta": np.array(json.dumps(meta))}
    if aligned:
        arrays |= {"t": demonstrations.times[0], "x": demonstrations.to_array()}
    else:
        for k, (time, position) in enumerate(demonstrations):
            arrays |= {f"t_{k}": time, f"x_{k}": position}
    np.savez_compressed(handle, **arrays)


def _check_archive(path: Path, max_bytes: int) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            n_bytes = sum(member.file_size for member in archive.infolist())
    except zipfile.BadZipFile as error:
        raise DataFormatError(f"{path} is not an .npz archive, or it is damaged: {error}.") from error
    if n_bytes > max_bytes:
        raise DataFormatError(
            f"{path} unpacks to {n_bytes} bytes, more than max_bytes={max_bytes}: raise max_bytes to read it."
        )


def _read(path: Path, archive: NpzFile, name: str) -> NDArray[Any]:
    if name not in archive.files:
        raise DataFormatError(f"{path} has no array {name!r}; it has: {', '.join(archive.files) or 'none'}.")
    try:
        array: Any = archive[name]
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DataFormatError(f"{path}: array {name!r} cannot be read: {error}") from error
    if not isinstance(array, np.ndarray):
        raise DataFormatError(f"{path}: {name!r} is not a NumPy array.")
    return array


def _read_meta(path: Path, archive: NpzFile) -> dict[str, Any]:
    if "meta" not in archive.files:
        return {}
    text = _read(path, archive, "meta")
    try:
        if text.ndim:
            raise ValueError(f"it has shape {text.shape}")
        meta = json.loads(text.item())
        if not isinstance(meta, dict):
            raise TypeError(f"it is a {type(meta).__name__}")
    except (ValueError, TypeError) as error:
        raise DataFormatError(f"{path}: meta must be a 0-d string with a JSON object: {error}") from error
    return meta


def _count(path: Path, files: Sequence[str]) -> int:
    numbers = {int(match[1]) for name in files if (match := re.fullmatch(r"[tx]_(\d+)", name))}
    if not numbers:
        raise DataFormatError(
            f"{path} has neither arrays t and x nor t_0, x_0, ...; it has: {', '.join(files) or 'none'}."
        )
    missing = set(range(len(numbers))) - numbers
    if missing:
        raise DataFormatError(f"{path} has demonstration {max(numbers)} but no t_{min(missing)}, x_{min(missing)}.")
    return len(numbers)


def _units(meta: dict[str, Any]) -> Any:
    units = meta.get("units")
    if isinstance(units, dict):
        missing = [name for name in meta.get("dims") or () if name not in units]
        if missing:
            raise ValueError(f"units in meta has no entry for output {missing[0]!r}; it has {preview([*units])}.")
        return [units[name] for name in meta.get("dims") or ()]
    return units if units is not None else _without_remark(meta.get("unit"))


def _without_remark(unit: Any) -> Any:
    """The unit before the remark in brackets that some recordings add to it."""
    return unit.partition(" (")[0] if isinstance(unit, str) else unit


def _check_counts(path: Path, meta: dict[str, Any], demonstrations: Demonstrations) -> None:
    for key, count in {"K": len(demonstrations), "d": demonstrations.n_outputs}.items():
        if meta.get(key, count) != count:
            raise DataFormatError(f"{path}: meta says {key} = {meta[key]}, but the arrays have {count}.")
