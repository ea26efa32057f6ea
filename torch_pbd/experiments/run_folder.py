"""The folder a run writes: its settings and environment, models, metrics and figures; and the page that shows them.

Importing this module does not load torch: a folder that cannot be written is refused before.
"""

import base64
import csv
import html
import io
import json
import os
import platform
import re
import socket
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from string import Template
from typing import Any, Self

from filelock import FileLock, Timeout

import torch_pbd
from torch_pbd.exceptions import ConfigError, FolderInUseError
from torch_pbd.experiments.resume import FinishedFits
from torch_pbd.files.atomic import remove_drafts, replacing

_PACKAGES = ("torch", "scikit-learn", "numpy", "matplotlib")
_PARTS = ("figures", "model", "schedule", "finished")
_SUFFIXES = (".csv", ".html", ".json", ".npz", ".png", ".safetensors", ".txt", ".yaml")  # of the files of results
_LONGEST = 180  # bytes of a name, to which titles, suffixes and marks of drafts are added: file systems take 255
_DPI = 110  # a figure of 12 inches fills a screen
_WIDTH = 80  # columns of the terminals that people start with

_CAPTIONS = {
    "tunnel": "Demonstrations (grey), and mean and two standard deviations of each model along the path: a model is "
    "good where its ellipses are as wide as the demonstrations differ, and no wider.",
    "figure5": "How the parts are connected.",
    "figure6": "The path that the controller reproduces, and how far demonstrations differ from it.",
    "figure7": "Above, standard deviations along the movement, of the demonstrations and as learned; below, the "
    "stiffness made of them: where one is small the other is large.",
    "figure8": "The same push twice, early and late: the robot gives way where demonstrations differed.",
    "recordings": "The recordings, output by output.",
    "figure": "What the model learned, over the data.",
}
"""Caption of a figure, by a part of its name; the last is of all others."""


class RunFolder:
    """A folder that one run at a time writes; a context manager, which gives it free again.

    It is locked, and ``env.json`` with the settings is written at once, so that a folder that cannot be made or written
    (OSError), or that another run writes (FolderInUseError), fails before the work. Every file is there whole or as it
    was before; those of an earlier run are replaced. What a killed run left half written is removed.
    """

    def __init__(self, path: str | Path, settings: Mapping[str, Any]) -> None:
        self.path = Path(path)
        self.finished: FinishedFits | None = None  # where the run keeps its fits, if it does
        self.figures: list[Path] = []  # that the run has written so far
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
                # What is named as files of results are is to be replaced.
                for entry in folder.iterdir():
                    if entry.suffix in _SUFFIXES and entry.exists() and not entry.is_file():
                        raise IsADirectoryError(f"{entry} stands where a file of results may have to: move it away")
                remove_drafts(folder)
            self.write_text("env.json", json.dumps(_environment(settings), indent=2) + "\n")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
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

    def write_figure(self, figure: Any, name: str) -> Path:
        """Write ``figures/<name>.png``."""
        target = self.path / "figures" / f"{name}.png"
        target.parent.mkdir(exist_ok=True)
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        # A figure with a layout of its own would be laid out twice and drawn twice, which takes as long again.
        if figure.axes and figure.get_layout_engine() is None:
            ConstrainedLayoutEngine().execute(figure)
        with replacing(target) as file:
            figure.savefig(file, format="png", dpi=_DPI)
        self.figures.append(target)
        return target

    def write_model(self, model: Any, name: str) -> Path:
        """Write ``model/<name>.safetensors``."""
        from torch_pbd.persistence import save

        target = self.path / "model" / f"{name}.safetensors"
        target.parent.mkdir(exist_ok=True)
        save(model, target)
        return target

    def write_controller(self, name: str, controller: Any, schedule: Any, **figures: Any) -> None:
        """Write figures, the model, and ``schedule/<name>.npz`` with a row each 10 ms as a table, to be looked at."""
        file, target = slug(name), self.path / "schedule"
        for what, figure in figures.items():
            self.write_figure(figure, f"{file}_{what}")
        self.write_model(controller, f"{file}_controller")  # the regressor may have a file of the name
        target.mkdir(exist_ok=True)
        schedule.save(target / f"{file}.npz")
        schedule.resample(100.0).save(target / f"{file}_100hz.csv")


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
    return "_".join(re.findall(r"[^\W_]+", name.lower()))


def check_names(names: Iterable[str], argument: str) -> None:
    """Check that every name of a model gives files of its own."""
    owners: dict[str, str] = {}
    for name in names:
        file = slug(name)
        if not 0 < len(file.encode()) <= _LONGEST:
            must = f"it must have a letter or a digit, and at most {_LONGEST} bytes"
            raise ConfigError(f"{argument}: {name!r:.80} gives no name of a file: {must}. Rename it.")
        if file in owners:
            raise ConfigError(
                f"{argument}: {owners[file]!r:.80} and {name!r:.80} would both be written to files named {file!r:.80}, "
                "must differ in letters or digits: rename one."
            )
        owners[file] = name


def format_table(rows: Sequence[Mapping[str, Any]], width: int = _WIDTH) -> str:
    """Text table of rows with the same keys; numbers to three digits, and a dash for one that is not known.

    A column of which nothing is known is left out. Where the table would be wider than ``width``, the headers take up
    to three lines, and then the longest texts too.
    """
    columns = [column for column in rows[0] if any(row[column] == row[column] for row in rows)]
    texts = {column for column in columns if isinstance(rows[0][column], str)}
    cells = {column: [_cell(row[column]) for row in rows] for column in columns}
    # Headers take more lines until the table fits; what is too much then comes off the longest texts.
    for n_lines in (1, 2, 3):
        widths = {column: max(_header_width(column, n_lines), *map(len, cells[column])) for column in columns}
        spare = width - sum(widths.values()) - 2 * (len(columns) - 1)
        if spare >= 0:
            break
    longest = max(texts, key=lambda column: widths[column], default=None)
    if longest and spare < 0:
        words = (len(word) for cell in cells[longest] for word in cell.split())
        widths[longest] = max(widths[longest] + spare, len(longest), *words)

    def lines(entries: Mapping[str, str], *, at_bottom: bool = False) -> list[str]:
        wrapped = [textwrap.wrap(entries[c], widths[c], break_on_hyphens=False) or [""] for c in columns]
        height = max(map(len, wrapped))
        blanks = [[""] * (height - len(own)) for own in wrapped]
        full = [blank + own if at_bottom else own + blank for own, blank in zip(wrapped, blanks, strict=True)]
        pads = [str.ljust if c in texts else str.rjust for c in columns]
        padded = [[pad(e, widths[c]) for e in own] for c, own, pad in zip(columns, full, pads, strict=True)]
        return ["  ".join(line).rstrip() for line in zip(*padded, strict=True)]

    header = lines({c: c for c in columns}, at_bottom=True) + lines({c: "-" * widths[c] for c in columns})
    return "\n".join(header + [line for i in range(len(rows)) for line in lines({c: cells[c][i] for c in columns})])


def _header_width(header: str, n_lines: int) -> int:
    longest = max(map(len, header.split()), default=1)
    widths = range(longest, max(longest, len(header)) + 1)
    return next(width for width in widths if len(textwrap.wrap(header, width, break_on_hyphens=False)) <= n_lines)


def _cell(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    size = abs(value)
    if value != value or not value:
        return "-" if value else "0"
    if 0.1 <= size < 1e5:
        return f"{value:.2f}" if size < 100.0 else f"{value:.0f}"
    return f"{value:.2g}" if 1e-3 <= size < 0.1 else f"{value:.2e}"


def write_report(folder: RunFolder, command: str, text: str) -> Path:
    """Write ``index.html``: the text of a run, its figures inside, and commands that go on from its files.

    Nothing in it is read from elsewhere, so that the page can be sent by itself.
    """
    figures = []
    for path in folder.figures:
        data = base64.b64encode(path.read_bytes()).decode()
        shows = next(text for part, text in _CAPTIONS.items() if part in path.stem or part == "figure")
        caption = html.escape(f"{path.stem}: {shows}")
        picture = f'<img alt="{caption}" src="data:image/png;base64,{data}">'
        figures.append(f"<figure>{picture}<figcaption>{caption}</figcaption></figure>")
    texts = {"command": command, "text": text, "steps": "\n".join(_next_steps(folder.path, command))}
    page = Template(Path(__file__).with_name("report.html").read_text(encoding="utf-8"))
    escaped = {name: html.escape(part) for name, part in texts.items()}
    folder.write_text("index.html", page.substitute(escaped, figures="\n".join(figures)))
    return folder.path / "index.html"


def _next_steps(folder: Path, command: str) -> Iterable[str]:
    """Commands and lines of Python for the files that a run has left."""
    if (folder / "demonstrations.csv").is_file():
        yield f"torch-pbd compare --data {folder / 'demonstrations.csv'}"
        yield f"torch-pbd experiment --data {folder / 'demonstrations.csv'}"
    yield f"torch-pbd {command} --config {folder / 'config.yaml'}  # the same again"
    models, schedules = sorted((folder / "model").glob("*.safetensors")), sorted((folder / "schedule").glob("*.npz"))
    if models or schedules:
        yield "python"
    for path in models:
        yield f">>> torch_pbd.load({str(path)!r})"
    for path in schedules:
        yield f">>> torch_pbd.control.Schedule.load({str(path)!r})"
