"""The process that learns, so that the robot of the page is never kept waiting; torch is loaded there alone."""

import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

Answer = dict[str, Any]
_NOTHING = "nothing is learned yet: draw two strokes."


class Worker:
    """Process beside the page's, which is begun again if it ends.

    Parameters
    ----------
    deliver : callable
        Called with the tab and each answer to it, from another thread.
    """

    def __init__(self, deliver: Callable[[int, Answer], None]) -> None:
        self._deliver = deliver
        self._lock = threading.Lock()
        self._is_closed = False
        self._begin()

    def ask(self, tab: int, request: Answer) -> None:
        """Send a request of a tab: the newest of a kind counts."""
        with self._lock:
            try:
                self._connection.send((tab, request))
            except OSError:
                self._deliver(tab, {"type": "error", "text": "the learning process has ended, and is begun again."})

    def close(self) -> None:
        """End the process."""
        self._is_closed = True
        self._process.terminate()
        self._process.join(5.0)

    def _begin(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=work, args=(other,), daemon=True)
        self._process.start()
        other.close()  # so that the end of either process is the end of the pipe
        threading.Thread(target=self._read, args=(self._connection,), daemon=True).start()

    def _read(self, connection: Connection) -> None:
        try:
            while True:
                self._deliver(*connection.recv())
        except (EOFError, OSError):
            if not self._is_closed:
                with self._lock:
                    self._begin()
                self._deliver(-1, {"type": "restarted"})


def work(connection: Connection) -> None:
    """Answer requests until the other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the page's process, which ends this one
    with suppress(AttributeError):  # not on Windows
        os.nice(5)  # the robot's frames come first
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    learned: dict[int, Any] = {}
    fits: dict[int, Iterator[tuple[Any, Answer | None]]] = {}
    connection.send((-1, {"type": "ready"}))
    try:
        while True:
            requests: list[tuple[int, Answer]] = []
            # With nothing to do it waits for a request; between two steps of a fit it only looks for one.
            while connection.poll(None if not (fits or requests) else 0.0):
                requests.append(connection.recv())
            for tab, request in _newest(requests):
                if request["type"] == "close":
                    learned.pop(tab, None)
                    fits.pop(tab, None)
                    continue
                _reply(connection, tab, partial(_serve, tab, request, learned, fits))
            for tab in list(fits):
                _reply(connection, tab, partial(_advance, tab, learned, fits))
    except (EOFError, BrokenPipeError, OSError):
        return


def _newest(requests: list[tuple[int, Answer]]) -> list[tuple[int, Answer]]:
    """Requests without those that a later one of the same tab and kind replaces."""
    # Files that are asked for are all given: none takes the place of another.
    last = {(tab, request["type"]): number for number, (tab, request) in enumerate(requests)}
    return [
        each
        for number, each in enumerate(requests)
        if each[1]["type"] in ("take", "read") or last[each[0], each[1]["type"]] == number
    ]


def _reply(connection: Connection, tab: int, answer: Callable[[], Answer | None]) -> None:
    try:
        found = answer()
    except Exception as error:  # whatever a fit raises is said on the page; a fit that raised is over
        found = {"type": "error", "text": f"{error}" or type(error).__name__}
    if found is not None:
        connection.send((tab, found))


def _advance(tab: int, learned: dict[int, Any], fits: dict[int, Any]) -> Answer | None:
    """Next answer of a fit that goes on."""
    step = next(fits[tab], None)
    if step is None:
        del fits[tab]
        return {"type": "done"}
    learned[tab], answer = step
    return answer


def _file(tab: int, name: str, learned: dict[int, Any]) -> Answer:
    from torch_pbd.playground import learning

    if tab not in learned:
        return {"text": _NOTHING}
    try:
        return {"content": learning.take_home(learned[tab], name)}
    except Exception as error:  # as of a fit
        return {"text": f"{error}" or type(error).__name__}


def _serve(tab: int, request: Answer, learned: dict[int, Any], fits: dict[int, Any]) -> Answer | None:
    from torch_pbd.playground import learning

    kind = request["type"]
    if kind == "learn":
        fits[tab] = learning.learn(request["strokes"], request["settings"])
        return None
    if kind == "read":
        strokes = learning.read_file(request["name"], request["content"])
        rows = [[[t, *p] for t, p in zip(s.time.tolist(), s.position.tolist(), strict=True)] for s in strokes]
        return {"type": "strokes", "strokes": rows}
    if kind == "take":
        return {"type": "file", "ask": request["ask"], **_file(tab, request["name"], learned)}
    if tab not in learned:
        raise ValueError(_NOTHING)
    if kind == "adjust":
        return learning.adjust(learned[tab], request["settings"])
    answer = learning.bend(learned[tab], request["points"])
    return answer if not request["follow"] else {**answer, "then": learning.follow(learned[tab])}
