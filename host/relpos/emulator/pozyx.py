"""Pozyx tag as registers and functions, firmware 1.x (sources: docs/emulator.md).

Two-way ranging itself happens in a :class:`UwbMedium` that all tags share; the tag only starts an
exchange and learns its end. What no source states is fixed here and has to be checked on
hardware: the time of an exchange, the default UWB settings, the clock stretching.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .bus import I2cDevice
from .surroundings import Surroundings

ADDRESS = 0x4B

WHO_AM_I = 0x00
FIRMWARE_VER = 0x01
HARDWARE_VER = 0x02
ST_RESULT = 0x03
ERRORCODE = 0x04
INT_STATUS = 0x05
INT_MASK = 0x10
NETWORK_ID = 0x1A
UWB_CHANNEL = 0x1C
UWB_RATES = 0x1D
UWB_PLEN = 0x1E
UWB_GAIN = 0x1F
OPERATION_MODE = 0x22
PRESSURE = 0x50
TEMPERATURE = 0x80
DEVICE_LIST_SIZE = 0x81

RESET_SYS = 0xB0
LED_CTRL = 0xB1
DO_RANGING = 0xB5
DEVICES_GETIDS = 0xC0
DEVICES_CLEAR = 0xC3
DEVICE_ADD = 0xC4
DEVICE_GETINFO = 0xC5
DEVICE_GETCOORDS = 0xC6
DEVICE_GETRANGEINFO = 0xC7

INT_ERR = 0x01
INT_FUNC = 0x10

ERROR_NONE = 0x00
ERROR_I2C_WRITE = 0x01
ERROR_FUNCTION_PARAMETER = 0x0D
ERROR_RANGING = 0x11
ERROR_RESPONSE_TIMEOUT_1 = 0x12
ERROR_RESPONSE_TIMEOUT_2 = 0x13
ERROR_UWB_BUSY = 0x15

BOOT_US = 250_000
"""From power-on to the first acknowledge: the vendor's library waits that long."""
RESET_US = 1_000_000
FUNCTION_STRETCH_US = 150
"""Clock held while a function is carried out (assumed; the vendor states only that it is)."""
MOST_DEVICES = 20
"""Rows of the device list, and of the ranges: a further peer's is not stored (assumed)."""

_READABLE = (
    (0x00, 0x06), (0x10, 0x11), (0x14, 0x23), (0x27, 0x2A), (0x30, 0x47), (0x4E, 0x88),
)  # fmt: skip
_WRITABLE = ((0x10, 0x11), (0x14, 0x23), (0x27, 0x2A), (0x30, 0x3B), (0x85, 0x88))
_DEFAULTS = {
    WHO_AM_I: 0x43,
    FIRMWARE_VER: 0x11,
    HARDWARE_VER: 0x23,
    ST_RESULT: 0x3F,
    0x15: 0x3F,
    UWB_CHANNEL: 5,
    UWB_RATES: 0x80,
    UWB_PLEN: 0x08,
    UWB_GAIN: 22,
    OPERATION_MODE: 0,
}


def _addresses(spans: tuple[tuple[int, int], ...]) -> frozenset[int]:
    return frozenset(address for low, high in spans for address in range(low, high + 1))


_READABLE_ADDRESSES = _addresses(_READABLE)
_WRITABLE_ADDRESSES = _addresses(_WRITABLE)


@dataclass(frozen=True, slots=True)
class RangeResult:
    """What both tags of a finished exchange store."""

    distance_mm: int
    rss_dbm: int


Completion = Callable[[int, RangeResult | None, int, int], None]
"""(peer, result, error, time) of an exchange that is over."""


class UwbMedium(Protocol):
    """The air between tags."""

    def begin_exchange(self, initiator: Pozyx, destination: int, time_us: int) -> None:
        """``initiator`` ranges to the tag with network id ``destination``.

        The medium later calls ``finish_ranging`` of the tags concerned.
        """


@dataclass(frozen=True)
class PressureErrors:
    """Sensor spread: offset of this piece and white noise of one reading, in pascal."""

    offset_pa: float = 0.0
    noise_pa: float = 0.0
    seed: int = 0


class Pozyx(I2cDevice):
    """The tag. ``network_id`` survives its reset, as after a save to its flash."""

    def __init__(
        self,
        network_id: int,
        medium: UwbMedium,
        surroundings: Surroundings | None = None,
        pressure: PressureErrors | None = None,
        power_on_us: int = 0,
    ) -> None:
        self._saved_id = network_id
        self._medium = medium
        self._surroundings = surroundings
        self._pressure = pressure or PressureErrors()
        self._rng = np.random.default_rng([self._pressure.seed, 4])
        self.time_us = power_on_us
        self._power_on_us = power_on_us
        self._silent_until_us = power_on_us + BOOT_US
        self._pressure_next_us = 0
        self.antenna_delay_m = 0.0
        """What it makes every range too long by."""
        self.ranging = False
        """Whether an exchange that this tag started is on the air."""
        self.intercept: Completion = self._finish
        """Fault: takes (peer, result, error, time) of an exchange that this tag started, and sees
        to its :meth:`complete`."""
        self.frozen: Callable[[int], bool] = lambda _time_us: False
        """Fault: (time) -> whether what exchanges give is not stored, though reported as done."""
        self._begin()

    def power_cycle(self, time_us: int) -> None:
        """Supply off and on again (brown-out) at ``time_us``."""
        self._power_on_us = time_us
        self._silent_until_us = time_us + BOOT_US
        self._begin()

    def _begin(self) -> None:
        self._registers = bytearray(0x89)
        for address, value in _DEFAULTS.items():
            self._registers[address] = value
        self._registers[NETWORK_ID : NETWORK_ID + 2] = self._saved_id.to_bytes(2, "little")
        self._status = 0
        self._ranges: dict[int, bytes] = {}
        self._devices: dict[int, bytes] = {}
        self.ranging = False
        self._received = bytearray()
        self._phase = 0
        self._answer: bytes | None = None
        self._answered = 0
        self._executed = False

    # -- the tag as its neighbours see it -----------------------------------------------------

    @property
    def network_id(self) -> int:
        """Address on the air."""
        return int.from_bytes(self._registers[NETWORK_ID : NETWORK_ID + 2], "little")

    @property
    def uwb_settings(self) -> bytes:
        """Channel, rates and preamble: tags that differ in them do not hear each other."""
        return bytes(self._registers[UWB_CHANNEL : UWB_PLEN + 1])

    def awake(self, time_us: int) -> bool:
        """Whether the tag has booted."""
        return time_us >= self._silent_until_us

    def finish_ranging(
        self, peer: int, result: RangeResult | None, error: int, time_us: int, started: bool
    ) -> None:
        """Report the end of an exchange; ``started`` where this tag began it, else it answered."""
        if started:
            if self.ranging:  # not reset in between
                self.intercept(peer, result, error, time_us)
        elif self.awake(time_us):  # not restarted in between
            self.complete(peer, result, error, time_us)

    def _finish(self, peer: int, result: RangeResult | None, error: int, time_us: int) -> None:
        self.ranging = False
        self.complete(peer, result, error, time_us)

    def complete(
        self,
        peer: int,
        result: RangeResult | None,
        error: int,
        time_us: int,
        *,
        inverted: bool = False,
    ) -> None:
        """Store what an exchange gave and raise its flag; a fault inverts that."""
        room = peer in self._ranges or len(self._ranges) < MOST_DEVICES
        if result is not None and room and not self.frozen(time_us):
            stamp_ms = (time_us - self._power_on_us) // 1000
            self._ranges[peer] = struct.pack(
                "<IIh", stamp_ms & 0xFFFFFFFF, result.distance_mm, result.rss_dbm
            )
        if (result is None) != inverted:
            self._fail(error or ERROR_RANGING)
        else:
            self._registers[ERRORCODE] = ERROR_NONE
            self._status |= INT_FUNC

    def _fail(self, error: int) -> None:
        self._registers[ERRORCODE] = error
        self._status |= INT_ERR

    # -- functions ----------------------------------------------------------------------------

    def _call(self, function: int, parameters: bytes) -> bytes:
        """Status byte and results."""
        handler = {
            RESET_SYS: self._reset_system,
            LED_CTRL: lambda p: b"\1" if len(p) == 1 else b"\0",
            DO_RANGING: self._do_ranging,
            DEVICES_CLEAR: self._clear_devices,
            DEVICE_ADD: self._add_device,
            DEVICES_GETIDS: self._list_devices,
            DEVICE_GETINFO: lambda p: self._device(p, slice(0, 15)),
            DEVICE_GETCOORDS: lambda p: self._device(p, slice(3, 15)),
            DEVICE_GETRANGEINFO: self._range_info,
        }.get(function)
        answer = b"\0" if handler is None else handler(parameters)
        if answer == b"\0" and self._registers[ERRORCODE] == ERROR_NONE:
            self._fail(ERROR_FUNCTION_PARAMETER)
        return answer

    def _reset_system(self, parameters: bytes) -> bytes:
        self._silent_until_us = self.time_us + RESET_US
        self._power_on_us = self.time_us
        self._begin()
        return b"\1"

    def _do_ranging(self, parameters: bytes) -> bytes:
        if len(parameters) != 2:
            return b"\0"
        destination = int.from_bytes(parameters, "little")
        if self.ranging:
            self._fail(ERROR_UWB_BUSY)
            return b"\0"
        if destination in (0, self.network_id):
            self._fail(ERROR_RANGING)
            return b"\0"
        self.ranging = True
        self._registers[ERRORCODE] = ERROR_NONE
        self._medium.begin_exchange(self, destination, self.time_us)
        return b"\1"

    def _range_info(self, parameters: bytes) -> bytes:
        stored = self._ranges.get(int.from_bytes(parameters, "little"))
        return b"\0" if len(parameters) != 2 or stored is None else b"\1" + stored

    def _clear_devices(self, parameters: bytes) -> bytes:
        self._devices.clear()
        return b"\1"

    def _add_device(self, parameters: bytes) -> bytes:
        if len(parameters) != 15 or len(self._devices) >= MOST_DEVICES:
            return b"\0"
        self._devices[int.from_bytes(parameters[:2], "little")] = parameters
        return b"\1"

    def _list_devices(self, parameters: bytes) -> bytes:
        if len(parameters) != 2:
            return b"\0"
        offset, count = parameters
        wanted = list(self._devices)[offset : offset + count]
        if len(wanted) < count:
            return b"\0"
        return b"\1" + b"".join(device.to_bytes(2, "little") for device in wanted)

    def _device(self, parameters: bytes, part: slice) -> bytes:
        stored = self._devices.get(int.from_bytes(parameters, "little"))
        return b"\0" if len(parameters) != 2 or stored is None else b"\1" + stored[part]

    # -- registers ----------------------------------------------------------------------------

    def _read_register(self, address: int) -> int:
        if address not in _READABLE_ADDRESSES:
            return 0
        if address == INT_STATUS:
            value, self._status = self._status, 0
            return value
        if address == PRESSURE:
            self._measure_pressure()
        elif address == TEMPERATURE and self._surroundings is not None:
            return round(self._surroundings.temperature_c) & 0xFF
        elif address == DEVICE_LIST_SIZE:
            return len(self._devices)
        return self._registers[address]

    def _measure_pressure(self) -> None:
        """Refresh PRESSURE, at most every 20 ms."""
        if self._surroundings is None or self.time_us < self._pressure_next_us:
            return
        self._pressure_next_us = self.time_us + 20_000
        true = self._surroundings.pressure_at(self.time_us)
        noise = self._pressure.noise_pa * self._rng.standard_normal()
        word = max(round((true + self._pressure.offset_pa + noise) * 1000), 0)
        self._registers[PRESSURE : PRESSURE + 4] = word.to_bytes(4, "little")

    def _write_register(self, address: int, value: int) -> None:
        if address not in _WRITABLE_ADDRESSES:
            self._fail(ERROR_I2C_WRITE)
            return
        self._registers[address] = value
        if address in (UWB_CHANNEL, UWB_RATES, UWB_PLEN):
            self._registers[UWB_GAIN] = _DEFAULTS[UWB_GAIN]

    # -- bus ----------------------------------------------------------------------------------

    def advance(self, time_us: int) -> None:
        """Only the time itself: exchanges end by the medium."""
        if time_us > self.time_us:
            self.time_us = time_us

    def start(self, read: bool) -> bool:
        """Not acknowledged while the tag boots."""
        if self.time_us < self._silent_until_us:
            return False
        if read:
            self._answer = None
            if self._received and self._received[0] >= RESET_SYS and not self._executed:
                self._executed = True
                self.stretch_us = FUNCTION_STRETCH_US
                self._answer = self._call(self._received[0], bytes(self._received[1:]))
                self._answered = 0
        elif self._phase == 0:
            self._received.clear()
            self._executed = False
            self._phase = 1
        else:
            self._phase = 2
        return True

    def write(self, byte: int) -> bool:
        """Register or function number first; a register's data only after a repeated start."""
        if self._phase == 2:
            if self._received:
                self._write_register(self._received[0], byte)
                self._received[0] = (self._received[0] + 1) & 0xFF
            return True
        self._received.append(byte)
        return True

    def read(self) -> int:
        """Next byte of a function's answer, or next register."""
        if self._answer is not None:
            place = self._answered
            self._answered += 1
            return self._answer[place] if place < len(self._answer) else 0
        register = self._received[0] if self._received else 0
        if register >= RESET_SYS:
            return 0
        value = self._read_register(register)
        if self._received:
            self._received[0] = (register + 1) & 0xFF
        return value

    def stop(self) -> None:
        """End of the transaction; a register's data without a repeated start are an error."""
        if self._phase == 1 and len(self._received) > 1 and self._received[0] < RESET_SYS:
            self._fail(ERROR_I2C_WRITE)
        self._phase = 0
