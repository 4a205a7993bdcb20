"""XBee API frames, both ways: bytes to frames that resynchronise after garbage, and back.

Layout and numbers are Digi's (802.15.4 and Zigbee/DigiMesh API frames; AP=1 plain, AP=2 escaped).
Host and emulator both use this file; the tests compare it with the independent ``digi-xbee``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

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


@dataclass(frozen=True, slots=True)
class Transmit16:
    """TX request to a 16-bit address (0x01); ``frame_id`` 0 asks for no status."""

    kind: ClassVar[int] = 0x01
    frame_id: int
    destination: int
    data: bytes
    options: int = 0

    def body(self) -> bytes:
        """Everything after the type byte."""
        return struct.pack(">BHB", self.frame_id, self.destination, self.options) + self.data

    @classmethod
    def parse(cls, body: bytes) -> Transmit16:
        """Inverse of :meth:`body`. Raises struct.error where it is too short."""
        frame_id, destination, options = struct.unpack_from(">BHB", body)
        return cls(frame_id, destination, body[4:], options)


@dataclass(frozen=True, slots=True)
class Receive16:
    """RX from a 16-bit address (0x81); ``rssi_dbm`` is negative, options bit 1 is broadcast."""

    kind: ClassVar[int] = 0x81
    source: int
    rssi_dbm: int
    data: bytes
    options: int = 0

    def body(self) -> bytes:
        """Everything after the type byte."""
        return struct.pack(">HBB", self.source, -self.rssi_dbm, self.options) + self.data

    @classmethod
    def parse(cls, body: bytes) -> Receive16:
        """Inverse of :meth:`body`. Raises struct.error where it is too short."""
        source, magnitude, options = struct.unpack_from(">HBB", body)
        return cls(source, -magnitude, body[4:], options)


@dataclass(frozen=True, slots=True)
class Receive64:
    """RX from a 64-bit address (0x80): a node whose 16-bit address is off (MY = FFFF)."""

    kind: ClassVar[int] = 0x80
    source: int
    rssi_dbm: int
    data: bytes
    options: int = 0

    def body(self) -> bytes:
        """Everything after the type byte."""
        return struct.pack(">QBB", self.source, -self.rssi_dbm, self.options) + self.data

    @classmethod
    def parse(cls, body: bytes) -> Receive64:
        """Inverse of :meth:`body`. Raises struct.error where it is too short."""
        source, magnitude, options = struct.unpack_from(">QBB", body)
        return cls(source, -magnitude, body[10:], options)


@dataclass(frozen=True, slots=True)
class ReceivePacket:
    """RX of Zigbee, DigiMesh and newer 802.15.4 firmware (0x90); carries no signal strength."""

    kind: ClassVar[int] = 0x90
    source: int
    source_16: int
    data: bytes
    options: int = 0

    def body(self) -> bytes:
        """Everything after the type byte."""
        return struct.pack(">QHB", self.source, self.source_16, self.options) + self.data

    @classmethod
    def parse(cls, body: bytes) -> ReceivePacket:
        """Inverse of :meth:`body`. Raises struct.error where it is too short."""
        source, source_16, options = struct.unpack_from(">QHB", body)
        return cls(source, source_16, body[11:], options)


@dataclass(frozen=True, slots=True)
class TransmitStatus:
    """TX status (0x89): 0 ok, 1 not acknowledged, 2 channel busy, 3 purged, 0x74 too long."""

    kind: ClassVar[int] = 0x89
    frame_id: int
    status: int

    def body(self) -> bytes:
        """Everything after the type byte."""
        return struct.pack(">BB", self.frame_id, self.status)

    @classmethod
    def parse(cls, body: bytes) -> TransmitStatus:
        """Inverse of :meth:`body`. Raises struct.error where it is too short."""
        return cls(*struct.unpack_from(">BB", body))


@dataclass(frozen=True, slots=True)
class AtCommand:
    """A command to the local module (0x08); without a value it queries the present one."""

    kind: ClassVar[int] = 0x08
    frame_id: int
    command: bytes
    value: bytes = b""

    def body(self) -> bytes:
        """Everything after the type byte."""
        return struct.pack(">B2s", self.frame_id, self.command) + self.value

    @classmethod
    def parse(cls, body: bytes) -> AtCommand:
        """Inverse of :meth:`body`. Raises struct.error where it is too short."""
        frame_id, command = struct.unpack_from(">B2s", body)
        return cls(frame_id, command, body[3:])


@dataclass(frozen=True, slots=True)
class AtResponse:
    """The local module's answer (0x88): status 0 ok, 1 error, 2 bad command, 3 bad parameter."""

    kind: ClassVar[int] = 0x88
    frame_id: int
    command: bytes
    status: int
    value: bytes = b""

    def body(self) -> bytes:
        """Everything after the type byte."""
        return struct.pack(">B2sB", self.frame_id, self.command, self.status) + self.value

    @classmethod
    def parse(cls, body: bytes) -> AtResponse:
        """Inverse of :meth:`body`. Raises struct.error where it is too short."""
        frame_id, command, status = struct.unpack_from(">B2sB", body)
        return cls(frame_id, command, status, body[4:])


@dataclass(frozen=True, slots=True)
class ModemStatus:
    """An event of the local module (0x8A): 0 hardware reset, 1 watchdog reset, 2 associated."""

    kind: ClassVar[int] = 0x8A
    status: int

    def body(self) -> bytes:
        """Everything after the type byte."""
        return bytes((self.status,))

    @classmethod
    def parse(cls, body: bytes) -> ModemStatus:
        """Inverse of :meth:`body`. Raises struct.error where it is too short."""
        return cls(*struct.unpack_from(">B", body))


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
_KINDS = {
    kind.kind: kind
    for kind in (
        Transmit16,
        Receive16,
        Receive64,
        ReceivePacket,
        TransmitStatus,
        AtCommand,
        AtResponse,
        ModemStatus,
    )
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


def interpret(frame_data: bytes) -> ApiFrame:
    """Return the frame in ``frame_data`` (type and body); UnknownFrame where unknown or short."""
    kind = _KINDS.get(frame_data[0])
    if kind is not None:
        try:
            return kind.parse(frame_data[1:])
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

    def _reject(self, used: int) -> tuple[None, bool]:
        # AP=1: only the delimiter is known to be wrong. AP=2: no frame can start inside.
        self._skip(used if self.escaped else 1)
        return None, True

    def _parse_one(self) -> tuple[ApiFrame | None, bool]:
        """Try the frame at the buffer's start: (frame, whether the buffer moved on)."""
        plain = bytearray()
        position = 1
        while position < len(self._buffer):
            byte = self._buffer[position]
            if self.escaped:
                if byte == DELIMITER:
                    self.counts.broken_off += 1
                    self._skip(position)
                    return None, True
                if byte == ESCAPE:
                    if position + 1 == len(self._buffer):
                        return None, False
                    following = self._buffer[position + 1]
                    if following == DELIMITER:
                        self.counts.broken_off += 1
                        self._skip(position + 1)
                        return None, True
                    byte = following ^ ESCAPE_XOR
                    position += 1
            plain.append(byte)
            position += 1
            if len(plain) < 2:
                continue
            length = plain[0] << 8 | plain[1]
            if not 1 <= length <= MAX_FRAME_DATA:
                self.counts.bad_lengths += 1
                return self._reject(position)
            if len(plain) == length + 3:
                frame_data = bytes(plain[2:-1])
                if checksum(frame_data) != plain[-1]:
                    self.counts.bad_checksums += 1
                    return self._reject(position)
                del self._buffer[:position]
                self.counts.frames += 1
                return interpret(frame_data), True
        return None, False
