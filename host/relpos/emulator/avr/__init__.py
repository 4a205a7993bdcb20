"""The firmware image that is flashed, run cycle by cycle on simulated AVR boards.

simavr simulates the processor; a shim in C (`simavr_shim/`, GPL, not in the wheel) drives it, and
`board.py` wraps the shim. `engine.py` makes a board one of the emulator's engines, in lock-step
with the virtual clock. `bench/avr_budget.py` measures what the firmware needs of flash, RAM, stack
and time; the tests hold it to that. Begin with `engine.py`.
"""

from relpos.emulator.avr.board import BOARDS, Board, BoardSpec, Counters
from relpos.emulator.avr.elf import Firmware, read_firmware
from relpos.emulator.avr.engine import AvrEngine
from relpos.emulator.avr.library import SimulatorError

__all__ = [
    "BOARDS",
    "AvrEngine",
    "Board",
    "BoardSpec",
    "Counters",
    "Firmware",
    "SimulatorError",
    "read_firmware",
]
