"""Cursor-on-Target: what members look like on TAK's screens, and how they get there."""

from __future__ import annotations

import math
import re
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.dom.minidom import Element, parseString

import numpy as np
import pytest
from geographiclib.geodesic import Geodesic

from relpos.errors import DataError
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus
from relpos.geodesy import MapFrame, Pin
from relpos.live.cot import CotSender, PinnedFrame, Schedule, check_url, default_prefix
from relpos.live.cot_events import Events, circle_90_m
from relpos.live.team_view import Alert, TeamView
from relpos.runs import read_estimates
from relpos.tracks import estimated_tracks
from support.command import relpos
from support.team_views import NAMES, PLACES, UNIX_S, team_view
from support.waiting import until

PIN = Pin(48.1, 11.5, math.radians(90.0), 520.0)
FRAME = MapFrame(48.1, 11.5, math.radians(90.0), 520.0)
UNKNOWN = 9999999.0


class Received:
    """One event, parsed by another parser than it was written by, and held against the schema."""

    def __init__(self, data: bytes) -> None:
        event = parseString(data).documentElement
        assert event.tagName == "event"
        assert event.getAttribute("version") == "2.0"
        self.uid = event.getAttribute("uid")
        self.type = event.getAttribute("type")
        self.how = event.getAttribute("how")
        assert self.uid
        assert re.fullmatch(r"\w+(-\w+)*(;[^;]*)?", self.type)
        assert re.fullmatch(r"\w(-\w+)*", self.how)
        self.time_s, self.start_s, self.stale_s = (
            self._moment(event.getAttribute(name)) for name in ("time", "start", "stale")
        )
        assert self.start_s <= self.time_s
        assert self.start_s < self.stale_s
        children = [c.tagName for c in event.childNodes if isinstance(c, Element)]
        assert sorted(children) == ["detail", "point"]
        (point,) = event.getElementsByTagName("point")
        assert sorted(point.attributes.keys()) == ["ce", "hae", "lat", "le", "lon"]
        self.lat, self.lon, self.hae, self.ce, self.le = (
            float(point.getAttribute(name)) for name in ("lat", "lon", "hae", "ce", "le")
        )
        assert -90.0 <= self.lat <= 90.0
        assert -180.0 <= self.lon <= 180.0
        assert self.ce > 0.0
        assert self.le > 0.0
        self.detail = event.getElementsByTagName("detail")[0]

    @staticmethod
    def _moment(text: str) -> float:
        assert text.endswith("Z")
        return datetime.fromisoformat(text).timestamp()

    def attributes(self, tag: str) -> dict[str, str]:
        found = self.detail.getElementsByTagName(tag)
        return dict(found[0].attributes.items()) if found else {}

    def words(self, tag: str) -> str:
        (found,) = self.detail.getElementsByTagName(tag)
        return "".join(child.data for child in found.childNodes)

    def metres_from(self, x_m: float, y_m: float) -> float:
        """How far the event is from a place in the plane, x being east of the pin."""
        bearing, far_m = 90.0 - math.degrees(math.atan2(y_m, x_m)), math.hypot(x_m, y_m)
        there = Geodesic.WGS84.Direct(PIN.latitude_deg, PIN.longitude_deg, bearing, far_m)
        return float(
            Geodesic.WGS84.Inverse(there["lat2"], there["lon2"], self.lat, self.lon)["s12"]
        )


def due(schedule: Schedule, shown: TeamView, now_s: float) -> dict[str, Received]:
    from relpos.live.cot_events import serialized

    events = [Received(serialized(e)) for e in schedule.due(shown, FRAME, now_s, {1: 0.5, 3: 0.0})]
    assert len({event.uid for event in events}) == len(events)
    return {event.uid: event for event in events}


@pytest.fixture
def schedule() -> Schedule:
    return Schedule(Events("test"))


def test_a_member_is_a_friendly_unit_where_it_is(schedule: Schedule) -> None:
    events = due(schedule, team_view(), 0.0)
    assert set(events) == {f"test.{node}" for node in PLACES}
    for node, (x_m, y_m) in PLACES.items():
        event = events[f"test.{node}"]
        assert (event.type, event.how) == ("a-f-G-U-C", "m-g")
        assert event.attributes("contact")["callsign"] == NAMES[node]
        assert event.metres_from(x_m, y_m) < 0.01
        assert event.hae == pytest.approx(520.0 + 0.5 * node)
        assert event.time_s == pytest.approx(UNIX_S + 11.0)
        assert event.start_s == pytest.approx(UNIX_S + 10.75)
        # A compass goes clockwise from north, a heading counter-clockwise from x.
        expected = (90.0 - math.degrees(0.5 * math.pi * node - math.pi)) % 360.0
        course = float(event.attributes("track")["course"])
        assert math.remainder(course - expected, 360.0) == pytest.approx(0.0, abs=0.06)
    assert events["test.1"].le == pytest.approx(1.645 * 0.5, abs=0.06)
    assert events["test.2"].le == UNKNOWN
    assert events["test.3"].le == UNKNOWN, "a standard deviation of 0 is one that is not stated"


def test_the_command_posts_node_is_no_unit(schedule: Schedule) -> None:
    events = due(schedule, team_view(1, changes={3: {"post": True}}), 0.0)
    assert events["test.3"].type == "a-f-G-I"
    assert events["test.3"].attributes("__group")["role"] == "HQ"
    assert events["test.1"].attributes("__group")["role"] == "Team Member"


def test_the_circle_holds_ninety_per_cent() -> None:
    noise = np.random.default_rng(1).normal(size=(400_000, 2))
    for major_m, minor_m in ((1.0, 1.0), (2.0, 0.9), (3.0, 0.2), (0.5, 0.0)):
        off_m = np.hypot(*(noise * [major_m, minor_m]).T)
        assert circle_90_m(major_m, minor_m) == pytest.approx(np.quantile(off_m, 0.9), rel=0.01)
    assert circle_90_m(0.0, 0.0) == 0.0


def test_the_error_is_the_circles_radius(schedule: Schedule) -> None:
    event = due(schedule, team_view(), 0.0)["test.1"]
    assert event.ce == pytest.approx(circle_90_m(0.8, 0.4), abs=0.06)


def test_no_member_is_sent_twice_a_second(schedule: Schedule) -> None:
    times: dict[str, list[float]] = {}
    for tick in range(60):
        now_s = 0.1 * tick
        changes: dict[int, Any] = {3: {"alert": Alert.STILL_ALARM}} if 20 < tick < 40 else {}
        for uid in due(schedule, team_view(tick, changes=changes), now_s):
            times.setdefault(uid.removesuffix("-9-1-1"), []).append(now_s)
    assert {"test.1", "test.2", "test.3"} <= set(times)
    for sent_s in times.values():
        assert min(np.diff(sent_s)) >= 1.0 - 1e-9
        assert len(sent_s) >= 5


def test_a_view_that_does_not_change_is_not_sent_again(schedule: Schedule) -> None:
    assert due(schedule, team_view(1), 0.0)
    assert not due(schedule, team_view(1), 5.0)
    assert due(schedule, team_view(2), 6.0)


def test_speed_is_that_of_the_path_between_two_events(schedule: Schedule) -> None:
    due(schedule, team_view(1), 0.0)
    moved = {"x_m": 3.0, "y_m": 4.0, "motion_s": 14.0}
    events = due(schedule, team_view(2, changes={1: moved, 2: {"moving": False}}), 4.0)
    assert float(events["test.1"].attributes("track")["speed"]) == pytest.approx(1.25)
    assert float(events["test.2"].attributes("track")["speed"]) == 0.0


def test_a_silent_member_goes_stale_by_its_last_reception_time(schedule: Schedule) -> None:
    gone = {"status": "lost", "seen_s": 40.0, "alert": Alert.LOST}
    event = due(schedule, team_view(1, changes={2: gone}), 0.0)["test.2"]
    assert event.how == "h-e"
    assert event.stale_s < event.time_s
    assert event.start_s == pytest.approx(event.time_s - 40.0)
    assert not event.attributes("track")
    assert "last heard 40 s ago" in event.words("remarks")
    # Now and then, for clients that join late.
    assert "test.2" not in due(schedule, team_view(2, changes={2: gone}), 3.0)
    assert "test.2" in due(schedule, team_view(3, changes={2: gone}), 11.0)


def test_an_ambiguous_position_is_called_an_estimate(schedule: Schedule) -> None:
    unsure = {"status": "ambiguous", "sigma_major_m": 9.0, "sigma_minor_m": 9.0}
    event = due(schedule, team_view(1, changes={2: unsure}), 0.0)["test.2"]
    assert event.how == "h-e"
    assert event.ce == pytest.approx(9.0 * 2.146, abs=0.1)
    assert "ambiguous" in event.words("remarks")


def test_a_member_without_position_is_not_sent(schedule: Schedule) -> None:
    changes: dict[int, dict[str, Any]] = {
        1: {"status": "unlocated"},
        2: {"x_m": None, "y_m": None},
        3: {"seen_s": None},
    }
    assert set(due(schedule, team_view(1, changes=changes), 0.0)) == {"test.4"}


def test_a_motionless_person_is_an_emergency_until_it_is_over(schedule: Schedule) -> None:
    still = {"alert": Alert.STILL_ALARM, "still_s": 31.0, "moving": False}
    alarm = due(schedule, team_view(1, changes={3: still}), 0.0)["test.3-9-1-1"]
    assert alarm.type == "b-a-o-tbl"
    assert alarm.attributes("emergency") == {"type": "911 Alert"}
    assert alarm.words("emergency") == NAMES[3]
    assert alarm.attributes("link")["uid"] == "test.3"
    assert alarm.metres_from(*PLACES[3]) < 0.01
    assert "LIES STILL for 31 s" in alarm.words("remarks")
    # The member itself goes on beside it, and the emergency is repeated.
    assert due(schedule, team_view(2, changes={3: still}), 1.0)["test.3"].type == "a-f-G-U-C"
    assert "test.3-9-1-1" in due(schedule, team_view(3, changes={3: still}), 11.0)
    # Silence is no sign of having got up.
    silent = {"alert": Alert.LOST, "status": "lost", "seen_s": 12.0}
    later = due(schedule, team_view(4, changes={3: silent}), 22.0)["test.3-9-1-1"]
    assert later.type == "b-a-o-tbl"
    over = due(schedule, team_view(5), 24.0)["test.3-9-1-1"]
    assert over.type == "b-a-o-can"
    assert over.attributes("emergency") == {"cancel": "true"}
    assert "test.3-9-1-1" not in due(schedule, team_view(6), 26.0)


def test_an_emergency_needs_no_position(schedule: Schedule) -> None:
    still = {"alert": Alert.STILL_ALARM, "status": "unlocated", "x_m": None, "y_m": None}
    alarm = due(schedule, team_view(1, changes={3: still}), 0.0)["test.3-9-1-1"]
    assert alarm.ce == UNKNOWN
    assert alarm.metres_from(0.0, 0.0) < 0.01
    assert "position unknown" in alarm.words("remarks")


def test_an_emulated_or_replayed_team_says_so() -> None:
    events = due(Schedule(Events("test", exercise=True)), team_view(), 0.0)
    assert {event.how for event in events.values()} == {"m-s"}
    assert all("EXERCISE" in event.words("remarks") for event in events.values())


def test_a_lost_member_stays_on_the_map_as_a_marker_until_it_is_heard_again(
    schedule: Schedule,
) -> None:
    gone = {1: {"status": "lost", "seen_s": 60.0, "alert": Alert.LOST}}
    events = due(schedule, team_view(1, changes=gone), 0.0)
    marker = events["test.1-last"]
    assert marker.type == "b-m-p-s-m"
    assert "last known" in marker.attributes("contact")["callsign"]
    assert marker.stale_s > marker.start_s + 3600.0, "clients delete what is stale"
    assert events["test.1"].stale_s < events["test.1"].time_s
    assert "test.1-last" not in due(schedule, team_view(2, changes=gone), 2.0)
    assert "test.1-last" in due(schedule, team_view(3, changes=gone), 62.0)
    assert due(schedule, team_view(4), 64.0)["test.1-last"].type == "t-x-d-d"
    assert "test.1-last" not in due(schedule, team_view(5), 66.0)


GONE = {1: {"status": "lost", "seen_s": 60.0, "alert": Alert.LOST}}


def test_the_marker_goes_also_where_who_is_heard_again_has_no_position(schedule: Schedule) -> None:
    due(schedule, team_view(1, changes=GONE), 0.0)
    nowhere = {1: {"status": "unlocated", "x_m": None, "y_m": None}}
    assert due(schedule, team_view(2, changes=nowhere), 2.0)["test.1-last"].type == "t-x-d-d"


def test_a_lost_member_has_its_marker_as_soon_as_it_has_a_position(schedule: Schedule) -> None:
    nowhere = {1: {**GONE[1], "x_m": None, "y_m": None}}
    assert "test.1-last" not in due(schedule, team_view(1, changes=nowhere), 0.0)
    assert "test.1-last" in due(schedule, team_view(2, changes=GONE), 2.0)


def test_the_ends_of_alarms_and_markers_are_told_thrice_and_after_each_broken_connection(
    schedule: Schedule,
) -> None:
    still = {"alert": Alert.STILL_ALARM, "still_s": 31.0, "moving": False}
    due(schedule, team_view(1, changes={**GONE, 3: still}), 0.0)

    def ends(seconds: range) -> list[tuple[int, str]]:
        return [
            (second, event.type)
            for second in seconds
            for event in due(schedule, team_view(second), float(second)).values()
            if event.type in ("b-a-o-can", "t-x-d-d")
        ]

    thrice = [(s, kind) for s in (2, 12, 22) for kind in ("t-x-d-d", "b-a-o-can")]
    assert ends(range(2, 100)) == thrice
    schedule.again()
    assert ends(range(100, 200))[:2] == [(100, "t-x-d-d"), (100, "b-a-o-can")]


def test_an_alarm_is_told_at_once_to_a_server_that_is_back(schedule: Schedule) -> None:
    still = {3: {"alert": Alert.STILL_ALARM, "still_s": 31.0, "moving": False}}
    due(schedule, team_view(1, changes=still), 0.0)
    assert "test.3-9-1-1" not in due(schedule, team_view(2, changes=still), 2.0)
    schedule.again()
    assert "test.3-9-1-1" in due(schedule, team_view(3, changes=still), 4.0)
    schedule.again()
    silent = {3: {"alert": Alert.LOST, "status": "lost", "seen_s": 12.0}}
    alarm = due(schedule, team_view(4, changes=silent), 6.0)["test.3-9-1-1"]
    assert alarm.type == "b-a-o-tbl", "who falls silent has not got up"


def test_what_a_session_has_sent_lapses_by_itself_and_is_repeated_before_it_does(
    schedule: Schedule,
) -> None:
    still = {"alert": Alert.STILL_ALARM, "still_s": 31.0, "moving": False}
    sent: dict[str, list[tuple[float, float]]] = {}
    for second in range(200):
        shown = team_view(second, changes={**GONE, 3: still})
        for uid, event in due(schedule, shown, float(second)).items():
            sent.setdefault(uid, []).append((float(second), event.stale_s - event.time_s))
    for uid, lasts_s in (("test.2", 15.0), ("test.3-9-1-1", 600.0), ("test.1-last", 86_400.0)):
        times = [at_s for at_s, _ in sent[uid]] + [200.0]
        for at_s, after_s, (_, stale_s) in zip(times, times[1:], sent[uid], strict=False):
            assert after_s - at_s < stale_s <= lasts_s, uid


@pytest.mark.soak  # `make soak` installs it
def test_takproto_reads_members_alarms_markers_and_deletions(schedule: Schedule) -> None:
    takproto = pytest.importorskip("takproto", reason="make soak installs it")
    from relpos.live.cot_events import serialized

    still = {"alert": Alert.STILL_ALARM, "still_s": 31.0, "moving": False}
    gone = {"status": "lost", "seen_s": 60.0, "alert": Alert.LOST}
    kinds = set()
    for second, changes in ((0.0, {3: still, 1: gone}), (64.0, {})):
        for sent in schedule.due(team_view(1 + int(second), changes=changes), FRAME, second, {}):
            mine = Received(serialized(sent))
            read = takproto.parse_proto(takproto.xml2proto(serialized(sent))).cotEvent
            assert (read.uid, read.type, read.how) == (mine.uid, mine.type, mine.how)
            assert (read.lat, read.lon) == pytest.approx((mine.lat, mine.lon), abs=1e-9)
            times = (read.sendTime, read.startTime, read.staleTime)
            ours = (mine.time_s, mine.start_s, mine.stale_s)
            assert [t / 1000.0 for t in times] == pytest.approx(ours, abs=0.002)
            if read.type == "a-f-G-U-C":
                assert read.detail.contact.callsign == mine.attributes("contact")["callsign"]
            kinds.add(read.type)
    assert kinds >= {"a-f-G-U-C", "b-a-o-tbl", "b-a-o-can", "b-m-p-s-m", "t-x-d-d"}


def test_a_name_that_xml_cannot_hold_is_sent_without_the_rest(schedule: Schedule) -> None:
    event = due(schedule, team_view(1, changes={1: {"name": "A\x00\x1b\ud800b"}}), 0.0)["test.1"]
    assert event.attributes("contact")["callsign"] == "Ab"


def test_a_teams_uids_are_the_same_in_every_session() -> None:
    assert default_prefix() == default_prefix()
    assert re.fullmatch(r"relpos-[0-9a-f]{8}", default_prefix())


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("239.2.3.1:6969", "begins with none of udp://"),
        ("http://tak.example:80", "begins with none of"),
        ("udp://239.2.3.1", "host and port are missing"),
        ("tcp://:8087", "host and port are missing"),
        ("tcp://tak.example:high", "--cot tcp://tak.example:high: "),
    ],
)
def test_an_address_that_cannot_work_is_reported_at_once(url: str, words: str) -> None:
    with pytest.raises(DataError, match=re.escape(words)):
        check_url(url)
    with pytest.raises(DataError):
        CotSender(url, [PIN])


def test_nothing_is_sent_without_a_pin() -> None:
    with pytest.raises(DataError, match="--pin LAT,LON"):
        CotSender("udp://127.0.0.1:9", [])


def test_a_pin_on_a_node_waits_for_it() -> None:
    pinned = PinnedFrame([Pin(48.0, 11.0, 0.0, node=2, time_s=15.0)])
    assert pinned.update(team_view(1)) is None
    assert pinned.update(team_view(6, changes={2: {"status": "ambiguous"}})) is None
    assert "node 2 is not located" in str(pinned.waits_for())
    frame = pinned.update(team_view(7))
    assert frame is not None
    assert frame.place_m == PLACES[2]
    assert pinned.waits_for() is None
    # It stays where it was put.
    moved = {2: {"x_m": 99.0}}
    assert pinned.update(team_view(8, changes=moved)) is frame


class Server:
    """A TAK server as far as taking events goes; can hang up and come back."""

    def __init__(self, port: int = 0, context: ssl.SSLContext | None = None) -> None:
        self._context = context
        self.received: list[Received] = []
        self._listener = socket.create_server(("127.0.0.1", port), reuse_port=False)
        self.port: int = self._listener.getsockname()[1]
        self._connections: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self._connections.append(connection)
            if self._context is not None:
                try:
                    connection = self._context.wrap_socket(connection, server_side=True)
                except OSError:
                    continue
                self._connections[-1] = connection
            threading.Thread(target=self._read, args=(connection,), daemon=True).start()

    def _read(self, connection: socket.socket) -> None:
        pending = b""
        # A server talks back: its own events must not stop the sender.
        connection.sendall(b"<event/>" * 100)
        while True:
            try:
                data = connection.recv(65536)
            except OSError:
                return
            if not data:
                return
            pending += data
            while b"</event>" in pending:
                event, pending = pending.split(b"</event>", 1)
                self.received.append(Received(event.strip() + b"</event>"))

    def close(self) -> None:
        # What another thread waits for is not freed by closing it.
        for used in (self._listener, *self._connections):
            with suppress(OSError):
                used.shutdown(socket.SHUT_RDWR)
            used.close()


class Feeding:
    """A session's receive thread: pictures at the usual rate."""

    def __init__(self, sender: CotSender) -> None:
        self._sender = sender
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        self._sender.estimated(
            Estimate(
                1.0,
                (NodeEstimate(1, 0, 0, 0, 1, 1, 0, 0.1, NodeStatus.OK, 0.5, 0.5),),
                (),
            )
        )
        seq = 0
        while not self._stop.wait(0.05):
            seq += 1
            self._sender.updated(replace(team_view(seq), unix_s=time.time()))

    def __enter__(self) -> Feeding:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture
def udp_port() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(30.0)
        yield listener


def test_every_member_arrives_by_udp(udp_port: socket.socket) -> None:
    sender = CotSender(f"udp://127.0.0.1:{udp_port.getsockname()[1]}", [PIN])
    events: dict[str, Received] = {}
    with closing(sender), Feeding(sender):
        while len(events) < len(PLACES):
            event = Received(udp_port.recv(65536))
            events[event.attributes("contact")["callsign"]] = event
        until(lambda: sender.trouble() is None, "the error is reported for ever")
    assert set(events) == set(NAMES.values())
    for node, place in PLACES.items():
        assert events[NAMES[node]].metres_from(*place) < 0.01


def test_a_session_sends_every_member(tmp_path: Path, udp_port: socket.socket) -> None:
    """The whole way: a walk through the command line, its fusion and its pictures."""
    words = ("simulate", "--scenario", "paper", "--seed", 1, "--out", tmp_path / "walk")
    made = relpos(*words, "--set", "seconds=20", "--set", "nodes=4")
    assert made.exit_code == 0, made.output
    events: dict[str, Received] = {}

    def receive() -> None:
        # Kernels may have to be compiled first, for minutes.
        while udp_port.fileno() >= 0:
            with suppress(OSError):
                event = Received(udp_port.recv(65536))
                events.setdefault(event.attributes("contact")["callsign"], event)

    receiver = threading.Thread(target=receive, daemon=True)
    receiver.start()
    url = f"udp://127.0.0.1:{udp_port.getsockname()[1]}"
    done = relpos(
        "fuse", tmp_path / "walk", "--cot", url, "--pin", "48.1,11.5,90", "--speed", 2,
        "--out", tmp_path / "out", "--seconds", 8, "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    until(lambda: len(events) >= 4, f"only {sorted(events)} arrived")
    # It walked some time ago: the positions are not live.
    assert {event.how for event in events.values()} == {"m-s"}
    tracks = estimated_tracks(read_estimates(tmp_path / "out"))
    for event in events.values():
        assert event.type == "a-f-G-U-C"
        track = tracks[int(event.uid.rpartition(".")[2])]
        # A view is between two estimates, a step's length apart.
        places = zip(track.x_m, track.y_m, strict=True)
        assert min(event.metres_from(x_m, y_m) for x_m, y_m in places) < 1.0


def test_a_udp_port_without_a_listener_is_reported() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("127.0.0.1", 0))
        port = held.getsockname()[1]
    sender = CotSender(f"udp://127.0.0.1:{port}", [PIN])
    with closing(sender), Feeding(sender):
        until(lambda: "Connection refused" in str(sender.trouble()), "the refusal is not reported")


def test_every_member_arrives_by_tcp_also_after_the_server_was_away() -> None:
    server = Server()
    port = server.port
    sender = CotSender(f"tcp://127.0.0.1:{port}", [PIN])
    with closing(sender), Feeding(sender):
        until(
            lambda: (
                {e.attributes("contact")["callsign"] for e in list(server.received)}
                == set(NAMES.values())
            ),
            "not every member arrives",
        )
        assert sender.trouble() is None
        server.close()
        until(
            lambda: f"tcp://127.0.0.1:{port}" in str(sender.trouble()), "the loss is not reported"
        )
        back = Server(port)
        until(lambda: len(back.received) >= len(PLACES), "it does not come back")
        until(lambda: sender.trouble() is None, "the error is reported for ever")
        back.close()


def test_every_member_arrives_by_tls(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import trustme

    authority = trustme.CA()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    authority.issue_cert("localhost", "127.0.0.1").configure_cert(context)
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    client = authority.issue_cert("team@example.org")
    client.private_key_and_cert_chain_pem.write_to_path(str(tmp_path / "client.pem"))
    server = Server(context=context)
    sender = CotSender(f"tls://localhost:{server.port}", [PIN])
    with closing(sender), Feeding(sender):
        until(
            lambda: "PYTAK_TLS_CLIENT_CERT" in str(sender.trouble()),
            "the missing variable is not reported",
        )
    for name in ("CERT", "KEY"):
        monkeypatch.setenv(f"PYTAK_TLS_CLIENT_{name}", str(tmp_path / "client.pem"))
    sender = CotSender(f"tls://localhost:{server.port}", [PIN])
    with closing(sender), Feeding(sender):
        until(lambda: "Could not verify" in str(sender.trouble()), "an unknown server is trusted")
    assert not server.received
    monkeypatch.setenv("PYTAK_TLS_CLIENT_CAFILE", str(tmp_path / "ca.pem"))
    sender = CotSender(f"tls://localhost:{server.port}", [PIN])
    with closing(sender), Feeding(sender):
        until(
            lambda: (
                {e.attributes("contact")["callsign"] for e in list(server.received)}
                == set(NAMES.values())
            ),
            f"not every member arrives: {sender.trouble()}",
        )
    server.close()


def test_a_server_that_is_not_there_does_not_hold_up_the_session() -> None:
    server = Server()
    server.close()
    sender = CotSender(f"tcp://127.0.0.1:{server.port}", [PIN])
    with closing(sender), Feeding(sender):
        until(lambda: "refused" in str(sender.trouble()), "the refusal is not reported")
        before_s = time.thread_time()
        for seq in range(1000):
            sender.updated(team_view(1_000 + seq))
        assert time.thread_time() - before_s < 5.0
