"""Runs that go on from the checkpoint of one that was cut."""

import hashlib
import json
import warnings
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
import yaml

import torch_pbd
from torch_pbd.checkpoint import checkpointed, differences, read_checkpoint
from torch_pbd.exceptions import ConfigError

_NOT_THE_WORK = ("output", "checkpoint_interval")


def checkpoint_of_run(
    path: Path, config: str, data: Path | None, *, resume: bool, interval: float
) -> AbstractContextManager[None]:
    """What keeps a run's checkpoint; see :func:`~torch_pbd.checkpoint.checkpointed`.

    Parameters
    ----------
    path : Path
        Of the checkpoint.
    config : str
        The run's options as YAML.
    data : Path or None
        File that it works on.
    resume : bool
        Whether to go on from the checkpoint that is there.
    interval : float
        Seconds between two checkpoints, at least.

    Raises
    ------
    ConfigError
        If the checkpoint is of other work: other options, other data, or other versions.
    ModelFileError
        If it is damaged.
    """
    options: dict[str, Any] = {key: value for key, value in yaml.safe_load(config).items() if key not in _NOT_THE_WORK}
    work = {
        "options": json.dumps(options),
        "data": "" if data is None else hashlib.sha256(data.read_bytes()).hexdigest(),
        "torch_pbd": torch_pbd.__version__,
        "torch": torch.__version__,
    }
    if not resume:
        if path.exists():
            warnings.warn(
                f"{path} of a run that was cut is replaced; with --resume that run would have gone on.", stacklevel=2
            )
        return checkpointed(path, work, interval=interval)
    if not path.exists():
        warnings.warn(f"There is no {path} to resume from: the run begins.", stacklevel=2)
        return checkpointed(path, work, interval=interval)
    done, entries = read_checkpoint(path)
    if changed := differences(work, done):
        raise ConfigError(
            f"resume: {path} is of another run: {'; '.join(changed)}. Give what it had, or begin without --resume."
        )
    return checkpointed(path, work, entries=entries, interval=interval)
