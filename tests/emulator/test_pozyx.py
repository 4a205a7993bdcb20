"""The emulated Pozyx tag against its register map."""

import numpy as np
import pytest
from chips import Host, constant

from relpos.emulator.air import EXCHANGE_US, FAILED_US, Outcome, UwbAir, VirtualClock
from relpos.emulator.bus import BusStatus
from relpos.emulator.pozyx import Pozyx, PressureErrors
from relpos.simulation.world import UwbChannel, World

TAG = 0x4B
BOOTED_US = 300_000


class Field:
    """Tags at given x coordinates on one medium."""

    def __init__(self, *x_m, by_bytes=False, collisions=True, **channel):
        options = {
            "max_range_m": 15.0,
            "detection_near": 1.0,
            "detection_far": 1.0,
            "noise_sigma_m": 0.0,
        } | channel
        self.clock = VirtualClock()
        self.place = {}
        self.air = UwbAir(
            self.clock,
            World(uwb=UwbChannel(**options)),
            lambda tag, _: np.array([self.place[tag], 0.0, 0.0]),
            np.random.default_rng(1),
            collisions,
        )
        self.hosts = []
        for k, x in enumerate(x_m):
            tag = Pozyx(k + 1, self.air, constant(pressure=98_765.4))
            self.place[tag] = x
            self.air.tags.append(tag)
            self.hosts.append(Host((TAG, tag), by_bytes=by_bytes))
        self.at(BOOTED_US)

    def at(self, time_us):
        self.clock.run(time_us)
        for host in self.hosts:
            host.at(time_us)
        return self

    def tag(self, k):
        return self.air.tags[k]

    def call(self, k, function, parameters=b"", count=0):
        status, data = self.hosts[k].transfer(TAG, bytes([function]) + parameters, b"", 1 + count)
        assert status == BusStatus.OK
        return data

    def range(self, k, peer):
        return self.call(k, 0xB5, peer.to_bytes(2, "little"))[0]

    def info(self, k, peer):
        data = self.call(k, 0xC7, peer.to_bytes(2, "little"), 10)
        return (
            data[0],
            int.from_bytes(data[1:5], "little"),
            int.from_bytes(data[5:9], "little"),
            int.from_bytes(data[9:11], "little", signed=True),
        )

    def interrupts(self, k):
        return self.hosts[k].byte(TAG, 0x05)

    def error(self, k):
        return self.hosts[k].byte(TAG, 0x04)


@pytest.fixture(params=[False, True], ids=["transactions", "bytes"])
def by_bytes(request):
    return request.param


def test_it_does_not_answer_before_a_quarter_second(by_bytes):
    host = Host((TAG, Pozyx(1, UwbAir(VirtualClock(), World(), None, None))), by_bytes=by_bytes)
    assert host.at(200_000).transfer(TAG, b"\0", b"", 1)[0] == BusStatus.ADDRESS_NACK
    assert host.at(250_000).byte(TAG, 0x00) == 0x43


def test_it_says_what_it_is(by_bytes):
    host = Field(0.0, by_bytes=by_bytes).hosts[0]
    assert host.byte(TAG, 0x00) == 0x43
    assert host.byte(TAG, 0x02) & 0xE0 == 0x20  # a tag, not an anchor
    assert host.byte(TAG, 0x03) == 0x3F  # what begin() wants of a tag
    assert host.read(TAG, 0x1A, 2) == b"\1\0"


def test_a_register_is_written_with_a_repeated_start(by_bytes):
    host = Field(0.0, by_bytes=by_bytes).hosts[0]
    assert host.transfer(TAG, b"\x1a", b"\x34\x12", 0)[0] == BusStatus.OK
    assert host.read(TAG, 0x1A, 2) == b"\x34\x12"


def test_a_register_written_the_usual_way_is_an_error(by_bytes):
    field = Field(0.0, by_bytes=by_bytes)
    field.hosts[0].transfer(TAG, b"\x1a\x34\x12", b"", 0)
    assert field.hosts[0].read(TAG, 0x1A, 2) == b"\1\0"
    assert field.interrupts(0) == 0x01
    assert field.error(0) == 0x01


def test_a_read_only_register_is_not_written():
    field = Field(0.0)
    field.hosts[0].transfer(TAG, b"\x00", b"\x99", 0)
    assert field.hosts[0].byte(TAG, 0x00) == 0x43
    assert field.error(0) == 0x01


def test_changing_a_uwb_setting_resets_the_gain():
    host = Field(0.0).hosts[0]
    default = host.byte(TAG, 0x1F)
    host.transfer(TAG, b"\x1f", bytes([67]), 0)
    assert host.byte(TAG, 0x1F) == 67
    host.transfer(TAG, b"\x1e", b"\x04", 0)
    assert host.byte(TAG, 0x1F) == default


def test_an_exchange_ends_with_the_true_distance_at_both_tags(by_bytes):
    field = Field(0.0, 7.321, by_bytes=by_bytes)
    assert field.range(0, 2) == 1
    assert field.interrupts(0) == 0
    field.at(BOOTED_US + 100_000)
    assert field.interrupts(0) == 0x10
    assert field.interrupts(0) == 0  # cleared by reading
    status, stamp_ms, distance_mm, rss = field.info(0, 2)
    assert (status, distance_mm) == (1, 7321)
    assert 300 < stamp_ms < 400
    assert -105 <= rss < -60
    # The responder stores it too and raises FUNC by itself.
    assert field.interrupts(1) == 0x10
    assert field.info(1, 1)[2] == 7321


def test_the_channel_reports_each_exchange_when_it_is_over():
    field = Field(0.0, 5.0, 9.0, 40.0, 44.0)
    records = []
    field.air.on_end = records.append
    field.range(0, 2)
    field.at(BOOTED_US + 10_000)
    field.range(2, 2)  # meets the first
    field.range(3, 5)  # out of reach of them
    field.at(BOOTED_US + 50_000)
    field.range(3, 77)
    field.at(BOOTED_US + 100_000)
    outcomes = [(r.initiator, r.destination, r.outcome) for r in records]
    assert outcomes == [
        (1, 2, Outcome.COLLIDED),
        (3, 2, Outcome.COLLIDED),
        (4, 5, Outcome.RANGED),
        (4, 77, Outcome.ABSENT),
    ]
    assert all(r.end_us - r.begin_us in (EXCHANGE_US, FAILED_US) for r in records)


def test_a_tag_that_restarts_while_it_answers_knows_nothing_of_it():
    field = Field(0.0, 5.0)
    field.range(0, 2)
    field.at(BOOTED_US + 5_000)
    field.tag(1).power_cycle(BOOTED_US + 5_000)
    field.at(BOOTED_US + 400_000)
    assert field.interrupts(1) == 0
    assert field.info(1, 1)[0] == 0


def test_an_exchange_takes_between_ten_and_fifty_milliseconds():
    field = Field(0.0, 5.0)
    field.range(0, 2)
    done = next(t for t in range(0, 100_000, 1_000) if field.at(BOOTED_US + t).interrupts(0) & 0x11)
    assert 10_000 <= done <= 50_000


@pytest.mark.parametrize("why", ["out of reach", "not there", "other settings", "asleep"])
def test_a_peer_that_does_not_answer_ends_in_a_timeout_error(why):
    field = Field(0.0, 16.0 if why == "out of reach" else 5.0)
    if why == "other settings":
        field.hosts[1].transfer(TAG, b"\x1c", b"\2", 0)
    if why == "asleep":
        field.call(1, 0xB0)
    assert field.range(0, 9 if why == "not there" else 2) == 1
    field.at(BOOTED_US + 90_000)
    assert field.interrupts(0) == 0x01
    assert field.error(0) in (0x11, 0x12, 0x13, 0x17)


def test_detection_follows_the_channel():
    field = Field(0.0, 5.0, detection_near=0.7, detection_far=0.7)
    found = 0
    for k in range(400):
        field.at(BOOTED_US + 100_000 * k).range(0, 2)
        field.at(BOOTED_US + 100_000 * k + 90_000)
        found += field.interrupts(0) == 0x10
    assert 0.6 < found / 400 < 0.8


def test_a_second_call_while_ranging_is_refused_as_busy():
    field = Field(0.0, 5.0)
    assert field.range(0, 2) == 1
    assert field.range(0, 2) == 0
    assert field.interrupts(0) == 0x01
    assert field.error(0) == 0x15


def test_a_tag_does_not_range_to_itself_or_to_the_broadcast_id():
    field = Field(0.0, 5.0)
    assert field.range(0, 1) == 0
    assert field.range(0, 0) == 0
    assert field.error(0) == 0x11


def test_overlapping_exchanges_in_reach_of_each_other_both_fail():
    field = Field(0.0, 5.0, 8.0, 12.0)
    field.range(0, 2)
    field.at(BOOTED_US + 5_000).range(2, 4)
    field.at(BOOTED_US + 100_000)
    assert field.interrupts(0) == field.interrupts(2) == 0x01
    assert field.air.counts["collisions"] == 2


def test_overlapping_exchanges_far_from_each_other_do_not_disturb():
    field = Field(0.0, 5.0, 100.0, 105.0)
    field.range(0, 2)
    field.at(BOOTED_US + 5_000).range(2, 4)
    field.at(BOOTED_US + 100_000)
    assert field.interrupts(0) == field.interrupts(2) == 0x10


def test_exchanges_one_after_the_other_do_not_collide():
    field = Field(0.0, 5.0, 8.0)
    field.range(0, 2)
    field.at(BOOTED_US + 50_000).range(2, 2)
    field.at(BOOTED_US + 100_000)
    assert field.interrupts(0) == 0x10
    assert field.interrupts(2) == 0x10


def test_no_range_is_known_of_a_peer_never_measured():
    field = Field(0.0, 5.0)
    assert field.info(0, 2)[0] == 0


def test_pressure_is_in_thousandths_of_a_pascal():
    host = Field(0.0).hosts[0]
    assert int.from_bytes(host.read(TAG, 0x50, 4), "little") == 98_765_400


def test_pressure_noise_is_that_of_the_piece():
    air = UwbAir(VirtualClock(), World(), None, None)
    errors = PressureErrors(offset_pa=50.0, noise_pa=2.0, seed=1)
    host = Host((TAG, Pozyx(1, air, constant(), errors)))
    values = (
        np.array(
            [
                int.from_bytes(host.at(BOOTED_US + 50_000 * k).read(TAG, 0x50, 4), "little")
                for k in range(500)
            ]
        )
        / 1000.0
    )
    assert values.mean() == pytest.approx(100_050.0, abs=0.4)
    assert values.std() == pytest.approx(2.0, rel=0.15)


def test_a_reset_silences_it_for_a_second_and_keeps_its_network_id():
    field = Field(0.0)
    assert field.call(0, 0xB0) == b"\1"
    status, _ = field.at(BOOTED_US + 900_000).hosts[0].transfer(TAG, b"\0", b"", 1)
    assert status == BusStatus.ADDRESS_NACK
    assert field.at(BOOTED_US + 1_000_001).hosts[0].read(TAG, 0x1A, 2) == b"\1\0"


def test_the_device_list_holds_what_was_added():
    field = Field(0.0)
    entry = (7).to_bytes(2, "little") + b"\2" + bytes(range(12))
    assert field.call(0, 0xC4, entry) == b"\1"
    assert field.hosts[0].byte(TAG, 0x81) == 1
    assert field.call(0, 0xC0, b"\0\1", 2) == b"\1\7\0"
    assert field.call(0, 0xC6, b"\7\0", 12) == b"\1" + bytes(range(12))
    assert field.call(0, 0xC3) == b"\1"
    assert field.hosts[0].byte(TAG, 0x81) == 0


def test_an_unknown_function_fails():
    field = Field(0.0)
    assert field.call(0, 0xBF) == b"\0"
    assert field.error(0) == 0x0D


def test_flags_show_without_the_mask_of_the_interrupt_pin():
    # The vendor's library never writes INT_MASK when it polls.
    field = Field(0.0, 5.0)
    assert field.hosts[0].byte(TAG, 0x10) == 0
    field.range(0, 2)
    assert field.at(BOOTED_US + 100_000).interrupts(0) == 0x10


def test_the_ranges_of_twenty_peers_are_kept_and_no_more():
    field = Field(*range(22), max_range_m=50.0)
    for k, peer in enumerate([*range(2, 23), 2]):
        field.range(0, peer)
        field.at(BOOTED_US + 100_000 * (k + 1))
    assert [peer for peer in range(2, 23) if field.info(0, peer)[0]] == list(range(2, 22))
    assert field.info(0, 2)[1] > field.info(0, 21)[1]  # a known peer's row is renewed
