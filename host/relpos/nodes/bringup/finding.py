"""What a check of a freshly wired node finds, line by line."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """``part`` is right (True), wrong (False) or could not be checked (None); ``remedy``: to do."""

    part: str
    right: bool | None
    found: str
    remedy: str = ""


BUS = "I2C bus"
IMU = "inertial sensor"
GYROSCOPE = "gyroscope"
ACCELEROMETER = "accelerometer"
SAMPLES = "samples"
COMPASS = "compass"
POZYX = "Pozyx"
PRESSURE = "pressure"
RANGING = "ranging"
RADIO = "XBee radio"
SUPPLY = "supply"
LOOP = "processor"
