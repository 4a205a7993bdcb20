"""The page's server, in a process of its own.

Between it and the session is one socket with a JSON document a line. What comes: ``hello``,
``tracks`` (all of them, once), ``points`` (newest of each track), ``names``, ``picture`` and
``answer``. What goes: what browsers and phones ask for, numbered; the session answers each.
Pictures are handed on as they come, unparsed; a browser that is slow misses some, and no
browser slows anything but itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import socket
import tempfile
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import (
    FileResponse,
    JSONResponse,
    PlainTextResponse,
    Response,
)
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket, WebSocketDisconnect

from relpos.errors import words_of
from relpos.live.board import BOARD_EVENTS
from relpos.live.team_view import MAX_LOG, to_json
from relpos.live.tracks import Tracks
from relpos.said import Said, refusal
from relpos.view.access import Access, Allowance, qr_svg
from relpos.view.bodies import (
    MAX_BODY_BYTES,
    BadRequestError,
    by_of,
    clocks_of,
    items_of,
    node_of,
    number_of,
    read_body,
    read_received,
    sigma_of,
    text_of,
)
from relpos.view.devices import Role
from relpos.view.guard import FORBIDDEN, TokenMiddleware, own_id, role_of
from relpos.view.plans import MAX_IMAGE_BYTES, PlanImages

STATIC = Path(__file__).parent / "static"
PING_S = 2.0
ANSWER_S = 5.0
"""Timeout of the session's answer to a request; then the phone gets an error and asks again."""
TOO_MANY = Said("too-many", "too many at once; try again in a minute")
NO_ANSWER = Said("no-answer", "the session does not answer; try again")
MAX_LINE_BYTES = 1 << 26
ALLOWED = {
    "presses": (20.0, 4000.0),
    "headings": (50.0, 4000.0),
    "name": (2.0, 100.0),
    "acknowledge": (2.0, 100.0),
    "shelve": (2.0, 20.0),
    "replay": (30.0, 300.0),
    "device": (2.0, 50.0),
    "end": (0.2, 5.0),
    "sources": (2.0, 20.0),
    "start": (0.5, 5.0),
    **dict.fromkeys(BOARD_EVENTS, (5.0, 100.0)),
}
"""Items that a visitor may send, per second and at once: a phone sends what it gathered offline."""


class SessionProxy:
    """The session as seen by this process: its last messages, and pending requests."""

    def __init__(self, lines: asyncio.StreamReader, out: asyncio.StreamWriter) -> None:
        self._lines = lines
        self._out = out
        self._asked = 0
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self.hello: str | None = None
        self.view: str | None = None
        self._view_s = 0.0
        self.tracks = Tracks()
        self.names: dict[str, str] = {}
        self.log: deque[dict[str, Any]] = deque(maxlen=MAX_LOG)
        self.logged = 0
        """Lines ever; the newest are in ``log``."""
        self.kept = {"board": '{"type":"board"}'}
        """The newest message of each of these kinds."""
        self.devices: dict[str, dict[str, Any]] = {}
        """Every device that was ever let in, by its id, in a mission."""
        self._news = asyncio.Event()
        self.over = False

    async def listen(self) -> None:
        """Read messages of the session until it ends."""
        with contextlib.suppress(ConnectionError):
            while line := await self._lines.readline():
                self._handle(line.decode())
        self.over = True
        for waiting in self._answers.values():
            waiting.cancel()
        self._notify()

    def _handle(self, line: str) -> None:
        if line.startswith('{"type":"picture"'):
            self.view = line.rstrip("\n")
            self._view_s = time.monotonic()
            self._notify()
            return
        message = json.loads(line)
        match message["type"]:
            case "hello":
                self.hello = line.rstrip("\n")
                self._notify()
            case "tracks":
                self.tracks = Tracks.from_message(message)
            case "points":
                for node, point in message["points"].items():
                    self.tracks.add(int(node), *point)
            case "timeline" | "board" | "smoothed" as kind:
                self.kept[kind] = line.rstrip("\n")
            case "device":
                event = message["event"]
                self.devices.setdefault(event["id"], {}).update(event)
            case "log":
                self.log += message["entries"]
                self.logged += len(message["entries"])
            case "names":
                self.names = message["names"]
            case "answer":
                waiting = self._answers.pop(message["id"], None)
                if waiting is not None and not waiting.done():
                    waiting.set_result(message)

    @property
    def view_age_s(self) -> float | None:
        """How long ago the newest view came."""
        return None if self.view is None else round(time.monotonic() - self._view_s, 2)

    def _notify(self) -> None:
        self._news.set()
        self._news = asyncio.Event()

    async def news(self, seen: str | None, within_s: float) -> str | None:
        """Return the newest view once it differs from ``seen``; None where none comes in time."""
        if self.view is not None and self.view is not seen:
            return self.view
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while not self.over:
                    await self._news.wait()
                    if self.view is not None and self.view is not seen:
                        return self.view
        return None

    async def until_hello(self) -> str | None:
        """The session's greeting; None where it ended before."""
        while self.hello is None and not self.over:
            await self._news.wait()
        return self.hello

    async def ask(self, kind: str, body: Mapping[str, Any]) -> dict[str, Any] | None:
        """Hand a request on; the session's answer, None where none comes in time."""
        self._asked += 1
        number = self._asked
        line = to_json({"id": number, "kind": kind, "unix_s": time.time(), "body": body})
        answer: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        self._answers[number] = answer
        try:
            async with asyncio.timeout(ANSWER_S):
                self._out.write(line.encode() + b"\n")
                await self._out.drain()
                return await answer
        except (TimeoutError, ConnectionError):
            return None
        except asyncio.CancelledError:
            if not answer.cancelled():
                raise
            return None  # The session has ended.
        finally:
            self._answers.pop(number, None)


class Pages:
    """What is served, of one session."""

    def __init__(self, session: SessionProxy, access: Access) -> None:
        self.session = session
        self._access = access
        self._code: str | None = None
        self._plans = PlanImages(access.folder)
        self._allowances = {kind: Allowance(*most) for kind, most in ALLOWED.items()}

    def app(self) -> ASGIApp:
        """The whole application behind its guard."""
        api = [
            Route("/api/picture", self.view),
            Route("/api/time", self.time),
            Route("/api/wearers", self.wearers),
            Route("/api/name", self.name, methods=["POST"]),
            Route("/api/presses", self.presses, methods=["POST"]),
            Route("/api/headings", self.headings, methods=["POST"]),
            Route("/api/acknowledge", self.acknowledge, methods=["POST"]),
            Route("/api/shelve", self.shelve, methods=["POST"]),
            *(Route(f"/api/{kind}", self.change_board, methods=["POST"]) for kind in BOARD_EVENTS),
            Route("/api/image", self.add_plan, methods=["POST"]),
            Route("/api/image/{name}", self.image),
            Route("/api/replay", self.replay, methods=["POST"]),
            Route("/api/end", self.end, methods=["POST"]),
            Route("/api/sources", self.sources),
            Route("/api/start", self.start, methods=["POST"]),
            Route("/api/invite", self.invite),
            Route("/api/devices", self.devices),
            Route("/api/revoke", self.revoke, methods=["POST"]),
        ]
        app = Starlette(
            routes=[
                Route("/", self.page("index.html")),
                Route("/phone", self.page("phone.html")),
                Route("/qr.svg", self.qr),
                # Asked for by browsers whatever a page says.
                Route("/favicon.ico", self.page("icon.svg")),
                *api,
                WebSocketRoute("/ws", self.follow),
                Mount("/static", StaticFiles(directory=STATIC)),
            ],
            exception_handlers={BadRequestError: _refuse},
        )
        return TokenMiddleware(app, self._access, self.session)

    @staticmethod
    def page(name: str) -> Any:
        """A page of ``static``."""

        async def serve(_: Request) -> Response:
            return FileResponse(STATIC / name)

        return serve

    async def qr(self, request: Request) -> Response:
        """The phone page's address, token included, as a QR code; a mission's is new each time."""
        if not self._access.reachable:
            return PlainTextResponse(
                "No phone can reach this session: it listens on this computer alone. "
                "Start it with --view-listen 0.0.0.0 for others to see it.",
                404,
            )
        if self._code is None or self._access.key is not None:
            self._code = qr_svg(self._access.url("/phone", Role.ACKNOWLEDGE, own_id(request)))
        return Response(self._code, media_type="image/svg+xml")

    async def follow(self, socket: WebSocket) -> None:
        """Send hello, the tracks, then every view, or as many as the browser takes.

        To a page, which answers each view (``/ws?answers``), the next one is sent after that: none
        grows old in the network, where megabytes would wait, and come as if they were of now.
        """
        await socket.accept()
        browser = _Browser(socket)
        gone = asyncio.create_task(browser.listen())
        try:
            hello = await self.session.until_hello()
            if hello is None:
                return
            await socket.send_text(hello)
            await socket.send_text(self.session.tracks.to_json())
            you = {"role": str(role_of(socket)), "view_age_s": self.session.view_age_s}
            await socket.send_text(to_json({"type": "you", **you}))
            seen: str | None = None
            told, kept = 0, dict[str, str]()
            while not gone.done() and not self.session.over and not self._is_revoked(socket):
                ready = await browser.is_ready(PING_S)
                newest = await self.session.news(seen, PING_S) if ready else None
                for kind, line in list(self.session.kept.items()):
                    if kept.get(kind) is not line:
                        kept[kind] = line
                        await socket.send_text(line)
                if new := self.session.logged - told:
                    entries, told = list(self.session.log)[-new:], self.session.logged
                    await socket.send_text(to_json({"type": "log", "entries": entries}))
                if newest is not None:
                    seen = newest
                    browser.ready.clear()
                await socket.send_text(newest if newest is not None else '{"type":"ping"}')
        except (WebSocketDisconnect, RuntimeError):
            pass
        finally:
            gone.cancel()
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await socket.close(1001)

    def _is_revoked(self, asking: HTTPConnection) -> bool:
        return bool(self.session.devices.get(own_id(asking), {}).get("revoked", False))

    async def invite(self, request: Request) -> Response:
        """A code for one more device: its address, and how many devices there are."""
        if self._access.key is None:
            return JSONResponse({"error": "only a mission has devices: relpos mission"}, 404)
        role = request.query_params.get("role", str(Role.ACKNOWLEDGE))
        if role not in list(Role):
            raise BadRequestError(f"role: none of {', '.join(Role)}")
        path = "/phone" if role == Role.ACKNOWLEDGE else "/"
        url = self._access.url(path, Role(role), own_id(request))
        reachable = self._access.reachable
        return JSONResponse({"url": url, "svg": qr_svg(url), "reachable": reachable})

    async def devices(self, request: Request) -> Response:
        """All devices that were let in."""
        devices = list(self.session.devices.values())
        return JSONResponse({"own": own_id(request) or None, "devices": devices})

    async def revoke(self, request: Request) -> Response:
        """Shut a device out, for good."""
        body = await read_body(request)
        device = text_of(body, "id", 40)
        if device not in self.session.devices:
            raise BadRequestError("id: no device of this mission")
        return await self._ask(request, "device", {"id": device, "revoked": True})

    async def view(self, _: Request) -> Response:
        """Return the newest view."""
        if self.session.view is None:
            return JSONResponse({"error": "no view yet"}, 503)
        return Response(self.session.view, media_type="application/json")

    async def time(self, _: Request) -> Response:
        """The server's clock, to which a phone refers its own."""
        now_s = time.time()
        session_s = None
        if self.session.view is not None:
            newest = json.loads(self.session.view)
            session_s = newest["time_s"] + now_s - newest["unix_s"]
        return JSONResponse({"unix_ms": now_s * 1000.0, "session_s": session_s})

    async def wearers(self, _: Request) -> Response:
        """Who is there, and who has a phone already."""
        people = [] if self.session.view is None else json.loads(self.session.view)["people"]
        return JSONResponse(
            [
                {
                    "node": person["node"],
                    "name": person["name"],
                    "taken": str(person["node"]) in self.session.names,
                }
                for person in people
                if not person["post"]
            ]
        )

    async def name(self, request: Request) -> Response:
        """Call a node by its wearer's name."""
        body = await read_body(request)
        name = body.get("name")
        if isinstance(name, str):
            # White space of any kind becomes one space; other characters have to be printable.
            body["name"] = " ".join(name.split())
        return await self._ask(
            request, "name", {"node": node_of(body), "name": text_of(body, "name", 40)}
        )

    async def presses(self, request: Request) -> Response:
        """Landmark presses of a phone; those accepted need not be sent again."""
        body = await read_body(request, MAX_BODY_BYTES)
        presses = [
            {
                "id": text_of(press, "id", 64),
                "landmark": text_of(press, "landmark", 64),
                "unix_ms": number_of(press, "unix_ms"),
            }
            for press in items_of(body, "presses")
        ]
        asked = {**clocks_of(body), "presses": presses}
        return await self._ask(request, "presses", asked, len(presses))

    async def headings(self, request: Request) -> Response:
        """Compass headings of a phone, already in the common convention (counter-clockwise)."""
        body = await read_body(request, MAX_BODY_BYTES)
        headings = [
            {
                "unix_ms": number_of(row, "unix_ms"),
                "heading_rad": number_of(row, "heading_rad"),
                "sigma_rad": sigma_of(row),
            }
            for row in items_of(body, "headings")
        ]
        asked = {**clocks_of(body), "headings": headings}
        return await self._ask(request, "headings", asked, len(headings))

    async def acknowledge(self, request: Request) -> Response:
        """Silence somebody's alarm until its reason has gone."""
        body = await read_body(request)
        return await self._ask(request, "acknowledge", {"node": node_of(body), "by": by_of(body)})

    async def change_board(self, request: Request) -> Response:
        """Change the board: an entry, a roll call, a MAYDAY, an evacuation.

        A wearer's phone may answer a roll call and an evacuation, and call MAYDAY.
        """
        kind = request.url.path.rpartition("/")[2]
        body = await read_body(request)
        answers = ("answer", "delivered", "acknowledged")
        own = (kind == "mayday" and body.get("on") is True) or (
            kind in ("rollcall", "evacuate") and body.get("action") in answers
        )
        own = own or (kind == "marker" and body.get("action") == "set")
        if not own and not role_of(request).allows(Role.COMMAND):
            return JSONResponse(refusal(FORBIDDEN), 403)
        if "node" in body:
            body["node"] = node_of(body)
        return await self._ask(request, kind, {**body, "by": by_of(body)})

    async def add_plan(self, request: Request) -> Response:
        """Keep an image, and lay it under the map."""
        if not role_of(request).allows(Role.COMMAND):
            return JSONResponse(refusal(FORBIDDEN), 403)
        if not self._allowances["plan"].take("everybody", 1):
            return JSONResponse(refusal(TOO_MANY), 429)
        too_much = Said(
            "image-large", "an image of more than {most} MB", most=MAX_IMAGE_BYTES >> 20
        )
        data = await read_received(request, MAX_IMAGE_BYTES, too_much)
        try:
            name = self._plans.keep(data)
        except ValueError as error:
            raise BadRequestError(error.args[0]) from None
        except OSError as error:
            return JSONResponse(refusal(words_of(error)), 507)
        return await self._ask(request, "plan", {"action": "set", "image": name, "by": ""})

    async def image(self, request: Request) -> Response:
        """An image that was laid under the map."""
        found = self._plans.find(request.path_params["name"])
        if found is None:
            return PlainTextResponse("no such image", 404)
        return Response(found[0], media_type=found[1])

    async def replay(self, request: Request) -> Response:
        """Move a recording that is played: a moment, a speed, play or pause, the next event."""
        body = await read_body(request)
        asked: dict[str, Any] = {}
        asked |= {name: number_of(body, name) for name in ("at_s", "speed", "step") if name in body}
        if "playing" in body:
            asked["playing"] = float(body["playing"] is True)
        return await self._ask(request, "replay", asked)

    async def shelve(self, request: Request) -> Response:
        """Silence all alarms of a person for a while."""
        body = await read_body(request)
        asked = {"node": node_of(body), "by": by_of(body), "seconds": number_of(body, "seconds")}
        return await self._ask(request, "shelve", asked)

    async def end(self, request: Request) -> Response:
        """End the session; a mission goes on with the next one."""
        body = await read_body(request)
        return await self._ask(request, "end", {"by": by_of(body)})

    async def sources(self, request: Request) -> Response:
        """What a session can be started with."""
        return await self._ask(request, "sources", {})

    async def start(self, request: Request) -> Response:
        """Start a session with a source."""
        body = await read_body(request)
        asked = {"source": text_of(body, "source", 400), "name": text_of(body, "name", 60)}
        return await self._ask(request, "start", {**asked, "common": body.get("common") is True})

    async def _ask(
        self, request: Request, kind: str, body: Mapping[str, Any], items: int = 1
    ) -> Response:
        visitor = request.client.host if request.client else ""
        if not self._allowances[kind].take(visitor, max(items, 1)):
            return JSONResponse(refusal(TOO_MANY), 429)
        try:
            answer = await self.session.ask(kind, body)
        except ValueError:  # Python reads NaN and 1e999, and does not write them.
            raise BadRequestError("a number that JSON does not have") from None
        if answer is None:
            return JSONResponse(refusal(NO_ANSWER), 503)
        return JSONResponse(answer["reply"], answer.get("status", 200))


class _Browser:
    """What a browser says: of a page whatever it sends means that it has the newest view."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._answers = "answers" in socket.query_params
        self.ready = asyncio.Event()
        self.ready.set()

    async def listen(self) -> None:
        """Listen until it has left."""
        while (await self._socket.receive())["type"] != "websocket.disconnect":
            self.ready.set()
        self.ready.set()

    async def is_ready(self, within_s: float) -> bool:
        """Wait for its answer; False where none comes in time."""
        if self._answers:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self.ready.wait(), within_s)
        return self.ready.is_set() or not self._answers


async def _refuse(_: Request, error: Exception) -> Response:
    return JSONResponse(refusal(error.args[0]), 400)


def run(listener: socket.socket, channel: socket.socket, access: Access) -> None:
    """Serve until the session ends."""
    # Ctrl-C in the terminal reaches this process, too; the session decides when it is over.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asyncio.run(_serve(listener, channel, access))


async def _serve(listener: socket.socket, channel: socket.socket, access: Access) -> None:
    lines, out = await asyncio.open_connection(sock=channel, limit=MAX_LINE_BYTES)
    session = SessionProxy(lines, out)
    with _certificate_files(access) as files:
        uvicorn_config = uvicorn.Config(
            Pages(session, access).app(),
            log_level="warning",
            access_log=False,
            lifespan="off",
            ws="auto",
            # Twenty views a second: compressing one would cost more than sending it.
            ws_per_message_deflate=False,
            ws_ping_interval=20.0,
            timeout_graceful_shutdown=1,
            **files,
        )
        uvicorn_config.load()
    server = _Server(uvicorn_config)
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    await session.listen()
    server.should_exit = True
    await serving


class _Server(uvicorn.Server):
    """Without handlers of its own for signals: the session's end ends it."""

    @contextlib.contextmanager
    def capture_signals(self) -> Any:
        yield


@contextlib.contextmanager
def _certificate_files(access: Access) -> Any:
    """The certificate as the files that the TLS library reads, gone as soon as it has."""
    if access.certificate is None:
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix="relpos-") as directory:
        key, chain = Path(directory) / "key.pem", Path(directory) / "chain.pem"
        key.touch(mode=0o600)
        key.write_bytes(access.certificate.key_pem)
        chain.write_bytes(access.certificate.chain_pem)
        yield {"ssl_keyfile": str(key), "ssl_certfile": str(chain)}
