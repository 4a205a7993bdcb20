"""The same source on an Uno, on a Mega and on this computer sends the same messages.

Two boards that run by themselves look at their chips some 0.1 ms apart: they see other samples, and
what they reckon differs by more than rounding. So what a simulated board met is written down (what
its clock showed at every pass, what its bus answered, what came over its line) and played to the
native build, which has to ask the same questions in the same order and send the same frames.
"""

from bisect import bisect_left
from collections import deque
from itertools import pairwise

import pytest

from relpos.emulator.avr import read_firmware
from relpos.emulator.avr.elf import default_build_folder, find_firmware
from relpos.emulator.avr.library import missing_parts
from relpos.emulator.bus import BusStatus
from relpos.emulator.engine import NodeClockError
from relpos.emulator.native import NativeEngine
from relpos.emulator.node import prepared_eeprom
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link import xbee
from relpos.protocol import framing
from relpos.protocol import messages as wire

pytestmark = pytest.mark.skipif(missing_parts() is not None, reason=str(missing_parts()))

RECEIVE_RING = 64
"""Bytes (firmware/lib/board/arduino/uart.cpp)."""
SUM_ERROR = 5e-6
"""Relative, of variances: sums of thousands of ticks in single precision (6e-8 an addition);
measured 4e-7 to 3e-6 in 45 s."""
OF_THE_BOARD = {"worst_tick_s", "free_stack_bytes"}
"""What the board measures of itself: a computer has other figures."""


def _firmware_is_built():
    if not (default_build_folder() / "uno" / "firmware.elf").exists():
        pytest.fail("no firmware for the boards: run `make firmware` first")


class Bus:
    """The questions and answers of one board's bus, written down, then played."""

    def __init__(self, bus=None):
        self.questions = []
        self.time_us = 0
        if bus is not None:
            start, write, read = bus.start, bus.write, bus.read
            note = self.questions.append

            def noted_start(address, reading):
                note(("start", address, reading, answer := start(address, reading)))
                return answer

            def noted_write(byte):
                note(("write", byte, None, answer := write(byte)))
                return answer

            def noted_read():
                note(("read", None, None, answer := read()))
                return answer

            bus.start, bus.write, bus.read = noted_start, noted_write, noted_read

    def _ask(self, *question):
        assert self.questions, f"the board did not ask {question}"
        *asked, answer = self.questions.pop(0)
        assert tuple(asked) == question
        return answer

    def transfer(self, address, first, second, read_count):
        parts = [first] if first or not read_count else []
        parts += [second] if second else []
        for part in parts:
            if not self._ask("start", address, False):
                return BusStatus.ADDRESS_NACK, b""
            for byte in part:
                if not self._ask("write", byte, None):
                    return BusStatus.DATA_NACK, b""
        if read_count and not self._ask("start", address, True):
            return BusStatus.ADDRESS_NACK, b""
        return BusStatus.OK, bytes(self._ask("read", None, None) for _ in range(read_count))


class Sent:
    """Frames among the bytes that a board sends to its module."""

    def __init__(self):
        self.parser = xbee.Parser()
        self.frames = []
        self.data = b""

    def __call__(self, _time_us, data):
        self.data += data
        for request in self.parser.feed(data):
            if isinstance(request, xbee.Transmit16):
                self.frames.append(framing.decode(request.data))


def written_down(kind, seconds):
    """What node 1 of two met on a simulated board, and the frames it sent."""
    with EmulatedTeam(TeamConfig("paper", 2, seconds, 4, kind)) as team:
        node = team.nodes[1]
        bus, sent = Bus(node.bus), Sent()
        pass_on = node.engine.on_transmit
        node.engine.on_transmit = lambda at_us, data: (sent(at_us, data), pass_on(at_us, data))
        board = node.engine.board
        variables = read_firmware(find_firmware(kind, default_build_folder())).variables
        board.trace(next(at for name, at in variables.items() if "received_tail" in name))
        for k, (code, value) in enumerate(
            (
                (wire.CommandCode.SET_STEP_REPORTS, 1),
                (wire.CommandCode.SET_REPORT_PERIOD_MS, 500),
            )
        ):
            at_us = 4_000_000 + 500_000 * k
            node.command(team.coordinator, code, value, 0xFFF0 + k, at_us)
        raw_from_us = round((seconds - 6.0) * 1e6)
        node.command(team.coordinator, wire.CommandCode.SET_RAW_REPORTS, 20, 0xFFF8, raw_from_us)
        looks, received, marks = [], [], []
        for until_us in range(500_000, round(seconds * 1e6) + 1, 500_000):
            team.run(until_us)
            looks += board.take_looks()
            received += board.take_heard()
            marks += board.take_marks()
        return bus, passes(looks, marks), received, sent.frames


def passes(looks, marks):
    """(cycle, microseconds, bytes of its line that it took) of the passes among the looks.

    Looks inside a tick time the tick.
    """
    ticks = [(a, b) for (a, begin), (b, _) in pairwise(marks) if begin == 1]
    ends = [end for _, end in ticks]
    found = []
    turns, before = 0, 0
    for at, count, tail in looks:
        turns += count < before
        before = count
        k = bisect_left(ends, at)
        if k == len(ticks):
            break  # the last whole tick ends it: a pass may have been broken off
        if at < ticks[k][0]:
            found.append((at, (turns << 16 | count) * 4 & 0xFFFFFFFF, tail))
    return [
        (at, now_us, (later - tail) % RECEIVE_RING)
        for (at, now_us, tail), (_, _, later) in pairwise(found)
    ]


def played(bus, passed, received):
    """The frames that the native build sends, asked the same at the same times."""
    (_, first_us, _), *passed = passed
    engine = NativeEngine(
        bus, prepared_eeprom(1), 1, clock=NodeClockError(offset_us=first_us), stored_id=True
    )
    sent = Sent()
    engine.on_transmit = sent
    received = deque(received)
    for k, (cycle, now_us, taken) in enumerate(passed):
        if taken:
            engine.receive(bytes(received.popleft()[1] for _ in range(taken)))
        try:
            engine.poll(cycle // 16, now_us)
        except AssertionError as error:
            raise AssertionError(f"pass {k} at {cycle / 16e6:.6f} s: {error}") from error
    engine.close()
    return sent.frames


def digits(frame):
    """The numbers of a frame as they travel, and how many of them make one unit; by name."""
    message, values = frame.message, frame.values
    found = {name: (values[name], field) for name, field in message.field.items()}
    if message.entries is not None:
        for k, entry in enumerate(values[message.entries.name]):
            for field in message.entries.fields:
                found[f"{field.label}[{k}]"] = entry[field.label], field
    return {
        name: (round(value * field.per_unit), field)
        for name, (value, field) in found.items()
        if name not in OF_THE_BOARD
    }


@pytest.mark.parametrize(
    "board", [pytest.param("uno"), pytest.param("mega", marks=pytest.mark.soak)]
)
def test_native_and_avr_agree_in_every_message_within_its_last_digit(board):
    _firmware_is_built()
    bus, passed, received, theirs = written_down(board, 30.0)
    ours = played(bus, passed, received)
    assert [(f.message.name, f.boot, f.counter) for f in ours] == [
        (f.message.name, f.boot, f.counter) for f in theirs
    ]
    assert {frame.message.name for frame in ours} == {
        "motion", "status", "ranges", "steps", "samples", "acknowledgement",
    }  # fmt: skip
    assert ours[-1].counter > 100
    moved = max(f.values["path_m"] for f in ours if f.message is wire.MOTION)
    assert moved > 10.0
    apart = []
    for native, avr in zip(ours, theirs, strict=True):
        mine, its = digits(native), digits(avr)
        assert mine.keys() == its.keys()
        for name, (value, _) in mine.items():
            other, _ = its[name]
            # The variance of the heading travels in finer steps than single-precision sums of
            # thousands of ticks agree in: 1e-8 rad^2, where a float of 0.05 has steps of 4e-9.
            if abs(value - other) > max(1, SUM_ERROR * abs(other)):
                apart.append((native.message.name, name, value, other))
    assert not apart
