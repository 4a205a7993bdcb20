"""The time line of a recording on the page."""

from __future__ import annotations

import re
from typing import Any

from playwright.sync_api import expect
from stage import Stage, wait_for


def test_a_recording_is_moved_by_its_time_line(visit: Any, stage: Stage) -> None:
    stage.play_recording(1.7e9)
    assert stage.web is not None
    asked: list[dict[str, Any]] = []
    stage.on_replay = asked.append
    page = visit()
    line = page.locator("#timeline")
    expect(line).to_be_hidden()
    ticks = [[30.0, "alarm", "Ben: still alarm"], [50.0, "landmark", "Anna is at landmark 7"]]
    stage.web.timed({
        "type": "timeline", "from_s": 0.0, "to_s": 100.0, "playing": True, "speed": 1.0,
        "ticks": ticks, "reading": False,
    })  # fmt: skip
    expect(line).to_be_visible()
    expect(page.locator(".tick")).to_have_count(2)
    expect(page.locator("#moment-words")).to_have_text(re.compile("of 100 s"))
    page.locator("#play").click()
    page.locator("#event-after").click()
    page.locator("#speed").select_option("10")
    # By keyboard: a slider is moved by arrows and Home.
    page.locator("#moment").focus()
    page.keyboard.press("Home")
    wanted: list[dict[str, Any]] = [
        {"playing": 0.0}, {"step": 1.0}, {"speed": 10.0}, {"at_s": 0.0},
    ]  # fmt: skip
    wait_for(lambda: all(one in asked for one in wanted))
    # The board and the devices belong to a live mission.
    expect(page.locator("#show-board")).to_be_hidden()
