"""Floors on the pages: a switch, people elsewhere pale, the building from the side."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path

from playwright.sync_api import expect
from stage import Stage
from walking_team import WalkingTeam

from relpos.live.team_view import Person

STOREY_M = 3.5


@dataclass
class TeamOnFloors(WalkingTeam):
    floors: dict[int, int] = field(default_factory=dict)

    def person(self, node: int, time_s: float) -> Person:
        person, floor = super().person(node, time_s), self.floors.get(node)
        if floor is None:
            return person
        return replace(person, floor=floor, floor_probability=0.97, z_m=STOREY_M * floor)


def shot(page, name: str) -> None:
    """Keep a picture where RELPOS_SHOTS names a folder."""
    if folder := os.environ.get("RELPOS_SHOTS"):
        page.screenshot(path=str(Path(folder) / f"{name}.png"))


def test_floors_are_switched_and_people_elsewhere_are_not_selected_away(visit, stage: Stage):
    stage.reset(TeamOnFloors(floors={1: 0, 2: 0, 3: 1, 4: 2, 5: 2}))
    page = visit()
    buttons = page.locator("#floors button")
    expect(buttons).to_have_text(["All floors", "Floor 2 (2)", "Floor 1 (1)", "Floor 0 (2)"])
    expect(buttons.first).to_have_attribute("aria-pressed", "true")
    page.get_by_role("button", name="Floor 2 (2)").click()
    expect(buttons.nth(1)).to_have_attribute("aria-pressed", "true")
    expect(page.locator("#people li[data-node='3'] .state")).to_contain_text("floor 1")
    expect(page.locator("#people li[data-node='6'] .state")).not_to_contain_text("floor")
    page.locator("#section summary").click()
    section = page.locator("#section-canvas")
    expect(section).to_be_visible()
    words = "Floor 2: Dmitri, Emil. Floor 1: Chloé. Floor 0: Anna, Ben"
    expect(section).to_have_attribute("aria-label", words)
    shot(page, "floors")
    # A name of the chosen floor is everybody's, and goes with the mission.
    page.get_by_label("Name of this floor").fill("attic")
    page.keyboard.press("Enter")
    expect(buttons.nth(1)).to_have_text("attic (2)")
    expect(page.locator("#people li[data-node='4'] .state")).to_contain_text("attic")
    assert stage.board.floors == {2: "attic"}
    shot(page, "named-floor")
    page.get_by_label("Name of this floor").fill("")
    page.keyboard.press("Enter")
    # Nobody is left on the floor that is shown: it stays shown until another is chosen.
    stage.team.floors = dict.fromkeys(range(1, 7), 0)
    expect(buttons).to_have_text(["All floors", "Floor 2 (0)", "Floor 0 (6)"])
    buttons.first.click()
    expect(page.locator("#floors")).to_be_hidden()


def test_without_floors_the_page_is_as_ever(visit, stage: Stage):
    page = visit()
    expect(page.locator("#people li").first).to_be_visible()
    expect(page.locator("#floors")).to_be_hidden()
    expect(page.locator("#section")).to_be_hidden()


def test_find_says_on_which_floor_the_other_is(visit, stage: Stage):
    stage.reset(TeamOnFloors(floors={1: 0, 3: 2}))
    page = visit()
    page.locator("#people li[data-node='3']").get_by_role("button", name="Find Chloé").click()
    find = page.locator("#find")
    expect(find.locator(".floor")).to_have_text("2 floors above you")
    shot(page, "find")
    # Right below somebody is not within reach.
    stage.team.spread_m = 0.0
    stage.team.still_since = dict.fromkeys((1, 3), 1e-9)
    stage.team.pose = lambda node, time_s: (0.1 * node, 0.0, 0.0)
    expect(find.locator(".order")).to_have_text("2 floors above you")
    expect(find.locator(".floor")).to_be_hidden()
    stage.team.floors = {1: 0, 3: 0}
    expect(find.locator(".order")).to_have_text("within reach: search here")
