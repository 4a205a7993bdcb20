"""The page of a mission without a source: its commander chooses one, starts and ends."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Page, expect
from test_mission_kill import Field, output_of, wearer

from relpos.cli import live, waiting
from relpos.live.mission import Mission
from relpos.view.access import DEFAULT_HOST, Access, free_port
from relpos.view.devices import Role


def test_only_a_commander_starts_and_a_path_of_a_guest_is_never_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mission = Mission.open(tmp_path / "mission", "", "Mill")
    port = free_port(DEFAULT_HOST, 0)
    opened: list[str] = []
    monkeypatch.setattr("relpos.link.port.check_port", opened.append)
    chosen: list[waiting.Choice | None] = []
    options = live.Options(True, f"{DEFAULT_HOST}:{port}", open_browser=False)
    room = threading.Thread(target=lambda: chosen.append(waiting.choose(mission, options, "", 60)))
    room.start()
    access = Access(port, (DEFAULT_HOST,), key=mission.key)
    body = {"source": "/dev/ttyUSB9", "name": "Old mill", "common": True}
    with httpx.Client(base_url=f"http://{DEFAULT_HOST}:{port}", timeout=60.0) as client:
        transport = httpx.HTTPTransport(retries=9)
        for role in (Role.LOOK, Role.ACKNOWLEDGE, Role.COMMAND):
            with httpx.Client(transport=transport, timeout=60.0) as entering:
                entered = entering.get(access.url(role=role))
            client.cookies = entered.cookies
            if role is not Role.COMMAND:
                assert client.get("/api/sources").status_code == 403
                assert client.post("/api/start", json=body).status_code == 403
                assert opened == []
        assert client.get("/api/sources").json()["name"] == "Mill"
        # One of pyserial's that writes files.
        spy = client.post("/api/start", json={**body, "source": f"spy:///x?file={tmp_path}/y"})
        assert spy.status_code == 400
        nothing = client.post("/api/start", json={**body, "source": str(tmp_path / "none")})
        assert "no such port" in nothing.json()["error"]
        too_long = client.post("/api/start", json={**body, "source": "a" * 300})
        assert "name too long" in too_long.json()["error"]
        assert client.post("/api/rollcall", json={"action": "start"}).status_code == 409
        assert client.post("/api/start", json=body).status_code == 200
    room.join(60.0)
    assert chosen == [waiting.Choice("/dev/ttyUSB9", "Old mill", common=True)]
    assert opened == ["/dev/ttyUSB9"]
    roles = [e["role"] for e in mission.events() if e["kind"] == "device"]
    assert sorted(roles) == ["acknowledge", "command", "look"], "kept for the session"


def hold_end(page: Page) -> None:
    page.locator("#show-log").click()
    page.locator("#end").focus()
    page.keyboard.down("Enter")
    page.wait_for_timeout(1300)
    page.keyboard.up("Enter")


@pytest.mark.soak
def test_a_mission_is_started_ended_and_a_recording_of_it_played_on_the_page(
    browser: Any, tmp_path: Path
) -> None:
    field = Field(tmp_path / "mission", started=False)
    try:
        field.session = field.run(
            "mission", str(field.folder), "--view-listen", "127.0.0.1:0", "--no-open"
        )
        context = browser.new_context(viewport={"width": 1366, "height": 768})
        page: Page = context.new_page()
        page.goto(output_of(field.session, "http://\\S+"))
        page.locator("#source-path").fill(field.port)
        page.locator("#source-common").check()
        page.locator("#source-name").fill("Old mill")
        page.locator("#source-start").click()
        expect(page.locator("#people li")).to_have_count(3)
        expect(page.locator("#session")).to_have_text("Old mill")
        phone = wearer(context, field)
        hold_end(page)
        expect(page.locator("#source-form")).to_be_visible()
        expect(page.locator("#link")).to_be_hidden()
        page.locator("#source-path").fill(str(field.folder / "recording-1.mcap"))
        page.locator("#source-start").click()
        expect(page.locator("html")).to_have_attribute("data-replay", "true")
        expect(page.locator("#people li")).to_have_count(3)
        # By its time line: any moment, and what happened.
        expect(page.locator("#moment-words")).to_have_text(re.compile(" of "))
        page.locator("#play").click()
        expect(page.locator("#play")).to_have_text("Play")
        page.locator("#moment").focus()
        page.keyboard.press("Home")
        expect(page.locator("#moment-words")).to_have_text(re.compile(r"^0.0\ss of "))
        # Who is let in meanwhile stays in.
        invited = output_of(
            field.run("mission", str(field.folder), "--invite", "look"), "http://\\S+"
        )
        guest = browser.new_page()
        guest.goto(re.sub("//[^:/]+:", "//127.0.0.1:", invited))
        expect(guest.locator("#people li")).to_have_count(3)
        guest.close()
        hold_end(page)
        expect(page.locator("#source-form")).to_be_visible()
        kept = Mission.open(field.folder)
        assert kept.about.source == field.port
        assert [e["role"] for e in kept.events() if e["kind"] == "device"][-1] == "look"
        phone.close()
        context.close()
    finally:
        field.close()
