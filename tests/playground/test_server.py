"""A raw client against the server: who is refused, and that the server lives on."""

import base64
import http.client
import json
from contextlib import ExitStack, closing, contextmanager
from urllib.parse import urlsplit

import pytest

pytest.importorskip("uvicorn", reason="the extra 'playground' is not installed")
sync = pytest.importorskip("websockets.sync.client")
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

from .strokes import make_strokes  # noqa: E402


def get(address, path="", **headers):
    url = urlsplit(address)
    with closing(http.client.HTTPConnection(url.hostname, url.port, timeout=60)) as connection:
        connection.request("GET", url.path + path, headers={"Host": url.netloc, **headers})
        answer = connection.getresponse()
        return answer.status, answer.read(), answer.headers


@contextmanager
def open_page(address, origin="ours"):
    """Socket of a page, after its first message."""
    url = urlsplit(address)
    origin = f"http://{url.netloc}" if origin == "ours" else origin
    with sync.connect(f"ws://{url.netloc}{url.path}live", origin=origin, open_timeout=60) as page:
        assert json.loads(page.recv(60))["type"] == "hello"
        yield page


def ask(page, message, *kinds):
    """First answer of one of these kinds."""
    if message is not None:
        page.send(message if isinstance(message, str) else json.dumps(message))
    while True:
        answer = json.loads(page.recv(120))
        if answer["type"] in kinds:
            return answer


@pytest.mark.slow
def test_strokes_are_learned_bent_followed_and_taken_home(address):
    with open_page(address) as page:
        settings = {"models": ["CholeskyCovRegressor"]}
        picture = ask(page, {"type": "learn", "strokes": make_strokes(), "settings": settings}, "picture")
        assert len(picture["path"]) == 50
        assert ask(page, None, "schedule")["is_guaranteed"]
        robot = ask(page, {"type": "frame", "frame": 7, "hand": [0.5, 0.5], "push": [0, 0]}, "robot")
        assert robot["is_there"]
        assert robot["frame"] == 7
        bent = ask(page, {"type": "bend", "points": [[0.7, 0.4, 0.35]], "follow": True}, "picture", "error")
        assert bent["path"] != picture["path"]
        taken = ask(page, {"type": "take", "name": "demonstrations.csv"}, "file", "error")
        assert base64.b64decode(taken["content"]).startswith(b"demo,time,x,y")
        for name in ("../cli/main.py", "server.py", "nothing", "..%2f..%2fpyproject.toml"):
            assert "name" in ask(page, {"type": "take", "name": name}, "file", "error")["text"]
            assert get(address, name)[0] == 404


@pytest.mark.slow
def test_newer_strokes_do_not_wait_for_what_is_learned_of_older_ones(address):
    with open_page(address) as page:
        fast = {"type": "learn", "strokes": make_strokes(), "settings": {"models": ["CholeskyCovRegressor"]}}
        ask(page, fast, "schedule")  # once the modules are loaded
        slow = {"models": ["HeteroscedasticGPRegressor", "WishartProcessRegressor"]}
        page.send(json.dumps({**fast, "settings": slow}))
        assert ask(page, fast, "picture")["model"] == "CholeskyCovRegressor"
        bent = ask(page, {"type": "bend", "points": [], "follow": False}, "picture", "score")
        assert bent["type"] == "picture"


def test_only_our_own_page_is_answered(address):
    assert get(address)[0] == 200
    assert b"canvas" in get(address)[1]
    assert "default-src 'self'" in get(address)[2]["Content-Security-Policy"]
    url = urlsplit(address)
    bare = f"http://{url.netloc}/"
    for base, headers in (
        (bare, {}), (f"{bare}guess/", {}), (address, {"Host": "evil.example"}),
        (address, {"Host": f"evil.example:{url.port}"}),
        (address, {"Origin": "http://evil.example"}), (address, {"Origin": "null"}),
    ):  # fmt: skip
        assert get(base, **headers)[0] == 403
    for base, origin in (
        (address, "http://evil.example"),
        (address, "null"),
        (address, None),
        (f"{bare}guess/", f"http://{url.netloc}"),
    ):
        with pytest.raises(InvalidStatus), open_page(base, origin):
            pass


def test_noise_and_too_much_of_it_end_no_more_than_the_page(address):
    with open_page(address) as page:
        for i in range(100):
            noise = [
                f"{{{i}",
                "null",
                '{"type": "frame", "hand": "x"}',
                '{"type": "learn", "strokes": 3}',
                '{"type": "shell"}',
            ][i % 5]
            assert ask(page, noise, "error")["text"]
        assert "data" not in ask(page, {"type": "read", "name": "/etc/passwd", "content": ""}, "error")
        with pytest.raises(ConnectionClosed):
            ask(page, {"type": "learn", "strokes": [[[0.001 * i, 0.0, 0.0] for i in range(100_000)]] * 2}, "picture")
    with open_page(address) as page:
        assert not ask(page, {"type": "frame"}, "robot")["is_there"]


def test_a_fifth_page_is_refused_in_words(address):
    url = urlsplit(address)
    with ExitStack() as pages:
        for _ in range(4):
            pages.enter_context(open_page(address))
        with sync.connect(f"ws://{url.netloc}{url.path}live", origin=f"http://{url.netloc}") as fifth:
            assert "4 pages" in json.loads(fifth.recv(30))["text"]
