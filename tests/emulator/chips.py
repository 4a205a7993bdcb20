"""Helpers for the chip tests: constant or given surroundings, and plain register access."""

from __future__ import annotations

import numpy as np

from relpos.emulator.bus import BusStatus, I2cBus, I2cDevice
from relpos.emulator.surroundings import Surroundings

GRAVITY = 9.80665


def constant(
    force=(0.0, 0.0, GRAVITY),
    rate=(0.0, 0.0, 0.0),
    field=(20.0, 5.0, -40.0),
    pressure=100_000.0,
    temperature_c=31.0,
):
    return Surroundings(
        rate_hz=200.0,
        specific_force_m_s2=np.tile(np.array(force, dtype=float), (4, 1)),
        angular_rate_rad_s=np.tile(np.array(rate, dtype=float), (4, 1)),
        magnetic_field_ut=np.tile(np.array(field, dtype=float), (4, 1)),
        pressure_pa=np.full(4, pressure),
        temperature_c=temperature_c,
    )


def of_signal(seconds, force=None, rate=None, rate_hz=200.0):
    """Surroundings whose accelerometer x and gyroscope x follow functions of time."""
    time_s = np.arange(int(seconds * rate_hz)) / rate_hz
    zero = np.zeros_like(time_s)
    return Surroundings(
        rate_hz=rate_hz,
        specific_force_m_s2=np.column_stack((force(time_s) if force else zero, zero, zero)),
        angular_rate_rad_s=np.column_stack((rate(time_s) if rate else zero, zero, zero)),
        magnetic_field_ut=np.zeros((len(time_s), 3)),
        pressure_pa=np.full(len(time_s), 100_000.0),
    )


class Host:
    """A bus with one master that writes and reads registers, by bytes or by transactions."""

    def __init__(self, *chips: tuple[int, I2cDevice], by_bytes=False):
        self.bus = I2cBus()
        self.by_bytes = by_bytes
        for address, chip in chips:
            self.bus.attach(address, chip)

    def at(self, time_us):
        self.bus.time_us = int(time_us)
        return self

    def transfer(self, address, first, second, count):
        if not self.by_bytes:
            return self.bus.transfer(address, first, second, count)
        bus = self.bus
        status = BusStatus.OK
        data = b""
        for part in (first, second) if second else (first,):
            if status is BusStatus.OK and (part or not count):
                if not bus.start(address, False):
                    status = BusStatus.ADDRESS_NACK
                elif not all(bus.write(byte) for byte in part):
                    status = BusStatus.DATA_NACK
        if status is BusStatus.OK and count:
            if bus.start(address, True):
                data = bytes(bus.read() for _ in range(count))
            else:
                status = BusStatus.ADDRESS_NACK
        bus.stop()
        return status, data

    def read(self, address, register, count=1):
        status, data = self.transfer(address, bytes([register]), b"", count)
        assert status == BusStatus.OK, status
        return data

    def byte(self, address, register):
        return self.read(address, register)[0]

    def write(self, address, register, *values):
        status, _ = self.transfer(address, bytes([register, *values]), b"", 0)
        assert status == BusStatus.OK, status


def words(data, order="big"):
    return [int.from_bytes(data[k : k + 2], order, signed=True) for k in range(0, len(data), 2)]
