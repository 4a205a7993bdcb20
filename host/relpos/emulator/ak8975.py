"""AKM AK8975 magnetometer as registers, after its data sheet (sources: docs/emulator.md).

It sits on the auxiliary bus of the MPU-9150: the host reaches it only while that chip bypasses.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .bus import I2cDevice
from .surroundings import FloatArray, MagneticErrors, Surroundings

ADDRESS = 0x0C
WIA = 0x00
ST1 = 0x02
HXL = 0x03
ST2 = 0x09
CNTL = 0x0A
ASTC = 0x0C
I2CDIS = 0x0F
ASAX = 0x10

POWER_DOWN = 0x0
SINGLE = 0x1
SELF_TEST = 0x8
FUSE_ROM = 0xF
DATA_READY = 0x01
DATA_ERROR = 0x04
OVERFLOW = 0x08

CONVERSION_US = 7_300
"""Typical conversion; the data sheet's most is 9 ms."""
SELF_TEST_UT = (0.0, 0.0, -180.0)
"""Field that the self-test coil makes, in the chip's axes: inside the data sheet's window."""


class Ak8975(I2cDevice):
    """The chip. ``reachable`` says whether the host's bus is joined to the auxiliary bus.

    ``accelerometer axes to chip axes``: chip x along accelerometer y, chip y along accelerometer
    x, chip z opposite to accelerometer z.
    """

    ut_per_lsb = 0.3
    most_raw = 4095
    overflow_ut = 2400.0
    """Sum of the three magnitudes at which HOFL is set."""
    wide = 0
    """The AK8963's bit for 16-bit output, in CNTL1 and ST2."""

    def __init__(
        self,
        surroundings: Surroundings,
        errors: MagneticErrors | None = None,
        reachable: Callable[[], bool] = lambda: True,
    ) -> None:
        self._surroundings = surroundings
        self._errors = errors or MagneticErrors()
        self._reachable = reachable
        self._gain = (np.array(self._errors.adjustment) + 128.0) / 256.0
        self._rng = np.random.default_rng([self._errors.seed, 3])
        self.time_us = 0
        self.conversion_us = CONVERSION_US
        self.spoil: Callable[[FloatArray], FloatArray] = lambda field: field
        """Fault: field (3,) in the chip's axes, microtesla -> what is measured instead."""
        self._begin()

    def power_cycle(self, time_us: int) -> None:
        """Supply off and on again (brown-out) at ``time_us``."""
        self.time_us = max(self.time_us, time_us)
        self._begin()

    def _begin(self) -> None:
        self._disabled = False
        self._mode = POWER_DOWN
        self._done_us: int | None = None
        self._data = bytes(6)
        self._st1 = 0
        self._st2 = 0
        self._astc = 0
        self._pointer = 0
        self._pointed = False

    def host_side(self) -> _HostSide:
        """The chip as the host's bus sees it, through the bypass."""
        return _HostSide(self, self._reachable)

    def advance(self, time_us: int) -> None:
        """Finish a conversion that is due."""
        self.time_us = max(self.time_us, time_us)
        if self._done_us is not None and self.time_us >= self._done_us:
            self._convert(self._done_us - self.conversion_us // 2)
            self._done_us = None
            self._mode = POWER_DOWN

    def _convert(self, time_us: int) -> None:
        field = self._surroundings.magnetic_field_at(time_us)
        chip = np.array((field[1], field[0], -field[2]))
        if self._mode == SELF_TEST and self._astc & 0x40:
            chip = np.array(SELF_TEST_UT)
        noise = self._errors.noise_ut * self._rng.standard_normal(3)
        chip = self._errors.soft_iron @ chip + self._errors.bias_ut + noise
        if not np.isfinite(chip).all():
            # A recording without magnetometer samples here: the conversion never ends.
            return
        chip = self.spoil(chip)
        counts = np.rint(chip / (self.ut_per_lsb * self._gain))
        self._data = counts.clip(-self.most_raw - 1, self.most_raw).astype("<i2").tobytes()
        self._st1 = DATA_READY
        self._st2 = OVERFLOW if np.abs(chip).sum() >= self.overflow_ut else 0

    def _set_mode(self, mode: int) -> None:
        if mode == POWER_DOWN:
            self._mode, self._done_us = POWER_DOWN, None
        elif self._mode not in (POWER_DOWN, mode) or mode not in (SINGLE, SELF_TEST, FUSE_ROM):
            # Between two modes lies power-down; the chip is left there and does nothing.
            self._mode, self._done_us = POWER_DOWN, None
        else:
            self._mode = mode
            if mode != FUSE_ROM:
                self._st1 = 0
                self._done_us = self.time_us + self.conversion_us

    def _read_register(self, address: int) -> int:
        if address == WIA:
            return 0x48
        if address == ST1:
            return self._st1
        if HXL <= address < ST2:
            if self._done_us is not None:
                self._st2 |= DATA_ERROR
            self._st1 = 0
            return self._data[address - HXL]
        if address == ST2:
            value, self._st2, self._st1 = self._st2, 0, 0
            return value | self.wide
        if address == CNTL:
            return self._mode | self.wide
        if address == ASTC:
            return self._astc
        if ASAX <= address < ASAX + 3 and self._mode == FUSE_ROM:
            return self._errors.adjustment[address - ASAX]
        return 0

    def _write_register(self, address: int, value: int) -> None:
        if address == CNTL:
            self._set_mode(value & 0x0F)
        elif address == ASTC:
            self._astc = value & 0x40
        elif address == I2CDIS and value & 1:
            self._disabled = True

    def start(self, read: bool) -> bool:
        """Acknowledged unless I2CDIS was set."""
        if not read:
            self._pointed = False
        return not self._disabled

    def write(self, byte: int) -> bool:
        """Register number first, then its data."""
        if not self._pointed:
            self._pointer = byte
            self._pointed = True
        else:
            self._write_register(self._pointer, byte)
            self._next()
        return True

    def read(self) -> int:
        """Next register; the two groups 0x00-0x0C and 0x10-0x12 wrap in themselves."""
        value = self._read_register(self._pointer)
        self._next()
        return value

    def _next(self) -> None:
        wrap = {0x0C: 0x00, 0x12: 0x10}
        self._pointer = wrap.get(self._pointer, self._pointer + 1)


class Ak8963(Ak8975):
    """The MPU-9250's compass: 14 bits of 0.6 uT, or 16 of 0.15 uT where bit 4 of CNTL1 is set.

    Its continuous modes are not emulated. Compared with the maker's own self-test for it: that
    reads 16 from ST2 at 16 bits and asks for -3200 to -800 along z; and with LibDriver's and
    M5Stack's drivers: 0.6 and 0.15 uT, CNTL1, ASA.
    """

    ut_per_lsb = 0.6
    most_raw = 8190
    overflow_ut = 4912.0

    def _write_register(self, address: int, value: int) -> None:
        if address == CNTL:
            self.wide = value & 0x10
            self.ut_per_lsb, self.most_raw = (0.15, 32760) if self.wide else (0.6, 8190)
        super()._write_register(address, value)


class _HostSide(I2cDevice):
    """Answers only while the MPU-9150 bypasses."""

    def __init__(self, chip: Ak8975, reachable: Callable[[], bool]) -> None:
        self._chip = chip
        self._reachable = reachable

    def advance(self, time_us: int) -> None:
        self._chip.advance(time_us)

    def start(self, read: bool) -> bool:
        return self._reachable() and self._chip.start(read)

    def write(self, byte: int) -> bool:
        return self._reachable() and self._chip.write(byte)

    def read(self) -> int:
        return self._chip.read() if self._reachable() else 0xFF

    def stop(self) -> None:
        self._chip.stop()
