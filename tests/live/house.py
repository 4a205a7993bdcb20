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
from relpos.live.requests import Request
from relpos.live.team_view import to_json
from relpos.measurements import common_priors
from relpos.runs import Description
from relpos.view.access import Access
from relpos.view.server import ALLOWED, Pages

STARTED_UNIX_S = time.time() - 100.0
BASE = "http://localhost:8460"
WELL = {200, 400, 405}
PRESS = {"id": "a", "landmark": "17", "unix_ms": 1e3 * STARTED_UNIX_S}
HEADING = {"unix_ms": 1e3 * STARTED_UNIX_S, "heading_rad": 1.0, "sigma_rad": 0.2}
CLOCKS = {"node": 1, "clock_offset_ms": 3.0, "sent_unix_ms": 1e3 * STARTED_UNIX_S}
BODIES = {
    "/api/name": {"node": 1, "name": "Kim"},
    "/api/acknowledge": {"node": 1},
    "/api/presses": {**CLOCKS, "presses": [PRESS]},
    "/api/headings": {**CLOCKS, "headings": [HEADING]},
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


class DirectSession(SimpleNamespace):
    """What the serving process sees of the session, without the two processes between them."""

    async def ask(self, kind, body):
        line = to_json({"id": 1, "kind": kind, "unix_s": time.time(), "body": body}).encode()
        asked = json.loads(line)
        request = Request(asked["id"], asked["kind"], asked["unix_s"], asked["body"])
        self.phones.waiting.append(request)
        self.live._update()
        return json.loads(to_json(self.phones.answers.pop()))


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


@contextmanager
def open_house(directory):
    """The server and the session; ``send(method, path, content)`` is a guest's request."""
    visitors = Visitors(directory)
    live, album = make_session(
        NowInput(), lambda p: fusion.make("deadreckoning", p), visitors, priors=common_priors((1,))
    )
    session = DirectSession(
        live=live, phones=visitors, hello=None, view=None, names={}, over=False, tracks=None
    )
    access = Access(8460, ("localhost",))
    pages = Pages(session, access)
    for kind, allowance in pages._allowances.items():
        assert kind in ALLOWED
        allowance._burst = 1e12
    transport = httpx.ASGITransport(pages.app(), raise_app_exceptions=True)
    cookies = {access.cookie: access.token}
    with asyncio.Runner() as runner:
        client = httpx.AsyncClient(transport=transport, base_url=BASE, cookies=cookies)

        def send(method, path, content):
            return runner.run(client.request(method, path, content=content))

        yield SimpleNamespace(send=send, live=live, album=album, directory=directory)
        runner.run(client.aclose())
