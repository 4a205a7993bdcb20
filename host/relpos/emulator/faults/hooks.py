"""The points of an emulated team where faults act; several faults can share one place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from relpos.emulator.air import RadioAir, UwbAir, VirtualClock
from relpos.emulator.bus import BusStatus, I2cDevice
from relpos.emulator.node import EmulatedNode
from relpos.emulator.xbee import XbeeModule

from .spec import FaultSpec

NEVER_US = 1 << 50

Rng = np.random.Generator
LineFault = Callable[[bytes, bool], bytes]
Spoil = Callable[[XbeeModule, XbeeModule, bytes, int], list[tuple[int, bytes]]]


class Team(Protocol):
    """What faults need of a team; see :class:`relpos.emulator.team.EmulatedTeam`."""

    clock: VirtualClock
    radio: RadioAir
    uwb: UwbAir
    coordinator: XbeeModule
    key: bytes
    host_fault: Callable[[int], int | None]

    @property
    def nodes(self) -> Mapping[int, EmulatedNode]:
        """Every node by its number."""


class FaultyChip(I2cDevice):
    """A chip on the bus whose answers and presence faults change."""

    def __init__(self, chip: I2cDevice) -> None:
        self._chip = chip
        self._time_us = 0
        self._open = False
        self._gone = False
        self.absent: list[Callable[[int], bool]] = []
        """(time) -> whether it does not answer this transaction."""
        self.answers: list[Callable[[int, bytes], bytes]] = []
        """(time, bytes that it answers) -> what the board receives of them."""

    def _begin(self) -> bool:
        if not self._open:
            self._open = True
            self._gone = any(absent(self._time_us) for absent in self.absent)
        return not self._gone

    def _answered(self, data: bytes) -> bytes:
        for answer in self.answers:
            data = answer(self._time_us, data)
        return data

    def advance(self, time_us: int) -> None:
        """Advance the fault and the chip to that time."""
        self._time_us = max(self._time_us, time_us)
        self._chip.advance(time_us)

    def start(self, read: bool) -> bool:
        """Acknowledged where the chip is present and acknowledges."""
        if not self._begin():
            return False
        acknowledged = self._chip.start(read)
        self.stretch_us, self._chip.stretch_us = self._chip.stretch_us, 0
        return acknowledged

    def write(self, byte: int) -> bool:
        """As the chip does."""
        return self._chip.write(byte)

    def read(self) -> int:
        """The chip's byte, as the board receives it."""
        return self._answered(bytes((self._chip.read(),)))[0]

    def stop(self) -> None:
        """End of the transaction."""
        self._open = False
        if not self._gone:
            self._chip.stop()

    def transfer(self, first: bytes, second: bytes, read_count: int) -> tuple[BusStatus, bytes]:
        """A whole transaction, with the same outcome as byte by byte."""
        present = self._begin()
        self._open = False
        if not present:
            return BusStatus.ADDRESS_NACK, b""
        status, data = self._chip.transfer(first, second, read_count)
        return status, self._answered(data)


class Hooks:
    """Where faults attach to ``team``."""

    def __init__(self, team: Team) -> None:
        self.team = team
        self.clock = team.clock

    def chip(self, node: EmulatedNode, address: int) -> FaultyChip:
        """The chip at that address of the node's bus."""
        chip = node.bus.devices[address]
        if not isinstance(chip, FaultyChip):
            chip = node.bus.devices[address] = FaultyChip(chip)
        return chip

    def at_end(self, spec: FaultSpec, action: Callable[[int], None]) -> None:
        """Call ``action(time)`` when the fault ends, if it does."""
        if spec.to_us is not None:
            self.clock.at(spec.to_us, action)

    def line(self, module: XbeeModule, fault: LineFault) -> None:
        """Pass what goes over the module's serial line through ``fault``, after earlier ones."""
        before = module.line_fault
        module.line_fault = lambda data, to_module: fault(before(data, to_module), to_module)

    def air(self, spoil: Spoil) -> None:
        """Pass what goes over the air through ``spoil``, after earlier ones."""
        before = self.team.radio.spoil

        self.team.radio.spoil = lambda sender, receiver, data, arrival_us: [
            out
            for at, frame in before(sender, receiver, data, arrival_us)
            for out in spoil(sender, receiver, frame, at)
        ]

    def silence(self, module: XbeeModule, gone: Callable[[int], bool]) -> None:
        """Let the module neither send nor receive anything while ``gone(time)``."""
        clock = self.clock
        self.line(module, lambda data, _to: b"" if gone(clock.now_us) else data)
        self.air(
            lambda sender, receiver, data, at_us: (
                [] if module in (sender, receiver) and gone(clock.now_us) else [(at_us, data)]
            )
        )
