"""The accountability board on the page, and what it asks of the wearers' phones."""

from __future__ import annotations

from typing import Any

from playwright.sync_api import Page, expect
from stage import Stage, until_held, wait_for


def row(page: Page, node: int) -> Any:
    return page.locator(f"#board-rows tr[data-node='{node}']")


def hold(page: Page, button: Any) -> None:
    button.scroll_into_view_if_needed()
    box = button.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    until_held(page)
    page.mouse.up()


def wearer(visit: Any, name: str) -> Page:
    phone: Page = visit("/phone", viewport={"width": 390, "height": 844})
    phone.get_by_role("button", name=name).click()
    phone.get_by_role("button", name="This is me").click()
    expect(phone.locator("#press")).to_be_visible()
    return phone


def test_the_commander_keeps_the_board_and_everybody_sees_it(visit: Any, stage: Stage) -> None:
    page, other = visit(viewport={"width": 1366, "height": 768}), visit()
    page.locator("#show-board").click()
    close = page.locator("#board-dialog").get_by_role("button", name="Close").bounding_box()
    assert close["y"] + close["height"] <= 768
    page.locator("#all-standby").click()
    wait_for(lambda: stage.board.waiting == {1, 2, 3, 4, 5, 6})
    row(page, 2).get_by_label("state of node 2").select_option("entered")
    row(page, 2).get_by_label("sector of node 2").fill("cellar")
    row(page, 2).get_by_label("air of node 2").fill("280")
    row(page, 2).get_by_label("air of node 2").blur()
    wait_for(lambda: 2 in stage.board.people and stage.board.people[2].air_bar == 280)
    expect(row(page, 2)).to_contain_text("not measured")
    expect(other.locator("#show-board")).to_have_text("Board (1 in)")
    other.locator("#show-board").click()
    expect(row(other, 2).get_by_label("sector of node 2")).to_have_value("cellar")


def test_a_roll_call_is_answered_by_people_and_its_time_is_shown(visit: Any, stage: Stage) -> None:
    page = visit()
    phone = wearer(visit, "Ben")
    page.locator("#show-board").click()
    page.locator("#roll-start").click()
    line = page.locator("#roll-line")
    expect(line).to_contain_text("0 of 6 confirmed")
    phone.get_by_role("button", name="I am all right").click()
    expect(row(page, 2)).to_contain_text("confirmed by Ben")
    row(page, 3).get_by_role("button", name="Missing").click()
    expect(line).to_contain_text("1 of 6 confirmed, 1 missing")
    page.locator("#roll-end").click()
    expect(line).to_contain_text("Roll call incomplete")
    expect(line).to_have_attribute("data-state", "incomplete")


def test_a_mayday_is_a_hold_and_no_slip(visit: Any, stage: Stage) -> None:
    page = visit()
    phone = wearer(visit, "Ben")
    button = phone.locator("#mayday")
    button.click()
    phone.wait_for_timeout(300)
    assert stage.board.mayday == {}
    hold(phone, button)
    wait_for(lambda: 2 in stage.board.mayday)
    expect(phone.locator("#last")).to_have_text("MAYDAY was sent")
    page.locator("#show-board").click()
    expect(row(page, 2)).to_have_attribute("data-mayday", "true")
    # By keyboard, too: the key is held.
    end = row(page, 2).get_by_role("button", name="End MAYDAY")
    end.focus()
    page.keyboard.down("Enter")
    wait_for(lambda: stage.board.mayday == {})
    page.keyboard.up("Enter")


def test_an_evacuation_is_shown_on_phones_and_ticked_for_the_others(
    visit: Any, stage: Stage
) -> None:
    page = visit()
    phone = wearer(visit, "Ben")
    page.locator("#show-board").click()
    hold(page, page.locator("#evacuate-all"))
    line = page.locator("#evacuation-line")
    expect(line).to_contain_text("0 of 6 have understood. A radio order")
    expect(row(page, 2)).to_contain_text("on the phone")
    phone.get_by_role("button", name="Understood").click()
    expect(row(page, 2)).to_contain_text("understood, by Ben")
    row(page, 3).get_by_role("button", name="Understood").click()
    expect(line).to_contain_text("2 of 6 have understood")
    expect(phone.locator("#orders")).to_contain_text("EVACUATE: understood")
