"""Frames: golden ones, the order of checks, and what a damaged frame may do."""

import contextlib
import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.protocol.schema import OutOfRangeError

VECTORS = json.loads(
    (Path(__file__).parents[2] / "protocol" / "vectors" / "frames.json").read_text()
)
BY_NAME = {v["name"]: v for v in VECTORS}
KEY = bytes(range(16))


def decode(vector):
    return framing.decode(bytes.fromhex(vector["hex"]), bytes.fromhex(vector["key"]))


def crc_by_polynomial_division(data: bytes, seed: int) -> int:
    """CRC-16/CCITT bit by bit, from its definition: independent of the table in binascii."""
    register = seed
    for byte in data:
        for bit in range(7, -1, -1):
            out = register >> 15 ^ (byte >> bit & 1)
            register = register << 1 & 0xFFFF
            if out:
                register ^= 0x1021
    return register


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: v["name"])
def test_golden_values_encode_to_the_golden_bytes(vector):
    encoded = framing.encode(
        wire.BY_NAME[vector["message"]],
        vector["node"],
        vector["boot"],
        vector["counter"],
        vector["values"],
        bytes.fromhex(vector["key"]),
    )
    assert encoded.hex() == vector["hex"]


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: v["name"])
def test_golden_bytes_decode_to_the_golden_values(vector):
    frame = decode(vector)
    assert (frame.message.name, frame.node, frame.boot, frame.counter) == (
        vector["message"],
        vector["node"],
        vector["boot"],
        vector["counter"],
    )
    assert dict(frame.values) == vector["values"]


def test_the_crc_is_the_published_one():
    assert framing.crc16(b"123456789", 0) == 0x31C3  # CRC-16/XMODEM check value
    assert framing.crc16(b"123456789", 0xFFFF) == 0x29B1  # CRC-16/CCITT-FALSE check value
    data = bytes.fromhex(BY_NAME["status"]["hex"])[: -wire.TAG_BYTES]
    assert crc_by_polynomial_division(data[:-2], wire.FINGERPRINT) == int.from_bytes(
        data[-2:], "little"
    )


def test_the_tag_is_siphash_2_4():
    # Appendix A of the SipHash paper: key 00..0f, data 00..0e.
    assert framing.tag(bytes(range(15)), bytes(range(16))) == bytes.fromhex("e545be4961ca29a1")


def test_a_frame_under_another_key_is_refused():
    data = bytes.fromhex(BY_NAME["status"]["hex"])
    with pytest.raises(framing.FrameTagError):
        framing.decode(data, bytes(range(1, 17)))
    with pytest.raises(framing.FrameTagError):
        framing.decode(data)


def test_every_bit_of_a_frame_is_under_its_tag():
    """A forger can compute the CRC, but not the tag."""
    data = bytes.fromhex(BY_NAME["command"]["hex"])
    for bit in range(16, 8 * (len(data) - wire.CRC_BYTES - wire.TAG_BYTES)):
        raw = bytearray(data[: -wire.CRC_BYTES - wire.TAG_BYTES])
        raw[bit // 8] ^= 1 << bit % 8
        forged = bytes(raw) + framing.crc16(bytes(raw)).to_bytes(2, "little")
        with pytest.raises(framing.FrameTagError):
            framing.decode(forged + data[-wire.TAG_BYTES :], KEY)


def test_a_foreign_version_is_named_even_when_the_rest_is_not_ours():
    with pytest.raises(
        framing.ForeignVersionError, match="node 6 speaks protocol version 9"
    ) as caught:
        framing.decode(bytes((wire.MAGIC, 9, 77, 6)) + b"whatever a later version may hold" * 3)
    assert (caught.value.version, caught.value.node) == (9, 6)
    for cut in ((wire.MAGIC, 1), (wire.MAGIC, 1, 77)):
        with pytest.raises(framing.ForeignVersionError, match="a node speaks"):
            framing.decode(bytes(cut))


def test_another_systems_packet_is_not_ours():
    for data in (b"", b"\x00", b"\x00" * 50):
        with pytest.raises(framing.NotOursError):
            framing.decode(data)


def test_another_layout_fails_the_crc_instead_of_being_misread():
    data = bytes.fromhex(BY_NAME["motion_walking"]["hex"])[:-10]
    data += crc_by_polynomial_division(data, wire.FINGERPRINT ^ 1).to_bytes(2, "little")
    with pytest.raises(framing.FrameCrcError):
        framing.decode(data + framing.tag(data, KEY), KEY)


@pytest.mark.parametrize("vector", VECTORS, ids=lambda v: v["name"])
def test_every_single_bit_error_and_truncation_is_refused(vector):
    data = bytes.fromhex(vector["hex"])
    for bit in range(8 * len(data)):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(framing.FrameError):
            framing.decode(bytes(damaged), bytes.fromhex(vector["key"]))
    for length in range(len(data)):
        with pytest.raises(framing.FrameError):
            framing.decode(data[:length], bytes.fromhex(vector["key"]))


def sealed(type_number: int, body: bytes) -> bytes:
    header = bytes((wire.MAGIC, wire.PROTOCOL_VERSION, type_number, 1, 0, 0, 0, 0, 0))
    return framing.seal(header + body)


def test_a_count_that_does_not_fit_the_length_is_refused_despite_a_good_crc_and_tag():
    body = bytes(4) + b"\x02" + bytes(8)
    with pytest.raises(framing.FrameLengthError):
        framing.decode(sealed(wire.RANGES.number, body))
    with pytest.raises(framing.FrameLengthError):
        framing.decode(sealed(wire.RANGES.number, bytes(4) + b"\xff" + bytes(8)))


def test_what_is_too_short_or_too_long_for_any_frame_is_told_as_that():
    whole = sealed(wire.MOTION.number, bytes(wire.FRAME_BYTES))
    least = len(sealed(wire.MOTION.number, b""))
    for length in (*range(2, least), wire.FRAME_BYTES + 1):
        with pytest.raises(framing.FrameLengthError, match=f"a frame of {length} bytes"):
            framing.decode(whole[:length])
    for length in (least, wire.FRAME_BYTES):
        with pytest.raises(framing.FrameCrcError):
            framing.decode(whole[:length])


def test_a_value_out_of_its_range_is_refused_despite_a_good_crc_and_tag():
    zero_range = bytes(4) + b"\x01" + b"\x02" + bytes(3) + bytes(4)
    with pytest.raises(framing.FrameValueError, match="range_m"):
        framing.decode(sealed(wire.RANGES.number, zero_range))


def test_an_unknown_type_is_refused_despite_a_good_crc_and_tag():
    with pytest.raises(framing.UnknownTypeError):
        framing.decode(sealed(200, b""))


def test_a_value_that_does_not_fit_is_not_sent():
    with pytest.raises(OutOfRangeError, match="range_m"):
        wire.RANGES.build(
            {
                "time_s": 0,
                "ranges": [{"peer": 1, "range_m": 0, "rss_dbm": 0, "age_s": 0, "quality": 0}],
            }
        )
    entry = {"peer": 1, "range_m": 1.0, "rss_dbm": 0, "age_s": 0, "quality": 0}
    with pytest.raises(OutOfRangeError, match="at most 5"):
        wire.RANGES.build({"time_s": 0, "ranges": [entry] * 6})


@given(st.binary(max_size=80))
@settings(max_examples=300)
def test_any_bytes_end_in_a_frame_or_a_named_refusal(data):
    with contextlib.suppress(framing.FrameError):
        framing.decode(data)
