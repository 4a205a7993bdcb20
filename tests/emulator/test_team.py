"""The emulated team end to end on the production firmware: bytes at the coordinator's port."""

import hashlib
import itertools
import math
import threading
from collections import Counter

import numpy as np
import pytest

from relpos import fusion
from relpos.emulator.pty import PseudoTerminal
from relpos.emulator.serving import record_team, serve_team
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.errors import DataError, RelposError
from relpos.fusion.estimator import NodeStatus
from relpos.link.port import Link, observe, open_port
from relpos.link.xbee import Parser, Receive16
from relpos.measurements import Height, Motion, Range, Status
from relpos.protocol import framing
from relpos.protocol import messages as wire

SECONDS = 40.0
NODES = 3


def serial_output(seed, seconds=SECONDS, nodes=NODES, **options):
    with EmulatedTeam(TeamConfig("paper", nodes, seconds, seed, **options)) as team:
        return list(team.stream())


@pytest.fixture(scope="module")
def received():
    """A team after its walk, what left its port, and the link that read it."""
    with EmulatedTeam(TeamConfig("paper", NODES, SECONDS, 5)) as team:
        link = Link()
        chunks, observations = [], []
        for time_us, data in team.stream():
            chunks.append((time_us, data))
            observations += link.feed(data, time_us * 1e-6)
        yield team, chunks, link, observations


def frames_of(chunks):
    parser = Parser()
    frames = [frame for _, data in chunks for frame in parser.feed(data)]
    assert parser.counts.skipped_bytes == parser.counts.bad_checksums == 0
    return frames


def test_everything_at_the_port_is_a_frame_of_this_protocol(received):
    _, chunks, _, _ = received
    frames = frames_of(chunks)
    assert all(isinstance(frame, Receive16) for frame in frames)
    decoded = [framing.decode(frame.data) for frame in frames]
    assert {f.node for f in decoded} == {1, 2, 3}
    assert all(f.node == frame.source for f, frame in zip(decoded, frames, strict=True))
    assert {"motion", "ranges", "status"} <= {f.message.name for f in decoded}


def test_times_rise_and_bytes_keep_to_the_speed_of_the_line(received):
    _, chunks, _, _ = received
    for (before, _), (after, data) in itertools.pairwise(chunks):
        assert after - before >= len(data) * 10 / 38_400 * 1e6 - 1


def test_every_node_reports_its_motion_every_second(received):
    team, _, _, observations = received
    counts = Counter(o.node for o in observations if isinstance(o, Motion))
    # 2 % of the frames are lost on the air, the first second is for booting.
    assert all(0.85 * SECONDS <= counts[node] <= SECONDS for node in team.nodes)


def test_the_same_seed_gives_the_same_bytes_at_the_same_times():
    one, other = serial_output(7, 15.0), serial_output(7, 15.0)
    assert one == other
    assert (
        hashlib.sha256(repr(serial_output(8, 15.0)).encode()).digest()
        != hashlib.sha256(repr(one).encode()).digest()
    )


def test_ranges_are_the_true_distances_at_their_times(received):
    team, _, _, observations = received
    ranges = [o for o in observations if isinstance(o, Range)]
    assert len(ranges) > 10
    for r in ranges:
        true = math.dist(team.position_m(r.node, r.time_s), team.position_m(r.peer, r.time_s))
        # 0.1 m of noise, and what people walk in the 50 ms that the node's clock may be off.
        assert r.range_m == pytest.approx(true, abs=0.55)


def test_dead_reckoning_goes_where_the_walker_goes(received):
    """A coarse check of the whole chain's scales and signs, not of its accuracy."""
    team, _, _, observations = received
    motions = [o for o in observations if isinstance(o, Motion) and o.node == 1]
    x = y = heading = 0.0
    for m in motions:
        x += math.cos(heading) * m.dx_m - math.sin(heading) * m.dy_m
        y += math.sin(heading) * m.dx_m + math.cos(heading) * m.dy_m
        heading += m.dtheta_rad
    true = team.position_m(1, motions[-1].time_s) - team.position_m(1, 0.0)
    true_turn = team.heading_rad(1, motions[-1].time_s) - team.heading_rad(1, 0.0)
    assert math.dist((x, y), true[:2]) < 0.25 * math.hypot(*true[:2])
    assert heading == pytest.approx(true_turn, abs=0.5)


def test_the_link_misses_what_the_radio_loses(received):
    team, _, link, _ = received
    assert team.radio.counts["sent"] - team.radio.counts["lost"] == pytest.approx(
        link.summary()["received"], abs=3
    )
    assert link.summary()["lost"] <= team.radio.counts["lost"]


def test_chips_are_driven_without_bus_errors(received):
    team, _, _, observations = received
    for node in team.nodes.values():
        failed = sum(n for (_, status), n in node.bus.counts.items() if status)
        assert failed < 0.02 * node.bus.transactions
    errors = {
        o.node: o.value for o in observations if isinstance(o, Status) and o.name == "bus_errors"
    }
    assert all(count < 100 for count in errors.values())


def test_a_command_reaches_its_node_and_is_acknowledged():
    link = Link()
    with EmulatedTeam(TeamConfig("paper", 2, 20.0, 3)) as team:
        for time_us, data in team.run(3_000_000):
            link.feed(data, time_us * 1e-6)
        token, request = link.command(2, wire.CommandCode.PING, 0)
        for _ in range(5):  # the radio loses one in fifty
            team.send(request)
            for time_us, data in team.run(team.time_us + 500_000):
                link.feed(data, time_us * 1e-6)
    answers = [a for a in link.decoder.acknowledged if a.token == token]
    assert {a.node for a in answers} == {2}
    assert all(a.result == wire.CommandResult.DONE for a in answers)


def beacons_of(team, node, seconds):
    """Arrival times and values of the beacons that come out of a node's radio module."""
    received, parser = [], Parser()
    inner = team.nodes[node].radio.on_serial

    def tap(left_us, data):
        received.extend(
            (left_us * 1e-6, framing.decode(frame.data, framing.node_key(team.key, frame.data[3])))
            for frame in parser.feed(data)
            if isinstance(frame, Receive16) and frame.data[2] == wire.BEACON.number
        )
        inner(left_us, data)

    team.nodes[node].radio.on_serial = tap
    team.run(round(seconds * 1e6))
    return received


def test_a_team_that_sends_beacons_itself_sends_its_virtual_time():
    key = bytes(range(16))
    with EmulatedTeam(TeamConfig("paper", 3, 30.0, 3, key=key, beacons=True)) as team:
        received = beacons_of(team, 2, 30.0)
    assert 23 <= len(received) <= 26
    counters = [frame.counter for _, frame in received]
    assert counters == sorted(set(counters))
    for time_s, frame in received:
        assert [entry["node"] for entry in frame.values["nodes"]] == [1, 2, 3]
        beacon_s = frame.values["round"] * 2.0 + frame.values["phase_s"]
        # Two lines of 38400 baud and the air lie between.
        assert 0.02 < time_s - beacon_s < 0.12


def test_nodes_receive_a_beacon_at_the_same_moment():
    with EmulatedTeam(TeamConfig("paper", 2, 20.0, 3, beacons=True)) as team:
        one = beacons_of(team, 1, 20.0)
    with EmulatedTeam(TeamConfig("paper", 2, 20.0, 3, beacons=True)) as team:
        other = {frame.counter: time_s for time_s, frame in beacons_of(team, 2, 20.0)}
    both = [(time_s, other[frame.counter]) for time_s, frame in one if frame.counter in other]
    assert len(both) > 10
    assert all(a == pytest.approx(b, abs=1e-3) for a, b in both)


def test_a_team_sends_no_beacons_unless_it_is_asked_to():
    with EmulatedTeam(TeamConfig("paper", 2, 10.0, 3)) as team:
        assert beacons_of(team, 1, 10.0) == []


def test_collisions_can_be_switched_off():
    with EmulatedTeam(TeamConfig("paper", 4, 20.0, 3, collisions=False)) as team:
        for _ in team.stream():
            pass
        assert team.uwb.counts["attempts"] > 10
        assert team.uwb.counts["collisions"] == 0


def test_an_unknown_scenario_or_fault_is_one_clear_error():
    with pytest.raises(DataError, match="moon"):
        EmulatedTeam(TeamConfig("moon", 2, 10.0, 1))
    with pytest.raises(RelposError, match="gremlins"):
        serve_team(TeamConfig("paper", 2, 10.0, 1, faults=("gremlins",)), 1.0, print)


def test_a_walk_that_does_not_fit_into_memory_is_refused_before_it_is_prepared(monkeypatch):
    monkeypatch.setattr("relpos.emulator.team.physical_memory_gb", lambda: 8.0)
    with pytest.raises(DataError, match=r"20 people for 7200 s takes 8.1 GB .* of 8.0 GB here"):
        EmulatedTeam(TeamConfig("paper", 20, 7200.0))


def test_a_recorded_team_is_the_same_run_each_time():
    arguments = {"board": "native", "nodes": 2, "seconds": 15.0, "scenario": "paper", "seed": 4}
    one, other = record_team(TeamConfig(**arguments)), record_team(TeamConfig(**arguments))
    assert one.measurements == other.measurements
    assert one.statuses == other.statuses
    assert {m.node for m in one.motions} == {1, 2}
    assert one.truth[-1].time_s >= 14.5
    assert {p.node for p in one.priors} == {1, 2}


def test_an_emulated_port_faster_than_real_time_is_read_in_virtual_time(capsys):
    path, opened = [], threading.Event()

    def announce(name):
        path.append(name)
        opened.set()

    config = TeamConfig("paper", 2, 30.0, 2)
    thread = threading.Thread(target=serve_team, args=(config, 0.0, announce))
    thread.start()
    assert opened.wait(20.0)
    link, motions = Link(), []

    def read_on():
        with open_port(path[0]) as port:
            for batch in observe(port, link):
                motions.extend(o for o in batch if isinstance(o, Motion))

    with pytest.raises(RelposError, match="vanished"):
        read_on()
    thread.join()
    times = [m.time_s for m in motions if m.node == 1]
    assert len(times) >= 25
    assert times[-1] - times[0] == pytest.approx(len(times) - 1, abs=3.0)
    assert "over" in capsys.readouterr().err


def test_a_terminal_of_a_real_team_gives_its_bytes_whole():
    expected = b"".join(data for _, data in serial_output(9, 10.0, 2))
    got = b""
    with (
        EmulatedTeam(TeamConfig("paper", 2, 10.0, 9)) as team,
        PseudoTerminal(team, 0.0) as terminal,
        terminal.open_port() as port,
    ):
        terminal.start()
        while not port.exhausted:
            got += port.read(max(1, port.in_waiting))
        terminal.join()
    assert got == expected


def test_whose_inertial_sensor_is_silent_is_followed_by_ranges_and_not_believed_to_stand():
    off = "imu:off:node=2,from=25,to=55"
    with EmulatedTeam(TeamConfig("paper", 4, 65.0, 2, faults=(off,))) as team:
        link, received = Link(), []
        for time_us, data in team.stream():
            received += link.feed(data, time_us * 1e-6)
        estimator = fusion.make("bank", team.priors(), {}, 1)
        used = [one for one in received if isinstance(one, Motion | Range | Height)]
        estimates = [e for one in used for e in estimator.process(one)]
        off_m, sigma_m, ok = [], [], []
        for estimate in [*estimates, *estimator.finish()]:
            good = {n.node for n in estimate.nodes if n.status is NodeStatus.OK}
            for pair in estimate.pairs:
                if estimate.time_s > 25.0 and 2 in (pair.node, pair.peer):
                    a, b = (team.position_m(n, estimate.time_s) for n in (pair.node, pair.peer))
                    off_m.append(abs(pair.distance_m - math.dist(a[:2], b[:2])))
                    sigma_m.append(pair.sigma_distance_m)
                    ok.append({pair.node, pair.peer} <= good)
    off_m, sigma_m, ok = np.array(off_m), np.array(sigma_m), np.array(ok)
    assert ok.any()
    assert (off_m[ok] < 3.0 * sigma_m[ok]).all()
    assert np.sqrt((off_m**2).mean()) < 1.0
