"""Faults that can be injected into an emulated team, written ``TARGET:BEHAVIOUR[:KEY=VALUE,...]``.

``table.py`` lists the faults and what node and host must do about each; ``spec.py`` parses one.
``injection.py`` installs them in a team: the effects are in ``chips.py``, ``radio.py`` (XBee and
its air), ``uwb.py``, ``host.py`` and ``boards.py`` (clock, supply, EEPROM), one function a
behaviour: one without a function is a KeyError. Every fault acts through a hook of the
emulated part, so the firmware sees no difference to the real one. Begin with ``FAULTS``. Importing
this package does not import the emulator: the command line's help needs only the table.
"""

from relpos.emulator.faults.spec import (
    FaultError,
    FaultSpec,
    help_text,
    parse_fault,
    parse_faults,
)
from relpos.emulator.faults.table import FAULTS, REFUSED, TARGETS, Fault, Key

__all__ = [
    "FAULTS",
    "REFUSED",
    "TARGETS",
    "Fault",
    "FaultError",
    "FaultSpec",
    "Key",
    "help_text",
    "parse_fault",
    "parse_faults",
]
