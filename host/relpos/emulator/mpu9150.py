"""InvenSense MPU-9150 (the MPU-6050 die) and MPU-9250 as registers, after their data sheets.

The chip feels :class:`Surroundings` through :class:`InertialErrors`, filters at 1 kHz as CONFIG
says, samples at its own clock and quantises at the range that is configured at that moment, so
that a driver with a wrong range or rate reads wrong values. All of it is computed in blocks ahead
of time; reading a sample costs one look-up.

Choices where the sources are silent, to be checked on hardware: INT_STATUS shows only enabled
interrupts; the DLPF is a second-order Butterworth of the stated bandwidth, plus the whole
milliseconds that the stated delay is longer than that filter's (stated/modelled delay in ms for
DLPF_CFG 1 to 6: 2.0/2.2, 3.0/3.4, 4.9/5.1, 8.5/10.7, 13.8/22.5, 19.0/45).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping
from functools import cache
from typing import ClassVar

import numpy as np
from scipy.linalg.lapack import dtbtrs

from .bus import BusStatus, I2cDevice
from .surroundings import FloatArray, InertialErrors, Surroundings

ADDRESS = 0x68
WHO_AM_I = 0x68

SELF_TEST = 0x0D
"""X, Y, Z and A: factory codes of the self-tests, five bits an axis (on the MPU-9250 eight)."""
SMPLRT_DIV = 0x19
CONFIG = 0x1A
GYRO_CONFIG = 0x1B
ACCEL_CONFIG = 0x1C
ACCEL_CONFIG_2 = 0x1D
"""Of the MPU-9250; on the MPU-9150 it has no function here."""
FIFO_EN = 0x23
I2C_MST_CTRL = 0x24
I2C_SLV0_ADDR = 0x25
I2C_SLV4_CTRL = 0x34
INT_PIN_CFG = 0x37
INT_ENABLE = 0x38
INT_STATUS = 0x3A
ACCEL_XOUT_H = 0x3B
GYRO_ZOUT_L = 0x48
EXT_SENS_DATA = 0x49
I2C_SLV0_DO = 0x63
I2C_MST_DELAY_CTRL = 0x67
SIGNAL_PATH_RESET = 0x68
USER_CTRL = 0x6A
PWR_MGMT_1 = 0x6B
PWR_MGMT_2 = 0x6C
FIFO_COUNT_H = 0x72
FIFO_R_W = 0x74
WHO_AM_I_REGISTER = 0x75

DATA_READY = 0x01
FIFO_OVERFLOW = 0x10
BYPASS = 0x02
CLEAR_ON_ANY_READ = 0x10
MASTER_ENABLE = 0x20
FIFO_ENABLE = 0x40
SLEEP = 0x40
DEVICE_RESET = 0x80
FIFO_BYTES = 1024
RESET_US = 50_000
"""How long DEVICE_RESET lasts; drivers wait 50 to 100 ms."""

ACCELEROMETER_LSB_PER_G = (16384.0, 8192.0, 4096.0, 2048.0)
GYROSCOPE_LSB_PER_DEG_S = (131.0, 65.5, 32.8, 16.4)
_ACCELEROMETER_BANDWIDTH_HZ = (260.0, 184.0, 94.0, 44.0, 21.0, 10.0, 5.0, 260.0)
_GYROSCOPE_BANDWIDTH_HZ = (256.0, 188.0, 98.0, 42.0, 20.0, 10.0, 5.0, 256.0)
_EXTRA_DELAY_S = (0.0, 0.001, 0.001, 0.0, 0.0, 0.0, 0.0, 0.0)

_TICKS_PER_S = 8000
"""The chip counts its time in the periods of the fast gyroscope clock."""
_TICKS_PER_STEP = 8
"""The filter runs at 1 kHz."""
_BLOCK_STEPS = 4096
_FILLED = 1024
"""Samples whose words are made at a time."""
_WARM_UP_STEPS = 512
"""Steps before a block that settle a filter with no history: 16 time constants at 5 Hz."""

_READ_ONLY = frozenset((*range(0x3A, 0x61), 0x72, 0x73, WHO_AM_I_REGISTER))


Filtering = tuple[float, float, float]
"""Bandwidths of accelerometer and gyroscope in Hz, further delay of both in seconds."""


@cache
def _filter(bandwidth_hz: float) -> tuple[FloatArray, FloatArray]:
    """(b, a) of a second-order Butterworth at 1 kHz."""
    k = math.tan(math.pi * bandwidth_hz / 1000.0)
    damped = math.sqrt(2.0) * k
    whole = 1.0 + damped + k * k
    return (
        np.array((k * k, 2.0 * k * k, k * k)) / whole,
        np.array((1.0, 2.0 * (k * k - 1.0) / whole, (1.0 - damped + k * k) / whole)),
    )


def _filtered(
    bandwidth_hz: float, raw: FloatArray, state: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Columns of filtered values, and the state (2, columns) after them.

    By LAPACK: to import scipy.signal takes longer than a minute of a node.
    """
    b, a = _filter(bandwidth_hz)
    raw = np.asfortranarray(raw)
    driven = b[0] * raw
    driven[1:] += b[1] * raw[:-1]
    driven[2:] += b[2] * raw[:-2]
    driven[:2] += state
    bands = np.tile(a, (len(raw), 1)).T
    rows: FloatArray = dtbtrs(bands, driven, uplo="L", diag="U", overwrite_b=1)[0]
    return rows, np.array(
        (
            b[1] * raw[-1] - a[1] * rows[-1] + b[2] * raw[-2] - a[2] * rows[-2],
            b[2] * raw[-1] - a[2] * rows[-1],
        )
    )


class _Pipeline:
    """Truth to filtered measurements (steps, 6) at the chip's 1 kHz, block by block.

    Noise is a function of the seed and the step alone, so that the same step gives the same noise
    whatever is configured and which chip reads first.
    """

    def __init__(self, surroundings: Surroundings, errors: InertialErrors) -> None:
        self._surroundings = surroundings
        self._errors = errors
        self.step_s = 1e-3 / (1.0 + errors.sample_clock_ppm * 1e-6)
        self._gain = np.zeros((6, 6))
        self._gain[:3, :3] = errors.accelerometer_gain.T
        self._gain[3:, 3:] = errors.gyroscope_gain.T
        self._bias = np.concatenate((errors.accelerometer_bias_m_s2, errors.gyroscope_bias_rad_s))
        # One-sided density d, white up to 500 Hz: sd = d sqrt(500 Hz).
        self._sigma = np.sqrt(500.0) * np.repeat(
            (errors.accelerometer_noise_m_s2_rthz, errors.gyroscope_noise_rad_s_rthz), 3
        )
        self._walk_rng = np.random.default_rng([errors.seed, 1])
        self._walk = [np.zeros(3)]
        self._blocks: dict[Filtering, tuple[int, FloatArray, list[FloatArray]]] = {}
        """Of each configuration that was used: number of its last block, rows, filters' states."""

    def block(self, number: int, config: Filtering) -> FloatArray:
        """Filtered measurements (_BLOCK_STEPS, 6) of a block, in SI units."""
        last, rows, states = self._blocks.get(config, (-2, np.zeros((0, 6)), []))
        if number == last:
            return rows
        filters = tuple(zip(config[:2], (slice(3), slice(3, 6)), strict=True))
        begin = number * _BLOCK_STEPS
        if number != last + 1:
            raw = self._raw(begin - _WARM_UP_STEPS, begin, config)
            states = []
            for bandwidth_hz, columns in filters:
                # Settled at the first value.
                b, a = _filter(bandwidth_hz)
                gain = b.sum() / a.sum()
                start = np.array((gain - b[0], b[2] - a[2] * gain))[:, None] * raw[0, columns]
                states.append(_filtered(bandwidth_hz, raw[:, columns], start)[1])
        rows = self._raw(begin, begin + _BLOCK_STEPS, config)
        after = []
        for (bandwidth_hz, columns), state in zip(filters, states, strict=True):
            rows[:, columns], state = _filtered(bandwidth_hz, rows[:, columns], state)
            after.append(state)
        self._blocks[config] = number, rows, after
        return rows

    def _raw(self, begin: int, end: int, config: Filtering) -> FloatArray:
        steps = np.arange(begin, end)
        times = np.asarray(steps * self.step_s - config[2], dtype=np.float64)
        true = self._surroundings.inertial_at(times)
        rows: FloatArray = true @ self._gain
        rows += self._bias
        if self._sigma.any() or self._errors.gyroscope_walk_rad_s_rts:
            for number in range(begin // _BLOCK_STEPS, (end - 1) // _BLOCK_STEPS + 1):
                first = number * _BLOCK_STEPS
                here = slice(max(first, begin) - begin, min(first + _BLOCK_STEPS, end) - begin)
                there = slice(here.start + begin - first, here.stop + begin - first)
                rows[here] += self._noise(number)[there]
        return rows

    def _noise(self, number: int) -> FloatArray:
        # A block before power-on (number -1) has its own noise but no walk.
        rng = np.random.default_rng([self._errors.seed, 2, number + 1])
        noise: FloatArray = rng.standard_normal((_BLOCK_STEPS, 6))
        noise *= self._sigma
        walk = self._errors.gyroscope_walk_rad_s_rts * np.sqrt(_BLOCK_STEPS * self.step_s)
        while len(self._walk) < number + 2:
            self._walk.append(self._walk[-1] + walk * self._walk_rng.standard_normal(3))
        fraction = np.arange(_BLOCK_STEPS)[:, None] / _BLOCK_STEPS
        begin, end = self._walk[max(number, 0)], self._walk[max(number + 1, 0)]
        noise[:, 3:] += (1.0 - fraction) * begin + fraction * end
        return noise


class Mpu9150(I2cDevice):
    """The chip. ``auxiliary`` is the device behind its second bus: the magnetometer, at 0x0C."""

    identity = WHO_AM_I
    power_on_management = SLEEP
    factory_codes: ClassVar[Mapping[int, int]] = {0x0D: 0xAF, 0x0E: 0x91, 0x0F: 0x74, 0x10: 0x39}

    def __init__(
        self,
        surroundings: Surroundings,
        errors: InertialErrors | None = None,
        auxiliary: Mapping[int, I2cDevice] | None = None,
    ) -> None:
        self._surroundings = surroundings
        errors = errors or InertialErrors()
        self._clock = 1.0 + errors.sample_clock_ppm * 1e-6
        self._pipeline = _Pipeline(surroundings, errors)
        self.auxiliary: Mapping[int, I2cDevice] = {} if auxiliary is None else auxiliary
        self.spoil: Callable[[bytes, int], bytes | None] = lambda data, _time_us: data
        """Fault: (a sample's 14 bytes, its time) -> what is shown for it; None: no new sample."""
        self.self_test_gain = 1.0
        """What its self-test moves the axes by, over what the factory measured."""
        self.time_us = 0
        self._registers = bytearray(128)
        self._pointer = 0
        self._pointed = False
        self._reset_until_us = 0
        self._reset_pending = False
        self._power_on_defaults()

    # -- state the auxiliary bus depends on ---------------------------------------------------

    def bypassed(self) -> bool:
        """Whether the host's bus is joined to the auxiliary bus."""
        return not self._registers[USER_CTRL] & MASTER_ENABLE and bool(
            self._registers[INT_PIN_CFG] & BYPASS
        )

    def power_cycle(self, time_us: int) -> None:
        """Supply off and on again (brown-out) at ``time_us``."""
        self.time_us = max(self.time_us, time_us)
        self._power_on_defaults()

    def _power_on_defaults(self) -> None:
        self._registers[:] = bytes(128)
        self._registers[PWR_MGMT_1] = self.power_on_management
        self._registers[WHO_AM_I_REGISTER] = self.identity
        for address, code in self.factory_codes.items():
            self._registers[address] = code
        self._status = 0
        self._fifo = bytearray()
        self._last_popped = 0
        self._data = self._shown = bytes(14)
        self._external = bytearray(24)
        self._reset_pending = False
        self._reschedule()

    @property
    def full_scale(self) -> tuple[float, float]:
        """Largest force (m/s^2) and rate (rad/s) of an axis at the ranges configured now."""
        force = 32768.0 / ACCELEROMETER_LSB_PER_G[self._registers[ACCEL_CONFIG] >> 3 & 3] * 9.80665
        rate = 32768.0 / GYROSCOPE_LSB_PER_DEG_S[self._registers[GYRO_CONFIG] >> 3 & 3]
        return force, rate * np.pi / 180.0

    # -- sampling ---------------------------------------------------------------------------

    def _ticks_at(self, time_us: int) -> int:
        return int(time_us * 1e-6 * _TICKS_PER_S * self._clock + 1e-6)

    def _reschedule(self) -> None:
        """Configuration changed: samples are counted anew from here."""
        config = self._registers[CONFIG] & 7
        self._config = self._filtering(config)
        fast = config in (0, 7)
        self._period = (1 + self._registers[SMPLRT_DIV]) * (1 if fast else _TICKS_PER_STEP)
        epoch = self._ticks_at(self.time_us)
        self._epoch = epoch if fast else epoch - epoch % _TICKS_PER_STEP
        self._sample = 0
        self._running = not self._registers[PWR_MGMT_1] & SLEEP
        self._table: list[bytes] = []
        self._table_first = 0
        self._due_us = self._time_of(1) if self._running else 1 << 62

    def _filtering(self, config: int) -> Filtering:
        """What DLPF_CFG chooses."""
        return (
            _ACCELEROMETER_BANDWIDTH_HZ[config],
            _GYROSCOPE_BANDWIDTH_HZ[config],
            _EXTRA_DELAY_S[config],
        )

    def _time_of(self, sample: int) -> int:
        """First whole microsecond at which ``sample`` is there."""
        exact = (self._epoch + sample * self._period) * 1e6 / (_TICKS_PER_S * self._clock)
        return int(exact) + 1

    def advance(self, time_us: int) -> None:
        """Take every sample that is due by ``time_us``."""
        if time_us < self._due_us:
            if time_us > self.time_us:
                self.time_us = time_us
                if self._reset_pending and time_us >= self._reset_until_us:
                    self._power_on_defaults()
            return
        newest = max((self._ticks_at(time_us) - self._epoch) // self._period, self._sample + 1)
        recording = self._registers[USER_CTRL] & FIFO_ENABLE and self._registers[FIFO_EN]
        mastering = self._registers[USER_CTRL] & MASTER_ENABLE
        if recording or mastering:
            # Nothing older than the FIFO's content or a slave's last answer can be seen.
            first = max(self._sample + 1, newest - FIFO_BYTES)
            for sample in range(first, newest + 1):
                self._take(sample)
                if mastering:
                    self.time_us = max(self.time_us, self._time_of(sample))
                    self._serve_slaves(sample)
                if recording:
                    self._record()
        else:
            self._take(newest)
        self.time_us = time_us
        self._sample = newest
        self._due_us = self._time_of(newest + 1)

    def _take(self, sample: int) -> None:
        spans = self._surroundings.silent_us
        if spans and _inside(self._time_of(sample), spans):
            return
        index = sample - self._table_first
        if not 0 <= index < len(self._table):
            self._fill(sample)
            index = sample - self._table_first
        shown = self.spoil(self._table[index], self._time_of(sample))
        if shown is not None:
            self._data = shown
            self._status |= DATA_READY

    def _fill(self, sample: int) -> None:
        """Make the words of ``sample`` and of those after it, no farther than its block."""
        block = (self._epoch + sample * self._period) // _TICKS_PER_STEP // _BLOCK_STEPS
        block_ticks = _BLOCK_STEPS * _TICKS_PER_STEP
        behind = -((self._epoch - (block + 1) * block_ticks) // self._period)
        # Until a driver has set it up, a chip samples at 8 kHz: few of them are ever read.
        samples = np.arange(sample, min(behind, sample + _FILLED))
        ticks = self._epoch + samples * self._period
        values = self._pipeline.block(block, self._config)[
            ticks // _TICKS_PER_STEP - block * _BLOCK_STEPS
        ]
        accelerometer = ACCELEROMETER_LSB_PER_G[self._registers[ACCEL_CONFIG] >> 3 & 3] / 9.80665
        gyroscope = GYROSCOPE_LSB_PER_DEG_S[self._registers[GYRO_CONFIG] >> 3 & 3] * 180 / np.pi
        words = np.empty((len(values), 7))
        words[:, :3] = values[:, :3] * accelerometer
        words[:, 3] = 0.0
        if not self._registers[PWR_MGMT_1] & 0x08:
            words[:, 3] = (self._surroundings.temperature_c - 35.0) * 340.0
        words[:, 4:] = values[:, 3:] * gyroscope
        force_g, rate_deg_s = self._self_test_response()
        for axis in range(3):
            if self._registers[ACCEL_CONFIG] >> (7 - axis) & 1:
                words[:, axis] += self.self_test_gain * force_g[axis] * 9.80665 * accelerometer
            if self._registers[GYRO_CONFIG] >> (7 - axis) & 1:
                rate_rad_s = np.radians(rate_deg_s[axis])
                words[:, 4 + axis] += self.self_test_gain * rate_rad_s * gyroscope
        standby = self._registers[PWR_MGMT_2]
        for bit, column in ((5, 0), (4, 1), (3, 2), (2, 4), (1, 5), (0, 6)):
            if standby >> bit & 1:
                words[:, column] = 0.0
        packed = np.clip(np.rint(words), -32768, 32767).astype(">i2").tobytes()
        self._table = [packed[k : k + 14] for k in range(0, len(packed), 14)]
        self._table_first = sample

    def _self_test_response(self) -> tuple[list[float], list[float]]:
        """What the factory measured: force in g and rate in deg/s an axis (register map, 13 to 16).

        Also i2cdevlib's names of the fields and Linux' users of the same die, the MPU-6050.
        """
        codes = [self.factory_codes[SELF_TEST + axis] for axis in range(3)]
        low = self.factory_codes[SELF_TEST + 3]
        force = [codes[axis] >> 3 & 0x1C | low >> (4 - 2 * axis) & 3 for axis in range(3)]
        rate = [code & 0x1F for code in codes]
        return (
            [0.34 * (0.92 / 0.34) ** ((code - 1) / 30.0) for code in force],
            [
                25.0 * 1.046 ** (code - 1) * (-1 if axis == 1 else 1)
                for axis, code in enumerate(rate)
            ],
        )

    # -- FIFO -------------------------------------------------------------------------------

    def _record(self) -> None:
        enabled = self._registers[FIFO_EN]
        data = self._data
        record = bytearray()
        if enabled & 0x08:
            record += data[0:6]
        if enabled & 0x80:
            record += data[6:8]
        for bit, start in ((0x40, 8), (0x20, 10), (0x10, 12)):
            if enabled & bit:
                record += data[start : start + 2]
        place = 0
        for slave in range(4):
            used = self._slave_read_length(slave)
            wanted = enabled >> slave & 1 if slave < 3 else self._registers[I2C_MST_CTRL] >> 5 & 1
            if wanted:
                record += self._external[place : place + used]
            place += used
        self._fifo += record
        if len(self._fifo) > FIFO_BYTES:
            del self._fifo[: len(self._fifo) - FIFO_BYTES]
            self._status |= FIFO_OVERFLOW

    def _pop(self) -> int:
        if self._fifo:
            self._last_popped = self._fifo.pop(0)
        return self._last_popped

    # -- auxiliary master ---------------------------------------------------------------------

    def _slave_read_length(self, slave: int) -> int:
        base = I2C_SLV0_ADDR + 3 * slave
        control = self._registers[base + 2]
        reading = self._registers[base] & 0x80
        return control & 0x0F if control & 0x80 and reading else 0

    def _serve_slaves(self, sample: int) -> None:
        if self._registers[INT_PIN_CFG] & BYPASS:
            return
        place = 0
        for slave in range(4):
            base = I2C_SLV0_ADDR + 3 * slave
            address, register, control = self._registers[base : base + 3]
            length = self._slave_read_length(slave)
            if not control & 0x80:
                continue
            delayed = self._registers[I2C_MST_DELAY_CTRL] >> slave & 1
            if not delayed or sample % (1 + (self._registers[I2C_SLV4_CTRL] & 0x1F)) == 0:
                device = self.auxiliary.get(address & 0x7F)
                if device is not None:
                    device.advance(self.time_us)
                    if address & 0x80:
                        status, data = device.transfer(bytes((register,)), b"", length)
                        if status is BusStatus.OK:
                            data = _swapped(data, control)
                            self._external[place : place + length] = data[: 24 - place]
                    else:
                        value = self._registers[I2C_SLV0_DO + slave]
                        device.transfer(bytes((register, value)), b"", 0)
            place += length

    # -- registers ----------------------------------------------------------------------------

    def _read_register(self, address: int) -> int:
        if address == INT_STATUS:
            status = self._status & self._registers[INT_ENABLE]
            self._status = 0
            return status
        if self._registers[INT_PIN_CFG] & CLEAR_ON_ANY_READ:
            self._status = 0
        if ACCEL_XOUT_H <= address <= GYRO_ZOUT_L:
            return self._shown[address - ACCEL_XOUT_H]
        if EXT_SENS_DATA <= address < EXT_SENS_DATA + 24:
            return self._external[address - EXT_SENS_DATA]
        if address == FIFO_COUNT_H:
            return len(self._fifo) >> 8
        if address == FIFO_COUNT_H + 1:
            return len(self._fifo) & 0xFF
        if address == FIFO_R_W:
            return self._pop()
        return self._registers[address]

    def _write_register(self, address: int, value: int) -> None:
        if address in _READ_ONLY:
            return
        if address == FIFO_R_W:
            self._fifo.append(value)
            return
        if address == PWR_MGMT_1 and value & DEVICE_RESET:
            self._registers[PWR_MGMT_1] = DEVICE_RESET | SLEEP
            self._status = 0
            self._reset_until_us = self.time_us + RESET_US
            self._reset_pending = True
            self._running = False
            self._due_us = 1 << 62
            return
        if self._reset_pending:
            return
        if address == USER_CTRL:
            if value & 0x04:
                self._fifo.clear()
            value &= ~0x0F  # the reset bits clear themselves
        elif address == SIGNAL_PATH_RESET:
            value = 0
        changed = self._registers[address] != value
        self._registers[address] = value
        if not changed:
            return
        if address in (SMPLRT_DIV, CONFIG, ACCEL_CONFIG_2, PWR_MGMT_1):
            self._reschedule()
        elif address in (GYRO_CONFIG, ACCEL_CONFIG, PWR_MGMT_2):
            self._table = []

    # -- bus ----------------------------------------------------------------------------------

    def start(self, read: bool) -> bool:
        """Every start is acknowledged; after one for writing the first byte is the register.

        A burst shows one sample: the registers do not change under it.
        """
        if read:
            self._shown = self._data
        else:
            self._pointed = False
        return True

    def write(self, byte: int) -> bool:
        """Register number first, then its data, with auto-increment."""
        if not self._pointed:
            self._pointer = byte & 0x7F
            self._pointed = True
            return True
        self._write_register(self._pointer, byte)
        self._next()
        return True

    def read(self) -> int:
        """Next register, with auto-increment."""
        value = self._read_register(self._pointer)
        self._next()
        return value

    def _next(self) -> None:
        if self._pointer != FIFO_R_W:
            self._pointer = (self._pointer + 1) & 0x7F

    def transfer(self, first: bytes, second: bytes, read_count: int) -> tuple[BusStatus, bytes]:
        """As the bytes would do; the two transactions of every tick without going through them."""
        if len(first) == 1 and not self._registers[INT_PIN_CFG] & CLEAR_ON_ANY_READ:
            register = first[0]
            behind = register + read_count
            if INT_PIN_CFG <= register <= INT_STATUS < behind <= EXT_SENS_DATA and not second:
                status = self._status & self._registers[INT_ENABLE]
                self._status = 0
                self._pointer = behind
                data = bytes((*self._registers[register:INT_STATUS], status))
                return BusStatus.OK, data + self._data[: behind - ACCEL_XOUT_H]
        return super().transfer(first, second, read_count)


def _swapped(data: bytes, control: int) -> bytes:
    """Bytes of each word exchanged where BYTE_SW asks for it (words from the register's start)."""
    if not control & 0x40:
        return data
    out = bytearray(data)
    for k in range(0, len(out) - 1, 2):
        out[k], out[k + 1] = out[k + 1], out[k]
    return bytes(out)


def _inside(time_us: int, spans: tuple[tuple[int, int], ...]) -> bool:
    first = bisect_right(spans, time_us, key=lambda span: span[1])
    return first < len(spans) and spans[first][0] <= time_us
