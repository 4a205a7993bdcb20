"""The accountability board: what people have said, and nothing else."""

from __future__ import annotations

import json
import math

import pytest

from relpos.live.alarms import Alarms
from relpos.live.board import Board, BoardError
from relpos.live.team_view import Alert
from relpos.measurements import Motion


def event(kind, unix_s=1000.0, by="Anna", **body):
    return {"kind": kind, "unix_s": unix_s, "by": by, **body}


def test_the_time_in_counts_from_entering_and_ends_with_leaving():
    board = Board()
    board.apply(event("board", node=2, state="entered", team="A"))
    board.apply(event("board", 1300.0, node=2, state="withdrawing"))
    assert board.people[2].entered_unix_s == 1000.0
    board.apply(event("board", 1400.0, node=2, state="out"))
    assert board.people[2].entered_unix_s is None
    assert board.people[2].team == "A"
    assert board.waiting == {2}


def test_air_is_what_somebody_has_entered_at_a_time():
    board = Board()
    board.apply(event("board", 1500.0, node=2, air_bar=250))
    assert (board.people[2].air_bar, board.people[2].air_unix_s) == (250, 1500.0)


def test_a_roll_call_is_complete_once_everybody_was_confirmed_by_somebody():
    board = Board()
    board.apply(event("rollcall", action="start", nodes=[1, 2, 3], within_s=600.0))
    for node in (1, 2):
        board.apply(event("rollcall", action="answer", node=node, answer="confirmed"))
    assert "incomplete" in board.apply(event("rollcall", action="end"))
    assert board.roll_call.outcome == "incomplete"
    board.apply(event("rollcall", action="start", nodes=[1, 2], within_s=600.0))
    board.apply(event("rollcall", action="answer", node=1, answer="confirmed"))
    board.apply(event("rollcall", action="answer", node=2, answer="missing"))
    board.apply(event("rollcall", action="end"))
    assert board.roll_call.outcome == "missing"
    board.apply(event("rollcall", action="start", nodes=[1], within_s=600.0))
    board.apply(event("rollcall", action="answer", node=1, answer="confirmed"))
    board.apply(event("rollcall", action="end"))
    assert board.roll_call.outcome == "complete"


def test_an_evacuation_knows_for_each_whether_it_was_shown_and_understood():
    board = Board()
    board.apply(event("evacuate", action="order", nodes=[1, 2]))
    board.apply(event("evacuate", 1001.0, action="lit", node=2))
    board.apply(event("evacuate", 1001.0, action="delivered", node=1))
    assert board.called_out == [1, 2]
    board.apply(event("evacuate", 1005.0, by="Ben", action="acknowledged", node=1))
    order = board.evacuation
    assert (list(order.delivered), order.acknowledged[1]["by"]) == ([1], "Ben")
    assert 2 not in order.acknowledged
    assert (order.lit, board.called_out) == ({2: 1001.0}, [2])
    # Node 1 has understood, went in again, and is ordered out again; 2 is still called.
    board.apply(event("evacuate", 1060.0, action="order", nodes=[1, 2]))
    assert (order.delivered, order.acknowledged, order.lit) == ({}, {}, {2: 1001.0})
    assert board.called_out == [1, 2]
    board.apply(event("evacuate", action="end"))
    assert board.evacuation is None


@pytest.mark.parametrize(
    "bad",
    [
        event("board", node=1, state="gone"),
        event("board", node=1, team="x" * 41),
        event("board", node=1, team=3),
        event("board", node=1, team="two\nlines"),
        event("board", node=1, air_bar=1e9),
        event("board", node=1, air_bar=math.nan),
        event("board", node=1, air_bar="full"),
        event("rollcall", action="end"),
        event("rollcall", action="start", nodes=3),
        event("rollcall", action="start", nodes=[1], within_s=math.nan),
        event("rollcall", action="start", nodes=[1], within_s="x"),
        event("mayday", node=1, on=False),
        event("mayday", node=1, on=True, id=""),
        event("mayday", node=1, on=True, id=["a"]),
        event("evacuate", action="acknowledged", node=1),
        event("evacuate", action="dance"),
    ],
    ids=str,
)
def test_a_request_that_makes_no_sense_changes_nothing(bad):
    board = Board()
    with pytest.raises(BoardError):
        board.apply(bad)
    assert board == Board()


@pytest.mark.parametrize(
    ("kind", "lacking"), [("board", "node"), ("mayday", "node"), ("marker", "id")]
)
def test_what_a_request_lacks_is_named_in_plain_words(kind, lacking):
    with pytest.raises(BoardError, match=f"^{lacking}: is missing$"):
        Board().apply(event(kind))


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (event("rollcall", action="start", nodes=7), "nodes: not a list"),
        (event("evacuate", action="order", nodes="12"), "nodes: not a list"),
        (event("rollcall", action="start", nodes=[1], within_s="soon"), "within_s: not from 0"),
        (event("marker", id="m", action="set", sign=["exit"]), "sign: none of "),
        (event("plan", action="set", image=5), "image: not the name of an image"),
        (event("board", node=[2], state="entered"), "board: a value is of the wrong type"),
        (event("floor", floor="1", name="attic"), "floor: not a number from -100 to 100"),
        (event("floor", floor=1, name="x" * 41), "name: not at most 40 printable characters"),
        (event("marker", id="", action="remove"), "id: not 1 to 40 printable characters"),
        (event("marker", id="m", action="remove"), "no such marker"),
        (event("plan", action="remove"), "there is no plan"),
    ],
    ids=str,
)
def test_a_value_of_the_wrong_type_is_refused_in_plain_words(bad, words):
    board = Board()
    with pytest.raises(BoardError, match=f"^{words}"):
        board.apply(bad)
    assert board == Board()


def test_a_marker_is_set_once_and_nobody_changes_its_sign_or_moves_it():
    board = Board()
    marker = {"action": "set", "id": "haz", "x_m": 1.0, "y_m": 2.0}
    board.apply(event("marker", sign="hazard", **marker))
    assert board.apply(event("marker", sign="hazard", **marker | {"x_m": 90.0})) is None
    with pytest.raises(BoardError, match="id: another marker has it"):
        board.apply(event("marker", sign="exit", by="Chief", **marker))
    assert (board.markers["haz"].sign, board.markers["haz"].x_m) == ("hazard", 1.0)


def test_a_marker_a_plan_and_the_name_of_a_floor_are_taken_away_again():
    board = Board()
    board.apply(event("marker", id="m", action="set", sign="exit", x_m=1.0, y_m=2.0))
    board.apply(event("plan", action="set", image="plan.png"))
    board.apply(event("floor", floor=-1, name=" cellar "))
    assert (list(board.markers), board.floors) == (["m"], {-1: "cellar"})
    board.apply(event("marker", id="m", action="remove"))
    board.apply(event("plan", action="remove", image="plan.png"))
    board.apply(event("floor", floor=-1, name=" "))
    assert board == Board()


@pytest.mark.parametrize("within_s", [600, 600.0, "600"])
def test_the_time_of_a_roll_call_may_be_any_numeral(within_s):
    board = Board()
    board.apply(event("rollcall", action="start", nodes=[1], within_s=within_s))
    assert repr(board.roll_call.within_s) == "600.0"


def test_a_mayday_that_is_over_does_not_begin_again_by_a_late_copy_of_its_call():
    board = Board()
    for call in (event("mayday", node=2, on=True, id="a"), event("mayday", node=2, on=False)):
        board.apply(call)
    assert board.apply(event("mayday", node=2, on=True, id="a")) is None
    assert board.mayday == {}
    board.apply(event("mayday", node=2, on=True, id="b"))
    assert list(board.mayday) == [2]
    json.dumps(board.to_message())


def test_the_same_events_give_the_same_board():
    events = [
        event("board", node=1, state="standby"),
        event("mayday", node=2, on=True),
        event("rollcall", action="start", nodes=[1, 2], emergency=True),
        event("rollcall", action="answer", node=1, answer="confirmed"),
        event("evacuate", action="order", nodes=[1, 2]),
    ]
    boards = [Board(), Board()]
    for board in boards:
        for one in events:
            board.apply(one)
    assert boards[0].to_message() == boards[1].to_message()


def test_who_waits_may_sit_still_and_a_mayday_is_above_all():
    alarms = Alarms()
    for second in range(60):
        for node in (1, 2):
            alarms.add_motion(Motion(float(second), node, 0.0, 0.0, 0.0, moving=False))
        alarms.waiting = {1}
        alarms.tick(float(second), listening=True)
    assert alarms.condition(1).alert is None
    assert alarms.condition(2).alert is Alert.STILL_ALARM
    alarms.mayday = {1}
    alarms.tick(60.0, listening=True)
    assert alarms.condition(1).alert is Alert.MAYDAY
    alarms.mayday.clear()
    alarms.waiting.clear()
    alarms.tick(60.5, listening=True)
    assert alarms.condition(1).alert is Alert.STILL_ALARM
