"""Whatever visitors send, by any route: refused in words or taken, and the session goes on."""

import asyncio
import json
import time
from types import SimpleNamespace

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from team_input import make_session

from relpos import fusion
from relpos.live.files import FileSink
from relpos.live.inputs import PacedInput
from relpos.live.requests import Request
from relpos.live.team_view import to_json
from relpos.measurements import common_priors, out_of_bounds
from relpos.runs import Description, load_run
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


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    directory = tmp_path_factory.mktemp("out")
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


numbers = st.one_of(
    st.floats(),
    st.integers(),
    st.sampled_from(
        [
            -1e305,
            1e308,
            -1e308,
            1e-300,
            10**400,
            2**63,
            -1,
            0,
            254,
            255,
            1.7e12,
            1e3 * STARTED_UNIX_S,
        ]
    ),
)
texts = st.one_of(
    st.text(alphabet=st.characters(exclude_categories=()), max_size=70),
    st.sampled_from(["\ud800", "\udfff\ud800", "a\x00b", "\x7f", "\u202e", "\\", '"', "=cmd", "]"]),
)
anything = st.recursive(
    st.one_of(st.none(), st.booleans(), numbers, texts),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=8,
)


@st.composite
def bodies(draw, body):
    """A body that is right but for some of its values, keys or items."""
    if isinstance(body, dict):
        made = {key: draw(bodies(value)) for key, value in body.items()}
        if draw(st.integers(0, 9)) == 0:
            made.pop(draw(st.sampled_from(sorted(made))))
        if draw(st.integers(0, 9)) == 0:
            made[draw(texts)] = draw(anything)
        return made
    if isinstance(body, list):
        return [draw(bodies(body[0])) for _ in range(draw(st.integers(0, 3)))]
    if draw(st.integers(0, 2)):
        return body
    if isinstance(body, str):
        return draw(st.one_of(texts, anything))
    return draw(st.one_of(numbers, anything))


requests = st.sampled_from(sorted(BODIES)).flatmap(
    lambda path: st.tuples(
        st.just(path),
        st.one_of(
            bodies(BODIES[path]).map(lambda body: json.dumps(body).encode()),
            st.binary(max_size=200),
            anything.map(lambda body: json.dumps(body).encode()),
        ),
    )
)


@pytest.mark.parametrize("bodies", [400, pytest.param(40_000, marks=pytest.mark.soak)])
def test_no_body_of_any_route_ends_a_session(house, bodies):
    @given(requests)
    @settings(max_examples=bodies, deadline=None, suppress_health_check=list(HealthCheck))
    def visit(sent):
        path, content = sent
        answer = house.send("POST", path, content)
        assert answer.status_code in WELL, answer.text
        assert answer.status_code == 200 or answer.json()["error"]
        assert not house.live._failed

    visit()


@pytest.mark.parametrize("method", ["GET", "POST", "PUT", "DELETE", "PATCH", "OPTIONS", "HEAD"])
@pytest.mark.parametrize(
    "path", ["/", "/phone", "/qr.svg", "/api/picture", "/api/time", "/api/wearers", "/nothing",
             "/static/../server.py", "/static/%2e%2e/server.py", "/api/name/", "//", "/%7f"]
)  # fmt: skip
def test_no_method_of_any_route_ends_a_session(house, method, path):
    answer = house.send(method, path, b"[" * 1000)
    assert answer.status_code in {200, 307, 404, 405, 503}
    assert b"import" not in answer.content[:2000] or "static" not in path
    assert not house.live._failed


def test_what_visitors_sent_is_a_run_that_loads(house):
    house.send("POST", "/api/name", json.dumps({"node": 7, "name": 'Zoë "Z" \\ 漢字'}).encode())
    sent = {**CLOCKS, "presses": [PRESS | {"unix_ms": time.time() * 1e3, "id": "last"}]}
    house.send("POST", "/api/presses", json.dumps(sent | {"sent_unix_ms": None}).encode())
    outcome = house.live.finish()
    assert "no motion was received" in str(outcome.failure)
    run = load_run(house.directory / "received")
    assert run.description.nodes[7].name == 'Zoë "Z" \\ 漢字'
    assert run.events
    assert all(out_of_bounds(o) is None for _, o in house.album.observations)
