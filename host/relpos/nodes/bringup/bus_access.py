"""Single transactions of a node's I2C bus, carried out by its firmware on command."""

from __future__ import annotations

import time
from dataclasses import dataclass

from relpos.errors import DeviceError
from relpos.link.dialogue import NodeDialogue
from relpos.protocol import messages as wire

TRIES = 6
"""Of a transaction that has to succeed: one in three may fail."""
MOST_READ = 15


@dataclass(frozen=True)
class Transaction:
    """How it ended, the last two bytes read, how long it took (0: the board does not tell).

    ``at_s`` is when it was carried out, midway between command and answer, which were ``apart_s``.
    """

    answered: bool
    data: bytes
    took_us: int
    at_s: float
    apart_s: float


class BusAccess:
    """The bus of the node that ``dialogue`` talks to. ``failed`` counts what was not answered."""

    def __init__(self, dialogue: NodeDialogue) -> None:
        self._dialogue = dialogue
        self.failed = 0

    def transfer(
        self, address: int, register: int, parameter: int = 0, *, written: int = 1, read: int = 0
    ) -> Transaction:
        """``S address+W register [parameter [0]] [Sr address+R read] P``.

        ``written`` counts the register, too. DeviceError where the firmware does not know it.
        """
        value = address | register << 8 | parameter << 16 | written << 24 | read << 28
        begin_s = time.monotonic()
        answer = self._dialogue.command(wire.CommandCode.ACCESS_BUS, value - (value >> 31 << 32))
        end_s = time.monotonic()
        if answer.result not in (wire.CommandResult.DONE, wire.CommandResult.NO_ANSWER):
            raise DeviceError(
                f"node {self._dialogue.node}: its firmware is older than this command: relpos node "
                "flash"
            )
        answered = answer.result is wire.CommandResult.DONE
        self.failed += not answered
        data = (answer.value & 0xFFFFFFFF).to_bytes(4, "little")
        took_us = int.from_bytes(data[2:], "little")
        return Transaction(answered, data[:2], took_us, (begin_s + end_s) / 2.0, end_s - begin_s)

    def byte(self, address: int, register: int) -> int | None:
        """Return a register; None where the chip does not answer."""
        found = self._insist(address, register, read=1)
        return None if found is None else found.data[1]

    def word(self, address: int, register: int, order: str = "big") -> int | None:
        """Return a signed register of two bytes; None where the chip does not answer."""
        found = self._insist(address, register, read=2)
        if found is None:
            return None
        return int.from_bytes(found.data, "big" if order == "big" else "little", signed=True)

    def write(self, address: int, register: int, value: int) -> Transaction | None:
        """Write a register; None where the chip does not answer."""
        return self._insist(address, register, value, written=2)

    def _insist(
        self, address: int, register: int, parameter: int = 0, *, written: int = 1, read: int = 0
    ) -> Transaction | None:
        for _ in range(TRIES):
            found = self.transfer(address, register, parameter, written=written, read=read)
            if found.answered:
                return found
        return None
