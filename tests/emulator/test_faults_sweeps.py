"""One fault at every place where it can happen: each transaction, each moment, each stored byte.

A single node on a bench that answers every exchange, so that a run costs some hundredths of a
second. What `make test` leaves out of a sweep, `make soak` does.
"""

import bisect
import math
from dataclasses import replace
from functools import cache

import pytest

from fault_runs import GOOD_CONDITIONS
from relpos.emulator.air import VirtualClock
from relpos.emulator.avr.elf import default_build_folder
from relpos.emulator.avr.library import missing_parts
from relpos.emulator.bus import BusStatus
from relpos.emulator.faults.boards import cut_native
from relpos.emulator.node import EmulatedNode, draw_node_errors
from relpos.emulator.pozyx import RangeResult
from relpos.emulator.surroundings import Surroundings
from relpos.emulator.xbee import DELIVERED, XbeeModule
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.simulation.team import make_team
from relpos.simulation.walker import RATE_HZ

SOAK = pytest.mark.soak
SECONDS = 6.0
FAILURES = (BusStatus.ADDRESS_NACK, BusStatus.DATA_NACK, BusStatus.TIMEOUT)
EXCHANGE_US = 20_000
OLD_KEY, NEW_KEY = wire.DEFAULT_KEY, bytes(range(16))


@cache
def surroundings():
    """A walker who stands for two seconds and walks off."""
    (walker,), _ = make_team(replace(GOOD_CONDITIONS, still_s=2.0), 1, 20.0, 3)
    return Surroundings(
        rate_hz=RATE_HZ,
        specific_force_m_s2=walker.specific_force_m_s2,
        angular_rate_rad_s=walker.angular_rate_rad_s,
        magnetic_field_ut=walker.magnetic_field_ut,
        pressure_pa=walker.pressure_pa,
    )


class Bench:
    """One node; its peers answer each exchange with a distance of its own, so that a range
    identifies its exchange. The radio delivers everything."""

    def __init__(self, board="native", prepare=lambda bench: None):
        self.clock = VirtualClock()
        self.exchanges = {}
        self.frames = []
        self.transactions = []
        self.coordinator = XbeeModule(0, 0x40000000, self, lambda _time, _data: None)
        errors = replace(draw_node_errors(1, 1), power_on_us=0)
        self.node = EmulatedNode(1, board, surroundings(), errors, self.clock, self, self)
        self.node.bus.fault = self._note
        self.fault = lambda number, time_us: None
        prepare(self)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.node.close()

    def _note(self, address, number):
        time_us = self.node.bus.time_us
        self.transactions.append((time_us, address))
        return self.fault(number, time_us)

    def begin_exchange(self, initiator, destination, time_us):
        range_mm = 1000 + len(self.exchanges)
        self.exchanges[range_mm] = (destination, (time_us + EXCHANGE_US) * 1e-6)
        self.clock.at(
            time_us + EXCHANGE_US,
            lambda now_us: initiator.finish_ranging(
                destination, RangeResult(range_mm, -80), 0, now_us, started=True
            ),
        )

    def send(self, sent):
        """The air as the node's radio sees it."""
        frame = None
        for key in (OLD_KEY, NEW_KEY):
            try:
                frame = framing.decode(sent.data, framing.node_key(key, sent.data[3]))
                break
            except framing.FrameTagError:
                continue
        assert frame is not None, "a frame under no key that was ever given"
        self.frames.append((sent.time_us * 1e-6, frame))
        self.clock.at(sent.time_us + 10_000, lambda now_us: sent.report(now_us, DELIVERED))

    def run(self, seconds=SECONDS):
        self.clock.run(round(seconds * 1e6))
        return self

    def of(self, message):
        return [(t, f) for t, f in self.frames if f.message is message]

    def value_in_force(self, code, at_s, token, key=OLD_KEY):
        """Of a setting, by a command that is out of range and changes nothing; None: no answer."""
        count = len(self.frames)
        self.node.command(self.coordinator, code, 0, token, round(at_s * 1e6), key)
        self.run(at_s + 0.7)
        for _, f in self.frames[count:]:
            if f.message is wire.ACKNOWLEDGEMENT and f.values["token"] == token:
                assert f.values["result"] == wire.CommandResult.OUT_OF_RANGE
                return f.values["value"]
        return None


def assert_ranges_are_true(bench):
    """Each is of an exchange that was made, with that peer, at that time, and reported once."""
    reported_mm = []
    boots = {}
    for t, f in bench.frames:
        boots.setdefault(f.boot, t)
    for t, frame in bench.of(wire.RANGES):
        for entry in frame.values["ranges"]:
            range_mm = round(entry["range_m"] * 1000)
            assert range_mm in bench.exchanges, "a distance that was not measured"
            peer, ended_s = bench.exchanges[range_mm]
            assert entry["peer"] == peer
            # Node time of the frame is when it left: from there back by the age.
            assert t - entry["age_s"] == pytest.approx(ended_s, abs=0.15)
            reported_mm.append(range_mm)
    assert len(reported_mm) == len(set(reported_mm))
    return reported_mm


@cache
def undisturbed(board="native", seconds=SECONDS):
    with Bench(board) as bench:
        bench.run(seconds)
        assert len(assert_ranges_are_true(bench)) >= 5
        last = bench.of(wire.MOTION)[-1][1].values
        return tuple(bench.transactions), last, len(bench.of(wire.MOTION))


def assert_no_more_than_lost(bench, gap_s, board="native", seconds=SECONDS, astray=1):
    """Reports go on to the end, and the motion is that of the undisturbed run but for a gap.

    ``astray``: steps that may be missed, or go elsewhere as long as the forward axis is unknown
    (which is flagged).
    """
    _, theirs, count = undisturbed(board, seconds)
    motions = bench.of(wire.MOTION)
    assert len(motions) >= count - 1
    assert motions[-1][0] > seconds - 1.2
    ours = motions[-1][1].values
    assert abs(ours["time_s"] - theirs["time_s"]) < 0.2
    apart_m = math.dist((ours["x_m"], ours["y_m"]), (theirs["x_m"], theirs["y_m"]))
    # A gap of samples costs the path of that time (1.5 m/s at most) and, where it hides the end
    # of a step, that step: 0.8 m. The heading is off by at most the turn in it (2 rad/s).
    assert apart_m < 0.8 * astray + 1.5 * gap_s
    assert abs(ours["path_m"] - theirs["path_m"]) < 0.8 * astray + 1.5 * gap_s
    assert abs(ours["heading_rad"] - theirs["heading_rad"]) < 0.05 + 2.0 * gap_s


# --- the bus -------------------------------------------------------------------------


def fail_once(number, failure, gap_s=1.2, board="native", seconds=SECONDS):
    """The set-up begins anew after a second where its first transaction fails; else a sample."""

    def prepare(bench):
        bench.fault = lambda n, _time_us: failure if n == number else None

    with Bench(board, prepare) as bench:
        bench.run(seconds)
        begin_s = undisturbed(board, seconds)[0][number][0] * 1e-6
        assert_no_more_than_lost(bench, gap_s if begin_s < 0.5 else 0.1, board, seconds)
        return len(assert_ranges_are_true(bench))


@pytest.mark.parametrize("shift", [0, *(pytest.param(k, marks=SOAK) for k in (1, 2))])
@pytest.mark.parametrize("part", [0, *(pytest.param(k, marks=SOAK) for k in range(1, 24))])
def test_no_transaction_whose_failure_hangs_the_node_or_lets_a_wrong_value_in(part, shift):
    """Each 24th one, with one of the three ways to fail; the others in soak."""
    numbers = range(part, len(undisturbed()[0]), 24)
    assert len(numbers) > 35
    for number in numbers:
        reported = fail_once(number, FAILURES[(number // 24 + shift) % 3])
        assert reported >= 3, number


@pytest.mark.parametrize("stride", [79, pytest.param(1, marks=SOAK)])
def test_a_bus_stuck_for_a_tenth_of_a_second_from_any_transaction_on_is_survived(stride):
    transactions = undisturbed()[0]
    for number in range(0, len(transactions), stride):
        begin_us = transactions[number][0]

        def prepare(bench, begin_us=begin_us):
            bench.fault = lambda _number, time_us: (
                BusStatus.TIMEOUT if begin_us <= time_us < begin_us + 100_000 else None
            )

        with Bench(prepare=prepare) as bench:
            bench.run()
            # Too short for the chip to be set up anew; in its set-up a second's pause.
            assert_no_more_than_lost(bench, 1.4 if begin_us < 500_000 else 0.1, astray=2)
            assert len(assert_ranges_are_true(bench)) >= 2


@pytest.mark.skipif(missing_parts() is not None, reason=str(missing_parts()))
@pytest.mark.parametrize("part", [0, *(pytest.param(k, marks=SOAK) for k in (1, 2))])
def test_no_sampled_transaction_of_the_simulated_uno_does_either(part):
    """Some of each chip, in set-up and after; natively there are all of them."""
    if not (default_build_folder() / "uno" / "firmware.elf").exists():
        pytest.fail("no firmware for the uno: run `make firmware` first")
    seconds = 5.0
    transactions = undisturbed("uno", seconds)[0]
    chosen = [2]
    for address, after_us in ((0x68, 1_500_000), (0x0C, 0), (0x0C, 2_000_000), (0x4B, 0),
                              (0x4B, 2_100_000)):  # fmt: skip
        start = bisect.bisect_left(transactions, (after_us, 0))
        chosen += [n for n, (_, a) in enumerate(transactions) if a == address and n >= start][1:8:6]
    assert len(chosen) >= 9
    for place, number in enumerate(chosen[part::3]):
        fail_once(number, FAILURES[(place + part) % 3], board="uno", seconds=seconds)


# --- restarts ------------------------------------------------------------------------

RESTART_S = 0.07


def restarted(at_us, command=False):
    """A bench after a brown-out at that time, its node asked for a setting afterwards."""

    def prepare(bench):
        bench.node.hold_frames = True

        def dip(now_us):
            bench.node.restart(now_us, wire.ResetCause.BROWN_OUT)
            bench.node.mpu.power_cycle(now_us)
            bench.node.magnetometer.power_cycle(now_us)
            bench.node.tag.power_cycle(now_us)

        bench.clock.at(at_us, dip)
        if command:
            code = wire.CommandCode.SET_LEG_LENGTH_MM
            bench.node.command(bench.coordinator, code, 777, 9, 4_000_000)

    bench = Bench(prepare=prepare)
    bench.run(at_us * 1e-6 + 2.5)
    return bench


def assert_it_is_back(bench, at_us):
    boots = [f.boot for _, f in bench.frames]
    assert sorted(set(boots)) == [boots[0], (boots[0] + 1) % 256]
    counters = [f.counter for _, f in bench.frames]
    assert counters == sorted(set(counters)), "a counter that went back"
    first = min(t for t, f in bench.of(wire.MOTION) if f.boot == boots[-1])
    assert first - at_us * 1e-6 < RESTART_S + 1.3, "a report within a period of the start"
    statuses = [f.values for _, f in bench.of(wire.STATUS) if f.boot == boots[-1]]
    assert statuses[0]["reset_cause"] == wire.ResetCause.BROWN_OUT
    reported_mm = assert_ranges_are_true(bench)
    ended = [bench.exchanges[range_mm][1] for range_mm in reported_mm]
    # No range from before the restart is reported after it.
    for t, frame in bench.of(wire.RANGES):
        if frame.boot == boots[-1]:
            assert all(t - e["age_s"] > at_us * 1e-6 for e in frame.values["ranges"])
    return ended


@pytest.mark.parametrize("stride", [13, pytest.param(2, marks=SOAK)])
def test_a_brown_out_at_any_point_of_an_exchange_leaves_nothing_wrong_behind(stride):
    transactions = undisturbed()[0]
    pozyx = [t for t, address in transactions if address == 0x4B and t > 3_500_000]
    begin_us = pozyx[0]
    # At each transaction of a round, just before and just after it, and in the exchange itself.
    times = sorted({t + d for t in pozyx[:24] for d in (-1, 1)} | {
        begin_us + 1_700 * k for k in range(40)
    })  # fmt: skip
    for at_us in times[::stride]:
        with restarted(at_us) as bench:
            assert_it_is_back(bench, at_us)


@pytest.mark.parametrize("stride_us", [3_900, pytest.param(700, marks=SOAK)])
def test_a_brown_out_at_any_point_of_a_frame_lets_no_part_of_it_be_taken(stride_us):
    with Bench() as bench:
        bench.node.hold_frames = True
        bench.run()
        left_s = next(t for t, f in bench.of(wire.MOTION) if 3.0 < t < 5.0)
    whole = None
    for back_us in range(0, 24_000, stride_us):
        at_us = round(left_s * 1e6) - back_us
        with restarted(at_us) as bench:
            assert_it_is_back(bench, at_us)
            arrived = any(abs(t - left_s) < 0.001 for t, _ in bench.of(wire.MOTION))
            # Once the cut comes before its end the frame is not there any more.
            assert whole is None or whole or not arrived
            whole = arrived
    assert whole is False


@pytest.mark.parametrize("stride", [7, pytest.param(1, marks=SOAK)])
def test_a_brown_out_at_any_point_of_a_command_leaves_the_old_setting_or_the_new(stride):
    found = []
    for k in range(0, 45, stride):
        at_us = 3_999_000 + 1_900 * k if k < 20 else 4_037_000 + 23_000 * (k - 20)
        with restarted(at_us, command=True) as bench:
            assert_it_is_back(bench, at_us)
            found.append(
                bench.value_in_force(wire.CommandCode.SET_LEG_LENGTH_MM, at_us * 1e-6 + 2.6, 0x4000)
            )
    assert set(found) == {930, 777}
    assert found == sorted(found, reverse=True), "once it is stored it stays"


# --- power cuts ----------------------------------------------------------------------

EACH_REMAINDER = pytest.mark.parametrize(
    "left", ["garbage", *(pytest.param(k, marks=SOAK) for k in ("erased", "old"))]
)


def cut(write, left, ask):
    """A bench whose supply was cut in the middle of a byte's write after ``ask`` at 3 s."""

    def prepare(bench):
        node = bench.node
        node.hold_frames = True

        def remains(at, value):
            old = node.eeprom[at]
            return {"erased": 0xFF, "old": old, "garbage": (old * 7 + 91) & 0xFF}[left]

        cut_native(node, bench.clock, 3_000_000, write, remains)
        ask(bench)

    return Bench(prepare=prepare)


def store_settings(bench):
    bench.node.command(bench.coordinator, wire.CommandCode.SET_TEAM_SIZE, 3, 8, 1_000_000)
    bench.node.command(bench.coordinator, wire.CommandCode.SET_LEG_LENGTH_MM, 777, 9, 3_000_000)


def store_key(bench):
    bench.node.command(bench.coordinator, wire.CommandCode.SET_TEAM_SIZE, 3, 8, 1_000_000)
    bench.node.set_key(NEW_KEY, 9, 3_000_000)


@cache
def writes_of(ask):
    """How many bytes are written from then on, counted without a cut."""
    with cut(100_000, "old", ask) as bench:
        count = [0]
        plain = bench.node.engine.store

        def store(at, value):
            count[0] += bench.clock.now_us >= 3_000_000
            plain(at, value)

        bench.node.engine.store = store
        bench.run(5.0)
        return count[0]


@EACH_REMAINDER
def test_a_power_cut_at_any_byte_of_the_settings_leaves_the_old_or_the_new(left):
    count = writes_of(store_settings)
    assert count >= 10, "what changes of the setting, its version and the CRC, twice"
    found = []
    for write in range(1, count + 1):
        with cut(write, left, store_settings) as bench:
            bench.run(5.0)
            counters = [f.counter for _, f in bench.frames]
            assert counters == sorted(set(counters)), "a counter that went back"
            assert {f.node for _, f in bench.frames} == {1}
            found.append(bench.value_in_force(wire.CommandCode.SET_LEG_LENGTH_MM, 5.0, 0x4000))
            assert bench.value_in_force(wire.CommandCode.SET_TEAM_SIZE, 6.0, 0x4001) == 3
    assert set(found) == {930, 777}
    assert found == sorted(found, reverse=True)


@pytest.mark.parametrize(
    ("left", "stride"),
    [("garbage", 5), *(pytest.param(k, 1, marks=SOAK) for k in ("erased", "old", "garbage"))],
)
def test_a_power_cut_at_any_byte_of_the_key_leaves_the_old_or_the_new(left, stride):
    count = writes_of(store_key)
    assert count > 30
    found = []
    for write in range(1, count + 1, stride):
        with cut(write, left, store_key) as bench:
            bench.run(5.0)
            counters = [f.counter for _, f in bench.frames]
            assert counters == sorted(set(counters)), "a counter that went back"
            sizes = [
                bench.value_in_force(wire.CommandCode.SET_TEAM_SIZE, 5.0 + k, 0x4000 + k, key)
                for k, key in enumerate((OLD_KEY, NEW_KEY))
            ]
            assert sizes in ([3, None], [None, 3]), "answers under one key, and that is stored"
            found.append(sizes.index(3))
    assert set(found) == {0, 1}
    assert found == sorted(found)


def start_again(bench):
    """Restart it; the start counts itself and reserves counters."""
    bench.clock.at(3_000_000, lambda now_us: bench.node.restart(now_us, wire.ResetCause.POWER_ON))


@EACH_REMAINDER
def test_a_power_cut_at_any_byte_written_while_starting_sets_no_counter_back(left):
    count = writes_of(start_again)
    assert count >= 5
    for write in range(1, count + 1):
        with cut(write, left, start_again) as bench:
            bench.run(6.0)
            counters = [f.counter for _, f in bench.frames]
            assert counters == sorted(set(counters)), "a counter that went back"
            assert {f.node for _, f in bench.frames} == {1}
            assert bench.of(wire.MOTION)[-1][0] > 4.5
            assert bench.of(wire.STATUS)[-1][1].values["reset_cause"] == wire.ResetCause.BROWN_OUT
