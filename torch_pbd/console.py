"""Output to a terminal, or to nobody."""

import os
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, TypeVar

_PATIENCE = 2.0  # s without a word, after which a terminal is told what goes on
_ERASE = "\r\x1b[K"

_Item = TypeVar("_Item")


def say(text: str, stream: TextIO | None = None) -> None:
    """Print; once nobody reads, as behind ``| head``, the work goes on without a word.

    Letters that the stream's encoding has not are question marks.
    """
    stream = sys.stdout if stream is None else stream
    encoding, errors = getattr(stream, "encoding", None) or "utf-8", getattr(stream, "errors", None) or "strict"
    errors = "replace" if errors == "strict" else errors
    with _LINE.lock:
        _LINE.erase()
        try:
            print(text.encode(encoding, errors).decode(encoding, errors), file=stream, flush=True)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class _Line:
    """Line of a terminal that says what goes on: written over and over, and erased before anything else is said."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.steps: list[str] = []
        self._is_there, self._last_word = False, 0.0

    def erase(self) -> None:
        if self._is_there:
            print(_ERASE, end="", file=sys.stderr, flush=True)
        self._is_there, self._last_word = False, time.monotonic()

    def write(self, elapsed: float) -> None:
        with self.lock, suppress(OSError):
            if time.monotonic() - self._last_word > _PATIENCE:
                text = ", ".join(self.steps) or "working"
                print(f"{_ERASE}{text}; {elapsed:.0f} s", end="", file=sys.stderr, flush=True)
                self._is_there = True


_LINE = _Line()


@contextmanager
def progress() -> Iterator[None]:
    """Say what goes on (see `steps`) and for how long, whenever a terminal was told nothing for two seconds.

    Where output is piped nothing is said.
    """
    if not (sys.stdout.isatty() and sys.stderr.isatty()):
        yield
        return
    begun, is_over = time.monotonic(), threading.Event()

    def watch() -> None:
        while not is_over.wait(0.5 * _PATIENCE):
            _LINE.write(time.monotonic() - begun)

    watcher = threading.Thread(target=watch, daemon=True)
    _LINE.erase()
    watcher.start()
    try:
        yield
    finally:
        is_over.set()
        watcher.join()
        _LINE.erase()


def steps(items: Iterable[_Item], what: str, n_items: int) -> Iterator[_Item]:
    """So many items, one after another, of which `progress` tells: ``fit 2 of 4``."""
    remaining = iter(items)
    for number in range(1, n_items + 1):
        _LINE.steps.append(f"{what} {number} of {n_items}")
        try:
            yield next(remaining)
        finally:
            _LINE.steps.pop()


class Notes:
    """Shows each warning once, as one line on the standard error."""

    def __init__(self) -> None:
        self._shown: set[str] = set()

    def __call__(self, message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        """Show a warning, in the place of ``warnings.showwarning``."""
        if str(message) not in self._shown:
            self._shown.add(str(message))
            say(f"note ({category.__name__}): {message}", sys.stderr)
