"""Every kind of file that this package writes: how it is written, read, and told from others of its kind."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import torch_pbd
from torch_pbd.control import Schedule
from torch_pbd.data import load_demonstrations, save_demonstrations
from torch_pbd.exceptions import DataFormatError, ModelFileError

GOLDEN = Path(__file__).parents[1] / "golden" / "v1"
MODELS = [
    "CholeskyCovRegressor", "WishartProcessRegressor", "HeteroscedasticGPRegressor", "GMMBaseline", "DMPController",
]  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """One kind of file, with the error of files that are not what they seem."""

    name: str
    suffix: str
    error: type[Exception]

    @property
    def content(self) -> bytes:
        """A sound file."""
        return (GOLDEN / f"{self.name}{self.suffix}").read_bytes()

    def read(self, path: Path) -> Any:
        """What the file holds."""
        if self.name == "demonstrations":
            return load_demonstrations(path)
        return Schedule.load(path) if self.name == "schedule" else torch_pbd.load(path)

    def write(self, path: Path) -> None:
        """Save what the sound file holds."""
        held = _held(self)
        if self.name == "demonstrations":
            save_demonstrations(held, path)
        elif self.name == "schedule":
            held.save(path)
        else:
            torch_pbd.save(held, path)

    def says_the_same(self, held: Any) -> bool:
        """Whether this is what the sound file holds, to the bit."""
        if self.name in ("demonstrations", "schedule"):
            return held == _held(self)
        x = np.linspace(0.0, 1.0, 5)[:, np.newaxis]
        return np.array_equal(held.predict(x), _held(self).predict(x))

    def file(self, folder: Path, content: bytes) -> Path:
        """A file of this suffix with this content."""
        path = folder / f"{self.name}{self.suffix}"
        path.write_bytes(content)
        return path


@cache
def _held(kind: Kind) -> Any:
    return kind.read(GOLDEN / f"{kind.name}{kind.suffix}")


KINDS = [
    *(Kind(name, ".safetensors", ModelFileError) for name in MODELS),
    *(Kind("schedule", suffix, ModelFileError) for suffix in (".npz", ".json", ".csv")),
    *(Kind("demonstrations", suffix, DataFormatError) for suffix in (".npz", ".csv")),
]
# A table that people may write holds no checksum: one that is cut or changed may be another sound one.
CHECKED = [kind for kind in KINDS if (kind.name, kind.suffix) != ("demonstrations", ".csv")]


def called(kind: Kind) -> str:
    """Name of a test of this kind."""
    return kind.name if kind.suffix == ".safetensors" else f"{kind.name}{kind.suffix}"
