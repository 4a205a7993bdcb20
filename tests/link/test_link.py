"""The link: XBee bytes against an independent codec, resynchronisation, totals, clocks, ports."""

import math
import os
import pty
import random
import threading

import pytest
from digi.xbee.models.address import XBee16BitAddress, XBee64BitAddress
from digi.xbee.models.mode import OperatingMode
from digi.xbee.packets import common, factory, raw

from relpos.errors import DeviceError
from relpos.link import port as serial_port
from relpos.link import xbee
from relpos.link.clock import NodeClock
from relpos.link.decoder import Decoder
from relpos.measurements import Heading, Height, Motion, Range, Status, Step, out_of_bounds
from relpos.protocol import framing
from relpos.protocol import messages as wire

MOTION_ZERO = dict.fromkeys(wire.MOTION.field, 0)


def motion_frame(counter, node=1, boot=0, **values):
    return framing.encode(wire.MOTION, node, boot, counter, MOTION_ZERO | values)


def ranges_frame(counter, time_s, peer, range_m, age_s, node=1, boot=0):
    entry = {"peer": peer, "range_m": range_m, "rss_dbm": -80, "age_s": age_s, "quality": 0}
    return framing.encode(wire.RANGES, node, boot, counter, {"time_s": time_s, "ranges": [entry]})


# --- XBee frames against digi-xbee ------------------------------------------------------------

PAYLOADS = [b"Hi", b"\x7e\x11Hi", bytes(range(256))[:66], b"\x7d\x13" * 30]


@pytest.mark.parametrize("data", PAYLOADS, ids=len)
def test_our_transmit_requests_are_digis(data):
    theirs = raw.TX16Packet(1, XBee16BitAddress.from_hex_string("0113"), 0, data)
    ours = xbee.Transmit16(1, 0x0113, data)
    assert xbee.encode(ours, escaped=False) == bytes(theirs.output(escaped=False))
    assert xbee.encode(ours, escaped=True) == bytes(theirs.output(escaped=True))


@pytest.mark.parametrize("data", PAYLOADS, ids=len)
@pytest.mark.parametrize("escaped", [False, True])
def test_frames_of_digis_module_are_read_as_digi_meant_them(data, escaped):
    address = XBee64BitAddress.from_hex_string("0013A20040522BAA")
    packets = [
        (
            raw.RX16Packet(XBee16BitAddress.from_hex_string("0013"), 40, 0, data),
            xbee.Receive16(0x13, -40, data),
        ),
        (raw.RX64Packet(address, 40, 0, data), xbee.Receive64(0x0013A20040522BAA, -40, data)),
        (
            common.ReceivePacket(address, XBee16BitAddress.from_hex_string("7D84"), 1, data),
            xbee.ReceivePacket(0x0013A20040522BAA, 0x7D84, data, 1),
        ),
    ]
    parser = xbee.Parser(escaped=escaped)
    stream = b"".join(bytes(theirs.output(escaped=escaped)) for theirs, _ in packets)
    assert parser.feed(stream) == [ours for _, ours in packets]


def test_digi_reads_our_frames_as_we_meant_them():
    ours = xbee.Receive16(0x0013, -40, b"Hi")
    theirs = factory.build_frame(
        bytearray(xbee.encode(ours, escaped=False)), OperatingMode.API_MODE
    )
    assert (theirs.rf_data, theirs.rssi, int(theirs.x16bit_source_addr.address.hex(), 16)) == (
        b"Hi",
        40,
        0x13,
    )


@pytest.mark.parametrize(
    ("frame", "plain", "escaped"),
    [
        (
            xbee.Transmit16(1, 1, b"\x7e\x11Hi"),
            "7e000901010001007e114869bc",
            "7e000901010001007d5e7d314869bc",
        ),
        (xbee.TransmitStatus(1, 0), "7e000389010075", "7e000389010075"),
        (xbee.Receive16(0x13, -40, b"Hi"), "7e00078100132800486992", "7e000781007d332800486992"),
        (xbee.AtCommand(0x52, b"MY"), "7e000408524d59ff", "7e000408524d59ff"),
        (
            xbee.AtResponse(0x52, b"MY", 0, b"\x00\x01"),
            "7e000788524d590000017e",
            "7e000788524d590000017d5e",
        ),
    ],
)
def test_the_reference_vectors_are_met_both_ways(frame, plain, escaped):
    assert xbee.encode(frame, escaped=False).hex() == plain
    assert xbee.encode(frame, escaped=True).hex() == escaped
    assert xbee.Parser(escaped=False).feed(bytes.fromhex(plain)) == [frame]
    assert xbee.Parser(escaped=True).feed(bytes.fromhex(escaped)) == [frame]


@pytest.mark.parametrize("escaped", [False, True])
def test_frames_are_found_again_after_garbage_and_in_any_pieces(escaped):
    rng = random.Random(1)
    frames = [xbee.Receive16(n, -n, rng.randbytes(rng.randrange(1, 66))) for n in range(1, 60)]
    # Garbage without the delimiter: in AP=1 a stray delimiter may swallow what follows until
    # its length is used up, which is the mode's own weakness, tested below.
    stream = b"".join(
        xbee.encode(f, escaped=escaped)
        + bytes(b for b in rng.randbytes(rng.randrange(20)) if b != xbee.DELIMITER)
        for f in frames
    )
    parser = xbee.Parser(escaped=escaped)
    found = []
    while stream:
        cut = rng.randrange(1, 9)
        found += parser.feed(stream[:cut])
        stream = stream[cut:]
    assert found == frames
    counts = parser.counts
    assert (counts.bad_checksums, counts.bad_lengths, counts.broken_off) == (0, 0, 0)
    assert counts.frames == len(frames)
    assert counts.skipped_bytes > 300


def test_a_stray_delimiter_costs_only_itself():
    good = xbee.Receive16(3, -50, b"all is well")
    for escaped in (False, True):
        stream = b"\x7e\x00\x05\x81" + xbee.encode(good, escaped=escaped) * 2 + bytes(200)
        assert xbee.Parser(escaped=escaped).feed(stream) == [good, good]


def test_a_broken_frame_costs_only_itself_when_escaped():
    good = xbee.encode(xbee.Receive16(3, -50, b"\x7e\x7d\x11\x13 hello"))
    expected = xbee.Parser().feed(good)
    for cut in range(1, len(good)):
        parser = xbee.Parser()
        assert parser.feed(good[:cut] + good) == expected
        assert parser.counts.broken_off == 1
    for index in range(1, len(good)):
        damaged = bytearray(good)
        damaged[index] ^= 0x04
        assert xbee.Parser().feed(bytes(damaged) + good * 2)[-1:] == expected


@pytest.mark.parametrize(("length", "bad"), [(0, 1), (1, 0), (128, 0), (129, 1), (256 + 5, 1)])
def test_a_length_that_no_frame_has_is_told_by_both_its_bytes(length, bad):
    parser = xbee.Parser(escaped=False)
    assert parser.feed(b"\x7e" + length.to_bytes(2, "big")) == []
    assert parser.counts.bad_lengths == bad


# --- totals to motion --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("over_north_rad", "from_east_rad"),
    [(0.0, math.pi / 2), (-math.pi / 2, 0.0), (math.pi / 2, math.pi), (math.pi, -math.pi / 2)],
)
def test_a_heading_over_magnetic_north_is_converted_to_the_worlds_x_axis(
    over_north_rad, from_east_rad
):
    decoder = Decoder()
    decoder.feed(motion_frame(0, time_s=1), 1.0)
    fields = {
        "time_s": 2,
        "magnetic_heading_rad": round(over_north_rad, 4),
        "quality": wire.Quality.MAGNETOMETER_VALID,
    }
    (heading,) = (o for o in decoder.feed(motion_frame(1, **fields), 2.0) if isinstance(o, Heading))
    assert math.remainder(heading.heading_rad - from_east_rad, math.tau) == pytest.approx(
        0.0, abs=1e-3
    )


def walk(count):
    """Totals of a walk on a circle, one a second."""
    return [
        {
            "time_s": float(n),
            "x_m": round(10 * math.sin(n / 10), 3),
            "y_m": round(10 - 10 * math.cos(n / 10), 3),
            "heading_rad": round(n / 10, 4),
            "state": 2,
            "quality": 0,
        }
        for n in range(1, count)
    ]


def compose(motions):
    x = y = heading = 0.0
    for m in motions:
        x += math.cos(heading) * m.dx_m - math.sin(heading) * m.dy_m
        y += math.sin(heading) * m.dx_m + math.cos(heading) * m.dy_m
        heading += m.dtheta_rad
    return x, y, heading


def motions(observations):
    return [o for o in observations if isinstance(o, Motion)]


@pytest.mark.parametrize("loss", [0.0, 0.5, 0.9])
def test_a_lost_frame_loses_no_motion(loss):
    rng = random.Random(2)
    totals = walk(300)
    decoder = Decoder()
    received = []
    for n, values in enumerate(totals):
        if n == len(totals) - 1 or rng.random() >= loss:
            received += decoder.feed(motion_frame(n, **values), values["time_s"] + 0.01)
    x, y, heading = compose(motions(received))
    assert (x, y, heading) == pytest.approx(
        (totals[-1]["x_m"], totals[-1]["y_m"], totals[-1]["heading_rad"]), abs=1e-9
    )


def test_motion_is_seen_from_the_previous_pose():
    decoder = Decoder()
    quarter = round(math.pi / 2, 4)
    decoder.feed(motion_frame(0, time_s=1, heading_rad=quarter), 1.0)
    (motion,) = motions(
        decoder.feed(motion_frame(1, time_s=2, y_m=1.5, heading_rad=quarter + 0.1), 2.0)
    )
    assert motion.dx_m == pytest.approx(1.5, abs=1e-3)
    assert motion.dy_m == pytest.approx(0.0, abs=1e-3)
    assert motion.dtheta_rad == pytest.approx(0.1)


def test_totals_differ_rightly_over_their_wrap():
    decoder = Decoder()
    top = 2147483.647
    decoder.feed(motion_frame(65535, time_s=4294967.0, x_m=top, heading_rad=-214748.3648), 5.0)
    (motion,) = motions(
        decoder.feed(
            motion_frame(65536, time_s=0.704, x_m=-2147483.148, heading_rad=214748.3647), 6.0
        )
    )
    # Seen from the heading before the wrap; the distance does not depend on it.
    assert math.hypot(motion.dx_m, motion.dy_m) == pytest.approx(0.501, abs=1e-6)
    assert motion.dtheta_rad == pytest.approx(-0.0001, abs=1e-6)
    assert decoder.nodes[1].counts["lost"] == 0


def test_late_and_doubled_frames_move_no_node():
    decoder = Decoder()
    frames = [motion_frame(n, time_s=n + 1, x_m=n + 1) for n in range(4)]
    decoder.feed(frames[0], 1.0)
    assert motions(decoder.feed(frames[2], 3.0))[0].dx_m == pytest.approx(2)
    assert decoder.feed(frames[2], 3.1) == []
    assert motions(decoder.feed(frames[1], 3.2)) == []
    assert motions(decoder.feed(frames[3], 4.0))[0].dx_m == pytest.approx(1)
    counts = decoder.nodes[1].counts
    assert (counts["duplicate"], counts["late_motion"], counts["lost"]) == (1, 1, 0)


def test_a_motion_has_the_steps_since_the_one_before_also_of_a_lost_one():
    decoder = Decoder()
    decoder.feed(motion_frame(7, boot=4, time_s=100, steps=65_530), 100.0)
    (motion,) = motions(decoder.feed(motion_frame(9, boot=4, time_s=102, steps=2), 102.0))
    assert motion.steps == 8


def test_a_restart_begins_new_totals_and_widens_the_next_motion():
    decoder = Decoder()
    decoder.feed(motion_frame(7, boot=4, time_s=100, x_m=50.0), 100.0)
    (motion,) = motions(decoder.feed(motion_frame(1024, boot=5, time_s=1, x_m=0.5), 104.0))
    assert motion.dx_m == pytest.approx(0.5)
    assert motion.sigma_x_m > 4.0
    assert decoder.nodes[1].counts["restarts"] == 1


def test_a_restart_widens_the_next_motion_by_what_a_person_can_do_meanwhile_and_no_other():
    decoder = Decoder()
    (first,) = motions(decoder.feed(motion_frame(7, boot=4, time_s=100), 100.0))
    sigmas = first.sigma_x_m, first.sigma_y_m, first.sigma_theta_rad, first.sigma_x_alone_m
    assert sigmas == (0.0, 0.0, 0.0, 0.0), "nothing was unseen before"
    (widened,) = motions(decoder.feed(motion_frame(1024, boot=5, time_s=1), 104.0))
    assert widened.sigma_x_m == pytest.approx(1.5 * 4.0)
    assert widened.sigma_y_m == pytest.approx(1.5 * 4.0)
    assert widened.sigma_x_alone_m == pytest.approx(1.5 * 4.0)
    assert widened.sigma_theta_rad == pytest.approx(0.5 * math.sqrt(4.0))
    (after,) = motions(decoder.feed(motion_frame(1025, boot=5, time_s=2), 105.0))
    assert after.sigma_y_m == 0.0


def test_a_restart_after_days_widens_within_the_bounds_of_a_motion():
    decoder = Decoder()
    decoder.feed(motion_frame(7, boot=4, time_s=100), 100.0)
    (motion,) = motions(decoder.feed(motion_frame(1024, boot=5, time_s=1), 500_000.0))
    assert out_of_bounds(motion) is None
    assert motion.sigma_x_m == pytest.approx(900.0)


def test_what_no_file_can_hold_is_no_observation_and_is_counted():
    decoder = Decoder()
    decoder.feed(motion_frame(1, time_s=1.0), 1.0)
    leap = motion_frame(2, time_s=2.0, x_m=2000.0, quality=wire.Quality.HEIGHT_VALID)
    assert decoder.feed(leap, 2.0) == [Height(2.0, 1, 0.0)]
    assert decoder.feed(ranges_frame(3, 2.5, peer=1, range_m=3.0, age_s=0.0), 2.5) == []
    (motion,) = decoder.feed(motion_frame(4, time_s=3.0, x_m=2001.0), 3.0)
    assert motion.dx_m == pytest.approx(1.0)
    counts = decoder.nodes[1].counts
    assert (counts["beyond_bounds"], counts["ranges_to_itself"]) == (1, 1)


def test_alarms_have_motions_to_go_by_also_after_a_week():
    decoder = Decoder()
    assert motions(decoder.feed(motion_frame(1, time_s=1.0), 8 * 86_400.0))


def test_a_restart_before_the_first_motion_widens_nothing():
    decoder = Decoder()
    status = dict.fromkeys(wire.STATUS.field, 0) | {"time_s": 1.0}
    decoder.feed(framing.encode(wire.STATUS, 1, 4, 7, status), 1.0)
    (motion,) = motions(decoder.feed(motion_frame(1024, boot=5, time_s=1), 9.0))
    assert (motion.sigma_x_m, motion.sigma_y_m, motion.sigma_theta_rad) == (0.0, 0.0, 0.0)


def test_variances_across_and_of_the_heading_add_up_as_they_are_reported():
    decoder = Decoder()
    before = {"variance_across_m2": 0.25, "variance_heading_rad2": 0.02}
    decoder.feed(motion_frame(0, time_s=1, **before), 1.0)
    after = {"variance_across_m2": 0.34, "variance_heading_rad2": 0.06}
    (motion,) = motions(decoder.feed(motion_frame(1, time_s=2, **after), 2.0))
    assert motion.sigma_y_m == pytest.approx(0.3, abs=1e-3)
    assert motion.sigma_theta_rad == pytest.approx(0.2, abs=1e-3)


def test_a_silent_inertial_sensor_tells_no_motion_and_then_all_of_it_at_once():
    silent = {"state": wire.MotionState.STARTING, "quality": wire.Quality.IMU_GAP}
    moving = {"state": wire.MotionState.MOVING, "quality": 0}
    decoder, got = Decoder(), []
    frames = [
        {"time_s": 1.0, "x_m": 1.0, **moving},
        {"time_s": 2.0, "x_m": 1.0, **silent},
        {"time_s": 3.0, "x_m": 1.0, **silent | {"quality": 0x10 | wire.Quality.HEIGHT_VALID}},
        {"time_s": 4.0, "x_m": 1.5, "variance_along_m2": 9.0, **moving},
    ]
    for counter, values in enumerate(frames):
        got.append(decoder.feed(motion_frame(counter, **values), values["time_s"]))
    assert [len(motions(each)) for each in got] == [1, 0, 0, 1]
    assert [type(one) for one in got[2]] == [Height]
    (last,) = motions(got[3])
    assert (last.dx_m, last.sigma_x_m) == pytest.approx((0.5, 3.0))


def test_an_error_of_scale_is_one_from_the_start_and_its_square_grows_with_it():
    decoder = Decoder()
    decoder.feed(motion_frame(0, time_s=1, scale_error_m=0.3), 1.0)
    frame = motion_frame(1, time_s=2, scale_error_m=0.5, variance_along_m2=0.09)
    (motion,) = motions(decoder.feed(frame, 2.0))
    assert motion.sigma_x_m == pytest.approx(math.sqrt(0.5**2 - 0.3**2 + 0.09), abs=1e-3)
    assert motion.sigma_x_alone_m == pytest.approx(math.hypot(0.5 - 0.3, 0.3), abs=1e-3)


def test_motions_whose_clock_estimates_cross_keep_their_order_and_are_counted():
    decoder = Decoder()
    (first,) = motions(decoder.feed(motion_frame(0, time_s=1), 1.5))
    # Half a second less delay: by this clock the first motion was half a second earlier.
    (second,) = motions(decoder.feed(motion_frame(1, time_s=1.2), 1.2))
    assert second.time_s == pytest.approx(first.time_s + 0.0005)
    assert decoder.nodes[1].counts["clock_step"] == 1
    decoder.feed(motion_frame(2, time_s=3), 3.0)
    assert decoder.nodes[1].counts["clock_step"] == 1


def test_a_restart_on_the_second_floor_leaves_the_node_there():
    decoder = Decoder()
    valid = wire.Quality.HEIGHT_VALID

    def height(counter, boot, **values):
        frame = motion_frame(counter, boot=boot, **values)
        return [o.height_m for o in decoder.feed(frame, 100.0 + counter) if isinstance(o, Height)]

    assert height(1, 4, time_s=100, height_m=6.1, quality=valid) == [6.1]
    assert height(2, 5, time_s=1) == []
    assert height(3, 5, time_s=4, height_m=-0.1, quality=valid) == pytest.approx([6.0])
    assert height(4, 6, time_s=1) == []
    assert height(5, 6, time_s=5, height_m=-3.0, quality=valid) == pytest.approx([3.0])
    assert height(6, 6, time_s=6, height_m=-6.0, quality=valid) == pytest.approx([0.0])
    assert height(7, 6, time_s=7, height_m=-4.0, quality=valid) == pytest.approx([2.0])
    for n in (8, 9):  # twice, before it knows a height
        assert height(n, n, time_s=1) == []
    assert height(10, 9, time_s=5, height_m=1.0, quality=valid) == pytest.approx([3.0])


def test_a_frame_held_up_from_before_the_restart_is_refused():
    decoder = Decoder()
    decoder.feed(motion_frame(7, boot=4, time_s=100, x_m=50.0), 100.0)
    decoder.feed(motion_frame(40, boot=5, time_s=1), 102.0)
    assert decoder.feed(motion_frame(8, boot=4, time_s=101, x_m=51.0), 102.5) == []
    assert decoder.nodes[1].boot == 5


def test_a_damaged_or_foreign_frame_changes_nothing():
    decoder = Decoder()
    decoder.feed(motion_frame(0, time_s=1), 1.0)
    before = repr(decoder.nodes)
    good = motion_frame(1, time_s=2, x_m=3)
    assert decoder.feed(good[:-1] + bytes((good[-1] ^ 1,)), 2.0) == []
    assert decoder.feed(b"\x00another system", 2.0) == []
    for foreign in ((wire.MAGIC, 1, 1, 9), (wire.MAGIC, 1, 1, 9), (wire.MAGIC, 1)):
        assert decoder.feed(bytes(foreign), 2.0) == []
    assert decoder.feed(good[:20] + bytes((good[20] ^ 1,)) + good[21:], 2.0) == []
    forged = framing.encode(wire.MOTION, 1, 0, 1, MOTION_ZERO | {"time_s": 2}, bytes(range(16)))
    assert decoder.feed(forged, 2.0) == []
    assert repr(decoder.nodes) == before
    assert decoder.foreign_versions == {9: 1}
    assert len(decoder.remarks) == 1
    assert decoder.counts == {
        "FrameTagError": 2,
        "FrameCrcError": 1,
        "NotOursError": 1,
        "ForeignVersionError": 3,
    }
    assert len(motions(decoder.feed(good, 2.0))) == 1


def test_what_only_a_host_sends_and_what_only_a_host_is_called_are_no_nodes():
    decoder = Decoder()
    command = {"token": 1, "command": 4, "value": 930}
    assert decoder.feed(framing.encode(wire.COMMAND, 1, 0, 1, command), 1.0) == []
    for node in (wire.COORDINATOR, wire.BROADCAST):
        assert decoder.feed(motion_frame(1, node=node, time_s=1), 1.0) == []
    assert decoder.counts == {"not_from_a_node": 3}
    assert decoder.nodes == {}


def test_steps_are_dated_back_by_their_ages():
    steps = [{"length_m": 0.7, "age_s": 1.5}, {"length_m": 0.8, "age_s": 0.9}]
    values = {"time_s": 10.0, "steps": steps}
    assert Decoder().feed(framing.encode(wire.STEPS, 1, 0, 0, values), 110.0) == [
        Step(pytest.approx(108.5), 1, pytest.approx(0.7)),
        Step(pytest.approx(109.1), 1, pytest.approx(0.8)),
    ]


def test_a_range_is_dated_back_by_its_age():
    decoder = Decoder()
    (observed,) = decoder.feed(ranges_frame(0, 10.0, 2, 3.25, 0.4), 110.0)
    assert observed == Range(pytest.approx(109.6), 1, 2, 3.25, -80.0)


# --- clocks ------------------------------------------------------------------------------------


@pytest.mark.parametrize("drift", [-0.005, 0.0, 30e-6, 0.005])
def test_node_time_becomes_host_time_within_milliseconds_despite_jitter(drift):
    rng = random.Random(3)
    clock = NodeClock()
    start_s = 4294967.296 - 100.0  # wraps after 100 s
    errors_s = []
    for n in range(600):
        true_s = 20.0 + n
        node_s = (start_s + (true_s - 20.0) / (1 + drift)) % 4294967.296
        clock.observe(round(node_s, 3), true_s + 0.004 + rng.expovariate(1 / 0.03))
        if n > 60:
            errors_s.append(clock.to_host_s(node_s) - true_s - 0.004)
    assert max(map(abs, errors_s)) < 0.02
    assert clock.drift == pytest.approx(drift, abs=2e-4)


def test_one_late_frame_does_not_move_the_clock():
    clock = NodeClock()
    for n in range(100):
        clock.observe(float(n), n + 5.0)
    clock.observe(100.0, 108.0)
    assert clock.to_host_s(100.0) == pytest.approx(105.0, abs=1e-6)


# --- ports -------------------------------------------------------------------------------------


def test_a_port_that_does_not_exist_is_named_in_one_line():
    with pytest.raises(DeviceError, match=r"no-such-port: cannot open.*no such device") as caught:
        serial_port.open_port("no-such-port")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("ask", [serial_port.open_port, serial_port.check_port])
@pytest.mark.parametrize(
    ("port", "reason"),
    [
        ("socket://", "HOST:PORT is missing, as in socket://HOST:PORT"),
        ("socket://host", "HOST:PORT is missing, as in socket://HOST:PORT"),
        ("socket://:4000", "HOST:PORT is missing, as in socket://HOST:PORT"),
        ("rfc2217://", "HOST:PORT is missing, as in rfc2217://HOST:PORT"),
        ("socket://host:99999", "Port out of range 0-65535"),
    ],
)
def test_an_address_without_host_or_port_is_told_in_plain_words(ask, port, reason):
    with pytest.raises(DeviceError) as caught:
        ask(port)
    assert str(caught.value) == f"{port}: cannot open the serial port: {reason}"


def test_a_device_that_is_no_serial_port_is_told_in_plain_words():
    with pytest.raises(DeviceError, match=r"^/dev/null: cannot open.*: not a serial port$"):
        serial_port.open_port("/dev/null")


def test_a_port_that_vanishes_is_an_error_after_all_that_came_before():
    master, slave = pty.openpty()
    device = serial_port.open_port(os.ttyname(slave))
    os.close(slave)
    stream = b"".join(
        xbee.encode(xbee.Receive16(1, -40, motion_frame(n, time_s=n + 1, x_m=n))) for n in range(5)
    )
    os.write(master, stream)
    closer = threading.Timer(0.3, os.close, [master])
    closer.start()
    received = []
    stream_of_observations = serial_port.observe(device, serial_port.Link())
    with pytest.raises(DeviceError, match="vanished"):
        received.extend(o for batch in stream_of_observations for o in batch)
    closer.join()
    assert len(motions(received)) == 5


def test_a_command_reaches_the_node_as_the_wire_says():
    link = serial_port.Link()
    token, data = link.command(7, wire.CommandCode.SET_LEG_LENGTH_MM, 930)
    (request,) = xbee.Parser().feed(data)
    frame = framing.decode(request.data)
    assert request.destination == 7
    assert dict(frame.values) == {"token": token, "command": 4, "value": 930}
    _, data = link.command(7, wire.CommandCode.SET_LEG_LENGTH_MM, 930, broadcast=True)
    assert xbee.Parser().feed(data)[0].destination == xbee.BROADCAST_16


def test_status_figures_carry_the_links_own_counts():
    decoder = Decoder()
    decoder.feed(motion_frame(0, time_s=1), 1.0)
    values = dict.fromkeys(wire.STATUS.field, 0) | {"time_s": 9.0, "battery_v": 3.7}
    observed = decoder.feed(framing.encode(wire.STATUS, 1, 0, 3, values), 9.0, -61)
    figures = {o.name: o.value for o in observed if isinstance(o, Status)}
    assert (figures["battery_v"], figures["link_lost"], figures["link_rssi_dbm"]) == (3.7, 2, -61)


def mark(time_us, size=8):
    return xbee.encode(xbee.UnknownFrame(xbee.VIRTUAL_TIME, time_us.to_bytes(size, "big")))


def from_node(counter):
    data = motion_frame(counter, time_s=float(counter))
    return xbee.encode(xbee.Receive16(1, -40, data))


def test_noise_on_a_real_teams_port_never_becomes_a_virtual_time():
    link = serial_port.Link()
    for k in range(1, 20):
        link.feed(from_node(k), float(k))
    link.feed(mark(7_000_000), 19.5)
    assert link.virtual_s is None
    assert link.decoder.counts["UnknownFrame"] == 1
    (motion,) = motions(link.feed(from_node(20), 20.0))
    assert motion.time_s == pytest.approx(20.0, abs=0.1)


def test_virtual_time_is_taken_from_an_emulated_team_alone_and_never_goes_back():
    link = serial_port.Link()
    link.feed(from_node(1), 0.5)
    link.feed(mark(5, size=7), 0.5)
    link.feed(mark(2**63), 0.5)
    link.feed(xbee.encode(xbee.UnknownFrame(0xA1, bytes(8))), 0.5)
    assert link.virtual_s is None
    link.feed(mark(7_000_000), 0.6)
    link.feed(mark(6_000_000), 0.7)
    assert link.virtual_s == 7.0
    assert link.decoder.counts["UnknownFrame"] == 4
