"""Nothing on the pages looks newer than it is: lost links, lost people, recordings."""

from __future__ import annotations

import re
import time
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from stage import Stage, wait_for, wait_live

SOUNDS = """
    window.tones = [];
    const start = OscillatorNode.prototype.start;
    OscillatorNode.prototype.start = function (...when) {
        window.tones.push(Math.round(this.frequency.value));
        return start.apply(this, when);
    };
"""
# Every visible element with text or a sign of its own that tells of the team: its colours, and
# those behind it; then the map's own pixels. The tools' words and buttons tell nothing of it.
COLOURED = """() => {
    const parse = (css) => (css.match(/[\\d.]+/g) || []).map(Number);
    const vivid = (css) => {
        const [r, g, b, a] = parse(css);
        return a !== 0 && Math.max(r, g, b) - Math.min(r, g, b) > 12;
    };
    const found = [];
    let checked = 0;
    const within = ["people", "people-title", "alarms", "notices", "table-view", "find",
        "others"].map((id) => `#${id} *`).join();
    for (const e of document.querySelectorAll(within)) {
        if (!e.checkVisibility() || e.closest(".unseen")) continue;
        checked += 1;
        const style = getComputedStyle(e);
        const shape = e.namespaceURI.includes("svg");
        const colours = shape ? [style.fill, style.stroke]
            : [style.color, style.backgroundColor, style.borderTopColor];
        if (colours.some(vivid) || getComputedStyle(e).animationName !== "none") {
            found.push(`${colours.filter(vivid)} ${e.outerHTML.slice(0, 80)}`);
        }
    }
    const canvas = document.getElementById("map");
    if (canvas) {
        const { width, height } = canvas;
        const pixels = canvas.getContext("2d").getImageData(0, 0, width, height).data;
        let vividPixels = 0;
        for (let k = 0; k < pixels.length; k += 4) {
            const [r, g, b] = [pixels[k], pixels[k + 1], pixels[k + 2]];
            if (Math.max(r, g, b) - Math.min(r, g, b) > 24) vividPixels += 1;
        }
        if (vividPixels) found.push(`${vividPixels} coloured pixels on the map`);
    }
    return [checked, found];
}"""
OVERLAPPING = """() => {
    const seen = [...document.querySelectorAll(".bar > *, .tools > *")]
        .filter((e) => e.checkVisibility() && e.textContent.trim())
        .map((e) => [e.id || e.tagName, e.getBoundingClientRect()]);
    return seen.flatMap(([a, p], k) => seen.slice(k + 1)
        .filter(([, q]) => p.left + 1 < q.right && q.left + 1 < p.right &&
            p.top + 1 < q.bottom && q.top + 1 < p.bottom)
        .map(([b]) => `${a} and ${b}`));
}"""
LIVE_WORDS = re.compile(r"\b(now|live|moves|node OK|located|warmer|colder)\b", re.IGNORECASE)


def texts(page: Page, selector: str) -> str:
    return " ".join(e.inner_text() for e in page.locator(selector).all() if e.is_visible())


def vivid(page: Page) -> list[str]:
    checked, found = page.evaluate(COLOURED)
    assert checked > 20
    return list(found)


@pytest.mark.parametrize(("how", "scheme"), [("session silent", "light"), ("server gone", "dark")])
def test_four_seconds_after_the_link_is_lost_no_value_looks_live(
    visit: Any, stage: Stage, how: str, scheme: str
) -> None:
    stage.team.still_since = {2: stage.at_s - 40.0}
    page = visit(expect_gone=True, init=SOUNDS, color_scheme=scheme)
    wait_live(page)
    page.locator("#sound").click()
    page.get_by_role("button", name="Table").click()
    page.get_by_role("button", name="Find Chloé").first.click()
    expect(page.locator("#find")).to_be_visible()
    assert vivid(page) != []
    assert LIVE_WORDS.search(texts(page, "#people li"))
    # From the server's last word on, by the page's own clock.
    page.evaluate("""() => { document.addEventListener("relpos:drawn", () => {
        if (!document.documentElement.dataset.link) window.last_live_ms = Date.now();
        else window.lost_ms ??= Date.now(); }); }""")
    if how == "session silent":
        stage.mute = True
    else:
        stage.shut()
    banner = page.locator("#link")
    expect(banner).to_be_visible()
    expect(banner).to_contain_text("No connection")
    wait_for(lambda: page.evaluate("window.lost_ms") is not None)
    # At most half a second later than the limit of 3.5 s, and what a busy machine adds.
    delay_ms = page.evaluate("window.lost_ms - window.last_live_ms")
    assert delay_ms < 6000
    assert page.title().startswith("NO CONNECTION")
    expect(page.get_by_role("alert").filter(has_text="Connection lost")).to_have_count(1)
    wait_for(lambda: 294 in page.evaluate("window.tones"))
    wait_for(lambda: vivid(page) == [])
    shown = texts(page, "#people li, #table, #find .order, #find .trend, #alarms, #table-caption")
    assert not LIVE_WORDS.search(shown.replace("0 of 6 people located", "")), shown
    expect(page.locator("#connection")).not_to_have_attribute("data-state", "live")
    assert page.evaluate(OVERLAPPING) == []
    expect(page.locator("#count")).to_have_text("(0 of 6 heard)")
    expect(page.locator("#find .order")).to_contain_text("no guidance")
    states = page.locator("#people li .state").all()
    before = [state.inner_text() for state in states]
    assert all("last news" in text for text in before)
    for state, text in zip(states, before, strict=True):
        expect(state).not_to_have_text(text)
    if how == "server gone":
        stage.open()
    stage.mute = False
    expect(banner).to_be_hidden()
    expect(page.locator("#count")).to_have_text("(6)")
    assert not page.title().startswith("NO CONNECTION")
    wait_for(lambda: vivid(page) != [])


def test_the_wearers_page_counts_up_when_the_link_is_lost(visit: Any, stage: Stage) -> None:
    page = visit("/phone", viewport={"width": 390, "height": 844}, expect_gone=True)
    page.get_by_role("button", name="Anna").click()
    page.get_by_role("button", name="This is me").click()
    expect(page.locator("#press")).to_be_visible()
    page.get_by_role("button", name="Team").click()
    expect(page.locator("#others .state").first).to_have_text("Moves")
    stage.mute = True
    expect(page.locator("#link")).to_be_visible()
    wait_for(lambda: vivid(page) == [])
    assert not LIVE_WORDS.search(texts(page, "#others"))
    stage.mute = False
    expect(page.locator("#link")).to_be_hidden()


def test_the_link_sound_can_be_silenced_and_comes_with_the_next_loss(
    visit: Any, stage: Stage
) -> None:
    page = visit(init=SOUNDS)
    wait_live(page)
    page.locator("#sound").click()
    stage.mute = True
    wait_for(lambda: 587 in page.evaluate("window.tones"))
    page.get_by_role("button", name="Silence").click()
    expect(page.get_by_role("button", name="Silence")).to_be_hidden()
    expect(page.locator("#link")).to_be_visible()
    stage.mute = False
    expect(page.locator("#link")).to_be_hidden()
    heard = page.evaluate("window.tones.length")
    stage.mute = True
    wait_for(lambda: page.evaluate("window.tones.length") > heard)


def test_a_lost_person_keeps_the_last_place_with_its_time_and_counts_as_lost(
    visit: Any, stage: Stage
) -> None:
    stage.team.lost_since[5] = stage.at_s - 60.0
    page = visit()
    wait_live(page)
    card = page.locator("#people li[data-node='5']")
    expect(card.locator(".sigma")).to_have_text(re.compile(r"to the last place, \d\d:\d\d:\d\d"))
    expect(card.locator(".health")).to_have_text("node silent")
    # The silence is told once, and by the node's sign.
    assert card.inner_text().count("ago") == 1
    assert "silent for" not in card.inner_text()
    expect(page.locator("#count")).to_have_text("(5 of 6 heard)")
    words = page.locator("#map-words")
    expect(words).to_contain_text("5 of 6 people located, last places of Emil")
    page.locator("#people").get_by_role("button", name="Find Emil").click()
    expect(page.locator("#find").get_by_role("heading")).to_contain_text("last place")
    expect(page.locator("#find .trend")).to_be_hidden()
    expect(page.locator("#find .caution")).to_contain_text(re.compile(r"on foot up to \d+"))
    page.keyboard.press("Escape")
    # Nobody is ever deleted.
    stage.team.lost_since[5] = stage.at_s - 7200.0
    expect(card.locator(".state")).to_contain_text("Lost: last heard 2:00 h ago")


def test_the_ring_of_a_lost_person_grows_at_walking_speed(visit: Any, stage: Stage) -> None:
    page = visit()
    reach = """async (s) => (await import("/static/js/age.js"))
        .reachM({ status: "lost", seen_s: s })"""
    assert page.evaluate(reach, 20.0) - page.evaluate(reach, 10.0) == pytest.approx(14.0)
    # Drawn: with a growing silence there is more on the map that is not ground.
    wait_live(page)
    stage.team.lost_since[5] = stage.at_s - 10.0
    expect(page.locator("#map-words")).to_contain_text("last places of Emil")
    drawn = """() => { window.radii = []; const arc = CanvasRenderingContext2D.prototype.arc;
        CanvasRenderingContext2D.prototype.arc = function (...a) {
            window.radii.push(a[2]); return arc.apply(this, a); }; }"""
    page.evaluate(drawn)
    wait_for(lambda: page.evaluate("Math.max(...window.radii)") > 100)


def test_a_recording_is_framed_and_has_its_own_clock_and_sound(visit: Any, stage: Stage) -> None:
    began = time.mktime((2024, 5, 17, 10, 20, 0, 0, 0, -1))
    stage.play_recording(began)
    page = visit(init=SOUNDS)
    pill = page.locator("#connection")
    expect(pill).to_have_attribute("data-state", "replay")
    expect(pill).to_contain_text("REPLAY")
    at = began + stage.at_s
    expect(pill).to_contain_text(time.strftime("%H:%M", time.localtime(at)))
    assert "Live" not in pill.inner_text()
    assert "now" not in pill.inner_text()
    assert "REPLAY" in page.title()
    frame = page.evaluate(
        "(() => { const s = getComputedStyle(document.body, '::after');"
        " return [s.position, parseFloat(s.borderTopWidth), s.borderTopColor]; })()"
    )
    assert frame[0] == "fixed"
    assert frame[1] >= 6
    page.locator("#sound").click()
    stage.team.still_since[2] = stage.at_s - 60.0
    # The sound's test, then one soft tone.
    wait_for(lambda: page.evaluate("window.tones") == [330, 330, 220])
