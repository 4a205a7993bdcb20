"""The page's server from outside: who is let in, what is served, what it survives."""

import asyncio
import contextlib
import json
import socket
import ssl
import threading
import time

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from relpos.errors import DeviceError, RelposError
from relpos.live.addresses import parse_listen
from relpos.live.team_view import Hello, Notice, Person, TeamView
from relpos.view.access import Allowance, listen, make_certificate, own_address
from relpos.view.server import SessionProxy
from relpos.view.web import WebView

PATIENCE_S = 60.0


class Stage:
    """A page without a session behind it: this feeds pictures and answers visitors."""

    def __init__(self, *, https=False, people=2):
        listener, access = listen("127.0.0.1:0")
        if https:
            object.__setattr__(access, "certificate", make_certificate(access.hosts))
        self.page = WebView(listener, access, Hello("test", "nowhere", "bank", time.time()))
        self.access = access
        self.people = people
        self.asked = []
        self.answering = True
        self.seq = 0
        self._over = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._feed)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._over.set()
        self._thread.join()
        self.page.close()

    def _feed(self):
        while not self._over.wait(0.02):
            self.seq += 1
            people = tuple(Person(n, f"Node {n}", 1.0 * n, 2.0) for n in range(1, self.people + 1))
            self.page.updated(TeamView(self.seq, 0.02 * self.seq, time.time(), people=people))
            for request in self.page.requests():
                self.asked.append(request)
                if self.answering:
                    self.page.respond(request, {"accepted": ["a"]})

    @property
    def base(self):
        return self.access.url("").split("?")[0]

    def client(self, *, token=True, **options):
        cookies = {self.access.cookie: self.access.token} if token else {}
        # Authorities, which no page over HTTP needs, are loaded for each client.
        options.setdefault("verify", False)
        return httpx.Client(base_url=self.base, timeout=PATIENCE_S, cookies=cookies, **options)

    def socket(self, **options):
        address = self.access.url("/ws").replace("http", "ws", 1)
        return connect(address, open_timeout=PATIENCE_S, **options)


@pytest.fixture(scope="module")
def stage():
    with Stage() as stage:
        yield stage


def pictures(socket):
    while True:
        message = json.loads(socket.recv(timeout=PATIENCE_S))
        if message["type"] == "picture":
            yield message


@pytest.mark.parametrize(
    "path", ["/", "/phone", "/qr.svg", "/api/picture", "/api/time", "/static/"]
)
@pytest.mark.parametrize("token", [None, "", "wrong"])
def test_nothing_is_shown_without_the_token(stage, path, token):
    params = {} if token is None else {"token": token}
    with stage.client(token=False) as client:
        answer = client.get(path, params=params)
    assert answer.status_code == 401
    assert "printed in the terminal" in answer.text
    assert "set-cookie" not in answer.headers


def test_nothing_is_accepted_without_the_token(stage):
    with stage.client(token=False) as client:
        before = len(stage.asked)
        assert client.post("/api/acknowledge", json={"node": 1}).status_code == 401
    address = stage.access.url("/ws").replace("http", "ws", 1).split("?")[0]
    with pytest.raises(InvalidStatus), connect(address, open_timeout=PATIENCE_S):
        pass
    assert len(stage.asked) == before


def test_the_token_becomes_a_cookie_and_leaves_the_address(stage):
    with stage.client(token=False) as client:
        answer = client.get("/phone", params={"token": stage.access.token, "node": "3"})
        assert answer.status_code == 303
        assert answer.headers["location"] == "/phone?node=3"
        cookie = answer.headers["set-cookie"].lower()
        assert "httponly" in cookie
        assert "max-age=86400" in cookie
        assert "samesite=lax" in cookie
        assert client.get("/phone").status_code == 200
        assert "script-src" not in answer.headers["content-security-policy"]
        policy = client.get("/").headers["content-security-policy"]
        own = stage.base.split("//")[1].rstrip("/")
        rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
        assert rules["default-src"] == "'self'"
        assert rules["connect-src"] == f"'self' ws://{own} wss://{own}"
        assert {rules[r] for r in ("base-uri", "form-action", "object-src")} == {"'none'"}


def test_another_sites_page_cannot_use_the_cookie(stage):
    with stage.client() as client:
        elsewhere = {"Origin": "http://elsewhere.example"}
        answer = client.post("/api/acknowledge", json={"node": 1}, headers=elsewhere)
        assert answer.status_code == 401
        own = {"Origin": stage.base.rstrip("/")}
        assert client.post("/api/acknowledge", json={"node": 1}, headers=own).status_code == 200


@pytest.mark.parametrize("host", ["elsewhere.example", "elsewhere.example:8460", "", "a b"])
def test_a_name_that_is_not_this_computers_is_refused(stage, host):
    with stage.client() as client:
        assert client.get("/", headers={"Host": host}).status_code in (400, 421)
        assert client.get("/", headers={"Host": "localhost:1"}).status_code == 200
    assert not stage.access.is_own(host)
    with pytest.raises(InvalidStatus), stage.socket(additional_headers={"Host": host}):
        pass


def test_a_flood_of_one_visitor_is_refused_and_leaves_the_others_alone():
    clock = [0.0]
    allowance = Allowance(20.0, 100.0, lambda: clock[0])
    assert sum(allowance.take("10.0.0.1", 10) for _ in range(1000)) == 10
    assert allowance.take("10.0.0.2", 100)
    clock[0] = 1.0
    assert allowance.take("10.0.0.1", 20)
    assert not allowance.take("10.0.0.1", 1)
    for k in range(2000):
        allowance.take(f"10.1.0.{k}", 1)
    assert allowance.take("10.0.0.1", 100), "long forgotten"


def test_a_flood_of_presses_is_told_to_the_phone(monkeypatch):
    with Stage() as stage, stage.client() as client:
        body = {"node": 1, "clock_offset_ms": 0, "presses": [PRESS] * 2000}
        statuses = [client.post("/api/presses", json=body).status_code for _ in range(4)]
    assert statuses == [200, 200, 429, 429]


def test_a_browser_gets_hello_tracks_and_then_pictures(stage):
    with stage.socket() as socket:
        hello = json.loads(socket.recv(timeout=PATIENCE_S))
        assert (hello["type"], hello["protocol"]) == ("hello", 1)
        assert hello["limits"] == {"still_warning_s": 20.0, "still_alarm_s": 30.0}
        assert json.loads(socket.recv(timeout=PATIENCE_S))["type"] == "tracks"
        first = next(pictures(socket))
    assert [person["node"] for person in first["people"]] == [1, 2]
    assert first["people"][0]["heading_rad"] is None


def test_the_server_reports_time_and_wearers(stage):
    with stage.client() as client:
        reply = client.get("/api/time").json()
        assert reply["unix_ms"] / 1000.0 == pytest.approx(time.time(), abs=30.0)
        assert reply["session_s"] > 0.0
        wearers = client.get("/api/wearers").json()
        assert wearers[1] == {"node": 2, "name": "Node 2", "taken": False}
        stage.page.named({2: "Kim"})
        until_s = time.monotonic() + PATIENCE_S
        while not client.get("/api/wearers").json()[1]["taken"]:
            assert time.monotonic() < until_s


PRESS = {"id": "a", "landmark": "17", "unix_ms": 1.7e12}


def test_a_press_is_accepted_when_the_session_has_it(stage):
    with stage.client() as client:
        body = {"node": 1, "presses": [PRESS], "clock_offset_ms": 3.5, "sent_unix_ms": 1.7e12}
        answer = client.post("/api/presses", json=body)
    assert answer.json() == {"accepted": ["a"]}
    assert stage.asked[-1].kind == "presses"
    assert stage.asked[-1].body == body


@pytest.mark.parametrize(
    ("path", "body", "why"),
    [
        ("presses", b"{", "not JSON"),
        ("presses", b"[]", "not a JSON object"),
        ("presses", {"node": 0, "presses": [], "clock_offset_ms": 0}, "node"),
        ("presses", {"node": 1, "presses": [{}], "clock_offset_ms": 0}, "id"),
        ("presses", {"node": 1, "presses": [PRESS]}, "clock_offset_ms"),
        ("presses", {"node": 1, "presses": [PRESS | {"landmark": "1\n2"}], "clock_offset_ms": 0},
         "landmark"),
        ("presses", {"node": 1, "presses": [PRESS] * 2001, "clock_offset_ms": 0}, "more than"),
        ("presses", b'{"node": 1, "presses": [], "clock_offset_ms": NaN}', "clock_offset_ms"),
        ("headings", {"node": 1, "clock_offset_ms": 0, "headings": [
            {"unix_ms": 1, "heading_rad": 1, "sigma_rad": 0}]}, "sigma_rad"),
        ("name", {"node": 1, "name": "x" * 41}, "name"),
        ("name", {"node": 1, "name": " "}, "name"),
        # Half of a character outside of the basic plane: no file could hold it.
        ("name", b'{"node": 1, "name": "\\ud800"}', "printable"),
        ("name", {"node": 1, "name": "a\x1bb"}, "printable"),
        ("acknowledge", {"node": True}, "node"),
        ("presses", b"[" * 100_000, "not JSON"),
        ("presses", b'{"node":' * 100_000, "not JSON"),
        ("presses", b'{"node": 1, "presses": [], "clock_offset_ms": 1' + b"0" * 400 + b"}",
         "clock_offset_ms"),
        ("presses", b"x" * (1 << 20) + b"x", "bytes"),
        ("acknowledge", b" " * 4097, "bytes"),
    ],
)  # fmt: skip
def test_an_invalid_request_is_refused_in_words(stage, path, body, why):
    with stage.client() as client:
        content = body if isinstance(body, bytes) else json.dumps(body).encode()
        answer = client.post(f"/api/{path}", content=content)
    assert answer.status_code == 400
    assert why in answer.json()["error"]


def test_no_qr_code_leads_phones_to_an_address_that_they_cannot_reach(stage):
    with stage.client() as client:
        answer = client.get("/qr.svg")
    assert answer.status_code == 404
    assert "--view-listen" in answer.text


def test_a_session_that_does_not_answer_is_reported_to_the_phone(stage, monkeypatch):
    stage.answering = False
    try:
        with stage.client() as client:
            answer = client.post("/api/acknowledge", json={"node": 1})
    finally:
        stage.answering = True
    assert answer.status_code == 503


@pytest.mark.soak
def test_ten_browsers_each_get_the_newest_view_and_a_sleeping_one_blocks_no_other(stage):
    with contextlib.ExitStack() as stack:
        # This one never reads.
        stack.enter_context(stage.socket(max_queue=1))
        sockets = [stack.enter_context(stage.socket()) for _ in range(10)]
        readers = [pictures(socket) for socket in sockets]
        for reader in readers:
            first = next(reader)["seq"]
            while next(reader)["seq"] < first + 20:
                pass
        newest = [next(reader)["seq"] for reader in readers]
    assert min(newest) > 20


def test_a_server_that_dies_is_started_again_behind_the_same_address(stage):
    with stage.socket() as socket:
        next(pictures(socket))
        stage.page._process.kill()
        with pytest.raises(ConnectionClosed):
            for _ in pictures(socket):
                pass
    # As a browser does: again and again, with the token that it had.
    until_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            with stage.socket() as socket:
                next(pictures(socket))
            break
        except (OSError, ConnectionClosed):
            assert time.monotonic() < until_s
            time.sleep(0.1)
    assert stage.page.restarts == 1
    assert "was restarted" in stage.page.trouble()
    with stage.client() as client:
        # The new session knows names given by phones, too.
        assert client.get("/api/wearers").status_code == 200


def test_the_cookie_of_https_is_for_https_alone():
    with Stage(https=True) as stage:
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        with stage.client(token=False, verify=context) as client:
            answer = client.get("/", params={"token": stage.access.token})
            assert "secure" in answer.headers["set-cookie"].lower()
            assert client.get("/").status_code == 200
        with stage.socket(ssl=context) as socket:
            next(pictures(socket))


def test_addresses_are_understood_or_refused_in_one_line():
    assert parse_listen("0.0.0.0:80") == ("0.0.0.0", 80)
    assert parse_listen("0.0.0.0")[0] == "0.0.0.0"
    assert parse_listen(":9000")[1] == 9000
    assert parse_listen("9000") == ("127.0.0.1", 9000)
    assert parse_listen("[::1]:9000") == ("::1", 9000)
    with pytest.raises(RelposError, match="HOST:PORT"):
        parse_listen("0.0.0.0:http")
    listener, access = listen("127.0.0.1:0")
    with listener, pytest.raises(DeviceError, match="cannot listen"):
        listen(f"127.0.0.1:{access.port}")


@pytest.mark.parametrize("windows", [True, False])
def test_two_sessions_never_share_a_port(monkeypatch, windows):
    """On Windows SO_REUSEADDR lets a second program bind a port that another listens on."""
    options = []

    class Socket(socket.socket):
        def setsockopt(self, *arguments):
            options.append(arguments)

    monkeypatch.setattr(socket, "socket", Socket)
    if windows:
        monkeypatch.setattr(socket, "SO_EXCLUSIVEADDRUSE", -5, raising=False)
    listener, _ = listen("127.0.0.1:0")
    listener.close()
    option = -5 if windows else socket.SO_REUSEADDR
    assert options == [(socket.SOL_SOCKET, option, 1)]


def test_phones_get_an_address_that_others_can_reach():
    listener, access = listen("0.0.0.0:0")
    with listener:
        if own_address() is not None:
            assert access.reachable
            assert access.hosts[0] == own_address()
        assert access.token in access.url("/phone")


def test_notices_and_names_of_any_kind_are_plain_json():
    view = TeamView(
        1, 2.0, 3.0, notices=(Notice("x", "alarm", 'a "quoted" <b> \u2028 line\n', 1.0),),
        people=(Person(1, "Zoë </script>", 1.0, float("nan")),),
    )  # fmt: skip
    text = view.to_json()
    assert "\n" not in text
    assert json.loads(text)["people"][0]["y_m"] is None


def test_a_session_that_ends_ends_its_pages():
    async def listen():
        lines = asyncio.StreamReader()
        session = SessionProxy(lines, None)
        waiting = asyncio.create_task(session.until_hello())
        await asyncio.sleep(0)
        lines.feed_data(b'{"type":"names","names":{"1":"Kim"}}\n')
        lines.feed_eof()
        await session.listen()
        async with asyncio.timeout(PATIENCE_S):
            assert await waiting is None, "nobody waits for a session that is over"
            assert await session.news(None, PATIENCE_S) is None
        return session

    session = asyncio.run(listen())
    assert session.over
    assert session.names == {"1": "Kim"}


def test_a_page_that_answers_has_one_picture_on_its_way_whatever_the_network_holds_back(stage):
    address = stage.access.url("/ws").replace("http", "ws", 1) + "&answers"
    with connect(address, open_timeout=PATIENCE_S) as page:

        def seqs(until_s):
            end, found = time.monotonic() + until_s, []
            while (left := end - time.monotonic()) > 0:
                with contextlib.suppress(TimeoutError):
                    message = json.loads(page.recv(timeout=left))
                    found += [message["seq"]] if message["type"] == "picture" else []
            return found

        assert len(seqs(1.0)) == 1
        before = stage.seq
        page.send("")
        # The newest one then, not those between.
        assert len(found := seqs(1.0)) == 1
        assert found[0] >= before - 1
