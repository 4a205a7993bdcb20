"""A mission's folder: what was confirmed survives the session, and the next one goes on."""

from __future__ import annotations

import json
import math
import os
import stat
import time
from pathlib import Path

import pytest
from team_input import TeamInput, make_session, run_through

from relpos import fusion
from relpos.cli import mission as command
from relpos.cli.live import _about
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.errors import DataError
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus
from relpos.link import xbee
from relpos.live.assembly import MissionPlan, SessionPlan
from relpos.live.board import Board
from relpos.live.fusion_thread import FusionThread
from relpos.live.inputs import PacedInput, Received
from relpos.live.mission import JOURNAL, TRACKS, Journal, Mission, MissionFiles, read_again
from relpos.live.requests import Request
from relpos.live.session import Outcome
from relpos.live.sinks import Sink
from relpos.live.team_view import Alert, Hello
from relpos.live.tracks import Tracks
from relpos.measurements import Motion
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.recording import make_recorder, open_recording
from relpos.recording.about import About
from relpos.recording.moments import Moments
from relpos.runs import Description
from support.command import relpos


class Visitors(Sink):
    """Asks what it is told to, and keeps the answers."""

    def __init__(self):
        self.asks = []
        self.answers = []
        self.lines = []
        self.names = {}

    def requests(self):
        asks, self.asks = self.asks, []
        return asks

    def respond(self, request, reply, status=200):
        self.answers.append((request.kind, reply, status))

    def logged(self, entry):
        self.lines.append(entry.text)

    def named(self, names):
        self.names = names

    def ask(self, kind, **body):
        self.asks.append(Request(1, kind, time.time(), body))


class Again(TeamInput):
    """A team whose session before is read first."""

    def __init__(self, team, earlier):
        super().__init__(team)
        self._earlier = earlier(self.link)

    def read(self, timeout_s):
        received = next(self._earlier, None)
        return super().read(timeout_s) if received is None else received


def play(session, until):
    for _ in session.run():
        if until():
            session.stop()


def made(team, source, resumed, mission, visitors):
    journal = Journal(mission.path / JOURNAL)
    session, album = make_session(
        source, lambda p: fusion.make("bank", p), visitors, priors=resumed.priors, paced=True
    )
    session.keep(journal, resumed)
    session.add_sink(MissionFiles(mission, journal, resumed.since_s))
    return session, album, journal


def test_a_session_that_was_killed_goes_on_with_the_same_map_names_and_alarms(tmp_path):
    folder = tmp_path / "mill"
    mission = Mission.open(folder, "emulated", "Old mill")
    config = TeamConfig("paper", 3, 70.0, 3, beacons=True, faults=["node:off:node=2,from=8,to=200"])
    with EmulatedTeam(config) as team:
        source, visitors = TeamInput(team), Visitors()
        resumed = mission.resume()
        resumed.priors = tuple(team.priors())
        session, album, _ = made(team, source, resumed, mission, visitors)
        visitors.ask("name", node=1, name="Anna", by="")

        def lost_and_seen():
            views = album.views
            lost = views and any(p.alert is Alert.LOST for p in views[-1].people)
            if lost and not any(kind == "acknowledge" for kind, *_ in visitors.answers):
                visitors.ask("acknowledge", node=2, by="Anna")
            return source.now_s() > 34.0

        play(session, lost_and_seen)
        # Killed: nothing is finished or closed. What was confirmed is on the disk already.
        assert ("acknowledge", {"acknowledged": True}, 200) in visitors.answers
        kinds = [event["kind"] for event in Mission.open(folder).events()]
        assert {"name", "alert", "acknowledge", "log"} <= set(kinds)
        recorded = [(s, Received(s, data, ())) for s, data in album.bytes]
        last = {n.node: n for n in album.estimates[-1].nodes}
        team.run(team.time_us + 10_000_000)

        again = Mission.open(folder).resume()
        assert 30.0 < again.since_s < 34.1
        source = Again(team, lambda link: read_again(recorded, link.feed, again))
        visitors = Visitors()
        session, album, _ = made(team, source, again, mission, visitors)
        play(session, lambda: source.now_s() > 56.0)
        session.finish()
        first, final = album.views[0], album.views[-1]
        assert [p.node for p in first.people] == [1, 2, 3], "nobody is left out"
        assert first.people[0].name == "Anna"
        assert visitors.names == {1: "Anna"}
        assert any("is not heard" in line for line in visitors.lines)
        two = final.people[1]
        assert (two.alert, two.acknowledged, two.acknowledged_by) == (Alert.LOST, True, "Anna")
        assert two.seen_s == pytest.approx(final.time_s - 8.0, abs=3.0)
        assert (two.x_m, two.y_m) == (
            pytest.approx(last[2].x_m, abs=3.0),
            pytest.approx(last[2].y_m, abs=3.0),
        )
        estimate = album.estimates[-1]
        for n in estimate.nodes:
            if n.node != 2:
                x_m, y_m, _ = team.position_m(n.node, estimate.time_s)
                sigma_m = math.sqrt(n.variance_x_m2 + n.variance_y_m2)
                assert math.hypot(n.x_m - x_m, n.y_m - y_m) < 3.0 * sigma_m < 12.0, "the same map"
        assert min(e.time_s for e in album.estimates) > again.since_s


def test_the_recording_of_a_session_that_goes_on_has_the_seconds_since_the_checkpoint(tmp_path):
    mission = Mission.open(tmp_path / "mill", "emulated")
    with EmulatedTeam(TeamConfig("paper", 3, 70.0, 3, beacons=True)) as team:
        source, paths = TeamInput(team), [mission.recording(n) for n in (1, 2)]
        resumed = mission.resume()
        resumed.priors = tuple(team.priors())
        session, _, _ = made(team, source, resumed, mission, make_recorder(paths[0], About(0)))
        play(session, lambda: source.now_s() > 30.0)
        session.finish()
        team.run(team.time_us + 10_000_000)
        again = mission.resume()
        first = open_recording(paths[0])
        source = Again(team, lambda link: read_again(first.inputs(), link.feed, again))
        session, _, _ = made(team, source, again, mission, make_recorder(paths[1], About(0)))
        play(session, lambda: source.now_s() > 56.0)
        session.finish()
    later = open_recording(paths[1])

    def moved(recording, until_s):
        motions = (o for o in recording.observations() if isinstance(o, Motion))
        return {(o.node, o.dx_m) for o in motions if again.since_s + 0.1 < o.time_s < until_s}

    killed_s = max(o.time_s for o in first.observations())
    assert killed_s > again.since_s + 0.5
    assert moved(later, killed_s + 0.1) == moved(first, killed_s + 0.1) != set()
    assert min(s for s, _ in later.observations_by_arrival()) > again.since_s
    # Played as one, nothing is there twice.
    moments = Moments(paths)
    heard = [(s, row.node, row.time_s) for s, row in moments.rows(0.0, 70.0, Motion)]
    assert len({row[1:] for row in heard}) == len(heard)
    assert [s for s, *_ in heard] == sorted(s for s, *_ in heard)
    assert moments.estimate_at(39.0).time_s > killed_s - 1.5
    assert Moments([paths[1]]).from_s > again.since_s


def test_what_a_request_says_beside_its_own_is_dropped_and_costs_it_nothing(tmp_path):
    mission = Mission.open(tmp_path / "mill", "emulated")
    with EmulatedTeam(TeamConfig("straight", 2, 20.0, 3, beacons=True)) as team:
        source, visitors = TeamInput(team), Visitors()
        resumed = mission.resume()
        resumed.priors = tuple(team.priors())
        session, _, _ = made(team, source, resumed, mission, visitors)
        visitors.ask("mayday", node=1, on=True, said=1, seconds="x", unix_s="now")
        visitors.ask("board", node=2, state="standby", name=3, text="x" * 4000)
        play(session, lambda: len(visitors.answers) == 2 and source.now_s() > 5.0)
        session.finish()
    assert [status for *_, status in visitors.answers] == [200, 200]
    kept = {event["kind"]: event for event in Mission.open(tmp_path / "mill").events()}
    assert kept["mayday"]["node"] == 1
    assert kept["board"].keys() == {"kind", "node", "nodes", "state", "by", "time_s", "unix_s"}


def test_an_event_is_confirmed_once_the_disk_has_it(tmp_path, monkeypatch):
    path = tmp_path / JOURNAL
    full = True
    fsync = os.fsync

    def sync(handle):
        if full:
            raise OSError(28, "No space left on device")
        fsync(handle)

    monkeypatch.setattr(os, "fsync", sync)
    journal = Journal(path)
    number = journal.add({"kind": "name", "node": 1, "name": "Anna"})
    while journal.trouble is None:
        time.sleep(0.01)
    assert not journal.is_safe(number)
    full = False
    while not journal.is_safe(number):
        time.sleep(0.01)
    journal.close()
    assert [json.loads(line)["name"] for line in path.read_text().splitlines()] == ["Anna"]
    assert journal.trouble is None


def test_what_was_saved_is_the_new_file_after_a_power_cut_not_the_one_before(tmp_path, monkeypatch):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    synced = []
    monkeypatch.setattr(os, "fsync", lambda h: synced.append(stat.S_ISDIR(os.fstat(h).st_mode)))
    mission.save()
    assert synced == [False, True], "what is in it, then that it has taken the other's place"


def test_a_line_that_a_power_cut_left_half_costs_no_other_line(tmp_path):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    (mission.path / JOURNAL).write_text('{"kind":"name","node":1,"name":"Anna"}\n{"kind":"na')
    journal = Journal(mission.path / JOURNAL)
    journal.add({"kind": "name", "node": 2, "name": "Ben"})
    journal.close()
    assert [event["name"] for event in mission.events()] == ["Anna", "Ben"]


@pytest.mark.parametrize("half", ["1", "1,12.5", "1,12.50,3", "1,12.50,3.10,13"])
def test_a_point_of_a_track_that_a_power_cut_left_half_is_none(tmp_path, half):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    (mission.path / TRACKS).write_text("1,10.00,1.00,1.00\n" + half)
    whole = [(10.0, 1.0, 1.0)]
    assert mission.resume().tracks.of(1) == whole
    journal = Journal(mission.path / JOURNAL)
    files = MissionFiles(mission, journal)
    at = NodeEstimate(1, 4.0, 5.0, 0.1, 0.5, 0.4, 0.0, 0.2, NodeStatus.OK)
    files.estimated(Estimate(13.0, (at,), ()))
    journal.close()
    assert files.trouble() is None
    tracks = mission.resume().tracks
    assert tracks.of(1) == [*whole, (13.0, 4.0, 5.0)]
    assert tracks.of(11) == []


def test_one_session_at_a_time_has_a_mission(tmp_path):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    with mission.lock(), pytest.raises(DataError, match="another session"), mission.lock():
        pass


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(DataError, match="neither a mission nor empty"):
        Mission.open(tmp_path, "/dev/null")
    with pytest.raises(
        DataError, match=r"no mission \(relpos mission begins one\), nor a recording"
    ):
        Mission.open(tmp_path / "new")


@pytest.mark.parametrize("damage", ["", "{", '{"name": 3}', "[]", '{"time_s": "x"}'])
def test_a_damaged_checkpoint_costs_the_map_and_no_more(tmp_path: Path, damage: str):
    mission = Mission.open(tmp_path / "m", "/dev/null", "Mill")
    (mission.path / "checkpoint.json").write_text(damage)
    (mission.path / "tracks.csv").write_text("1,2.0,3.0,4.0\nrubbish\n1,3.0")
    resumed = Mission.open(mission.path).resume()
    assert resumed.priors == ()
    assert resumed.tracks.of(1) == [(2.0, 3.0, 4.0)]
    assert isinstance(resumed.tracks, Tracks)


def test_a_damaged_checkpoint_leaves_no_plan_aligned_and_no_tracks_of_the_map_before(tmp_path):
    mission = Mission.open(tmp_path / "mill", "loop://")
    mission.about.sessions = 1
    mission.save()
    journal = Journal(mission.path / JOURNAL)
    laid = {"kind": "plan", "image": "mill.png", "time_s": 1.0, "unix_s": 1.8e9}
    journal.keep({**laid, "action": "set"})
    journal.keep({**laid, "action": "align", "points": [[0, 0, 0, 0], [9, 0, 9, 0]]})
    journal.close()
    (mission.path / TRACKS).write_text("1,2.0,3.0,4.0\n")
    (mission.path / "checkpoint.json").write_text("{")
    again = ("mission", mission.path, "--estimator", "deadreckoning", "--no-open", "--seconds")
    told = relpos(*again, "1").stderr
    assert "the map begins anew" in told
    board = Board()
    for event in mission.events():
        if event["kind"] == "plan":
            board.apply(event)
    assert board.plan is not None, "it lies there still"
    assert board.plan.points == []
    assert not (mission.path / TRACKS).exists()
    assert (mission.path / "tracks-1.csv").read_text() == "1,2.0,3.0,4.0\n"


@pytest.mark.parametrize("x_m", [math.nan, math.inf, 1e300, "x", None, True])
def test_a_place_that_is_none_costs_that_place_and_no_other(tmp_path: Path, x_m: object):
    mission = Mission.open(tmp_path / "m", "/dev/null", "Mill")
    rows = [{"node": k, "x_m": x, "y_m": 0.0, "heading_rad": 0.0} for k, x in ((1, x_m), (2, 3.0))]
    found = {"time_s": 5.0, "arrived_s": 6.0, "heard_s": {"1": 4.0}, "priors": rows}
    (mission.path / "checkpoint.json").write_text(json.dumps(found))
    (mission.path / "tracks.csv").write_text("1,2.0,nan,4.0\n1,3.0,inf,4.0\n1,4.0,1.0,1.0\n")
    resumed = mission.resume()
    assert [prior.node for prior in resumed.priors] == [2]
    assert resumed.tracks.of(1) == [(4.0, 1.0, 1.0)]


HUGE = 10**400
"""No float is so large."""
STRANGE = [
    "[" * 100_000, "7", '{"kind": 3}', '{"kind": "log"}', '{"kind": "log", "entry": 5}',
    '{"kind": "log", "entry": {"time_s": NaN, "unix_s": 1, "kind": "note", "text": "a"}}',
    '{"kind": "log", "entry": {"time_s": 1, "unix_s": 1, "kind": "note", "text": 5}}',
    '{"kind": "log", "entry": {"time_s": 1, "unix_s": 1, "kind": "note", "text": "", "new": 1}}',
    '{"kind": "device"}', '{"kind": "name", "node": 1}', '{"kind": "name", "node": 1, "name": 5}',
    '{"kind": "alert", "node": 1, "alert": "x"}', '{"kind": "rollcall", "action": "answer"}',
    '{"kind": "shelve", "node": 1}', '{"kind": "presses"}', '{"kind": "board", "node": [1]}',
    *(f'{{"kind": "shelve", "node": 1, "seconds": {HUGE}, "unix_s": {u}}}' for u in (1, HUGE)),
]  # fmt: skip


def test_lines_of_a_journal_that_are_none_of_ours_cost_no_other_and_no_mission(tmp_path):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    known = '{"kind": "name", "node": 1, "name": "Anna"}'
    (mission.path / JOURNAL).write_text("\n".join([*STRANGE, known]))
    with EmulatedTeam(TeamConfig("paper", 2, 5.0, 1)) as team:
        visitors = Visitors()
        session, _ = make_session(
            TeamInput(team), lambda p: fusion.make("deadreckoning", p), visitors
        )
        session.keep(Journal(mission.path / JOURNAL), mission.resume())
    assert visitors.names == {1: "Anna"}


def test_a_shelved_alarm_comes_back_in_time_where_the_laptops_clock_was_set(tmp_path):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    found = {"time_s": 0.0, "arrived_s": 0.0, "heard_s": {"1": 0.0}, "priors": []}
    (mission.path / "checkpoint.json").write_text(json.dumps(found))
    for set_s in (-3600.0, 3600.0):
        event = {"kind": "shelve", "node": 1, "seconds": 60.0, "by": "Anna", "time_s": 0.0}
        line = json.dumps(event | {"unix_s": time.time() + set_s})
        (mission.path / JOURNAL).write_text(line + "\n")
        with EmulatedTeam(TeamConfig("paper", 2, 5.0, 1)) as team:
            session, album = make_session(
                TeamInput(team), lambda p: fusion.make("deadreckoning", p)
            )
            session.keep(Journal(mission.path / JOURNAL), mission.resume())
            run_through(session)
        left_s = [p.shelved_s for view in album.views for p in view.people if p.node == 1]
        assert 50.0 < max(left_s) <= 60.0


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, "[]", "{}", '{"name": 1}', "null", '{"name": "a", "source": "", "sessions": 1, '
     '"started_unix_s": NaN, "port": null, "ended_unix_s": null}'],
)  # fmt: skip
def test_a_description_that_is_none_of_ours_is_one_line(tmp_path, text):
    (tmp_path / "mission.json").write_text(text)
    with pytest.raises(DataError, match="not a mission's folder"):
        Mission.open(tmp_path)


@pytest.mark.parametrize("field", ["started_unix_s", "ended_unix_s"])
@pytest.mark.parametrize("value", [HUGE, 10**18, 1e300, -1.0], ids=["huge", "late", "far", "-1"])
def test_a_description_whose_date_is_none_is_one_line(tmp_path, field, value):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    found = json.loads((mission.path / "mission.json").read_text())
    (mission.path / "mission.json").write_text(json.dumps(found | {field: value}))
    with pytest.raises(DataError, match="not a mission's folder"):
        Mission.open(mission.path)


@pytest.mark.parametrize("name", ["time_s", "arrived_s", "node"])
def test_a_checkpoint_of_huge_numbers_costs_what_it_says_and_no_more(tmp_path, name):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    row = {"node": 1, "x_m": 0.0, "y_m": 0.0, "heading_rad": 0.0}
    found = {"time_s": 5.0, "arrived_s": 6.0, "heard_s": {"1": 4.0}, "priors": [row]}
    (row if name in row else found)[name] = HUGE
    (mission.path / "checkpoint.json").write_text(json.dumps(found))
    assert mission.resume().priors == ()


@pytest.mark.parametrize(
    ("field", "value"),
    [("time_s", HUGE), ("unix_s", 1e18), ("unix_s", HUGE)],
    ids=["time", "late date", "date"],
)
@pytest.mark.parametrize("log", ["log.csv", "log.kml"])
def test_a_line_of_the_log_whose_time_is_none_is_left_out_of_the_files(tmp_path, field, value, log):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    mission.about.sessions = 1
    mission.save()
    recorder = make_recorder(mission.recording(1), About(round(time.time() * 1e9)))
    recorder.received(0.5, b"anything")
    recorder.close()
    entry = {"time_s": 1.0, "unix_s": 1.7e9, "kind": "note", "text": "to be kept"}
    strange = entry | {field: value, "text": "not"}
    lines = [json.dumps({"kind": "log", "entry": e}) for e in (strange, entry)]
    (mission.path / JOURNAL).write_text("\n".join(lines))
    path = tmp_path / log
    done = relpos("replay", mission.path, "--log", path)
    assert "1 lines written" in done.output, done.output
    assert "to be kept" in path.read_text()


def test_a_mission_s_name_can_be_shown_and_written_whatever_its_folder_is_called(tmp_path):
    path = Path(f"{tmp_path}/mühle\udcff")
    assert Mission.open(path, "/dev/null").about.name == "mühle?"
    assert Mission.open(path, name="new\udcff").about.name == "new?"
    found = vars(Mission.open(path).about) | {"name": "\ud800"}
    (path / "mission.json").write_text(json.dumps(found))
    assert Mission.open(path).about.name == "?"


def test_a_device_stays_shut_out_after_a_week(tmp_path):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    event = {"kind": "device", "id": "a", "action": "shut", "time_s": 9e5, "unix_s": 1.7e9}
    (mission.path / JOURNAL).write_text(json.dumps(event))
    assert list(mission.events()) == [event]


@pytest.mark.parametrize("name", ["lock", "journal.jsonl", "plans", "mission.json.new"])
def test_a_strangers_folder_does_not_lead_to_other_files(tmp_path, name):
    precious = tmp_path / "precious"
    precious.write_text("mine")
    path = Mission.open(tmp_path / "m", "/dev/null").path
    (path / name).symlink_to(precious)
    with pytest.raises(DataError, match="a link or a device"):
        Mission.open(path)
    assert precious.read_text() == "mine"


def test_a_folder_that_was_begun_and_killed_or_lost_its_key_goes_on(tmp_path):
    (tmp_path / "secret.key").write_bytes(b"half")
    (tmp_path / "mission.json.new").write_text("{")
    assert len(Mission.open(tmp_path, "/dev/null").key) == 32
    (tmp_path / "secret.key").write_bytes(b"")
    key = Mission.open(tmp_path).key
    assert len(key) == 32, "without one anybody could sign"
    assert Mission.open(tmp_path).key == key


def test_whoever_looks_at_a_copy_takes_it_for_no_running_session_and_writes_nothing(tmp_path):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    assert not mission.is_running()
    assert not (mission.path / "lock").exists()
    with mission.lock():
        assert mission.is_running()


@pytest.mark.parametrize("jumped_s", [-86_400.0, 8 * 86_400.0, 1.7e9])
def test_a_clock_that_jumped_between_two_sessions_is_told_and_locks_nobody_out(tmp_path, jumped_s):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    resumed = mission.resume()
    resumed.arrived_s = 100.0
    mission.about.started_unix_s = time.time() - 160.0
    assert mission.keep_time(resumed) is None
    mission.about.started_unix_s -= jumped_s
    assert f"{(60.0 + jumped_s) / 3600.0:.1f} h ago" in mission.keep_time(resumed)
    assert time.time() - mission.about.started_unix_s == pytest.approx(100.0, abs=10.0)


def test_only_its_owner_can_read_the_key(tmp_path):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    assert (mission.path / "secret.key").stat().st_mode & 0o077 == 0
    assert Mission.open(mission.path).key == mission.key
    assert len(mission.key) == 32


class Failing:
    """Estimates at every fourth second, and fails at second 6, or at 6 and 8."""

    def __init__(self, fails_s):
        self.fails_s = fails_s
        self.processed_s = []

    def process(self, measurement):
        if measurement.time_s in self.fails_s:
            raise ZeroDivisionError("a matrix")
        self.processed_s.append(measurement.time_s)
        if measurement.time_s % 4:
            return []
        at = NodeEstimate(1, measurement.time_s, 0.0, 0.1, 0.5, 0.4, 0.0, 0.2, NodeStatus.OK)
        return [Estimate(measurement.time_s, (at,), ())]

    def finish(self):
        return []

    def counters(self):
        return {}


@pytest.mark.parametrize("fails_s", [(6.0,), (6.0, 8.0)])
def test_an_estimator_that_fails_in_a_mission_goes_on_from_its_last_estimate_but_once(fails_s):
    made = []

    def make(priors):
        made.append((tuple(priors), Failing(fails_s)))
        return made[-1][1]

    thread = FusionThread(make, restarts=True)
    for second in range(1, 13):
        thread.submit([Motion(float(second), 1, 1.0, 0.0, 0.0, 0.1, 0.1, 0.1)])
    thread.finish()
    assert thread.join(20.0)
    (_, first), (priors, second) = made
    assert first.processed_s == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert [(p.node, p.x_m) for p in priors] == [(1, 4.0)]
    times = [fused.estimate.time_s for fused in thread.poll()]
    if len(fails_s) == 1:
        assert second.processed_s == [5.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0]
        assert (times, thread.failure) == ([4.0, 8.0, 12.0], None)
    else:
        assert isinstance(thread.failure, ZeroDivisionError)
        assert times == [4.0]


def test_a_start_at_one_pose_outlives_a_kill_before_the_first_checkpoint(tmp_path, monkeypatch):
    values = dict.fromkeys(wire.MOTION.field, 0) | {"time_s": 1.0}
    sent = xbee.encode(xbee.Receive16(1, -40, framing.encode(wire.MOTION, 1, 0, 1, values)))
    sessions = []

    def session(job, source, options, *, common, **_):
        again = [] if source._earlier is None else list(source._earlier)
        sessions.append((common, sum(isinstance(o, Motion) for r in again for o in r.observations)))
        if len(sessions) == 1:
            recorder = make_recorder(options.record, About(round(time.time() * 1e9)))
            recorder.received(0.5, sent)
            recorder.close()
        else:
            (tmp_path / "mill" / "checkpoint.json").write_text("{}")
        source.close()
        return Outcome()

    monkeypatch.setattr(command, "fuse_live", session)
    again = ("mission", tmp_path / "mill", "--estimator", "deadreckoning", "--no-open")
    for asked in ((*again, "loop://", "--initial", "common"), again, again):
        relpos(*asked)
    assert sessions == [(True, 0), (True, 1), (False, 0)]


def test_what_was_received_before_a_session_that_heard_nobody_is_read_again(tmp_path, monkeypatch):
    values = dict.fromkeys(wire.MOTION.field, 0) | {"time_s": 1.0}
    sent = xbee.encode(xbee.Receive16(1, -40, framing.encode(wire.MOTION, 1, 0, 1, values)))
    heard = []

    def session(job, source, options, **_):
        heard.append([] if source._earlier is None else [r.arrival_s for r in source._earlier])
        mission = options.mission.folder
        recorder = make_recorder(options.record, About(round(mission.about.started_unix_s * 1e9)))
        recorder.log("info", "no node is heard yet")
        if len(heard) == 1:
            recorder.received(95.0, sent)
            checkpoint = {"time_s": 99.0, "arrived_s": 100.0, "heard_s": {}, "priors": []}
            (mission.path / "checkpoint.json").write_text(json.dumps(checkpoint))
            mission.about.started_unix_s -= 200.0
        recorder.close()
        source.close()
        return Outcome()

    monkeypatch.setattr(command, "fuse_live", session)
    again = ("mission", tmp_path / "mill", "--estimator", "deadreckoning", "--no-open")
    for asked in ((*again, "loop://"), again, again):
        assert relpos(*asked).exit_code == 0
    assert heard == [[], [95.0], [95.0]]


@pytest.mark.parametrize("sessions", [1, 2])
def test_a_recording_tells_whether_its_session_went_on_from_another(tmp_path, sessions):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    mission.about.sessions = sessions
    kept = MissionPlan(mission, mission.resume())
    plan = SessionPlan("m", tmp_path, Description(), lambda _: Failing(()), "bank", mission=kept)
    about = _about(PacedInput("port", []), plan, Hello("m", "port", "bank", 1.0))
    assert about.resumed is (sessions > 1)
    assert About.read("m", about.metadata()).resumed is about.resumed


def test_a_file_that_a_running_session_replaces_meanwhile_is_no_foreign_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Mission.open(tmp_path / "m", "/dev/null")
    listed = Path.rglob

    def rglob(path: Path, pattern: str) -> list[Path]:
        return [*listed(path, pattern), path / "mission.json.new"]

    monkeypatch.setattr(Path, "rglob", rglob)
    Mission.open(tmp_path / "m", "/dev/null")


@pytest.mark.parametrize("https", [False, True])
def test_an_invitation_has_the_address_at_which_the_page_is_served(tmp_path, https):
    mission = Mission.open(tmp_path / "m", "/dev/null")
    mission.about.port, mission.about.https = 8460, https
    mission.save()
    made = relpos("mission", mission.path, "--invite", "look")
    assert made.stdout.startswith("https://" if https else "http://"), made.output
