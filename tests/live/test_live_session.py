"""A session over an emulated team, in virtual time: what is shown, kept and survived."""

import json
import math
import os
import pty
import threading
import time

import pytest
from team_input import Album, TeamInput, make_session, run_through

from relpos import fusion
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.fusion.linear_algebra import one_thread
from relpos.link import xbee
from relpos.link.authentication import KEYLESS, SeenCounters
from relpos.link.decoder import Decoder
from relpos.link.port import Link
from relpos.live.assembly import SessionPlan, run_session
from relpos.live.composer import Composer
from relpos.live.inputs import PacedInput, PortInput, Received
from relpos.live.notices import REMARK_S, NoticeBoard
from relpos.live.requests import Request
from relpos.live.sinks import Sink
from relpos.live.team_view import Alert
from relpos.measurements import Event, Measurement, Motion
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.runs import Description, load_run, read_estimates


def deadreckoning(priors):
    return fusion.make("deadreckoning", priors)


@pytest.fixture(scope="module")
def walk():
    """Forty seconds of three people through a session with the default estimator."""
    with EmulatedTeam(TeamConfig("paper", 3, 40.0, 3, beacons=True)) as team:
        priors = team.priors()
        session, album = make_session(
            TeamInput(team), lambda p: fusion.make("bank", p), priors=priors, paced=True
        )
        yield run_through(session), album, priors


def test_the_view_has_every_node_with_all_that_is_known(walk):
    _, album, _ = walk
    last = album.views[-1]
    assert [person.node for person in last.people] == [1, 2, 3]
    for person in last.people:
        assert person.status == "ok"
        assert person.x_m is not None
        assert person.sigma_major_m > person.sigma_minor_m > 0.0
        assert (person.health == "green") == (not person.reasons)
        assert person.battery_v > 4.0
        assert person.neighbours == 2
    assert len(last.pairs) == 3
    assert last.ranges
    message = json.loads(last.to_json())
    assert message["type"] == "picture"
    assert len(message["people"]) == len(message["pairs"]) == 3
    assert message["pairs"][0][:2] == [1, 2]


def test_the_view_runs_ahead_of_the_fused_estimate(walk):
    _, album, _ = walk
    later = [p for p in album.views if p.time_s > 20.0][:-1]
    assert all(p.fused_s < p.time_s for p in later)
    # Motion comes once a second; the fusion waits for the slowest node.
    assert all(p.time_s - person.motion_s < 2.0 for p in later for person in p.people)
    assert max(p.time_s - p.fused_s for p in later) > 1.0


def test_replaying_the_recorded_bytes_gives_the_same_estimates_to_the_last_bit(walk):
    outcome, album, priors = walk
    assert outcome.estimates == len(album.estimates) > 30
    link, estimator, again = Link(), fusion.make("bank", priors), []
    with one_thread():
        for arrival_s, data in album.bytes:
            for o in link.feed(data, arrival_s):
                if isinstance(o, Measurement):
                    again += estimator.process(o)
        again += estimator.finish()
    assert again == album.estimates


def test_the_recording_has_what_was_decoded_in_its_order(walk):
    _, album, _ = walk
    link = Link()
    decoded = [o for arrival_s, data in album.bytes for o in link.feed(data, arrival_s)]
    assert [o for _, o in album.observations] == decoded
    assert album.closed


def test_a_node_that_falls_silent_is_stale_then_lost():
    with EmulatedTeam(
        TeamConfig("straight", 3, 60.0, 3, beacons=True, faults=["node:off:node=2,from=25,to=100"])
    ) as team:
        session, album = make_session(TeamInput(team), deadreckoning, priors=team.priors())
        run_through(session)
    states = {}
    for view in album.views:
        for person in view.people:
            if person.node == 2:
                states.setdefault((person.status, person.alert), view.time_s)
            else:
                assert person.alert is not Alert.LOST
    assert ("stale", None) in states
    assert 25.0 + 9.0 < states["lost", Alert.LOST] < 25.0 + 14.0


def asleep(seconds, at_s=30.0, until_s=120.0):
    with EmulatedTeam(TeamConfig("paper", 3, until_s, 5, beacons=True)) as team:
        source = TeamInput(team)
        source.sleep(at_s, seconds)
        # The team's clock is the session's; a virtual one would come over the link.
        session, album = make_session(source, deadreckoning, priors=team.priors())
        run_through(session)
        return source, album


def test_a_laptop_that_slept_for_a_minute_raises_no_alarm_and_says_that_it_slept():
    source, album = asleep(60.0)
    after = [p for p in album.views if p.time_s > 90.0]
    assert any("slept for 60 s" in n.text for p in after for n in p.notices)
    assert not [person for p in after for person in p.people if person.alert is not None]
    assert {person.status for person in album.views[-1].people} == {"ok"}
    # The nodes' clocks are as right as before: motions lie where they were made.
    for node, track in source.link.decoder.nodes.items():
        late = [o.time_s - t for t, o in album.observations if isinstance(o, Motion) and t > 92.0
                and o.node == node]  # fmt: skip
        assert late
        assert all(-0.15 < lag_s <= 0.0 for lag_s in late)
        assert abs(track.clock.drift) < 0.006


def test_a_port_that_is_gone_is_reported_and_makes_no_node_lost():
    with EmulatedTeam(TeamConfig("paper", 3, 90.0, 5, beacons=True)) as team:
        source = TeamInput(team)
        source.unplug(30.0, 30.0)
        session, album = make_session(source, deadreckoning, priors=team.priors())
        run_through(session)
    gone = [p for p in album.views if 32.0 < p.time_s < 59.0]
    assert all(any("port vanished" in n.text for n in p.notices) for p in gone)
    assert gone[-1].people[0].status == "stale"
    back = [p for p in album.views if p.time_s > 64.0]
    assert not any("port vanished" in n.text for p in back for n in p.notices)
    everyone = [person for p in album.views for person in p.people]
    assert not [person for person in everyone if person.alert is Alert.LOST]
    assert {person.status for person in back[-1].people} == {"ok"}


def test_a_laptop_whose_clock_is_set_while_nothing_arrives_hides_no_silence(monkeypatch):
    now_s = time.time
    with EmulatedTeam(TeamConfig("straight", 2, 20.0, 5, beacons=True)) as team:
        source = TeamInput(team)
        source.unplug(10.0, 10.0)
        monkeypatch.setattr(time, "time", lambda: now_s() - 3600.0 * (source.now_s() > 12.0))
        session, album = make_session(source, deadreckoning, priors=team.priors())
        run_through(session)
    silent = [view for view in album.views if 13.0 < view.time_s < 19.0]
    ages_s = [view.unix_s - view.arrived_unix_s for view in silent]
    assert ages_s == sorted(ages_s)
    assert 0.0 < ages_s[0] < ages_s[-1] < 300.0


class Slow:
    """An estimator that is held up until it is let go."""

    def __init__(self, priors):
        self._own = deadreckoning(priors)
        self.go = threading.Event()

    def process(self, measurement):
        self.go.wait(60.0)
        return self._own.process(measurement)

    def finish(self):
        return self._own.finish()

    def counters(self):
        return self._own.counters()


def test_a_fusion_that_falls_behind_holds_up_nothing_and_loses_nothing():
    made = []

    def make(priors):
        made.append(Slow(priors))
        return made[0]

    with EmulatedTeam(TeamConfig("straight", 3, 40.0, 3, beacons=True)) as team:
        session, album = make_session(TeamInput(team), make, priors=team.priors())
        for _ in session.run():
            pass
        shown = album.views[-1]
        behind = [n.text for n in shown.notices if n.id == "fusion"]
        made[0].go.set()
        outcome = session.finish()
    assert shown.time_s > 35.0
    assert all(person.motion_s > 35.0 for person in shown.people)
    assert not album.estimates or shown.fused_s is None
    assert "s behind" in behind[0]
    motions = sum(isinstance(o, Motion) for _, o in album.observations)
    assert outcome.last.time_s > 37.0
    assert outcome.failure is None
    assert motions > 100


class Broken(Sink):
    def updated(self, view):
        raise RuntimeError("no ink")


class Troubled(Sink):
    def trouble(self):
        return "disk full: 12 s wait in memory"


def test_a_sink_that_fails_is_reported_and_the_others_go_on():
    with EmulatedTeam(TeamConfig("straight", 2, 8.0, 3, beacons=True)) as team:
        session, album = make_session(
            TeamInput(team), deadreckoning, Broken(), Troubled(), priors=team.priors()
        )
        outcome = run_through(session)
    texts = [n.text for n in album.views[-1].notices]
    assert any("Broken has failed" in text and "no ink" in text for text in texts)
    assert "disk full: 12 s wait in memory" in texts
    assert outcome.failure is None


class Fragile(Sink):
    """A view that raises in everything that visitors and names lead to."""

    def __init__(self):
        self.closed = False
        self.asked = 0

    def requests(self):
        self.asked += 1
        if self.asked % 2:
            raise ValueError("half a line")
        return [Request(self.asked, "name", 0.0, {"node": 1})]

    def respond(self, request, reply, status=200):
        self.answer = status

    def named(self, names):
        raise OSError("no such folder")

    def trouble(self):
        raise RuntimeError("no words")

    def close(self):
        self.closed = True


def test_no_request_reply_name_or_view_ends_a_session():
    with EmulatedTeam(TeamConfig("straight", 2, 8.0, 3, beacons=True)) as team:
        source, fragile = TeamInput(team), Fragile()
        phones = Phones(source, (3.0, Request(1, "name", 0.0, {"node": 2, "name": "Kim"})))
        session, album = make_session(source, deadreckoning, fragile, phones, priors=team.priors())
        outcome = run_through(session, survives=["requests_failed"])
    assert outcome.failure is None
    assert album.views[-1].time_s > 7.0
    assert fragile.answer == 500
    assert fragile.closed, "what a failed sink holds is written all the same"
    assert outcome.counters["requests_failed"] > 2
    texts = [notice.text for notice in album.views[-1].notices]
    assert any(text.startswith("request failed: ") for text in texts)
    assert [person.name for person in album.views[-1].people] == ["Node 1", "Kim"]


class Failing(Slow):
    def process(self, measurement):
        if measurement.time_s > 5.0:
            raise RuntimeError("matrix is not what it was")
        return self._own.process(measurement)


def test_a_fusion_that_dies_is_reported_and_receiving_goes_on():
    with EmulatedTeam(TeamConfig("straight", 2, 20.0, 3, beacons=True)) as team:
        source = TeamInput(team, until_s=15.0)
        session, album = make_session(source, Failing, priors=team.priors(), lasts=True)
        for _ in session.run():
            if source.now_s() > 14.0:
                session.stop()
        outcome = session.finish()
    assert "matrix is not what it was" in str(outcome.failure)
    notices = [n for n in album.views[-1].notices if n.id == "fusion"]
    assert notices[0].level == "alarm"
    assert album.views[-1].people[0].motion_s > 12.0


class Phones(Sink):
    """Phones whose requests wait, each for a moment of the session."""

    def __init__(self, source, *requests):
        self._source = source
        self._waiting = list(requests)
        self.answers = []

    def requests(self):
        due = [request for at_s, request in self._waiting if self._source.now_s() >= at_s]
        self._waiting = [
            (at_s, request) for at_s, request in self._waiting if self._source.now_s() < at_s
        ]
        return due

    def respond(self, request, reply, status=200):
        self.answers.append((request.id, reply, status))

    def named(self, names):
        self.names = names

    def boarded(self, message):
        self.board = message


def press(number, unix_s, name="a"):
    body = {
        "node": 1,
        "clock_offset_ms": 0.0,
        "sent_unix_ms": None,
        "presses": [{"id": name, "landmark": "17", "unix_ms": unix_s * 1000.0}],
    }
    return Request(number, "presses", unix_s, body)


def test_presses_names_and_acknowledgements_reach_record_and_view(monkeypatch):
    with EmulatedTeam(TeamConfig("straight", 2, 20.0, 3, beacons=True)) as team:
        source = TeamInput(team)
        # The wall clock as the team's, from a date on.
        monkeypatch.setattr("relpos.live.session.time.time", lambda: 1.7e9 + source.now_s())
        phones = Phones(
            source,
            (10.0, press(1, 1.7e9 + 9.5)),
            (11.0, press(2, 1.7e9 + 9.5)),
            (12.0, Request(3, "name", 1.7e9 + 12.0, {"node": 2, "name": "Kim"})),
            (13.0, Request(4, "acknowledge", 1.7e9 + 13.0, {"node": 2})),
        )
        session, album = make_session(source, deadreckoning, phones)
        run_through(session)
    (event,) = [o for _, o in album.observations if isinstance(o, Event)]
    assert event == Event(pytest.approx(9.5, abs=0.05), 1, "landmark", "17")
    assert [(i, status) for i, _, status in phones.answers] == [
        (1, 200),
        (2, 200),
        (3, 200),
        (4, 200),
    ]
    assert phones.answers[1][1] == {"accepted": ["a"]}
    assert phones.answers[3][1] == {"acknowledged": False}, "there was no alarm"
    assert [person.name for person in album.views[-1].people] == ["Node 1", "Kim"]


def test_nobody_at_the_command_post_is_called_or_ordered_out():
    with EmulatedTeam(TeamConfig("straight", 3, 20.0, 3, beacons=True)) as team:
        source = TeamInput(team)
        phones = Phones(
            source,
            (10.0, Request(1, "rollcall", 10.0, {"action": "start"})),
            (11.0, Request(2, "evacuate", 11.0, {"action": "order"})),
        )
        session, album = make_session(source, deadreckoning, phones, posts=frozenset({3}))
        run_through(session)
    assert phones.board["roll_call"]["nodes"] == [1, 2]
    assert phones.board["evacuation"]["nodes"] == [1, 2]
    assert [person.name for person in album.views[-1].people][2] == "Command post"


@pytest.mark.parametrize("kind", ["mayday", "marker", "name"])
def test_a_request_is_taken_as_the_kind_that_its_device_was_allowed(kind):
    order = {"kind": "evacuate", "action": "order", "nodes": [1, 2], "on": True}
    body = {"mayday": {}, "marker": {"x_m": 0.0, "y_m": 0.0}, "name": {"name": "Kim"}}[kind]
    with EmulatedTeam(TeamConfig("straight", 2, 14.0, 3, beacons=True)) as team:
        source = TeamInput(team)
        phones = Phones(source, (10.0, Request(1, kind, 10.0, {**order, **body, "node": 1})))
        session, _ = make_session(source, deadreckoning, phones)
        run_through(session)
    assert phones.answers
    assert not getattr(phones, "board", {}).get("evacuation")


def test_a_marker_where_i_am_is_set_nowhere_while_my_node_is_silent():
    here = {"action": "set", "sign": "hazard", "node": 1}
    with EmulatedTeam(TeamConfig("straight", 2, 40.0, 3, beacons=True)) as team:
        source = TeamInput(team)
        source.unplug(9.0, 30.0)
        phones = Phones(
            source,
            (8.0, Request(1, "marker", 8.0, {**here, "id": "a"})),
            (30.0, Request(2, "marker", 30.0, {**here, "id": "b"})),
        )
        session, _ = make_session(source, deadreckoning, phones, common=True)
        run_through(session)
    assert [(i, status) for i, _, status in phones.answers] == [(1, 200), (2, 409)]
    assert list(phones.board["markers"]) == ["a"]


def test_a_mayday_that_is_called_again_leaves_the_answers_of_the_roll_call():
    with EmulatedTeam(TeamConfig("straight", 3, 16.0, 3, beacons=True)) as team:
        source = TeamInput(team)
        answer = {"action": "answer", "node": 2, "answer": "confirmed"}
        phones = Phones(
            source,
            (8.0, Request(1, "mayday", 8.0, {"node": 1, "on": True})),
            (10.0, Request(2, "rollcall", 10.0, answer)),
            (12.0, Request(3, "mayday", 12.0, {"node": 1, "on": True})),
        )
        session, _ = make_session(source, deadreckoning, phones)
        run_through(session)
    assert phones.board["roll_call"]["emergency"]
    assert list(phones.board["roll_call"]["answers"]) == [2]


def test_a_late_copy_of_a_mayday_that_is_over_calls_the_roll_no_second_time():
    call = {"node": 1, "on": True, "id": "a"}
    with EmulatedTeam(TeamConfig("straight", 3, 16.0, 3, beacons=True)) as team:
        source = TeamInput(team)
        phones = Phones(
            source,
            (8.0, Request(1, "mayday", 8.0, call)),
            (10.0, Request(2, "mayday", 10.0, {"node": 1, "on": False})),
            (11.0, Request(3, "rollcall", 11.0, {"action": "end"})),
            (12.0, Request(4, "mayday", 12.0, call)),
        )
        session, _ = make_session(source, deadreckoning, phones)
        run_through(session)
    assert [status for _, _, status in phones.answers] == [200] * 4
    assert phones.board["mayday"] == {}
    assert phones.board["roll_call"]["outcome"] == "incomplete"


def test_a_mayday_of_somebody_whose_node_is_not_heard_sounds_and_is_shown_until_it_is_over():
    with EmulatedTeam(TeamConfig("straight", 2, 26.0, 3, beacons=True)) as team:
        source = TeamInput(team)
        phones = Phones(
            source,
            (6.0, Request(1, "mayday", 6.0, {"node": 9, "on": True, "by": "Kim"})),
            (22.0, Request(2, "mayday", 22.0, {"node": 9, "on": False})),
        )
        session, album = make_session(source, deadreckoning, phones, common=True)
        run_through(session)
    called = [view for view in album.views if 7.0 < view.time_s < 21.0]
    assert called
    for view in called:
        (caller,) = [person for person in view.people if person.node == 9]
        assert (caller.alert, caller.seen_s, caller.x_m) == (Alert.MAYDAY, None, None)
        json.loads(view.to_json())
    assert [e.text for e in album.log if e.kind == "alarm"] == ["Node 9 calls MAYDAY"]
    assert phones.board["roll_call"]["nodes"] == [1, 2, 9]
    assert [person.node for person in album.views[-1].people] == [1, 2]


def test_a_port_that_vanishes_is_told_where_nothing_is_shown(tmp_path):
    remarks = []
    with EmulatedTeam(TeamConfig("straight", 2, 12.0, 3, beacons=True)) as team:
        source = TeamInput(team)
        source.trouble = lambda: "/dev/x: gone" if source.now_s() > 6.0 else None
        plan = SessionPlan(
            "walk", tmp_path, Description(), deadreckoning, "deadreckoning", priors=team.priors()
        )
        run_session(source, plan, [lambda _: Album()], remark=remarks.append)
    assert [line for line in remarks if "gone" in line] == [
        "/dev/x: gone; trying again each second"
    ]


def test_a_recording_is_played_and_takes_no_presses():
    motions = [Motion(float(t), node, 1.0, 0.0, 0.1) for t in range(1, 30) for node in (1, 2)]
    source = PacedInput("a run", [Received(m.time_s, b"", (m,)) for m in motions], speed=0.0)
    phones = Phones(source, (5.0, press(1, 0.0)))
    session, album = make_session(source, deadreckoning, phones)
    outcome = run_through(session)
    assert outcome.received == len(motions)
    assert phones.answers[0][2] == 409
    last = album.views[-1]
    assert last.people[1].motion_s == 29.0
    # Nothing is known of a link, and nothing made up.
    assert last.people[1].rssi_dbm is None
    assert math.isfinite(last.time_s)


def test_a_remark_is_shown_for_a_minute():
    board = NoticeBoard(lambda: 10.0)
    board.post_remark("a node has another version")
    board.drop_expired(10.0 + REMARK_S)
    assert [notice.text for notice in board.all()] == ["a node has another version"]
    board.drop_expired(10.1 + REMARK_S)
    assert list(board.all()) == []


def test_nodes_received_first_share_one_start_with_a_common_start():
    with EmulatedTeam(TeamConfig("straight", 3, 15.0, 3, beacons=True)) as team:
        given = []

        def make(priors):
            given.extend(priors)
            return deadreckoning(priors)

        session, album = make_session(TeamInput(team), make, common=True)
        run_through(session)
    assert [prior.node for prior in given] == [1, 2, 3]
    assert album.estimates


@pytest.mark.parametrize("keyless", [True, False])
def test_a_session_without_a_team_key_says_so_until_its_end(tmp_path, keyless):
    key = wire.DEFAULT_KEY if keyless else bytes(range(16))
    album, remarks = Album(), []
    with EmulatedTeam(TeamConfig("straight", 2, 8.0, 3, beacons=True, key=key)) as team:
        source = TeamInput(team)
        source.link = Link(key=key)
        plan = SessionPlan(
            "walk", tmp_path, Description(), deadreckoning, "deadreckoning", priors=team.priors()
        )
        run_session(source, plan, [lambda _: album], remark=remarks.append)
    assert remarks.count(KEYLESS) == keyless
    assert {n.text for n in album.views[-1].notices if n.id == "no-key"} == {KEYLESS} & {
        KEYLESS if keyless else ""
    }


def test_the_page_says_who_is_spoken_for_by_a_stolen_node():
    key, faults = bytes(range(16)), ["radio:foreign:from=3,to=15,key=stolen"]
    with EmulatedTeam(
        TeamConfig("straight", 3, 16.0, 3, beacons=True, key=key, faults=faults)
    ) as team:
        source = TeamInput(team)
        source.link = Link(key=key)
        session, album = make_session(source, deadreckoning, priors=team.priors())
        run_through(session)
    told = {notice.text for view in album.views for notice in view.notices}
    assert {text[:7] for text in told if "such as a stolen node" in text} == {"node 1:", "node 2:"}


class Crumbling(Composer):
    """Raises in everything that a measurement, an estimate or a view leads to."""

    def _fail(self, *_, **__):
        raise ZeroDivisionError("a figure of nobody")

    add_observations = add_estimate = view = _fail


def test_a_view_that_fails_costs_neither_estimates_nor_files(tmp_path, monkeypatch):
    monkeypatch.setattr("relpos.live.assembly.Composer", Crumbling)
    remarks = []
    with EmulatedTeam(TeamConfig("straight", 2, 8.0, 3, beacons=True)) as team:
        plan = SessionPlan(
            "walk", tmp_path, Description(), deadreckoning, "deadreckoning", priors=team.priors()
        )
        outcome = run_session(TeamInput(team), plan, [lambda _: Album()], remark=remarks.append)
    assert outcome.failure is None
    assert outcome.counters["views_failed"] > 10
    assert [line for line in remarks if "a figure of nobody" in line] == [remarks[1]]
    assert len(read_estimates(tmp_path)) == outcome.estimates > 5
    assert load_run(tmp_path / "received").motions


def test_an_input_that_fails_in_an_unknown_way_leaves_the_files_whole(tmp_path):
    class Burning(TeamInput):
        def read(self, timeout_s):
            if self.now_s() > 5.0:
                raise KeyError("smoke")
            return super().read(timeout_s)

    with EmulatedTeam(TeamConfig("straight", 2, 8.0, 3, beacons=True)) as team:
        plan = SessionPlan(
            "walk", tmp_path, Description(), deadreckoning, "deadreckoning", priors=team.priors()
        )
        outcome = run_session(Burning(team), plan)
    assert isinstance(outcome.failure, KeyError)
    assert load_run(tmp_path / "received").motions[-1].time_s > 3.5


def test_a_frame_that_cannot_be_decoded_is_counted_and_told_once(monkeypatch):
    feed = Decoder.feed

    def fail(self, data, arrival_s, rssi_dbm=None):
        if self.counts["frames_failed"] < 2:
            raise OverflowError("math range error")
        return feed(self, data, arrival_s, rssi_dbm)

    monkeypatch.setattr(Decoder, "feed", fail)
    with EmulatedTeam(TeamConfig("straight", 2, 6.0, 3, beacons=True)) as team:
        session, album = make_session(TeamInput(team), deadreckoning, priors=team.priors())
        outcome = run_through(session)
    assert outcome.counters["frames_failed"] == 2
    assert [n.text for n in album.views[-1].notices if "math range error" in n.text] == [
        "a frame could not be decoded: OverflowError('math range error')"
    ]
    assert album.estimates


def test_a_full_disk_under_the_counters_file_ends_no_session(tmp_path):
    master, slave = pty.openpty()
    seen = SeenCounters(tmp_path / "gone" / "team.key.seen")
    live = PortInput(os.ttyname(slave), Link(), seen, teach=False)
    try:
        for counter in range(3):
            values = dict.fromkeys(wire.MOTION.field, 0) | {"time_s": 1.0 + counter}
            data = framing.encode(wire.MOTION, 1, 0, counter, values)
            os.write(master, xbee.encode(xbee.Receive16(1, -40, data)))
            assert live.read(5.0) is not None
        (remark,) = live.remarks()
        assert "team.key.seen: cannot be written" in remark
    finally:
        live.close()
        os.close(master)
        os.close(slave)
