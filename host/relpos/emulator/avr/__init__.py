"""The firmware image that is flashed, run cycle by cycle on simulated AVR boards."""

from relpos.emulator.avr.board import BOARDS, Board, BoardKind, Counters
from relpos.emulator.avr.elf import Firmware, read_firmware
from relpos.emulator.avr.engine import AvrEngine
from relpos.emulator.avr.library import SimulatorError

__all__ = [
    "BOARDS",
    "AvrEngine",
    "Board",
    "BoardKind",
    "Counters",
    "Firmware",
    "SimulatorError",
    "read_firmware",
]
