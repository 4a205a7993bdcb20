"""Every fault that can be injected: :data:`FAULTS`, and why others are refused: :data:`REFUSED`.

This table alone says which faults exist, which keys each takes and what node and host must do
about it. `docs/reliability.md` prints it beside what was measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Key:
    """A parameter of a fault besides node, from and to: a number, or one of ``choices``."""

    name: str
    meaning: str
    default: float | str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Fault:
    """One line of the table.

    ``team`` faults concern all nodes and take no node; ``whole_run`` ones take neither from nor to,
    ``momentary`` ones happen at ``from`` and take no to. ``must`` is what node and host have to do.
    """

    target: str
    behaviour: str
    meaning: str
    must: str
    keys: tuple[Key, ...] = ()
    team: bool = False
    whole_run: bool = False
    momentary: bool = False
    coordinator: bool = False
    """Whether node=0, the coordinator, can have it."""

    @property
    def name(self) -> str:
        """As it is written: TARGET:BEHAVIOUR."""
        return f"{self.target}:{self.behaviour}"

    def key_names(self) -> list[str]:
        """Every key that it takes."""
        names = [] if self.team else ["node"]
        if not self.whole_run:
            names += ["from"] if self.momentary else ["from", "to"]
        return names + [key.name for key in self.keys]


TARGETS: Mapping[str, str] = {
    "imu": "accelerometer and gyroscope of the MPU-9150 (off and brownout: with the magnetometer)",
    "magnetometer": "the AK8975 in the same package",
    "pozyx": "the UWB tag",
    "xbee": "a radio module and its serial line (node=0: the coordinator's)",
    "clock": "a board's oscillator",
    "radio": "the air between the XBee modules",
    "uwb": "the air between the tags",
    "bus": "a node's I2C bus",
    "node": "a whole node",
    "eeprom": "a board's non-volatile memory",
    "host": "the laptop at the coordinator's serial port",
}

_FRACTION = Key("rate", "fraction of them", 0.3, "", 0.0, 1.0)
_ANSWER = Key("value", "what it answers", "random", choices=("random", "zeros", "ones"))


def _ms(meaning: str, default: float) -> Key:
    return Key("value", meaning, default, "ms", 0.0, 60_000.0)


def _s(meaning: str, default: float) -> Key:
    return Key("value", meaning, default, "s", 0.0, 600.0)


_FLAGGED = "IMU_GAP flagged, nothing integrated, the gap charged as variance; back within 3 s"
_GYRO_ONLY = "dead reckoning goes on by the gyroscope, no magnetic heading is reported"
_NO_RANGES = "motion unharmed; failures counted, no wrong range; ranges again within two periods"
_RADIO = "0 motion lost: the next frame's totals hold all"

FAULTS: tuple[Fault, ...] = (
    Fault("imu", "off", "no supply: does not answer, restarts with reset registers", _FLAGGED),
    Fault("imu", "stuck", "the sample stays as it is, still announced as new", _FLAGGED),
    Fault("imu", "garbage", "every byte that it answers is wrong", _FLAGGED, (_ANSWER,)),
    Fault(
        "imu",
        "wrong",
        "angular rate off by a constant about each axis",
        "not observable from inside: goes on, bias learned while standing and walking straight",
        (Key("value", "error", 1.0, "deg/s", -500.0, 500.0),),
    ),
    Fault(
        "imu",
        "slow",
        "gives only a fraction of its samples",
        "missed ticks counted and flagged, the longer steps integrated",
        (Key("rate", "fraction of the samples that come", 0.5, "", 0.0, 1.0),),
    ),
    Fault(
        "imu",
        "delayed",
        "samples are handed out late",
        "not observable from inside: motion is late by as much, none is lost",
        (_ms("delay", 100.0),),
    ),
    Fault(
        "imu",
        "intermittent",
        "does not answer a fraction of the transactions (loose contact)",
        "bus errors and missed ticks counted and flagged, the rest integrated",
        (_FRACTION,),
    ),
    Fault(
        "imu",
        "brownout",
        "its supply dips: registers are those of a reset, it sleeps",
        "set up anew within 0.5 s, gap flagged",
        momentary=True,
    ),
    Fault("magnetometer", "off", "does not answer", _GYRO_ONLY),
    Fault(
        "magnetometer",
        "stuck",
        "the field stays as it is, still announced as new",
        f"noticed within 2 s; {_GYRO_ONLY}",
    ),
    Fault("magnetometer", "garbage", "every byte that it answers is wrong", _GYRO_ONLY, (_ANSWER,)),
    Fault(
        "magnetometer",
        "wrong",
        "a magnet beside it: the field is off by a constant on each axis",
        "MAGNETOMETER_DISTURBED flagged, heading not corrected by it",
        (Key("value", "offset", 60.0, "uT", -1000.0, 1000.0),),
    ),
    Fault(
        "magnetometer",
        "slow",
        "a conversion takes longer",
        _GYRO_ONLY,
        (_ms("conversion", 40.0),),
    ),
    Fault(
        "magnetometer",
        "intermittent",
        "does not answer a fraction of the transactions",
        "headings that are reported are true; motion unharmed",
        (_FRACTION,),
    ),
    Fault("pozyx", "off", "no supply: does not answer, restarts", _NO_RANGES),
    Fault("pozyx", "stuck", "reports the same row again for every exchange", _NO_RANGES),
    Fault("pozyx", "garbage", "every byte that it answers is wrong", _NO_RANGES, (_ANSWER,)),
    Fault(
        "pozyx",
        "wrong",
        "ranges that it begins are off by a constant",
        "not observable from inside: the fusion weighs what contradicts the motion",
        (Key("value", "error", 2.0, "m", -100.0, 100.0),),
    ),
    Fault(
        "pozyx",
        "slow",
        "an exchange takes longer: over the node's 100 ms it is busy when asked again",
        _NO_RANGES,
        (_ms("longer by", 150.0),),
    ),
    Fault(
        "pozyx",
        "delayed",
        "the end of an exchange is reported late: over 100 ms in the middle of the next one",
        "a completion is never taken for another exchange's; no wrong range",
        (_ms("delay", 110.0),),
    ),
    Fault(
        "pozyx",
        "intermittent",
        "does not answer a fraction of the transactions",
        "failures counted, the ranges that come are true",
        (_FRACTION,),
    ),
    Fault(
        "pozyx",
        "inverted",
        "reports failure for success and success for failure (seen in the field)",
        _NO_RANGES,
    ),
    Fault(
        "pozyx",
        "brownout",
        "its supply dips: registers are those of a reset, it boots",
        "set up anew, ranges again within 15 s",
        momentary=True,
    ),
    Fault("xbee", "off", "neither sends nor receives", _RADIO, coordinator=True),
    Fault(
        "xbee",
        "stuck",
        "sends, but its own line to the board is dead: no status, no commands",
        "frames without status counted as failed, reports go on, slower",
        coordinator=True,
    ),
    Fault("xbee", "garbage", "every byte on its serial line is random", _RADIO, coordinator=True),
    Fault(
        "xbee",
        "wrong",
        "reports every delivered frame as failed",
        "radio failures counted, no motion twice",
        coordinator=True,
    ),
    Fault(
        "xbee",
        "slow",
        "the transmit status comes late",
        "frames without status counted as failed, reports go on, slower",
        (_ms("delay", 300.0),),
        coordinator=True,
    ),
    Fault(
        "xbee",
        "delayed",
        "frames are held before they go out",
        "dated by the node's clock all the same: times of motion and ranges stay true",
        (_s("delay", 3.0),),
        coordinator=True,
    ),
    Fault(
        "xbee",
        "intermittent",
        "loses a fraction of the serial frames, in both directions",
        _RADIO,
        (_FRACTION,),
        coordinator=True,
    ),
    Fault(
        "xbee",
        "bitflip",
        "bits of the serial line are turned over",
        f"refused by checksum; {_RADIO}",
        (Key("rate", "fraction of the bytes", 0.01, "", 0.0, 1.0),),
        coordinator=True,
    ),
    Fault(
        "xbee",
        "truncate",
        "bytes of the serial line are missing",
        f"refused by length and checksum; {_RADIO}",
        (Key("rate", "fraction of the bytes", 0.01, "", 0.0, 1.0),),
        coordinator=True,
    ),
    Fault(
        "xbee",
        "duplicate",
        "bytes of the serial line come twice",
        f"refused by length and checksum; {_RADIO}",
        (Key("rate", "fraction of the bytes", 0.01, "", 0.0, 1.0),),
        coordinator=True,
    ),
    Fault(
        "xbee",
        "brownout",
        "its supply dips: what it held is lost, it reports its reset",
        _RADIO,
        momentary=True,
        coordinator=True,
    ),
    Fault(
        "clock",
        "off",
        "the oscillator stops; above 1 s the watchdog, which has its own, resets the node",
        "restart with cause WATCHDOG and the next boot count; the host widens the first motion",
    ),
    Fault(
        "clock",
        "wrong",
        "off by a constant (a ceramic resonator may be by 5000 ppm)",
        "the host follows it: times stay true",
        (Key("value", "error", 5000.0, "ppm", -50_000.0, 50_000.0),),
        whole_run=True,
    ),
    Fault(
        "clock",
        "intermittent",
        "stands for a moment every second",
        "as much is lost as it stands, of motion and of the node's time; no hang, no reset",
        (_ms("each time", 60.0),),
    ),
    Fault(
        "clock",
        "wrap",
        "the 32-bit microsecond timer wraps at `from`",
        "no effect is observable",
        momentary=True,
    ),
    Fault(
        "radio",
        "loss",
        "frames are lost",
        _RADIO,
        (Key("rate", "fraction", 0.5, "", 0.0, 1.0),),
    ),
    Fault(
        "radio",
        "bitflip",
        "frames arrive with a bit turned over, under a right XBee checksum",
        f"refused, counted; {_RADIO}",
        (_FRACTION,),
    ),
    Fault(
        "radio",
        "truncate",
        "frames arrive cut, under a right XBee checksum",
        f"refused, counted; {_RADIO}",
        (_FRACTION,),
    ),
    Fault(
        "radio",
        "duplicate",
        "frames arrive twice",
        "the second counted and refused; no motion, range or command twice",
        (_FRACTION,),
    ),
    Fault(
        "radio",
        "reorder",
        "frames are held back and overtaken",
        "late motion is not used; ranges are, at their time; 0 motion lost",
        (_FRACTION, _s("held for", 2.5)),
    ),
    Fault(
        "radio",
        "replay",
        "frames are recorded and sent again later",
        "refused, counted; no motion, range or command twice",
        (_FRACTION, _s("later by", 20.0)),
    ),
    Fault(
        "radio",
        "foreign",
        "a foreign module sends motion, ranges, commands and beacons in every node's name",
        "with another key: refused and counted by node and host, nothing changes. With what a "
        "stolen node holds: the same, but for its beacons, after which the team ranges without",
        (
            Key("key", "whose", "wrong", choices=("wrong", "stolen")),
            Key("rate", "frames a second", 5.0, "1/s", 0.1, 20.0),
        ),
        team=True,
    ),
    Fault("radio", "delayed", "frames are held", f"times stay true; {_RADIO}", (_s("for", 2.0),)),
    Fault(
        "uwb",
        "collisions",
        "foreign tags range within reach",
        "failures counted, no wrong range; motion unharmed",
        (Key("rate", "exchanges of foreign tags a second", 15.0, "1/s", 0.0, 50.0),),
        team=True,
    ),
    Fault(
        "uwb",
        "loss",
        "exchanges get no answer",
        "failures counted, ranges go on",
        (Key("rate", "fraction", 0.5, "", 0.0, 1.0),),
        team=True,
    ),
    Fault(
        "uwb",
        "wrong",
        "the direct path is blocked: ranges are too long",
        "not observable from inside: the fusion weighs what contradicts the motion",
        (_FRACTION, Key("value", "at most longer by", 3.0, "m", 0.0, 100.0)),
        team=True,
    ),
    Fault(
        "bus",
        "stuck",
        "a line is held: SDA until nine clocks free it, SCL for as long as the fault lasts",
        "no hang: every transaction ends in 1 ms, bus errors counted, chips set up anew",
        (Key("line", "which", "scl", choices=("sda", "scl")),),
    ),
    Fault(
        "bus",
        "nack",
        "a fraction of all transactions is not acknowledged",
        "bus errors counted, gaps flagged, no wrong value used",
        (_FRACTION, Key("part", "which acknowledge", "address", choices=("address", "data"))),
    ),
    Fault(
        "node",
        "brownout",
        "the supply dips: the board restarts, its RAM is lost",
        "next boot count, cause BROWN_OUT; at most the last unreported second and the restart lost",
        (Key("chips", "what the dip does to the chips", "reset", choices=("reset", "kept")),),
        momentary=True,
    ),
    Fault(
        "node",
        "off",
        "the battery is out",
        "next boot count, cause POWER_ON; the others' ranging goes on; first motion widened",
    ),
    Fault(
        "eeprom",
        "cut",
        "the supply is cut in the middle of a write after `from`",
        "settings are the old or the new ones, counters never go back, the node starts",
        (
            Key("write", "which byte written from then on", 1.0, "", 1.0, 100_000.0),
            Key("left", "what the cut leaves of the byte", "erased",
                choices=("erased", "old", "garbage")),
        ),
        momentary=True,
    ),
    Fault(
        "host",
        "gone",
        "no host reads the port or sends to it",
        "ranging goes on without beacon; the first motion after it holds all: 0 motion lost",
        team=True,
    ),
    Fault(
        "host",
        "delayed",
        "the laptop sleeps: what has come arrives at once when it wakes",
        "times stay true by the nodes' clocks; 0 motion lost",
        team=True,
    ),
)  # fmt: skip

BY_NAME: Mapping[tuple[str, str], Fault] = {(f.target, f.behaviour): f for f in FAULTS}

_STREAM = "what is lost, doubled or overtaken on the air is radio:%s"
REFUSED: Mapping[tuple[str, str], str] = {
    ("magnetometer", "delayed"): "it measures only when asked: a late answer is magnetometer:slow",
    ("magnetometer", "brownout"): "it has the MPU-9150's supply: imu:brownout",
    ("xbee", "reorder"): f"a serial line keeps its order; {_STREAM % 'reorder'}",
    ("xbee", "replay"): f"a serial line keeps its order; {_STREAM % 'replay'}",
    ("xbee", "loss"): f"{_STREAM % 'loss'}, bytes missing on the line xbee:truncate",
    ("xbee", "foreign"): f"no other device is on the line; {_STREAM % 'foreign'}",
    ("clock", "stuck"): "a processor whose clock stands executes nothing: clock:off",
    ("clock", "garbage"): "a board knows no other time to have garbage beside: clock:wrong",
    ("clock", "slow"): "that is clock:wrong with a negative value",
    (
        "clock",
        "delayed",
    ): "no part waits for a clock's answer: one that halts is clock:intermittent",
    ("radio", "off"): "air cannot be: xbee:off, or radio:loss:rate=1",
    ("uwb", "off"): "air cannot be: pozyx:off, or uwb:loss:rate=1",
    ("uwb", "garbage"): "frames are protected by the tags' own checks: pozyx:garbage",
    ("node", "stuck"): "a node that executes nothing is clock:off",
    ("bus", "off"): "that is bus:stuck",
}
