"""A pseudo-terminal that speaks as the team's XBee coordinator.

The virtual clock waits for its reader: while no reader has the port open, or the reader is behind
and the buffer is full, it stands, so that nothing is lost at any speed but what lies in the buffer
when a reader goes away (as with a real port). Opening a port discards what waited in it (pyserial
and most others do that), hence the short wait after an open.

At other speeds than 1 a host cannot read virtual time from its own clock. Two ways out:
``mark_time`` puts a frame of type VIRTUAL_TIME (8 bytes, big-endian, microseconds) before what
arrives at that time; no XBee has such a frame, and a host that does not know it skips it. In the
same process :class:`VirtualTimePort` hands out bytes with their virtual times.
"""

from __future__ import annotations

import array
import os
import select
import sys
import threading
import time
from collections import deque
from typing import Protocol

import serial

from relpos.errors import DeviceError
from relpos.link.port import BAUD, READ_TIMEOUT_S
from relpos.link.xbee import virtual_time

from .air import STEP_US

try:
    import fcntl
    import termios
except ImportError:  # no POSIX: the rest of the emulator works all the same
    PSEUDO_TERMINALS = False
else:
    PSEUDO_TERMINALS = True

SETTLE_S = 0.1
"""From an open to the first byte: the reader configures and empties its port meanwhile."""
DRAIN_S = 2.0
"""How long the end waits for a reader that does not read."""
_POLL_S = 0.02
_QUIET_POLLS = 5


def require_pseudo_terminals() -> None:
    """Raise DeviceError where the system has none."""
    if not PSEUDO_TERMINALS:
        raise DeviceError(
            "emulated teams need pseudo-terminals, which Linux and macOS have and this system lacks"
        )


class SerialDevice(Protocol):
    """A device with a serial port, on a virtual clock that its user advances."""

    seconds: float
    end_us: int

    @property
    def time_us(self) -> int:
        """Virtual time."""

    def run(self, until_us: int) -> list[tuple[int, bytes]]:
        """Advance to ``until_us``; (time in microseconds, bytes) that left the port."""

    def send(self, data: bytes) -> None:
        """Bytes that begin to arrive now at the port."""


class PseudoTerminal:
    """Offers ``device`` at :attr:`path`. ``speed`` 1 is real time, 0 as fast as it is read.

    Either ``serve`` in this thread, or ``start`` and ``join`` around reading it from another.
    DeviceError where the system has no pseudo-terminal.
    """

    def __init__(
        self, device: SerialDevice, speed: float = 1.0, *, mark_time: bool = False
    ) -> None:
        require_pseudo_terminals()
        if speed < 0.0:
            raise DeviceError(f"the speed is not negative, unlike {speed:g}")
        self.device = device
        self._speed = 0.0 if speed == float("inf") else speed
        self._mark_time = mark_time
        try:
            self._master, slave = os.openpty()
        except OSError as error:
            raise DeviceError(f"no pseudo-terminal to be had: {error.strerror}") from error
        self.path = os.ttyname(slave)
        _make_raw(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN | select.POLLHUP)
        self._had_reader = False
        self._tracked = False
        self._written = 0
        self._ledger: deque[tuple[int, int]] = deque()
        self._finished = threading.Event()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None

    def __enter__(self) -> PseudoTerminal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End at once; a reader sees the port vanish."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def open_port(self) -> VirtualTimePort:
        """Open the terminal as a serial port of this process. Call before ``start``."""
        self._tracked = True
        return VirtualTimePort(self)

    # -- in a thread ------------------------------------------------------------------------------

    def start(self) -> None:
        """Serve in a thread of its own."""
        self._thread = threading.Thread(target=self._serve_quietly, name="emulator", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait for the thread's end; raises what it failed with."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self.raise_failure()

    def raise_failure(self) -> None:
        """Raise what the thread failed with, if it did."""
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure

    def _serve_quietly(self) -> None:
        try:
            self._serve()
        except BaseException as error:
            self._failure = error
        finally:
            self._finished.set()

    @property
    def finished(self) -> bool:
        """Whether nothing more will be written."""
        return self._finished.is_set()

    # -- serving ----------------------------------------------------------------------------------

    def serve(self) -> None:
        """Serve until the walk ends or Ctrl-C; says on standard error which."""
        try:
            self._serve()
        except KeyboardInterrupt:
            print(
                f"relpos emulate: stopped after {self.device.time_us * 1e-6:.1f} s of the walk",
                file=sys.stderr,
            )
            return
        self.drain()
        print(f"relpos emulate: the walk of {self.device.seconds:g} s is over", file=sys.stderr)

    def _serve(self) -> None:
        device = self.device
        anchor_wall_s = time.monotonic()
        anchor_us = device.time_us
        while device.time_us < device.end_us and not self._stop.is_set():
            waited = self._wait_for_reader()
            for time_us, data in device.run(min(device.time_us + STEP_US, device.end_us)):
                if self._mark_time:
                    data = virtual_time(time_us) + data
                waited |= self._write(time_us, data)
            if waited:
                anchor_wall_s, anchor_us = time.monotonic(), device.time_us
            self._listen(0.0)
            if self._speed:
                due_s = anchor_wall_s + (device.time_us - anchor_us) * 1e-6 / self._speed
                while (left_s := due_s - time.monotonic()) > 0 and not self._stop.is_set():
                    self._listen(min(left_s, _POLL_S))

    def _reader_gone(self) -> bool:
        return any(event & select.POLLHUP for _, event in self._poll.poll(0))

    def _wait_for_reader(self) -> bool:
        """Wait while no reader has the port open; whether that took any time."""
        if self._had_reader and not self._reader_gone():
            return False
        while self._reader_gone():
            self._had_reader = False
            if self._stop.wait(_POLL_S):
                return True
        if not self._had_reader:
            # The last close has put the terminal back to its echoing default.
            try:
                slave = os.open(self.path, os.O_RDWR | os.O_NOCTTY)
            except OSError:
                return True
            _make_raw(slave)
            os.close(slave)
            self._stop.wait(SETTLE_S)
            self._had_reader = not self._reader_gone()
        return True

    def _write(self, time_us: int, data: bytes) -> bool:
        """Write all of it, waiting while the buffer is full; whether it had to wait."""
        if self._tracked:
            self._ledger.append((self._written + len(data), time_us))
            self._written += len(data)
        waited = False
        while data:
            try:
                data = data[os.write(self._master, data) :]
            except BlockingIOError:
                waited = True
                if self._stop.is_set() or self._reader_gone():
                    return True
                select.select([], [self._master], [], _POLL_S)
        return waited

    def _listen(self, timeout_s: float) -> None:
        """Hand what the host sends to the coordinator."""
        if self._reader_gone():
            # Nothing to hear, and a hang-up makes select return at once.
            self._stop.wait(timeout_s)
            return
        readable, _, _ = select.select([self._master], [], [], timeout_s)
        if readable:
            try:
                data = os.read(self._master, 4096)
            except (BlockingIOError, OSError):
                return
            self.device.send(data)

    def drain(self) -> None:
        """Give a reader the time to take what is left: closing would throw it away."""
        deadline_s = time.monotonic() + DRAIN_S
        quiet = 0
        try:
            slave = os.open(self.path, os.O_RDWR | os.O_NOCTTY)
        except OSError:
            return
        try:
            # Empty once is not empty: the kernel hands on what was written piece by piece.
            while time.monotonic() < deadline_s and quiet < _QUIET_POLLS:
                time.sleep(_POLL_S)
                quiet = 0 if _waiting(slave) else quiet + 1
        finally:
            os.close(slave)

    # -- for VirtualTimePort --------------------------------------------------------------------

    def boundary(self, offset: int) -> tuple[int, int] | None:
        """(end offset, time) of the chunk that the byte at ``offset`` is in; None before it is."""
        while self._ledger and self._ledger[0][0] <= offset:
            self._ledger.popleft()
        return self._ledger[0] if self._ledger else None


class VirtualTimePort(serial.Serial):  # type: ignore[misc, unused-ignore]
    """The terminal as pyserial's port, whose reads never go past the end of one moment.

    ``virtual_time_s`` is the clock for ``relpos.link.port.observe``: the time at which the last
    byte read arrived. ``exhausted`` is true once the team has ended and all is read.
    """

    def __init__(self, terminal: PseudoTerminal) -> None:
        self._terminal = terminal
        self._offset = 0
        self._time_us = 0
        super().__init__(terminal.path, BAUD, timeout=READ_TIMEOUT_S)

    def virtual_time_s(self) -> float:
        """Virtual time in seconds at which the last byte read arrived."""
        return self._time_us * 1e-6

    @property
    def exhausted(self) -> bool:
        """Whether nothing more will come. Raises what the team failed with."""
        if not self._terminal.finished:
            return False
        self._terminal.raise_failure()
        return self._terminal.boundary(self._offset) is None

    @property
    def in_waiting(self) -> int:
        """Bytes of the present moment that are there."""
        chunk = self._terminal.boundary(self._offset)
        if chunk is None:
            return 0
        return min(int(super().in_waiting), chunk[0] - self._offset)

    def read(self, size: int = 1) -> bytes:
        """At most ``size`` bytes, all of one moment."""
        chunk = self._terminal.boundary(self._offset)
        data: bytes = super().read(min(size, 1 if chunk is None else chunk[0] - self._offset))
        if data:
            chunk = self._terminal.boundary(self._offset)
            self._offset += len(data)
            if chunk is not None:
                self._time_us = chunk[1]
        return data


def _make_raw(terminal: int) -> None:
    """No echo, no line discipline; the control characters stay as the reader set them."""
    attributes = termios.tcgetattr(terminal)
    attributes[0] &= ~(
        termios.IGNBRK | termios.BRKINT | termios.PARMRK | termios.ISTRIP
        | termios.INLCR | termios.IGNCR | termios.ICRNL | termios.IXON | termios.IXOFF
    )  # fmt: skip
    attributes[1] &= ~termios.OPOST
    attributes[2] = attributes[2] & ~(termios.CSIZE | termios.PARENB) | termios.CS8
    attributes[3] &= ~(
        termios.ECHO | termios.ECHONL | termios.ICANON | termios.ISIG | termios.IEXTEN
    )
    termios.tcsetattr(terminal, termios.TCSANOW, attributes)


def _waiting(terminal: int) -> int:
    """Bytes that lie unread in the terminal."""
    buffer = array.array("i", [0])
    fcntl.ioctl(terminal, termios.FIONREAD, buffer)
    return buffer[0]
