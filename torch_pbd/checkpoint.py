"""Where a run's optimizations are, on the disk: what it goes on from after an interrupt, a kill or a power cut."""

import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torch_pbd.checksummed import read_checksummed, write_checksummed
from torch_pbd.optim import Entry, Journal, recorded

FORMAT_VERSION = 1
_KEY = "torch_pbd_checkpoint"

Work = Mapping[str, str]
"""What a run does, by name: a checkpoint is for the same work only."""


@contextmanager
def checkpointed(path: Path, work: Work, *, entries: Sequence[Entry] = (), interval: float = 5.0) -> Iterator[None]:
    """Optimizations within leave a checkpoint at this path: at the beginning, at intervals, and when they are cut.

    It is there whole from the beginning to the end, whatever kills the process, and is removed at a good end. Where
    it cannot be written the work goes on, and one warning says so.

    Parameters
    ----------
    path : Path
    work : mapping of str to str
        What is done.
    entries : sequence of Entry, default=()
        Of :func:`read_checkpoint`, to go on from.
    interval : float, default=5.0
        Seconds between two writes, at least; one follows an iteration of an optimization.
    """

    def write(now: Sequence[Entry]) -> None:
        try:
            write_checkpoint(path, work, now)
        except (OSError, ValueError) as error:
            warnings.warn(f"No checkpoint could be written ({error}): a cut run starts again.", stacklevel=2)

    journal = Journal(entries, write, interval)
    journal.write()
    try:
        with recorded(journal):
            yield
    except BaseException:
        journal.write()
        raise
    with suppress(OSError):  # of a folder in its place it has been told
        path.unlink(missing_ok=True)


def write_checkpoint(path: Path, work: Work, entries: Sequence[Entry]) -> None:
    """Write entries of a journal to one file, which is there whole or as it was before.

    Raises
    ------
    OSError
        If it cannot be written.
    ValueError
        If there are too many entries for a file, some ten thousands.
    """
    arrays, described = {}, []
    for i, entry in enumerate(entries):
        plain = {}
        for name, value in entry.state.items():
            if isinstance(value, torch.Tensor):
                arrays[f"{i} tensor {name}"] = value.detach().cpu().numpy()
            elif isinstance(value, list):
                arrays[f"{i} list {name}"] = np.array(value, dtype=np.float64)
            else:
                plain[name] = value
        described.append([entry.kind, entry.fingerprint, entry.ended, plain])
    header = {"format_version": FORMAT_VERSION, "work": dict(work), "entries": described}
    write_checksummed(path, _KEY, header, arrays)


def read_checkpoint(path: Path) -> tuple[dict[str, str], list[Entry]]:
    """The work that a checkpoint is of, and the entries to go on from.

    Raises
    ------
    FileNotFoundError
        If there is none.
    ModelFileError
        If it is damaged, or of another format.
    """
    header, arrays = read_checksummed(path, _KEY, FORMAT_VERSION)
    states: list[dict[str, Any]] = [dict(plain) for *_, plain in header["entries"]]
    for key, array in arrays.items():
        index, kind, name = key.split(" ", 2)
        states[int(index)][name] = torch.tensor(array) if kind == "tensor" else array.tolist()
    told = zip(header["entries"], states, strict=True)
    return header["work"], [Entry(kind, mark, state, ended) for (kind, mark, ended, _), state in told]


def differences(work: Work, other: Work) -> list[str]:
    """What is different between two pieces of work, a phrase each: "tol was 1e-3, is 1e-4"."""
    mine, others = _flat(work), _flat(other)
    names = [name for name in dict.fromkeys([*mine, *others]) if mine.get(name) != others.get(name)]
    return [f"{name} was {others.get(name, 'not given')}, is {mine.get(name, 'not given')}" for name in names]


def _flat(value: Any, name: str = "") -> dict[str, str]:
    """Values of nested mappings under dotted names; text that is JSON counts as what it says."""
    if isinstance(value, str) and value.startswith("{"):
        value = json.loads(value)
    if not isinstance(value, Mapping):
        return {name: str(value)}
    parts = [_flat(entry, f"{name}.{key}" if name else str(key)) for key, entry in value.items()]
    return {key: entry for part in parts for key, entry in part.items()}
