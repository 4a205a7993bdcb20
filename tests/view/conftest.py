"""One browser for each file of these tests, and pages that are watched while they are open."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import expect
from stage import (
    NO_BROWSER,
    Browser,
    Page,
    Stage,
    browser_of,
    chromium,
    sync_playwright,
    wait_ready,
)
from walking_team import WalkingTeam

# Generous: other tests run beside these.
expect.set_options(timeout=60_000)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """The system's Chromium; skipped where there is none.

    Playwright's event loop goes on until it is closed: tests of other files need their own.
    """
    if chromium() is None:
        pytest.skip(NO_BROWSER)
    with sync_playwright() as playwright, browser_of(playwright) as started:
        yield started


@pytest.fixture(scope="module")
def theatre(browser: Browser) -> Iterator[Stage]:
    """One server for a file's tests."""
    stage = Stage(WalkingTeam())
    yield stage
    stage.close()


@pytest.fixture
def stage(theatre: Stage) -> Stage:
    """The server with a team that is well."""
    theatre.reset(WalkingTeam())
    return theatre


OpenPage = Callable[..., Page]


@pytest.fixture
def visit(browser: Browser, stage: Stage) -> Iterator[OpenPage]:
    """Open a page of the stage; at the end none has complained or asked another host."""
    contexts = []
    complaints: list[str] = []

    def visit(path: str = "/", *, expect_gone: bool = False, **options: Any) -> Page:
        options.setdefault("viewport", {"width": 1200, "height": 760})
        init = options.pop("init", None)
        context = options.pop("context", None)
        if context is None:
            context = browser.new_context(**options)
            contexts.append(context)
        page: Page = context.new_page()
        page.set_default_timeout(60_000)
        if init:
            page.add_init_script(init)

        def console(message: Any) -> None:
            gone = any(word in message.text for word in ("ERR_", "WebSocket", "status of"))
            # These tests read the canvas; the page does not.
            ours = "getImageData" in message.text or (expect_gone and gone)
            if message.type in ("error", "warning") and not ours:
                complaints.append(f"{message.type}: {message.text}")

        def request(asked: Any) -> None:
            parts = urlsplit(asked.url)
            if parts.scheme not in ("data", "blob") and parts.netloc != here:
                complaints.append(f"asked another host: {asked.url}")

        here = urlsplit(stage.url()).netloc
        page.on("console", console)
        page.on("pageerror", lambda error: complaints.append(f"exception: {error}"))
        page.on("request", request)
        page.on("websocket", lambda socket: request(socket) if here not in socket.url else None)
        page.goto(stage.url(path))
        wait_ready(page)
        return page

    yield visit
    for context in contexts:
        context.close()
    assert complaints == []
