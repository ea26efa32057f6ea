"""Demonstrations as NumPy's .npz: arrays, and a JSON object that describes them."""

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data.demonstrations import Demonstrations
from torch_pbd.data.poses import with_whole_rotation
from torch_pbd.data.recordings import as_names, as_units, preview
from torch_pbd.data.wanted import Arguments, Wanted, natural
from torch_pbd.files import LOADERS, read_array, read_members
from torch_pbd.files.memory import parsed_bytes, require_memory

_NUMBERED = r"[tx]_(\d+)"


def read(path: Path, wanted: Wanted) -> Arguments:
    """Read the format of `torch_pbd.data.load_demonstrations`."""
    members = read_members(
        path.read_bytes(), wanted.max_bytes, remedy=f"Raise max_bytes={wanted.max_bytes} to read it."
    )
    if not ({"meta", "x"} & set(members) or [*members] == ["t"] or any(re.fullmatch(_NUMBERED, m) for m in members)):
        return _of_laboratory({name: _read(members, name) for name in members}, wanted)
    meta = _read_meta(members)
    # One grid of times for all demonstrations, or a grid for each.
    if "t" in members:
        times: Any = _read(members, "t")
        positions: Any = _read(members, "x")
        if positions.ndim != 3:
            raise ValueError(f"x has shape {positions.shape}, must have shape (K, T, d).")
    else:
        numbers = range(_count(members))
        times, positions = ([_read(members, f"{letter}_{k}") for k in numbers] for letter in "tx")
    n_outputs = np.shape(positions[0])[-1] if len(positions) else 0
    for key, count in {"K": len(positions), "d": n_outputs}.items():
        if meta.get(key, count) != count:
            raise ValueError(f"meta says {key} = {meta[key]}, but the arrays have {count}.")
    for option in ("demo", "time", "rate"):
        if getattr(wanted, option) is not None:
            raise ValueError(f"{option} is {getattr(wanted, option)!r}, but arrays t and x say it: leave it out.")
    names, units, reference = meta.get("dims"), _units(meta), meta.get("rotation_reference")
    if wanted.outputs is not None:
        every, units = as_names(names, n_outputs), as_units(units, n_outputs)
        chosen = wanted.choose({name: (name,) for name in every}).names
        names, reference = with_whole_rotation(chosen, every, reference)
        kept = [every.index(name) for name in names]
        positions, units = [position[:, kept] for position in positions], units and [units[i] for i in kept]
    return {
        "times": times,
        "positions": positions,
        "names": names,
        "units": units if wanted.units is None else wanted.units,
        "frame": wanted.frame or _text(meta, "frame"),
        # Public recordings say unit and t_unit, with a remark in brackets: "s (100 Hz)".
        "time_unit": wanted.time_unit or _text(meta, "time_unit") or _without_remark(_text(meta, "t_unit")) or "s",
        "alignment": meta.get("alignment"),
        "missing": wanted.missing,
        "rotation": wanted.rotation,
        "angles": wanted.angles,
        "rotation_reference": reference,
    }


def read_array_file(path: Path, wanted: Wanted) -> Arguments:
    """Read .npy: one array (T, d), or (K, T, d)."""
    return _of_laboratory({"y": read_array("it", path.read_bytes())}, wanted)


def _of_laboratory(arrays: Mapping[str, NDArray[Any]], wanted: Wanted) -> Arguments:
    """Arrays by names that mean nothing to us: (K, T, d), or a recording (T, d) each, or columns of one recording."""
    arrays = {name: array for name, array in arrays.items() if array.dtype.kind in "biuf" and 1 <= array.ndim <= 3}
    names = sorted(arrays, key=natural)
    deep = [arrays[name] for name in names if arrays[name].ndim == 3]
    flat = [name for name in names if arrays[name].ndim == 2]
    if deep:
        shape = deep[0].shape[:2]
        # A grid (T,) that all share, columns (K, T), signals (K, T, d).
        signals = {n: np.broadcast_to(a, shape) if a.shape == shape[1:] else a for n, a in arrays.items()}
        signals = {n: a for n, a in signals.items() if a.shape[:2] == shape}
        recordings = [{name: array[k] for name, array in signals.items()} for k in range(shape[0])]
    elif flat == names and len({arrays[name].shape[1] for name in names}) == 1:
        recordings = [{"y": arrays[name]} for name in names]
    else:
        recordings = [arrays]
        if len({len(array) for array in arrays.values()}) != 1:
            shapes = preview([f"{name} {arrays[name].shape}" for name in names])
            raise ValueError(
                f"its arrays fit no layout, (K, T, d), or (T, d) each of equal d, or (T,): {shapes}. {LOADERS}"
            )
    columns: dict[str, tuple[str, ...]] = {name: (name,) for name in recordings[0]}
    for name, array in recordings[0].items():
        if array.ndim == 2:
            columns[name] = tuple(f"{name}{'' if name == 'y' else '_'}{i}" for i in range(array.shape[1]))
    time = next((name for name in ("time", "t") if columns.get(name) == (name,)), "time")
    try:
        return wanted.read_each(wanted.choose(columns, time=time), recordings)
    except ValueError as error:
        raise ValueError(f"{error} {LOADERS}") from error


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
    if demonstrations.rotation_reference is not None:
        meta["rotation_reference"] = demonstrations.rotation_reference.tolist()
    arrays: dict[str, Any] = {"meta": np.array(json.dumps(meta))}
    if aligned:
        arrays |= {"t": demonstrations.times[0], "x": demonstrations.to_array()}
    else:
        for k, (time, position) in enumerate(demonstrations):
            arrays |= {f"t_{k}": time, f"x_{k}": position}
    np.savez_compressed(handle, **arrays)


def _read(members: Mapping[str, bytes], name: str) -> NDArray[Any]:
    if name not in members:
        raise ValueError(f"it has no array {name!r}; it has: {_listed(members)}.")
    try:
        return read_array(name, members[name])
    except ValueError as error:
        raise ValueError(f"array {name!r} cannot be read: {error}") from error


def _read_meta(members: Mapping[str, bytes]) -> dict[str, Any]:
    if "meta" not in members:
        return {}
    text = _read(members, "meta")
    try:
        if text.ndim:
            raise ValueError(f"it has shape {text.shape}")
        require_memory(parsed_bytes([members["meta"]]), what="it", remedy="Leave out what is not read.")
        meta = json.loads(text.item())
        if not isinstance(meta, dict):
            raise TypeError(f"it is a {type(meta).__name__}")
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"meta must be a 0-d string with a JSON object: {error}") from error
    return meta


def _count(names: Iterable[str]) -> int:
    numbers = {int(match[1]) for name in names if (match := re.fullmatch(_NUMBERED, name))}
    if not numbers:
        raise ValueError(f"it has neither arrays t and x nor t_0, x_0, ...; it has: {_listed(names)}. {LOADERS}")
    missing = set(range(len(numbers))) - numbers
    if missing:
        raise ValueError(f"it has demonstration {max(numbers)} but no t_{min(missing)}, x_{min(missing)}.")
    return len(numbers)


def _listed(names: Iterable[str]) -> str:
    return f"{', '.join(names):.200}" or "none"


def _text(meta: dict[str, Any], name: str) -> Any:
    return checks.text(meta.get(name), f"{name} in meta", optional=True)


def _units(meta: dict[str, Any]) -> Any:
    """Units of the outputs: in the order of ``dims``, by their names, or one for all."""
    units, names = meta.get("units"), meta.get("dims") or ()
    if not isinstance(units, dict):
        return _without_remark(meta.get("unit")) if units is None else units
    missing = [name for name in names if name not in units]
    if missing:
        raise ValueError(f"units in meta has no entry for output {missing[0]!r}; it has {preview([*units])}.")
    return [units[name] for name in names]


def _without_remark(unit: Any) -> Any:
    """Unit before the remark in brackets that some recordings add to it."""
    return unit.partition(" (")[0] if isinstance(unit, str) else unit
