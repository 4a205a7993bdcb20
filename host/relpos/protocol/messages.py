"""Every message between node and host: the one place where the wire is written.

``generate.py`` makes ``firmware/lib/wire/messages.h``, the C++ test vectors and
``docs/protocol.md`` from this file. A frame is the payload of one XBee packet:

    magic  version  type  node  boot  counter(4)   body   crc(2)   tag(8)

All integers are little-endian. A frame has at most the 66 bytes that every XBee variant carries.
The first two bytes mean the same in every version for ever: a frame of a foreign version can
always be named. The CRC-16/CCITT starts from the layout's fingerprint, not from a constant, so that
a peer with another layout fails the check instead of being misread (the habit of MAVLink's
CRC_EXTRA). The tag is SipHash-2-4 (Aumasson & Bernstein 2012) under the team's key over all that
stands before it; a sender's counter grows with every frame and never goes back, so that a frame is
new or is refused. :mod:`relpos.protocol.framing` makes and checks frames.
"""

from __future__ import annotations

import enum
import hashlib

from .schema import Entries, Message, Quantity

MAGIC = 0xB5
PROTOCOL_VERSION = 3
FRAME_BYTES = 66
CRC_BYTES = 2
TAG_BYTES = 8
KEY_BYTES = 16
DEFAULT_KEY = bytes(KEY_BYTES)
"""Of a node that was never given one: everybody knows it, so it keeps nobody out."""
COORDINATOR = 0
BROADCAST = 255
CABLE_OPTIONS = 0xA5
"""Receive options of a frame that the host hands a node over its USB cable, in the module's place.
No module sets them, and no sender on the air can."""
MAX_COMMAND_JUMP = 1 << 30
"""How far ahead of the newest the counter of a command or beacon may be: four years of the host's
clock. Longer no node lies unused under one key."""


class ResetCause(enum.IntEnum):
    """Why the node started."""

    UNKNOWN = 0
    POWER_ON = 1
    EXTERNAL = 2
    BROWN_OUT = 3
    WATCHDOG = 4
    COMMAND = 5


class MotionState(enum.IntEnum):
    """What the wearer does, as the node's gait detection sees it."""

    STARTING = 0
    STANDING = 1
    MOVING = 2


class Quality(enum.IntFlag):
    """What weakens the motion since the last report."""

    MAGNETOMETER_VALID = 0x01
    MAGNETOMETER_DISTURBED = 0x02
    SATURATED = 0x04
    FORWARD_AXIS_UNKNOWN = 0x08
    IMU_GAP = 0x10
    IRREGULAR_GAIT = 0x20
    HEIGHT_VALID = 0x40
    FILTER_RESET = 0x80


class RangeQuality(enum.IntFlag):
    """What weakens one range."""

    WEAK_SIGNAL = 0x01
    RETRIED = 0x02


class Health(enum.IntFlag):
    """What of a node works."""

    IMU = 0x01
    MAGNETOMETER = 0x02
    POZYX = 0x04
    PRESSURE = 0x08
    BEACON = 0x10
    KEY_SET = 0x20


class CommandCode(enum.IntEnum):
    """What the host may ask of a node; ``value`` is the command's argument."""

    PING = 0
    REBOOT = 1
    SET_REPORT_PERIOD_MS = 2
    SET_RANGING_PERIOD_MS = 3
    SET_LEG_LENGTH_MM = 4
    SET_STEP_GAIN_PERMILLE = 5
    SET_TEAM_SIZE = 6
    SET_STEP_REPORTS = 7
    SET_LED = 8
    SET_STATUS_PERIOD_MS = 9
    SET_RAW_REPORTS = 10
    SET_CALIBRATION = 11
    COMMIT_CALIBRATION = 12
    READ_CALIBRATION = 13
    SET_NODE_ID = 14
    SET_RANGE_OFFSET_MM = 15
    RESTORE_DEFAULTS = 16
    SET_KEY = 17
    ACCESS_BUS = 18
    """One I2C transaction. The value's bytes, lowest first: address, register, a parameter, and how
    many bytes are written (low half: 1 the register, 2 the parameter, too, 3 a zero behind it) and
    read. The answer's: the last two that were read, and the microseconds that it took."""


class CommandResult(enum.IntEnum):
    """How a command ended; COUNTER_REFUSED tells the newest one, CABLE_ONLY is a first key's."""

    DONE = 0
    UNKNOWN_COMMAND = 1
    OUT_OF_RANGE = 2
    BUSY = 3
    NO_ANSWER = 4
    COUNTER_REFUSED = 5
    CABLE_ONLY = 6


HEADER = (
    Quantity("magic", "u8", "Always 0xB5; the same in every version", low=MAGIC, high=MAGIC),
    Quantity("version", "u8", "Protocol version; the second byte in every version"),
    Quantity("type", "u8", "Message type"),
    Quantity(
        "node", "u8", "Whose frame: the sender going up, the addressee going down (255: everybody)"
    ),
    Quantity(
        "boot", "u8", "Counts the node's starts; totals and clock begin anew with each", wraps=True
    ),
    Quantity("counter", "u32", "Grows with every frame of the sender, also over its restarts"),
)
HEADER_BYTES = sum(f.byte_count for f in HEADER)


def _total(name: str, wire: str, raw_name: str, meaning: str) -> Quantity:
    return Quantity(name, wire, meaning, raw_name=raw_name, wraps=True)


def _time(meaning: str) -> Quantity:
    return _total("time_s", "u32", "time_ms", meaning)


def _vector(name: str, unit: str, raw_unit: str, meaning: str) -> tuple[Quantity, ...]:
    return tuple(
        Quantity(f"{name}_{axis}_{unit}", "i32", meaning, raw_name=f"{name}_{axis}_{raw_unit}")
        for axis in "xyz"
    )


MOTION = Message(
    1,
    "motion",
    "Dead reckoning since the node's start, as running totals: the host takes differences, so a "
    "lost frame loses no motion.",
    (
        _time("Node clock at the end of the motion"),
        _total("x_m", "i32", "x_mm", "Total displacement along the heading at the start"),
        _total("y_m", "i32", "y_mm", "Total displacement to the left of the heading at the start"),
        _total(
            "heading_rad",
            "i32",
            "heading_100urad",
            "Total turn, counter-clockwise, whole turns included",
        ),
        _total("path_m", "u32", "path_mm", "Total of the step lengths"),
        Quantity("steps", "u16", "Total number of steps", wraps=True),
        _total(
            "variance_along_m2",
            "u32",
            "variance_along_mm2",
            "Total variance along the walking direction, without the scale error",
        ),
        _total(
            "variance_across_m2",
            "u32",
            "variance_across_mm2",
            "Total variance across the walking direction",
        ),
        _total(
            "variance_heading_rad2",
            "u32",
            "variance_heading_100urad2",
            "Total variance of the heading",
        ),
        _total(
            "scale_error_m",
            "u32",
            "scale_error_mm",
            "Total standard deviation of the path from what all steps err by together",
        ),
        Quantity(
            "height_m",
            "i16",
            "Height over the start, from pressure; see HEIGHT_VALID",
            raw_name="height_cm",
        ),
        Quantity(
            "magnetic_heading_rad",
            "i16",
            "Heading of the body over magnetic north, counter-clockwise; see MAGNETOMETER_VALID",
            raw_name="magnetic_heading_100urad",
            low=-31_416,
            high=31_416,
        ),
        Quantity("state", "u8", "Standing or moving", values=MotionState),
        Quantity(
            "gain_version", "u8", "Counts the changes of leg length and step gain", wraps=True
        ),
        Quantity("quality", "u8", "What weakens this motion", values=Quality),
    ),
)

RANGES = Message(
    2,
    "ranges",
    "Distances to other nodes by UWB two-way ranging; failures are counted in the status.",
    (_time("Node clock when the frame was filled"),),
    Entries(
        "ranges",
        "range",
        (
            Quantity("peer", "u8", "The other node"),
            Quantity("range_m", "u24", "Distance", raw_name="range_mm", low=1, high=200_000),
            Quantity("rss_dbm", "i8", "Signal strength", unit="dBm"),
            Quantity(
                "age_s",
                "u16",
                "How long before the frame's time it was measured",
                raw_name="age_ms",
            ),
            Quantity("quality", "u8", "What weakens this range", values=RangeQuality),
        ),
        most=5,
    ),
)

STATUS = Message(
    3,
    "status",
    "The node's health.",
    (
        _time("Node clock"),
        Quantity("firmware_major", "u8", "Firmware version, first part"),
        Quantity("firmware_minor", "u8", "Firmware version, second part"),
        Quantity("firmware_patch", "u8", "Firmware version, third part"),
        Quantity("uptime_s", "u32", "Time since the start", unit="s"),
        Quantity("reset_cause", "u8", "Why the node started", values=ResetCause),
        Quantity(
            "battery_v", "u16", "Supply voltage; 0 where it is not measured", raw_name="battery_mv"
        ),
        Quantity("bus_errors", "u16", "I2C transactions that failed", wraps=True),
        Quantity("ranging_successes", "u16", "Ranges obtained", wraps=True),
        Quantity("ranging_failures", "u16", "Ranging exchanges that gave none", wraps=True),
        Quantity(
            "worst_tick_s",
            "u16",
            "Longest 50 Hz tick since the last status",
            raw_name="worst_tick_us",
        ),
        Quantity("missed_ticks", "u16", "50 Hz ticks that came too late to be kept", wraps=True),
        Quantity(
            "free_stack_bytes", "u16", "Bytes between heap end and deepest stack so far", unit="B"
        ),
        Quantity(
            "bad_frames",
            "u16",
            "Received frames that failed a check, or that the module sends unasked (its restart)",
            wraps=True,
        ),
        Quantity("dropped_ranges", "u16", "Ranges dropped because the radio was busy", wraps=True),
        Quantity("dropped_steps", "u16", "Steps dropped because the radio was busy", wraps=True),
        Quantity(
            "radio_failures", "u16", "Frames that the radio reported as not delivered", wraps=True
        ),
        Quantity(
            "refused_frames",
            "u16",
            "Received frames with a wrong tag or a counter that was used before",
            wraps=True,
        ),
        Quantity(
            "range_offset_m",
            "i16",
            "This end's share of what its ranges are too long by (antenna delay); the host "
            "subtracts both ends' shares",
            raw_name="range_offset_mm",
        ),
        Quantity(
            "damaged_bytes", "u16", "Bytes that arrived damaged at the UART: noise", wraps=True
        ),
        Quantity("lost_bytes", "u16", "Bytes that the UART had no room for", wraps=True),
        Quantity(
            "ranging_error",
            "u8",
            "Why the newest failed exchange failed: the Pozyx's code, or 128 no end, "
            "129 bus, 130 refused without a code, 131 not a distance; 0: none has failed",
        ),
        Quantity("neighbours", "u8", "Nodes ranged within the last 8 to 16 s"),
        Quantity("team", "u8", "Nodes in the beacon in force; 0: none is heard"),
        Quantity("health", "u8", "What works", values=Health),
    ),
)

STEPS = Message(
    4,
    "steps",
    "Single steps, sent where SET_STEP_REPORTS asks for them (calibration and deadreckon).",
    (_time("Node clock when the frame was filled"),),
    Entries(
        "steps",
        "step",
        (
            Quantity(
                "age_s",
                "u16",
                "How long before the frame's time the mid-stance was",
                raw_name="age_ms",
            ),
            Quantity("length_m", "u16", "Step length", raw_name="length_mm"),
        ),
        most=10,
    ),
)

SAMPLES = Message(
    5,
    "samples",
    "Sensors before any calibration, in the axes of accelerometer and gyroscope; sent "
    "five times a second while SET_RAW_REPORTS asks for it. The node does not range meanwhile.",
    (
        _time("Node clock at the last sample"),
        *_vector("acceleration", "m_s2", "10um_s2", "Sum of the specific force over the samples"),
        *_vector("angular_rate", "rad_s", "10urad_s", "Sum of the angular rate over the samples"),
        *_vector(
            "field", "ut", "10pt", "Magnetic field, the newest reading since the previous report"
        ),
        Quantity("samples", "u8", "Number of inertial samples since the previous report"),
        Quantity(
            "field_readings", "u8", "Magnetometer readings since the previous report; 0: none"
        ),
    ),
)

COMMAND = Message(
    16,
    "command",
    "The host asks a node; repeating a token repeats the acknowledgement, not the effect.",
    (
        Quantity("token", "u16", "Chosen by the host, returned in the acknowledgement"),
        Quantity("command", "u8", "What to do", values=CommandCode),
        Quantity("value", "i32", "The command's argument"),
    ),
)

ACKNOWLEDGEMENT = Message(
    17,
    "acknowledgement",
    "A node's answer to a command.",
    (
        Quantity("token", "u16", "The command's token"),
        Quantity("command", "u8", "The command's code; unknown codes come back as they were"),
        Quantity("result", "u8", "How it ended", values=CommandResult),
        Quantity("value", "i32", "The value now in force"),
    ),
)

BEACON = Message(
    18,
    "beacon",
    "The coordinator tells everybody the team and the time: ids in the order of their slots, and "
    "how far the superframe is.",
    (
        Quantity(
            "phase_s",
            "u16",
            "Since the superframe began, when the frame leaves",
            raw_name="phase_ms",
        ),
        Quantity(
            "period_s", "u16", "Length of a superframe", raw_name="period_ms", low=200, high=60_000
        ),
        Quantity("round", "u8", "Counts the superframes", wraps=True),
    ),
    Entries("nodes", "slot", (Quantity("node", "u8", "Its id", low=1, high=254),), most=20),
)

NEW_KEY = Message(
    19,
    "new_key",
    "A node's own new key and the beacon's, hidden under its old one; answered like SET_KEY.",
    (
        Quantity("token", "u16", "Chosen by the host, returned in the acknowledgement"),
        *(Quantity(f"masked_{k}", "u32", "Words of both keys XOR the mask") for k in range(8)),
    ),
)

MESSAGES = (MOTION, RANGES, STATUS, STEPS, SAMPLES, COMMAND, ACKNOWLEDGEMENT, BEACON, NEW_KEY)
BY_NUMBER = {message.number: message for message in MESSAGES}
BY_NAME = {message.name: message for message in MESSAGES}
ENUMS = (ResetCause, MotionState, Quality, RangeQuality, Health, CommandCode, CommandResult)


def _words(
    label: str, count: int, unit: str, per_unit: int, meaning: str, low: int | None = None
) -> tuple[Quantity, ...]:
    return tuple(
        Quantity(
            label if count == 1 else f"{label}_{k}",
            "i16",
            meaning,
            unit=unit,
            per_unit=per_unit,
            low=low,
        )
        for k in range(count)
    )


CALIBRATION_PER_UNIT = 1 << 14
"""Of every calibration word but the hard iron's: one unit in all spares the Uno flash."""
CALIBRATION_GROUPS = {
    "acceleration_bias": _words(
        "acceleration_bias",
        3,
        "m/s^2",
        CALIBRATION_PER_UNIT,
        "Subtracted from the specific force, axis by axis",
    ),
    "gyro_bias": _words(
        "gyro_bias",
        3,
        "rad/s",
        CALIBRATION_PER_UNIT,
        "Subtracted from the angular rate, axis by axis",
    ),
    "acceleration_scale": _words(
        "acceleration_scale",
        3,
        "",
        CALIBRATION_PER_UNIT,
        "The specific force is then multiplied by 1 + this, axis by axis",
    ),
    "field_offset": _words(
        "field_offset", 3, "uT", 16, "Hard iron: subtracted from the field, axis by axis"
    ),
    "field_matrix": _words(
        "field_matrix",
        9,
        "",
        CALIBRATION_PER_UNIT,
        "Soft iron: the field is then multiplied by the unit matrix + this (3 x 3, row by row)",
    ),
    "gyro_bias_sigma": _words(
        "gyro_bias_sigma",
        1,
        "rad/s",
        CALIBRATION_PER_UNIT,
        "Standard deviation of what is left of the gyroscope's bias; 0: not calibrated",
        0,
    ),
}
"""A node's calibration: 16-bit words in this order, all in the axes of accelerometer and gyroscope.
All words zero change nothing. SET_CALIBRATION stages one word (value = index x 65536 + the word as
unsigned), COMMIT_CALIBRATION, whose value is the CRC of all staged words (little-endian, seeded
like a frame's), stores all of them and restarts the node with them; READ_CALIBRATION (value = index
x 65536) tells a word that is in force."""
CALIBRATION = tuple(word for group in CALIBRATION_GROUPS.values() for word in group)


def layout_text() -> str:
    """Everything that decides how bytes are read, as canonical text: the fingerprint's input."""

    def line(field: Quantity) -> str:
        return (
            f"{field.label} {field.wire} {field.per_unit} {field.unit} "
            f"{field.low} {field.high} {field.wraps}"
        )

    lines = [f"magic {MAGIC} version {PROTOCOL_VERSION} frame {FRAME_BYTES}"]
    lines += [f"header {line(f)}" for f in HEADER]
    for message in MESSAGES:
        lines += [f"{message.number} {message.name} {line(f)}" for f in message.fields]
        if message.entries is not None:
            lines += [
                f"{message.number} {message.name}[{message.entries.most}] {line(f)}"
                for f in message.entries.fields
            ]
    lines += [f"calibration {line(f)}" for f in CALIBRATION]
    for kind in ENUMS:
        lines += [f"{kind.__name__} {member.name} {member.value}" for member in kind]
    return "\n".join(lines) + "\n"


FINGERPRINT = int.from_bytes(hashlib.sha256(layout_text().encode()).digest()[:2], "big")
"""Seed of the CRC: the first two bytes of SHA-256 over :func:`layout_text`."""

MOST_BODY_BYTES = FRAME_BYTES - HEADER_BYTES - CRC_BYTES - TAG_BYTES
for _message in MESSAGES:
    if _message.most_bytes > MOST_BODY_BYTES:
        raise AssertionError(f"{_message.name} needs {_message.most_bytes} bytes: too long")
