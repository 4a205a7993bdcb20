"""Frames: how a message becomes checked bytes, and bytes a checked message.

The CRC says that a frame came whole, the tag that it is of the team. What stands in a frame, and
in which order, is :mod:`relpos.protocol.messages`'.
"""

from __future__ import annotations

import binascii
import functools
import hmac
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import siphash24

from .messages import (
    BY_NUMBER,
    CRC_BYTES,
    DEFAULT_KEY,
    FINGERPRINT,
    FRAME_BYTES,
    HEADER,
    HEADER_BYTES,
    KEY_BYTES,
    MAGIC,
    PROTOCOL_VERSION,
    TAG_BYTES,
)
from .schema import Message, OutOfRangeError


def crc16(data: bytes, seed: int = FINGERPRINT) -> int:
    """CRC-16/CCITT, polynomial 0x1021, most significant bit first, no final inversion."""
    return binascii.crc_hqx(data, seed)


class FrameError(ValueError):
    """A frame that must not be used; the class says why."""


class NotOursError(FrameError):
    """The first byte is not the magic: another system's packet."""


class ForeignVersionError(FrameError):
    """A node that speaks another protocol version; ``version`` and ``node`` name it."""

    def __init__(self, version: int, node: int | None) -> None:
        who = "a node" if node is None else f"node {node}"
        super().__init__(
            f"{who} speaks protocol version {version}, this host speaks {PROTOCOL_VERSION}: "
            "flash the firmware that belongs to this version"
        )
        self.version = version
        self.node = node


class FrameLengthError(FrameError):
    """Too short, too long, or not the length that its type and count ask for."""


class FrameCrcError(FrameError):
    """The CRC does not fit: damaged on the way, or another layout."""


class FrameTagError(FrameError):
    """The tag does not fit: sent by somebody without the team's key, or forged."""


class UnknownTypeError(FrameError):
    """A type number that this version does not have."""


class FrameValueError(FrameError):
    """A field outside its range."""


def tag(data: bytes, key: bytes) -> bytes:
    """SipHash-2-4 of ``data`` under the 16-byte ``key``: 8 bytes."""
    return bytes(siphash24.siphash24(data, key=key).digest())


@functools.lru_cache(maxsize=1024)
def node_key(team_key: bytes, node: int) -> bytes:
    """The key of frames from and to ``node``; of ``BROADCAST``, the beacons'.

    The first 16 bytes of HMAC-SHA-256 (FIPS 198-1) under the team's key, so that nobody learns the
    team's key or another node's from a node. Without a team key, all have ``DEFAULT_KEY``.
    """
    if team_key == DEFAULT_KEY:
        return DEFAULT_KEY
    return hmac.digest(team_key, b"relpos node key" + bytes((node,)), "sha256")[:KEY_BYTES]


def masked_keys(old_key: bytes, token: int, counter: int, keys: bytes) -> dict[str, int]:
    """The values of a ``NEW_KEY`` frame that gives ``keys``: a node's own, then the beacon's.

    They are XORed with four SipHash blocks of ``old_key`` over 0, block number, token (2 bytes),
    counter (4): no frame begins with 0.
    """
    said = token.to_bytes(2, "little") + counter.to_bytes(4, "little")
    mask = b"".join(tag(bytes((0, block)) + said, old_key) for block in range(4))
    masked = bytes(a ^ b for a, b in zip(keys, mask, strict=True))
    words = struct.unpack("<8I", masked)
    return {"token": token} | {f"masked_{k}": word for k, word in enumerate(words)}


@dataclass(frozen=True, slots=True)
class Frame:
    """One checked frame: who, which, and its values in SI units."""

    message: Message
    node: int
    boot: int
    counter: int
    values: Mapping[str, Any]


def encode(
    message: Message,
    node: int,
    boot: int,
    counter: int,
    values: Mapping[str, Any],
    key: bytes = DEFAULT_KEY,
) -> bytes:
    """The frame's bytes, CRC and tag included. OutOfRangeError where a value does not fit."""
    header = {
        "magic": MAGIC,
        "version": PROTOCOL_VERSION,
        "type": message.number,
        "node": node,
        "boot": boot,
        "counter": counter,
    }
    raw = b"".join(
        f.to_raw(header[f.label]).to_bytes(f.byte_count, "little") for f in HEADER
    ) + message.build(values)
    return seal(raw, key)


def seal(raw: bytes, key: bytes = DEFAULT_KEY) -> bytes:
    """Header and body with their CRC and tag."""
    raw += crc16(raw).to_bytes(CRC_BYTES, "little")
    return raw + tag(raw, key)


def decode(data: bytes, key: bytes = DEFAULT_KEY) -> Frame:
    """Check everything, then read: magic, version, length, CRC, tag, type, layout, ranges.

    Raises a subclass of :class:`FrameError` that says what was wrong; nothing of a frame that
    fails is ever returned. Whether the counter is new is the receiver's to check: it needs memory.
    """
    if not data or data[0] != MAGIC:
        raise NotOursError("not a relpos frame: the first byte is not the magic")
    if len(data) >= 2 and data[1] != PROTOCOL_VERSION:
        raise ForeignVersionError(data[1], data[3] if len(data) > 3 else None)
    if not HEADER_BYTES + CRC_BYTES + TAG_BYTES <= len(data) <= FRAME_BYTES:
        raise FrameLengthError(f"a frame of {len(data)} bytes")
    tagged = data[:-TAG_BYTES]
    raw = tagged[:-CRC_BYTES]
    if crc16(raw) != int.from_bytes(tagged[-CRC_BYTES:], "little"):
        raise FrameCrcError("the CRC does not fit")
    if not hmac.compare_digest(tag(tagged, key), data[-TAG_BYTES:]):
        raise FrameTagError("the tag does not fit the team's key")
    header: dict[str, int] = {}
    position = 0
    for field in HEADER:
        header[field.label] = int.from_bytes(raw[position : position + field.byte_count], "little")
        position += field.byte_count
    message = BY_NUMBER.get(header["type"])
    if message is None:
        raise UnknownTypeError(f"message type {header['type']} is not of this version")
    body = raw[position:]
    if not message.length_fits(body):
        raise FrameLengthError(f"a {message.name} body of {len(body)} bytes")
    try:
        values = message.parse(body)
    except OutOfRangeError as error:
        raise FrameValueError(f"{message.name}: {error}") from error
    return Frame(message, header["node"], header["boot"], header["counter"], values)
