"""Kills: the session, the page's server, the browser, all of them, while something is under way."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from stage import wait_for
from test_plan_and_markers import click, png

from relpos.live.mission import Mission

BACK_S = 5.0
RELPOS = [sys.executable, "-m", "relpos.cli.main"]


def output_of(process: subprocess.Popen[str], pattern: str) -> str:
    """The first line that fits."""
    assert process.stdout
    for line in process.stdout:
        if found := re.search(pattern, line):
            return found[0]
    raise AssertionError(f"no {pattern}: the program has ended")


class Field:
    """An emulated team of its own process, and a mission over it that can be killed."""

    def __init__(self, folder: Path, *, started: bool = True) -> None:
        self.folder = folder
        self.team = self.run("emulate", "--nodes", "3")
        self.port = output_of(self.team, "/dev/\\S+")
        if started:
            self.address = self.start(self.port, "--name", "Old mill", "--initial", "common")

    def run(self, *arguments: str) -> subprocess.Popen[str]:
        command = [*RELPOS, *arguments]
        options: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        return subprocess.Popen(command, text=True, start_new_session=True, **options)

    def start(self, *more: str) -> str:
        listen = ("--view-listen", "127.0.0.1") if not more else ("--view-listen", "127.0.0.1:0")
        self.session = self.run("mission", str(self.folder), *more, *listen, "--no-open")
        return output_of(self.session, "http://\\S+")

    def kill(self, what: str) -> None:
        if what == "browser":
            return  # The test closes it.
        if what == "server":
            killed = self.servers()
            for server in killed:
                os.kill(server, signal.SIGKILL)
            # Its connections end with it; a page that still looks live is one that is back.
            wait_for(lambda: bool(self.servers() - killed))
            return
        os.killpg(self.session.pid, signal.SIGKILL)
        self.session.wait()
        self.start()

    def servers(self) -> set[int]:
        """Processes of the page's server."""
        children = Path(f"/proc/{self.session.pid}/task/{self.session.pid}/children")
        return {
            int(child)
            for child in children.read_text().split()
            if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text()
        }

    def close(self) -> None:
        for process in (self.session, self.team):
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture
def field(tmp_path: Path) -> Iterator[Field]:
    """A mission under way."""
    made = Field(tmp_path / "mission")
    yield made
    made.close()


def wearer(context: Any, field: Field) -> Page:
    """A wearer's phone with a token of its own."""
    invited = field.run("mission", str(field.folder), "--invite", "acknowledge")
    phone: Page = context.browser.new_page(viewport={"width": 390, "height": 844})
    phone.set_default_timeout(60_000)
    address = re.sub("//[^:/]+:", "//127.0.0.1:", output_of(invited, "http://\\S+"))
    phone.goto(address)
    phone.locator("[data-wearer='1']").click()
    phone.get_by_role("button", name="This is me").click()
    expect(phone.locator("#press")).to_be_visible()
    return phone


@pytest.mark.soak
@pytest.mark.parametrize("killed", ["session", "server", "browser", "all"])
def test_what_was_confirmed_is_there_again_five_seconds_after_a_kill(
    browser: Any, field: Field, killed: str
) -> None:
    context = browser.new_context()
    page: Page = context.new_page()
    page.goto(field.address)
    expect(page.locator("#people li")).to_have_count(3)

    def post(path: str, body: dict[str, Any]) -> int:
        asked = """([path, body]) => fetch(path, { method: "POST", body: JSON.stringify(body),
            headers: { "content-type": "application/json" } }).then((a) => a.status)"""
        return int(page.evaluate(asked, [path, body]))

    assert post("/api/name", {"node": 2, "name": "Ben"}) == 200
    assert post("/api/shelve", {"node": 3, "seconds": 600, "by": "Anna"}) == 200
    press = {"id": "p1", "landmark": "7", "unix_ms": time.time() * 1000}
    clocks = {"node": 2, "clock_offset_ms": 0, "sent_unix_ms": time.time() * 1000}
    assert post("/api/presses", {**clocks, "presses": [press]}) == 200
    assert post("/api/rollcall", {"action": "start", "within_s": 600, "by": "Anna"}) == 200
    answer = {"action": "answer", "node": 1, "answer": "confirmed", "by": "Anna"}
    assert post("/api/rollcall", answer) == 200
    assert post("/api/evacuate", {"action": "order", "nodes": [2], "by": "Anna"}) == 200
    phone = wearer(context, field)
    time.sleep(4.0)
    expect(page.locator("#evacuation-line")).to_contain_text("0 of 1")
    # An alarm that nobody has acknowledged; its emergency roll call replaces the other one.
    if killed in ("session", "browser"):
        assert post("/api/mayday", {"node": 3, "on": True, "by": "Anna"}) == 200
        expect(page.locator("#alarms")).to_contain_text("MAYDAY")
    # A phone without connection presses a landmark, and the kill comes meanwhile.
    phone.context.set_offline(True)
    phone.locator("#landmark").fill("9")
    phone.locator("#press").click()
    before = page.locator("#map-words").inner_text()
    assert "3 of 3 people located" in before
    page.evaluate("window.same_page = true")
    field.kill(killed)
    # The session is back once it has printed its address.
    back_s = time.monotonic()
    phone.context.set_offline(False)
    if killed in ("all", "browser"):
        page.close()
        page = context.new_page()
        page.goto(field.address.partition("?")[0])
    else:
        wait_for(lambda: page.locator("#link").is_hidden() and "live" in str(
            page.locator("#connection").get_attribute("data-state")))  # fmt: skip
        assert page.evaluate("window.same_page")
    expect(page.locator("#people li[data-node='2'] .label")).to_have_text(re.compile("Ben"))
    took_s = time.monotonic() - back_s
    print(f"{killed}: back after {took_s:.1f} s")
    assert took_s < BACK_S
    expect(page.locator("#evacuation-line")).to_contain_text("0 of 1")
    if killed in ("session", "browser"):
        expect(page.locator("#alarms .alarm").first).to_contain_text("MAYDAY")
        expect(page.locator("#roll-line")).to_contain_text("Emergency roll call")
    else:
        expect(page.locator("#roll-line")).to_contain_text("1 of 3 confirmed")
    expect(phone.locator("#queue")).to_contain_text("1 press received by the laptop")
    page.locator("#show-log").click()
    for words in ("node 2 is Ben", "alarms of", "is at landmark 7", "is at landmark 9"):
        expect(page.locator("#log")).to_contain_text(words.replace("node 2", "Ben"))
    page.keyboard.press("Escape")
    wait_for(lambda: "3 of 3 people located" in page.locator("#map-words").inner_text())
    # Sent again by a phone that had no answer: it counts once.
    assert post("/api/presses", {**clocks, "presses": [press]}) == 200
    presses = [e for e in Mission.open(field.folder).events() if e["kind"] == "presses"]
    assert sorted(len(e["ids"]) for e in presses) == [1, 1]
    assert ["p1"] in [e["ids"] for e in presses]
    context.close()


@pytest.mark.soak
@pytest.mark.parametrize("killed", ["session", "server"])
def test_a_plan_that_is_being_aligned_is_aligned_after_a_kill_with_plan_and_markers_kept(
    browser: Any, field: Field, tmp_path: Path, killed: str
) -> None:
    context = browser.new_context(viewport={"width": 1366, "height": 768})
    page: Page = context.new_page()
    page.goto(field.address)
    expect(page.locator("#people li")).to_have_count(3)
    page.locator("#layers summary").click()
    (tmp_path / "plan.png").write_bytes(png(600, 400))
    page.locator("#plan-file").set_input_files(tmp_path / "plan.png")
    expect(page.locator("#plan-align")).to_be_enabled()
    page.locator("#marker-place").click()
    page.keyboard.press("Enter")
    expect(page.locator("#markers li")).to_have_count(1)
    page.locator("#layers summary").click()
    page.locator("#plan-align").click()
    status = page.locator("#ground-status")
    click(page, 400, 300)
    expect(status).to_contain_text("is on the map")
    click(page, 400, 300)
    expect(status).to_contain_text("2")
    field.kill(killed)
    back_s = time.monotonic()
    wait_for(lambda: page.locator("#link").is_hidden() and "live" in str(
        page.locator("#connection").get_attribute("data-state")))  # fmt: skip
    print(f"{killed}: back after {time.monotonic() - back_s:.1f} s")
    assert time.monotonic() - back_s < BACK_S
    # The points that were clicked so far are still there.
    expect(status).to_contain_text("2")
    click(page, 700, 500)
    expect(status).to_contain_text("is on the map")
    click(page, 700, 500)
    plans = [e for e in Mission.open(field.folder).events() if e["kind"] == "plan"]
    wait_for(lambda: any("points" in e for e in Mission.open(field.folder).events()))
    assert [e["action"] for e in plans][:1] == ["set"]
    expect(page.locator("#markers li")).to_have_count(1)
    other: Page = context.new_page()
    other.goto(field.address.partition("?")[0])
    expect(other.locator("#plan-remove")).to_be_enabled()
    expect(other.locator("#markers li")).to_have_count(1)
    context.close()
