"""The beacon: its nodes, their order, and its time."""

import os
import pty
import tty

import pytest

from relpos.cli.node_watch import _watch
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.errors import DataError
from relpos.link import xbee
from relpos.link.beacon import FORGET_S, MAX_NODES, BeaconSchedule, HostBeacons
from relpos.link.port import Link
from relpos.live.inputs import PortInput
from relpos.measurements import Status
from relpos.protocol import framing
from relpos.protocol import messages as wire


def ids(beacon):
    return [entry["node"] for entry in beacon["nodes"]]


def receive(schedule, nodes, time_s):
    for node in nodes:
        schedule.heard(node, time_s)


def test_a_beacon_leaves_once_a_second_with_the_time_in_the_superframe():
    schedule = BeaconSchedule([1, 2])
    sent = []
    for k in range(1000):  # looked at every 10 ms
        values = schedule.due(k * 0.01)
        if values is not None:
            sent.append((k * 0.01, values))
    assert len(sent) == 10
    for time_s, values in sent:
        assert values["period_s"] == 2.0
        assert values["round"] * 2.0 + values["phase_s"] == pytest.approx(time_s, abs=1e-3)


def test_a_late_beacon_carries_the_time_at_which_it_leaves():
    schedule = BeaconSchedule([1])
    assert schedule.due(0.0)["phase_s"] == 0.0
    assert schedule.due(0.9) is None
    late = schedule.due(5.123)
    assert late["phase_s"] == pytest.approx(1.123)
    assert late["round"] == 2
    assert schedule.due(5.2) is None, "missed beacons are not made up for"


def test_a_beacon_that_leaves_when_the_next_is_due_takes_its_turn():
    schedule = BeaconSchedule([1])
    assert schedule.due(0.0)
    assert schedule.due(2.0)
    assert schedule.due(2.5) is None
    assert schedule.due(3.0)


def test_the_round_wraps_after_256_superframes():
    schedule = BeaconSchedule([1])
    assert schedule.due(511.0)["round"] == 255
    assert schedule.due(512.0)["round"] == 0


def test_no_beacon_is_sent_to_an_empty_team():
    schedule = BeaconSchedule()
    assert schedule.due(0.0) is None
    schedule.heard(4, 0.5)
    assert ids(schedule.due(0.6)) == [4]


def test_present_nodes_keep_their_order_and_newcomers_follow_sorted():
    schedule = BeaconSchedule()
    receive(schedule, (5, 9), 0.0)
    assert schedule.team(0.0) == (5, 9)
    receive(schedule, (7, 1, 5, 9), 1.0)
    assert schedule.team(1.0) == (5, 9, 1, 7)
    receive(schedule, (5, 1, 7), 20.0)
    assert schedule.team(1.0 + FORGET_S) == (5, 9, 1, 7)
    assert schedule.team(1.1 + FORGET_S) == (5, 1, 7), "9 was silent for too long"
    receive(schedule, (9,), 32.0)
    assert schedule.team(32.0) == (5, 1, 7, 9)


def test_given_nodes_stay_whether_they_are_received_or_not():
    schedule = BeaconSchedule([3, 2])
    receive(schedule, (1,), 0.0)
    assert schedule.team(0.0) == (2, 3, 1)
    assert schedule.team(100.0) == (2, 3)


def test_the_twenty_first_node_is_left_out_and_named():
    schedule = BeaconSchedule()
    receive(schedule, range(10, 10 + MAX_NODES), 0.0)
    schedule.team(0.0)
    receive(schedule, range(10, 10 + MAX_NODES), 1.0)
    receive(schedule, (1,), 1.0)
    assert len(schedule.team(1.0)) == MAX_NODES
    assert 1 not in schedule.team(1.0)
    assert schedule.left_out == (1,)


@pytest.mark.parametrize("nodes", [[0], [255], [1, 1], range(1, MAX_NODES + 2)])
def test_a_team_that_cannot_be_is_refused(nodes):
    with pytest.raises(DataError):
        BeaconSchedule(nodes)


def test_every_beacon_fits_the_wire():
    schedule = BeaconSchedule(range(1, MAX_NODES + 1))
    for k in range(5000):
        values = schedule.values(k * 0.1234567)
        assert 0.0 <= values["phase_s"] < values["period_s"]
        frame = framing.decode(framing.encode(wire.BEACON, wire.BROADCAST, 0, k + 1, values))
        assert ids(frame.values) == list(range(1, MAX_NODES + 1))


# --- of a host -----------------------------------------------------------------------------------


def motion(node, counter):
    values = dict.fromkeys(wire.MOTION.field, 0)
    data = framing.encode(wire.MOTION, node, 0, counter, values)
    return xbee.encode(xbee.Receive16(node, -60, data))


def test_a_host_reports_the_nodes_that_it_receives():
    link = Link(clock=lambda: 2e9)
    beacons = HostBeacons(link)
    assert beacons.due(0.0) == b""
    link.feed(motion(6, 1) + motion(2, 1), 0.5)
    (request,) = xbee.Parser().feed(beacons.due(3.25))
    assert request.destination == xbee.BROADCAST_16
    frame = framing.decode(request.data)
    assert (frame.message, frame.node) == (wire.BEACON, wire.BROADCAST)
    assert ids(frame.values) == [2, 6]
    assert frame.values["phase_s"] == pytest.approx(1.25)
    assert beacons.due(3.3) == b""
    (later,) = xbee.Parser().feed(beacons.due(4.25))
    assert framing.decode(later.data).counter > frame.counter


def test_a_host_sends_none_to_an_emulated_team_that_marks_its_own_time():
    link = Link()
    beacons = HostBeacons(link)
    link.feed(xbee.virtual_time(10**6), 0.0)
    link.feed(motion(6, 1), 0.5)
    assert beacons.due(1.0) == b""


def test_a_forged_frame_adds_no_node_to_the_team():
    link = Link(key=bytes(range(16)))
    beacons = HostBeacons(link)
    link.feed(motion(6, 1), 0.5)
    assert beacons.due(1.0) == b""


def test_a_node_that_takes_no_beacon_is_asked_once_in_ten_seconds():
    link = Link(clock=lambda: 2e9)
    beacons, asked_s = HostBeacons(link), []
    for k in range(1, 31):
        values = dict.fromkeys(wire.STATUS.field, 0) | {"time_s": float(k)}
        values["health"] = wire.Health.BEACON if k > 26 else 0
        data = framing.encode(wire.STATUS, 6, 0, k, values)
        link.feed(xbee.encode(xbee.Receive16(6, -60, data)), float(k))
        for request in xbee.Parser().feed(beacons.due(float(k))):
            if request.destination == 6:
                assert framing.decode(request.data).values["command"] == wire.CommandCode.PING
                asked_s.append(k)
    assert asked_s == [12, 23]


def test_a_node_too_many_is_reported_once():
    link = Link()
    beacons = HostBeacons(link)
    link.feed(b"".join(motion(node, 1) for node in range(1, MAX_NODES + 2)), 0.5)
    for time_s in (1.0, 2.0, 3.0):
        assert beacons.due(time_s)
    assert len(link.decoder.remarks) == 1
    assert "node 21:" in link.decoder.remarks[0]


@pytest.mark.parametrize("command", ["fuse", "monitor"])
def test_a_command_that_listens_sends_beacons_to_the_nodes_it_receives(command, capsys):
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    path = os.ttyname(slave)
    try:
        if command == "fuse":
            live = PortInput(path, Link())
            stream = (live.read(0.05) for _ in range(20))
        else:
            stream = _watch(path, 1.0, None, False)
            next(stream)
        os.write(master, motion(3, 1))  # opening a port empties it
        for _ in stream:
            pass
        request, *_ = xbee.Parser().feed(os.read(master, 4096))
    finally:
        os.close(master)
        os.close(slave)
    assert ids(framing.decode(request.data).values) == [3]
    if command == "monitor":
        assert "no team key" in capsys.readouterr().err


def test_beacons_of_a_host_ten_years_ahead_lock_no_later_host_out():
    """Emulated nodes; their status tells whether they take the beacons."""
    with EmulatedTeam(TeamConfig("straight", 2, 120.0, 3, key=bytes(range(16)))) as team:
        for ahead_s, least in ((315e6, 20.0), (0.0, 45.0)):
            link = Link(key=team.key, clock=lambda ahead_s=ahead_s: 1.8e9 + ahead_s)
            beacons, begun_s, health = HostBeacons(link), team.time_us * 1e-6, {}
            while team.time_us < (begun_s + least) * 1e6:
                for time_us, data in team.run(team.time_us + 20_000):
                    for o in link.feed(data, time_us * 1e-6):
                        if isinstance(o, Status) and o.name == "health":
                            health[o.node] = int(o.value) & wire.Health.BEACON
                team.send(beacons.due(team.time_us * 1e-6))
            assert list(health.values()) == [wire.Health.BEACON] * 2
        told = [line for line in link.decoder.remarks if "days ahead" in line]
        assert told == [], "no command was refused: nothing is wrong with this host's clock"
