"""The real page server with a team of these tests behind it, and a browser in front."""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from playwright.sync_api import Browser, Page, Playwright, expect, sync_playwright
from walking_team import WalkingTeam

from relpos.live.board import BOARD_EVENTS, Board
from relpos.live.requests import RequestHandler
from relpos.live.team_view import Hello
from relpos.measurements import Event, Heading, Observation
from relpos.view.access import Access, listen
from relpos.view.web import WebView

# The shell without windows does the same work with two thirds of the processor time.
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
NO_BROWSER = "no Chromium is installed: `apt-get install chromium`"


def chromium() -> str | None:
    """Path of the system's Chromium."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


@contextmanager
def browser_of(playwright: Playwright) -> Iterator[Browser]:
    """Start the system's Chromium, without a window."""
    # Chromium refuses its sandbox to root.
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    browser = playwright.chromium.launch(
        executable_path=chromium(),
        args=[*arguments, "--autoplay-policy=no-user-gesture-required"],
    )
    try:
        yield browser
    finally:
        browser.close()


class Stage:
    """A session that plays ``team``: its own clock, its views, and the requests it got.

    Its time goes on by itself at ``rate_hz`` pictures a second; ``at_s`` may be moved forward.
    """

    def __init__(self, team: WalkingTeam, port: int = 0, token: str | None = None) -> None:
        self.team = team
        self.rate_hz = 5.0
        self.at_s = 40.0
        self.frozen = False
        self.recorded_unix_s: float | None = None
        """Unix time of second 0 of a recording that is played; None: the team is live."""
        self.hello_name = "Drill at the old mill"
        self.mute = False
        """The server is connected, but not a word comes."""
        self.sent: dict[int, float] = {}
        """When each view was sent, in Unix time."""
        self.observed: list[Observation] = []
        self.acknowledged: list[int] = []
        self.board = Board()
        self.on_replay: Callable[[dict[str, Any]], None] = lambda _: None
        self.started_unix_s = time.time() - self.at_s
        self._listen_port = port
        self._token = token
        self._seq = 0
        self._handler = RequestHandler(lambda unix_s: unix_s - self.started_unix_s)
        self._lock = threading.Lock()
        self._over = threading.Event()
        self.open()
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def reset(self, team: WalkingTeam) -> None:
        """Begin anew with a team that is well."""
        if self.recorded_unix_s is not None:
            self.play_recording(None)
        with self._lock:
            self.team = team
            self.frozen = self.mute = False
            self.observed.clear()
            self.acknowledged.clear()
            self.board = Board()
            if self.web is not None:
                self.web.boarded(self.board.to_message())
        if self.web is None:
            self.open()

    def play_recording(self, recorded_unix_s: float | None) -> None:
        """As if a recording of that time were played behind the same address."""
        self.shut()
        self.recorded_unix_s = recorded_unix_s
        self.open()

    def begin_another_session(self) -> None:
        """As if relpos had been started anew behind the same address."""
        self.shut()
        self.team.names.clear()
        self.started_unix_s += 1.0
        self.open()

    def open(self) -> None:
        """Start serving, at the same address as before."""
        listener, access = listen(f"127.0.0.1:{self._listen_port}")
        self._listen_port = access.port
        if self._token is not None:
            access = Access(access.port, access.hosts, self._token)
        self._token = access.token
        self.access = access
        hello = Hello(
            self.hello_name,
            "/dev/ttyUSB0",
            "bank",
            self.started_unix_s,
            replay=self.recorded_unix_s is not None,
            recorded_unix_s=self.recorded_unix_s,
        )
        self.web: WebView | None = WebView(listener, access, hello)

    def set_board(self, event: dict[str, Any]) -> None:
        """As if somebody else had changed the board."""
        with self._lock:
            self.board.apply({"unix_s": time.time(), "by": "Somebody", **event})
            if self.web is not None:
                self.web.boarded(self.board.to_message())

    def shut(self) -> None:
        """Stop serving; the team goes on."""
        with self._lock:
            web, self.web = self.web, None
        if web is not None:
            web.close()

    def close(self) -> None:
        """End it all."""
        self._over.set()
        self._thread.join()
        self.shut()

    def url(self, path: str = "/") -> str:
        """Address of a page, with the token."""
        return self.access.url(path)

    @property
    def presses(self) -> list[Event]:
        """Landmark presses, as the session has them."""
        return [o for o in self.observed if isinstance(o, Event)]

    @property
    def headings(self) -> list[Heading]:
        """Headings from phones."""
        return [o for o in self.observed if isinstance(o, Heading)]

    def _play(self) -> None:
        before = time.monotonic()
        while not self._over.wait(1.0 / self.rate_hz):
            now = time.monotonic()
            if not self.frozen:
                self.at_s += now - before
            before = now
            with self._lock:
                if self.web is not None and not self.mute:
                    self._seq += 1
                    self.sent[self._seq] = time.time()
                    self.web.updated(self.team.view(self._seq, self.at_s, self.sent[self._seq]))
                    self._serve(self.web)

    def _serve(self, web: WebView) -> None:
        for request in web.requests():
            reply: dict[str, object] = {}
            if request.kind == "presses":
                reply, new = self._handler.presses(request)
                self.observed += new
            elif request.kind == "headings":
                reply, new = self._handler.headings(request)
                self.observed += new
            elif request.kind == "name":
                self.team.names[request.body["node"]] = request.body["name"]
                web.named(self.team.names)
            elif request.kind == "acknowledge":
                self.acknowledged.append(request.body["node"])
                self.team.acknowledged[request.body["node"]] = request.body["by"]
            elif request.kind == "shelve":
                self.team.shelved_s[request.body["node"]] = request.body["seconds"]
            elif request.kind == "replay":
                self.on_replay(request.body)
            elif request.kind in BOARD_EVENTS:
                event = {"nodes": list(range(1, self.team.size + 1)), **request.body}
                if request.kind == "marker" and "node" in event:
                    x_m, y_m, _ = self.team.pose(event["node"], self.at_s)
                    event = {"x_m": x_m, "y_m": y_m, **event}
                self.board.apply({"kind": request.kind, "unix_s": time.time(), **event})
                web.boarded(self.board.to_message())
            web.respond(request, reply)


def wait_for(condition: Callable[[], bool], within_s: float = 60.0) -> None:
    """Wait until it holds; AssertionError where it does not in time."""
    end = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end, "it did not come about in time"
        time.sleep(0.05)


def wait_ready(page: Page) -> None:
    """Wait until a page that has been opened listens to its buttons.

    It does so once its texts are there, which can be after the browser calls it loaded.
    """
    expect(page.locator("#language option")).not_to_have_count(0)


def wait_live(page: Page) -> None:
    """Wait until the page shows that its connection is there."""
    expect(page.locator("#connection")).to_have_attribute("data-state", "live")


def until_held(page: Page) -> None:
    """Wait until a button that is held down has acted, which it does by itself."""
    wait_for(lambda: page.locator(".holding").count() == 0)


__all__ = [
    "Browser",
    "Page",
    "Stage",
    "browser_of",
    "chromium",
    "sync_playwright",
    "until_held",
    "wait_for",
    "wait_live",
    "wait_ready",
]
