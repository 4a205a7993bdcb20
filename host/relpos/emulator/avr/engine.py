"""The AVR engine: an emulated node whose board executes the very firmware that is flashed."""

from __future__ import annotations

from collections.abc import Callable

from relpos.emulator.avr.board import (
    BUS_HANGS,
    Board,
    BoardSpec,
    BusOperation,
    ResetCause,
)
from relpos.emulator.avr.elf import Firmware
from relpos.emulator.avr.library import SimulatorError
from relpos.emulator.bus import I2cBus
from relpos.emulator.engine import RESTART_US, NodeClockError, nowhere
from relpos.protocol import messages as wire

QUANTUM_US = 1000
"""How far a board may run ahead of the others: one frame of 3 bytes at 38400 baud takes as long."""

XBEE_BAUD = 38400

# The firmware's clock (firmware/lib/board/arduino): timer 1 in steps of 4 us, and a variable that
# counts its turns. Register addresses are those of both boards.
_TURNS = "turns"
_TIMSK1 = 0x6F
_TCNT1L = 0x84
_MICROSECONDS_A_COUNT = 4
_MOST_START_UP_CYCLES = 200_000

_FLAGS = {
    wire.ResetCause.UNKNOWN: ResetCause.EXTERNAL,
    wire.ResetCause.POWER_ON: ResetCause.POWER_ON,
    wire.ResetCause.EXTERNAL: ResetCause.EXTERNAL,
    wire.ResetCause.BROWN_OUT: ResetCause.BROWN_OUT,
    wire.ResetCause.WATCHDOG: ResetCause.WATCHDOG,
    wire.ResetCause.COMMAND: ResetCause.WATCHDOG,
}


class BusBridge:
    """Drives an I2cBus with the two-wire conditions and bytes of a simulated master."""

    def __init__(self, bus: I2cBus, time_us: Callable[[int], int]) -> None:
        """``time_us`` turns the board's cycles into virtual time."""
        self.bus = bus
        self._time_us = time_us

    def __call__(self, operation: BusOperation, value: int, cycle: int) -> int:
        """Answer one operation as shim.h asks: result | microseconds of clock stretching << 8."""
        bus = self.bus
        if operation == BusOperation.RELEASE:
            bus.release()
            return 0
        bus.time_us = self._time_us(cycle)
        if operation == BusOperation.STOP:
            bus.stop()
            return 0
        if bus.stuck:
            return BUS_HANGS
        if operation == BusOperation.START:
            result = int(bus.start(value >> 1, bool(value & 1)))
        elif operation == BusOperation.WRITE:
            result = int(bus.write(value))
        else:
            result = bus.read() & 0xFF
        if bus.stuck:
            return BUS_HANGS
        return result | bus.take_stretch_us() << 8


class AvrEngine:
    """Runs a firmware image on a simulated Uno or Mega in lock-step with the virtual clock.

    ``eeprom`` is loaded at power-on and kept up to date with what the firmware writes. The board is
    powered on at ``power_on_us`` of virtual time; its crystal is off by ``clock.drift_ppm``. An
    offset of ``clock`` is put into the firmware's counter (timer and turns, to 4 us) between its
    making and the first poll: as if the board had been on for so long.
    """

    def __init__(
        self,
        kind: BoardSpec,
        firmware: Firmware,
        bus: I2cBus,
        eeprom: bytearray,
        node_id: int,
        *,
        clock: NodeClockError | None = None,
        power_on_us: int = 0,
        line_baud: int = XBEE_BAUD,
    ) -> None:
        self.node_id = node_id
        self.bus = bus
        self.on_transmit: Callable[[int, bytes], None] = nowhere
        self.next_due_us = power_on_us
        clock = clock or NodeClockError()
        self._nominal_hz = kind.frequency_hz
        self._frequency_hz = self._hz(clock.drift_ppm)
        # Virtual time of a cycle: a line through the newest bend, a halt or another drift.
        self._bend_us = power_on_us
        self._bend_cycle = 0
        self._starts_us = power_on_us
        self._asked_us = 0
        self._eeprom = eeprom
        self._eeprom_writes = 0
        self._now_us = power_on_us
        self.lost_while_off = 0
        """Received bytes for which there was no board yet, or one that was starting."""
        self.board = Board(
            kind,
            firmware,
            BusBridge(bus, self._time_us),
            frequency_hz=self._frequency_hz,
            line_baud=line_baud,
        )
        self.board.load_eeprom(bytes(eeprom))
        if clock.offset_us:
            self._preset_clock(firmware, clock.offset_us)

    def _hz(self, drift_ppm: float) -> int:
        return round(self._nominal_hz * (1.0 + drift_ppm * 1e-6))

    def _time_us(self, cycle: int) -> int:
        return self._bend_us + (cycle - self._bend_cycle) * 1_000_000 // self._frequency_hz

    def _cycle(self, time_us: int) -> int:
        return self._bend_cycle + (time_us - self._bend_us) * self._frequency_hz // 1_000_000

    def _preset_clock(self, firmware: Firmware, offset_us: int) -> None:
        turns = [at for name, at in firmware.variables.items() if _TURNS in name]
        if len(turns) != 1:
            raise SimulatorError(f"node {self.node_id}: this firmware has no clock to set")
        # Memory has been cleared, the clock's interrupts are about to be allowed.
        while not self.board.data(_TIMSK1, 1)[0]:
            cycle = self.board.cycle
            if cycle > _MOST_START_UP_CYCLES:
                raise SimulatorError(f"node {self.node_id}: the firmware starts no clock")
            self.board.run(cycle + 1)
        counts = (offset_us & 0xFFFFFFFF) // _MICROSECONDS_A_COUNT
        low, high = counts & 0xFFFF, counts >> 16
        self.board.store(_TCNT1L + 1, low >> 8)
        self.board.store(_TCNT1L, low & 0xFF)
        self.board.store(turns[0], high & 0xFF)
        self.board.store(turns[0] + 1, high >> 8)

    def run(self, until_us: int) -> None:
        """Advance the board to virtual time ``until_us``; what it sent goes to ``on_transmit``.

        Raises SimulatorError when the firmware crashes, after handing over what it sent before.
        """
        self._asked_us = until_us
        if until_us > self._now_us:
            try:
                self.board.run(self._cycle(until_us))
            except SimulatorError as error:
                self._hand_over()
                raise SimulatorError(f"node {self.node_id}: {error}") from error
            self._now_us = until_us
            self._hand_over()
        self.next_due_us = self._now_us + QUANTUM_US

    def _hand_over(self) -> None:
        for cycle, byte in self.board.take_sent():
            self.on_transmit(self._time_us(cycle), bytes([byte]))
        self._keep_eeprom()

    def _keep_eeprom(self) -> None:
        writes = self.board.counters().eeprom_writes
        if writes != self._eeprom_writes:
            self._eeprom_writes = writes
            self._eeprom[:] = self.board.eeprom()[: len(self._eeprom)]

    def executes(self, time_us: int) -> bool:
        """Whether it is powered and the start-up after the last reset is over at ``time_us``."""
        return time_us >= self._starts_us

    def receive(self, data: bytes) -> None:
        """Bytes that begin to arrive now at the board's UART, at the line's speed."""
        if self.executes(self._asked_us):
            self.board.receive(data, self._cycle(self._now_us))
        else:
            self.lost_while_off += len(data)

    def reset(self, time_us: int, cause: wire.ResetCause) -> None:
        """Reset the board at ``time_us``: by its button, a dip of the supply or a new battery.

        A restart that the firmware brings about itself (watchdog) is simavr's, without the start-up
        time.
        """
        self.run(time_us)
        self.board.reset(_FLAGS[cause])
        self._keep_eeprom()
        self.stall(time_us, time_us + RESTART_US)
        self._starts_us = time_us + RESTART_US

    def set_drift(self, time_us: int, drift_ppm: float) -> None:
        """From ``time_us`` on the oscillator is off by ``drift_ppm``; the clock does not jump."""
        self.run(time_us)
        at_us = max(time_us, self._bend_us)
        self._bend_cycle, self._bend_us = self._cycle(at_us), at_us
        self._frequency_hz = self._hz(drift_ppm)
        self.board.set_frequency(self._frequency_hz)

    @property
    def eeprom_writing(self) -> bool:
        """Whether a byte is being written at this moment (EEPE in EECR, at 0x3F on both boards)."""
        return bool(self.board.data(0x3F, 1)[0] & 0x02)

    @property
    def eeprom_writes(self) -> int:
        """Bytes written since power-on."""
        return self.board.counters().eeprom_writes

    def stall(self, time_us: int, until_us: int) -> None:
        """The oscillator stands from ``time_us`` to ``until_us``: nothing executes or counts."""
        self.run(time_us)
        self._bend_us += until_us - time_us

    def set_supply(self, supply_mv: int) -> None:
        """Supply in millivolts from now on; 5000 at first."""
        self.board.set_supply(supply_mv)

    def close(self) -> None:
        """Free the simulated board."""
        self.board.close()
