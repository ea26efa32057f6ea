"""Parquet, and data sets of robot learning: LeRobot's folders, HDF5 of robomimic, replay buffers in Zarr."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_pbd import checks
from torch_pbd.data.recordings import preview
from torch_pbd.data.wanted import Arguments, Wanted, column_names, natural, numeric
from torch_pbd.registry import optional

# Rows at a time: what is packed and unpacked of a whole column of lists would be several times its numbers. Without a
# buffer, in bytes, the library holds all of a row group.
_ROWS, _BUFFER = 2**14, 2**20
_LARGEST_INFO = 2**22  # letters of meta/info.json
# Zarr's codecs of numbers; another one, pickle, would execute what is in the file.
_CODECS = {"bytes", "blosc", "zstd", "lz4", "gzip", "zlib", "bz2", "lzma", "shuffle", "bitshuffle", "delta", "crc32c"}
_CODECS |= {"transpose", "sharding_indexed", "numcodecs.shuffle", "numcodecs.delta", "numcodecs.zlib", "numcodecs.lz4"}


def read_parquet(path: Path, wanted: Wanted) -> Arguments:
    """Read a long Parquet table with one row per sample."""
    with _open_parquet(path) as file:
        _read_columns(file, (), wanted)  # refuses what is too large
        signals = {field.name: column_names(field.name, _first_shape(file, field)) for field in file.schema_arrow}
        chosen = wanted.choose(signals, demo="demo", time="time")
        return wanted.read_rows(chosen, _read_columns(file, chosen.signals, wanted))


def _open_parquet(path: Path, extra: str = "parquet") -> Any:
    parquet = optional("pyarrow.parquet", extra, f"{path.name}, as all of Parquet,")
    return parquet.ParquetFile(path, buffer_size=_BUFFER, pre_buffer=False)


def _read_columns(file: Any, names: Sequence[str], wanted: Wanted) -> dict[str, NDArray[Any]]:
    """Columns of an open Parquet file by name; lists of one length are rows of a matrix."""
    metadata = file.metadata
    packed = sum(metadata.row_group(i).total_byte_size for i in range(metadata.num_row_groups))
    wanted.require(max(packed, 8.0 * metadata.num_rows * len(names)), "it")
    return {name: _read_column(file, name) for name in names}


def _read_column(file: Any, name: str) -> NDArray[Any]:
    batches = file.iter_batches(_ROWS, columns=[name], use_threads=False)
    parts = [_as_array(batch.column(name)) for batch in batches] or [np.empty(0)]
    if len({part.shape[1:] for part in parts}) > 1:
        raise ValueError(f"column {name!r} has lists that differ in length.")
    return np.concatenate(parts)  # whole numbers become floats where some are absent


def _first_shape(file: Any, field: Any) -> tuple[int, ...]:
    batches = file.iter_batches(1, columns=[field.name], use_threads=False) if field.type.num_fields == 1 else ()
    return next(((1, len(batch.column(0)[0].as_py() or [0])) for batch in batches), (1,))


def _as_array(column: Any) -> NDArray[Any]:
    if not hasattr(column.type, "value_type") or hasattr(column.type, "index_type"):
        return column.to_numpy(zero_copy_only=False)
    if column.null_count or len(column.value_lengths().unique()) > 1:
        raise ValueError(f"it has lists of {column.type}, which are absent in some rows or differ in length.")
    return column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), -1)


def read_lerobot(path: Path, wanted: Wanted) -> Arguments:
    """Read a LeRobot folder, version 2 or 3: Parquet files with metadata in meta/."""
    with (path / "meta" / "info.json").open(encoding="utf-8") as file:
        info = json.loads(file.read(_LARGEST_INFO))
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not str(version).startswith(("v2", "v3")) or not isinstance(info.get("features"), dict):
        raise ValueError(f"meta/info.json is of version {version!s:.20}, must be v2 or v3, with features.")
    signals = {
        name: _feature_columns(name, feature)
        for name, feature in info["features"].items()
        if str(feature["dtype"]).startswith(("float", "int", "bool")) and len(feature["shape"]) == 1
    }
    chosen = wanted.choose(signals, demo="episode_index", time="timestamp", outputs="observation.state")
    if wanted.units is None:
        joints = "'deg' or 'rad' of joints, 'percent' where they go from -100 to 100, or one for each"
        wanted.refuse(f"it does not tell the units of {preview(chosen.names, 6)}: give units=, {joints}.", "units")
    # Several episodes a file in version 3, one in version 2; the numbers in the names are in order.
    files = sorted((path / "data").rglob("*.parquet"), key=lambda file: natural(file.relative_to(path).as_posix()))
    if not files:
        raise ValueError("it has no Parquet files in data/.")
    parts = []
    for name in files:
        with _open_parquet(name, "lerobot") as file:
            parts.append(_read_columns(file, list(dict.fromkeys(["episode_index", *chosen.signals])), wanted))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    # A missing file would be fewer demonstrations.
    numbers, counts = np.unique(columns["episode_index"], return_counts=True)
    found = dict(zip(numbers.tolist(), counts.tolist(), strict=True))
    declared = _declared_lengths(path, wanted) or found
    for number in sorted(declared.keys() | found.keys()):
        if declared.get(number) != found.get(number):
            has = f"episode {number} has {found.get(number, 0)} samples in data/"
            raise ValueError(f"{has}, but {declared.get(number, 0)} by meta/episodes: files are missing or cut.")
    return wanted.read_rows(chosen, columns)


def _feature_columns(name: str, feature: dict[str, Any]) -> tuple[str, ...]:
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]}
        names = [entry for entries in names.values() for entry in (entries if isinstance(entries, list) else [entries])]
    # "x" of the state and "x" of the action are two columns.
    if isinstance(names, list) and len(names) == feature["shape"][0] > 1:
        return tuple(f"{name}.{entry}" for entry in names)
    return column_names(name, (0, *feature["shape"]))


def _declared_lengths(path: Path, wanted: Wanted) -> dict[int, int]:
    """Samples of each episode by meta/; empty where that has none."""
    declared: dict[int, int] = {}
    for name in (path / "meta" / "episodes").rglob("*.parquet"):
        with _open_parquet(name, "lerobot") as file:
            columns = _read_columns(file, ["episode_index", "length"], wanted)
            declared |= dict(zip(columns["episode_index"].tolist(), columns["length"].tolist(), strict=True))
    lines = path / "meta" / "episodes.jsonl"
    if lines.is_file():
        entries = map(json.loads, lines.read_text(encoding="utf-8").splitlines())
        declared |= {int(entry["episode_index"]): int(entry["length"]) for entry in entries}
    return declared


def read_hdf5(path: Path, wanted: Wanted, mask: str | None = None) -> Arguments:
    """Read HDF5 of robomimic, with a group data/demo_k for each demonstration; ``mask`` is a list of them in /mask."""
    h5py = optional("h5py", "hdf5", f"{path.name}, as all of HDF5,")
    with h5py.File(path, "r") as file:
        data = file.get("data")
        if not isinstance(data, h5py.Group) or not len(data):
            raise ValueError(f"it has no group data with demonstrations, as robomimic's, but {preview([*file])}.")
        names = sorted(data, key=natural)
        if mask is not None:
            if mask not in (known := [*file.get("mask", ())]):
                raise checks.refusal(mask, "mask", f"one of {preview(known)}")
            names = sorted(file["mask"][mask].asstr()[()], key=natural)
            absent = [name for name in names if name not in data]
            if absent or not names:
                raise ValueError(f"mask {mask!r} names {preview(absent)}, must name demonstrations in data/.")
        each = {name: _hdf5_datasets(data[name], h5py) for name in names}
        signals = {key: column_names(key, found.shape) for key, found in each[names[0]].items()}
        # robosuite's quaternions have their real part last.
        turns = [key for key, columns in signals.items() if key.endswith("quat") and len(columns) == 4]
        signals |= {key: tuple(f"{key}_{letter}" for letter in "xyzw") for key in turns}
        chosen = wanted.choose(signals, outputs="robot0_eef_pos")
        # Texts of variable length, as the environment's arguments with their rate, are not read: from damaged files the
        # HDF5 library may not come back.
        for name, found in each.items():
            declared = data[name].attrs.get("num_samples")
            for key in chosen.signals:
                if key not in found:
                    raise ValueError(f"data/{name} has no {key!r}, which others have; it has {preview([*found])}.")
                if declared is not None and len(found[key]) != int(np.asarray(declared).item()):
                    raise ValueError(f"data/{name} says num_samples = {declared}, but {key} has {len(found[key])}.")
                if found[key].id.get_storage_size() == 0:
                    raise ValueError(f"data/{name}/{key} of shape {found[key].shape} was never written.")
        wanted.require(sum(found[key].nbytes for found in each.values() for key in chosen.signals), "it")
        recordings = [{key: found[key][()] for key in chosen.signals} for found in each.values()]
    # Positions of robosuite's end effectors are in m.
    units = "m" if all(signal.endswith(("eef_pos", "eef_quat")) for signal, _ in chosen.outputs) else None
    return wanted.read_each(chosen, recordings, units=units)


def _hdf5_datasets(group: Any, h5py: Any) -> dict[str, Any]:
    """Numbers (T,) or (T, d) of a demonstration: what its obs/ holds by name, and what stands beside it."""
    found = {}
    for place in (group, group.get("obs")):
        for key in place or ():
            # Links to other files, and arrays that lie in some, are not followed.
            value: Any = place[key] if isinstance(place.get(key, getlink=True), h5py.HardLink) else None
            if isinstance(value, h5py.Dataset) and not value.is_virtual and not value.external:
                found[key] = value
    return numeric(found)


def read_zarr(path: Path, wanted: Wanted) -> Arguments:
    """Read a replay buffer of UMI or diffusion policy: data/<key> and meta/episode_ends, a folder or a zip."""
    zarr = optional("zarr", "zarr", f"{path.name}, as all of Zarr,")
    store = zarr.storage.ZipStore(path, mode="r") if path.is_file() else zarr.storage.LocalStore(path, read_only=True)
    group = zarr.open_group(store, mode="r")
    try:
        keys = [*group["data"].array_keys()] if "data" in group else []
        if not keys or "meta/episode_ends" not in group:
            raise ValueError(f"it has no data and meta/episode_ends, but {preview([*group.keys()])}.")
        arrays = numeric({key: group[f"data/{key}"] for key in keys})
        ends = _read_zarr_array(group["meta/episode_ends"], wanted, "meta/episode_ends").astype(np.int64)
        signals = {key: column_names(key, array.shape) for key, array in arrays.items()}
        chosen = wanted.choose(signals, time="timestamp" if "timestamp" in signals else None)
        columns = {key: _read_zarr_array(arrays[key], wanted, f"data/{key}") for key in chosen.signals}
    finally:
        store.close()
    n = len(next(iter(columns.values())))
    if not len(ends) or (np.diff(ends, prepend=0) <= 0).any() or ends[-1] != n:
        raise ValueError(f"meta/episode_ends is {preview(ends.tolist())}, must rise to {n}, the samples of data/.")
    spans = zip(np.r_[0, ends[:-1]], ends, strict=True)
    return wanted.read_each(chosen, [{key: values[a:b] for key, values in columns.items()} for a, b in spans])


def _read_zarr_array(array: Any, wanted: Wanted, name: str) -> Any:
    """Array whose codecs, by its metadata in version 2 or 3, are those of numbers."""
    metadata = array.metadata.to_dict()
    stages = [*(metadata.get("codecs") or ()), *(metadata.get("filters") or ()), metadata.get("compressor")]
    plain = json.loads(json.dumps(stages, default=lambda codec: getattr(codec, "get_config", lambda: str(codec))()))
    strange = {stage.get("name") or stage.get("id") or "?" for stage in plain if stage} - _CODECS
    if strange or array.dtype.kind not in "biuf":
        raise ValueError(f"{name} is {array.dtype} packed by {', '.join(sorted(strange))}, must be plain numbers.")
    wanted.require(array.nbytes, name)
    return array[...]
