"""LeRobot's data sets, versions 2 and 3: a folder of Parquet files, and what they hold in meta/."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torch_pbd.data.formats.parquet import open_file, read_columns
from torch_pbd.data.recordings import preview
from torch_pbd.data.wanted import Arguments, Wanted, column_names, natural

_LARGEST_INFO = 2**22  # bytes


def read(path: Path, wanted: Wanted) -> Arguments:
    """Read the format of `torch_pbd.data.load_demonstrations`."""
    opened = partial(open_file, extra="lerobot", what=f"{path.name}, as all of LeRobot,")
    info = _read_info(path / "meta" / "info.json")
    signals = {name: _columns(name, feature) for name, feature in info["features"].items() if _is_number(feature)}
    chosen = wanted.choose(signals, demo="episode_index", time="timestamp", outputs="observation.state")
    if wanted.units is None:
        shown = preview(chosen.names, 6)
        wanted.refuse(
            f"it does not tell the units of {shown}: give units=, 'deg' or 'rad' of joints, 'percent' where they go "
            "from -100 to 100, or one for each."
        )
    # Several episodes a file in version 3, one in version 2; the numbers in the names are in order.
    files = sorted((path / "data").rglob("*.parquet"), key=lambda file: natural(file.relative_to(path).as_posix()))
    if not files:
        raise ValueError("it has no Parquet files in data/.")
    parts = []
    for name in files:
        with opened(name) as file:
            parts.append(read_columns(file, list(dict.fromkeys(["episode_index", *chosen.signals])), wanted))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    _check_lengths(path, columns["episode_index"], opened, wanted)
    return wanted.read_rows(chosen, columns)


def _read_info(path: Path) -> dict[str, Any]:
    if path.stat().st_size > _LARGEST_INFO:
        raise ValueError(f"meta/info.json has more than {_LARGEST_INFO} bytes.")
    info = json.loads(path.read_text(encoding="utf-8"))
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not str(version).startswith(("v2", "v3")) or not isinstance(info.get("features"), dict):
        raise ValueError(f"meta/info.json is of version {version!s:.20}, must be v2 or v3, with features.")
    return info


def _is_number(feature: Any) -> bool:
    """True of a feature that is a number or a vector of some, and no image."""
    return str(feature["dtype"]).startswith(("float", "int", "bool")) and len(feature["shape"]) == 1


def _columns(name: str, feature: dict[str, Any]) -> tuple[str, ...]:
    n, names = feature["shape"][0], feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]}
        names = [entry for entries in names.values() for entry in (entries if isinstance(entries, list) else [entries])]
    # "x" of the state and "x" of the action are two columns.
    if isinstance(names, list) and len(names) == n > 1:
        return tuple(f"{name}.{entry}" for entry in names)
    return column_names(name, n)


def _check_lengths(path: Path, episode: Any, opened: Any, wanted: Wanted) -> None:
    """Check that the episodes are as long as meta/ says: a missing file would be fewer demonstrations."""
    numbers, counts = np.unique(episode, return_counts=True)
    found = dict(zip(numbers.tolist(), counts.tolist(), strict=True))
    declared: dict[int, int] = {}
    for name in (path / "meta" / "episodes").rglob("*.parquet"):
        with opened(name) as file:
            columns = read_columns(file, ["episode_index", "length"], wanted)
            declared |= dict(zip(columns["episode_index"].tolist(), columns["length"].tolist(), strict=True))
    lines = path / "meta" / "episodes.jsonl"
    if lines.is_file():
        entries = map(json.loads, lines.read_text(encoding="utf-8").splitlines())
        declared |= {int(entry["episode_index"]): int(entry["length"]) for entry in entries}
    for number in sorted(declared.keys() | found.keys()):
        if declared.get(number) != found.get(number) and declared:
            raise ValueError(
                f"episode {number} has {found.get(number, 0)} samples in data/, but {declared.get(number, 0)} by "
                "meta/episodes: files are missing or cut."
            )
