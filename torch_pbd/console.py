"""Output to a terminal, or to nobody: sentences, tables, and what goes on meanwhile."""

import os
import sys
import textwrap
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, TextIO, TypeVar

_PATIENCE = 2.0  # s without a word, after which a terminal is told what goes on
_ERASE = "\r\x1b[K"
_WIDTH = 80  # columns of the terminals that people start with

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
    """The first ``n_items`` items; `progress` tells which is at work: ``fit 2 of 4``."""
    remaining = iter(items)
    for number in range(1, n_items + 1):
        _LINE.steps.append(f"{what} {number} of {n_items}")
        try:
            yield next(remaining)
        finally:
            _LINE.steps.pop()


def format_table(rows: Sequence[Mapping[str, Any]], width: int = _WIDTH) -> str:
    """Text table of rows with the same keys; numbers to three digits, and a dash for one that is not known.

    A column of which nothing is known is left out. Where the table would be wider than ``width``, the headers take up
    to three lines, and then the longest texts too.
    """
    columns = [column for column in rows[0] if any(row[column] == row[column] for row in rows)]
    texts = {column for column in columns if isinstance(rows[0][column], str)}
    cells = [{column: _cell(row[column]) for column in columns} for row in rows]
    # Headers take more lines until the table fits; what is too much then comes off the longest texts.
    for n_lines in (1, 2, 3):
        widths = {c: max(_header_width(c, n_lines), *(len(row[c]) for row in cells)) for c in columns}
        spare = width - sum(widths.values()) - 2 * (len(columns) - 1)
        if spare >= 0:
            break
    if texts and spare < 0:
        longest = max(texts, key=lambda column: widths[column])
        words = (len(word) for row in cells for word in row[longest].split())
        widths[longest] = max(widths[longest] + spare, len(longest), *words)

    def lines(entries: Mapping[str, str], *, at_bottom: bool = False) -> list[str]:
        wrapped = {c: textwrap.wrap(entries[c], widths[c], break_on_hyphens=False) or [""] for c in columns}
        height = max(map(len, wrapped.values()))
        padded = []
        for column, own in wrapped.items():
            blank, pad = [""] * (height - len(own)), str.ljust if column in texts else str.rjust
            padded.append([pad(part, widths[column]) for part in (blank + own if at_bottom else own + blank)])
        return ["  ".join(line).rstrip() for line in zip(*padded, strict=True)]

    header = lines({c: c for c in columns}, at_bottom=True) + lines({c: "-" * widths[c] for c in columns})
    return "\n".join(header + [line for row in cells for line in lines(row)])


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
