"""The emulated XBee modules against the API; frames are made and read by digi-xbee."""

import os
import select
import threading
import tty

import numpy as np
import pytest
from digi.xbee.devices import Raw802Device
from digi.xbee.models.address import XBee16BitAddress, XBee64BitAddress
from digi.xbee.models.mode import OperatingMode
from digi.xbee.packets.base import XBeePacket
from digi.xbee.packets.common import ATCommPacket, ATCommQueuePacket
from digi.xbee.packets.factory import build_frame
from digi.xbee.packets.raw import TX16Packet, TX64Packet

from relpos.emulator.air import RadioAir, VirtualClock
from relpos.emulator.xbee import XbeeModule
from relpos.simulation.world import RadioChannel, World

MODE = OperatingMode.ESCAPED_API_MODE


class Network:
    """A coordinator (index 0) and nodes; what leaves each serial port, with its times."""

    def __init__(self, nodes=2, loss=0.0, baud=38_400):
        self.clock = VirtualClock()
        world = World(radio=RadioChannel(loss_probability=loss))
        self.air = RadioAir(self.clock, world, lambda a, b, t: 10.0, np.random.default_rng(2))
        self.out = [[] for _ in range(nodes + 1)]
        self.modules = [
            XbeeModule(
                k,
                0x40000000 + k,
                self.air,
                lambda t, data, k=k: self.out[k].append((t, data)),
                baud=baud,
            )
            for k in range(nodes + 1)
        ]
        self.air.modules += self.modules

    def feed(self, k, packet, time_us=0):
        self.modules[k].from_serial(time_us, bytes(packet.output(escaped=True)))

    def run(self, until_us=1_000_000):
        self.clock.run(until_us)
        return self

    def frames(self, k):
        return [
            build_frame(XBeePacket.unescape_data(bytearray(data)), MODE) for _, data in self.out[k]
        ]


def tx16(destination, data, frame_id=1):
    return TX16Packet(frame_id, XBee16BitAddress.from_hex_string(f"{destination:04X}"), 0, data)


def test_data_of_a_node_reach_the_coordinator_with_address_and_strength():
    network = Network()
    network.feed(2, tx16(0, b"\x7e\x11 Hi \x7d\x13"))
    (frame,) = network.run().frames(0)
    assert frame.get_frame_type().code == 0x81
    assert int(str(frame.x16bit_source_addr), 16) == 2
    assert bytes(frame.rf_data) == b"\x7e\x11 Hi \x7d\x13"
    assert frame.rssi == 60  # -40 dBm at 1 m, 20 dB a decade


def test_the_sender_learns_that_it_was_delivered_and_only_if_it_asked():
    network = Network()
    network.feed(1, tx16(0, b"x", frame_id=7))
    network.feed(1, tx16(0, b"y", frame_id=0), 50_000)
    (frame,) = network.run().frames(1)
    assert frame.get_frame_type().code == 0x89
    assert (frame.frame_id, frame.transmit_status.code) == (7, 0)


def test_loss_is_reported_as_no_acknowledgement():
    network = Network(loss=1.0)
    network.feed(1, tx16(0, b"x"))
    network.run()
    assert network.frames(0) == []
    assert network.frames(1)[0].transmit_status.code == 1


def test_an_unused_address_gives_no_acknowledgement():
    network = Network()
    network.feed(1, tx16(9, b"x"))
    assert network.run().frames(1)[0].transmit_status.code == 1


def test_loss_has_the_worlds_rate():
    network = Network(loss=0.3)
    for k in range(1000):
        network.feed(1, tx16(0, b"x", frame_id=0), 20_000 * k)
    network.run(30_000_000)
    assert 0.25 < 1 - len(network.out[0]) / 1000 < 0.35


def test_a_payload_that_is_too_long_is_refused_with_status_0x74():
    network = Network()
    network.feed(1, tx16(0, b"x" * 101))
    network.feed(1, tx16(0, b"x" * 100, frame_id=2))
    network.run()
    assert [f.transmit_status.code for f in network.frames(1)] == [0x74, 0]
    assert len(network.out[0]) == 1


def test_a_broadcast_reaches_all_others_and_is_marked():
    network = Network(nodes=3)
    network.feed(0, tx16(0xFFFF, b"all"))
    network.run()
    for k in (1, 2, 3):
        (frame,) = network.frames(k)
        assert bytes(frame.rf_data) == b"all"
        assert frame.receive_options & 2


def test_a_64_bit_address_is_one_of_a_module():
    network = Network()
    address = XBee64BitAddress.from_hex_string(f"{network.modules[2].serial_number:016X}")
    network.feed(0, TX64Packet(1, address, 0, b"long"))
    assert bytes(network.run().frames(2)[0].rf_data) == b"long"


def test_a_module_without_a_short_address_is_received_under_its_long_one():
    network = Network()
    network.feed(1, ATCommPacket(1, "MY", parameter=b"\xff\xff"))
    network.feed(1, tx16(0, b"x", frame_id=0))
    (frame,) = network.run().frames(0)
    assert frame.get_frame_type().code == 0x80
    assert int(str(frame.x64bit_source_addr), 16) == network.modules[1].serial_number


def test_at_commands_read_and_set_the_local_module():
    network = Network()
    network.feed(1, ATCommPacket(5, "MY"))
    network.feed(1, ATCommPacket(6, "ID", parameter=b"\x12\x34"))
    network.feed(1, ATCommPacket(7, "ID"))
    network.feed(1, ATCommPacket(8, "ZZ"))
    network.feed(1, ATCommPacket(9, "CH", parameter=b"\x01\x02\x03"))
    answers = network.run().frames(1)
    assert [a.frame_id for a in answers] == [5, 6, 7, 8, 9]
    assert bytes(answers[0].command_value) == b"\0\1"
    assert bytes(answers[2].command_value) == b"\x12\x34"
    assert [a.status.code for a in answers] == [0, 0, 0, 2, 3]


def test_a_queued_setting_is_in_force_from_the_next_command_that_is_not_queued():
    network = Network()
    network.feed(1, ATCommQueuePacket(1, "ID", parameter=b"\x12\x34"))
    network.feed(1, ATCommQueuePacket(2, "ID"))
    network.feed(1, ATCommPacket(3, "AC"))
    network.feed(1, ATCommQueuePacket(4, "ID"))
    network.feed(1, ATCommQueuePacket(5, "ZZ"))
    answers = network.run().frames(1)
    assert [(a.frame_id, a.status.code) for a in answers] == [
        (1, 0),
        (2, 0),
        (3, 0),
        (4, 0),
        (5, 2),
    ]
    assert bytes(answers[1].command_value) == b"\x33\x32"
    assert bytes(answers[3].command_value) == b"\x12\x34"


def test_the_makers_library_opens_the_module():
    terminal, port = os.openpty()
    tty.setraw(port)
    network = Network()
    module = network.modules[1]
    module.on_serial = lambda _time_us, data: os.write(terminal, data)
    over = threading.Event()

    def serve():
        while not over.is_set():
            if select.select([terminal], [], [], 0.02)[0]:
                module.from_serial(0, os.read(terminal, 4096))

    thread = threading.Thread(target=serve)
    thread.start()
    device = Raw802Device(os.ttyname(port), 38_400)
    try:
        device.open()
        assert device.operating_mode is MODE
        assert int(str(device.get_16bit_addr()), 16) == 1
        assert device.get_node_id() == "NODE1"
        device.set_parameter("ID", b"\x12\x34")
        assert bytes(device.get_parameter("ID")) == b"\x12\x34"
    finally:
        device.close()
        over.set()
        thread.join()
        os.close(terminal)
        os.close(port)


def test_frames_leave_at_the_speed_of_the_line():
    network = Network(baud=9600)
    for k in range(5):
        network.feed(1 + k % 2, tx16(0, b"A" * 31, frame_id=0))
    network.run()
    times = [t for t, _ in network.out[0]]
    lengths = [len(data) for _, data in network.out[0]]
    # 40 bytes take 42 ms at 9600 baud; five frames at once queue up.
    assert lengths[0] == 40
    assert np.diff(times) == pytest.approx([length * 10e6 / 9600 for length in lengths[1:]], abs=2)


def test_garbage_before_a_frame_costs_nothing_but_itself():
    network = Network()
    network.modules[1].from_serial(0, b"\x00\x55garbage\x7e\x00\x05\x01")
    network.feed(1, tx16(0, b"good", frame_id=0))
    assert bytes(network.run().frames(0)[0].rf_data) == b"good"


def test_frames_of_one_sender_keep_their_order():
    network = Network()
    for k in range(100):
        network.feed(1, tx16(0, bytes([k]), frame_id=0), 1_000 * k)
    network.run(5_000_000)
    assert [f.rf_data[0] for f in network.frames(0)] == list(range(100))
