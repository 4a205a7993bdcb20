"""The bus: which chips answer, as what, how often, and how fast the lines rise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import fmean

from relpos.nodes.bringup.bus_access import MOST_READ, BusAccess
from relpos.nodes.bringup.finding import BUS, COMPASS, IMU, POZYX, Finding

IMU_ADDRESS, COMPASS_ADDRESS, POZYX_ADDRESS = 0x68, 0x0C, 0x4B
WHO_AM_I = 0x75
PIN_CONFIG, BYPASS = 0x37, 0x02
SAMPLE_DIVIDER, DIVIDER_IN_USE = 0x19, 19
"""What the firmware writes once it has recognised the sensor that it is built for."""
SAMPLE = 0x3B
PROBES = 16
"""With a contact that fails one time in three, all succeed once in 650 times."""
IMU_NAMES = {0x68: "MPU-9150", 0x71: "MPU-9250", 0x73: "MPU-9255"}
OTHER_NAMES = {0x70: "MPU-6500 (no compass)", 0x74: "MPU-6515 (no compass)", 0x12: "ICM-20602",
               0x98: "ICM-20689", 0xEA: "ICM-20948"}  # fmt: skip
COMPASS_IDENTITY, POZYX_IDENTITY = 0x48, 0x43
TIMINGS = 8
BYTE_US = 25.2
"""A byte at 400 kHz with the firmware's work between two, lines without capacitance (simavr)."""
SLOW_BYTE_US = 60.0
"""Above it the bus is a build with 100 kHz, whose bytes take 90 us."""
RISE_LIMIT_NS = 300
"""Fast mode's limit (I2C specification)."""
RELEASED_US = 1_000
"""The firmware gives up a transaction after that time: a line is held."""


@dataclass
class Chip:
    """What the probes of one chip's identity gave."""

    part: str
    address: int
    identity: int | None = None
    """Its most frequent answer; None where it never answered."""
    others: int = 0
    """Answers that differed."""
    failed: int = 0
    held: int = 0

    @property
    def steady(self) -> bool:
        """Whether it always answered, and the same."""
        return self.identity is not None and not (self.failed or self.others)


@dataclass
class BusFindings:
    """Of :func:`probe`: the chips by part, and the bus' own timing."""

    chips: dict[str, Chip] = field(default_factory=dict)
    byte_us: float = 0.0
    """Of a byte; 0 where the board does not tell."""
    start_us: float = 0.0
    """Of start, stop and the work around them."""
    usable: bool = True
    """Whether not the bus as a whole fails, rather than a chip."""


def probe(bus: BusAccess) -> BusFindings:
    """Ask each chip many times who it is, and time reads of two lengths."""
    found = BusFindings()
    places = (
        (IMU, IMU_ADDRESS, WHO_AM_I),
        (COMPASS, COMPASS_ADDRESS, 0),
        (POZYX, POZYX_ADDRESS, 0),
    )
    for part, address, register in places:
        chip = found.chips[part] = Chip(part, address)
        answers: Counter[int] = Counter()
        for _ in range(PROBES):
            asked = bus.transfer(address, register, read=1)
            if asked.answered:
                answers[asked.data[1]] += 1
            else:
                chip.failed += 1
                chip.held += asked.took_us >= RELEASED_US
        if answers:
            chip.identity, most = answers.most_common(1)[0]
            chip.others = answers.total() - most
    failing = [chip for chip in found.chips.values() if chip.failed]
    answering = [chip for chip in found.chips.values() if chip.identity is not None]
    found.usable = bool(answering) and len([c for c in failing if c in answering]) <= 1
    reader = next((chip for chip in answering if chip.part == IMU and chip.steady), None)
    if reader is not None:
        times = [
            fmean(bus.transfer(reader.address, SAMPLE, read=n).took_us for _ in range(TIMINGS))
            for n in (1, MOST_READ)
        ]
        found.byte_us = (times[1] - times[0]) / (MOST_READ - 1)
        found.start_us = times[0] - 4 * found.byte_us if found.byte_us else 0.0
    return found


def bus_findings(found: BusFindings, figures: dict[str, object]) -> Iterator[Finding]:
    """Whether it is the bus as a whole that is wrong, and its pull-ups."""
    chips = found.chips.values()
    if all(chip.identity is None for chip in chips):
        held = any(chip.held for chip in chips)
        yield Finding(
            BUS,
            False,
            "a line is held low" if held else "no chip answers",
            "SDA and SCL exchanged, touching each other or GND? The level shifter's two supplies "
            "and GND? Take one chip after the other off the bus",
        )
        return
    if not found.usable:
        failed = sum(chip.failed for chip in chips if chip.identity is not None)
        yield Finding(
            BUS,
            False,
            f"{failed} of {PROBES * len(found.chips)} transactions failed, at several chips",
            "SDA, SCL and GND: loose contacts, long or parallel wires; pull-ups (docs/hardware.md)",
        )
        return
    if not found.byte_us:
        yield Finding(BUS, True, "transactions are answered; this board does not time them")
        return
    hz = 100_000 if found.byte_us > SLOW_BYTE_US else 400_000
    if hz == 100_000:
        yield Finding(BUS, True, f"{found.byte_us:.1f} us a byte: a build for 100 kHz")
        return
    rise_ns = max(0.0, (found.byte_us - BYTE_US) / 9.0 * 1e3)
    figures["bus_rise_ns"] = rise_ns
    yield Finding(
        BUS,
        rise_ns < RISE_LIMIT_NS,
        f"{found.byte_us:.1f} us a byte: its lines rise within {rise_ns:.0f} ns",
        f"over {RISE_LIMIT_NS} ns: stronger pull-ups (docs/hardware.md), shorter wires, or "
        "firmware with -DRELPOS_TWI_HZ=100000",
    )


def chip_finding(chip: Chip, names: dict[int, str], elsewhere: str, bus: BusAccess) -> Finding:
    """Whether a chip answers always, as what it should be. ``elsewhere``: what a strap may do."""
    if chip.identity is None:
        hint = "its supply, SDA, SCL and GND"
        if chip.part != COMPASS and bus.transfer(chip.address ^ 1, 0, read=1).answered:
            hint = elsewhere
        return Finding(chip.part, False, f"no answer at 0x{chip.address:02X}", hint)
    if chip.failed:
        return Finding(
            chip.part,
            False,
            f"{chip.failed} of {PROBES} transactions are not answered",
            "a loose contact at this chip, or its supply",
        )
    if chip.others:
        return Finding(
            chip.part,
            False,
            "answers differently each time",
            "a disturbed line at this chip, or a defective one",
        )
    if chip.identity not in names:
        what = OTHER_NAMES.get(chip.identity, "no chip that is known here")
        return Finding(
            chip.part,
            False,
            f"says that it is 0x{chip.identity:02X}: {what}",
            "another chip than docs/hardware.md asks for, or a disturbed or defective one",
        )
    return Finding(chip.part, True, f"{names[chip.identity]} at 0x{chip.address:02X}")
