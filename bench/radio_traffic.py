"""What a team sends: bytes on the serial lines, time on the air; and which baud rates fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

from relpos.link.port import BAUD
from relpos.protocol import messages as wire

BITS_A_BYTE = 10
FRAME_BYTES = 9
"""Delimiter, length, type, 16-bit source, signal strength, options, checksum of a 0x81 frame."""
ESCAPED_SHARE = 4 / 256
"""0x7E, 0x7D, 0x11 and 0x13 take two bytes each; tag and counters are as good as random."""
EXCHANGE_S = 0.024
ALL_IN_A_ROUND = 7
"""How the firmware plans its slots (firmware/lib/node/ranging.h)."""
AIR_BIT_S = 1 / 250_000
AIR_OVERHEAD_BYTES = 6 + 11 + 2 + 11
"""802.15.4: preamble and length, MAC header and check, Digi's header (MM=0), acknowledgement."""
AIR_WAIT_S = 0.0025
"""Mean back-off of the first attempt (7 slots of 0.32 ms), sensing, two turn-rounds."""


MOTION_S, RANGING_S, STATUS_S = 1.0, 2.0, 10.0
"""Seconds between a new node's reports."""
CLOCK_HZ = 16_000_000


def packet_bytes(body_bytes: int) -> int:
    """Payload of an XBee packet: header, body, CRC, tag."""
    return wire.HEADER_BYTES + body_bytes + wire.CRC_BYTES + wire.TAG_BYTES


def serial_bytes(body_bytes: int) -> float:
    """Mean bytes of a received frame on the coordinator's serial line, escapes included."""
    plain = packet_bytes(body_bytes) + FRAME_BYTES
    return plain * (1.0 + ESCAPED_SHARE)


def air_s(body_bytes: int) -> float:
    """Time that a packet occupies the channel, its acknowledgement included."""
    return (packet_bytes(body_bytes) + AIR_OVERHEAD_BYTES) * 8 * AIR_BIT_S + AIR_WAIT_S


def reports(ranges_a_round: int) -> list[tuple[int, float]]:
    """(body bytes, times a second) of everything that a node sends by itself."""
    frames: list[tuple[int, float]] = [
        (wire.MOTION.fixed_size, 1.0 / MOTION_S),
        (wire.STATUS.fixed_size, 1.0 / STATUS_S),
    ]
    assert wire.RANGES.entries is not None
    most = wire.RANGES.entries.most
    left = ranges_a_round
    while left > 0:
        count = min(left, most)
        size = wire.RANGES.fixed_size + count * wire.RANGES.entry_size
        frames.append((size, 1.0 / RANGING_S))
        left -= count
    return frames


@dataclass(frozen=True)
class Load:
    """A team's load: bytes a second at the coordinator, share of its line, share of the channel."""

    nodes: int
    ranges_a_round: int
    bytes_s: float
    line_share: float
    air_share: float


def load(nodes: int, ranges_a_round: int, baud: int = BAUD) -> Load:
    """Load of a team whose nodes get so many ranges a round, without losses."""
    frames = reports(ranges_a_round)
    bytes_s = nodes * sum(serial_bytes(size) * rate for size, rate in frames)
    air = nodes * sum(air_s(size) * rate for size, rate in frames)
    return Load(nodes, ranges_a_round, bytes_s, bytes_s * BITS_A_BYTE / baud, air)


def baud_error(baud: int) -> float:
    """Relative error of the AVR's UART at double speed (U2X) with its best divisor."""
    divisor = max(round(CLOCK_HZ / (8 * baud)), 1)
    return CLOCK_HZ / (8 * divisor) / baud - 1.0


def line_ms(baud: int) -> float:
    """Milliseconds that a motion report takes on a serial line."""
    return math.ceil(serial_bytes(wire.MOTION.fixed_size)) * BITS_A_BYTE / baud * 1000.0


def ranges_a_round(nodes: int) -> int:
    """Ranges that a node begins in a round: all others, or the next half as its slot has room."""
    wanted = nodes - 1 if nodes <= ALL_IN_A_ROUND else nodes // 2
    return min(wanted, int(RANGING_S / nodes / EXCHANGE_S))


def beacon_bytes(nodes: int) -> float:
    """Bytes of a beacon on the coordinator's serial line, as a transmit request."""
    assert wire.BEACON.entries is not None
    return serial_bytes(wire.BEACON.fixed_size + nodes * wire.BEACON.entry_size)
