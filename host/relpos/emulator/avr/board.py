"""One simulated AVR board: chip, program, two-wire bus and UART, driven by cycles."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Self

from relpos.emulator.avr.elf import Firmware
from relpos.emulator.avr.library import BusCallback, SimulatorError, load


@dataclass(frozen=True)
class BoardSpec:
    """A board as the firmware knows it."""

    name: str
    """PlatformIO's environment of that name builds its firmware."""
    mmcu: str
    ram_bytes: int
    flash_bytes: int
    frequency_hz: int = 16_000_000


BOARDS = {
    "uno": BoardSpec("uno", "atmega328p", 2048, 32768),
    "mega": BoardSpec("mega", "atmega2560", 8192, 262144),
}


class BusOperation(IntEnum):
    """What the two-wire master does; numbers as in shim.h."""

    START = 0
    WRITE = 1
    READ = 2
    STOP = 3
    RELEASE = 4


class ResetCause(IntEnum):
    """Bits of MCUSR."""

    POWER_ON = 1
    EXTERNAL = 2
    BROWN_OUT = 4
    WATCHDOG = 8


BUS_HANGS = -1
"""Answer of a bus handler that never lets the operation complete."""

BusHandler = Callable[[BusOperation, int, int], int]
"""(operation, value, cycle) -> acknowledge, byte read or BUS_HANGS; values as in shim.h."""


@dataclass(frozen=True)
class Counters:
    """What the board has counted since it was made; the order is that of shim.h."""

    cycle: int
    resets: int
    watchdog_resets: int
    lowest_stack_pointer: int
    uart_overruns: int
    uart_deaf: int
    ticks: int
    tick_cycles_sum: int
    tick_cycles_max: int
    twi_busy_cycles: int
    lost_records: int
    worst_tick_at_cycle: int
    eeprom_writes: int


_COUNTERS = len(fields(Counters))
_ROOM = 1024


class Board:
    """A simulated board. Time is its own cycle counter; nothing happens between calls of run.

    Raises SimulatorError when the simulated program crashes, its stack reaches static data, or the
    bus handler fails; the board is then dead, what it sent before can still be taken.
    """

    def __init__(
        self,
        kind: BoardSpec,
        firmware: Firmware,
        bus: BusHandler | None = None,
        *,
        frequency_hz: int | None = None,
        line_baud: int = 0,
        reset_cause: ResetCause = ResetCause.POWER_ON,
    ) -> None:
        self.kind = kind
        self.firmware = firmware
        self.frequency_hz = frequency_hz or kind.frequency_hz
        self._library = load()
        self._handler = bus
        self._failure: BaseException | None = None
        # The callback object must outlive the board.
        self._callback = BusCallback(self._on_bus)
        self._board = self._library.relpos_avr_create(
            kind.mmcu.encode(),
            firmware.flash,
            len(firmware.flash),
            self.frequency_hz,
            firmware.static_end,
            line_baud,
            int(reset_cause),
            self._callback,
            None,
        )
        if not self._board:
            raise SimulatorError(
                f"simavr cannot run {len(firmware.flash)} bytes of program on an {kind.mmcu}"
            )
        if firmware.eeprom:
            self.load_eeprom(firmware.eeprom)
        self._cycles = (ctypes.c_uint64 * _ROOM)()
        self._values = (ctypes.c_uint8 * _ROOM)()
        self._counters = (ctypes.c_uint64 * _COUNTERS)()

    def _on_bus(self, _context: int | None, operation: int, value: int, cycle: int) -> int:
        if self._handler is None:
            return 0
        try:
            return self._handler(BusOperation(operation), value, cycle)
        except BaseException as error:  # must not cross the C code; run() raises it
            self._failure = self._failure or error
            return BUS_HANGS

    def _alive(self) -> int:
        if not self._board:
            raise SimulatorError("the simulated board is closed")
        board: int = self._board
        return board

    def run(self, until_cycle: int) -> None:
        """Run until the cycle counter reaches until_cycle, at most one instruction further."""
        failed = self._library.relpos_avr_run(self._alive(), until_cycle)
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        if failed:
            message = self._library.relpos_avr_error(self._board).decode(errors="replace")
            raise SimulatorError(f"{self.kind.name}: {message}")

    def reset(self, cause: ResetCause = ResetCause.EXTERNAL) -> None:
        """Reset from outside; EEPROM and RAM keep their contents.

        But after POWER_ON and BROWN_OUT the EEPROM byte being written is erased and the RAM holds
        garbage.
        """
        self._library.relpos_avr_reset(self._alive(), int(cause))

    def set_reset_vector(self, address: int) -> None:
        """Let resets start the program there, as the fuse does for a boot loader; 0 at first."""
        self._library.relpos_avr_set_reset_vector(self._alive(), address)

    def jump(self, address: int) -> None:
        """Continue at that place of the program, as if it had gone astray."""
        self._library.relpos_avr_jump(self._alive(), address)

    def receive(self, data: bytes, cycle: int = 0, *, damaged: bool = False) -> None:
        """Put bytes on the receive line from that cycle on, after those already on their way.

        Damaged ones, as noise makes them, have no stop bit.
        """
        self._library.relpos_avr_receive(self._alive(), data, len(data), cycle, damaged)

    def take_sent(self) -> list[tuple[int, int]]:
        """Bytes sent since the last call, as (cycle at which the stop bit ended, byte)."""
        return self._take(self._library.relpos_avr_take_sent)

    def take_marks(self) -> list[tuple[int, int]]:
        """Values written to GPIOR0 since the last call, as (cycle, value)."""
        return self._take(self._library.relpos_avr_take_marks)

    def trace(self, watched: int) -> None:
        """From now on keep what take_looks and take_heard give; they have to be called.

        ``watched`` is the address of a byte of RAM.
        """
        self._library.relpos_avr_trace(self._alive(), watched)

    def take_looks(self) -> list[tuple[int, int, int]]:
        """Looks at timer 1's overflow flag: (cycle, timer as the program read it last, watched)."""
        taken = self._take(self._library.relpos_avr_take_looks)
        looks = zip(taken[::3], taken[1::3], taken[2::3], strict=True)
        return [(cycle, low | high << 8, byte) for (cycle, low), (_, high), (_, byte) in looks]

    def take_heard(self) -> list[tuple[int, int]]:
        """Bytes that the program fetched from the receiver, as (cycle, byte)."""
        return self._take(self._library.relpos_avr_take_heard)

    def _take(self, function: Callable[..., int]) -> list[tuple[int, int]]:
        taken: list[tuple[int, int]] = []
        while True:
            count = function(self._alive(), self._cycles, self._values, _ROOM)
            taken.extend(zip(self._cycles[:count], self._values[:count], strict=True))
            if count < _ROOM:
                return taken

    def counters(self) -> Counters:
        """Everything the board counts."""
        self._library.relpos_avr_counters(self._alive(), self._counters)
        return Counters(*self._counters)

    @property
    def cycle(self) -> int:
        """Cycles since power-on, sleeping included."""
        return self.counters().cycle

    @property
    def deepest_stack_bytes(self) -> int:
        """Most bytes of stack in use at any instant, interrupts included."""
        end: int = self._library.relpos_avr_ram_end(self._alive())
        return end - self.counters().lowest_stack_pointer

    @property
    def eeprom_bytes(self) -> int:
        """Size of the EEPROM."""
        size: int = self._library.relpos_avr_eeprom_size(self._alive())
        return size

    def eeprom(self) -> bytes:
        """Contents of the whole EEPROM."""
        buffer = ctypes.create_string_buffer(self.eeprom_bytes)
        self._library.relpos_avr_eeprom_get(self._board, buffer, len(buffer))
        return buffer.raw

    def load_eeprom(self, contents: bytes) -> None:
        """Set the EEPROM from address 0."""
        if len(contents) > self.eeprom_bytes:
            raise SimulatorError(
                f"{len(contents)} bytes do not fit the EEPROM of {self.eeprom_bytes} bytes"
            )
        self._library.relpos_avr_eeprom_set(self._board, contents, len(contents))

    def set_supply(self, supply_mv: int) -> None:
        """Supply in millivolts from now on, as the chip's converter sees it; 5000 at first."""
        self._library.relpos_avr_set_supply(self._alive(), supply_mv)

    def set_frequency(self, frequency_hz: int) -> None:
        """Clock of the board from now on; the cycle counter goes on."""
        self.frequency_hz = frequency_hz
        self._library.relpos_avr_set_frequency(self._alive(), frequency_hz)

    def store(self, address: int, value: int) -> None:
        """Store a byte in data memory as the program would: registers react."""
        self._library.relpos_avr_data_set(self._alive(), address, value)

    def data(self, address: int, count: int) -> bytes:
        """Bytes of data memory (registers, I/O, RAM) as they are now."""
        buffer = ctypes.create_string_buffer(count)
        self._library.relpos_avr_data_get(self._alive(), address, buffer, count)
        return buffer.raw

    def close(self) -> None:
        """Free the board."""
        if self._board:
            self._library.relpos_avr_destroy(self._board)
            self._board = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
