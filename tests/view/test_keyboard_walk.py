"""A mission by keyboard alone: nothing that is used loses the focus to nowhere."""

from __future__ import annotations

from typing import Any

from playwright.sync_api import Page, expect
from stage import Stage, wait_for
from test_mission_page import hold

FOCUS = "document.activeElement !== document.body && document.activeElement.checkVisibility()"


def test_board_roll_call_evacuation_markers_and_find_go_by_key_without_losing_the_focus(
    visit: Any, stage: Stage
) -> None:
    page: Page = visit(viewport={"width": 1366, "height": 768})
    expect(page.locator("#people li")).to_have_count(6)

    def press(selector: str, key: str = "Enter") -> None:
        page.locator(selector).focus()
        page.keyboard.press(key)

    def is_focused() -> None:
        wait_for(lambda: bool(page.evaluate(FOCUS)))

    press("#show-board")
    press("#roll-start")
    wait_for(lambda: stage.board.roll_call is not None)
    is_focused()
    expect(page.locator("#roll-end")).to_be_visible()
    press("#roll-end")
    expect(page.locator("#roll-end")).to_be_hidden()
    is_focused()
    row = "#board-rows tr[data-node='2']"
    hold(page, f"{row} button[aria-label='Evacuate Ben: hold']")
    expect(page.locator(f"{row} >> text=Understood")).to_be_visible()
    # The button has gone: on to the tick beside it.
    wait_for(lambda: "Understood" in page.evaluate("document.activeElement.textContent.slice(-40)"))
    page.keyboard.press("Enter")
    wait_for(
        lambda: stage.board.evacuation is not None and bool(stage.board.evacuation.acknowledged)
    )
    press("#evacuate-end")
    wait_for(lambda: stage.board.evacuation is None)
    is_focused()
    page.keyboard.press("Escape")
    expect(page.locator("#board-dialog")).to_be_hidden()
    is_focused()
    press("#layers summary")
    press("#marker-place")
    page.keyboard.press("Enter")
    wait_for(lambda: len(stage.board.markers) == 1)
    press("#layers summary")
    press("#markers button")
    expect(page.locator("#markers button")).to_have_count(0)
    is_focused()
    press("button[aria-label='Find Ben']")
    expect(page.locator("#find")).to_be_visible()
    is_focused()
    page.keyboard.press("Escape")
    is_focused()
