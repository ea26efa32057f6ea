"""The learning process at work: the newest strokes come first, whatever is being learned of older ones."""

import base64
import os
import signal
import threading
from _thread import interrupt_main
from collections import deque
from functools import partial
from multiprocessing.connection import Connection
from queue import SimpleQueue

import numpy as np

from torch_pbd.playground import learning
from torch_pbd.playground.learning import Answer, Learned, Step


class _Newer(BaseException):
    """A request came while a step of a fit was under way."""


class Desk:
    """What each tab has learned, and the steps of its fit that are still to do.

    A request interrupts the step under way, which begins again unless the request replaces the fit.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._requests: SimpleQueue[tuple[int, Answer]] = SimpleQueue()
        self._learned: dict[int, Learned] = {}
        self._fits: dict[int, tuple[Learned, deque[Step]]] = {}
        self._is_stepping = False
        signal.signal(signal.SIGINT, self._interrupt)
        threading.Thread(target=self._receive, daemon=True).start()

    def run(self) -> None:
        """Answer requests, and with none of them do a step of each fit, for ever."""
        while True:
            requests: list[tuple[int, Answer]] = []
            while not self._requests.empty() or not (requests or self._fits):
                requests.append(self._requests.get())
            for tab, request in _newest(requests):
                self._reply(tab, partial(self._serve, tab, request))
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
        learned, steps = self._fits[tab]
        try:
            self._is_stepping = True
            self._interrupt()
            is_sound = self._reply(tab, steps[0])
        except _Newer:
            return
        if is_sound:
            self._learned[tab] = learned
            steps.popleft()
        if not (is_sound and steps):
            del self._fits[tab]

    def _reply(self, tab: int, make: Step) -> bool:
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
        kind, learned = request["type"], self._learned.get(tab)
        if kind == "close":
            self._learned.pop(tab, None)
            self._fits.pop(tab, None)
            return None
        if kind == "learn":
            self._fits[tab] = learning.learn(request["strokes"], request["settings"])
            return None
        if kind == "read":
            strokes = learning.read_file(request["name"], request["content"])
            return {"type": "strokes", "strokes": [np.column_stack(stroke).tolist() for stroke in strokes]}
        if learned is None:
            raise ValueError("nothing is learned yet: draw two strokes.")
        if kind == "take":
            content = base64.b64encode(learning.take_home(learned, request["name"])).decode()
            return {"type": "file", "name": request["name"], "content": content}
        if kind == "adjust":
            return learning.adjust(learned, request["settings"])
        answer = learning.bend(learned, request["points"])
        return answer if not request["follow"] else {**answer, "then": learning.follow(learned)}


def _newest(requests: list[tuple[int, Answer]]) -> list[tuple[int, Answer]]:
    """Requests without those that a later one of the same tab and kind replaces; files are all given."""
    last = {(tab, request["type"]): number for number, (tab, request) in enumerate(requests)}
    return [
        each
        for number, each in enumerate(requests)
        if each[1]["type"] in ("take", "read") or last[each[0], each[1]["type"]] == number
    ]
