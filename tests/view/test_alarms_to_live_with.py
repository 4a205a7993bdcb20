"""Alarms that people can live with, and a page that fits the screens that they have."""

from __future__ import annotations

import itertools
import re
from typing import Any

import pytest
from playwright.sync_api import expect
from stage import Stage, wait_for, wait_live
from walking_team import NAMES, WalkingTeam, disk_full

from relpos.live.team_view import Level, LogEntry, Notice

# A burst rendered as a browser would play it: the pulses' beginnings and lengths in seconds, and
# the strength of the fundamental's first harmonics.
RENDER = """async (kind) => {
    const { schedule, PATTERNS } = await import("/static/js/sound.js");
    const rate = 22050;
    const context = new OfflineAudioContext(1, 5 * rate, rate);
    schedule(context, kind, 0);
    const samples = (await context.startRendering()).getChannelData(0);
    const pulses = [];
    const step = Math.round(0.01 * rate);
    let on = false;
    for (let k = 0; k + step <= samples.length; k += step) {
        const loud = samples.subarray(k, k + step).some((v) => Math.abs(v) > 0.05);
        if (loud && !on) pulses.push([k / rate, 0]);
        if (!loud && on) pulses[pulses.length - 1][1] = k / rate - pulses[pulses.length - 1][0];
        on = loud;
    }
    const hertz = PATTERNS[kind].pulses[0][1];
    const part = samples.subarray(Math.round(0.04 * rate), Math.round(0.14 * rate));
    const strength = (f) => { let [c, s] = [0, 0]; part.forEach((v, k) => {
        const at = 2 * Math.PI * f * k / rate;
        c += v * Math.cos(at);
        s += v * Math.sin(at);
    }); return 2 * Math.hypot(c, s) / part.length; };
    return { pulses, hertz, every: PATTERNS[kind].everyS,
        harmonics: [1, 2, 3, 4, 5].map((n) => strength(n * hertz)) };
}"""


def test_each_sound_has_the_pulses_of_its_priority(visit: Any) -> None:
    page = visit()
    for kind, groups, every in (
        ("high", [3, 2, 3, 2], 10),
        ("medium", [3], 25),
        ("low", [2], 30),
        ("link", [2], 6),
    ):
        sound = page.evaluate(RENDER, kind)
        starts = [start for start, _ in sound["pulses"]]
        gaps = [b - a for a, b in itertools.pairwise(starts)]
        # A pulse farther than the shortest gap and a half begins the next group.
        found = [1]
        for gap in gaps:
            found = [*found, 1] if gap > 1.5 * min(gaps) else [*found[:-1], found[-1] + 1]
        assert found == groups, kind
        assert sound["every"] == every, kind
        if kind != "link":
            assert 150 <= sound["hertz"] <= 1000
            assert min(sound["harmonics"]) > 0.15 * max(sound["harmonics"]), kind


def test_all_that_is_silent_at_once_is_one_alarm_with_its_cause(visit: Any, stage: Stage) -> None:
    page = visit()
    wait_live(page)
    stage.team.lost_since = dict.fromkeys(range(1, 7), stage.at_s - 11.0)
    rows = page.locator("#alarms .rows .alarm")
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text("Nothing heard from anybody")
    expect(rows).to_have_attribute("data-level", "high")
    rows.get_by_role("button", name="Acknowledge").click()
    wait_for(lambda: sorted(stage.acknowledged) == [1, 2, 3, 4, 5, 6])
    expect(rows).to_have_count(0)


def test_sound_can_be_off_for_two_minutes_and_says_so_meanwhile(visit: Any, stage: Stage) -> None:
    page = visit()
    page.clock.install()
    wait_live(page)
    button = page.locator("#sound")
    expect(button).to_have_text("NO SOUND: enable")
    button.click()
    expect(button).to_have_text("Sound on")
    button.click()
    expect(button).to_have_text(re.compile(r"Sound off, (2:00\smin|1\d\d\ss) left"))
    page.clock.fast_forward(121_000)
    expect(button).to_have_text("Sound on")


def test_a_shelved_alarm_counts_down_and_is_shelved_for_everybody(visit: Any, stage: Stage) -> None:
    stage.team.still_since = {2: stage.at_s - 60.0}
    page = visit()
    wait_live(page)
    expect(page.locator("#alarms .rows .alarm")).to_have_count(1)
    page.locator("#people li[data-node='2'] .name").click()
    page.get_by_role("button", name="Shelve alarms 10 min").click()
    wait_for(lambda: stage.team.shelved_s == {2: 600.0})
    expect(page.locator("#alarms .rows .alarm")).to_have_count(0)
    expect(page.locator("#alarms .known")).to_contain_text("shelved, back in 10:00 min")
    page.get_by_role("button", name="left: end").click()
    wait_for(lambda: stage.team.shelved_s == {2: 0.0})
    expect(page.locator("#alarms .rows .alarm")).to_have_count(1)


def test_notes_are_in_the_log_with_names_and_in_no_ones_way(visit: Any, stage: Stage) -> None:
    note = "node 3: steps were counted 9 % too short and are right now"
    stage.team.notices = (Notice("n", Level.INFO, note, 1.0), disk_full())
    assert stage.web is not None
    stage.web.logged(LogEntry(1.0, 1.7e9, "note", note, 3))
    stage.web.logged(LogEntry(2.0, 1.7e9, "acknowledge", "alarm of Ben", 2, "Anna"))
    page = visit()
    wait_live(page)
    expect(page.locator("#notices p")).to_have_count(1)
    button = page.locator("#show-log")
    expect(button).to_have_text("Log (2)")
    button.click()
    lines = page.locator("#log li")
    expect(lines.nth(0)).to_contain_text("alarm of Ben, by Anna")
    expect(lines.nth(1)).to_contain_text("Chloé: steps were counted 9 % too short")
    page.keyboard.press("Escape")
    expect(button).to_have_text("Log")


def test_a_node_that_starts_is_starting_and_not_failing(visit: Any, stage: Stage) -> None:
    stage.team.health = {1: ("yellow", ("starting",)), 2: ("yellow", ("no status heard yet",))}
    page = visit()
    for node in (1, 2):
        health = page.locator(f"#people li[data-node='{node}'] .health")
        expect(health).to_have_text("node starting")


def test_twenty_people_are_visible_at_once_beside_a_map_of_half_the_laptops_screen(
    visit: Any, stage: Stage
) -> None:
    stage.team = WalkingTeam(size=20)
    page = visit(viewport={"width": 1366, "height": 768})
    wait_live(page)
    people = page.locator("#people li")
    expect(people).to_have_count(20)
    expect(page.locator("#count")).to_have_text("(20)")
    for k in range(20):
        expect(people.nth(k)).to_be_in_viewport(ratio=1)
        assert NAMES[k].split()[0][:5] in people.nth(k).inner_text()
    box = page.locator("#map").bounding_box()
    assert box
    assert box["width"] * box["height"] >= 0.5 * 1366 * 768
    # With three alarms open, too.
    stage.team.lost_since = {5: stage.at_s - 12.0}
    stage.team.still_since = {2: stage.at_s - 52.0, 3: stage.at_s - 24.0}
    expect(page.locator("#alarms .rows .alarm")).to_have_count(3)
    for k in range(20):
        expect(people.nth(k)).to_be_in_viewport(ratio=1)


def test_eleven_alarms_leave_a_phone_half_its_map_and_say_how_many_they_are(
    visit: Any, stage: Stage
) -> None:
    stage.team = WalkingTeam(size=20)
    stage.team.still_since = dict.fromkeys(range(1, 12), stage.at_s - 52.0)
    page = visit(viewport={"width": 390, "height": 844})
    wait_live(page)
    count = page.get_by_text("11 open")
    expect(count).to_be_in_viewport(ratio=1)
    expect(page.locator("#alarms .rows .alarm").first).to_be_in_viewport(ratio=1)
    assert page.locator("#map").bounding_box()["height"] >= 0.5 * 844
    stage.mute = True
    banner = page.locator(".link")
    expect(banner).to_be_visible()
    assert banner.bounding_box()["height"] <= 0.15 * 844
    expect(count).to_be_in_viewport(ratio=1)


@pytest.mark.parametrize("size", [6, 20])
def test_the_map_keeps_three_fifths_of_a_phone_with_three_alarms_open(
    visit: Any, stage: Stage, size: int
) -> None:
    stage.team = WalkingTeam(size=size)
    stage.team.lost_since = {5: stage.at_s - 9.0}
    stage.team.still_since = {2: stage.at_s - 52.0, 3: stage.at_s - 24.0}
    page = visit(viewport={"width": 390, "height": 844}, has_touch=True)
    wait_live(page)
    expect(page.locator("#alarms .rows .alarm")).to_have_count(3)
    box = page.locator("#map").bounding_box()
    assert box
    assert box["width"] * box["height"] >= 0.6 * 390 * 844
    for row in page.locator("#alarms .rows .alarm").all():
        expect(row).to_be_in_viewport(ratio=1)
        assert (row.bounding_box() or {})["height"] <= 52
    # Nothing is trapped behind the map: the people are drawn up from below, and all are reached.
    page.locator("#sheet").tap()
    last = page.locator("#people li").last
    last.scroll_into_view_if_needed()
    expect(last).to_be_in_viewport()
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0


def test_what_is_left_out_of_a_flood_is_counted_by_people(visit: Any, stage: Stage) -> None:
    stage.frozen = True
    stage.team = WalkingTeam(size=12)
    stage.team.still_since = dict.fromkeys(range(1, 10), stage.at_s - 40.0)
    stage.team.lost_since = {10: stage.at_s - 12.0, 11: stage.at_s - 30.0}
    page = visit()
    expect(page.locator("#alarms .rows .alarm")).to_have_count(9)
    expect(page.locator("#alarms .more")).to_contain_text("and 2 more: ")
