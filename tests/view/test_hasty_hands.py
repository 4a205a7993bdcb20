"""Hasty and gloved hands, and a network that swallows everything: what was pressed is told."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from typing import Any

from playwright.sync_api import Browser, Page, Route, expect
from stage import Stage, wait_for, wait_live

BY_HAND: dict[str, Any] = {
    "viewport": {"width": 390, "height": 844},
    "has_touch": True,
    "is_mobile": True,
}
PRESS = "document.getElementById('mayday').dispatchEvent(new PointerEvent('pointerdown'))"
RELEASE = "document.getElementById('mayday').dispatchEvent(new PointerEvent('pointerup'))"


class Hole:
    """A network before the server that can swallow all that goes through it."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.swallows = False
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def url(self, path: str) -> str:
        return self._stage.url(path).replace(str(self._stage.access.port), str(self.port), 1)

    def _accept(self) -> None:
        while True:
            near, _ = self._listener.accept()
            far = socket.create_connection(("127.0.0.1", self._stage.access.port))
            for ends in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=ends, daemon=True).start()

    def _carry(self, a: socket.socket, b: socket.socket) -> None:
        while data := _received(a):
            while self.swallows:
                time.sleep(0.02)
            with contextlib.suppress(OSError):
                b.sendall(data)
        for end in (a, b):
            end.close()


def _received(end: socket.socket) -> bytes:
    try:
        return end.recv(1 << 16)
    except OSError:
        return b""


def wearer(page: Page, name: str) -> Page:
    page.get_by_role("button", name=name).click()
    page.get_by_role("button", name="This is me").click()
    expect(page.locator("#press")).to_be_visible()
    return page


def press_landmark(page: Page) -> None:
    page.locator("#pad button").first.click()
    page.locator("#press").click()


def test_a_mayday_that_is_not_sent_says_so_and_does_not_vanish(
    browser: Browser, stage: Stage
) -> None:
    hole = Hole(stage)
    context = browser.new_context(**BY_HAND)
    page = context.new_page()
    page.goto(hole.url("/phone"))
    wearer(page, "Anna")
    press_landmark(page)
    hole.swallows = True
    page.evaluate(PRESS)
    words = page.locator("#mayday-words")
    expect(words).to_have_text("MAYDAY is being sent", timeout=3000)
    page.evaluate(RELEASE)
    expect(words).to_contain_text("MAYDAY NOT SENT. Use the radio.", timeout=15_000)
    expect(words).to_be_in_viewport(ratio=1)
    # The last landmark is told each second, and takes its place no more.
    page.wait_for_timeout(2500)
    expect(words).to_contain_text("MAYDAY NOT SENT")
    # It is called again until the session has it.
    hole.swallows = False
    wait_for(lambda: 1 in stage.board.mayday)
    expect(words).to_have_text("MAYDAY was sent")
    stage.set_board({"kind": "mayday", "node": 1, "on": False})
    expect(words).to_have_text("")
    context.close()


def test_a_mayday_is_called_until_the_session_has_it_also_by_a_page_that_was_closed_meanwhile(
    visit: Any, stage: Stage
) -> None:
    page = wearer(visit("/phone", expect_gone=True, **BY_HAND), "Anna")
    wait_live(page)
    calls: list[Any] = []

    def abort(route: Route) -> None:
        calls.append(route.request.post_data_json)
        route.abort()

    page.route("**/api/mayday", abort)
    page.evaluate(PRESS)
    words = page.locator("#mayday-words")
    expect(words).to_contain_text("MAYDAY NOT SENT")
    assert not stage.board.mayday
    context = page.context
    page.close()
    page = visit("/phone", context=context)
    wait_for(lambda: 1 in stage.board.mayday, 10.0)
    expect(page.locator("#mayday-words")).to_have_text("MAYDAY was sent")
    # Once: the commander has ended it, and the page is opened once more.
    stage.set_board({"kind": "mayday", "node": 1, "on": False})
    page.reload()
    wait_live(page)
    page.wait_for_timeout(1500)
    assert not stage.board.mayday
    # A browser repeats what got no answer; a copy may come when all is over.
    assert page.request.post(stage.url("/api/mayday"), data=calls[0]).ok
    assert not stage.board.mayday


def test_a_page_that_is_opened_the_next_day_calls_no_mayday_of_the_day_before(
    visit: Any, stage: Stage
) -> None:
    old = "Date.now() - 24 * 3600e3"
    call = f"JSON.stringify({{ node: 1, by: 'Anna', unix_ms: {old} }})"
    page = visit("/phone", init=f"localStorage.setItem('relpos.mayday', {call})", **BY_HAND)
    wait_live(page)
    page.wait_for_timeout(1500)
    assert not stage.board.mayday


def test_the_mayday_is_in_view_on_every_page_of_the_phone_and_hides_no_key(
    visit: Any, stage: Stage
) -> None:
    for size in ({"width": 390, "height": 844}, {"width": 320, "height": 568}):
        page = wearer(visit("/phone", viewport=size), "Anna")
        covers = """() => document.elementsFromPoint(innerWidth / 2,
            document.querySelector("#press").getBoundingClientRect().bottom - 3)[0].id"""
        assert page.evaluate(covers) == "press"
        for tab in ("Landmarks", "Team", "Me"):
            page.locator("nav").get_by_role("button", name=tab, exact=True).click()
            expect(page.locator("#mayday")).to_be_in_viewport(ratio=1)
        page.evaluate("localStorage.clear()")
        page.close()


def test_a_thumb_that_drifts_still_holds_the_mayday(visit: Any, stage: Stage) -> None:
    page = wearer(visit("/phone", **BY_HAND), "Anna")
    box = page.locator("#mayday").bounding_box()
    assert box
    x, y = box["x"] + 60, box["y"] + box["height"] - 4
    touch = page.context.new_cdp_session(page)
    for k in range(16):
        point = {"x": x + k, "y": y - min(3 * k, 40)}
        kind = "touchStart" if k == 0 else "touchMove"
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [point]})
        page.wait_for_timeout(100)
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    wait_for(lambda: 1 in stage.board.mayday, 5.0)


def test_a_key_that_stays_down_ends_a_mayday_and_calls_none(visit: Any, stage: Stage) -> None:
    page = visit()
    wait_live(page)
    stage.set_board({"kind": "mayday", "node": 3, "on": True})
    page.locator("#show-board").click()
    page.locator("#board-rows tr[data-node='3']").get_by_role("button", name="End MAYDAY").focus()
    page.keyboard.down("Enter")
    wait_for(lambda: stage.board.mayday == {})
    for _ in range(25):
        page.keyboard.down("Enter")  # The key repeats.
        page.wait_for_timeout(100)
        assert stage.board.mayday == {}
    page.keyboard.up("Enter")


def test_the_answer_to_an_order_stays_under_the_thumb_while_others_answer(
    visit: Any, stage: Stage
) -> None:
    page = wearer(visit("/phone", **BY_HAND), "Anna")
    stage.set_board({"kind": "evacuate", "action": "order", "nodes": [1, 2, 3]})
    button = page.locator("#orders").get_by_role("button", name="Understood")
    expect(button).to_be_visible()
    wait_for(lambda: 1 in stage.board.evacuation.delivered)
    page.wait_for_timeout(500)
    page.evaluate("""() => { window.first = document.querySelector("#orders button");
        window.vibrated = 0; navigator.vibrate = () => { window.vibrated += 1; return true; }; }""")
    for node in (2, 3):
        stage.set_board({"kind": "evacuate", "action": "acknowledged", "node": node})
    stage.set_board({"kind": "board", "node": 4, "task": "the end"})
    page.wait_for_timeout(1000)
    assert page.evaluate("[window.first.isConnected, window.vibrated]") == [True, 0]
    button.click()
    wait_for(lambda: 1 in stage.board.evacuation.acknowledged)
    expect(page.locator("#orders")).to_contain_text("EVACUATE: understood")


def test_the_board_shows_what_the_session_has_also_in_the_field_with_the_focus(
    visit: Any, stage: Stage
) -> None:
    page = visit()
    wait_live(page)
    page.locator("#show-board").click()
    state = page.locator("#board-rows tr[data-node='4'] select")
    state.focus()
    state.select_option("entered")
    wait_for(lambda: 4 in stage.board.people and stage.board.people[4].state == "entered")
    stage.set_board({"kind": "board", "node": 4, "state": "out"})
    expect(state).to_have_value("out")
    expect(state).to_be_focused()
    # What is being typed stays.
    task = page.locator("#board-rows tr[data-node='4'] input").nth(2)
    task.press_sequentially("second flo")
    stage.set_board({"kind": "board", "node": 4, "task": "first floor"})
    page.wait_for_timeout(800)
    expect(task).to_have_value("second flo")


def test_the_board_has_no_rows_of_a_session_before(visit: Any, stage: Stage) -> None:
    page = visit(expect_gone=True)
    wait_live(page)
    page.locator("#show-board").click()
    rows = page.locator("#board-rows tr")
    expect(rows).to_have_count(6)
    stage.team.size = 4
    stage.begin_another_session()
    expect(rows).to_have_count(4)


def test_what_went_wrong_is_told_for_a_minute_and_not_for_ever(visit: Any, stage: Stage) -> None:
    page = visit(init="const real = setTimeout; window.setTimeout = (f, ms) => real(f, ms / 20);",
        expect_gone=True)  # fmt: skip
    wait_live(page)
    page.route("**/api/rollcall", lambda route: route.abort())
    page.locator("#show-board").click()
    page.locator("#roll-start").click()
    expect(page.locator("#notices")).to_contain_text("The board has not changed")
    expect(page.locator("#notices")).to_be_empty(timeout=10_000)
