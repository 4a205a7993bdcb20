"""The command post's node on the pages: a place and a reference, but nobody."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from playwright.sync_api import expect
from stage import Stage, wait_for
from test_floors_page import shot
from walking_team import WalkingTeam

from relpos.live.team_view import POST_NAME, Alert, Person

POST = 6
SILENT_S = 12.0


@dataclass
class TeamWithPost(WalkingTeam):
    silent: bool = False

    def person(self, node: int, time_s: float) -> Person:
        person = super().person(node, 40.0 if node == POST else time_s)
        person = replace(person, floor=0, floor_probability=0.97, z_m=0.0)
        if node != POST:
            return person
        person = replace(person, name=POST_NAME, post=True, moving=False, still_s=900.0)
        if not self.silent:
            return person
        return replace(person, status="lost", alert=Alert.LOST, seen_s=SILENT_S)


def test_the_command_posts_node_is_nobody_of_the_team(visit: Any, stage: Stage) -> None:
    stage.reset(TeamWithPost(still_since={2: 0.0}))
    page = visit(viewport={"width": 1366, "height": 768})
    card = page.locator(f"#people li[data-node='{POST}']")
    expect(card.locator(".label")).to_have_text("Command post")
    expect(card.locator(".state")).to_have_text("Nobody wears it: reference for heights")
    expect(page.locator("#people li").last).to_have_attribute("data-node", str(POST))
    expect(page.locator("#count")).to_have_text("(5)")
    card.locator(".name").click()
    expect(card.locator(".disc")).to_have_css("border-radius", "0px")
    expect(card.get_by_role("button", name="Follow")).to_be_visible()
    expect(card.get_by_role("button", name="MAYDAY")).to_be_hidden()
    expect(page.locator("#map-words")).to_contain_text("5 of 5 people located")
    shot(page, "post")
    page.locator("#show-board").click()
    expect(page.locator("#board-rows tr")).to_have_count(5)
    page.locator("#all-entered").click()
    wait_for(lambda: len(stage.board.people) == 5)
    expect(page.locator("#show-board")).to_have_text("Board (5 in)")
    french = visit(locale="fr-FR")
    label = french.locator(f"#people li[data-node='{POST}'] .label")
    expect(label).to_have_text("Poste de commandement")


def test_a_silent_command_post_is_no_lost_person(visit: Any, stage: Stage) -> None:
    stage.reset(TeamWithPost(silent=True))
    page = visit()
    row = page.locator(f"#alarms .alarm[data-node='{POST}']")
    expect(row).to_contain_text("The command post's node is not heard for 12 s")
    expect(row).to_have_attribute("data-level", "low")
    state = page.locator(f"#people li[data-node='{POST}'] .state")
    expect(state).to_have_text("Not heard: last news 12 s ago")
    expect(page.locator("#count")).to_have_text("(5)")
    shot(page, "post-silent")
    # The name has room beside the words for a last place.
    label = page.locator(f"#people li[data-node='{POST}'] .label")
    assert label.evaluate("(e) => e.scrollWidth <= e.clientWidth")


def test_a_phone_leads_to_the_command_post_and_nobody_says_this_is_me(
    visit: Any, stage: Stage
) -> None:
    stage.reset(TeamWithPost())
    phone = visit("/phone", viewport={"width": 390, "height": 844})
    expect(phone.get_by_role("button", name="Ben")).to_be_visible()
    expect(phone.get_by_role("button", name="Command post")).to_have_count(0)
    phone.get_by_role("button", name="Ben").click()
    phone.get_by_role("button", name="This is me").click()
    # The answer leads to the landmarks.
    expect(phone.get_by_role("heading", name="Landmarks")).to_be_visible()
    phone.locator("[data-page='team']").click()
    expect(phone.get_by_role("button", name="Find Command post")).to_be_visible()
