"""Whatever visitors send, by any route: refused in words or taken, and the session goes on."""

import json
import time

import pytest
from house import BODIES, CLOCKS, PRESS, STARTED_UNIX_S, WELL, open_house
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from relpos.measurements import out_of_bounds
from relpos.runs import load_run


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    with open_house(tmp_path_factory.mktemp("out")) as house:
        yield house


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


# Ten thousand of each route.
@pytest.mark.parametrize(
    "bodies", [400, pytest.param(10_000 * len(BODIES), marks=pytest.mark.soak)]
)
def test_no_body_of_any_route_ends_a_session(house, bodies):
    @given(requests)
    @example(("/api/replay", b"{}"))
    @example(("/api/rollcall", b'{"action": "start", "within_s": 1' + b"0" * 400 + b"}"))
    @example(("/api/board", b'{"node": 1, "x": 1e999}'))
    @example(("/api/mayday", b'{"node": 1, "on": true, "x": "' + b"x" * 300_000 + b'"}'))
    @example(("/api/rollcall", b'{"action": "start", "nodes": [' + b"7," * 200_000 + b"8]}"))
    @example(("/api/board", b'{"node": 1, "x": ' + b"[" * 900 + b"]" * 900 + b"}"))
    @settings(max_examples=bodies, suppress_health_check=list(HealthCheck))
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


@pytest.mark.parametrize(
    ("host", "origin"),
    [(b"localhost:8460", b"http://localhos[:8460"), (b"[::1", b""), (b"[localhost]", b""),
     (b"[1.2.3.4]:8460", b""), (b"", b"")],
)  # fmt: skip
def test_a_host_or_origin_that_is_no_address_is_refused(house, host, origin):
    head = [(b"host", host), (b"origin", origin)]
    assert house.meet("/ws", b"token=a-token-of-this-house", head, []) == ["websocket.close"]


@pytest.mark.parametrize("message", [{"text": "[" * 1000}, {"bytes": b"\xff"}, {"text": "\ud800"}])
def test_whatever_a_browser_sends_by_its_socket_is_ignored(house, message):
    cookie = "; ".join("=".join(pair) for pair in house.cookies.items()).encode()
    head = [(b"host", b"localhost:8460"), (b"cookie", cookie)]
    sent = house.meet("/ws", b"", head, [message])
    assert sent[:2] == ["websocket.accept", "websocket.send"]


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


def test_a_guest_adds_no_person_to_the_team(tmp_path):
    heading = {"unix_ms": 1e3 * time.time(), "heading_rad": 1.0, "sigma_rad": 0.2}
    body = {**CLOCKS, "node": 77, "sent_unix_ms": None, "headings": [heading]}
    with open_house(tmp_path) as house:
        assert house.send("POST", "/api/headings", json.dumps(body).encode()).status_code == 200
        assert house.album.observations == []
        assert house.live.finish().counters["headings_of_unheard_nodes"] == 1
