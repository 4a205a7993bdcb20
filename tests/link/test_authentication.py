"""Key files, counters, and what a frame that is old, foreign or forged may do on the host."""

import hashlib
import hmac
import resource
import stat
from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpos.cli.node_dialogue import connect
from relpos.emulator.pty import PseudoTerminal
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.errors import DataError, DeviceError
from relpos.link import port as serial_port
from relpos.link import xbee
from relpos.link.authentication import (
    EPOCH_UNIX_S,
    MAX_JUMP,
    WINDOW,
    CounterWindow,
    HostCounter,
    SeenCounters,
    Verdict,
    clock_fault,
    read_key,
    write_new_key,
)
from relpos.link.beacon import HostBeacons
from relpos.link.decoder import REPLAYS_BEFORE_CHALLENGE, Decoder
from relpos.link.dialogue import NodeDialogue
from relpos.measurements import Motion, Range
from relpos.protocol import framing
from relpos.protocol import messages as wire

KEY = bytes(range(16))
ZERO = dict.fromkeys(wire.MOTION.field, 0)


def motion(counter, time_s, node=1, boot=0, key=wire.DEFAULT_KEY):
    values = ZERO | {"time_s": time_s}
    return framing.encode(wire.MOTION, node, boot, counter, values, framing.node_key(key, node))


def test_the_hosts_counter_is_the_time_and_never_stands_or_goes_back():
    now = [1_800_000_000.0]
    counter = HostCounter(lambda: now[0])
    first = counter.next()
    assert first == (1_800_000_000 - 1_704_067_200) * 8
    burst = [counter.next() for _ in range(100)]
    assert burst == list(range(first + 1, first + 101))
    now[0] -= 3600.0
    assert counter.next() == first + 101
    now[0] += 7200.0
    assert counter.next() == first + 8 * 3600


def test_a_refusal_of_a_frame_that_another_overtook_changes_no_counter():
    counter = HostCounter(lambda: 1.8e9)
    sent = counter.next()
    for newest in (sent, sent - 1, sent - wire.MAX_COMMAND_JUMP):
        assert counter.follow(newest) is None
    assert counter.next() == sent + 1
    further = (sent - wire.MAX_COMMAND_JUMP - 10) % (1 << 32)
    counter.follow(further)
    assert counter.next() == further + 1


def test_counters_go_on_past_2041():
    last_s = 1_704_067_200 + (1 << 32) / 8
    now = [last_s - 1.0]
    counter = HostCounter(lambda: now[0])
    assert counter.next() == (1 << 32) - 8
    now[0] = last_s + 1.0
    assert counter.next() == 8
    now[0] = last_s - 1.0
    assert counter.next() == 9
    assert counter.follow((1 << 32) - 1) is None, "overtaken on the way"
    assert counter.next() == 10


def test_a_clock_is_followed_as_far_as_a_node_follows_and_no_further():
    furthest_s = wire.MAX_COMMAND_JUMP / 8
    now = [1.8e9]
    counter = HostCounter(lambda: now[0])
    first = counter.next()
    now[0] += furthest_s
    assert counter.next() == first + wire.MAX_COMMAND_JUMP
    now[0] += furthest_s + 1 / 8
    assert counter.next() == first + wire.MAX_COMMAND_JUMP + 1


@pytest.mark.parametrize(
    ("own_s", "newest_s", "said"),
    [
        (1.8e9, 1.8e9 + 315e6, "3645.8 days ahead"),
        (1.8e9 + 315e6, 1.8e9, "3645.8 days behind"),
        (1.8e9, 1.8e9 + 3599.0, None),
        (1.8e9, 1.8e9 + 3600.0, "0.0 days ahead"),
        (0.0, 1.8e9, "clock says 1970-01-01"),
    ],
)
def test_told_the_newest_counter_a_host_goes_on_from_it_and_says_whose_clock_is_wrong(
    own_s, newest_s, said
):
    newest = int((newest_s - 1_704_067_200) * 8)
    counter = HostCounter(lambda: own_s)
    counter.next()
    fault = counter.follow(newest)
    assert fault is None if said is None else said in fault
    assert [counter.next() for _ in range(3)] == [newest + 1, newest + 2, newest + 3]


@given(st.lists(st.integers(0, 400), max_size=300))
@settings(max_examples=200)
def test_the_window_takes_each_counter_once_and_nothing_older(counters):
    """Against the plain definition: a set of all that was taken."""
    window, taken, newest = CounterWindow(), set(), -1
    for counter in counters:
        verdict = window.check(counter)
        if counter > newest:
            expected = Verdict.NEW
        elif newest - counter >= WINDOW:
            expected = Verdict.REPLAYED
        else:
            expected = Verdict.DUPLICATE if counter in taken else Verdict.LATE
        assert verdict is expected
        if verdict in (Verdict.NEW, Verdict.LATE):
            window.add(counter)
            assert window._seen < 1 << WINDOW, "it needs no more memory with time"
            taken.add(counter)
            newest = max(newest, counter)


def test_a_frame_that_is_sent_again_changes_nothing():
    decoder = Decoder()
    frames = [motion(n, 1.0 + n) for n in range(200)]
    for frame in frames:
        decoder.feed(frame, 1.0)
    before = repr(decoder.nodes[1].totals), decoder.nodes[1].motion_s
    for frame in frames:
        assert decoder.feed(frame, 500.0) == []
    assert (repr(decoder.nodes[1].totals), decoder.nodes[1].motion_s) == before
    assert decoder.nodes[1].counts["replayed"] + decoder.nodes[1].counts["duplicate"] == 200
    assert len(decoder.remarks) == 1
    assert REPLAYS_BEFORE_CHALLENGE < 200


def test_frames_that_overtake_each_other_are_all_taken():
    decoder = Decoder()
    for n in (0, 3, 1, 2, 5, 4):
        decoder.feed(motion(n, 1.0 + n), 1.0)
    counts = decoder.nodes[1].counts
    assert (counts["received"], counts["lost"], counts["reordered"]) == (6, 0, 3)


def test_a_session_knows_what_an_earlier_one_received():
    first = serial_port.Link()
    frames = [motion(n, 1.0 + n) for n in range(10)]
    for frame in frames:
        first.decoder.feed(frame, 1.0)
    second = serial_port.Link(newest_counters=first.newest_counters())
    for frame in frames:
        assert second.decoder.feed(frame, 1.0) == []
    assert second.decoder.nodes == {}
    assert second.newest_counters() == {}
    assert ["node 1: frame counters" in line for line in second.decoder.remarks] == [True]
    second.decoder.feed(motion(10, 11.0), 2.0)
    assert second.decoder.nodes[1].counts["lost"] == 0


@pytest.mark.parametrize(("stored", "refused"), [(20, range(21)), (3, [10])])
def test_a_session_told_of_an_earlier_one_while_it_hears_takes_the_higher_counter(stored, refused):
    decoder = Decoder()
    decoder.feed(motion(10, 1.0), 1.0)
    decoder.expect_after({1: stored, 2: 7})
    for n in refused:
        assert decoder.feed(motion(n, 12.0 + n), 12.0) == [], n
    assert len(decoder.feed(motion(refused[-1] + 1, 50.0), 50.0)) == 1
    assert decoder.feed(motion(7, 1.0, node=2), 50.0) == []
    assert len(decoder.feed(motion(8, 2.0, node=2), 50.0)) == 1


def test_frames_without_the_key_are_refused_and_not_remembered():
    decoder = Decoder((KEY,))
    for n in range(20):
        assert decoder.feed(motion(n, 1.0 + n), 1.0) == []
    assert decoder.nodes == {}
    assert decoder.counts == {"FrameTagError": 20}
    assert [line for line in decoder.remarks if "--key-file" in line] == decoder.remarks
    assert len(decoder.remarks) == 1
    assert decoder.feed(motion(0, 1.0, key=KEY), 1.0) != [] or 1 in decoder.nodes


def test_a_forged_restart_does_not_end_the_real_one():
    decoder = Decoder((KEY,))
    decoder.feed(motion(5, 1.0, boot=1, key=KEY), 1.0)
    decoder.feed(motion(4_000_000_000, 1.0, boot=2), 2.0)
    assert [type(o) for o in decoder.feed(motion(6, 2.0, boot=1, key=KEY), 3.0)] == [Motion]
    assert decoder.nodes[1].boot == 1


def test_new_keys_travel_hidden_and_come_out_whole():
    link = serial_port.Link(key=KEY, clock=lambda: 1.8e9)
    new = bytes(range(100, 132))
    (request,) = xbee.Parser().feed(link.new_keys(3, new, token=77))
    assert new[:16] not in request.data
    old = framing.node_key(KEY, 3)
    frame = framing.decode(request.data, old)
    assert (frame.message, frame.node, frame.values["token"]) == (wire.NEW_KEY, 3, 77)
    masked = b"".join(frame.values[f"masked_{k}"].to_bytes(4, "little") for k in range(8))
    mask = framing.masked_keys(old, 77, frame.counter, bytes(32))
    mask = b"".join(mask[f"masked_{k}"].to_bytes(4, "little") for k in range(8))
    assert bytes(a ^ b for a, b in zip(masked, mask, strict=True)) == new
    # Meanwhile a node may answer under either key.
    link.accept_keys(new[:16], KEY)
    link.decoder.feed(motion(0, 1.0, key=KEY), 1.0)
    link.decoder.feed(motion(1, 2.0, key=new[:16]), 2.0)
    assert link.decoder.nodes[1].counts["received"] == 2


def test_a_nodes_key_says_nothing_of_the_teams_or_anothers():
    """The published construction, from the standard's own module, and no key twice."""
    said = hmac.new(KEY, b"relpos node key\x03", hashlib.sha256).digest()
    assert framing.node_key(KEY, 3) == said[:16]
    keys = {framing.node_key(KEY, node) for node in range(256)} | {KEY, wire.DEFAULT_KEY}
    assert len(keys) == 258
    assert {framing.node_key(wire.DEFAULT_KEY, node) for node in range(256)} == {wire.DEFAULT_KEY}


def test_a_stolen_node_speaks_and_commands_for_nobody_else():
    """An attacker has all that node 3 holds: its own key and the beacon's."""
    held = framing.node_key(KEY, 3), framing.node_key(KEY, wire.BROADCAST)
    decoder = Decoder((KEY,))
    for n in range(10):
        for node in (1, 2, 3):
            decoder.feed(motion(n, 1.0 + n, node, key=KEY), 1.0 + n)
    before = repr({n: decoder.nodes[n] for n in (1, 2)})
    for n in range(10, 40):
        for node in (1, 2, 4):
            for key in held:
                frame = framing.encode(wire.MOTION, node, 0, n, ZERO | {"time_s": 1.0 + n}, key)
                assert decoder.feed(frame, 1.0 + n) == []
    assert repr({n: decoder.nodes[n] for n in (1, 2)}) == before
    assert set(decoder.nodes) == {1, 2, 3}
    told = [line for line in decoder.remarks if "somebody else" in line]
    assert [line.split(":")[0] for line in told] == ["node 1", "node 2"]


def test_ranges_come_without_both_ends_offsets():
    decoder = Decoder()
    status = dict.fromkeys(wire.STATUS.field, 0)
    for node, offset_m in ((1, 0.2), (2, -0.05)):
        values = status | {"time_s": 1.0, "range_offset_m": offset_m}
        decoder.feed(framing.encode(wire.STATUS, node, 0, 0, values), 1.0)

    def ranges(counter, range_m, peer=2):
        entry = {"peer": peer, "range_m": range_m, "rss_dbm": -80, "age_s": 0.0, "quality": 0}
        values = {"time_s": 2.0, "ranges": [entry]}
        frame = framing.encode(wire.RANGES, 1, 0, counter, values)
        return [o.range_m for o in decoder.feed(frame, 2.0) if isinstance(o, Range)]

    assert ranges(1, 5.0) == [pytest.approx(4.85)]
    assert ranges(2, 5.0, peer=9) == [pytest.approx(4.8)]  # which has reported nothing yet
    assert ranges(3, 0.1) == []
    assert decoder.nodes[1].counts["range_below_its_offset"] == 1


def test_a_key_file_is_secret_random_and_never_overwritten(tmp_path):
    path = tmp_path / "team.key"
    key = write_new_key(path)
    assert read_key(path) == key
    assert len(key) == 16
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert write_new_key(tmp_path / "other.key") != key
    with pytest.raises(DataError, match=r"team\.key exists already"):
        write_new_key(path)


@pytest.mark.parametrize("text", ["", "00" * 15, "00" * 17, "zz" * 16, "geheim\n", "\xe9" * 16])
def test_an_invalid_key_is_refused_in_one_line_that_does_not_quote_it(tmp_path, text):
    path = tmp_path / "team.key"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(DataError, match=r"team\.key") as caught:
        read_key(path)
    assert "\n" not in str(caught.value)
    assert not text or text.strip() not in str(caught.value)


def test_counters_are_kept_beside_the_key_and_never_go_back(tmp_path):
    seen = SeenCounters.beside(tmp_path / "team.key")
    assert seen.load() == {}
    seen.save({1: 10, 2: 20}, 0.0)
    seen.save({1: 11, 2: 20}, 1.0)  # too soon
    assert SeenCounters(seen.path).load() == {1: 10, 2: 20}
    seen.save({1: 12}, 1.0, at_once=True)
    assert SeenCounters(seen.path).load() == {1: 12, 2: 20}
    seen.save({1: 3, 2: 4}, 2.0, at_once=True, lowered={2})
    assert SeenCounters(seen.path).load() == {1: 12, 2: 4}
    seen.path.write_text("{")
    with pytest.raises(DataError, match=r"team\.key\.seen"):
        SeenCounters(seen.path).load()


def answer(counter, challenge, command=wire.CommandCode.PING, boot=0, **other):
    values = {"token": challenge.token, "command": command, "value": challenge.value} | other
    values["result"] = wire.CommandResult.DONE
    key = framing.node_key(KEY, challenge.node)
    return framing.encode(wire.ACKNOWLEDGEMENT, challenge.node, boot, counter, values, key)


def test_one_frame_of_the_last_counter_silences_no_node():
    decoder = Decoder((KEY,))
    for n in range(10):
        decoder.feed(motion(n, 1.0 + n, key=KEY), 1.0 + n)
    assert decoder.feed(motion((1 << 32) - 1, 500.0, key=KEY), 11.0) == []
    assert decoder.nodes[1].counts["jumped"] == 1
    assert len(decoder.feed(motion(10, 11.0, key=KEY), 11.0)) == 1
    assert decoder.nodes[1].window.newest == 10


@pytest.mark.parametrize(("counter", "asked"), [(500, 0), (100, 1), ((1 << 32) - 1, 1)])
def test_a_node_is_asked_for_counters_that_do_not_fit_and_not_for_an_echo(counter, asked):
    decoder = Decoder((KEY,))
    decoder.feed(motion(500, 1.0, key=KEY), 1.0)
    for _ in range(20):
        decoder.feed(motion(counter, 1.0, key=KEY), 1.5)
    assert len(decoder.challenges) == len(decoder.remarks) == asked


def test_a_node_may_have_sent_for_a_month_while_no_host_listened():
    decoder = Decoder((KEY,), {1: 1000})
    assert decoder.feed(motion(1000 + MAX_JUMP, 1.0, key=KEY), 1.0)
    decoder = Decoder((KEY,), {1: 1000})
    assert not decoder.feed(motion(1001 + MAX_JUMP, 1.0, key=KEY), 1.0)


@pytest.mark.parametrize("before", [(1 << 32) - 1, 5000])
def test_a_node_that_lost_its_counter_comes_back_by_an_answer_and_nothing_else(before):
    decoder = Decoder((KEY,), {1: before})
    for n in range(REPLAYS_BEFORE_CHALLENGE - 1):
        decoder.feed(motion(n, 1.0, key=KEY), 1.0)
    assert not decoder.challenges
    decoder = Decoder((KEY,), {1: before})
    for n in range(40):
        assert decoder.feed(motion(n, 1.0 + 0.2 * n, key=KEY), 1.0 + 0.2 * n) == []
    asked = list(decoder.challenges)
    assert len(asked) == 2, "one in five seconds"
    assert len(decoder.remarks) == 1
    last = asked[-1]
    for wrong in (
        answer(40, asked[0]),
        answer(40, last, wire.CommandCode.REBOOT),
        answer(40, last, token=last.token ^ 1),
        answer(40, last, value=last.value ^ 1),
    ):
        decoder.feed(wrong, 9.0)
    assert decoder.nodes == {}
    decoder.feed(answer(41, last), 9.0)
    assert [line for line in decoder.remarks if "heard again" in line] == [decoder.remarks[1]]
    assert len(decoder.feed(motion(42, 10.0, key=KEY), 10.0)) == 1
    # What it said before is old now, and so is its answer.
    decoder.feed(answer(41, last), 11.0)
    decoder.feed(motion(30, 7.0, key=KEY), 11.0)
    counts = decoder.nodes[1].counts
    assert (counts["received"], counts["duplicate"], counts["lost"]) == (2, 2, 0)


def test_a_recorded_answer_brings_no_recorded_session_back():
    first, heard = Decoder((KEY,), {1: 5000}), []
    for n in range(20):
        heard.append((motion(n, 1.0 + n, key=KEY), 1.0 + n))
        first.feed(*heard[-1])
    heard.append((answer(20, first.challenges[-1]), 21.0))
    heard += [(motion(n, 1.0 + n, key=KEY), 1.0 + n) for n in range(21, 30)]
    taken = [o for frame, at_s in heard[20:] for o in first.feed(frame, at_s)]
    assert len(taken) == 9
    # The session's recording, with the same times of arrival, gives the same.
    again = Decoder((KEY,), {1: 5000})
    assert [o for frame, at_s in heard for o in again.feed(frame, at_s)] == taken
    # Somebody who sends it again, to a host that knows what this one knew, cannot have its times.
    another = Decoder((KEY,), {1: 5000})
    assert [o for frame, at_s in heard for o in another.feed(frame, at_s + 1e-6)] == []
    assert another.nodes == {}


def test_a_dialogue_finds_a_node_that_lost_its_counter_and_the_next_one_at_once(tmp_path):
    key_file = tmp_path / "team.key"
    write_new_key(key_file)
    key = read_key(key_file)
    SeenCounters.beside(key_file).save({1: 50_000}, 0.0, at_once=True)
    config = TeamConfig("straight", 1, 600.0, 3, key=key)
    with (
        EmulatedTeam(config) as team,
        PseudoTerminal(team, speed=5.0, mark_time=True) as terminal,
    ):
        terminal.start()
        for known in (50_000, None):
            assert known in (None, SeenCounters.beside(key_file).load()[1])
            with connect(terminal.path, 1, key_file) as dialogue:
                dialogue.demand(wire.CommandCode.PING, 0)
            remarks = "".join(dialogue.link.decoder.remarks)
            assert ("heard again" in remarks) == (known is not None)
    assert SeenCounters.beside(key_file).load()[1] < 50_000


def test_a_node_answers_the_challenge_of_a_host_that_remembers_a_higher_counter():
    with EmulatedTeam(TeamConfig("straight", 2, 30.0, 3)) as team:
        link = serial_port.Link(newest_counters={1: (1 << 32) - 1})
        beacons, heard_s = HostBeacons(link), []
        while team.time_us < 20e6 and not heard_s:
            for time_us, data in team.run(team.time_us + 20_000):
                for o in link.feed(data, time_us * 1e-6):
                    heard_s += [o.time_s] * (o.node == 1)
            due = beacons.due(team.time_us * 1e-6)
            if due:
                team.send(due)
    assert heard_s
    assert any("node 1: its frame counter had changed" in line for line in link.decoder.remarks)


@pytest.mark.parametrize(("clock_s", "day"), [(0.0, "1970-01-01"), (1.6e9, "2020-09-13")])
def test_a_clock_that_cannot_be_right_is_told_as_that(clock_s, day):
    link = serial_port.Link(clock=lambda: clock_s)
    for _ in range(3):
        link.command(1, wire.CommandCode.PING, 0)
    (remark,) = link.decoder.remarks
    assert f"clock says {day}" in remark
    assert "set the clock" in remark
    assert HostCounter(lambda: clock_s).next() == 1
    assert serial_port.Link(clock=lambda: 1.8e9).clock_fault() is None
    assert clock_fault(EPOCH_UNIX_S) is None


def obey(team, link, size):
    """Send a command as a dialogue does; return how often, until the node has done it."""
    token = link.next_token()
    for attempt in range(1, 6):
        team.send(link.command(1, wire.CommandCode.SET_TEAM_SIZE, size, token=token)[1])
        for time_us, data in team.run(team.time_us + 700_000):
            link.feed(data, time_us * 1e-6)
        answers, link.decoder.acknowledged = list(link.decoder.acknowledged), deque()
        if any((a.token, a.result) == (token, wire.CommandResult.DONE) for a in answers):
            return attempt
    return None


def test_no_wrong_clock_locks_a_node_out_and_the_reason_is_told():
    """1970, ten years ahead, steps of a day, and 2050, each followed by a host that is right."""
    now = [1.8e9]
    with EmulatedTeam(TeamConfig("straight", 1, 60.0, 3, key=KEY)) as team:
        team.run(5_000_000)

        def command(*clocks_s):
            link = serial_port.Link(key=KEY, clock=lambda: now[0])
            attempts = []
            for clock_s in clocks_s:
                now[0] = clock_s
                attempts.append(obey(team, link, 2 + len(attempts)))
            return attempts, "".join(link.decoder.remarks)

        assert command(1.8e9) == ([1], "")
        attempts, said = command(1.8e9 + 315e6)
        assert attempts == [2]
        assert "3645.8 days behind" in said
        assert command(1.8e9) == ([2], ""), "once more, as counters went on by themselves"
        attempts, said = command(0.0)
        assert attempts == [2]
        assert "clock says 1970-01-01" in said
        attempts, said = command(1.8e9 + 60.0, 1.8e9 + 86_460.0, 1.8e9 + 61.0, 1.8e9 + 62.0)
        assert (attempts, said) == ([1, 1, 1, 1], "")
        attempts, said = command(1.8e9 + 63.0)
        assert attempts == [2]
        assert "1.0 days ahead" in said
        for year_2050_s in (2.53e9, 2.53e9 + 60.0):
            assert command(year_2050_s)[0] == [2]
        assert command(1.8e9 + 64.0)[0] == [2], "a day behind, as before"


def test_a_node_that_does_not_answer_a_host_of_1970_is_no_wrong_key(monkeypatch):
    monkeypatch.setattr("relpos.link.dialogue.ANSWER_S", 0.01)

    class Silent:
        port, in_waiting = "test", 0

        def read(self, size=1):
            return b""

        def write(self, data):
            return len(data)

    link = serial_port.Link(clock=lambda: 86_400.0)
    with pytest.raises(DeviceError, match="clock says 1970-01-02"):
        NodeDialogue(Silent(), 1, link).command(wire.CommandCode.PING, 0)


def test_a_node_under_another_key_is_told_though_others_are_heard():
    decoder = Decoder((KEY,))
    for n in range(20):
        decoder.feed(motion(n, 1.0 + n, key=KEY), 1.0 + n)
        decoder.feed(motion(n, 1.0 + n, node=2), 1.0 + n)
    (remark,) = decoder.remarks
    assert "another key" in remark


def test_a_key_for_which_the_disk_has_no_room_leaves_no_file(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(DataError, match=r"team\.key: cannot be written: "):
            write_new_key(tmp_path / "team.key")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())
