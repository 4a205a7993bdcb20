"""The view in a terminal: what it says, in eighty columns, without colour, without UTF-8."""

from __future__ import annotations

import codecs
import math
import os
import pty
import re
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from relpos.live.team_view import Alert, GhostPerson, Ghosts, Level, Notice, Person, TeamView
from relpos.view.keys import has_keys, raw_keys
from relpos.view.terminal import TerminalView
from relpos.view.text_page import Canvas, RenderOptions, page
from support.team_views import team_view
from support.waiting import until

STILL = {"alert": Alert.STILL_ALARM, "still_s": 33.0, "moving": False}


def lines(shown: TeamView, **options: Any) -> list[str]:
    return [line.plain for line in page(shown, RenderOptions(**options))]


def row_of(name: str, shown: list[str]) -> str:
    """The row of the table that somebody has."""
    head = next(k for k, line in enumerate(shown) if line.startswith("#"))
    return next((line for line in shown[head + 1 :] if line[4:].startswith(name)), "")


@pytest.mark.parametrize("utf8", [True, False])
@pytest.mark.parametrize(
    ("columns", "rows"),
    [(80, 24), (60, 15), (132, 43), (200, 12), (40, 10), (132, 4), (132, 1), (1, 9)],
)
@pytest.mark.parametrize("people", ["well", "in need", "empty"])
def test_the_page_is_as_large_as_the_terminal(
    columns: int, rows: int, utf8: bool, people: str
) -> None:
    shown = {
        "well": team_view(),
        "in need": team_view(
            changes={2: STILL, 3: {"alert": Alert.LOST, "status": "lost", "seen_s": 99.0}},
            notices=tuple(Notice(f"n{k}", Level.WARNING, "w" * 300, 0.0) for k in range(9)),
        ),
        "empty": team_view(people=(), pairs=()),
    }[people]
    made = page(shown, RenderOptions(columns=columns, rows=rows, utf8=utf8, me=2))
    assert len(made) == rows
    assert all(line.cell_len <= columns for line in made)
    if not utf8:
        assert all(line.plain.isascii() for line in made)


def test_distance_and_direction_are_those_from_me() -> None:
    # Node 2 stands at (12, 5) facing world x; node 1 at the origin.
    shown = team_view(changes={2: {"heading_rad": 0.0}})
    table = lines(shown, me=2)
    assert "me" in row_of("Kim", table)
    assert "13.0 m ±0.6" in row_of("Åsa", table)
    turned = math.degrees(math.atan2(-5.0, -12.0))
    assert f"{5 * round(abs(turned) / 5)}° right" in row_of("Åsa", table)
    # Seen the other way round, from somebody who faces y.
    shown = team_view(changes={1: {"heading_rad": math.pi / 2}})
    assert "65° right" in row_of("Kim", lines(shown, me=1))
    assert "65 right" in row_of("Kim", lines(shown, me=1, utf8=False))


def test_a_person_with_unknown_heading_has_no_direction() -> None:
    shown = team_view(changes={2: {"sigma_heading_rad": 1.5}})
    row = row_of("Åsa", lines(shown, me=2))
    assert "13.0 m" in row
    assert not re.search("left|right|ahead|behind", row)


def test_a_bearing_that_is_not_known_is_no_direction() -> None:
    shown = team_view()
    vague = tuple(replace(pair, sigma_bearing_rad=1.75) for pair in shown.pairs)
    row = row_of("Åsa", lines(replace(shown, pairs=vague), me=2))
    assert "13.0 m ±0.6" in row
    assert not re.search("left|right|ahead|behind", row)


@pytest.mark.parametrize("status", ["stale", "lost"])
def test_whoever_is_not_heard_has_a_last_place_and_no_face(status: str) -> None:
    silent = {"status": status, "seen_s": 75.0, "heading_rad": 0.0}
    # My node is silent: where I face is not known, nor how far the others are now.
    me_silent = lines(team_view(changes={2: silent}), me=2, columns=132, rows=40, heading_up=True)
    row = row_of("Åsa", me_silent)[:75]
    assert "last 13 m" in row
    assert not re.search("left|right|ahead|behind|±", row)
    assert any("up: y" in line for line in me_silent)
    assert "2→" in "".join(lines(team_view(changes={2: {"heading_rad": 0.0}}), me=1, rows=40))
    assert "2→" not in "".join(lines(team_view(changes={2: silent}), me=1, rows=40))
    row = row_of("Kim", lines(team_view(changes={2: silent, 1: {"heading_rad": 0.0}}), me=1))
    assert "last 13 m" in row
    assert "left" in row


def test_a_person_who_needs_help_is_on_top_in_words() -> None:
    gone = {"alert": Alert.LOST, "status": "lost", "seen_s": 75.0}
    shown = lines(team_view(changes={3: STILL, 4: gone, 1: {"alert": Alert.STILL_WARNING}}), me=2)
    assert shown[1].startswith("!! Li & Söhne LIES STILL for 33 s, 25 m from Kim")
    assert shown[2].startswith("!! node 4 is LOST: silent for 1 min")
    assert shown[3].startswith("! Åsa <1> has not moved")
    assert "STILL 33 s" in row_of("Li & Söhne", shown)
    assert "LOST" in row_of("node 4", shown)
    seen = lines(team_view(changes={3: {**STILL, "acknowledged": True}, 4: gone}), me=2)
    assert "node 4" in seen[1]
    assert seen[2].endswith("(seen to)")


def test_the_command_posts_node_is_no_person() -> None:
    silent = {"post": True, "alert": Alert.LOST, "status": "lost", "seen_s": 75.0}
    assert "post" in row_of("node 4", lines(team_view(changes={4: {"post": True}})))
    shown = lines(team_view(changes={4: silent}))
    assert "3 people" in shown[0]
    assert shown[1].startswith("! node 4 is silent for 1 min: no reference")
    assert "silent" in row_of("node 4", shown)
    assert not any("LOST" in line for line in shown)


def test_a_person_who_moves_again_is_not_shown_as_lying() -> None:
    shown = lines(team_view(changes={3: {**STILL, "moving": True, "still_s": 0.0}}), me=2)
    assert shown[1].startswith("!! Li & Söhne lay still, moves again")
    assert "moving" in row_of("Li & Söhne", shown)


def test_more_alarms_than_there_is_room_for_are_counted() -> None:
    notices = tuple(Notice(f"n{k}", Level.WARNING, f"notice {k}", 0.0) for k in range(9))
    shown = lines(team_view(changes={3: STILL}, notices=notices), me=2)
    assert "LIES STILL" in shown[1]
    assert shown[6] == "... and 5 more"


def test_faults_of_the_session_and_of_a_node_are_shown() -> None:
    notices = (Notice("port", Level.ALARM, "the port has vanished", 0.0),)
    ill = {"health": "yellow", "reasons": ("supply 4.40 V",)}
    shown = lines(team_view(changes={2: ill}, notices=notices), columns=100)
    assert "!! the port has vanished" in shown
    assert "supply 4.40 V" in row_of("Kim", shown)


def ghost(node: int, x_m: float, y_m: float, heading_rad: float = 0.0) -> GhostPerson:
    return GhostPerson(node, x_m, y_m, heading_rad, 0.5, 0.5, 0.0, "ellipse")


def ambiguous() -> TeamView:
    return team_view(
        changes={3: {"status": "ambiguous"}},
        ambiguous=True,
        alternatives=(
            Ghosts(0.7, (ghost(2, 12.0, 5.0), ghost(3, 22.0, 5.0))),
            Ghosts(0.3, (ghost(2, 12.0, 5.0), ghost(3, 12.0, 25.0))),
        ),
    )


def test_an_ambiguous_estimate_shows_the_possibilities() -> None:
    shown = lines(ambiguous(), me=2, table=True)
    assert "? ambiguous: 2 alternatives (70 %, 30 %)" in shown
    row = row_of("Li & Söhne", shown)
    assert "10 or 20 m" in row
    assert "↑ or ←" in row
    assert "ambiguous" in row
    drawn = "\n".join(shown)
    assert drawn.count("3?") == 2
    assert "ahead or " in row_of("Li & Sohne", lines(ambiguous(), me=2, utf8=False))


def test_the_map_shows_who_is_where() -> None:
    shown = lines(team_view(), me=1, columns=100, rows=40, table=False)
    places = {}
    for row, line in enumerate(shown):
        for found in re.finditer(r"(?<![\d?])([1-4])[↑↖←↙↓↘→↗]", line):
            places[int(found[1])] = (found.start(), row)
    assert set(places) == {1, 2, 3, 4}
    # x to the right, y up; a character is twice as high as wide.
    right = (places[2][0] - places[1][0]) / (places[1][1] - places[2][1])
    assert right == pytest.approx(2.0 * 12.0 / 5.0, rel=0.35)
    assert places[3][1] < places[1][1] < places[4][1]
    assert places[3][0] < places[1][0] < places[4][0]


def test_the_map_has_north_up_once_that_is_known() -> None:
    shown = lines(team_view(north_rad=0.0), me=1, columns=100, rows=40, table=False)
    places = {
        int(found[1]): (found.start(), row)
        for row, line in enumerate(shown)
        for found in re.finditer(r"(?<![\d?])([1-4])[↑↖←↙↓↘→↗]", line)
    }
    # North lies along x: what was to the right is up, and what was up is to the left.
    assert places[2][1] < places[1][1]
    assert places[3][0] < places[1][0] < places[4][0]
    assert any("up: magnetic north" in line for line in shown)
    assert any("up: y" in line for line in lines(team_view(), me=1, columns=100, rows=40))


def test_the_scale_is_true() -> None:
    shown = lines(team_view(), me=1, columns=100, rows=40, table=False)
    bar = next(re.search(r"├─*┤ (\d+) m", line) for line in shown if "├" in line)
    assert bar is not None
    cells_per_m = len(bar[0].split(" ")[0]) / float(bar[1])
    by_node = {int(m[1]): m.start() for line in shown for m in re.finditer(r"([24])[↑←→↓]", line)}
    assert (by_node[2] - by_node[4]) / cells_per_m == pytest.approx(9.0, abs=1.0)


def test_my_face_is_up_when_it_is_wanted() -> None:
    # I face x; who is ahead of me, at larger x, is above me then.
    shown = team_view(changes={1: {"heading_rad": 0.0}})
    drawn = lines(shown, me=1, rows=40, table=False, heading_up=True)
    rows = {int(m[1]): k for k, line in enumerate(drawn) for m in re.finditer(r"([12])[←-↙]", line)}
    assert rows[2] < rows[1]
    assert any("up: where I face" in line for line in drawn)


def test_zoom_changes_the_scale_and_keeps_everybody() -> None:
    wide = "\n".join(lines(team_view(), me=1, rows=40, table=False, zoom=-3))
    near = "\n".join(lines(team_view(), me=1, rows=40, table=False, zoom=3))
    scale = [float(re.findall(r"┤ ([\d.]+) m", text)[0]) for text in (wide, near)]
    assert scale[0] > scale[1]
    # Who is beyond the border stands at it.
    assert all(re.search(rf"(?m){node}[←-↙]", near) for node in (1, 2, 3, 4))


def test_people_in_need_stay_and_the_rest_rotates_on_a_small_screen() -> None:
    people = tuple(
        Person(node, f"Wearer {node}", float(node), 0.0, status="ok", seen_s=0.1)
        for node in range(1, 21)
    )
    people = (*people[:18], Person(19, "Wearer 19", 19.0, 0.0, alert=Alert.LOST), people[19])
    seen: set[str] = set()
    for second in range(60):
        shown = lines(team_view(people=people, pairs=(), time_s=float(second)), me=5)
        names = [m[0] for line in shown[2:] if (m := re.search(r"Wearer \d+", line))]
        assert names[:2] == ["Wearer 5", "Wearer 19"]
        assert any("page " in line for line in shown)
        seen.update(names)
    assert len(seen) == 20


def test_a_name_cannot_command_the_terminal() -> None:
    evil = "Eve\x1b[2J\x07\u202e"
    shown = team_view(
        changes={1: {"name": evil, "alert": Alert.LOST, "reasons": ("\x1b]0;x\x07",)}},
        notices=(Notice("n", Level.INFO, "\x9b1m", 0.0),),
    )
    text = "".join(lines(shown, me=2))
    assert "Eve?[2J??" in text
    assert all(letter.isprintable() for letter in text)


def test_wide_names_keep_the_columns_in_line() -> None:
    made = page(team_view(changes={1: {"name": "消防士田中太郎一郎"}}), RenderOptions(me=2))
    rows = [line for line in made if "13.0 m" in line.plain or "16.6 m" in line.plain]
    from rich.cells import cell_len

    starts = {cell_len(row.plain[: row.plain.index(" m ±")]) for row in rows}
    assert len(rows) == 2
    assert len(starts) == 1


def test_the_canvas_sets_the_dots_of_braille() -> None:
    canvas = Canvas(2, 1, utf8=True)
    canvas.dot(0, 0)
    canvas.dot(3, 3)
    canvas.dot(9, 9)
    assert canvas.lines() == ["⠁⢀"]


class Screen:
    """A terminal of eighty by twenty-four: what stands on it, and what came over the line."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        import fcntl
        import struct
        import termios

        fcntl.ioctl(self._slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self.stream = os.fdopen(self._slave, "w", encoding="utf-8")
        self.received = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def close(self) -> None:
        """End the line; its reader first, lest it read from the next one with that number."""
        self.stream.close()
        self._reader.join(10.0)
        os.close(self.master)

    def _read(self) -> None:
        decoder = codecs.getincrementaldecoder("utf-8")()
        with suppress(OSError):
            while data := os.read(self.master, 65536):
                self.received += decoder.decode(data)

    def rows(self) -> list[str]:
        rows = [""] * 24
        written = self.received.split("\x1b[2J")[-1]
        for number, text in re.findall(
            r"\x1b\[(\d+);1H\x1b\[K([^\x1b]*(?:\x1b\[[\d;]*m[^\x1b]*)*)", written
        ):
            rows[int(number) - 1] = re.sub(r"\x1b\[[\d;]*m", "", text).rstrip("\a")
        return rows


@pytest.fixture
def screen() -> Iterator[Screen]:
    made = Screen()
    yield made
    made.close()


@pytest.fixture
def view(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> Iterator[TerminalView]:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.delenv("LINES", raising=False)
    made = TerminalView(me=2, stream=screen.stream, keys=False)
    yield made
    made.close()


def test_the_terminal_shows_the_newest_view_and_is_restored_at_the_end(
    screen: Screen, view: TerminalView
) -> None:
    view.updated(team_view())
    until(lambda: "Kim" in "".join(screen.rows()), "nothing is drawn")
    view.updated(team_view(changes={2: {"name": "Robin"}}))
    until(lambda: "Robin" in "".join(screen.rows()), "the next view is not drawn")
    assert "Kim" not in "".join(screen.rows())
    assert screen.rows()[-1].startswith("a seen to")
    assert view.trouble() is None
    view.close()
    until(lambda: screen.received.endswith("\x1b[?7h\x1b[?25h\x1b[?1049l"), "it is left drawn on")


def test_the_bell_rings_when_an_alarm_begins_and_not_when_it_is_muted(
    screen: Screen, view: TerminalView
) -> None:
    view.updated(team_view())
    until(lambda: "Kim" in screen.received, "nothing is drawn")
    assert "\a" not in screen.received
    view.updated(team_view(2, changes={3: STILL}))
    until(lambda: "\a" in screen.received, "the bell does not ring")
    view.press("b")
    until(lambda: "bell off" in screen.rows()[0], "it does not say that it is muted")
    rung = screen.received.count("\a")
    view.updated(team_view(3, changes={1: STILL, 3: STILL}))
    until(lambda: "sa <1> LIES STILL" in "".join(screen.rows()), "the second is not shown")
    assert screen.received.count("\a") == rung


def test_the_bell_goes_on_for_a_person_and_not_for_a_cable(
    screen: Screen, view: TerminalView, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("relpos.view.terminal.BELL_S", 0.0)
    monkeypatch.setattr("relpos.view.terminal.DRAW_S", 0.02)
    cable = (Notice("port", Level.ALARM, "the port has vanished", 0.0),)
    view.updated(team_view(notices=cable))
    until(lambda: "\a" in screen.received, "the bell does not ring")
    seen = screen.received.count("time")
    for seq in range(20):
        view.updated(team_view(seq, notices=cable))
        time.sleep(0.03)
    assert screen.received.count("\a") == 1 + seen
    view.updated(team_view(changes={3: STILL}))
    until(lambda: screen.received.count("\a") >= 5, "it does not go on")
    view.updated(team_view(changes={3: {**STILL, "acknowledged": True}}))
    until(lambda: "(seen to)" in "".join(screen.rows()), "it is not shown as seen to")
    rung = screen.received.count("\a")
    time.sleep(0.2)
    assert screen.received.count("\a") == rung


def test_a_key_says_that_the_worst_alarm_is_seen_to(screen: Screen, view: TerminalView) -> None:
    lost = {"alert": Alert.LOST, "status": "lost"}
    view.updated(team_view(changes={1: lost, 3: STILL}))
    until(lambda: "LOST" in "".join(screen.rows()), "nothing is drawn")
    for node, others in ((3, {1: lost, 3: {**STILL, "acknowledged": True}}), (1, {1: lost})):
        view.press("a")
        (request,) = view.requests()
        assert (request.kind, request.body) == ("acknowledge", {"node": node})
        view.updated(team_view(changes=others))
    view.updated(team_view())
    view.press("a")
    assert view.requests() == []


def test_keys_change_whose_view_it_is(screen: Screen, view: TerminalView) -> None:
    view.updated(team_view())
    until(lambda: "me" in row_of("Kim", ["#", *screen.rows()]), "nothing is drawn")
    view.press("m")
    until(lambda: " me " in row_of("Li", ["#", *screen.rows()]), "it is still Kim's view")
    view.press("M")
    until(lambda: " me " in row_of("Kim", ["#", *screen.rows()]), "it is not Kim's view")
    view.press("c")
    until(lambda: not any(r.startswith("#") for r in screen.rows()), "the table stays")


def test_q_ends_the_session_as_ctrl_c_does(
    view: TerminalView, monkeypatch: pytest.MonkeyPatch
) -> None:
    # os.kill(pid, SIGINT) terminates the process on Windows, before any file is closed.
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("the process is killed"))
    ended = threading.Event()
    before = signal.signal(signal.SIGINT, lambda *_: ended.set())
    try:
        view.press("q")
        until(ended.is_set, "nothing ends")
    finally:
        signal.signal(signal.SIGINT, before)


def test_keys_are_read_from_the_console_of_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    typed = ["q", "m"]
    console = SimpleNamespace(kbhit=lambda: bool(typed), getwch=lambda: typed.pop())
    monkeypatch.setitem(sys.modules, "msvcrt", console)
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
    assert has_keys()
    read, restore = raw_keys()
    assert [read(0.05) for _ in range(3)] == ["m", "q", ""]
    restore()


def test_a_terminal_that_is_gone_is_reported_and_ends_nothing() -> None:
    screen = Screen()
    view = TerminalView(stream=screen.stream, keys=False)
    view.updated(team_view())
    until(lambda: "Kim" in screen.received, "nothing is drawn")
    os.close(screen.master)

    def drawn() -> bool:
        view.updated(team_view(int(10.0 * time.monotonic())))
        return view.trouble() is not None

    until(drawn, "the error is not reported")
    assert str(view.trouble()).startswith("terminal view: ")
    view.close()
    with suppress(OSError):
        screen.stream.close()


def test_a_terminal_that_does_not_know_its_size_is_drawn_on(
    screen: Screen, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "get_terminal_size", lambda _: os.terminal_size((0, 0)))
    view = TerminalView(2, stream=screen.stream, keys=False)
    view.updated(team_view(1))
    until(lambda: "node 4" in screen.rows()[5], "not everybody is drawn")
    assert view.trouble() is None
    view.close()


def test_a_file_gets_plain_pages(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("relpos.view.terminal.PLAIN_S", 0.05)
    monkeypatch.setenv("TERM", "xterm")  # a dumb one has no plus-minus sign
    with (tmp_path / "log.txt").open("w", encoding="utf-8") as file:
        view = TerminalView(me=2, stream=file)
        view.updated(team_view())
        until(lambda: "Kim" in (tmp_path / "log.txt").read_text("utf-8"), "no page")
        view.close()
    text = (tmp_path / "log.txt").read_text("utf-8")
    assert "\x1b" not in text
    assert "\a" not in text
    assert "13.0 m ±0.6" in text
