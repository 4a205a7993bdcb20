"""The I2C bus of an emulated board, for engines that speak bytes and for those of transactions.

A chip model is written once, at the byte level (:class:`I2cDevice`). The AVR engine drives it
condition by condition through :class:`I2cBus` (``start``, ``write``, ``read``, ``stop``), the
native engine by whole transactions (``transfer``); a chip may override ``transfer`` for speed as
long as both ways give the same answers, which the tests compare.
"""

from __future__ import annotations

import enum
from collections import Counter
from collections.abc import Callable

Fault = Callable[[int, int], "BusStatus | None"]
"""(address, number of the transaction on this bus) -> what goes wrong with it, or None."""


class BusStatus(enum.IntEnum):
    """How a transaction ended; the numbers are those of the firmware's ``Board``."""

    OK = 0
    ADDRESS_NACK = 1
    DATA_NACK = 2
    TIMEOUT = 3


class I2cDevice:
    """A chip on the bus. Subclasses override the byte-level methods.

    ``stretch_us`` is how long the chip holds the clock after the present condition or byte; an
    engine with bus timing reads it through :meth:`I2cBus.take_stretch_us`.
    """

    stretch_us: int = 0

    def advance(self, time_us: int) -> None:
        """Move the chip to virtual time ``time_us``; never goes back."""

    def start(self, read: bool) -> bool:
        """(Repeated) start with the chip's address; returns whether the chip acknowledges."""
        return True

    def write(self, byte: int) -> bool:
        """Take a byte from the master; returns whether the chip acknowledges."""
        return True

    def read(self) -> int:
        """Hand the next byte to the master."""
        return 0xFF

    def stop(self) -> None:
        """Stop condition."""

    def transfer(self, first: bytes, second: bytes, read_count: int) -> tuple[BusStatus, bytes]:
        """``S W first [Sr W second] [Sr R read] P``; without anything it is an address probe."""
        if first or second or not read_count:
            for part in (first, second) if second else (first,):
                if not self.start(False):
                    self.stop()
                    return BusStatus.ADDRESS_NACK, b""
                for byte in part:
                    if not self.write(byte):
                        self.stop()
                        return BusStatus.DATA_NACK, b""
        data = b""
        if read_count:
            if not self.start(True):
                self.stop()
                return BusStatus.ADDRESS_NACK, b""
            data = bytes([self.read() for _ in range(read_count)])
        self.stop()
        return BusStatus.OK, data


class I2cBus:
    """Chips at their addresses, the time they live in, and what is made to go wrong.

    The engine sets ``time_us`` (virtual time) before it drives the bus; a chip is advanced to it
    when it is addressed. ``counts`` holds transactions per (address, status).

    Byte level: after each call the engine asks ``stuck``: the clock line is then held low for
    ever and the operation never completes; :meth:`release` (nine clocks, or a reset) frees it.
    """

    def __init__(self) -> None:
        self.time_us = 0
        self.devices: dict[int, I2cDevice] = {}
        self.fault: Fault = lambda _address, _number: None
        self.transactions = 0
        self.counts: Counter[tuple[int, BusStatus]] = Counter()
        self.stuck = False
        self.rise_ns = 0
        """Of both lines; it makes each of a byte's nine bits longer for a master that looks."""
        self._active: I2cDevice | None = None
        self._address = 0
        self._open = False
        self._refuse_data = False
        self._status = BusStatus.OK

    def attach(self, address: int, device: I2cDevice) -> None:
        """Put ``device`` at the 7-bit ``address``; ValueError where it is taken or no address."""
        if not 0x08 <= address <= 0x77:
            raise ValueError(f"0x{address:02X} is no 7-bit device address")
        if address in self.devices:
            raise ValueError(f"address 0x{address:02X} is taken")
        self.devices[address] = device

    # -- transactions -----------------------------------------------------------------------

    def transfer(
        self, address: int, first: bytes, second: bytes, read_count: int
    ) -> tuple[BusStatus, bytes]:
        """``S addr+W first [Sr addr+W second] [Sr addr+R read] P`` as one step."""
        number = self.transactions
        self.transactions = number + 1
        failure = self.fault(address, number)
        device = self.devices.get(address)
        if failure:
            self.counts[address, failure] += 1
            return failure, b""
        if device is None:
            self.counts[address, BusStatus.ADDRESS_NACK] += 1
            return BusStatus.ADDRESS_NACK, b""
        device.advance(self.time_us)
        result = device.transfer(first, second, read_count)
        self.counts[address, result[0]] += 1
        return result

    # -- bytes ------------------------------------------------------------------------------

    def start(self, address: int, read: bool) -> bool:
        """(Repeated) start and address; returns the acknowledge bit."""
        if not self._open:
            self._open = True
            self._status = BusStatus.OK
            self._refuse_data = False
            number = self.transactions
            self.transactions = number + 1
            failure = self.fault(address, number)
            if failure is BusStatus.TIMEOUT:
                self.stuck = True
            self._refuse_data = failure is BusStatus.DATA_NACK
            if failure:
                self._status = failure
                self._active = None
                self._address = address
                return failure is BusStatus.DATA_NACK
        elif self._status is not BusStatus.OK:
            return self._refuse_data
        self._address = address
        self._active = self.devices.get(address)
        if self._active is None:
            self._status = BusStatus.ADDRESS_NACK
            return False
        self._active.advance(self.time_us)
        if not self._active.start(read):
            self._status = BusStatus.ADDRESS_NACK
            self._active = None
            return False
        return True

    def write(self, byte: int) -> bool:
        """Write a byte; returns the acknowledge bit."""
        if self._active is None:
            return False
        self._active.advance(self.time_us)
        if not self._active.write(byte):
            self._status = BusStatus.DATA_NACK
            return False
        return True

    def read(self) -> int:
        """Read a byte; 0xFF (a line that is not pulled down) where no chip answers."""
        if self._active is None:
            return 0xFF
        self._active.advance(self.time_us)
        return self._active.read()

    def stop(self) -> None:
        """Stop condition: the transaction is over and counted."""
        if self._active is not None:
            self._active.stop()
            self._active = None
        if self._open:
            self.counts[self._address, self._status] += 1
        self._open = False
        self._refuse_data = False

    def release(self) -> None:
        """Free a stuck bus."""
        self.stuck = False
        self.stop()

    def take_stretch_us(self) -> int:
        """How much longer the last condition or byte takes: the clock is held, or rises late."""
        late_us = 9 * self.rise_ns // 1000
        device = self._active
        if device is None or not device.stretch_us:
            return late_us
        stretch, device.stretch_us = device.stretch_us, 0
        return stretch + late_us
