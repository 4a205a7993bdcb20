"""The time line of a recording on the page."""

from __future__ import annotations

import re
from typing import Any

from playwright.sync_api import expect
from stage import Stage, wait_for

from relpos.live.tracks import Tracks

DASHES = """() => {
  const canvas = document.getElementById("map");
  const data = canvas.getContext("2d").getImageData(0, 0, 220, canvas.height).data;
  let count = 0;
  for (let k = 0; k < data.length; k += 4) count += data[k + 2] - data[k] > 120 ? 1 : 0;
  return count;
}"""


def drawn(page: Any) -> int:
    """Pixels of the first person's blue at the left of the map."""
    return int(page.evaluate(DASHES))


def test_a_recording_is_moved_by_its_time_line(visit: Any, stage: Stage) -> None:
    stage.play_recording(1.7e9)
    assert stage.web is not None
    asked: list[dict[str, Any]] = []
    stage.on_replay = asked.append
    stage.frozen = True
    page = visit()
    line = page.locator("#timeline")
    expect(line).to_be_hidden()
    ticks = [[30.0, "alarm", "Ben: still alarm"], [50.0, "landmark", "Anna is at landmark 7"]]
    stage.web.timed({
        "type": "timeline", "from_s": 0.0, "to_s": 100.0, "playing": True, "speed": 1.0,
        "ticks": ticks, "reading": False, "smoothing": True,
    })  # fmt: skip
    expect(line).to_be_visible()
    expect(page.locator(".tick")).to_have_count(2)
    expect(page.locator("#moment-words")).to_have_text(re.compile(r"of 100\ss"))
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
    # The smoothed tracks come when they are ready; a switch hides them.
    expect(page.locator("#smoothed-words")).to_have_text("Smoothed tracks: being computed")
    expect(page.locator("#smoothed")).to_be_disabled()
    tracks = Tracks()
    for second in range(60):
        tracks.add(1, float(second), -6.0, 0.25 * second)
    bare = drawn(page)
    stage.web.smoothed(tracks)
    expect(page.locator("#smoothed-words")).to_have_text("Smoothed tracks")
    wait_for(lambda: drawn(page) > bare + 100)
    page.locator("#smoothed").uncheck()
    wait_for(lambda: drawn(page) < bare + 50)
    # The board and the devices belong to a live mission.
    expect(page.locator("#show-board")).to_be_hidden()


def test_the_time_line_is_that_of_what_is_shown(visit: Any, stage: Stage) -> None:
    stage.frozen = True
    page = visit(expect_gone=True)
    line = {"type": "timeline", "from_s": 0.0, "to_s": 100.0, "playing": False, "speed": 1.0,
            "reading": False, "smoothing": False}  # fmt: skip
    for recorded_unix_s, text in ((1.7e9, "Ben: still alarm"), (1.71e9, "Anna: lost")):
        stage.play_recording(recorded_unix_s)
        assert stage.web is not None
        stage.web.timed({**line, "ticks": [[30.0, "alarm", text]]})
        expect(page.locator(".tick")).to_have_attribute("title", text)
    # A mission that is shown live again has none.
    stage.play_recording(None)
    expect(page.locator("#connection")).to_have_attribute("data-state", "live")
    expect(page.locator("#timeline")).to_be_hidden()
