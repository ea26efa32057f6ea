"""Demonstrations of robomimic and robosuite: HDF5 with a group data/demo_k for each."""

from pathlib import Path
from typing import Any

import numpy as np

from torch_pbd import checks
from torch_pbd.data.recordings import preview
from torch_pbd.data.wanted import Arguments, Wanted, column_names, natural
from torch_pbd.registry import optional


def read(path: Path, wanted: Wanted, mask: str | None = None) -> Arguments:
    """Read the format of `torch_pbd.data.load_demonstrations`, which describes the options."""
    checks.text(mask, "mask", optional=True)
    h5py = optional("h5py", "hdf5", f"{path.name}, as all of HDF5,")
    with h5py.File(path, "r") as file:
        data = file.get("data")
        if not isinstance(data, h5py.Group) or not len(data):
            raise ValueError(
                f"it has no group data with demonstrations, as robomimic's files have, but {preview([*file])}."
            )
        names = sorted(data, key=natural)
        if mask is not None:
            names = _masked(file, mask)
        each = {name: _datasets(data[name], h5py) for name in names}
        signals = {key: _columns(key, found.shape[1:]) for key, found in each[names[0]].items()}
        chosen = wanted.choose(signals, outputs="robot0_eef_pos" if "robot0_eef_pos" in signals else None)
        for name in names:
            _check(name, data[name], each[name], chosen.signals)
        wanted.require(sum(found[key].nbytes for found in each.values() for key in chosen.signals), "it")
        recordings = [{key: found[key][()] for key in chosen.signals} for found in each.values()]
    # Positions of robosuite's end effectors are in m.
    units = "m" if all(signal.endswith(("eef_pos", "eef_quat")) for signal, _ in chosen.outputs) else None
    return wanted.read_each(chosen, recordings, units=units)


def _masked(file: Any, mask: str) -> list[str]:
    """Names of the demonstrations of a list in /mask, in the order of their numbers."""
    known = [*file.get("mask", ())]
    if mask not in known:
        raise checks.refusal(mask, "mask", f"one of {preview(known)}")
    names = [name.decode() if isinstance(name, bytes) else str(name) for name in file["mask"][mask][()]]
    absent = [name for name in names if name not in file["data"]]
    if absent or not names:
        raise ValueError(f"mask {mask!r} names {absent[0] if absent else 'no demonstration'!r}, which data/ has not.")
    return sorted(names, key=natural)


def _datasets(group: Any, h5py: Any) -> dict[str, Any]:
    """Numbers (T,) or (T, d) of a demonstration: what its obs/ holds by name, and what stands beside it."""
    found = {}
    for place in (group, group.get("obs")):
        for key in place or ():
            # Links to other files, and arrays that lie in some, are not followed.
            value: Any = place[key] if isinstance(place.get(key, getlink=True), h5py.HardLink) else None
            own = isinstance(value, h5py.Dataset) and not value.is_virtual and not value.external
            if own and value.dtype.kind in "biuf" and 1 <= value.ndim <= 2:
                found[key] = value
    return found


def _columns(key: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    # robosuite's quaternions have their real part last.
    order = "xyzw" if key.endswith("quat") and shape == (4,) else None
    return tuple(f"{key}_{letter}" for letter in order) if order else column_names(key, shape[0] if shape else 1)


# Texts of variable length, as the environment's arguments with their rate, are not read: from damaged files the HDF5
# library may not come back.
def _check(name: str, group: Any, found: dict[str, Any], signals: list[str]) -> None:
    declared = group.attrs.get("num_samples")
    for key in signals:
        if key not in found:
            raise ValueError(f"data/{name} has no {key!r}, which others have; it has {preview([*found])}.")
        if declared is not None and len(found[key]) != int(np.asarray(declared).item()):
            raise ValueError(f"data/{name} says num_samples = {declared}, but {key} has {len(found[key])}.")
        if found[key].id.get_storage_size() == 0:
            raise ValueError(f"data/{name}/{key} of shape {found[key].shape} was never written.")
