"""The native engine: the production firmware compiled for this computer, driven poll by poll.

Virtual time is mapped to the node's 32-bit microsecond clock with its drift and offset; the
firmware says when it wants its next pass, so that a sleeping node costs nothing.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

from relpos import paths
from relpos.errors import DeviceError
from relpos.protocol.messages import ResetCause

from .bus import BusStatus, I2cBus
from .engine import EEPROM_WRITE_US, JUMP_US, POWER_LOSS, RESTART_US, NodeClockError, nowhere
from .xbee import line_time_us

_COMPILE = ("-std=gnu++11", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
_WARNINGS = ("-Wall", "-Wextra", "-Werror")
LOOP_US = 200
"""Shortest time of one pass of the main loop, where the firmware wants the next at once: about
what the Uno needs for an idle pass with its interrupts. Without it virtual time would stand."""
EEPROM_BYTES = 1024
WIRE_BYTES = 510
"""Room for the two parts of a transaction of the bus (engine.h)."""
UART_BAUD = 38_400

_U8 = ctypes.c_uint8
_U16 = ctypes.c_uint16
_U32 = ctypes.c_uint32
_POINTER = ctypes.c_void_p

# Plain addresses instead of POINTER(c_uint8): making pointer objects costs more than the chips do.
_I2cTransfer = ctypes.CFUNCTYPE(_U8, _POINTER, _U8, _U8, _U8, _U8)
_UartWrite = ctypes.CFUNCTYPE(None, _POINTER, _POINTER, _U16)
_Reset = ctypes.CFUNCTYPE(None, _POINTER)
_StorageWrite = ctypes.CFUNCTYPE(None, _POINTER, _U16, _U8)


class _Callbacks(ctypes.Structure):
    _fields_ = (
        ("context", _POINTER),
        ("i2c_transfer", _I2cTransfer),
        ("wire", _POINTER),
        ("uart_write", _UartWrite),
        ("reset", _Reset),
        ("storage_write", _StorageWrite),
    )


def _sources(library: Path) -> list[Path]:
    """Everything that can end up in the native library, sorted; the Arduino board is not in it."""
    return sorted(
        path
        for path in library.rglob("*")
        if path.suffix in (".h", ".cpp", ".c") and "arduino" not in path.parts
    )


def build(library: Path | None = None, output: Path | None = None, imu: str = "mpu9150") -> Path:
    """Compile ``firmware/lib`` where its content has changed; returns the shared library.

    ``imu`` is the sensor that it is for, as in ``relpos node flash --imu``.
    Raises DeviceError where the compiler is missing, or with its first complaint.
    """
    library = library or paths.firmware_project() / "firmware" / "lib"
    output = output or paths.build_folder() / "native"
    sources = _sources(library)
    units = [path for path in sources if path.suffix != ".h"]
    if not any(path.parent.name == "native" for path in units):
        raise DeviceError("the firmware has no native board (firmware/lib/board/native)")
    compiler = os.environ.get("CXX", "g++")
    options = (*_COMPILE, f"-DRELPOS_IMU={imu.upper()}")
    digest = hashlib.sha256(" ".join((compiler, *options)).encode())
    for path in sources:
        digest.update(path.relative_to(library).as_posix().encode() + b"\0")
        digest.update(path.read_bytes() + b"\0")
    target = output / f"relpos-node-{digest.hexdigest()[:16]}.so"
    if target.is_file():
        return target
    if shutil.which(compiler) is None:
        raise DeviceError(
            f"the native board needs a C++ compiler: {compiler} is not there (apt install g++)"
        )
    try:
        output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=output) as folder:
            made = Path(folder) / target.name
            command = [compiler, *options, *_WARNINGS, "-I", str(library), "-o", str(made)]
            result = subprocess.run(
                [*command, *map(str, units)], capture_output=True, text=True, check=False
            )
            if result.returncode:
                raise DeviceError(f"the firmware does not compile: {_first_error(result.stderr)}")
            made.replace(target)  # atomic: two processes may build at once
    except OSError as error:
        raise DeviceError(f"{output}: cannot be written: {error.strerror or error}") from error
    return target


def _first_error(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    for line in lines:
        if "error:" in line or "undefined reference" in line:
            return line.strip()
    return lines[0].strip() if lines else "the compiler gave no reason"


@cache
def load(path: Path) -> ctypes.CDLL:
    """Load a library made by :func:`build` and declare its functions."""
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise DeviceError(f"{path.name}: cannot be loaded: {error}") from error
    library.relpos_node_create.restype = _POINTER
    library.relpos_node_create.argtypes = [
        ctypes.POINTER(_Callbacks), _POINTER, _U16, _U8, _U8, _U32,
    ]  # fmt: skip
    library.relpos_node_destroy.restype = None
    library.relpos_node_destroy.argtypes = [_POINTER]
    library.relpos_node_receive.restype = None
    library.relpos_node_receive.argtypes = [_POINTER, ctypes.c_char_p, _U16]
    library.relpos_node_set_supply.restype = None
    library.relpos_node_set_supply.argtypes = [_POINTER, _U16]
    library.relpos_node_poll.restype = _U32
    library.relpos_node_poll.argtypes = [_POINTER, _U32]
    return library


class NativeEngine:
    """One node of the native library: an Engine.

    ``eeprom`` is written in place and survives resets, as does the chips' state. ``resets``
    counts the reboots that the node asked for. ``stored_id``: the node takes its number from the
    EEPROM, as a board does, and ``node_id`` only names it in errors.
    """

    def __init__(
        self,
        bus: I2cBus,
        eeprom: bytearray,
        node_id: int,
        *,
        clock: NodeClockError | None = None,
        power_on_us: int = 0,
        reset_cause: ResetCause = ResetCause.POWER_ON,
        library: Path | None = None,
        stored_id: bool = False,
    ) -> None:
        self.node_id = node_id
        self._given_id = 0 if stored_id else node_id
        self.bus = bus
        self.on_transmit: Callable[[int, bytes], None] = nowhere
        self.next_due_us = power_on_us
        self.resets = 0
        self.store: Callable[[int, int], None] = self._eeprom_write
        """Called with (address, value) of every byte that is written to the EEPROM."""
        self._clock = clock or NodeClockError()
        self._power_on_us = power_on_us
        self._rate = 1.0 + self._clock.drift_ppm * 1e-6
        self._written_at = 0
        self._written_until_us = 0
        # The node's clock as a line through its newest bend: a restart or another drift.
        self._bend_us = power_on_us
        self._bend_node_us = self._clock.offset_us
        self._library = load(library or build())
        self._poll = self._library.relpos_node_poll
        self._eeprom = (_U8 * len(eeprom)).from_buffer(eeprom)
        self._error: BaseException | None = None
        self._reset_asked = False
        self._line_free_us = 0
        self._supply_mv = 5000
        # Kept alive here: ctypes does not.
        wire = (_U8 * WIRE_BYTES)()
        self._wire = memoryview(wire).cast("B")
        self._callbacks = _Callbacks(
            None,
            _I2cTransfer(self._transfer),
            ctypes.addressof(wire),
            _UartWrite(self._written),
            _Reset(self._asked),
            _StorageWrite(self._stored),
        )
        self._node: int | None = None
        self._create(reset_cause)

    def _create(self, cause: ResetCause) -> None:
        self._node = self._library.relpos_node_create(
            ctypes.byref(self._callbacks),
            ctypes.addressof(self._eeprom),
            len(self._eeprom),
            self._given_id,
            int(cause),
            self._bend_node_us & 0xFFFFFFFF,
        )
        if not self._node:
            raise DeviceError(f"node {self.node_id}: the firmware refuses to start")
        self._library.relpos_node_set_supply(self._node, self._supply_mv)

    # -- called by the firmware -----------------------------------------------------------------

    def _transfer(
        self, _context: int | None, address: int, first: int, second: int, read_count: int
    ) -> int:
        wire = self._wire
        try:
            status, data = self.bus.transfer(
                address,
                wire[:first].tobytes(),
                wire[first : first + second].tobytes() if second else b"",
                read_count,
            )
            if data:
                wire[:read_count] = data
        except BaseException as error:  # ctypes would print it and go on
            self._error = error
            return int(BusStatus.TIMEOUT)
        return status

    def _written(self, _context: int | None, data: int | None, count: int) -> None:
        try:
            if data and count:
                begin = max(self.bus.time_us, self._line_free_us)
                self._line_free_us = begin + line_time_us(count, UART_BAUD)
                self.on_transmit(self._line_free_us, ctypes.string_at(data, count))
        except BaseException as error:
            self._error = error

    def _asked(self, _context: int | None) -> None:
        self._reset_asked = True

    def _stored(self, _context: int | None, at: int, value: int) -> None:
        try:
            self.store(at, value)
            self._written_at = at
            # A fault that stores something else has cut the supply itself.
            intact = self._eeprom[at] == value
            self._written_until_us = self.bus.time_us + EEPROM_WRITE_US if intact else 0
        except BaseException as error:
            self._error = error

    def _eeprom_write(self, at: int, value: int) -> None:
        self._eeprom[at] = value

    # -- Engine -----------------------------------------------------------------------------------

    def run(self, until_us: int) -> None:
        """Make every pass that is due by ``until_us``: some 400 a second."""
        while (time_us := self.next_due_us) <= until_us:
            since_us = int((time_us - self._bend_us) * self._rate)
            wait_us = self.poll(time_us, since_us + self._bend_node_us & 0xFFFFFFFF)
            if self._reset_asked:
                self.reset(time_us, ResetCause.COMMAND)
            elif wait_us < LOOP_US:
                self.next_due_us = time_us + LOOP_US
            else:
                self.next_due_us = self._time_of(since_us + wait_us)

    def poll(self, time_us: int, node_us: int) -> int:
        """One pass of the main loop with the node's clock at ``node_us``; what it returns."""
        self.bus.time_us = time_us
        wait_us: int = self._poll(self._node, node_us)
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        return wait_us

    def _time_of(self, node_us: int) -> int:
        """First virtual microsecond at which the node's clock has gone that far since its bend."""
        since_us = int(node_us / self._rate)
        while int(since_us * self._rate) < node_us:
            since_us += 1
        return self._bend_us + since_us

    def executes(self, time_us: int) -> bool:
        """Whether it is powered and the start-up after the last reset is over at ``time_us``."""
        return time_us >= self._power_on_us

    def receive(self, data: bytes) -> None:
        """Bytes that have arrived at the UART; the node runs again at once."""
        if self._node:
            self._library.relpos_node_receive(self._node, data, len(data))

    def reset(self, time_us: int, cause: ResetCause) -> None:
        """Restart the firmware: its RAM is lost, EEPROM and chips keep their state.

        A byte being written to the EEPROM is left erased where the supply was lost.
        """
        self._reset_asked = False
        if cause in POWER_LOSS and time_us < self._written_until_us:
            self._eeprom[self._written_at] = 0xFF
        self._written_until_us = 0
        self.resets += 1
        self._library.relpos_node_destroy(self._node)
        away_us = JUMP_US if cause is ResetCause.COMMAND else RESTART_US
        self._power_on_us = self._bend_us = time_us + away_us
        self._bend_node_us = 0
        self.next_due_us = self._power_on_us
        self._create(cause)

    def set_drift(self, time_us: int, drift_ppm: float) -> None:
        """From ``time_us`` on the oscillator is off by ``drift_ppm``; the clock does not jump."""
        if time_us > self._bend_us:
            self._bend_node_us += int((time_us - self._bend_us) * self._rate)
            self._bend_us = time_us
        self._rate = 1.0 + drift_ppm * 1e-6

    def set_supply(self, supply_mv: int) -> None:
        """Supply in millivolts that the board measures from now on, over restarts too."""
        self._supply_mv = supply_mv
        if self._node:
            self._library.relpos_node_set_supply(self._node, supply_mv)

    def stall(self, time_us: int, until_us: int) -> None:
        """The oscillator stands from ``time_us`` to ``until_us``: nothing executes or counts."""
        self._power_on_us += until_us - time_us
        self._bend_us += until_us - time_us
        self.next_due_us = max(self.next_due_us, time_us) + until_us - time_us

    def close(self) -> None:
        """Free the node."""
        if self._node:
            self._library.relpos_node_destroy(self._node)
            self._node = None
