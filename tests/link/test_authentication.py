"""Key files, counters, and what a frame that is old, foreign or forged may do on the host."""

import stat

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpos.errors import DataError
from relpos.link import port as serial_port
from relpos.link import xbee
from relpos.link.authentication import (
    WINDOW,
    CounterWindow,
    HostCounter,
    SeenCounters,
    Verdict,
    read_key,
    write_new_key,
)
from relpos.link.decoder import REPLAYS_BEFORE_REMARK, Decoder
from relpos.measurements import Motion, Range
from relpos.protocol import messages as wire

KEY = bytes(range(16))
ZERO = dict.fromkeys(wire.MOTION.field, 0)


def motion(counter, time_s, node=1, boot=0, key=wire.DEFAULT_KEY):
    return wire.encode(wire.MOTION, node, boot, counter, ZERO | {"time_s": time_s}, key)


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
    assert HostCounter(lambda: 2_240_000_000.0).next() < 1 << 32  # the year 2040


@given(st.lists(st.integers(0, 400), max_size=300))
@settings(max_examples=200, deadline=None)
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
    assert REPLAYS_BEFORE_REMARK < 200


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
    assert ["node 1: old frames" in line for line in second.decoder.remarks] == [True]
    second.decoder.feed(motion(10, 11.0), 2.0)
    assert second.decoder.nodes[1].counts["lost"] == 0


def test_frames_without_the_key_are_refused_and_not_remembered():
    decoder = Decoder((KEY,))
    for n in range(20):
        assert decoder.feed(motion(n, 1.0 + n), 1.0) == []
    assert decoder.nodes == {}
    assert decoder.counts == {"FrameTagError": 20}
    assert [line for line in decoder.remarks if "--key-file" in line] == decoder.remarks
    assert len(decoder.remarks) == 1
    assert decoder.feed(motion(0, 1.0, key=KEY), 1.0) != [] or decoder.nodes[1].heard


def test_a_forged_restart_does_not_end_the_real_one():
    decoder = Decoder((KEY,))
    decoder.feed(motion(5, 1.0, boot=1, key=KEY), 1.0)
    decoder.feed(motion(4_000_000_000, 1.0, boot=2), 2.0)
    assert [type(o) for o in decoder.feed(motion(6, 2.0, boot=1, key=KEY), 3.0)] == [Motion]
    assert decoder.nodes[1].boot == 1


def test_a_new_key_travels_hidden_and_comes_out_whole():
    link = serial_port.Link(key=KEY, counter=HostCounter(lambda: 1.8e9))
    new = bytes(range(100, 116))
    token, data = link.new_key(3, new)
    (request,) = xbee.Parser().feed(data)
    assert new not in request.data
    frame = wire.decode(request.data, KEY)
    assert (frame.message, frame.node, frame.values["token"]) == (wire.NEW_KEY, 3, token)
    masked = b"".join(frame.values[f"masked_{k}"].to_bytes(4, "little") for k in range(4))
    mask = wire.key_mask(KEY, frame.counter)
    assert bytes(a ^ b for a, b in zip(masked, mask, strict=True)) == new
    # Meanwhile the node may answer under either key.
    link.accept_keys(new, KEY)
    assert link.decoder.feed(motion(0, 1.0, key=KEY), 1.0) is not None
    link.decoder.feed(motion(1, 2.0, key=new), 2.0)
    assert link.decoder.nodes[1].counts["received"] == 2


def test_ranges_come_without_both_ends_offsets():
    decoder = Decoder()
    status = dict.fromkeys(wire.STATUS.field, 0)
    for node, offset_m in ((1, 0.2), (2, -0.05)):
        values = status | {"time_s": 1.0, "range_offset_m": offset_m}
        decoder.feed(wire.encode(wire.STATUS, node, 0, 0, values), 1.0)

    def ranges(counter, range_m, peer=2):
        entry = {"peer": peer, "range_m": range_m, "rss_dbm": -80, "age_s": 0.0, "quality": 0}
        values = {"time_s": 2.0, "ranges": [entry]}
        frame = wire.encode(wire.RANGES, 1, 0, counter, values)
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
    seen.path.write_text("{")
    with pytest.raises(DataError, match=r"team\.key\.seen"):
        SeenCounters(seen.path).load()
