"""Finished fits of a run, kept in its folder until its good end: a run that was cut need not repeat them.

Importing this module does not load torch: a command says its first line before.
"""

import hashlib
import json
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import torch_pbd
from torch_pbd import checks

_NAME = re.compile(r"[0-9a-f]{64}-\d+\.\d{6}\.safetensors")


@dataclass
class FinishedFits:
    """Folder of fitted models, named by the SHA-256 of all that a fit depends on, and the seconds that it took.

    It is made when the first fit ends. Worker processes write and read it too, each file whole.
    """

    folder: Path
    resume: bool = False
    """True if the next fit that is asked for should be there."""

    def files(self, key: str = "") -> list[Path]:
        """Files of finished fits, one each: of a key, or all."""
        return [file for file in self.folder.glob(f"{key}*") if _NAME.fullmatch(file.name)]

    def clear(self) -> None:
        """Remove the files, and the folder if nothing else is in it."""
        for file in self.files():
            file.unlink()
        with suppress(OSError):
            self.folder.rmdir()


@contextmanager
def finished_fits(folder: Path, *, resume: bool) -> Iterator[FinishedFits]:
    """The finished fits of a run, which begins with those of one that was cut, or with none; cleared at a good end."""
    finished = FinishedFits(folder, resume)
    if not resume and finished.files():
        checks.warn(f"{folder} of a run that was cut is cleared: --resume would have gone on with it.")
        finished.clear()
    # Not where the run fails or is cut: then it keeps what is finished.
    yield finished
    finished.clear()


def fit_once(model: Any, *data: Any, finished: FinishedFits | None = None) -> tuple[Any, float]:
    """The fitted model, loaded or fitted and kept, and the seconds that its fit took.

    The data are X, y and groups, or Demonstrations. What is no class of this package is always fitted.
    """
    from torch_pbd.persistence import load, save
    from torch_pbd.persistence.plain import is_ours

    if finished is None or not is_ours(model):
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
    from torch_pbd.estimators.demonstrations import fit_with_groups

    start = time.perf_counter()
    fitted = model.fit(*data) if len(data) == 1 else fit_with_groups(model, *data)
    return fitted, time.perf_counter() - start


def _key(model: Any, *data: Any) -> str:
    """SHA-256 of class, parameters, versions and data."""
    import torch

    from torch_pbd.persistence.plain import encode_parameters

    # What rows of demonstrations do not say, names and units, counts too: a controller keeps them.
    labels: list[Any] = []
    if len(data) == 1:
        (demos,) = data
        labels, data = [demos.names, demos.units, demos.frame, demos.time_unit], demos.stack()
    described = [encode_parameters(model), torch_pbd.__version__, torch.__version__, labels]
    digest = hashlib.sha256(json.dumps(described, sort_keys=True).encode())
    for array in map(np.asarray, data):
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
