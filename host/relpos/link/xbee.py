"""XBee API frames, both ways: bytes to frames that resynchronise after garbage, and back.

Layout and numbers are Digi's (802.15.4 and Zigbee/DigiMesh API frames; AP=1 plain, AP=2 escaped).
Host and emulator both use this file; the tests compare it with the independent ``digi-xbee``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self, get_args

DELIMITER = 0x7E
ESCAPE = 0x7D
ESCAPED = frozenset((0x7E, 0x7D, 0x11, 0x13))
ESCAPE_XOR = 0x20
MAX_FRAME_DATA = 128
"""Longest frame data of the supported modules: 116 bytes of RF data and 12 of header."""
BROADCAST_16 = 0xFFFF
VIRTUAL_TIME = 0xF0
"""Frame by which an emulated team that does not run in real time marks the time of the next frames:
8 bytes, microseconds. Digi's 802.15.4 modules have no frame of this type."""


class _Frame:
    """A type of frame: fields of a fixed length, in order, and at most one that takes the rest."""

    __slots__ = ()
    kind: ClassVar[int]
    layout: ClassVar[str]
    """Of the fields of a fixed length, as ``struct`` has it."""
    fixed: ClassVar[tuple[str, ...]]
    rest: ClassVar[str] = ""

    def body(self) -> bytes:
        """Everything after the type byte."""
        values = (_as_sent(name, getattr(self, name)) for name in self.fixed)
        return struct.pack(self.layout, *values) + (getattr(self, self.rest) if self.rest else b"")

    @classmethod
    def parse(cls, body: bytes) -> Self:
        """Inverse of :meth:`body`. Raises struct.error where it is too short."""
        sent = zip(cls.fixed, struct.unpack_from(cls.layout, body), strict=True)
        values = {name: _as_sent(name, value) for name, value in sent}
        if cls.rest:
            values[cls.rest] = body[struct.calcsize(cls.layout) :]
        return cls(**values)


def _as_sent(name: str, value: Any) -> Any:
    """A signal strength goes over the line as its magnitude, and back."""
    return -value if name == "rssi_dbm" else value


@dataclass(frozen=True, slots=True)
class Transmit16(_Frame):
    """TX request to a 16-bit address (0x01); ``frame_id`` 0 asks for no status."""

    kind = 0x01
    layout, fixed, rest = ">BHB", ("frame_id", "destination", "options"), "data"
    frame_id: int
    destination: int
    data: bytes
    options: int = 0


@dataclass(frozen=True, slots=True)
class Receive16(_Frame):
    """RX from a 16-bit address (0x81); ``rssi_dbm`` is negative, options bit 1 is broadcast."""

    kind = 0x81
    layout, fixed, rest = ">HBB", ("source", "rssi_dbm", "options"), "data"
    source: int
    rssi_dbm: int
    data: bytes
    options: int = 0


@dataclass(frozen=True, slots=True)
class Receive64(_Frame):
    """RX from a 64-bit address (0x80): a node whose 16-bit address is off (MY = FFFF)."""

    kind = 0x80
    layout, fixed, rest = ">QBB", ("source", "rssi_dbm", "options"), "data"
    source: int
    rssi_dbm: int
    data: bytes
    options: int = 0


@dataclass(frozen=True, slots=True)
class ReceivePacket(_Frame):
    """RX of Zigbee, DigiMesh and newer 802.15.4 firmware (0x90); carries no signal strength."""

    kind = 0x90
    layout, fixed, rest = ">QHB", ("source", "source_16", "options"), "data"
    source: int
    source_16: int
    data: bytes
    options: int = 0


@dataclass(frozen=True, slots=True)
class TransmitStatus(_Frame):
    """TX status (0x89): 0 ok, 1 not acknowledged, 2 channel busy, 3 purged, 0x74 too long."""

    kind = 0x89
    layout, fixed = ">BB", ("frame_id", "status")
    frame_id: int
    status: int


@dataclass(frozen=True, slots=True)
class AtCommand(_Frame):
    """A command to the local module (0x08); without a value it queries the present one."""

    kind = 0x08
    layout, fixed, rest = ">B2s", ("frame_id", "command"), "value"
    frame_id: int
    command: bytes
    value: bytes = b""


@dataclass(frozen=True, slots=True)
class AtResponse(_Frame):
    """The local module's answer (0x88): status 0 ok, 1 error, 2 bad command, 3 bad parameter."""

    kind = 0x88
    layout, fixed, rest = ">B2sB", ("frame_id", "command", "status"), "value"
    frame_id: int
    command: bytes
    status: int
    value: bytes = b""


@dataclass(frozen=True, slots=True)
class ModemStatus(_Frame):
    """An event of the local module (0x8A): 0 hardware reset, 1 watchdog reset, 2 associated."""

    kind = 0x8A
    layout, fixed = ">B", ("status",)
    status: int


@dataclass(frozen=True, slots=True)
class UnknownFrame:
    """A frame with a good checksum and a type that is not used here."""

    type: int
    data: bytes


ApiFrame = (
    Transmit16
    | Receive16
    | Receive64
    | ReceivePacket
    | TransmitStatus
    | AtCommand
    | AtResponse
    | ModemStatus
    | UnknownFrame
)
_KINDS: dict[int, type[Any]] = {
    kind.kind: kind for kind in get_args(ApiFrame) if kind is not UnknownFrame
}


def checksum(frame_data: bytes) -> int:
    """Return the byte that makes the sum of frame data and checksum 0xFF modulo 256."""
    return 0xFF - (sum(frame_data) & 0xFF)


def encode(frame: ApiFrame, *, escaped: bool = True) -> bytes:
    """The frame as it goes over the serial line: AP=2 where ``escaped``, else AP=1."""
    if isinstance(frame, UnknownFrame):
        frame_data = bytes((frame.type,)) + frame.data
    else:
        frame_data = bytes((frame.kind,)) + frame.body()
    rest = struct.pack(">H", len(frame_data)) + frame_data + bytes((checksum(frame_data),))
    if escaped:
        out = bytearray()
        for byte in rest:
            out += bytes((ESCAPE, byte ^ ESCAPE_XOR)) if byte in ESCAPED else bytes((byte,))
        rest = bytes(out)
    return bytes((DELIMITER,)) + rest


def virtual_time(time_us: int) -> bytes:
    """Return the mark of an emulated team: what follows arrives at ``time_us``."""
    return encode(UnknownFrame(VIRTUAL_TIME, time_us.to_bytes(8, "big")))


def interpret(frame_data: bytes) -> ApiFrame:
    """Return the frame in ``frame_data`` (type and body); UnknownFrame where unknown or short."""
    kind = _KINDS.get(frame_data[0])
    if kind is not None:
        try:
            known: ApiFrame = kind.parse(frame_data[1:])
            return known
        except struct.error:
            pass
    return UnknownFrame(frame_data[0], frame_data[1:])


@dataclass
class ParserCounts:
    """Counts of a parser; ``skipped_bytes`` includes every dropped byte."""

    frames: int = 0
    bad_checksums: int = 0
    bad_lengths: int = 0
    broken_off: int = 0
    skipped_bytes: int = 0


@dataclass
class Parser:
    """Bytes in, frames out. Never raises on input; never holds more than one frame.

    In AP=2 a raw delimiter always starts a frame, so a frame that is broken off costs only
    itself. In AP=1 the delimiter may be data: after a bad frame the search goes on from the byte
    behind its delimiter, so that a good frame inside garbage is found.
    """

    escaped: bool = True
    counts: ParserCounts = field(default_factory=ParserCounts)
    _buffer: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[ApiFrame]:
        """Frames completed by ``data``, in order."""
        self._buffer += data
        return list(self._parse_all())

    def _parse_all(self) -> Iterator[ApiFrame]:
        while True:
            start = self._buffer.find(DELIMITER)
            if start < 0:
                self._skip(len(self._buffer))
                return
            self._skip(start)
            frame, done = self._parse_one()
            if not done:
                return
            if frame is not None:
                yield frame

    def _skip(self, count: int) -> None:
        self.counts.skipped_bytes += count
        del self._buffer[:count]

    def _reject(self) -> tuple[None, bool]:
        # Only the delimiter is known to be wrong: in AP=1 the next one may stand inside.
        self._skip(1)
        return None, True

    def _parse_one(self) -> tuple[ApiFrame | None, bool]:
        """Try the frame at the buffer's start: (frame, whether the buffer moved on)."""
        plain = bytearray()
        position = 1
        while position < len(self._buffer):
            byte, mask = self._buffer[position], 0
            if self.escaped and byte == ESCAPE:
                position += 1
                if position == len(self._buffer):
                    break
                byte, mask = self._buffer[position], ESCAPE_XOR
            if self.escaped and byte == DELIMITER:
                self.counts.broken_off += 1
                return self._reject()
            plain.append(byte ^ mask)
            position += 1
            if len(plain) < 2:
                continue
            length = plain[0] << 8 | plain[1]
            if not 1 <= length <= MAX_FRAME_DATA:
                self.counts.bad_lengths += 1
                return self._reject()
            if len(plain) == length + 3:
                frame_data = bytes(plain[2:-1])
                if checksum(frame_data) != plain[-1]:
                    self.counts.bad_checksums += 1
                    return self._reject()
                del self._buffer[:position]
                self.counts.frames += 1
                return interpret(frame_data), True
        return None, False
