"""What a commander does with a mission on the page: evacuate one, end it, return to live."""

from __future__ import annotations

import functools
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from stage import Stage, until_held, wait_for

from relpos.live.team_view import Hello


def hold(page: Page, selector: str) -> None:
    """By key: it is held as the mouse is."""
    page.locator(selector).focus()
    page.keyboard.down("Enter")
    until_held(page)
    page.keyboard.up("Enter")


def test_one_person_is_called_out_and_then_another_without_losing_the_first_answer(
    visit: Any, stage: Stage
) -> None:
    page = visit(viewport={"width": 1366, "height": 768})
    page.locator("#show-board").click()
    row = "#board-rows tr[data-node='2']"
    hold(page, f"{row} button[aria-label='Evacuate Ben: hold']")
    wait_for(lambda: stage.board.evacuation is not None)
    assert stage.board.evacuation is not None
    assert stage.board.evacuation.nodes == [2]
    page.locator(f"{row} >> text=Understood").click()
    wait_for(
        lambda: stage.board.evacuation is not None and bool(stage.board.evacuation.acknowledged)
    )
    hold(page, "#board-rows tr[data-node='3'] button[aria-label='Evacuate Chloé: hold']")
    expect(page.locator("#evacuation-line")).to_contain_text("1 of 2 have understood")


def test_the_session_is_ended_by_a_hold_and_never_by_a_slip(visit: Any, stage: Stage) -> None:
    page = visit()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    expect(page.locator("#connection")).to_have_attribute("data-state", "live")
    page.locator("#show-log").click()
    page.locator("#end").click()
    page.wait_for_timeout(300)
    assert not any(url.endswith("/api/end") for url in asked)
    with page.expect_request("**/api/end") as found:
        hold(page, "#end")
    assert found.value.post_data_json == {"by": "the commander"}


def test_a_replay_leads_back_to_the_mission_that_goes_on(
    visit: Any, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stage.Hello", functools.partial(Hello, live_port=8467))
    stage.play_recording(1.7e9)
    page = visit()
    expect(page.locator("#to-live")).to_have_attribute("href", "http://127.0.0.1:8467/")
    expect(page.locator("#to-live")).to_have_text("Return to live")
    expect(page.locator("#end")).to_be_hidden()
