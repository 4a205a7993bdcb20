"""A session and its page's server, without the two processes between them."""

import asyncio
import json
import time
from contextlib import contextmanager
from types import SimpleNamespace

import httpx
from team_input import make_session

from relpos import fusion
from relpos.live.files import FileSink
from relpos.live.inputs import PacedInput
from relpos.live.mission import Resumed
from relpos.live.requests import Request
from relpos.live.team_view import to_json
from relpos.measurements import common_priors
from relpos.runs import Description
from relpos.view.access import Access
from relpos.view.server import ALLOWED, Pages, SessionProxy

STARTED_UNIX_S = time.time() - 100.0
BASE = "http://localhost:8460"
WELL = {200, 400, 404, 405, 409}
PRESS = {"id": "a", "landmark": "17", "unix_ms": 1e3 * STARTED_UNIX_S}
HEADING = {"unix_ms": 1e3 * STARTED_UNIX_S, "heading_rad": 1.0, "sigma_rad": 0.2}
CLOCKS = {"node": 1, "clock_offset_ms": 3.0, "sent_unix_ms": 1e3 * STARTED_UNIX_S}
BODIES = {
    "/api/name": {"node": 1, "name": "Kim"},
    "/api/acknowledge": {"node": 1},
    "/api/presses": {**CLOCKS, "presses": [PRESS]},
    "/api/headings": {**CLOCKS, "headings": [HEADING]},
    "/api/shelve": {"node": 1, "seconds": 60.0, "by": "Kim"},
    "/api/board": {"node": 1, "team": "A", "state": "entered", "air_bar": 200.0},
    "/api/rollcall": {"action": "start", "within_s": 300.0, "node": 1, "answer": "confirmed"},
    "/api/mayday": {"node": 1, "on": True},
    "/api/evacuate": {"action": "order", "node": 1},
    "/api/marker": {"action": "set", "id": "a", "sign": "exit", "x_m": 1.0, "y_m": 2.0},
    "/api/plan": {"action": "set", "image": "a.png", "points": [[1.0, 2.0, 3.0, 4.0]]},
    "/api/image": {"a": "no image"},
    "/api/replay": {"at_s": 1.0, "speed": 2.0, "playing": True},
    "/api/end": {"by": "Kim"},
    "/api/start": {"source": "/dev/ttyUSB0"},
    "/api/revoke": {"id": "a"},
}


class NowInput(PacedInput):
    """A live team that is silent."""

    is_now = True

    def __init__(self):
        super().__init__("nobody", [])

    def read(self, timeout_s):
        return None

    def now_s(self):
        return time.time() - STARTED_UNIX_S


class DirectSession(SessionProxy):
    """What the serving process sees of the session, without the two processes between them."""

    def __init__(self, live, phones):
        super().__init__(None, None)
        self.live, self.phones = live, phones

    async def ask(self, kind, body):
        line = to_json({"id": 1, "kind": kind, "unix_s": time.time(), "body": body}).encode()
        asked = json.loads(line)
        request = Request(asked["id"], asked["kind"], asked["unix_s"], asked["body"])
        self.phones.waiting.append(request)
        self.live._update()
        return json.loads(to_json(self.phones.answers.pop()))

    async def until_hello(self):
        return "{}"

    async def news(self, seen, within_s):
        await asyncio.sleep(0.0)


class Phones:
    def __init__(self):
        self.waiting, self.answers = [], []

    def requests(self):
        asked, self.waiting = self.waiting, []
        return asked

    def respond(self, request, reply, status=200):
        self.answers.append({"reply": reply, "status": status})


class Visitors(FileSink, Phones):
    """The files and the phones of one session."""

    def __init__(self, directory):
        FileSink.__init__(self, directory, Description(name="walk"))
        Phones.__init__(self)


async def _meet(app, path, query, head, messages):
    """What a guest's WebSocket gets that sends so and leaves; whatever fails is raised."""
    waiting = [
        {"type": "websocket.connect"},
        *({"type": "websocket.receive", **message} for message in messages),
        {"type": "websocket.disconnect", "code": 1001},
    ]
    scope = {"type": "websocket", "path": path, "query_string": query, "headers": head,
             "scheme": "ws", "root_path": "", "subprotocols": []}  # fmt: skip
    tasks, sent = [], []

    def begun(loop, work, **options):
        tasks.append(asyncio.Task(work, loop=loop, **options))
        return tasks[-1]

    async def receive():
        return waiting.pop(0)

    async def send(message):
        sent.append(message["type"])

    loop = asyncio.get_running_loop()
    loop.set_task_factory(begun)
    try:
        await app(scope, receive, send)
    finally:
        loop.set_task_factory(None)
    for task in tasks:
        if task.done() and not task.cancelled():
            task.result()
    return sent


class KeptAtOnce:
    """A mission's journal that is safe at once, and takes no more than a line of each request."""

    newest, trouble = 0, None

    def add(self, event):
        assert len((to_json(event) + "\n").encode()) < 200_000, event["kind"]

    def is_safe(self, number):
        return True


@contextmanager
def open_house(directory):
    """The server and the session; ``send(method, path, content)`` is a guest's request."""
    visitors = Visitors(directory)
    live, album = make_session(
        NowInput(), lambda p: fusion.make("deadreckoning", p), visitors, priors=common_priors((1,))
    )
    live.keep(KeptAtOnce(), Resumed())
    session = DirectSession(live, visitors)
    access = Access(8460, ("localhost",), token="a-token-of-this-house")
    pages = Pages(session, access)
    assert pages._allowances.keys() == ALLOWED.keys()
    for allowance in pages._allowances.values():
        allowance._burst = 1e12
    app = pages.app()
    transport = httpx.ASGITransport(app, raise_app_exceptions=True)
    cookies = {access.cookie: access.token}
    with asyncio.Runner() as runner:
        client = httpx.AsyncClient(transport=transport, base_url=BASE, cookies=cookies)

        def send(method, path, content):
            return runner.run(client.request(method, path, content=content))

        def meet(path, query, head, messages):
            return runner.run(_meet(app, path, query, head, messages))

        yield SimpleNamespace(
            send=send, meet=meet, live=live, album=album, directory=directory, cookies=cookies
        )
        runner.run(client.aclose())
