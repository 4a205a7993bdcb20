"""The page of a mission without a source: its commander chooses one, starts and ends."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Page, expect
from stage import until_held
from test_mission_kill import Field, output_of, wearer
from typer.testing import CliRunner

from relpos.cli import live, waiting
from relpos.cli.main import app
from relpos.link.port import check_port
from relpos.live.addresses import DEFAULT_HOST
from relpos.live.mission import Mission
from relpos.live.session import Outcome
from relpos.view.access import Access, listen
from relpos.view.devices import Role


def test_only_a_commander_starts_and_a_path_of_a_guest_is_never_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mission = Mission.open(tmp_path / "mission", "", "Mill")
    door = listen(f"{DEFAULT_HOST}:0")
    opened: list[str] = []
    monkeypatch.setattr("relpos.link.port.check_port", opened.append)
    chosen: list[waiting.Choice | None] = []
    options = live.Options(True, open_browser=False, door=door)
    room = threading.Thread(target=lambda: chosen.append(waiting.choose(mission, options, "", 60)))
    room.start()
    access = Access(door[1].port, (DEFAULT_HOST,), key=mission.key)
    body = {"source": "/dev/ttyUSB9", "name": "Old mill", "common": True}
    base = f"http://{DEFAULT_HOST}:{access.port}"
    with httpx.Client(base_url=base, timeout=60.0, verify=False) as client:
        transport = httpx.HTTPTransport(retries=9, verify=False)
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
    # A kill before the session has begun loses nothing of what was chosen.
    about = Mission.open(mission.path).about
    assert (about.source, about.name, about.common) == ("/dev/ttyUSB9", "Old mill", True)


def test_a_mission_without_a_source_keeps_its_address_whoever_takes_the_usual_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    served: list[int] = []

    def choose(_: Mission, options: live.Options, *__: object) -> None:
        assert options.door is not None
        served.append(options.door[1].port)

    def start() -> str:
        words = ["mission", str(tmp_path / "mission"), "--view-listen", DEFAULT_HOST]
        return CliRunner().invoke(app, words).output

    monkeypatch.setattr(waiting, "choose", choose)
    usual, _ = listen(None)
    start()
    usual.close()
    start()
    assert served[0] == served[1]
    # A server that is about to go.
    old, _ = listen(f"{DEFAULT_HOST}:{served[0]}")
    threading.Timer(0.5, old.close).start()
    start()
    assert served[2] == served[0]
    with listen(f"{DEFAULT_HOST}:{served[0]}")[0]:
        monkeypatch.setattr("relpos.cli.mission.PATIENCE_S", 0.0)
        assert f"was at port {served[0]}" in start()
    assert served[3] != served[0]


def test_a_mission_waits_for_its_coordinator_and_goes_on_once_it_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = tmp_path / "coordinator"
    Mission.open(tmp_path / "mission", str(port), "Mill")
    begun: list[str] = []

    def run(found: Mission, *_: object, **__: object) -> Outcome:
        check_port(found.about.source)
        begun.append(found.about.source)
        return Outcome()

    monkeypatch.setattr("relpos.cli.mission._run", run)
    plugging = threading.Timer(3.0, port.touch)
    plugging.start()
    words = ["mission", str(tmp_path / "mission"), "--view-listen", f"{DEFAULT_HOST}:0"]
    said = CliRunner().invoke(app, words).output
    assert "no such device" in said
    assert "the team's page" in said, "meanwhile another source can be chosen"
    assert begun == [str(port)]


def hold_end(page: Page) -> None:
    page.locator("#show-log").click()
    page.locator("#end").focus()
    page.keyboard.down("Enter")
    until_held(page)
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
        context.set_default_timeout(60_000)
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
