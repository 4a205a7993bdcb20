"""The wearer's page in a real browser, behind the real server."""

from __future__ import annotations

import math
import re
import time

import pytest
from playwright.sync_api import Page, expect
from stage import Stage, wait_for

PHONE = {
    "viewport": {"width": 390, "height": 844},
    "has_touch": True,
    "is_mobile": True,
    "device_scale_factor": 1,
}


def choose(page: Page, who: str, name: str | None = None) -> None:
    page.get_by_role("button", name="Me", exact=True).click()
    page.locator("#wearers").get_by_role("button", name=who).click()
    if name is not None:
        page.get_by_label("Your name").fill(name)
    page.get_by_role("button", name="This is me").click()
    expect(page.locator("#page-landmarks")).to_be_visible()


def wait_clock(page: Page) -> None:
    expect(page.locator("#clock-status")).to_contain_text("The laptop's clock is")


def press(page: Page, landmark: str) -> None:
    for digit in landmark:
        page.locator("#pad").get_by_role("button", name=digit, exact=True).click()
    page.get_by_role("button", name=f"I am at {landmark}").click()


def session_s(stage: Stage) -> float:
    return time.time() - stage.started_unix_s


@pytest.mark.parametrize("wrong_s", [0.0, pytest.param(37.0, marks=pytest.mark.soak), -7200.0])
def test_a_press_is_recorded_with_its_node_and_time_whatever_the_phones_clock(
    visit, stage: Stage, wrong_s: float
):
    # The phone's clock as the page sees it; the network's and timers' pace is the real one.
    page = visit("/phone", **PHONE, init=f"""
        const real = Date.now;
        Date.now = () => real() + {1000 * wrong_s};
    """)  # fmt: skip
    choose(page, "Ben")
    wait_clock(page)
    before_s = session_s(stage)
    press(page, "17")
    after_s = session_s(stage)
    expect(page.locator("#queue")).to_contain_text("1 press stored on this phone")
    wait_for(lambda: len(stage.presses) == 1)
    event = stage.presses[0]
    assert (event.node, event.event, event.value) == (2, "landmark", "17")
    assert before_s - 0.25 <= event.time_s <= after_s + 0.25
    expect(page.locator("#queue")).to_have_text("1 press received by the laptop")


def test_presses_made_offline_are_sent_later_with_their_own_time(visit, stage: Stage):
    page = visit("/phone", expect_gone=True, **PHONE)
    choose(page, "Chloé")
    wait_clock(page)
    stage.shut()
    expect(page.locator("#connection")).to_contain_text("Not connected")
    times = []
    for landmark in ("4", "52"):
        before_s = session_s(stage)
        press(page, landmark)
        times.append((before_s, session_s(stage)))
        page.wait_for_timeout(400)
    expect(page.locator("#queue")).to_contain_text("2 presses stored on this phone")
    expect(page.locator("#queue")).to_contain_text("sent once connected")
    # Closed and opened again in the meantime, as somebody does whose phone seems dead.
    context = page.context
    page.close()
    assert stage.presses == []
    stage.open()
    page = visit("/phone", context=context)
    wait_for(lambda: len(stage.presses) == 2)
    for event, landmark, (before_s, after_s) in zip(stage.presses, ("4", "52"), times, strict=True):
        assert (event.node, event.value) == (3, landmark)
        assert before_s - 0.25 <= event.time_s <= after_s + 0.25
    expect(page.locator("#queue")).to_contain_text("2 presses received by the laptop")
    expect(page.locator("#my-name")).to_have_text("Chloé")


def test_a_press_taken_back_within_five_seconds_is_never_sent(visit, stage: Stage):
    page = visit("/phone", **PHONE)
    choose(page, "Ben")
    wait_clock(page)
    press(page, "99")
    page.get_by_role("button", name=re.compile("Undo 99")).click()
    expect(page.locator("#last")).to_contain_text("Landmark 99 at")
    expect(page.locator("#undo")).to_be_hidden()
    press(page, "7")
    wait_for(lambda: [e.value for e in stage.presses] == ["7"])
    expect(page.locator("#undo")).to_be_hidden()


def test_a_name_given_on_the_phone_is_everybodys(visit, stage: Stage):
    team_page = visit()
    page = visit("/phone", **PHONE)
    choose(page, "Dmitri", "Dmitri the Tall")
    expect(team_page.locator("#people")).to_contain_text("Dmitri the Tall")
    expect(page.locator("#my-name")).to_have_text("Dmitri the Tall")
    second = visit("/phone", **PHONE)
    expect(second.locator("#wearers")).to_contain_text("has a phone")
    page.reload()
    expect(page.locator("#my-name")).to_have_text("Dmitri the Tall")


def test_the_phone_sends_its_name_to_a_new_session(visit, stage: Stage):
    page = visit("/phone", expect_gone=True, **PHONE)
    choose(page, "Dmitri", "Dmitri the Tall")
    wait_for(lambda: stage.team.names.get(4) == "Dmitri the Tall")
    stage.begin_another_session()
    wait_for(lambda: stage.team.names.get(4) == "Dmitri the Tall")
    expect(page.locator("#my-name")).to_have_text("Dmitri the Tall")


def test_the_others_are_shown_from_the_wearer(visit, stage: Stage):
    stage.frozen = True
    page = visit("/phone", **PHONE)
    choose(page, "Emil")
    page.get_by_role("button", name="Team", exact=True).click()
    expect(page.locator("#others li")).to_have_count(5)
    x, y, heading = stage.team.pose(5, stage.at_s)
    ox, oy, _ = stage.team.pose(1, stage.at_s)
    row = page.locator("#others li[data-node='1']")
    left_deg = math.degrees(math.remainder(math.atan2(oy - y, ox - x) - heading, math.tau))
    shown_deg = float(row.locator(".small-arrow").get_attribute("data-direction") or "nan")
    assert math.remainder(shown_deg - left_deg, 360.0) == pytest.approx(0.0, abs=1.0)
    distance = math.hypot(ox - x, oy - y)
    shown = f"{distance:.1f} m" if distance < 9.95 else f"{distance:.0f} m"
    expect(row.locator(".far")).to_contain_text(shown)
    row.get_by_role("button", name="Find Anna").click()
    expect(page.locator("#find").get_by_role("heading")).to_have_text("Emil → Anna")
    page.locator("#find").get_by_role("button", name="Close").click()
    expect(page.locator("#others")).to_be_visible()


# As if the phone's owner had allowed them.
SENSORS = ["accelerometer", "gyroscope", "magnetometer"]
TURN = """([alpha, beta, gamma]) => {
    window.turning = setInterval(() => dispatchEvent(new DeviceOrientationEvent(
        "deviceorientationabsolute", { absolute: true, alpha, beta, gamma })), 100);
}"""


def test_a_shared_compass_is_a_heading_from_east_counter_clockwise(visit, stage: Stage):
    page = visit("/phone", **PHONE, permissions=SENSORS)
    choose(page, "Ben")
    page.get_by_role("button", name="Me", exact=True).click()
    page.get_by_role("button", name="Share compass").click()
    # Upright, its back to the west-north-west: 300 degrees clockwise from north.
    before_s = session_s(stage)
    page.evaluate(TURN, [60, 85, 0])
    wait_for(lambda: len(stage.headings) >= 2)
    heading = stage.headings[0]
    assert (heading.node, heading.source) == (2, "phone")
    assert heading.heading_rad == pytest.approx(math.radians(150), abs=0.01)
    assert heading.sigma_rad == pytest.approx(math.radians(15), abs=0.01)
    assert before_s - 0.25 <= heading.time_s <= session_s(stage) + 0.25
    expect(page.locator("#compass-status")).to_contain_text("Heading 300° from magnetic north")
    page.get_by_role("button", name="Sharing compass").click()
    page.wait_for_timeout(2500)
    count = len(stage.headings)
    page.wait_for_timeout(1500)
    assert len(stage.headings) == count


def test_the_compass_says_what_is_missing_without_https(visit, stage: Stage):
    insecure = "Object.defineProperty(window, 'isSecureContext', { value: false });"
    page = visit("/phone", **PHONE, init=insecure)
    expect(page.locator("#connection")).to_have_attribute("data-state", "live")
    page.get_by_role("button", name="Share compass").click()
    expect(page.locator("#compass-status")).to_contain_text("only over HTTPS")
    expect(page.get_by_role("button", name="Share compass")).to_have_attribute(
        "aria-pressed", "false"
    )


def test_an_alarm_reaches_the_phones_and_addresses_its_wearer(visit, stage: Stage):
    page = visit("/phone", **PHONE)
    choose(page, "Ben")
    stage.team.still_since[2] = stage.at_s - 21.0
    expect(page.get_by_role("alert")).to_contain_text("You have not moved: move, or acknowledge")
    page.get_by_role("button", name="Acknowledge: Ben").click()
    wait_for(lambda: stage.acknowledged == [2])


@pytest.mark.parametrize("path", ["/", "/phone"])
def test_an_acknowledgement_that_reached_nobody_leaves_the_alarm_open(visit, stage: Stage, path):
    page = visit(path, expect_gone=True, **PHONE)
    if path == "/phone":
        choose(page, "Anna")
    page.route("**/api/acknowledge", lambda route: route.abort())
    stage.team.still_since[2] = stage.at_s - 31.0
    page.get_by_role("button", name="Acknowledge: Ben").click()
    expect(page.locator("#notices")).to_contain_text("Not acknowledged")
    expect(page.locator("#alarms .rows .alarm")).to_contain_text("Ben has not moved")
    page.unroute("**/api/acknowledge")
    page.get_by_role("button", name="Acknowledge: Ben").click()
    wait_for(lambda: stage.acknowledged == [2])
    expect(page.locator("#alarms .known")).to_contain_text("Ben has not moved")


def test_find_on_a_phone_says_where_else_an_ambiguous_person_may_be(visit, stage: Stage):
    stage.frozen = True
    stage.team.ambiguous = 2
    poses = {1: (0.0, 0.0, 0.0), 2: (10.0, 0.0, 0.0)}
    stage.team.pose = lambda node, time_s: poses.get(node, (20.0, float(node), 0.0))
    page = visit("/phone", **PHONE)
    choose(page, "Anna")
    page.get_by_role("button", name="Team", exact=True).click()
    page.get_by_role("button", name="Find Ben").click()
    caution = page.locator("#find .caution")
    expect(caution).to_contain_text("Ben may be elsewhere: 62 % where shown. Or, 29 %: 9 m")
    # There Ben is (-4, 7) m from where he is shown: (6, 7) m from Anna, who looks along x.
    expect(caution).to_contain_text("10 o'clock, ahead left")
    poses[1] = (0.0, 0.0, math.pi)
    expect(caution).to_contain_text("behind right")
    # What moves a third person is no other place of these two.
    stage.team.ambiguous = 3
    expect(caution).to_be_hidden()


def test_the_phones_page_works_on_the_smallest_screen_by_keyboard(visit, stage: Stage):
    page = visit("/phone", viewport={"width": 320, "height": 568})
    choose(page, "Fatima")
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
    expect(page.locator("#press")).to_be_in_viewport(ratio=1)
    for button in page.locator("#pad button, #press, nav button").all():
        box = button.bounding_box()
        assert box
        assert min(box["width"], box["height"]) >= 44
    field = page.get_by_label("Landmark", exact=True)
    field.focus()
    page.keyboard.type("8x")
    expect(field).to_have_value("8")
    page.keyboard.press("Enter")
    expect(page.locator("#queue")).to_contain_text("1 press stored")
    nameless = page.evaluate("""() => [...document.querySelectorAll("button, input")]
        .filter((e) => e.checkVisibility() && !e.textContent.trim()
            && !e.getAttribute("aria-label") && !(e.labels && e.labels.length)).length""")
    assert nameless == 0


def test_a_picture_that_changes_nothing_asks_for_no_frame(visit, stage: Stage):
    page = visit("/phone", **PHONE)
    choose(page, "Ben")
    wait_clock(page)
    stage.frozen = True
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")

    def styled() -> float:
        figures = session.send("Performance.getMetrics")["metrics"]
        return next(f["value"] for f in figures if f["name"] == "RecalcStyleCount")

    def styled_meanwhile() -> float:
        first, before = max(stage.sent), styled()
        wait_for(lambda: max(stage.sent) > first + 15)
        return styled() - before

    page.wait_for_timeout(1000)
    # A busy browser may still be drawing what came before.
    assert any(styled_meanwhile() <= 3 for _ in range(3))
