"""Server of the page: loopback only, one secret address, small messages; the robot moves with requested frames."""

import asyncio
import contextlib
import json
import math
import secrets
import socket
import time
import webbrowser
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from torch_pbd import checks
from torch_pbd.console import say
from torch_pbd.control.realtime import RealTimeAdmittance
from torch_pbd.control.schedule import Schedule
from torch_pbd.playground import messages
from torch_pbd.playground.worker import Worker

_PAGE = Path(__file__).with_name("page")
_TABS = 4  # open at a time
_LOOPBACK = "127.0.0.1"
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",  # the address is the secret
    "X-Content-Type-Options": "nosniff",
}

_TICK = 0.001  # s
_LONGEST = 0.1  # s of ticks at a time: after a page that was hidden the robot goes on from where it stood
_REST = 0.8  # s at the end, before the movement begins again
_HAND = 150.0  # N/m of the spring between hand and robot: a hand's own, between relaxed and firm
_STRONGEST = 25.0  # N: what people push robots with


class Robot:
    """Point that moves as :class:`~torch_pbd.control.realtime.RealTimeAdmittance` says, over and over."""

    def __init__(self) -> None:
        self._following: tuple[Schedule, RealTimeAdmittance] | None = None
        self._now = self._rest = self._left = 0.0
        self._desired: Sequence[float] = (0.0, 0.0)

    @staticmethod
    def prepare(schedule: Schedule) -> RealTimeAdmittance:
        """Loop of a schedule, whose table takes longer to lay out than a frame."""
        return RealTimeAdmittance(schedule, soft_start=0.5)

    def follow(self, schedule: Schedule, controller: RealTimeAdmittance | None = None) -> None:
        """Take up a schedule, and its loop, from where the robot is, at the same share of the movement."""
        controller, here, at = controller or self.prepare(schedule), None, 0.0
        if self._following is not None:
            last, before = self._following
            here, at = before.position, min(1.0, before.schedule_time / last.duration) * schedule.duration
        self._following = schedule, controller
        controller.start(self._now, here, at=at)
        self._desired = controller.desired_position

    def advance(self, elapsed: float, hand: tuple[float, float] | None, push: tuple[float, float]) -> dict[str, Any]:
        """State to draw after ``elapsed`` s in which a hand in m, or None, pulled by a spring, and keys pushed in N."""
        if self._following is None:
            return {"type": "robot", "is_there": False}
        schedule, controller = self._following
        self._left += min(elapsed, _LONGEST)
        force = push
        while self._left >= _TICK:
            self._left -= _TICK
            self._now += _TICK
            force, before = _pull(controller.position, hand, push), controller.desired_position
            controller.tick(self._now, force)
            # The loop's desired place is that of the tick's start; the robot has come to its end.
            self._desired = [2.0 * d - b for d, b in zip(controller.desired_position, before, strict=True)]
            self._rest = self._rest + _TICK if controller.schedule_time >= schedule.duration else 0.0
            if self._rest > _REST:
                self._rest = 0.0
                controller.start(self._now)  # at its start: on a way back it would not be where the schedule is
                self._desired = controller.desired_position
        stiffness = np.asarray(controller.stiffness)
        return {
            "type": "robot",
            "is_there": True,
            "time": controller.schedule_time,
            "position": controller.position,
            "desired": self._desired,
            "force": force,
            "stiffness": [stiffness[0, 0], stiffness[0, 1], stiffness[1, 1]],
            "deviation": math.dist(controller.position, self._desired),
            "faults": str(controller.faults) if controller.faults else "",
        }


def _pull(position: Any, hand: tuple[float, float] | None, push: tuple[float, float]) -> tuple[float, float]:
    """Force of the hand's spring and of the keys, no stronger than a person."""
    x, y = push
    if hand is not None:
        x, y = x + _HAND * (hand[0] - position[0]), y + _HAND * (hand[1] - position[1])
    share = min(1.0, _STRONGEST / (math.hypot(x, y) or 1.0))
    return share * x, share * y


class Tab:
    """One page in a browser: its robot, and the socket that answers go to."""

    def __init__(self, page: WebSocket, worker: Worker, number: int) -> None:
        self._page, self._worker, self._number = page, worker, number
        self._robot, self._last = Robot(), time.perf_counter()

    async def answer(self, message: dict[str, Any]) -> None:
        """Do what a message asks for; a ValueError says what is wrong with it."""
        kind, request = message["type"], {"type": message["type"]}
        if kind == "frame":
            hand = messages.as_pair(message.get("hand"), "hand", 10.0)
            push = messages.as_pair(message.get("push"), "push", 100.0) or (0.0, 0.0)
            before, self._last = self._last, time.perf_counter()
            elapsed = 0.0 if message.get("is_paused") else self._last - before
            await self.send({**self._robot.advance(elapsed, hand, push), "frame": message.get("frame")})
            return
        if kind in ("learn", "adjust"):
            request["settings"] = messages.as_settings(message.get("settings", {}))
        if kind == "learn":
            request["strokes"] = messages.as_strokes(message.get("strokes"))
        elif kind == "bend":
            request |= {"points": messages.as_points(message.get("points")), "follow": bool(message.get("follow"))}
        elif kind == "read":
            request["name"], request["content"] = messages.as_file(message)
        elif kind == "take":
            request["name"] = checks.choice(message.get("name"), "name", messages.FILES)
        elif kind != "adjust":
            raise ValueError(f"the page asks for {kind!r:.40}, which is not known here")
        self._worker.ask(self._number, request)

    async def deliver(self, answer: dict[str, Any]) -> None:
        """Hand an answer of the worker on to the page, and its schedule to the robot."""
        if "schedule" in answer:
            schedule = answer.pop("schedule")
            self._robot.follow(schedule, await asyncio.to_thread(self._robot.prepare, schedule))
        await self.send(answer)

    async def send(self, answer: dict[str, Any]) -> None:
        """Send to the page, if it is still there."""
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await self._page.send_text(json.dumps(answer))


class Playground:
    """All pages of the server at a port of the loopback interface, its worker, and its secret."""

    def __init__(self, port: int) -> None:
        self.token = secrets.token_urlsafe(16)
        self._hosts = {f"{name}:{port}" for name in (_LOOPBACK, "localhost")}
        self.address = f"http://{_LOOPBACK}:{port}/{self.token}/"
        self._tabs: dict[int, Tab] = {}
        self._n_tabs = 0

    def application(self) -> Any:
        """ASGI application, which refuses what other pages of the same browser send."""
        routes = [
            Route("/{token}/", self._page),
            Route("/{token}/{name}", self._page),
            WebSocketRoute("/{token}/live", self._live),
        ]
        inner = Starlette(routes=routes, lifespan=self._lifespan)

        async def guarded(scope: Any, receive: Any, send: Any) -> None:
            if scope["type"] == "lifespan" or self._is_ours(scope):
                await inner(scope, receive, send)
            elif scope["type"] == "websocket":
                await receive()
                await send({"type": "websocket.close", "code": 1008})
            else:
                await PlainTextResponse("refused: not the address that was printed.", 403)(scope, receive, send)

        return guarded

    def _is_ours(self, scope: Any) -> bool:
        """Whether a request is to our host, of our page, with our secret.

        A page of another site can send requests here, by any name that leads to this machine: its Origin or its Host
        tell. Sockets have an Origin in every browser.
        """
        headers = {key.decode("latin-1").lower(): value.decode("latin-1") for key, value in scope["headers"]}
        origin = headers.get("origin", "" if scope["type"] == "websocket" else None)
        is_from_us = origin is None or origin.removeprefix("http://") in self._hosts
        token = scope["path"].lstrip("/").partition("/")[0]
        # Compared in constant time: how long a guess takes says nothing of the secret.
        is_secret = secrets.compare_digest(token.encode(), self.token.encode())
        return is_secret and is_from_us and headers.get("host") in self._hosts

    @contextlib.asynccontextmanager
    async def _lifespan(self, _: Starlette) -> AsyncIterator[None]:
        loop = asyncio.get_running_loop()
        self._worker = Worker(lambda tab, answer: asyncio.run_coroutine_threadsafe(self._deliver(tab, answer), loop))
        try:
            yield
        finally:
            self._worker.close()

    async def _deliver(self, number: int | None, answer: dict[str, Any]) -> None:
        """Hand an answer to a tab that is still open, or to all."""
        for tab in [tab for key, tab in self._tabs.items() if number in (key, None)]:
            await tab.deliver(dict(answer))

    async def _page(self, request: Request) -> Response:
        name = request.path_params.get("name", "index.html")
        if name not in {path.name for path in _PAGE.iterdir()}:
            raise HTTPException(404)
        return FileResponse(_PAGE / name, headers=_HEADERS)

    async def _live(self, page: WebSocket) -> None:
        await page.accept()
        if len(self._tabs) >= _TABS:
            text = f"{_TABS} pages are open already: close one, and reload this."
            await page.send_text(json.dumps({"type": "error", "text": text}))
            await page.close()
            return
        self._n_tabs += 1
        number = self._n_tabs
        tab = self._tabs[number] = Tab(page, self._worker, number)
        await tab.send({"type": "hello", "models": messages.MODELS, "files": messages.FILES})
        try:
            while True:
                message = await page.receive()
                if message["type"] == "websocket.disconnect":
                    break
                try:
                    await tab.answer(messages.parse(message.get("text")))
                except (ValueError, TypeError) as error:
                    await tab.send({"type": "error", "text": str(error)})
        finally:
            del self._tabs[number]
            self._worker.ask(number, {"type": "close"})


def serve(port: int = 0, *, browse: bool = True) -> None:
    """Serve the page until Ctrl-C, at a port of the loopback interface (0: a free one); open it in a browser."""
    # asyncio lets small messages wait for each other, up to 40 ms, unless the protocol is named.
    with socket.socket(proto=socket.IPPROTO_TCP) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((_LOOPBACK, port))
        listening.listen()  # whoever opens the address before the first request is answered waits
        playground = Playground(listening.getsockname()[1])
        say(f"playground: {playground.address}\nCtrl-C ends it.")
        config = uvicorn.Config(
            playground.application(), ws="websockets-sansio", ws_max_size=messages.MOST_BYTES, ws_max_queue=64,
            log_level="error", timeout_graceful_shutdown=1,
        )  # fmt: skip
        if browse:
            webbrowser.open(playground.address)
        with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C, which is how it is meant to end
            uvicorn.Server(config).run(sockets=[listening])
        say("\nplayground: ended.")
