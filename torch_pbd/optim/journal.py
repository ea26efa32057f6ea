"""What optimizations have come to, in their order: what the same work, begun again, goes on from.

Work that is deterministic runs the same optimizations in the same order. Under :func:`recorded` each of them leaves
an entry in a :class:`Journal`: where it is, or what it ended with. Begun again with these entries, those that ended are
not run again, and the one that was cut goes on where it was, so that the end is the same to the last bit.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

State = dict[str, Any]
"""Tensors, numbers, strings and lists of floats, by name."""

_MULTIPLIER = 6364136223846793005  # Knuth's, of the MMIX generator


@dataclass(frozen=True)
class Entry:
    """Where one optimization is."""

    kind: str
    fingerprint: int
    """Of where it started."""
    state: State = field(default_factory=dict)
    """What it goes on from, or ended with; empty before its first iteration."""
    ended: bool = False


class Journal:
    """Entries of optimizations, in their order.

    Parameters
    ----------
    entries : sequence of Entry, default=()
        Of the run that was cut. One that does not match what is begun is dropped, with all that follow.
    write : callable, default=None
        Is given the entries at intervals, to put them on a disk.
    interval : float, default=5.0
        Seconds between two calls of it, at least.
    """

    def __init__(
        self,
        entries: Sequence[Entry] = (),
        write: Callable[[Sequence[Entry]], None] | None = None,
        interval: float = 5.0,
    ) -> None:
        self.entries = list(entries)
        self._write, self._interval = write, interval
        self._position = 0
        self._written_at = time.monotonic()

    def begin(self, kind: str, mark: int) -> int:
        """Index of the next optimization's entry: that of the run that was cut, or a new one."""
        index = self._position
        self._position += 1
        if index < len(self.entries) and (self.entries[index].kind, self.entries[index].fingerprint) != (kind, mark):
            del self.entries[index:]
        if index == len(self.entries):
            self.entries.append(Entry(kind, mark))
        return index

    def keep(self, index: int, state: State, *, ended: bool) -> None:
        """Replace an entry's state, at once: an interrupt finds the old one or the new one; write if it is time to."""
        self.entries[index] = replace(self.entries[index], state=state, ended=ended)
        if self._write is not None and time.monotonic() - self._written_at >= self._interval:
            self.write()

    def write(self) -> None:
        """Write the journal now."""
        if self._write is not None:
            self._write(self.entries)
            self._written_at = time.monotonic()


_journal: ContextVar[Journal | None] = ContextVar("torch_pbd_journal", default=None)


@contextmanager
def recorded(journal: Journal | None) -> Iterator[None]:
    """Optimizations within are recorded in this journal, and go on from its entries; None: in none.

    Like ``torch.no_grad`` this holds for the thread (or task) that enters it.
    """
    token = _journal.set(journal)
    try:
        yield
    finally:
        _journal.reset(token)


class Record:
    """An optimization's side of the journal; without a journal it does nothing.

    Parameters
    ----------
    kind : str
        Of optimization.
    *start : Tensor
        Where it starts: what a record must have started from to be gone on from.
    """

    def __init__(self, kind: str, *start: Tensor) -> None:
        self._journal = _journal.get()
        self._index = 0 if self._journal is None else self._journal.begin(kind, _fingerprint(start))

    @property
    def state(self) -> State:
        """What to go on from; empty at the beginning."""
        return {} if self._journal is None else self._journal.entries[self._index].state

    @property
    def ended(self) -> bool:
        """Whether :attr:`state` is the end."""
        return self._journal is not None and self._journal.entries[self._index].ended

    def keep(self, state: Callable[[], State], *, ended: bool = False) -> None:
        """Keep a state, whose tensors nobody changes later; it is asked for only if there is a journal."""
        if self._journal is not None:
            self._journal.keep(self._index, state(), ended=ended)


def _fingerprint(tensors: tuple[Tensor, ...]) -> int:
    """Number that tells tensors of other shapes or other bits apart, in practice."""
    result = 0
    for tensor in tensors:
        bits = tensor.detach().to(torch.float64).contiguous().view(-1).view(torch.int64)
        mixed = (bits + 1) * (2 * torch.arange(len(bits), device=bits.device) + 1) * _MULTIPLIER  # wraps around
        result = hash((result, tuple(tensor.shape), int((mixed ^ (mixed >> 29)).sum())))
    return result
