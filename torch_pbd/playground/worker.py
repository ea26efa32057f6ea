"""Process that learns models, so that the robot of the page never waits; only it loads torch."""

import base64
import multiprocessing
import os
import signal
import threading
import warnings
from _thread import interrupt_main
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

Answer = dict[str, Any]


class Worker:
    """The page's side of the process, which is begun again if it ends; ``deliver`` hands answers to a tab, or all."""

    def __init__(self, deliver: Callable[[int | None, Answer], object]) -> None:
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
                self._deliver(None, {"type": "restarted"})


def work(connection: Connection) -> None:
    """Answer requests until the other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the page's process, which ends this one
    with suppress(AttributeError):  # not on Windows
        os.nice(5)  # the robot's frames come first
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    Desk(connection).run()


class _Newer(BaseException):
    """A request came while a step of a fit was under way."""


class Desk:
    """Learned models of each tab, and the fits under way: a request interrupts their step, which begins again after."""

    def __init__(self, connection: Connection) -> None:
        from torch_pbd.playground import learning  # here: it loads torch

        self._learning, self._connection = learning, connection
        self._requests: SimpleQueue[tuple[int, Answer]] = SimpleQueue()
        self._learned: dict[int, learning.Learned] = {}
        self._fits: dict[int, learning.Learned] = {}
        self._is_stepping = False
        signal.signal(signal.SIGINT, self._interrupt)
        threading.Thread(target=self._receive, daemon=True).start()

    def run(self) -> None:
        """Answer requests, and with none of them do a step of each fit, for ever."""
        while True:
            requests: list[tuple[int, Answer]] = []
            while not self._requests.empty() or not (requests or self._fits):
                requests.append(self._requests.get())
            # A later request of the same tab and kind replaces one; files are all given.
            last = {(tab, request["type"]): number for number, (tab, request) in enumerate(requests)}
            for number, (tab, request) in enumerate(requests):
                if request["type"] in ("take", "read") or last[tab, request["type"]] == number:
                    self._reply(tab, lambda tab=tab, request=request: self._serve(tab, request))
            for tab in list(self._fits):
                self._advance(tab)

    def _receive(self) -> None:
        try:
            while True:
                self._requests.put(self._connection.recv())
                interrupt_main(signal.SIGINT)
        except (EOFError, OSError):
            os._exit(0)  # whoever asked is gone, whatever is being learned

    def _interrupt(self, *_: object) -> None:
        if self._is_stepping and not self._requests.empty():  # of Ctrl-C there is none
            self._is_stepping = False
            raise _Newer

    def _advance(self, tab: int) -> None:
        fit = self._fits[tab]
        try:
            self._is_stepping = True
            self._interrupt()
            is_sound = self._reply(tab, fit.steps[0])
        except _Newer:
            return
        if is_sound:
            self._learned[tab] = fit
            fit.steps.popleft()
        if not (is_sound and fit.steps):
            del self._fits[tab]

    def _reply(self, tab: int, make: Callable[[], Answer | None]) -> bool:
        """Send what is made, or in words what is wrong with it; whether it was sound."""
        is_sound = True
        try:
            answer = make()
        except Exception as error:  # whatever a fit raises is said on the page
            answer, is_sound = {"type": "error", "text": f"{error}" or type(error).__name__}, False
        self._is_stepping = False  # an answer is sent as a whole
        if answer is not None:
            self._connection.send((tab, answer))
        return is_sound

    def _serve(self, tab: int, request: Answer) -> Answer | None:
        learning, kind, learned = self._learning, request["type"], self._learned.get(tab)
        if kind == "close":
            self._learned.pop(tab, None)
            self._fits.pop(tab, None)
            return None
        if kind == "learn":
            self._fits[tab] = learning.learn(request["strokes"], request["settings"])
            return None
        if kind == "read":
            return {"type": "strokes", "strokes": learning.read_file(request["name"], request["content"])}
        if learned is None:
            raise ValueError("nothing is learned yet: draw two strokes.")
        if kind == "take":
            content = base64.b64encode(learning.take_home(learned, request["name"])).decode()
            return {"type": "file", "name": request["name"], "content": content}
        if kind == "adjust":
            return learning.adjust(learned, request["settings"])
        answer = learning.bend(learned, request["points"])
        if request["follow"]:
            self._connection.send((tab, answer))
            answer = learning.follow(learned)
        return answer
