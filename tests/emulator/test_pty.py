"""The pseudo-terminal: nothing lost at any speed, readers that come and go, virtual times."""

import os
import select
import subprocess
import sys
import threading
import time

import pytest
import serial

from relpos.emulator.pty import PseudoTerminal
from relpos.errors import DeviceError
from relpos.link.port import Link, observe
from relpos.link.xbee import VIRTUAL_TIME, Parser, Receive16, UnknownFrame, encode, virtual_time
from relpos.protocol import framing
from relpos.protocol import messages as wire


class Talker:
    """Stands in for a team: one numbered frame every ``period_us`` of virtual time."""

    def __init__(self, seconds, period_us=10_000, size=40):
        self.seconds = seconds
        self.end_us = round(seconds * 1e6)
        self.time_us = 0
        self.received = bytearray()
        self.period_us = period_us
        self.size = size
        self.fails_at_us = None

    def frame(self, number):
        # 7E, 7D, 11, 13 and line ends: what a terminal in the way would spoil.
        data = number.to_bytes(4, "big") + b"\x7e\x7d\x11\x13\x0d\x0a\x03\x04\x1a\x7f\xff"
        return encode(Receive16(1, -40, data.ljust(self.size, b".")))

    def run(self, until_us):
        first = self.time_us // self.period_us + 1
        last = until_us // self.period_us
        self.time_us = until_us
        if self.fails_at_us is not None and until_us >= self.fails_at_us:
            raise DeviceError("node 3: the firmware crashed")
        return [(k * self.period_us, self.frame(k)) for k in range(first, last + 1)]

    def send(self, data):
        self.received += data


def numbers(data):
    parser = Parser()
    frames = parser.feed(data)
    assert parser.counts.skipped_bytes == parser.counts.bad_checksums == 0
    return [int.from_bytes(f.data[:4], "big") for f in frames if isinstance(f, Receive16)]


PATIENCE_S = 60.0


def read_all(port, enough):
    data = b""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline and (len(data) < enough):
        data += port.read(max(1, port.in_waiting))
    return data


def test_nothing_is_lost_at_full_speed_with_a_slow_reader():
    talker = Talker(seconds=60.0)
    with PseudoTerminal(talker, speed=0.0) as terminal:
        with serial.Serial(terminal.path, 38_400, timeout=0.05) as port:
            terminal.start()
            total = sum(len(talker.frame(k)) for k in range(1, 6001))
            data = b""
            while len(data) < total:
                chunk = port.read(1500)
                assert chunk or not terminal.finished
                data += chunk
                if len(data) < 40_000:
                    time.sleep(0.002)
        terminal.join()
    assert numbers(data) == list(range(1, 6001))


def test_the_clock_stands_while_the_port_is_not_read():
    talker = Talker(seconds=1000.0)
    with PseudoTerminal(talker, speed=0.0) as terminal:
        terminal.start()
        time.sleep(0.2)
        assert talker.time_us == 0
        with serial.Serial(terminal.path, 38_400):
            before_us = 0
            while not 0 < before_us == talker.time_us:
                before_us = talker.time_us
                time.sleep(0.2)
            assert talker.time_us < talker.end_us, "a clock that does not stand gets to its end"


def test_a_reader_that_comes_back_goes_on_reading_whole_frames():
    talker = Talker(seconds=1000.0)
    with PseudoTerminal(talker, speed=0.0) as terminal:
        terminal.start()
        seen = []
        for _ in range(3):
            with serial.Serial(terminal.path, 38_400, timeout=0.05) as port:
                data = read_all(port, 3000)
            # The first and the last frame may be cut by opening and closing.
            frames = Parser().feed(data[data.index(b"\x7e") :])
            seen.append([int.from_bytes(f.data[:4], "big") for f in frames])
        assert all(len(s) > 30 for s in seen)
        assert seen[0][-1] < seen[1][0] < seen[1][-1] < seen[2][0]


def test_real_time_is_real_time():
    talker = Talker(seconds=1000.0)
    with PseudoTerminal(talker, speed=2.0) as terminal:
        terminal.start()
        with serial.Serial(terminal.path, 38_400, timeout=0.05) as port:
            read_all(port, 1)
            # A busy computer disturbs a measurement or two.
            for _ in range(20):
                start, start_us = time.monotonic(), talker.time_us
                while time.monotonic() < start + 0.5:
                    port.read(4096)
                speed = (talker.time_us - start_us) * 1e-6 / (time.monotonic() - start)
                if speed == pytest.approx(2.0, rel=0.2):
                    return
    pytest.fail(f"{speed:.2f} instead of 2")


def test_bytes_of_the_host_reach_the_coordinator_unchanged():
    talker = Talker(seconds=1000.0)
    message = bytes(range(256)) * 4
    with PseudoTerminal(talker, speed=1.0) as terminal:
        terminal.start()
        with serial.Serial(terminal.path, 38_400, timeout=0.05) as port:
            read_all(port, 1)
            port.write(message)
            deadline = time.monotonic() + PATIENCE_S
            while len(talker.received) < len(message) and time.monotonic() < deadline:
                port.read(4096)
    assert bytes(talker.received) == message


def test_a_reader_without_settings_of_its_own_gets_raw_bytes():
    talker = Talker(seconds=10.0)
    with PseudoTerminal(talker, speed=0.0) as terminal:
        terminal.start()
        reader = os.open(terminal.path, os.O_RDWR | os.O_NOCTTY)
        try:
            data = b""
            while not terminal.finished or select.select([reader], [], [], 0.1)[0]:
                if select.select([reader], [], [], 0.1)[0]:
                    data += os.read(reader, 4096)
        finally:
            os.close(reader)
        terminal.join()
    assert numbers(data) == list(range(1, 1001))
    assert talker.received == b""  # nothing was echoed


def test_marks_carry_the_virtual_time_of_what_follows():
    talker = Talker(seconds=5.0)
    with PseudoTerminal(talker, speed=0.0, mark_time=True) as terminal:
        with serial.Serial(terminal.path, 38_400, timeout=0.05) as port:
            terminal.start()
            data = b""
            while (chunk := port.read(4096)) or not terminal.finished:
                data += chunk
        terminal.join()
    frames = Parser().feed(data)
    assert len(frames) == 1000
    for mark, frame in zip(frames[::2], frames[1::2], strict=True):
        assert isinstance(mark, UnknownFrame)
        assert mark.type == VIRTUAL_TIME
        number = int.from_bytes(frame.data[:4], "big")
        assert int.from_bytes(mark.data, "big") == number * 10_000


def test_the_port_of_the_same_process_gives_the_exact_arrival_of_every_byte():
    talker = Talker(seconds=20.0, period_us=7_000)
    parser = Parser()
    arrivals = []
    with PseudoTerminal(talker, speed=0.0) as terminal, terminal.open_port() as port:
        terminal.start()
        while not port.exhausted:
            data = port.read(max(1, min(port.in_waiting, 4096)))
            arrivals += [
                (int.from_bytes(f.data[:4], "big"), port.virtual_time_s())
                for f in parser.feed(data)
            ]
        terminal.join()
    assert [a[0] for a in arrivals] == list(range(1, 20_000_000 // 7_000 + 1))
    assert all(at == pytest.approx(number * 0.007, abs=1e-9) for number, at in arrivals)


def test_the_link_reads_motion_at_virtual_times_through_the_port():
    class Walker(Talker):
        def frame(self, number):
            values = dict.fromkeys(wire.MOTION.field, 0) | {
                "time_s": 0.01 * number - 0.004,
                "x_m": 0.02 * number,
                "state": wire.MotionState.MOVING,
            }
            return encode(Receive16(5, -40, framing.encode(wire.MOTION, 5, 0, number, values)))

    link = Link()
    motions = []
    with PseudoTerminal(Walker(seconds=10.0), speed=0.0) as terminal, terminal.open_port() as port:
        terminal.start()
        for batch in observe(port, link, port.virtual_time_s):
            motions += [o for o in batch if type(o).__name__ == "Motion"]
            if port.exhausted:
                break
        terminal.join()
    assert len(motions) == 1000
    assert sum(m.dx_m for m in motions) == pytest.approx(20.0)
    assert motions[-1].time_s == pytest.approx(10.0, abs=0.001)


def test_the_link_lives_in_the_marked_time_whatever_its_own_clock_says():
    values = dict.fromkeys(wire.MOTION.field, 0) | {"state": wire.MotionState.MOVING}
    link = Link()
    motions = []
    for k in range(1, 100):
        frame = framing.encode(wire.MOTION, 5, 0, k, values | {"time_s": float(k)})
        data = virtual_time(k * 1_000_000 + 2_000)
        motions += link.feed(data + encode(Receive16(5, -40, frame)), arrival_s=0.05 * k)
    assert [m.time_s for m in motions] == pytest.approx([k + 0.002 for k in range(1, 100)])


def test_a_team_that_fails_gives_the_reader_its_error():
    talker = Talker(seconds=10.0)
    talker.fails_at_us = 5_000_000
    with PseudoTerminal(talker, speed=0.0) as terminal, terminal.open_port() as port:
        terminal.start()

        def read_on():
            for _ in observe(port, Link(), port.virtual_time_s):
                assert not port.exhausted

        with pytest.raises(DeviceError, match="node 3"):
            read_on()


def test_the_end_is_reported_in_words_and_the_last_byte_arrives(capsys):
    talker = Talker(seconds=3.0)
    terminal = PseudoTerminal(talker, speed=0.0)
    data = b""

    def serve():
        terminal.serve()
        terminal.close()

    thread = threading.Thread(target=serve)
    with serial.Serial(terminal.path, 38_400, timeout=0.05) as port:
        thread.start()
        try:
            while True:
                data += port.read(max(1, port.in_waiting))
        except (serial.SerialException, OSError):
            pass  # the port vanished: the end
    thread.join()
    assert numbers(data) == list(range(1, 301))
    assert "over" in capsys.readouterr().err


def test_a_negative_speed_is_refused():
    with pytest.raises(DeviceError, match="speed"):
        PseudoTerminal(Talker(1.0), speed=-1.0)


@pytest.mark.parametrize(
    "command",
    [
        "emulate --nodes 2",
        *(pytest.param(c, marks=pytest.mark.soak) for c in ("demo --seconds 10", "demo --view")),
    ],
)
def test_a_system_without_pseudo_terminals_gets_one_line(command):
    """As on Windows, whose Python has neither of these modules."""
    without = (
        "import runpy, serial, sys\n"
        "sys.modules['fcntl'] = sys.modules['termios'] = None\n"
        f"sys.argv = ['relpos', *{command.split()!r}]\n"
        "runpy.run_module('relpos.cli.main', run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", without], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1, done.stderr
    (line,) = [x for x in done.stderr.splitlines() if x.startswith("relpos: ")]
    assert "emulated teams need pseudo-terminals" in line
    assert "Traceback" not in done.stderr
