"""The folder a run writes: what was run, on what, and what came out."""

import csv
import io
import json
import os
import platform
import socket
import sys
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from filelock import FileLock, Timeout
from matplotlib.figure import Figure

import torch_pbd
from torch_pbd.control.controller import DMPController
from torch_pbd.estimators.base import CovarianceRegressor
from torch_pbd.exceptions import ConfigError, FolderInUseError
from torch_pbd.experiments.resume import FinishedFits
from torch_pbd.files.atomic import remove_drafts, replacing
from torch_pbd.persistence import save

_PACKAGES = ("torch", "scikit-learn", "numpy", "matplotlib")
_PARTS = ("figures", "model", "schedule", "finished")
_SUFFIXES = (".csv", ".json", ".npz", ".png", ".safetensors", ".txt", ".yaml")  # of the files of results
_LONGEST = 180  # bytes of a name, to which titles, suffixes and marks of drafts are added


class RunFolder:
    """A folder that one run at a time writes; a context manager, which gives it free again.

    It is locked and ``env.json`` is written at once, so that a folder that cannot be written, or that another run
    writes, fails before the work. Every file is there whole or as it was before. What a killed run left half written
    is removed.

    Parameters
    ----------
    path : str or Path
        Made if it is not there; files of an earlier run with the same names are replaced.
    settings : mapping
        Arguments of the run, JSON-able, for ``env.json``.

    Raises
    ------
    FolderInUseError
        If another run, which the message names, writes it.
    OSError
        If the folder cannot be made or written.
    """

    def __init__(self, path: str | Path, settings: Mapping[str, Any]) -> None:
        self.path = Path(path)
        self.finished: FinishedFits | None = None  # where the run keeps its fits, if it does
        self.path.mkdir(parents=True, exist_ok=True)
        # The operating system frees the lock of a process that is killed.
        self._lock = FileLock(self.path / ".lock", timeout=0)
        try:
            self._lock.acquire()
        except Timeout:
            raise FolderInUseError(f"{self.path} is being written by {_owner(self.path)}.") from None
        try:
            for folder in (self.path, *(self.path / part for part in _PARTS if (self.path / part).exists())):
                if not folder.is_dir() or not os.access(folder, os.W_OK):
                    raise PermissionError(f"{folder} is no folder, or not writable")
                _check_files(folder)
                remove_drafts(folder)
            self.write_text("env.json", json.dumps(_environment(settings), indent=2) + "\n")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let another run have the folder."""
        self._lock.release()

    def write_text(self, name: str, text: str) -> None:
        """Write a file of text."""
        with replacing(self.path / name) as file:
            file.write(text.encode())

    def write_metrics(self, rows: Sequence[Mapping[str, Any]], name: str = "metrics") -> None:
        """Write ``<name>.csv``, the columns those of the first row."""
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
        self.write_text(f"{name}.csv", text.getvalue())

    def write_figure(self, figure: Figure, name: str) -> Path:
        """Write ``figures/<name>.png``."""
        target = self.path / "figures" / f"{name}.png"
        target.parent.mkdir(exist_ok=True)
        with replacing(target) as file:
            figure.savefig(file, format="png", dpi=150)
        return target

    def write_model(self, model: CovarianceRegressor | DMPController, name: str) -> Path:
        """Write ``model/<name>.safetensors``."""
        target = self.path / "model" / f"{name}.safetensors"
        target.parent.mkdir(exist_ok=True)
        save(model, target)
        return target


def _check_files(folder: Path) -> None:
    """Check that what is named as files of results are is none but files, which can be replaced."""
    for entry in folder.iterdir():
        if entry.suffix in _SUFFIXES and entry.exists() and not entry.is_file():
            raise IsADirectoryError(f"{entry} stands where a file of results may have to: move it away")


def _environment(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "torch_pbd": torch_pbd.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {package: version(package) for package in _PACKAGES},
        "command": sys.argv,
        "settings": dict(settings),
        "process": {
            "id": os.getpid(),
            "host": socket.gethostname(),
            "started": datetime.now(UTC).isoformat(" ", timespec="seconds"),
        },
    }


def _owner(path: Path) -> str:
    """The run that writes a folder, as its env.json says."""
    try:
        process = json.loads((path / "env.json").read_text(encoding="utf-8"))["process"]
        return f"process {process['id']} on {process['host']}, since {process['started']}"
    except (OSError, ValueError, KeyError, TypeError):  # it has just begun
        return "another run"


def slug(name: str) -> str:
    """Name of a file for the name of a model."""
    return "_".join("".join(letter if letter.isalnum() else " " for letter in name).lower().split())


def check_names(names: Iterable[str], argument: str) -> None:
    """Check that every name of a model gives files of its own.

    Raises
    ------
    ConfigError
        If a name has no letter and no digit, or is too long; if two names give the same files.
    """
    owners: dict[str, str] = {}
    for name in names:
        file = slug(name)
        if not 0 < len(file.encode()) <= _LONGEST:
            raise ConfigError(
                f"{argument}: {name!r:.80} gives no name of a file: it must have a letter or a digit, and at most "
                f"{_LONGEST} bytes. Rename it."
            )
        if file in owners:
            raise ConfigError(
                f"{argument}: {owners[file]!r:.80} and {name!r:.80} would both be written to files named {file!r:.80}, "
                "where one would replace the other: they must differ in letters or digits. Rename one."
            )
        owners[file] = name


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Text table of rows with the same keys; numbers to three digits, what is not known as a dash.

    A column of which nothing is known is left out.
    """
    header = [column for column in rows[0] if any(row[column] == row[column] for row in rows)]
    cells = [[_cell(row[column]) for column in header] for row in rows]
    widths = [max(len(column), *(len(line[i]) for line in cells)) for i, column in enumerate(header)]
    is_text = [isinstance(rows[0][column], str) for column in header]

    def line(entries: Sequence[str]) -> str:
        columns = zip(entries, widths, is_text, strict=True)
        return "  ".join(e.ljust(w) if text else e.rjust(w) for e, w, text in columns).rstrip()

    return "\n".join([line(header), "  ".join("-" * width for width in widths), *map(line, cells)])


def _cell(value: Any) -> str:
    if isinstance(value, float):
        if value != value:
            return "-"
        if 1000 <= abs(value) < 1e5:
            return f"{value:.0f}"
        return f"{value:.2f}" if 0.1 <= abs(value) < 1000 else f"{value:.2e}" if value else "0"
    return str(value)
