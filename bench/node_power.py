"""What a node draws, and how long a battery lasts.

Every current is an assumption with its source; none was measured by this project. Linear regulators
pass the current on: a part draws the same from 5 V as from its 3.3 V.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

SUPPLY_V = 5.0
USABLE = 0.9
"""Share of the rated capacity until the supply sags (assumed: room temperature, half-new cells)."""


@dataclass(frozen=True)
class Part:
    """One part's mean current from the 5 V rail while the node works."""

    name: str
    current_ma: float
    source: str


ATMEGA_ACTIVE_MA = 9.0
ATMEGA_IDLE_MA = 2.7
BUSY_SHARE = 0.25
"""What `make firmware` allows for the mean of a 50 Hz tick."""


def microcontroller_ma(busy_share: float = BUSY_SHARE) -> float:
    """Mean current of the ATmega328P that sleeps (idle mode) for the rest of each tick."""
    return busy_share * ATMEGA_ACTIVE_MA + (1.0 - busy_share) * ATMEGA_IDLE_MA


UNO = Part(
    "Arduino Uno R3 without its ATmega328P",
    37.0,
    "USB chip, regulator, power LED: whole board 45 to 50 mA idle [from memory: check]",
)
MEGA = Part(
    "Arduino Mega 2560",
    75.0,
    "whole board, 70 to 80 mA [from memory: check]",
)
MICROCONTROLLER = Part(
    "ATmega328P, 5 V, 16 MHz, a quarter of the time busy",
    microcontroller_ma(),
    "9 mA active, 2.7 mA idle [data sheet's typical curves, from memory: check]",
)
SENSOR = Part(
    "MPU-9150 breakout",
    4.5,
    "gyroscope and accelerometer 3.9 mA, compass 0.35 mA at 8 Hz [data sheet, from memory: check]; "
    "the breakout's regulator 0.2 mA (assumed)",
)
POZYX = Part(
    "Pozyx tag shield",
    200.0,
    "DW1000 listening all the time 120 to 160 mA, STM32F4 and sensors 40 mA [data sheets, from "
    "memory: check]",
)
XBEE = Part(
    "XBee Series 1 (1 mW) on its shield",
    52.0,
    "receiving 50 mA, transmitting 45 mA [data sheet, from memory: check]; shield's LEDs 2 mA "
    "(assumed)",
)
UNO_NODE: tuple[Part, ...] = (UNO, MICROCONTROLLER, SENSOR, POZYX, XBEE)
MEGA_NODE: tuple[Part, ...] = (MEGA, SENSOR, POZYX, XBEE)


def total_ma(parts: Sequence[Part]) -> float:
    """Mean current from the 5 V rail."""
    return sum(part.current_ma for part in parts)


@dataclass(frozen=True)
class Battery:
    """A battery, and what makes 5 V of it.

    ``efficiency`` of a switching converter; None for a linear regulator, which burns what is over
    5 V and passes the current on.
    """

    name: str
    capacity_mah: float
    voltage_v: float
    efficiency: float | None

    def life_h(self, load_ma: float) -> float:
        """Hours at a steady load on the 5 V rail."""
        if self.efficiency is None:
            drawn_ma = load_ma
        else:
            drawn_ma = load_ma * SUPPLY_V / (self.voltage_v * self.efficiency)
        return USABLE * self.capacity_mah / drawn_ma

    def burnt_w(self, load_ma: float) -> float:
        """Heat in the regulator or converter, watts."""
        if self.efficiency is None:
            return (self.voltage_v - SUPPLY_V) * load_ma / 1000.0
        return SUPPLY_V * load_ma / 1000.0 * (1.0 / self.efficiency - 1.0)


BATTERIES: tuple[Battery, ...] = (
    Battery("USB power bank, 2,200 mAh (one 18650 cell)", 2200, 3.7, 0.85),
    Battery("USB power bank, 5,000 mAh", 5000, 3.7, 0.85),
    Battery("USB power bank, 10,000 mAh", 10000, 3.7, 0.85),
    Battery("LiPo 2S 7.4 V, 2,000 mAh, at the Uno's Vin", 2000, 7.4, None),
    Battery("LiPo 1S 3.7 V, 2,500 mAh, with a 5 V step-up converter", 2500, 3.7, 0.88),
    Battery("9 V block (alkaline), 500 mAh, at the Uno's Vin", 500, 9.0, None),
)
REGULATOR_W = 1.0
"""What the Uno's own regulator can get rid of without a heat sink [SOT-223, from memory: check]."""
