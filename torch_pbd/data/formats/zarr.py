"""Replay buffers of UMI and diffusion policy: Zarr with data/<key> and meta/episode_ends, a folder or a zip."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from torch_pbd.data.recordings import preview
from torch_pbd.data.wanted import Arguments, Wanted, column_names
from torch_pbd.registry import optional

# Codecs of numbers; another one, pickle, would execute what is in the file.
_CODECS = {"bytes", "blosc", "zstd", "lz4", "gzip", "zlib", "bz2", "lzma", "shuffle", "bitshuffle", "delta", "crc32c"}
_CODECS |= {"transpose", "sharding_indexed", "numcodecs.shuffle", "numcodecs.delta", "numcodecs.zlib", "numcodecs.lz4"}


def read(path: Path, wanted: Wanted) -> Arguments:
    """Read the format of `torch_pbd.data.load_demonstrations`."""
    zarr = optional("zarr", "zarr", f"{path.name}, as all of Zarr,")
    store = zarr.storage.ZipStore(path, mode="r") if path.is_file() else zarr.storage.LocalStore(path, read_only=True)
    group = zarr.open_group(store, mode="r")
    try:
        keys = [*group["data"].array_keys()] if "data" in group else []
        if not keys or "meta/episode_ends" not in group:
            raise ValueError(
                f"it has no data and meta/episode_ends, as replay buffers have, but {preview([*group.keys()])}."
            )
        arrays = {key: group[f"data/{key}"] for key in keys}
        arrays = {key: a for key, a in arrays.items() if a.dtype.kind in "biuf" and 1 <= a.ndim <= 2}
        ends = _read(group["meta/episode_ends"], wanted, "meta/episode_ends").astype(np.int64)
        signals = {key: column_names(key, (*a.shape, 1)[1]) for key, a in arrays.items()}
        chosen = wanted.choose(signals, time="timestamp" if "timestamp" in signals else None)
        columns = {key: _read(arrays[key], wanted, f"data/{key}") for key in chosen.signals}
    finally:
        store.close()
    n = len(next(iter(columns.values())))
    if not len(ends) or (np.diff(ends, prepend=0) <= 0).any() or ends[-1] != n:
        raise ValueError(f"meta/episode_ends is {preview(ends.tolist())}, must rise to {n}, the samples of data/.")
    spans = zip(np.r_[0, ends[:-1]], ends, strict=True)
    return wanted.read_each(chosen, [{key: values[a:b] for key, values in columns.items()} for a, b in spans])


def _read(array: Any, wanted: Wanted, name: str) -> Any:
    found = set(_codec_names(array.metadata.to_dict()))
    if not found <= _CODECS:
        raise ValueError(f"{name} is packed by {', '.join(sorted(found - _CODECS))}, which is not read.")
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} holds {array.dtype}, no numbers.")
    wanted.require(array.nbytes, name)
    return array[...]


def _codec_names(metadata: Any) -> list[str]:
    """Names of the codecs of an array, by its metadata in version 2 or 3."""
    stages = [*(metadata.get("codecs") or ()), *(metadata.get("filters") or ()), metadata.get("compressor")]
    plain = json.loads(json.dumps(stages, default=lambda codec: getattr(codec, "get_config", lambda: str(codec))()))
    return [stage.get("name") or stage.get("id") or "?" for stage in plain if stage]
