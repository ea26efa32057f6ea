"""Results folder of a run: its files, the finished fits, and the page that shows them.

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
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from string import Template
from typing import Any, Self

import numpy as np
from filelock import FileLock, Timeout

import torch_pbd
from torch_pbd import checks
from torch_pbd.exceptions import ConfigError, FolderInUseError
from torch_pbd.files import remove_drafts, replacing

_PACKAGES = ("torch", "scikit-learn", "numpy", "matplotlib")
_PARTS = ("figures", "model", "schedule", "finished")
_SUFFIXES = (".csv", ".html", ".json", ".npz", ".png", ".safetensors", ".txt", ".yaml")  # suffixes of result files
_FINISHED = re.compile(r"[0-9a-f]{64}-\d+\.\d{6}\.safetensors")
_LONGEST = 180  # bytes of a name, to which titles, suffixes and marks of drafts are added: file systems take 255
_DPI = 110  # a figure of 12 inches fills a screen

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


@dataclass
class FinishedFits:
    """Files of fitted models, named by the SHA-256 of all that a fit depends on, and the seconds that it took."""

    folder: Path  # which worker processes write too, made when the first fit ends
    resume: bool = False  # whether the next fit that is asked for should be there

    def files(self, key: str = "") -> list[Path]:
        """Files of all finished fits, or of the fit of a key."""
        return [file for file in self.folder.glob(f"{key}*") if _FINISHED.fullmatch(file.name)]

    def clear(self) -> None:
        """Remove the files, and the folder if nothing else is in it."""
        for file in self.files():
            file.unlink()
        with suppress(OSError):
            self.folder.rmdir()


def fit_once(model: Any, *data: Any, finished: FinishedFits | None = None) -> tuple[Any, float]:
    """Fitted model, loaded or fitted to X, y and groups, or to Demonstrations, and kept; and the seconds of its fit."""
    from torch_pbd.persistence import load, save
    from torch_pbd.persistence.plain import is_ours

    if finished is None or not is_ours(model):  # of other classes there are no files
        return _timed_fit(model, *data)
    key = _key(model, *data)
    found = finished.files(key)
    # The first fit that is asked for tells whether there is anything to resume from.
    if finished.resume and not found:
        checks.warn(f"There is nothing finished to resume from in {finished.folder}: the run begins.")
    finished.resume = False
    if found:
        return load(found[0]), float(found[0].stem.partition("-")[2])
    model, seconds = _timed_fit(model, *data)
    finished.folder.mkdir(exist_ok=True)
    save(model, finished.folder / f"{key}-{seconds:.6f}.safetensors")
    return model, seconds


def _timed_fit(model: Any, *data: Any) -> tuple[Any, float]:
    from torch_pbd.estimators.validation import fit_with_groups

    start = time.perf_counter()
    fitted = model.fit(*data) if len(data) == 1 else fit_with_groups(model, *data)
    return fitted, time.perf_counter() - start


def _key(model: Any, *data: Any) -> str:
    """SHA-256 of class, parameters, versions and data."""
    import torch

    from torch_pbd.persistence import checksum
    from torch_pbd.persistence.plain import encode_parameters

    described = encode_parameters(model) | {"versions": [torch_pbd.__version__, torch.__version__]}
    if len(data) == 1:
        # What rows of demonstrations do not say, names and units, counts too: a controller keeps them.
        (demos,) = data
        described["labels"], data = [demos.names, demos.units, demos.frame, demos.time_unit], demos.stack()
    return checksum(described, {name: np.asarray(array) for name, array in zip("Xyg", data, strict=True)})


class RunFolder:
    """Folder that one run at a time writes; a context manager, which gives it free again.

    One that cannot be made or written (OSError), or that another run writes (FolderInUseError), fails before the work.
    Every file is there whole or as it was before; what a killed run left half written is removed. The finished fits of
    a run that was cut are kept if it is to ``resume``.
    """

    def __init__(self, path: str | Path, settings: Mapping[str, Any], *, resume: bool = False) -> None:
        self.path = Path(path)
        self.finished = FinishedFits(self.path / "finished", resume)
        self.figures: list[Path] = []  # that the run has written so far
        self.path.mkdir(parents=True, exist_ok=True)
        # The operating system frees the lock of a process that is killed.
        self._lock = FileLock(self.path / ".lock", timeout=0)
        try:
            self._lock.acquire()
        except Timeout:
            owner = "another run"
            with suppress(OSError, ValueError, KeyError, TypeError):  # of one that has just begun there is no env.json
                process = json.loads((self.path / "env.json").read_text(encoding="utf-8"))["process"]
                owner = f"process {process['id']} on {process['host']}, since {process['started']}"
            raise FolderInUseError(f"{self.path} is being written by {owner}.") from None
        try:
            for folder in (self.path, *filter(Path.exists, (self.path / part for part in _PARTS))):
                if not folder.is_dir() or not os.access(folder, os.W_OK):
                    raise PermissionError(f"{folder} is no folder, or not writable")
                # What is named as files of results are is to be replaced.
                for entry in folder.iterdir():
                    if entry.suffix in _SUFFIXES and entry.exists() and not entry.is_file():
                        raise IsADirectoryError(f"{entry} stands where a file of results may have to: move it away")
                remove_drafts(folder)
            started = datetime.now(UTC).isoformat(" ", timespec="seconds")
            environment = {
                "torch_pbd": torch_pbd.__version__,
                "python": platform.python_version(),
                "platform": platform.platform(),
                "packages": {package: version(package) for package in _PACKAGES},
                "command": sys.argv,
                "settings": dict(settings),
                "process": {"id": os.getpid(), "host": socket.gethostname(), "started": started},
            }
            self.write_text("env.json", json.dumps(environment, indent=2) + "\n")
            if not resume and self.finished.files():
                what = f"{self.finished.folder} of a run that was cut is cleared"
                checks.warn(f"{what}: --resume would have gone on with it.")
                self.finished.clear()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, error: object, *_: object) -> None:
        if error is None:  # a run that fails or is cut keeps what is finished
            self.finished.clear()
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
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        # A figure with a layout of its own would be laid out twice and drawn twice, which takes as long again.
        if figure.axes and figure.get_layout_engine() is None:
            ConstrainedLayoutEngine().execute(figure)
        target = self._target("figures", f"{name}.png")
        with replacing(target) as file:
            figure.savefig(file, format="png", dpi=_DPI)
        self.figures.append(target)
        return target

    def write_model(self, model: Any, name: str) -> Path:
        """Write ``model/<name>.safetensors``."""
        from torch_pbd.persistence import save

        target = self._target("model", f"{name}.safetensors")
        save(model, target)
        return target

    def write_fitted(self, name: str, model: Any, figure: Any) -> tuple[Path, Path]:
        """Write a fitted model and its figure, to files of its name."""
        return self.write_model(model, slug(name)), self.write_figure(figure, slug(name))

    def write_controller(self, name: str, controller: Any, schedule: Any, **figures: Any) -> None:
        """Write figures, the model, and ``schedule/<name>.npz`` with a row each 10 ms as a table, to be looked at."""
        file = slug(name)
        for what, figure in figures.items():
            self.write_figure(figure, f"{file}_{what}")
        self.write_model(controller, f"{file}_controller")  # the regressor may have a file of the name
        schedule.save(self._target("schedule", f"{file}.npz"))
        schedule.resample(100.0).save(self._target("schedule", f"{file}_100hz.csv"))

    def _target(self, part: str, name: str) -> Path:
        (self.path / part).mkdir(exist_ok=True)
        return self.path / part / name


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


def write_report(folder: RunFolder, command: str, text: str) -> Path:
    """Write ``index.html``, which can be sent by itself: text and figures of a run, and how to go on from its files."""
    figures = []
    for path in folder.figures:
        data = base64.b64encode(path.read_bytes()).decode()
        shows = next(text for part, text in _CAPTIONS.items() if part in path.stem or part == "figure")
        caption = html.escape(f"{path.stem}: {shows}")
        picture = f'<img alt="{caption}" src="data:image/png;base64,{data}">'
        figures.append(f"<figure>{picture}<figcaption>{caption}</figcaption></figure>")
    made = folder.path / "demonstrations.csv"
    steps = [f"torch-pbd {each} --data {made}" for each in ("compare", "experiment") if made.is_file()]
    steps.append(f"torch-pbd {command} --config {folder.path / 'config.yaml'}  # the same again")
    loads = []
    for files, load in (("model/*.safetensors", "load"), ("schedule/*.npz", "control.Schedule.load")):
        loads += [f">>> torch_pbd.{load}({str(path)!r})" for path in sorted(folder.path.glob(files))]
    steps += ["python", *loads] if loads else []
    page = Template(Path(__file__).with_name("report.html").read_text(encoding="utf-8"))
    texts = {"command": command, "text": text, "steps": "\n".join(steps)}
    escaped = {name: html.escape(part) for name, part in texts.items()}
    folder.write_text("index.html", page.substitute(escaped, figures="\n".join(figures)))
    return folder.path / "index.html"
