"""Who may see a mission's pages: codes that work once, tokens that hold, roles, shutting out."""

from __future__ import annotations

import contextlib
import secrets
import time
from collections.abc import Iterator
from dataclasses import replace

import httpx
import pytest

from relpos.live.team_view import Hello
from relpos.view.access import Access, listen
from relpos.view.devices import INVITATION_S, Device, Gate, Role
from relpos.view.web import WebView

KEY = secrets.token_bytes(32)


def test_a_code_lets_in_one_device_within_five_minutes() -> None:
    gate = Gate(KEY)
    code = gate.invite(Role.LOOK, 1000.0)
    device = gate.admit(code, 1000.0 + INVITATION_S - 1)
    assert device is not None
    assert device.role is Role.LOOK
    assert gate.admit(code, 1001.0) is None, "once"
    assert Gate(KEY, used={device.id}).admit(code, 1001.0) is None, "nor in the next session"
    late = gate.invite(Role.LOOK, 1000.0)
    assert gate.admit(late, 1000.0 + INVITATION_S + 2) is None


def test_a_code_that_was_fetched_by_a_device_ends_when_that_is_shut_out() -> None:
    gate = Gate(KEY)
    code, another = gate.invite(Role.LOOK, by="0f0f"), gate.invite(Role.LOOK, by="1e1e")
    gate.revoked = {"0f0f"}
    assert gate.admit(code) is None
    assert gate.admit(another) is not None
    assert gate.admit(gate.invite(Role.LOOK)) is not None, "of the computer itself"


@pytest.mark.parametrize("index", range(0, 54, 7))
def test_an_altered_token_is_none(index: int) -> None:
    gate = Gate(KEY)
    token = gate.token(Device("0123456789abcdef", Role.LOOK))
    assert gate.device(token) == Device("0123456789abcdef", Role.LOOK)
    other = token[:index] + chr(ord(token[index]) ^ 1) + token[index + 1 :]
    assert gate.device(other) is None
    assert gate.device(token.replace("look", "command")) is None
    assert gate.device(gate.invite(Role.COMMAND)) is None, "a code is no token"
    assert gate.admit(token) is None, "a token is no code"
    assert Gate(b"x" * 32).device(token) is None
    for rubbish in (None, "", ".", "d.", "d..." + "é", "d" * 5000):
        assert gate.device(rubbish) is None


class Mill:
    """A mission's page whose session notes devices, and nothing else."""

    def __init__(self, port: int = 0) -> None:
        listener, access = listen(f"127.0.0.1:{port}")
        self.access: Access = replace(access, key=KEY)
        self.page = WebView(listener, self.access, Hello("m", "p", "bank", time.time()))
        self.events: list[dict[str, object]] = []

    def restarted(self) -> Mill:
        port = self.access.port
        self.page.close()
        again = Mill(port)
        for event in self.events:
            again.page.admitted(event)
        again.events = self.events
        return again

    def serve(self) -> None:
        for request in self.page.requests():
            if request.kind == "device":
                self.events.append(request.body)
                self.page.admitted(request.body)
            self.page.respond(request, {"ok": True})

    def ask(self, method: str, path: str, cookies: httpx.Cookies, **options: object):
        """A request, while the session goes on."""
        from concurrent.futures import ThreadPoolExecutor

        base = f"http://127.0.0.1:{self.access.port}"
        with (
            ThreadPoolExecutor(1) as pool,
            httpx.Client(base_url=base, cookies=cookies, timeout=60.0, verify=False) as client,
        ):
            answer = pool.submit(client.request, method, path, **options)  # type: ignore[arg-type]
            while not answer.done():
                self.serve()
                time.sleep(0.005)
            cookies.update(client.cookies)
            return answer.result()

    def enter(self, role: Role) -> tuple[httpx.Cookies, int]:
        cookies = httpx.Cookies()
        path = self.access.url("/", role=role).partition(str(self.access.port))[2]
        return cookies, self.ask("GET", path, cookies).status_code


@pytest.fixture
def mill() -> Iterator[list[Mill]]:
    """A mission's page in a list, so that a test may restart it."""
    pages = [Mill()]
    yield pages
    with contextlib.suppress(OSError):
        pages[0].page.close()


def test_devices_keep_their_token_and_role_over_a_restart(mill: list[Mill]) -> None:
    page = mill[0]
    commander, status = page.enter(Role.COMMAND)
    assert status == 303
    phone, _ = page.enter(Role.ACKNOWLEDGE)
    viewer, _ = page.enter(Role.LOOK)
    seen = {"node": 1, "by": "Anna"}
    tries = [
        page.ask("POST", "/api/acknowledge", who, json=seen).status_code
        for who in (commander, phone, viewer, httpx.Cookies())
    ]
    assert tries == [200, 200, 403, 401]
    tries = [page.ask("GET", "/api/devices", who).status_code for who in (commander, phone, viewer)]
    assert tries == [200, 403, 403]
    # Each would let in one more phone.
    tries = [page.ask("GET", "/qr.svg", who).status_code for who in (phone, viewer)]
    assert tries == [403, 403]
    page = mill[0] = page.restarted()
    for who in (commander, phone, viewer):
        assert page.ask("GET", "/api/time", who).status_code == 200
    # Shut out: at once, and after another restart.
    listed = page.ask("GET", "/api/devices", commander).json()
    ids = {d["role"]: d["id"] for d in listed["devices"]}
    assert listed["own"] == ids["command"]
    answer = page.ask("POST", "/api/revoke", commander, json={"id": ids["acknowledge"]})
    assert answer.status_code == 200
    assert page.ask("GET", "/api/time", phone).status_code == 401
    page = mill[0] = page.restarted()
    assert page.ask("GET", "/api/time", phone).status_code == 401
    assert page.ask("GET", "/api/time", viewer).status_code == 200


def test_a_code_that_was_used_lets_nobody_in_and_the_next_one_does(mill: list[Mill]) -> None:
    page = mill[0]
    commander, _ = page.enter(Role.COMMAND)
    invited = page.ask("GET", "/api/invite?role=acknowledge", commander).json()
    path = invited["url"].partition(str(page.access.port))[2]
    assert path.startswith("/phone?token=")
    assert "<svg" in invited["svg"]
    assert invited["reachable"] is False, "this page listens on its computer alone"
    assert page.ask("GET", path, httpx.Cookies()).status_code == 303
    assert page.ask("GET", path, httpx.Cookies()).status_code == 401
    other = page.ask("GET", "/api/invite?role=acknowledge", commander).json()["url"]
    assert other != invited["url"]
    # Whoever is in already uses up no code.
    again = other.partition(str(page.access.port))[2]
    assert page.ask("GET", again, commander).status_code == 303
    assert page.ask("GET", again, httpx.Cookies()).status_code == 303
    assert page.ask("GET", "/api/invite?role=king", commander).status_code == 400


def test_whoever_is_shut_out_cannot_come_back_by_a_code_that_was_fetched_before(
    mill: list[Mill],
) -> None:
    page = mill[0]
    commander, _ = page.enter(Role.COMMAND)
    other, _ = page.enter(Role.COMMAND)
    own = page.ask("GET", "/api/devices", other).json()["own"]
    code = page.ask("GET", "/api/invite?role=command", other).json()["url"]
    page.ask("POST", "/api/revoke", commander, json={"id": own})
    path = code.partition(str(page.access.port))[2]
    assert page.ask("GET", path, httpx.Cookies()).status_code == 401
