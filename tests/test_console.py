"""A terminal is told what goes on; a pipe gets results alone."""

import io
import time
from types import SimpleNamespace

import pytest

from torch_pbd import console


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def terminal(monkeypatch):
    shown = Terminal()
    monkeypatch.setattr(console, "sys", SimpleNamespace(stdout=shown, stderr=shown))
    monkeypatch.setattr(console, "_PATIENCE", -1.0)
    return shown


def test_each_step_and_the_steps_within_are_told(terminal):
    for _ in console.steps("ab", "model", 2):
        for _ in console.steps(iter("xyz"), "fold", 3):
            console._LINE.write(7.4)
    told = [text.split(";")[0] for text in terminal.getvalue().split("\r\x1b[K")[1:]]
    assert told == [f"model {i} of 2, fold {j} of 3" for i in (1, 2) for j in (1, 2, 3)]
    assert terminal.getvalue().endswith("; 7 s")


def test_the_step_of_an_item_that_is_still_being_made_is_told(terminal):
    def make():
        console._LINE.write(0.0)
        yield "a"

    assert next(console.steps(make(), "fold", 3)) == "a"
    assert "fold 1 of 3" in terminal.getvalue()


def test_what_is_said_takes_the_place_of_the_line(terminal):
    console._LINE.write(3.0)
    console.say("result")
    console.say("next")
    assert terminal.getvalue() == "\r\x1b[Kworking; 3 s\r\x1b[Kresult\nnext\n"


def test_a_terminal_that_is_told_nothing_for_a_while_shows_progress(terminal, monkeypatch):
    monkeypatch.setattr(console, "_PATIENCE", 0.01)
    with console.progress():
        until = time.monotonic() + 60.0
        while "working; 0 s" not in terminal.getvalue() and time.monotonic() < until:
            pass
    assert terminal.getvalue().endswith("\r\x1b[K")


def test_a_pipe_is_told_nothing(monkeypatch):
    piped = io.StringIO()
    monkeypatch.setattr(console, "sys", SimpleNamespace(stdout=piped, stderr=Terminal()))
    monkeypatch.setattr(console.threading, "Thread", None)
    with console.progress():
        pass
    assert piped.getvalue() == ""
