"""What the emulated team needs of a board, whatever executes the firmware on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from relpos.protocol.messages import ResetCause

RESTART_US = 70_000
"""From a reset to the first pass: 65 ms start-up of the ATmega's fuses, then the C runtime. A boot
loader, which no engine has, adds to it (docs/emulator.md)."""
JUMP_US = 1_000
"""A restart on command is a jump: the C runtime alone."""
EEPROM_WRITE_US = 3_400
"""A byte of the ATmega's EEPROM erased and written (ATmega328P data sheet, EEPROM timing)."""
POWER_LOSS = frozenset((ResetCause.POWER_ON, ResetCause.BROWN_OUT))
"""Causes of a reset with the supply gone meanwhile."""


@dataclass(frozen=True, slots=True)
class NodeClockError:
    """How a board's clock differs from virtual time: node = (1 + ppm 1e-6) t + offset."""

    drift_ppm: float = 0.0
    offset_us: int = 0


def nowhere(_time_us: int, _data: bytes) -> None:
    """Where an engine's UART leads until somebody listens."""


class Engine(Protocol):
    """One board that executes the firmware in lock-step with the virtual clock."""

    next_due_us: int
    """Earliest virtual time at which it must run again."""
    on_transmit: Callable[[int, bytes], None]
    """Called with (virtual time in microseconds, bytes leaving the UART)."""

    def run(self, until_us: int) -> None:
        """Advance the board to virtual time ``until_us``."""

    def executes(self, time_us: int) -> bool:
        """Whether it is powered and the start-up after the last reset is over at ``time_us``."""

    def receive(self, data: bytes) -> None:
        """Bytes that arrive now at the board's UART."""

    def set_supply(self, supply_mv: int) -> None:
        """Supply in millivolts that the board measures from now on; 5000 at first."""

    def reset(self, time_us: int, cause: ResetCause) -> None:
        """Restart the board at ``time_us``; it executes again RESTART_US later.

        The firmware reads the cause as on that board (MCUSR on an AVR). EEPROM and chips
        keep their state, but where the supply was lost (power-on, brown-out) the EEPROM byte being
        written is left erased. The firmware of an AVR finds in its RAM what was there, or after a
        loss of supply garbage.
        """

    def set_drift(self, time_us: int, drift_ppm: float) -> None:
        """From ``time_us`` on the oscillator is off by ``drift_ppm``; the clock does not jump."""

    def stall(self, time_us: int, until_us: int) -> None:
        """The oscillator stands from ``time_us`` to ``until_us``: nothing executes or counts."""

    def close(self) -> None:
        """Free what the engine holds; it must not be used afterwards."""
