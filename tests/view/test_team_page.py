"""The team's page in a real browser, fed by the real server from a team that walks by a formula."""

from __future__ import annotations

import math
import re
import time
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from stage import Stage, wait_for, wait_live
from walking_team import WalkingTeam, disk_full

# Colours on the canvas, at places given in CSS pixels from its centre.
PIXELS = """(places) => {
    const canvas = document.getElementById("map");
    const ratio = canvas.width / canvas.getBoundingClientRect().width;
    const context = canvas.getContext("2d");
    return places.map(([dx, dy]) => [...context.getImageData(
        canvas.width / 2 + dx * ratio, canvas.height / 2 + dy * ratio, 1, 1).data.slice(0, 3)]);
}"""
COUNT_FRAMES = """() => {
    window.frames_drawn = 0;
    document.addEventListener("relpos:drawn", () => { window.frames_drawn += 1; });
}"""


POINTS = (
    "north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west",
)  # fmt: skip


def rgb(css: str) -> list[int]:
    return [int(n) for n in re.findall(r"\d+", css)[:3]]


def card(page: Page, node: int) -> Any:
    return page.locator(f"#people li[data-node='{node}']")


def colour_of(page: Page, node: int) -> list[int]:
    return rgb(card(page, node).locator(".disc").evaluate("e => getComputedStyle(e).background"))


def wait_for_people(page: Page) -> None:
    wait_live(page)
    expect(page.locator("#people li").first).to_be_visible()


def metres_across(page: Page) -> int:
    expect(page.locator("#map-words")).to_contain_text("about")
    scale = re.search(r"about (\d+)", page.locator("#map-words").inner_text())
    assert scale
    return int(scale.group(1))


def overflow(page: Page) -> int:
    return int(page.evaluate("document.documentElement.scrollWidth - innerWidth"))


def follow(page: Page, node: int) -> None:
    card(page, node).locator(".name").click()
    card(page, node).get_by_role("button", name="Follow").click()


def find_button(page: Page, name: str) -> Any:
    return page.locator("#people").get_by_role("button", name=f"Find {name}", exact=True)


# --- the map ------------------------------------------------------------------------------------


def test_the_followed_person_stays_in_the_middle_while_the_map_moves(visit, stage: Stage):
    page = visit()
    wait_for_people(page)
    follow(page, 2)
    beside = [[-7, 0], [7, 0]]
    ben = colour_of(page, 2)
    wait_for(lambda: page.evaluate(PIXELS, beside) == [ben, ben])
    before = page.locator("#map").screenshot()
    for _ in range(4):
        stage.at_s += 1.0
        page.wait_for_timeout(250)
        wait_for(lambda: page.evaluate(PIXELS, beside) == [ben, ben])
    assert page.locator("#map").screenshot() != before
    assert "following Ben" in page.locator("#map-words").inner_text()


def test_heading_up_points_the_followed_persons_marker_upwards_on_every_side(visit, stage: Stage):
    page = visit()
    wait_for_people(page)
    page.get_by_role("button", name="Follow Anna").first.click()
    anna = colour_of(page, 1)
    # The marker's disc has a radius of 11, its point is 11 longer.
    ahead, behind, left, right = [0, -16], [0, 16], [-16, 0], [16, 0]
    page.get_by_role("button", name="Heading up").click()
    for _ in range(4):
        wait_for(lambda: page.evaluate(PIXELS, [ahead]) == [anna])
        assert anna not in page.evaluate(PIXELS, [left, right])
        stage.at_s += 16.0
        page.wait_for_timeout(300)
    assert "Anna up" in page.locator("#map-words").inner_text()
    del behind


def test_north_is_up_and_named_once_compasses_have_reported_it(visit, stage: Stage):
    stage.frozen = True
    page = visit()
    wait_for_people(page)
    page.get_by_role("button", name="Follow Anna").first.click()
    anna = colour_of(page, 1)
    heading = stage.team.pose(1, stage.at_s)[2]
    # The pixels 16 from its middle distinguish the marker's point from its disc.
    wait_for(lambda: "map north up" in page.locator("#map-words").inner_text())
    for north in (heading, heading - math.pi / 2):
        stage.team.north_rad = north
        point = [0, -16] if north == heading else [-16, 0]
        wait_for(lambda at=point: page.evaluate(PIXELS, [at]) == [anna])
    wait_for(lambda: "magnetic north up ±6°" in page.locator("#map-words").inner_text())
    page.locator("#me").select_option("1")
    x, y, _ = stage.team.pose(1, stage.at_s)
    ox, oy, _ = stage.team.pose(4, stage.at_s)
    clockwise = (stage.team.north_rad - math.atan2(oy - y, ox - x)) % math.tau
    point = POINTS[round(clockwise / math.tau * 8) % 8]
    expect(card(page, 4).locator(".compass")).to_have_text(point)


def test_the_map_zooms_by_wheel_buttons_keys_and_two_fingers(visit, stage: Stage):
    page = visit(has_touch=True)
    wait_for_people(page)
    wait_for(lambda: metres_across(page) > 20)

    def zoomed(action) -> None:
        before = metres_across(page)
        action()
        wait_for(lambda: metres_across(page) < before)

    box = page.locator("#map").bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def wheel() -> None:
        page.mouse.move(*middle)
        page.mouse.wheel(0, -300)

    def keys() -> None:
        page.locator("#map").focus()
        page.keyboard.press("+")

    def pinch() -> None:
        session = page.context.new_cdp_session(page)

        def touch(kind: str, reach: float) -> None:
            points = [{"x": middle[0] + s * reach, "y": middle[1], "id": k}
                      for k, s in enumerate((-1, 1))]  # fmt: skip
            session.send(
                "Input.dispatchTouchEvent",
                {"type": kind, "touchPoints": [] if kind == "touchEnd" else points},
            )

        touch("touchStart", 40)
        for reach in (60, 80, 100):
            touch("touchMove", reach)
        touch("touchEnd", 100)

    for action in (wheel, page.locator("#zoom-in").click, keys, pinch):
        zoomed(action)
    expect(page.locator("#fit")).to_have_attribute("aria-pressed", "false")
    page.locator("#fit").click()
    wait_for(lambda: metres_across(page) > 20)


def test_dragging_ends_following(visit, stage: Stage):
    page = visit()
    wait_for_people(page)
    follow(page, 2)
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "true")
    box = page.locator("#map").bounding_box()
    page.mouse.move(box["x"] + 400, box["y"] + 400)
    page.mouse.down()
    page.mouse.move(box["x"] + 500, box["y"] + 450, steps=4)
    page.mouse.up()
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "false")


def test_a_touch_on_somebodys_marker_chooses_that_person(visit, stage: Stage):
    stage.frozen = True
    page = visit()
    wait_for_people(page)
    follow(page, 5)
    card(page, 5).locator(".name").click()
    ben = colour_of(page, 5)
    wait_for(lambda: page.evaluate(PIXELS, [[-7, 0]]) == [ben])
    box = page.locator("#map").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    expect(card(page, 5)).to_have_attribute("data-selected", "true")


def test_nothing_is_drawn_while_nothing_changes(visit, stage: Stage):
    page = visit()
    wait_for_people(page)
    page.evaluate(COUNT_FRAMES)
    wait_for(lambda: page.evaluate("window.frames_drawn") > 3)
    stage.mute = True
    page.wait_for_timeout(1500)
    before = page.evaluate("window.frames_drawn")
    page.wait_for_timeout(1200)
    assert page.evaluate("window.frames_drawn") == before


# --- people -------------------------------------------------------------------------------------


def test_distance_and_direction_from_me_are_those_of_the_team(visit, stage: Stage):
    def seen(me: int, other: int) -> tuple[float, float, float]:
        """Distance in the last digit shown, direction in hours, bearing in eighths from north."""
        x, y, heading = stage.team.pose(me, stage.at_s)
        ox, oy, _ = stage.team.pose(other, stage.at_s)
        distance, bearing = math.hypot(ox - x, oy - y), math.atan2(oy - y, ox - x)
        return (
            10.0 * distance if distance < 9.95 else distance,
            (heading - bearing) % math.tau / math.tau * 12,
            (math.pi / 2 - bearing) % math.tau / math.tau * 8,
        )

    stage.frozen = True
    looks = ((1, 4), (3, 2))
    # A moment at which the digits that a view carries cannot tip a rounding.
    while any(abs(value % 1.0 - 0.5) < 0.1 for look in looks for value in seen(*look)):
        stage.at_s += 0.1
    page = visit()
    wait_for_people(page)
    for me, other in looks:
        page.locator("#me").select_option(str(me))
        digits, hour, point = map(round, seen(me, other))
        x, y, _ = stage.team.pose(me, stage.at_s)
        near = math.dist((x, y), stage.team.pose(other, stage.at_s)[:2]) < 9.95
        shown = f"{digits / 10:.1f} m" if near else f"{digits} m"
        expect(card(page, other).locator(".far")).to_have_text(shown)
        expect(card(page, other).locator(".direction")).to_have_text(f"{hour % 12 or 12} o'clock")
        word = POINTS[point % 8]
        # The frame is the team's own; its y axis need not be north.
        expect(card(page, other).locator(".compass")).to_have_text(f"map {word}")


def test_health_is_shown_by_a_word_and_a_shape_and_its_reason(visit, stage: Stage):
    stage.team.health = {2: ("yellow", ("weak radio (-88 dBm)",)), 3: ("red", ("supply 4.10 V",))}
    page = visit()
    wait_for_people(page)
    shapes = set()
    for node, word, reason in (
        (1, "node OK", ""),
        (2, "node weak", "weak radio (-88 dBm)"),
        (3, "node failing", "supply 4.10 V"),
    ):
        expect(card(page, node).locator(".health")).to_have_text(word)
        expect(card(page, node).locator(".reasons")).to_have_text(reason)
        shapes.add(card(page, node).locator(".sign path").first.get_attribute("d"))
    assert len(shapes) == 3
    facts = card(page, 2).locator(".facts").inner_text()
    for figure in ("4.96 V", "58 dBm", "1 %", "89 %"):
        assert figure in facts


def test_a_lost_person_raises_an_alarm_and_is_announced_when_found(visit, stage: Stage):
    page = visit()
    wait_for_people(page)
    stage.team.lost_since[5] = stage.at_s - 4.5
    alarm = page.locator("#alarms .rows .alarm")
    expect(alarm).to_contain_text("Emil is lost: not heard for")
    expect(page.get_by_role("alert")).to_contain_text("Emil is lost")
    expect(card(page, 5).locator(".state")).to_contain_text("Lost: last heard")
    assert page.locator("#people li").first.get_attribute("data-node") == "5"
    del stage.team.lost_since[5]
    expect(alarm).to_have_count(0)
    expect(page.locator("#news-voice")).to_have_text("Emil is heard again")
    expect(card(page, 5).locator(".state")).to_have_text("Moves")


def test_standing_still_warns_then_alarms_until_acknowledged_on_every_page(visit, stage: Stage):
    stage.frozen = True
    stage.team.still_since[2] = stage.at_s - 17.0
    page, other = visit(), visit()
    wait_for_people(page)
    expect(page.locator("#alarms")).to_be_hidden()
    stage.at_s += 4.0
    alarm = page.locator("#alarms .rows .alarm")
    expect(alarm).to_have_attribute("data-level", "low")
    expect(alarm).to_contain_text("Ben has not moved for 2")
    stage.at_s += 10.0
    expect(alarm).to_have_attribute("data-level", "high")
    page.get_by_role("button", name="Acknowledge: Ben").click()
    expect(alarm).to_have_count(0)
    wait_for(lambda: stage.acknowledged == [2])
    for somewhere in (page, other):
        known = somewhere.locator("#alarms .known")
        expect(known).to_contain_text("Ben has not moved for")
        expect(known).to_contain_text("seen by the commander")
        expect(somewhere.locator("#alarms .rows .alarm")).to_have_count(0)
    stage.team.still_since.clear()
    expect(page.locator("#alarms")).to_be_hidden()
    expect(page.locator("#news-voice")).to_have_text("Ben moves again")


def test_many_alarms_at_once_leave_room_for_the_map_and_are_acknowledged_together(
    visit, stage: Stage
):
    stage.frozen = True
    stage.team = WalkingTeam(size=12)
    stage.team.still_since = {n: stage.at_s - 22.0 - 2 * n for n in range(1, 10)}
    page = visit()
    wait_for_people(page)
    rows = page.locator("#alarms .rows .alarm")
    # All that are high are shown, whoever they are.
    expect(rows).to_have_count(6)
    expect(rows.first).to_contain_text("Ivo has not moved for 4")
    expect(page.locator("#alarms .more")).to_contain_text("and 3 more: Chloé, Ben, Anna")
    assert page.locator("#map").bounding_box()["height"] > 300
    page.get_by_role("button", name="Acknowledge all").click()
    wait_for(lambda: sorted(stage.acknowledged) == list(range(1, 10)))
    expect(rows).to_have_count(0)
    expect(page.locator("#alarms .known")).to_contain_text("Anna has not moved for")


def test_alarms_sound_until_acknowledged(visit, stage: Stage):
    listen = """
        window.beeps = 0;
        const start = OscillatorNode.prototype.start;
        OscillatorNode.prototype.start = function (...when) {
            window.beeps += 1;
            return start.apply(this, when);
        };
        window.buzzes = 0;
        Navigator.prototype.vibrate = function (pattern) {
            window.buzzes += Array.isArray(pattern) ? 1 : 0;
            return true;
        };
    """
    page = visit(init=listen)
    wait_for_people(page)
    expect(page.locator("#sound")).to_have_text("NO SOUND: enable")
    page.locator("#sound").click()
    expect(page.locator("#sound")).to_have_text("Sound on")
    # The test that sound is armed.
    wait_for(lambda: page.evaluate("window.beeps") == 2)
    stage.team.still_since[4] = stage.at_s - 60.0
    wait_for(lambda: page.evaluate("window.beeps") == 12)
    assert page.evaluate("window.buzzes") > 0
    page.get_by_role("button", name="Acknowledge: Dmitri").click()
    beeps = page.evaluate("window.beeps")
    page.wait_for_timeout(1800)
    assert page.evaluate("window.beeps") == beeps


def test_a_notice_of_the_session_is_shown(visit, stage: Stage):
    stage.team.notices = (disk_full(),)
    page = visit()
    expect(page.locator("#notices")).to_contain_text("disk full: the recording stands still")
    stage.team.notices = ()
    expect(page.locator("#notices p")).to_have_count(0)


def test_an_ambiguous_estimate_shows_the_other_positions_and_their_probabilities(
    visit, stage: Stage
):
    stage.team.ambiguous, stage.team.ring = 3, 6
    stage.frozen = True
    page = visit()
    wait_for_people(page)
    expect(card(page, 3).locator(".state")).to_contain_text("Ambiguous: 62 % where shown")
    expect(card(page, 6).locator(".state")).to_have_text("Not located yet")
    expect(page.locator("#map-hint")).to_have_text("Not located yet: Fatima")
    page.get_by_role("button", name="Table").click()
    alternatives = page.locator("#table-alternatives")
    x, y, _ = stage.team.pose(3, stage.at_s)
    expect(alternatives).to_contain_text("Chloé is where shown with 62 %.")
    expect(alternatives).to_contain_text(f"With 29 % Chloé is at x {x - 4:.1f}, y {y + 7:.1f}.")
    expect(alternatives).to_contain_text(
        "Fatima is somewhere on a ring of 6.0 m about x 10.0, y 5.0."
    )


def test_names_are_text_whatever_is_in_them(visit, stage: Stage):
    name = "<img src=x onerror=alert(1)>"
    stage.team.names[2] = name
    page = visit()
    wait_for_people(page)
    expect(card(page, 2).locator(".label")).to_have_text(name)
    assert page.locator("#people img").count() == 0


# --- finding ------------------------------------------------------------------------------------


def test_find_leads_by_arrow_distance_and_words(visit, stage: Stage):
    page = visit()
    wait_for_people(page)
    find_button(page, "Chloé").click()
    find = page.locator("#find")
    expect(find.get_by_role("heading")).to_have_text("Anna → Chloé")
    arrow = find.locator(".big-arrow")

    def pointing_error_deg() -> float:
        shown = float(arrow.get_attribute("data-direction") or "nan")
        x, y, heading = stage.team.pose(1, stage.at_s)
        ox, oy, _ = stage.team.pose(3, stage.at_s)
        true = math.atan2(oy - y, ox - x) - heading
        return abs(math.degrees(math.remainder(math.radians(shown) - true, math.tau)))

    wait_for(lambda: pointing_error_deg() < 12.0)
    expect(find.get_by_role("status")).to_contain_text("Chloé, ")
    expect(find.locator(".sure")).to_contain_text("Anna ±0.5 m · Chloé ±0.6 m")
    # Chloé stands on Anna's way: she comes closer, then is within reach.
    stage.frozen = True
    stage.team.still_since[3] = stage.at_s
    while math.dist(stage.team.pose(1, stage.at_s)[:2], stage.team.pose(3, stage.at_s)[:2]) > 7.0:
        stage.at_s += 0.5
    stage.frozen = False
    expect(find.locator(".trend")).to_contain_text("warmer: getting closer")
    stage.team.lost_since[3] = stage.at_s - 8.0
    expect(find.locator(".caution")).to_contain_text("Chloé: last heard")
    page.keyboard.press("Escape")
    expect(find).to_be_hidden()
    expect(find_button(page, "Chloé")).to_be_focused()


def test_an_arrow_to_one_of_several_places_is_hollow(visit, stage: Stage):
    page = visit()
    page.locator("#me").select_option("1")
    page.locator("#people").get_by_role("button", name="Find Ben").click()
    arrow = page.locator("#find .big-arrow path")
    expect(arrow).not_to_have_css("fill", "none")
    stage.team.ambiguous = 2
    expect(page.locator("#find .caution")).to_contain_text("Ben may be elsewhere: 62 %")
    expect(arrow).to_have_css("fill", "none")


def test_find_says_that_the_direction_is_unknown(visit, stage: Stage):
    stage.team.ring = 1
    page = visit()
    wait_for_people(page)
    page.locator("#me").select_option("1")
    find_button(page, "Ben").click()
    expect(page.locator("#find .order")).to_have_text("position unknown")
    expect(page.locator("#find .caution")).to_contain_text("Anna is not located")
    expect(page.locator("#find .big-arrow")).to_have_attribute("data-direction", "unknown")


# --- the connection -----------------------------------------------------------------------------


def test_a_server_that_is_gone_is_reported_and_found_again_without_reloading(visit, stage: Stage):
    page = visit(expect_gone=True)
    wait_for_people(page)
    page.evaluate("window.same_page = true")
    stage.shut()
    connection = page.locator("#connection")
    expect(connection).to_contain_text("Not connected")
    expect(connection).to_contain_text(re.compile(r"data \d+\ss old"))
    expect(page.locator("#people li")).to_have_count(6)
    stage.open()
    expect(connection).to_have_attribute("data-state", "live")
    expect(connection).to_contain_text("data now")
    assert page.evaluate("window.same_page")


def test_a_laptop_that_slept_for_a_minute_is_connected_anew_when_it_wakes(visit, stage: Stage):
    page = visit(expect_gone=True)
    page.clock.install()
    wait_for_people(page)
    page.evaluate("window.same_page = true")
    x_before = stage.team.pose(1, stage.at_s)
    # Behind a closed lid no timer runs, and the server gives the connection up.
    page.clock.pause_at(time.time() + 1.0)
    stage.shut()
    stage.open()
    stage.at_s += 60.0
    expect(page.locator("#connection")).not_to_have_attribute("data-state", "live")
    page.clock.set_system_time(time.time() + 60.0)
    page.clock.resume()
    expect(page.locator("#connection")).to_have_attribute("data-state", "live")
    expect(page.locator("#age")).to_have_text("data now")
    assert page.evaluate("window.same_page")
    assert math.dist(stage.team.pose(1, stage.at_s)[:2], x_before[:2]) > 1.0


def test_silence_of_the_server_is_reported_before_the_connection_breaks(visit, stage: Stage):
    page = visit()
    wait_for_people(page)
    # Its process stands still: not even pings come.
    process = stage.web._process
    assert process is not None
    import os
    import signal

    os.kill(process.pid, signal.SIGSTOP)
    try:
        expect(page.locator("#connection")).to_contain_text("Server silent")
    finally:
        os.kill(process.pid, signal.SIGCONT)
    expect(page.locator("#connection")).to_have_attribute("data-state", "live")


def test_a_page_without_the_token_says_where_to_find_it(visit, stage: Stage):
    page = visit(expect_gone=True)
    wait_for_people(page)
    stage.shut()
    page.context.clear_cookies()
    stage.open()
    expect(page.locator("#connection")).to_contain_text("open the address with the token")


def test_ten_pages_at_once_all_stay_live(visit, stage: Stage):
    first = visit(viewport={"width": 400, "height": 300})
    pages = [first, *(visit(context=first.context) for _ in range(9))]
    for page in pages:
        wait_for_people(page)
        page.evaluate(COUNT_FRAMES)
    for page in pages:
        page.bring_to_front()
        wait_for(lambda page=page: page.evaluate("window.frames_drawn") > 2)
        expect(page.locator("#age")).to_have_text("data now")


# --- everybody can use it -----------------------------------------------------------------------


def test_everything_can_be_done_with_the_keyboard_alone(visit, stage: Stage):
    page = visit()
    wait_for_people(page)
    page.keyboard.press("Tab")
    expect(page.locator(".skip")).to_be_focused()
    reached, unseen = [], []
    for _ in range(40):
        page.keyboard.press("Tab")
        focused = page.evaluate("""() => {
            const e = document.activeElement;
            if (e === document.body) return ["", true];
            const style = getComputedStyle(e);
            return [e.id || e.getAttribute("aria-label") || e.textContent.trim(),
                    style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2];
        }""")
        reached.append(focused[0])
        if not focused[1]:
            unseen.append(focused[0])
    controls = ("me", "sound", "theme", "phones", "help", "map", "zoom-in", "fit", "heading-up")
    for wanted in (*controls, "as-table", "show-log", "Find Ben", "Find Fatima"):
        assert wanted in reached
    assert unseen == []
    page.locator("#map").focus()
    page.keyboard.press("n")
    page.keyboard.press("n")
    expect(card(page, 2)).to_have_attribute("data-selected", "true")
    page.keyboard.press("f")
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("h")
    expect(page.locator("#heading-up")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("Escape")
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "false")
    page.keyboard.press("0")
    expect(page.locator("#fit")).to_have_attribute("aria-pressed", "true")
    find_button(page, "Ben").focus()
    page.keyboard.press("Enter")
    expect(page.locator("#find")).to_be_visible()
    page.keyboard.press("Escape")
    expect(find_button(page, "Ben")).to_be_focused()


NAMELESS = """() => [...document.querySelectorAll(
        "button, a, input, select, summary, canvas, img, table, dialog, [role], section, nav")]
    .filter((e) => e.checkVisibility() && !["status", "alert"].includes(e.getAttribute("role")))
    .filter((e) => !(e.getAttribute("aria-label") || e.getAttribute("aria-labelledby")
        || e.getAttribute("alt") || e.textContent.trim() || (e.labels && e.labels.length)))
    .map((e) => e.outerHTML.slice(0, 120))"""
TWICE = """() => { const ids = [...document.querySelectorAll("[id]")].map((e) => e.id);
    return ids.filter((id, k) => ids.indexOf(id) !== k); }"""
# Contrast of every visible text with what is painted behind it.
PALE = """() => {
    const parse = (css) => (css.match(/[\\d.]+/g) || []).map(Number);
    const luminance = ([r, g, b]) => [r, g, b].map((v) => v / 255)
        .map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
        .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
    const behind = (e) => {
        for (; e; e = e.parentElement) {
            const c = parse(getComputedStyle(e).backgroundColor);
            if (c.length === 3 || c[3] > 0.99) return c;
        }
        return [255, 255, 255];
    };
    const found = [];
    for (const e of document.querySelectorAll("body *")) {
        const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
        const hidden = e.closest(".unseen, .skip, noscript, option, script");
        if (!own || hidden || !e.checkVisibility()) continue;
        const [x, y] = [luminance(parse(getComputedStyle(e).color)), luminance(behind(e))];
        const ratio = (Math.max(x, y) + 0.05) / (Math.min(x, y) + 0.05);
        if (ratio < 4.5) found.push(`${ratio.toFixed(2)}: ${e.outerHTML.slice(0, 90)}`);
    }
    return found;
}"""


def test_everything_has_a_name_and_enough_contrast(visit, stage: Stage):
    stage.team.still_since = {2: stage.at_s - 60.0, 4: stage.at_s - 22.0}
    stage.team.health = {3: ("yellow", ("weak radio",))}
    stage.team.notices = (disk_full(),)
    page = visit(reduced_motion="reduce")
    wait_for_people(page)
    page.locator("#layers summary").click()
    page.get_by_role("button", name="Table").click()
    find_button(page, "Chloé").click()
    expect(page.locator("#alarms .rows .alarm")).to_have_count(2)
    page.get_by_role("button", name="Acknowledge: Dmitri").click()
    page.wait_for_timeout(300)
    assert page.evaluate(NAMELESS) == []
    assert page.evaluate(TWICE) == []
    assert page.evaluate("document.documentElement.lang") == "en"
    for theme in ("light", "dark"):
        page.emulate_media(color_scheme=theme)
        expect(page.locator("html")).to_have_attribute("data-theme", theme)
        assert page.evaluate(PALE) == []


def test_a_table_states_what_the_map_shows(visit, stage: Stage):
    stage.frozen = True
    page = visit()
    wait_for_people(page)
    page.get_by_role("button", name="Table").click()
    x, y, _ = stage.team.pose(4, stage.at_s)
    row = page.locator("#table tr", has=page.locator("th", has_text="Dmitri"))
    expect(row.get_by_role("rowheader")).to_have_text("Dmitri")
    cells = [c.inner_text() for c in row.get_by_role("cell").all()]
    assert cells[0].startswith("located")
    assert float(cells[1]) == pytest.approx(x, abs=0.06)
    assert float(cells[2]) == pytest.approx(y, abs=0.06)
    assert "o'clock" in cells[5]
    near = {
        stage.team.name(n)
        for n in (1, 2, 3, 5, 6)
        if math.dist(stage.team.pose(n, stage.at_s)[:2], (x, y)) < 15.9
    }
    assert near
    assert all(name in cells[6] for name in near)


@pytest.mark.parametrize(
    ("width", "height"),
    [
        (320, 568),
        pytest.param(390, 844, marks=pytest.mark.soak),
        (1280, 720),
        pytest.param(3840, 2160, marks=pytest.mark.soak),
    ],
)
def test_it_fits_screens_from_a_small_phone_to_a_wall(visit, stage: Stage, width: int, height: int):
    stage.team.still_since = {2: stage.at_s - 60.0}
    page = visit(viewport={"width": width, "height": height})
    wait_for_people(page)
    assert overflow(page) <= 0
    box = page.locator("#map").bounding_box()
    assert box["width"] >= 300
    assert box["height"] >= 200
    places = ("#people", ".tools", "#map-tools")
    buttons = page.locator(", ".join(f"{place} button:visible" for place in places))
    heights = [button.bounding_box()["height"] for button in buttons.all()[:16]]
    assert len(heights) > 10
    assert min(heights) >= 40
    find_button(page, "Chloé").click()
    expect(page.locator("#find .distance")).to_be_in_viewport()
    expect(page.locator("#find .order")).to_be_in_viewport()
    assert overflow(page) <= 0


def test_the_theme_follows_the_system_until_somebody_chooses(visit, stage: Stage):
    page = visit(color_scheme="dark")
    wait_for_people(page)
    ground = "getComputedStyle(document.body).backgroundColor"
    assert rgb(page.evaluate(ground)) == [11, 16, 22]
    page.emulate_media(color_scheme="light")
    wait_for(lambda: rgb(page.evaluate(ground)) == [255, 255, 255])
    page.get_by_role("button", name="Dark theme").click()
    assert rgb(page.evaluate(ground)) == [11, 16, 22]
    page.reload()
    wait_for_people(page)
    assert rgb(page.evaluate(ground)) == [11, 16, 22]
    wait_for(lambda: page.evaluate(PIXELS, [[-300, 250]])[0][0] < 40)


def test_nothing_moves_with_reduced_motion(visit, stage: Stage):
    stage.team.still_since = {2: stage.at_s - 60.0}
    stage.frozen = True
    page = visit(reduced_motion="reduce")
    wait_for_people(page)
    expect(page.locator("#alarms .rows .alarm")).to_be_visible()
    assert page.evaluate("document.getAnimations().length") == 0
    stage.mute = True
    page.wait_for_timeout(1500)
    page.evaluate(COUNT_FRAMES)
    page.wait_for_timeout(700)
    assert page.evaluate("window.frames_drawn") == 0


def test_help_and_the_phones_code_open_and_close_by_keyboard(visit, stage: Stage):
    page = visit(expect_gone=True)
    wait_for_people(page)
    page.locator("#help").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_contain_text("Legend")
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)
    page.locator("#phones").click()
    # This stage listens on this computer alone, and says what to do about it.
    expect(page.locator("#qr-trouble")).to_contain_text("--view-listen 0.0.0.0")
