"""What comes out of the coordinator's serial port, against the host's parser and decoder.

An input is a script of small operations as in node_fuzzer.cpp, so that the harness knows of every
frame whether it is genuine. Two ways to run it: random scripts (the test beside it), and
coverage-guided by atheris:

    python tests/fuzz/link_fuzzer.py FRAMES [libFuzzer's options] [CORPUS]
"""

from __future__ import annotations

import contextlib
import math
import os
import random
import sys
import time
from collections import Counter
from dataclasses import fields

import fuzz_builds

from relpos.link import port as serial_port
from relpos.link import xbee
from relpos.link.decoder import Decoder
from relpos.measurements import Observation
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.protocol.schema import OutOfRangeError

GOLDEN = fuzz_builds.golden_frames()
KEY = GOLDEN[1][2]
UP = (wire.MOTION, wire.RANGES, wire.STATUS, wire.STEPS, wire.SAMPLES, wire.ACKNOWLEDGEMENT)


class BrokenPromiseError(Exception):
    """Something that must never happen."""


def require(promise: bool, what: str) -> None:
    if not promise:
        raise BrokenPromiseError(what)


def crc_fits(data: bytes) -> bool:
    """CRC-16/CCITT bit by bit, as docs/protocol.md states it."""
    if not 19 <= len(data) <= wire.FRAME_BYTES:
        return False
    crc = wire.FINGERPRINT
    for byte in data[:-10]:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc == int.from_bytes(data[-10:-8], "little")


def key_of(frame: bytes) -> bytes:
    """The key of the node in whose name a frame is."""
    return framing.node_key(KEY, frame[3] if len(frame) > 3 else wire.BROADCAST)


class CheckedDecoder(Decoder):
    """A decoder of which every frame is watched."""

    def __init__(self, totals: Counter[str]) -> None:
        super().__init__((KEY,))
        self._totals = totals
        self.genuine: set[bytes] = set()
        self._taken: set[tuple[int, int]] = set()

    def state(self) -> object:
        """What a refused frame must not change."""
        return (
            [
                (
                    node,
                    track.boot,
                    track.window,
                    track.motion_s,
                    track.arrival_s,
                    track.rssi_dbm,
                    track.counts["received"],
                    track.counts["restarts"],
                    track.counts["lost"],
                    track.clock.drift,
                    track.clock._offset_s,
                    track.clock._newest_s,
                    len(track.clock._points),
                    track.totals,
                )
                for node, track in self.nodes.items()
            ],
            self.range_offsets_m,
            len(self.acknowledged),
            len(self.raw_samples),
        )

    def received(self) -> int:
        """Frames of all nodes that were taken."""
        return sum(track.counts["received"] for track in self.nodes.values())

    def feed(self, data: bytes, arrival_s: float, rssi_dbm: int | None = None) -> list[Observation]:
        """As the decoder's; BrokenPromiseError where it does what it must not."""
        try:
            frame = framing.decode(data, key_of(data))
        except framing.FrameError:
            frame = None
        if frame is not None:
            require(data in self.genuine, "a frame without a genuine tag is accepted")
            values = (frame.message, frame.node, frame.boot, frame.counter, frame.values)
            require(
                framing.encode(*values, key_of(data)) == data,
                "decoded, it is encoded as another one",
            )
        received = self.received()
        before = repr(self.state())
        observations = super().feed(data, arrival_s, rssi_dbm)
        if self.received() == received:
            self._totals["refused"] += 1
            require(not observations, "observations of a refused frame")
            require(repr(self.state()) == before, "a refused frame changes the host")
            return observations
        self._totals["taken"] += 1
        require(self.received() == received + 1, "one frame is taken twice")
        require(frame is not None, "a frame is taken that cannot be decoded")
        assert frame is not None
        once = (frame.node, frame.counter)
        require(once not in self._taken, "a frame is taken again")
        self._taken.add(once)
        for observation in observations:
            for part in fields(observation):
                value = getattr(observation, part.name)
                if isinstance(value, float):
                    require(math.isfinite(value), f"{part.name} of {type(observation).__name__}")
        return observations


class Script:
    """One input against a link of its own."""

    def __init__(self, data: bytes, totals: Counter[str]) -> None:
        self._data = data
        self._at = 0
        self._totals = totals
        self._arrival_s = 0.0
        self._sent = [data for _, _, _, data in GOLDEN]
        self._counters: Counter[int] = Counter()
        flags = self.u8()
        self._escaped = flags & 3 != 0
        self.link = serial_port.Link(key=KEY, clock=lambda: 0.0)
        self.link.parser.escaped = self._escaped
        self.decoder = self.link.decoder = CheckedDecoder(totals)
        self._genuine = self.decoder.genuine
        self._chunk = flags >> 2

    # -- the script's bytes --

    def u8(self) -> int:
        self._at += 1
        return self._data[self._at - 1] if self._at <= len(self._data) else 0

    def below(self, limit: int) -> int:
        return self.u8() % limit

    def number(self, count: int) -> int:
        return int.from_bytes(self.raw(count), "little")

    def raw(self, count: int) -> bytes:
        part = self._data[self._at : self._at + count]
        self._at += count
        return part.ljust(count, b"\0")

    def run(self) -> None:
        while self._at < len(self._data):
            self._operation(self.u8() % 14)
        # Whatever came: the next good frame is understood, after one delimiter at the latest where
        # the delimiter is never data.
        self.link.parser.feed(bytes(300) if not self._escaped else b"")
        before = self.decoder.received()
        self._feed_frame(self._motion(77, 0xFFFFFFFF))
        require(self.decoder.received() > before, "the host does not take a good frame any more")

    # -- what must hold --

    def _feed(self, stream: bytes) -> None:
        """Bytes as they are, in pieces."""
        self._totals["frames"] += 1
        self._arrival_s += self.below(200) * 0.01
        step = self._chunk or len(stream) or 1
        for start in range(0, len(stream), step):
            self.link.feed(stream[start : start + step], self._arrival_s)

    def _feed_frame(self, data: bytes) -> None:
        """One frame that the module has received."""
        node = self.u8()
        kind = self.below(8)
        api: xbee.ApiFrame = xbee.Receive16(node, -self.below(120), data)
        if kind == 0:
            api = xbee.Receive64(0x0013A200_00000000 + node, -self.below(120), data)
        elif kind == 1:
            api = xbee.ReceivePacket(0x0013A200_00000000 + node, 0xFFFE, data)
        self._feed(xbee.encode(api, escaped=self._escaped))

    # -- frames --

    def _seal(self, raw: bytes, key: bytes | None = None) -> bytes:
        data = framing.seal(raw, key or key_of(raw))
        if key is None:
            self._genuine.add(data)
        self._sent.append(data)
        return data

    def _header(self, number: int, node: int, counter: int, boot: int = 0) -> bytes:
        return bytes((wire.MAGIC, wire.PROTOCOL_VERSION, number, node, boot)) + counter.to_bytes(
            4, "little"
        )

    def _next_counter(self, node: int) -> int:
        self._counters[node] += 1 + self.below(4) // 3
        return self._counters[node]

    def _motion(self, node: int, counter: int) -> bytes:
        values = dict.fromkeys(wire.MOTION.field, 0)
        data = framing.encode(wire.MOTION, node, 0, counter, values, framing.node_key(KEY, node))
        self._genuine.add(data)
        return data

    def _fresh(self) -> bytes:
        """A frame that a node could have sent: fields of its message, drawn over their ranges."""
        message = UP[self.below(len(UP))]
        node = 1 + self.below(6)
        fixed = message.fixed_size
        entries = 0
        if message.entries is not None:
            entries = self.below(message.entries.most + 1)
        size = fixed + entries * message.entry_size
        body = bytearray(self.raw(size))
        if message.entries is not None:
            body[fixed - 1] = entries
        return self._seal(
            self._header(message.number, node, self._next_counter(node), self.below(16) // 15)
            + bytes(body)
        )

    def _golden(self) -> bytes:
        return GOLDEN[self.below(len(GOLDEN))][3]

    def _mutant(self) -> bytes:
        data = bytearray(self._fresh() if self.u8() & 1 else self._golden())
        for _ in range(1 + self.below(4)):
            kind = self.below(6)
            at = self.u8() % len(data) if data else 0
            if not data or kind == 0:
                data.insert(at, self.u8())
            elif kind == 1:
                data[at] ^= 1 << self.below(8)
            elif kind == 2:
                data[at] = self.u8()
            elif kind == 3:
                del data[at:]
            elif kind == 4:
                del data[at]
            else:
                data[at:] = self._golden()[at:]
        return bytes(data[:100])

    def _operation(self, code: int) -> None:
        totals = self._totals
        if code == 0:
            self._feed(self.raw(1 + self.below(64)))
        elif code == 1:
            totals["genuine"] += 1
            self._feed_frame(self._golden())
        elif code in (2, 3, 4):
            data = self._mutant()
            if not any(len(data) == len(each) and data[:-8] == each[:-8] for each in self._sent):
                totals["mutants"] += 1
                totals["crc of mutants"] += crc_fits(data)
            self._feed_frame(data)
        elif code == 5:
            source = random.Random(self.number(4))
            length = 17 + source.randrange(wire.MOST_BODY_BYTES + 1)
            data = bytes((wire.MAGIC, wire.PROTOCOL_VERSION)) + source.randbytes(length)
            totals["noise"] += 1
            totals["crc of noise"] += crc_fits(data)
            self._feed_frame(data)
        elif code == 6:
            data = self._mutant()
            if len(data) > 19:
                raw = data[:-10]
                data = raw + framing.crc16(raw).to_bytes(2, "little") + data[-8:]
            totals["forged"] += data not in self._genuine
            self._feed_frame(data)
        elif code in (7, 8, 9):
            totals["genuine"] += 1
            self._feed_frame(self._fresh())
        elif code == 10:  # sealed by the team, with anything in it
            totals["genuine"] += 1
            node = self.u8()
            header = self._header(self.below(24), node, self.number(4), self.u8())
            self._feed_frame(self._seal(header + self.raw(self.below(wire.MOST_BODY_BYTES + 1))))
        elif code == 11:  # another team
            totals["forged"] += 1
            raw = self._header(1 + self.below(6), self.u8(), self.number(4)) + self.raw(45)
            self._feed_frame(self._seal(raw, bytes(reversed(KEY))))
        elif code == 12:
            totals["genuine"] += 1
            self._feed_frame(self._sent[self.below(len(self._sent))])
        else:  # frames of the module itself, of any type, or broken on the cable
            kind = self.u8()
            frame = xbee.UnknownFrame(self.u8(), self.raw(self.below(40)))
            stream = bytearray(xbee.encode(frame, escaped=self._escaped))
            if kind & 1:
                stream[kind % len(stream)] ^= 1 << (kind >> 5)
            if frame.type != xbee.VIRTUAL_TIME:  # an emulated team's own: trusted like the cable
                self._feed(bytes(stream))


def refuses_with_its_own_errors(data: bytes) -> None:
    """Encoding what a host may get wrong: OutOfRangeError and nothing else."""
    message = wire.MESSAGES[data[0] % len(wire.MESSAGES)] if data else wire.MOTION
    value = int.from_bytes(data[1:7], "little", signed=True)
    values: dict[str, object] = dict.fromkeys(message.field, value)
    if message.entries is not None:
        values[message.entries.name] = []
    with contextlib.suppress(OutOfRangeError):
        framing.encode(message, 1, 0, 0, values)


def run_one(data: bytes, totals: Counter[str]) -> None:
    refuses_with_its_own_errors(data[:7])
    Script(data, totals).run()


def totals_line(totals: Counter[str], start_s: float) -> str:
    rate = totals["frames"] / (time.perf_counter() - start_s)
    rest = ", ".join(f"{name} {n}" for name, n in sorted(totals.items()) if name != "frames")
    return f"frames {totals['frames']}, a second {rate:.0f}: {rest}"


def main() -> None:
    import atheris

    wanted = int(sys.argv[1])
    totals: Counter[str] = Counter()
    start_s = time.perf_counter()

    def one(data: bytes) -> None:
        run_one(data, totals)
        if totals["frames"] >= wanted:
            print(totals_line(totals, start_s), flush=True)
            os._exit(0)

    for module in (xbee, serial_port, sys.modules["relpos.link.decoder"], wire):
        for name, value in list(vars(module).items()):
            if callable(value) and getattr(value, "__module__", None) == module.__name__:
                if isinstance(value, type):
                    for inner, method in list(vars(value).items()):
                        if callable(method) and hasattr(method, "__code__"):
                            setattr(value, inner, atheris.instrument_func(method))
                elif hasattr(value, "__code__"):
                    setattr(module, name, atheris.instrument_func(value))
    atheris.Setup([sys.argv[0], *sys.argv[2:]], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
