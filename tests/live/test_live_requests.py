"""What phones send: whose time counts, and that nothing counts twice."""

from dataclasses import replace

import pytest

from relpos.live.requests import Request, RequestHandler
from relpos.measurements import Event, Heading

STARTED_UNIX_S = 1_700_000_000.0


@pytest.fixture
def handler():
    return RequestHandler(lambda unix_s: unix_s - STARTED_UNIX_S)


def presses(*rows, arrived_s, offset_ms=0.0, sent_ms=None, node=3):
    body = {
        "node": node,
        "clock_offset_ms": offset_ms,
        "sent_unix_ms": sent_ms,
        "presses": [{"id": i, "landmark": m, "unix_ms": ms} for i, m, ms in rows],
    }
    return Request(1, "presses", STARTED_UNIX_S + arrived_s, body)


def unix_ms(session_s):
    return (STARTED_UNIX_S + session_s) * 1000.0


def test_a_press_has_the_phones_time_on_the_servers_clock(handler):
    # The phone's clock is 7 s behind the server's.
    request = presses(
        ("a", "17", unix_ms(100.0) - 7000.0),
        arrived_s=100.2,
        offset_ms=7000.0,
        sent_ms=unix_ms(100.1) - 7000.0,
    )
    reply, new = handler.presses(request)
    assert reply == {"accepted": ["a"]}
    assert new == [Event(pytest.approx(100.0), 3, "landmark", "17")]


def test_a_press_made_offline_keeps_its_own_time(handler):
    request = presses(("a", "4", unix_ms(100.0)), arrived_s=460.0, sent_ms=unix_ms(459.9))
    assert handler.presses(request)[1] == [Event(pytest.approx(100.0), 3, "landmark", "4")]


def test_the_same_press_counts_once_however_often_it_is_sent(handler):
    first = handler.presses(presses(("a", "4", unix_ms(10.0)), arrived_s=10.1))
    again = handler.presses(
        presses(("a", "4", unix_ms(10.0)), ("b", "5", unix_ms(11.0)), arrived_s=12.0)
    )
    assert len(first[1]) == 1
    assert again[0] == {"accepted": ["a", "b"]}, "the phone need not send it a third time"
    assert [event.value for event in again[1]] == ["5"]


def test_a_press_that_a_session_before_has_accepted_counts_no_second_time(handler):
    handler.accept(["a"])
    again = handler.presses(presses(("a", "4", unix_ms(10.0)), arrived_s=600.0))
    assert again == ({"accepted": ["a"]}, [])


def test_the_age_of_a_press_counts_when_a_clock_was_set_meanwhile(handler):
    # By the offset it would have been sent an hour ago: but it was sent now, 5 s after the press.
    request = presses(
        ("a", "4", unix_ms(95.0) - 3.6e6),
        arrived_s=100.0,
        offset_ms=0.0,
        sent_ms=unix_ms(100.0) - 3.6e6,
    )
    assert handler.presses(request)[1][0].time_s == pytest.approx(95.0)


def test_nothing_happens_after_it_was_sent(handler):
    request = presses(("a", "4", unix_ms(100.5)), arrived_s=100.0)
    assert handler.presses(request)[1][0].time_s == pytest.approx(100.0)


def test_a_phones_compass_is_a_heading_of_its_node(handler):
    rows = [{"unix_ms": unix_ms(50.0), "heading_rad": 1.5, "sigma_rad": None}]
    body = {"node": 2, "clock_offset_ms": 0.0, "sent_unix_ms": None, "headings": rows}
    _, new = handler.headings(Request(2, "headings", STARTED_UNIX_S + 50.1, body))
    assert new == [Heading(pytest.approx(50.0), 2, 1.5, None, "phone")]


def test_a_heading_whose_answer_was_lost_counts_once(handler):
    rows = [{"unix_ms": unix_ms(k), "heading_rad": 1.5, "sigma_rad": 0.2} for k in (50.0, 51.0)]
    for count, sent in ((1, rows[:1]), (1, rows), (0, rows)):
        body = {"node": 2, "clock_offset_ms": 0.0, "sent_unix_ms": None, "headings": sent}
        request = Request(2, "headings", STARTED_UNIX_S + 51.5, body)
        assert len(handler.headings(request)[1]) == count
    assert len(handler.headings(replace(request, body=body | {"node": 3}))[1]) == 2


@pytest.mark.parametrize("ms", [-1e305, -1e308, unix_ms(-200_000.0)])
def test_a_press_of_another_age_is_dropped_counted_and_not_sent_again(handler, ms):
    for offset_ms, sent_ms in ((0.0, None), (0.0, unix_ms(9.0)), (ms, 1e308)):
        request = presses(
            (f"{offset_ms}{sent_ms}", "4", ms), arrived_s=10.0, offset_ms=offset_ms, sent_ms=sent_ms
        )
        reply, new = handler.presses(request)
        assert len(reply["accepted"]) == 1
        assert new == []
    assert handler.counts["presses_beyond_bounds"] == 3


def test_a_heading_that_no_compass_shows_is_dropped_and_counted(handler):
    rows = [
        {"unix_ms": unix_ms(50.0), "heading_rad": 1e308, "sigma_rad": 1e-300},
        {"unix_ms": unix_ms(50.0), "heading_rad": 1.0, "sigma_rad": 1e308},
        {"unix_ms": unix_ms(50.0), "heading_rad": 1.0, "sigma_rad": 0.2},
    ]
    body = {"node": 2, "clock_offset_ms": 0.0, "sent_unix_ms": None, "headings": rows}
    reply, new = handler.headings(Request(2, "headings", STARTED_UNIX_S + 50.1, body))
    assert reply == {"accepted": 1}
    assert [heading.sigma_rad for heading in new] == [0.2]
    assert handler.counts["headings_beyond_bounds"] == 2


def test_the_ids_of_presses_take_no_more_memory_in_a_flood(handler, monkeypatch):
    monkeypatch.setattr("relpos.live.requests.MAX_ACCEPTED", 10)
    for k in range(30):
        handler.presses(presses((str(k), "4", unix_ms(5.0)), arrived_s=6.0))
    assert handler.presses(presses(("29", "4", unix_ms(5.0)), arrived_s=7.0))[1] == []
    assert len(handler.presses(presses(("3", "4", unix_ms(5.0)), arrived_s=7.0))[1]) == 1
