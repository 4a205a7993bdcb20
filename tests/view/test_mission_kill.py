"""Kills: session, page's server, browser, estimator, all, while something is under way."""

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
    said = []
    for line in process.stdout:
        if found := re.search(pattern, line):
            return found[0]
        said.append(line)
    raise AssertionError(f"no {pattern}: the program has ended: {''.join(said)}")


class Field:
    """An emulated team of its own process, and a mission over it that can be killed."""

    def __init__(self, folder: Path, *, started: bool = True) -> None:
        self.folder = folder
        self.fails = folder.with_name("fails")
        """Makes the estimator fail."""
        self.team = self.run("emulate", "--nodes", "3")
        self.port = output_of(self.team, "/dev/\\S+")
        if started:
            estimator = f"{Path(__file__).with_name('failing_estimator.py')}:make"
            words = ("--name", "Old mill", "--initial", "common", "--estimator", estimator)
            self.address = self.start(self.port, *words)

    def run(self, *arguments: str) -> subprocess.Popen[str]:
        command = [*RELPOS, *arguments]
        options: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        options["env"] = {**os.environ, "RELPOS_FAILS": str(self.fails)}
        return subprocess.Popen(command, text=True, start_new_session=True, **options)

    def start(self, *more: str) -> str:
        listen = ("--view-listen", "127.0.0.1") if not more else ("--view-listen", "127.0.0.1:0")
        self.session = self.run("mission", str(self.folder), *more, *listen, "--no-open")
        return output_of(self.session, "http://\\S+")

    def kill(self, what: str) -> None:
        if what == "browser":
            return  # The test closes it.
        if what == "estimator":
            self.fails.touch()
            wait_for(lambda: not self.fails.exists())
            return
        if what == "server":
            killed = self.servers()
            for server in killed:
                os.kill(server, signal.SIGKILL)
            # Its connections end with it; a page that still looks live is one that is back.
            wait_for(lambda: bool(self.servers() - killed))
            return
        if what == "all":
            os.killpg(self.session.pid, signal.SIGKILL)
        # Alone, as by a kernel without memory: its server goes by itself.
        self.session.kill()
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
    own = context.browser.new_context(viewport={"width": 390, "height": 844})
    phone: Page = own.new_page()
    phone.set_default_timeout(60_000)
    address = re.sub("//[^:/]+:", "//127.0.0.1:", output_of(invited, "http://\\S+"))
    phone.goto(address)
    phone.locator("[data-wearer='1']").click()
    phone.get_by_role("button", name="This is me").click()
    expect(phone.locator("#press")).to_be_visible()
    return phone


def is_live(page: Page) -> bool:
    """Whether a page has found its session again."""
    state = page.locator("#connection").get_attribute("data-state")
    return page.locator("#link").is_hidden() and "live" in str(state)


def begin_everything(page: Page, phone: Page, folder: Path) -> Any:
    """Name, press, evacuation, MAYDAY with its roll call, marker; a plan of one aligned point.

    The phone presses a landmark without connection. Returns what posts to the session.
    """

    def post(path: str, body: dict[str, Any]) -> int:
        asked = """([path, body]) => fetch(path, { method: "POST", body: JSON.stringify(body),
            headers: { "content-type": "application/json" } }).then((a) => a.status)"""
        return int(page.evaluate(asked, [path, body]))

    assert post("/api/name", {"node": 2, "name": "Ben"}) == 200
    assert post("/api/shelve", {"node": 1, "seconds": 600, "by": "Anna"}) == 200
    assert post("/api/presses", {**clocks(), "presses": [PRESS]}) == 200
    assert post("/api/evacuate", {"action": "order", "nodes": [2], "by": "Anna"}) == 200
    # An alarm that nobody has acknowledged starts the roll call.
    assert post("/api/mayday", {"node": 3, "on": True, "by": "Anna"}) == 200
    answer = {"action": "answer", "node": 1, "answer": "confirmed", "by": "Anna"}
    assert post("/api/rollcall", answer) == 200
    expect(page.locator("#alarms")).to_contain_text("MAYDAY")
    page.locator("#show-board").click()
    expect(page.locator("#board-rows tr[data-node='2']")).to_contain_text("its LED is on")
    page.keyboard.press("Escape")
    page.locator("#layers summary").click()
    (folder / "plan.png").write_bytes(png(600, 400))
    page.locator("#plan-file").set_input_files(folder / "plan.png")
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
    phone.context.set_offline(True)
    phone.locator("#landmark").fill("9")
    phone.locator("#press").click()
    assert "3 of 3 people located" in page.locator("#map-words").inner_text()
    return post


PRESS = {"id": "p1", "landmark": "7", "unix_ms": time.time() * 1000}


def clocks() -> dict[str, Any]:
    """Of a phone whose clock is right."""
    return {"node": 2, "clock_offset_ms": 0, "sent_unix_ms": time.time() * 1000}


@pytest.mark.soak
@pytest.mark.parametrize("killed", ["session", "server", "browser", "estimator", "all"])
def test_what_was_confirmed_is_there_again_five_seconds_after_a_kill(
    browser: Any, field: Field, tmp_path: Path, killed: str
) -> None:
    context = browser.new_context(viewport={"width": 1366, "height": 768})
    context.set_default_timeout(60_000)
    page: Page = context.new_page()
    page.goto(field.address)
    expect(page.locator("#people li")).to_have_count(3)
    phone = wearer(context, field)
    wait_for(lambda: "3 of 3 people located" in page.locator("#map-words").inner_text())
    begin_everything(page, phone, tmp_path)
    page.evaluate("window.same_page = true")
    field.kill(killed)
    # The session is back once it has printed its address.
    back_s = time.monotonic()
    phone.context.set_offline(False)
    closed = killed in ("all", "browser")
    if closed:
        page.close()
        page = context.new_page()
        page.goto(field.address.partition("?")[0])
        # The phone's page, too: it keeps what it has not sent.
        others = phone.context
        phone.close()
        phone = others.new_page()
        phone.goto(field.address.partition("?")[0] + "phone")
    else:
        wait_for(lambda: is_live(page))
        assert page.evaluate("window.same_page")
    expect(page.locator("#people li[data-node='2'] .label")).to_have_text(re.compile("Ben"))
    took_s = time.monotonic() - back_s
    print(f"{killed}: back after {took_s:.1f} s")
    assert took_s < BACK_S
    expect(page.locator("#evacuation-line")).to_contain_text("0 of 1")
    expect(page.locator("#alarms .alarm").first).to_contain_text("MAYDAY")
    expect(page.locator("#roll-line")).to_contain_text("Emergency roll call")
    expect(page.locator("#roll-line")).to_contain_text("1 of 3 confirmed")
    expect(phone.locator("#queue")).to_contain_text(re.compile("received by the laptop|No press"))
    status = page.locator("#ground-status")
    if closed:
        # The plan was confirmed, its first point was not: it is aligned anew.
        page.locator("#layers summary").click()
        page.locator("#plan-align").click()
        click(page, 400, 300)
        expect(status).to_contain_text("is on the map")
        click(page, 400, 300)
    expect(status).to_contain_text("2")
    click(page, 700, 500)
    expect(status).to_contain_text("is on the map")
    click(page, 700, 500)
    wait_for(lambda: any("points" in e for e in Mission.open(field.folder).events()))
    expect(page.locator("#markers li")).to_have_count(1)
    page.locator("#show-log").click()
    logged = ["node 2 is Ben", "alarms of", "is at landmark 7", "is at landmark 9"]
    for words in [*logged, *["the fusion has failed"] * (killed == "estimator")]:
        expect(page.locator("#log")).to_contain_text(words)
    page.keyboard.press("Escape")
    wait_for(lambda: "3 of 3 people located" in page.locator("#map-words").inner_text())
    api = field.address.partition("?")[0] + "api/"
    (shelved,) = [p for p in page.request.get(api + "picture").json()["people"] if p["node"] == 1]
    assert 400.0 < shelved["shelved_s"] < 600.0
    # Sent again by a phone that had no answer: it counts once.
    sent = page.request.post(api + "presses", data={**clocks(), "presses": [PRESS]})
    assert sent.status == 200
    presses = [e for e in Mission.open(field.folder).events() if e["kind"] == "presses"]
    assert sorted(len(e["ids"]) for e in presses) == [1, 1]
    assert ["p1"] in [e["ids"] for e in presses]
    context.close()


@pytest.mark.soak
@pytest.mark.parametrize("killed", ["session", "server", "all"])
def test_a_page_that_waits_for_a_source_goes_on_five_seconds_after_a_kill(
    browser: Any, tmp_path: Path, killed: str
) -> None:
    field = Field(tmp_path / "mission", started=False)
    try:
        address = field.start()
        context = browser.new_context()
        context.set_default_timeout(60_000)
        page: Page = context.new_page()
        page.goto(address)
        expect(page.locator("#source-form")).to_be_visible()
        page.locator("#source-path").fill(field.port)
        page.evaluate("window.same_page = true")
        field.kill(killed)
        back_s = time.monotonic()
        if killed == "all":
            page.close()
            page = context.new_page()
            page.goto(address.partition("?")[0])
            page.locator("#source-path").fill(field.port)
        expect(page.locator("#connection")).to_contain_text("No session runs")
        expect(page.locator("#source-form")).to_be_visible()
        took_s = time.monotonic() - back_s
        print(f"waiting, {killed}: back after {took_s:.1f} s")
        assert took_s < BACK_S
        if killed != "all":
            assert page.evaluate("window.same_page")
            assert page.locator("#source-path").input_value() == field.port
        page.locator("#source-start").click()
        wait_for(lambda: Mission.open(field.folder).about.source == field.port)
        # What was chosen is on the disk before it is confirmed.
        os.killpg(field.session.pid, signal.SIGKILL)
        field.session.wait()
        field.start()
        expect(page.locator("#people li")).to_have_count(3)
        context.close()
    finally:
        field.close()
