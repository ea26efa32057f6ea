"""Demonstrations as NumPy's .npz: arrays, and a JSON object that describes them."""

import json
import re
from collections.abc import Mapping
from dataclasses import replace
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
    members = read_members(path.read_bytes(), wanted.max_bytes, remedy=f"Raise max_bytes={wanted.max_bytes}.")
    numbers = {int(match[1]) for name in members if (match := re.fullmatch(_NUMBERED, name))}
    shared = {"t", "x"} <= members.keys() and _read(members, "x").ndim > 1  # else they are columns, as y beside them
    if not ("meta" in members or [*members] == ["t"] or numbers or shared):
        return _read_other({name: _read(members, name) for name in members}, wanted)
    meta = _read_meta(members)
    if "t" in members:  # one grid of times for all demonstrations
        positions = _read(members, "x")
        if positions.ndim != 3:
            raise ValueError(f"x has shape {positions.shape}, must have shape (K, T, d).")
        recordings = [{"t": _read(members, "t"), "x": position} for position in positions]
    else:
        # Of one that lacks, the first is told.
        ks = range(max(numbers, default=0) + 1)
        recordings = [{letter: _read(members, f"{letter}_{k}") for letter in "tx"} for k in ks]
    n_outputs = (*recordings[0]["x"].shape, 1)[1] if recordings else 0
    if meta.get("K", len(recordings)) != len(recordings):
        raise ValueError(f"meta says K = {meta['K']}, but the arrays have {len(recordings)}.")
    names = as_names(meta.get("dims"), n_outputs)
    outputs, reference = with_whole_rotation(wanted.outputs or names, names, meta.get("rotation_reference"))
    wanted = replace(wanted, outputs=outputs)
    chosen = wanted.choose({"x": names})
    # Times are known by the name of their array, which an output may have too.
    chosen = chosen if wanted.rate else chosen._replace(time=("t", 0))
    units = None if wanted.units is not None else as_units(_units(meta), n_outputs)
    return wanted.read_each(
        chosen,
        recordings,
        units=units and [units[i] for _, i in chosen.outputs],
        time_unit=_text(meta, "time_unit") or _plain(_text(meta, "t_unit")),
        rotation_reference=reference,
        frame=_text(meta, "frame"),
        alignment=meta.get("alignment"),
    )


def read_array_file(path: Path, wanted: Wanted) -> Arguments:
    """Read .npy: one array (T, d), or (K, T, d)."""
    return _read_other({"y": read_array("it", path.read_bytes())}, wanted)


def _read_other(arrays: Mapping[str, NDArray[Any]], wanted: Wanted) -> Arguments:
    """Arrays by names that mean nothing: (K, T, d), or recordings (T, d) by numbers or lengths, or signals of one."""
    arrays = {name: array for name, array in arrays.items() if array.dtype.kind in "biuf" and 1 <= array.ndim <= 3}
    names = sorted(arrays, key=natural)
    deep = [arrays[name] for name in names if arrays[name].ndim == 3]
    flat = [name for name in names if arrays[name].ndim == 2]
    others = {name: arrays[name] for name in names if name not in flat}
    fits = len({arrays[name].shape[1] for name in flat}) == 1
    apart = len({re.sub(r"\d+", "", name) for name in flat}) == 1 or len({len(arrays[name]) for name in flat}) > 1
    apart = apart and not any(output.startswith(name) for output in wanted.outputs or () for name in flat)
    shapes = preview([f"{name} {arrays[name].shape}" for name in names])
    if deep:
        shape = deep[0].shape[:2]
        # A grid (T,) that all share, columns (K, T), signals (K, T, d).
        signals = {n: np.broadcast_to(a, shape) if a.shape == shape[1:] else a for n, a in arrays.items()}
        signals = {n: a for n, a in signals.items() if a.shape[:2] == shape}
        recordings = [{name: array[k] for name, array in signals.items()} for k in range(shape[0])]
    elif fits and apart and (flat == names or (len(flat) > 1 and others.keys() <= {wanted.time, "time", "t"})):
        recordings = [{"y": arrays[name]} | others for name in flat]
    elif len({len(array) for array in arrays.values()}) == 1:
        if fits and flat == names and not wanted.outputs:
            what = f"its arrays may be recordings or signals of one: {shapes}"
            wanted.refuse(f"{what}: call recordings demo_0, demo_1, ..., or say which signals by outputs=.", "outputs")
        recordings = [arrays]
    else:
        layouts = "(K, T, d), or demo_0, demo_1, ... of (T, d), or (T, d) and (T,) of one T"
        raise ValueError(f"its arrays fit no layout, {layouts}: {shapes}. {LOADERS}")
    columns = {
        name: tuple(f"{name}{'' if name == 'y' else '_'}{i}" for i in range(a.shape[1])) if a.ndim == 2 else (name,)
        for name, a in recordings[0].items()
    }
    time = next((name for name in ("time", "t") if columns.get(name) == (name,)), "time")
    try:
        return wanted.read_each(wanted.choose(columns, time=time), recordings)
    except ValueError as error:
        raise ValueError(f"{error} {LOADERS}") from error


def write(demonstrations: Demonstrations, handle: BinaryIO) -> None:
    """Write the format of `torch_pbd.data.load_demonstrations`."""
    aligned, lengths = demonstrations.is_aligned, demonstrations.n_steps
    reference = demonstrations.rotation_reference
    meta: dict[str, Any] = {"K": len(demonstrations), "T": lengths[0] if aligned else [min(lengths), max(lengths)]}
    meta |= {"d": demonstrations.n_outputs, "aligned": aligned, "dims": demonstrations.names}
    meta |= {name: getattr(demonstrations, name) for name in ("units", "time_unit", "frame", "alignment")}
    meta |= {} if reference is None else {"rotation_reference": reference.tolist()}
    arrays: dict[str, Any] = {"meta": np.array(json.dumps(meta))}
    if aligned:
        arrays |= {"t": demonstrations.times[0], "x": demonstrations.to_array()}
    else:
        for k, (time, position) in enumerate(demonstrations):
            arrays |= {f"t_{k}": time, f"x_{k}": position}
    np.savez_compressed(handle, **arrays)


def _read(members: Mapping[str, bytes], name: str) -> NDArray[Any]:
    if name not in members:
        raise ValueError(f"it has no array {name!r}; it has: {preview([*members])}. {LOADERS}")
    return read_array(f"array {name!r}", members[name])


def _read_meta(members: Mapping[str, bytes]) -> dict[str, Any]:
    if "meta" not in members:
        return {}
    text = _read(members, "meta")
    require_memory(parsed_bytes([members["meta"]]), what="meta", remedy="Leave out what is not read.")
    try:
        meta = json.loads(text.item())
        if not isinstance(meta, dict):
            raise TypeError(f"it is a {type(meta).__name__}")
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"meta must be a 0-d string with a JSON object: {error}") from error
    return meta


def _text(meta: dict[str, Any], name: str) -> Any:
    return checks.text(meta.get(name), f"{name} in meta", optional=True)


def _units(meta: dict[str, Any]) -> Any:
    """Units of the outputs: in the order of ``dims``, by their names, or one for all."""
    units, names = meta.get("units"), meta.get("dims") or ()
    if not isinstance(units, dict):
        return _plain(meta.get("unit")) if units is None else units
    for name in names:
        if name not in units:
            raise ValueError(f"units in meta has no entry for output {name!r}; it has {preview([*units])}.")
    return [units[name] for name in names]


def _plain(unit: Any) -> Any:
    """Unit without a remark in brackets, as in public recordings: "s (100 Hz)"."""
    return unit.partition(" (")[0] if isinstance(unit, str) else unit
