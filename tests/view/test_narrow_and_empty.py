"""Names, screens and teams at their limits: nothing is hidden, nothing is told that is not so."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from playwright.sync_api import expect
from stage import Stage, wait_live
from walking_team import WalkingTeam

from relpos.live.team_view import TeamView

LONG = "W" * 40
# Words that lie under a button, or beyond the edge of their row.
COVERED = """(selector) => [...document.querySelectorAll(selector)].filter((e) => {
    const range = document.createRange();
    range.selectNodeContents(e);
    const words = range.getBoundingClientRect();
    const buttons = e.parentElement.querySelector(".buttons").getBoundingClientRect();
    const level = words.bottom > buttons.top && words.top < buttons.bottom;
    return level && words.right > buttons.left + 1;
}).length"""


class Nobody(WalkingTeam):
    """A port that is open, at which nothing has arrived."""

    def view(self, seq: int, time_s: float, unix_s: float) -> TeamView:
        """Return a view without anybody."""
        view = super().view(seq, time_s, unix_s)
        return replace(view, arrived_unix_s=None, people=(), pairs=(), ranges=())


def test_where_nobody_has_been_heard_there_are_no_data_of_now(visit: Any, stage: Stage) -> None:
    stage.reset(Nobody())
    for path, waiting in (("/", "#waiting"), ("/phone", "#team-empty")):
        page = visit(path)
        wait_live(page)
        expect(page.locator("#age")).to_have_text("no data yet")
        if path == "/phone":
            page.locator("nav").get_by_role("button", name="Team").click()
        expect(page.locator(waiting)).to_be_visible()


def test_a_name_of_forty_characters_hides_no_alarm_and_no_tool(visit: Any, stage: Stage) -> None:
    stage.team.names[2] = LONG
    stage.team.still_since[2] = stage.at_s - 45.0
    for width in (1280, 390):
        page = visit(viewport={"width": width, "height": 720})
        wait_live(page)
        expect(page.locator(".alarm .text").first).to_contain_text("has not moved")
        assert page.evaluate(COVERED, ".alarm[data-level=high] .text") == 0
        page.locator("#map").focus()
        page.close()
    page = visit()
    page.locator("#me").select_option("2")
    box = page.locator("#follow").bounding_box()
    assert box
    assert box["width"] < 300
    page.locator("#show-board").click()
    # All that is said of a person fits beside the name.
    assert page.evaluate("document.querySelector('#board-rows th').offsetWidth") < 320


def test_the_boards_people_can_be_reached_on_a_phone(visit: Any, stage: Stage) -> None:
    page = visit(viewport={"width": 320, "height": 640})
    wait_live(page)
    page.locator("#menu").click()
    page.locator("#show-board").click()
    mayday = page.locator("#board-rows tr[data-node='6'] button").filter(has_text="MAYDAY")
    mayday.scroll_into_view_if_needed()
    expect(mayday).to_be_in_viewport(ratio=1)
    mayday.click(trial=True, timeout=5000)


def test_who_may_only_look_has_no_mayday_to_press(visit: Any, stage: Stage) -> None:
    page = visit()
    wait_live(page)
    page.locator("#people .name").first.click()
    mayday = page.locator("#people .details .mayday").first
    expect(mayday).to_be_visible()
    page.evaluate("document.documentElement.dataset.role = 'look'")
    expect(mayday).to_be_hidden()
    # The board is read, and has nothing that would be refused.
    page.locator("#show-board").click()
    expect(page.locator("#board-rows tr")).to_have_count(6)
    expect(page.locator("#board-dialog button:visible")).to_have_text(["Close"])
    enabled = "#board-rows :is(input, select):enabled"
    expect(page.locator(enabled)).to_have_count(0)


@pytest.mark.parametrize("path", ["/", "/phone"])
def test_no_alarm_is_cut_on_the_narrowest_screen_in_german(
    visit: Any, stage: Stage, path: str
) -> None:
    stage.team.still_since = {2: stage.at_s - 64.0}
    stage.team.lost_since = {1: stage.at_s - 200.0}
    stage.team.names = {1: "Hauptbrandmeister Anna-Lena"}
    page = visit(path, viewport={"width": 320, "height": 568}, locale="de-DE")
    texts = page.locator(".alarms .rows .text")
    expect(texts).to_have_count(2)
    for text in texts.all():
        assert text.evaluate("(e) => e.scrollHeight <= e.clientHeight + 1"), text.inner_text()
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
