"""Any moment of a recording: found by its blocks' times, with alarms and silence as they were."""

from __future__ import annotations

import os
import shutil
import threading
import time
from array import array
from dataclasses import replace

import pytest
from sessions import PulledOut, about, play, session

from relpos.cli.replay import Played
from relpos.cli.smoothing import Smoothing
from relpos.errors import DataError
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus
from relpos.live.mission import JOURNAL, Journal, Mission
from relpos.live.requests import Request
from relpos.live.sinks import Sink
from relpos.live.team_view import Alert, LogEntry
from relpos.measurements import Motion
from relpos.recording import open_recording, topics
from relpos.recording.moments import Moments
from relpos.recording.player import History, Player
from relpos.recording.recorder import Recorder
from relpos.simulation.building import simulate_building
from support.waiting import until

SEEK_S = 0.3


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording of three nodes, cut off like one of a laptop without power."""
    path = tmp_path_factory.mktemp("moments") / "walk.mcap"
    recorder = Recorder(path, about())
    play(recorder, session())
    recorder.close()
    cut = path.with_name("cut.mcap")
    cut.write_bytes(path.read_bytes()[: path.stat().st_size * 9 // 10])
    return path, cut


def test_the_estimate_of_a_moment_is_the_newest_that_was_recorded_by_then(recorded):
    path, _ = recorded
    estimates = list(open_recording(path).estimates())
    moments = Moments([path])
    for estimate in estimates[2:-1:5]:
        found = moments.estimate_at(estimate.time_s + 4.0)
        assert found is not None
        assert found in estimates
        assert found.time_s >= estimate.time_s
    assert moments.estimate_at(moments.to_s + 5000.0) == estimates[-1], "a last place stays"
    assert moments.estimate_at(moments.from_s - 1.0) is None


@pytest.mark.parametrize("name", [b"/motion", b"started_unix_ns", b"relpos_version"])
def test_a_recording_whose_head_is_damaged_is_refused_in_one_line(recorded, tmp_path, name):
    data = recorded[0].read_bytes()
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data.replace(name, b"\xff" * len(name), 1))
    with pytest.raises(DataError, match="damaged"):
        Moments([path])


def test_sessions_of_a_mission_between_which_the_clock_was_set_follow_each_other(tmp_path):
    began_ns = about().started_unix_ns
    paths = [tmp_path / "1.mcap", tmp_path / "2.mcap"]
    for path, start_ns, first_s in zip(paths, (began_ns - 10**17, began_ns), (0, 100), strict=True):
        recorder = Recorder(path, replace(about(), started_unix_ns=start_ns))
        for second in range(first_s, first_s + 10):
            recorder.observed(second, [Motion(float(second), 1, 0.1, 0.0, 0.0)])
            node = NodeEstimate(1, second, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, NodeStatus.OK)
            recorder.estimated(Estimate(float(second), (node,), ()))
        recorder.close()
    moments = Moments(paths)
    assert (moments.from_s, moments.to_s) == (0.0, 109.0)
    for at_s in (4.0, 104.0):
        estimate = moments.estimate_at(at_s)
        assert estimate is not None
        assert estimate.time_s == at_s
    seconds = [row.time_s for _, row in moments.rows(0.0, 109.0, Motion)]
    assert seconds == [*range(10), *range(100, 110)]


def test_a_recording_is_played_with_its_further_parts_and_nothing_in_them_twice(
    tmp_path, monkeypatch
):
    path, part = tmp_path / "walk.mcap", tmp_path / "walk.part2.mcap"
    cut = os.ftruncate
    monkeypatch.setattr(os, "ftruncate", lambda *to: part.exists() or cut(*to))
    recorder = Recorder(path, about(), disk=PulledOut(2))
    second = 0
    while not part.exists():
        second += 1
        assert second < 600
        recorder.observed(second, [Motion(float(second), 1, 0.1, 0.0, 0.0)])
        time.sleep(0.1)
    recorder.close()

    def seconds():
        return [row.time_s for _, row in Moments([path]).rows(0.0, 1e6, Motion)]

    assert seconds() == [*range(1, second + 1)]
    part.rename(tmp_path / "other.mcap")
    alone = seconds()
    assert alone
    Recorder(part, replace(about(), started_unix_ns=1)).close()
    assert seconds() == alone, "another recording's file is no part"


def test_a_recording_that_is_a_device_is_refused(tmp_path):
    path = tmp_path / "endless.mcap"
    path.symlink_to("/dev/zero")
    with pytest.raises(DataError, match="not a regular file"):
        Moments([path])


def test_a_recording_that_was_cut_off_has_its_moments_and_seeks_as_fast(recorded):
    _, cut = recorded
    moments = Moments([cut])
    assert moments.to_s > 20.0
    slowest_s = 0.0
    for step in range(20):
        at_s = moments.from_s + (step * 7 % 20) / 20 * (moments.to_s - moments.from_s)
        fresh = moments.again()
        began_s = time.process_time()
        fresh.estimate_at(at_s)
        slowest_s = max(slowest_s, time.process_time() - began_s)
        fresh.close()
    assert slowest_s < SEEK_S


def test_a_moment_costs_the_lists_of_one_estimate_however_long_ago_it_was(recorded, monkeypatch):
    path, _ = recorded
    decoded = []
    real = topics.decode_list
    monkeypatch.setattr(topics, "decode_list", lambda *a: decoded.append(a[0]) or real(*a))
    moments = Moments([path])
    for at_s in (moments.from_s + 12.0, moments.to_s, moments.to_s + 5000.0):
        decoded.clear()
        assert moments.estimate_at(at_s) is not None
        assert len(decoded) <= len(topics.LISTS)


def test_what_is_no_recording_is_refused(tmp_path):
    path = tmp_path / "x.mcap"
    path.write_bytes(b"rubbish" * 100)
    with pytest.raises(DataError, match="no recording of relpos"):
        Moments([path])


class Page(Sink):
    """A page that asks."""

    def __init__(self):
        self.views = []
        self.lines = []
        self.asks = []
        self.answers = []
        self.timeline = {}

    def updated(self, view):
        self.views.append(view)

    def logged(self, entry):
        self.lines.append(entry)

    def timed(self, timeline):
        self.timeline = timeline

    def requests(self):
        asks, self.asks = self.asks, []
        return asks

    def respond(self, request, reply, status=200):
        self.answers.append((reply, status))


def test_a_recording_is_moved_to_any_moment_and_to_its_events(recorded):
    path, _ = recorded
    page = Page()
    log = [LogEntry(at_s, 0.0, "note", "a note") for at_s in (15.0, 20.0)]
    moments = Moments([path])
    player = Player(moments, [page], log)
    while not player.history.complete:
        time.sleep(0.01)
    for body in ({"playing": False}, {"at_s": 12.0}, {"speed": 99.0}):
        page.asks.append(Request(1, "replay", 0.0, body))
    player.run(0.1)
    assert page.views[-1].time_s == 12.0
    assert (page.timeline["playing"], page.timeline["speed"]) == (False, 30.0)
    assert [p.node for p in page.views[-1].people] == [1, 2, 3]
    assert all(p.seen_s < 3.0 for p in page.views[-1].people)
    stepped = []
    for step in (1, 1, 1, -1, -1, -1):
        page.asks.append(Request(2, "replay", 0.0, {"step": step}))
        player.run(0.05)
        stepped.append(page.views[-1].time_s)
    assert stepped == [15.0, 20.0, moments.to_s, 20.0, 15.0, moments.from_s]
    assert page.views[-1].fused_s is None, "nothing was estimated yet"
    page.asks.append(Request(3, "name", 0.0, {"node": 1, "name": "x"}))
    player.run(0.05)
    assert page.answers[-1][1] == 409
    page.asks.append(Request(4, "end", 0.0, {}))
    player.run()
    assert player.ended


def test_alerts_of_a_moment_are_those_that_were_then():
    class Rows:
        started_unix_s, from_s, to_s = 1000.0, 0.0, 60.0

        def rows(self, *_):
            for second in range(60):
                if second < 45:
                    moving = second < 10
                    yield float(second), Motion(float(second), 2, 0.0, 0.0, 0.0, moving=moving)
                yield float(second), Motion(float(second), 3, 1.0, 0.0, 0.0, moving=True)

    history = History()
    history.read(Rows(), {2: "Ben"}, ())
    assert history.alert(2, 20.0)[1] is None
    assert history.alert(2, 31.0)[1] is Alert.STILL_WARNING
    assert history.alert(2, 42.0)[1] is Alert.STILL_ALARM
    assert history.heard(2, 59.0) == 44.0
    assert any(e.text.startswith("Ben") for e in history.events)
    assert all(e.unix_s == 1000.0 + e.time_s for e in history.events)
    posts = History()
    posts.read(Rows(), {}, (), frozenset({2}))
    assert posts.alert(2, 42.0)[1] is None, "the command post's node lies still"


def test_the_replay_of_a_mission_shows_who_called_mayday_from_then_until_it_was_over(
    recorded, tmp_path
):
    mission = Mission.open(tmp_path / "mission", "/dev/ttyUSB0")
    mission.about.sessions = 1
    mission.save()
    shutil.copy(recorded[0], mission.recording(1))
    journal = Journal(mission.path / JOURNAL)
    for time_s, node, on in ((12.05, 2, True), (13.0, 9, True), (22.0, 2, False)):
        said = {"kind": "mayday", "node": node, "on": on, "by": "Ben"}
        journal.keep({**said, "time_s": time_s, "unix_s": 1.8e9 + time_s})
    journal.close()
    played = Played.open(mission.path)
    player = Player(Moments(played.paths), [], played.entries, calls=played.calls)
    player.wait()

    def callers(time_s):
        return [p.node for p in player.view(time_s).people if p.alert is Alert.MAYDAY]

    assert [callers(at_s) for at_s in (12.0, 12.1, 13.1, 23.0)] == [[], [2], [2, 9], [9]]


def test_a_fall_is_an_alert_of_a_recording_too():
    run = simulate_building("building-fall", 205, {"seconds": 120.0, "fall_s": 10.0})
    ends_s = next(e.time_s for e in run.events if e.value == "lying")

    class Rows:
        started_unix_s, from_s, to_s = 0.0, 0.0, 120.0

        def rows(self, _from_s, _to_s, *kinds):
            return ((m.time_s, m) for m in run.measurements if isinstance(m, kinds))

    history = History()
    history.read(Rows(), {2: "Ben"}, ())
    assert history.alert(2, ends_s + 3.0)[1] is Alert.FALL
    assert any(e.text == "Ben fell" for e in history.events)


def test_before_all_of_a_recording_is_read_nobody_is_called_silent_or_lying(recorded, monkeypatch):
    path, _ = recorded
    go_on = threading.Event()

    def read(history, moments, *_):
        # As far as it has come: somebody lay still then.
        history.heard_s[1] = array("d", [1.0])
        history.alerts[1] = [(1.0, Alert.STILL_ALARM)]
        go_on.wait(30.0)
        history.complete = True

    monkeypatch.setattr(History, "read", read)
    player = Player(Moments([path]), [Page()])
    until(lambda: player.history.alerts, "the reading does not begin")
    for complete in (False, True):
        shown = next(p for p in player.view(12.0).people if p.node == 1)
        assert (shown.alert is None) is not complete
        assert (shown.seen_s is None) is not complete
        go_on.set()
        player.wait()


@pytest.mark.soak
def test_the_smoothed_tracks_come_to_the_page_once_they_are_computed(recorded):
    path, _ = recorded
    page, shown = Page(), []
    page.smoothed = shown.append
    smoothing = Smoothing([path])
    player = Player(Moments([path]), [page], smoothed=smoothing)
    player.run(0.1)
    assert page.timeline["smoothing"] is True
    end_s = time.monotonic() + 120.0
    while not shown and time.monotonic() < end_s:
        player.run(0.2)
    smoothing.close()
    assert page.timeline["smoothing"] is False
    assert len(shown) == 1
    for node in (1, 2, 3):
        times = [time_s for time_s, _, _ in shown[0].of(node)]
        assert times == sorted(times)
        assert times[-1] > 30.0
