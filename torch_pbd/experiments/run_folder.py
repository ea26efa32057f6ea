"""The folder a run writes: what was run, on what, and what came out."""

import csv
import json
import platform
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

import torch_pbd
from torch_pbd.control.controller import DMPController
from torch_pbd.estimators._base import CovarianceRegressor
from torch_pbd.persistence import save

_PACKAGES = ("torch", "scikit-learn", "numpy", "matplotlib")


class RunFolder:
    """Writes ``env.json`` at once, so that a folder that cannot be written fails before the work.

    Parameters
    ----------
    path : str or Path
        Made if it is not there; files of an earlier run with the same names are replaced.
    settings : mapping
        Arguments of the run, JSON-able, for ``env.json``.

    Raises
    ------
    OSError
        If the folder cannot be made or written.
    """

    def __init__(self, path: str | Path, settings: Mapping[str, Any]) -> None:
        self.path = Path(path)
        self.path.mkdir(parents=True, exist_ok=True)
        environment = {
            "torch_pbd": torch_pbd.__version__,
            "python": platform.python_version(),
            "platform": platform.platform(),
            "packages": {package: version(package) for package in _PACKAGES},
            "command": sys.argv,
            "settings": dict(settings),
        }
        (self.path / "env.json").write_text(json.dumps(environment, indent=2) + "\n", encoding="utf-8")

    def write_metrics(self, rows: Sequence[Mapping[str, Any]], name: str = "metrics") -> None:
        """Write ``<name>.csv``, the columns those of the first row."""
        with (self.path / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)

    def write_figure(self, figure: Figure, name: str) -> Path:
        """Write ``figures/<name>.png``."""
        target = self.path / "figures" / f"{name}.png"
        target.parent.mkdir(exist_ok=True)
        figure.savefig(target, dpi=150)
        return target

    def write_model(self, model: CovarianceRegressor | DMPController, name: str) -> Path:
        """Write ``model/<name>.safetensors``."""
        target = self.path / "model" / f"{name}.safetensors"
        target.parent.mkdir(exist_ok=True)
        save(model, target)
        return target


def slug(name: str) -> str:
    """Name of a file for the name of a model."""
    return "_".join("".join(letter if letter.isalnum() else " " for letter in name).lower().split())


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
