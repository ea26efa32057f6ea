"""The process that learns, so that the robot of the page is never kept waiting; torch is loaded there alone."""

import multiprocessing
import os
import signal
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

Answer = dict[str, Any]


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

    from torch_pbd.playground.desk import Desk

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    Desk(connection).run()
