"""Both pages over the whole chain: emulated boards, serial port, fusion, server, browser."""

from __future__ import annotations

import csv
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Page, expect
from stage import Browser, wait_for


@pytest.fixture
def session(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A live session in which node 3's radio is off for 20 seconds."""
    command = [
        Path(sys.executable).with_name("relpos"), "demo", "--view", "--no-open", "--nodes", "3",
        "--view-listen", "127.0.0.1:0", "--seconds", "300", "--out", tmp_path / "out",
        # Lost for so long that a busy machine sees it.
        "--fault", "xbee:off:node=3,from=8,to=28",
    ]  # fmt: skip
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert running.stdout is not None
        address = next(
            found.group(0) for line in running.stdout if (found := re.search(r"http\S+", line))
        )
        yield running, address
    finally:
        if running.poll() is None:
            running.kill()
        running.communicate()


# All that the page has announced to screen readers, however late this test looks.
LISTEN = """addEventListener("DOMContentLoaded", () => {
    window.announced = [];
    new MutationObserver((changes) => {
        for (const { target } of changes) {
            if (/-voice$/.test(target.id ?? "")) window.announced.push(target.textContent);
        }
    }).observe(document.body, { subtree: true, childList: true });
})"""


def positions(page: Page) -> dict[str, tuple[float, float]]:
    """What the map shows, by the table."""
    rows = page.locator("#table tr").all()
    cells = [[c.inner_text() for c in row.locator("th, td").all()] for row in rows]
    return {c[0]: (float(c[2]), float(c[3])) for c in cells if c[2][-1:].isdigit()}


def test_an_emulated_team_is_seen_walking_lost_found_and_pressing_a_landmark(
    browser: Browser, session: tuple[subprocess.Popen[str], str], tmp_path: Path
) -> None:
    running, address = session
    context = browser.new_context(viewport={"width": 1200, "height": 760})
    context.set_default_timeout(60_000)
    page, phone = context.new_page(), context.new_page()
    hosts, complaints = set(), []
    for opened in (page, phone):
        opened.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
        opened.on("pageerror", lambda error: complaints.append(str(error)))
        opened.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
    page.add_init_script(LISTEN)
    page.goto(address)
    expect(page.locator("#people li")).to_have_count(3)
    page.get_by_role("button", name="Table").click()
    wait_for(lambda: "Node 1" in positions(page))
    before = positions(page)

    phone.goto(page.url + "phone")
    phone.locator("#wearers").get_by_role("button", name="Node 2").click()
    phone.get_by_label("Your name").fill("Ben")
    phone.get_by_role("button", name="This is me").click()
    expect(page.locator("#people")).to_contain_text("Ben")
    expect(phone.locator("#clock-status")).to_contain_text("The laptop's clock is")
    for digit in "17":
        phone.locator("#pad").get_by_role("button", name=digit, exact=True).click()
    earliest = time.time()
    phone.get_by_role("button", name="I am at 17").click()
    latest = time.time()
    expect(phone.locator("#queue")).to_have_text("1 press received by the laptop")
    phone.close()
    view = page.evaluate("fetch('/api/picture').then((answer) => answer.json())")
    began = view["unix_s"] - view["time_s"]

    def announced(words: str) -> bool:
        return any(words in text for text in page.evaluate("window.announced"))

    wait_for(lambda: announced("Node 3 is lost: not heard for"), 120.0)
    wait_for(lambda: announced("Node 3 is heard again"), 120.0)
    expect(page.locator("#alarms [data-node='3']")).to_have_count(0)
    after = positions(page)
    moved = [name for name in before if name in after and before[name] != after[name]]
    assert "Node 1" in moved
    assert hosts == {urlsplit(address).netloc}
    assert complaints == []
    context.close()

    running.send_signal(signal.SIGINT)
    said, _ = running.communicate(timeout=600)
    assert running.returncode == 0, said
    assert "debrief: " in said
    (events,) = (tmp_path / "out").rglob("events.csv")
    with events.open() as file:
        presses = [row for row in csv.DictReader(file) if row["event"] == "landmark"]
    assert [(row["node"], row["value"]) for row in presses] == [("2", "17")]
    assert earliest - began - 0.3 <= float(presses[0]["time_s"]) <= latest - began + 0.3
