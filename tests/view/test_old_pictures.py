"""An old picture is told as old whatever clocks, networks and slow devices do."""

from __future__ import annotations

import re
from typing import Any

from playwright.sync_api import Page, expect
from stage import Stage, wait_for, wait_live

CLOCK = """window.offMs = 0; const real = Date.now.bind(Date);
    Date.now = () => real() + window.offMs;"""
HOUR_MS = 3_600_000
# How old each picture is when the page begins with it; then the page is busy for so long.
SLOW = """window.agesS = []; const Real = WebSocket;
    window.WebSocket = class extends Real {
        constructor(address) {
            super(address);
            this.addEventListener("message", ({ data }) => {
                if (!data.startsWith('{"type":"picture"')) return;
                window.agesS.push(Date.now() / 1000 - JSON.parse(data).unix_s);
                for (const end = performance.now() + 250; performance.now() < end;);
            });
        }
    };"""
COUNTED = """window.pictures = 0; const Real = WebSocket;
    window.WebSocket = class extends Real {
        constructor(address) {
            super(address);
            this.addEventListener("message", ({ data }) => {
                window.pictures += data.startsWith('{"type":"picture"');
            });
        }
    };"""
# A network in which every message takes three seconds.
FAR = """const Real = WebSocket;
    window.WebSocket = class extends Real {
        set onmessage(hear) {
            this.addEventListener("message", (event) => setTimeout(() => hear(event), 3000));
        }
    };"""


def expect_lost(page: Page) -> None:
    expect(page.locator("#link")).to_be_visible(timeout=15_000)
    assert page.title().startswith("NO CONNECTION")
    expect(page.locator("#count")).to_have_text("(0 of 6 heard)")


def test_a_clock_that_is_set_back_makes_no_old_picture_look_live(visit: Any, stage: Stage) -> None:
    for path in ("/", "/phone"):
        stage.mute = False
        page = visit(path, init=CLOCK)
        wait_live(page)
        expect(page.locator("#link")).to_be_hidden()
        stage.mute = True
        page.evaluate(f"window.offMs = -{HOUR_MS}")
        expect(page.locator("#link")).to_be_visible(timeout=15_000)
        expect(page.locator("#age")).to_have_text(re.compile(r"data \d+.s old"))
        page.close()


def test_a_clock_that_is_set_back_delays_no_new_attempt(visit: Any, stage: Stage) -> None:
    page = visit(init=CLOCK, expect_gone=True)
    wait_live(page)
    stage.shut()
    expect(page.locator("#retry")).to_be_visible()
    page.evaluate(f"window.offMs = -{HOUR_MS}")
    stage.open()
    expect(page.locator("#connection")).to_have_attribute("data-state", "live", timeout=30_000)


def test_a_page_that_is_opened_while_the_session_stands_still_says_since_when(
    visit: Any, stage: Stage
) -> None:
    page = visit()
    wait_live(page)
    stage.mute = True
    expect_lost(page)
    page.wait_for_timeout(5000)
    page.reload()
    expect_lost(page)
    # It did not begin when the page was opened.
    found = re.search(r"for (\d+).s", page.locator("#link").inner_text())
    assert found
    assert int(found[1]) >= 8


def test_a_slow_browser_misses_pictures_and_shows_none_late(visit: Any, stage: Stage) -> None:
    stage.rate_hz = 20.0
    try:
        page = visit(init=SLOW)
        wait_for(lambda: page.evaluate("window.agesS.length") > 20)
        # Twenty pictures at four a second: those of a queue would be four seconds old by now.
        assert max(page.evaluate("window.agesS.slice(10)")) < 1.5
    finally:
        stage.rate_hz = 5.0


def test_a_picture_that_was_long_on_its_way_is_not_of_now(visit: Any, stage: Stage) -> None:
    page = visit(init=FAR)
    expect(page.locator("#people li").first).to_be_visible()
    for _ in range(5):
        assert re.search(r"data [3-9].s old", page.locator("#age").inner_text())
        page.wait_for_timeout(500)


def test_the_title_is_that_of_the_session_that_came_after_the_loss(
    visit: Any, stage: Stage
) -> None:
    page = visit(expect_gone=True)
    wait_live(page)
    title = page.title()
    stage.shut()
    expect_lost(page)
    stage.hello_name = "Second drill"
    stage.started_unix_s += 1.0
    stage.open()
    try:
        expect(page.locator("#link")).to_be_hidden()
        expect(page).to_have_title(title.replace("Drill at the old mill", "Second drill"))
    finally:
        stage.hello_name = "Drill at the old mill"


def test_times_on_the_board_are_the_sessions_and_not_a_wrong_clocks(
    visit: Any, stage: Stage
) -> None:
    page = visit(init=CLOCK + f"window.offMs = -{HOUR_MS / 4};")
    wait_live(page)
    stage.set_board({"kind": "rollcall", "action": "start", "nodes": [1, 2], "within_s": 900})
    expect(page.locator("#roll-line")).to_contain_text(re.compile(r"1[45]:\d\d.min left"))


def test_a_phone_asks_for_few_pictures_and_the_team_s_page_for_all(
    visit: Any, stage: Stage
) -> None:
    counts = []
    for path in ("/phone", "/"):
        page = visit(path, init=COUNTED)
        wait_live(page)
        page.evaluate("window.pictures = 0")
        page.wait_for_timeout(4000)
        counts.append(page.evaluate("window.pictures") / 4.0)
        page.close()
    phone, team = counts
    assert 1.0 < phone <= 4.0 < team, counts
