"""InvenSense MPU-9250: the MPU-9150's successor, by what differs in its register map.

CONFIG filters the gyroscope alone, ACCEL_CONFIG_2 the accelerometer; power-on finds it awake. Its
compass is the AK8963 (:class:`relpos.emulator.ak8975.Ak8963`).

Compared with two public drivers that share no code, LibDriver's mpu9250 and M5Stack's: registers,
bandwidths, identity 0x71, ranges, self-tests. 0x73 of the MPU-9255: atabakp's driver.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from .mpu9150 import ACCEL_CONFIG_2, Filtering, Mpu9150

_ACCELEROMETER_BANDWIDTH_HZ = (218.1, 218.1, 99.0, 44.8, 21.2, 10.2, 5.05, 420.0)
_GYROSCOPE_BANDWIDTH_HZ = (250.0, 184.0, 92.0, 41.0, 20.0, 10.0, 5.0, 250.0)
_UNFILTERED_HZ = 490.0
"""Stated: 1046 Hz, more than the model's kilohertz carries."""


class Mpu9250(Mpu9150):
    """The chip."""

    identity = 0x71
    power_on_management = 0x01
    factory_codes: ClassVar[Mapping[int, int]] = {
        0x00: 0x61, 0x01: 0x58, 0x02: 0x6A, 0x0D: 0x70, 0x0E: 0x7C, 0x0F: 0x66,
    }  # fmt: skip

    def _filtering(self, config: int) -> Filtering:
        chosen = self._registers[ACCEL_CONFIG_2]
        unfiltered = chosen & 0x08
        accelerometer = _UNFILTERED_HZ if unfiltered else _ACCELEROMETER_BANDWIDTH_HZ[chosen & 7]
        return accelerometer, _GYROSCOPE_BANDWIDTH_HZ[config], 0.0

    def _self_test_response(self) -> tuple[list[float], list[float]]:
        def counts(address: int) -> float:
            return float(2620.0 * 1.01 ** (self.factory_codes[address] - 1))

        force_g = [counts(0x0D + axis) / 16384.0 for axis in range(3)]
        return force_g, [counts(axis) / 131.0 for axis in range(3)]
