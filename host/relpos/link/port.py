"""The link of one coordinator, and its serial port: bytes in, observations out, commands back."""

from __future__ import annotations

import errno
import os
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

import serial

from relpos.errors import DeviceError
from relpos.link import xbee
from relpos.link.authentication import HostCounter, clock_fault, of_node
from relpos.link.decoder import Decoder
from relpos.measurements import BOUNDS, Observation
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.protocol.schema import Message
from relpos.said import Said

BAUD = 38_400
"""0.2 % off on the ATmega at 16 MHz, where 115200 is 2.1 % off; the coordinator uses the same."""
READ_TIMEOUT_S = 0.05
"""Longest wait for bytes; bounds the delay with which silence is noticed."""
READ_BYTES = 4096
PSEUDO_TERMINALS = ("/dev/pts/", "/dev/ttys")
"""Of Linux and macOS."""
FAILURES: tuple[type[Exception], ...] = (serial.SerialException, OSError, TypeError)
"""Of a port that vanishes; pyserial raises TypeError where it is closed under a waiting read."""
with suppress(ImportError):
    import termios

    FAILURES += (termios.error,)  # pyserial passes it on where it discards what has come in
UNOPENED: tuple[type[Exception], ...] = (*FAILURES, ValueError)
UNMARKED_FRAMES = 10
"""A reader that joins an emulated team in the middle gets a few frames before the first mark."""


class Line(Protocol):
    """A port as the link uses it: pyserial's, or a node's cable in its place."""

    @property
    def port(self) -> str | None:
        """Its name."""

    @property
    def in_waiting(self) -> int:
        """Number of bytes that are there."""

    def read(self, size: int = 1) -> bytes:
        """At most ``size`` bytes; fewer after a timeout."""

    def write(self, data: bytes) -> int | None:
        """Send."""


class Link:
    """XBee bytes to observations, and commands to bytes; without I/O.

    ``key`` is the team's. ``clock`` gives Unix time (default: the computer's), from which sent
    frames are counted; ``newest_counters`` are the nodes' from an earlier session (see
    :mod:`relpos.link.authentication`).
    """

    def __init__(
        self,
        *,
        key: bytes = wire.DEFAULT_KEY,
        clock: Callable[[], float] | None = None,
        newest_counters: Mapping[int, int] | None = None,
    ) -> None:
        self.parser = xbee.Parser()
        self.decoder = Decoder((key,), newest_counters)
        self.key = key
        self.counters_before = dict(newest_counters or {})
        self.node_keys: dict[int, bytes] = {}
        """Of nodes that have another key than the team's gives them, while that changes."""
        self._clock = clock or time.time
        self._counters: dict[int, HostCounter] = {}
        # Not from 0: a node answers for what an earlier session sent it under the same token.
        self._token = int(self._clock() * 10) % 0xFFFF
        self.virtual_s: float | None = None
        """Virtual time of an emulated team that marks it; None for a real team."""
        self._faults_told: set[int] = set()
        """Addressees whose counters a wrong clock has met; remarked on once."""
        self._unmarked = 0
        """Frames of nodes before the first mark of virtual time."""

    @property
    def keyless(self) -> bool:
        """Whether the key is the one that every new node has, which everybody knows."""
        return self.key == wire.DEFAULT_KEY

    def newest_counters(self) -> dict[int, int]:
        """Return the newest counter of each node heard, for the next session."""
        return {n: track.window.newest for n, track in self.decoder.nodes.items()}

    def feed(self, data: bytes, arrival_s: float) -> list[Observation]:
        """Return the observations completed by ``data``, whose last byte arrived at ``arrival_s``.

        Virtual time frames of an emulated team replace ``arrival_s`` from then on. A real team
        has none: what looks like one after :data:`UNMARKED_FRAMES` frames is line noise.
        """
        observations: list[Observation] = []
        for frame in self.parser.feed(data):
            if self.virtual_s is not None:
                arrival_s = self.virtual_s
            if isinstance(frame, xbee.Receive16 | xbee.Receive64 | xbee.ReceivePacket):
                observations += self._decode(frame, arrival_s)
            elif not self._is_mark(frame):
                self.decoder.counts[type(frame).__name__] += 1
                continue
            self._unmarked += self.virtual_s is None
        return observations

    def _decode(
        self, frame: xbee.Receive16 | xbee.Receive64 | xbee.ReceivePacket, arrival_s: float
    ) -> list[Observation]:
        rssi_dbm = None if isinstance(frame, xbee.ReceivePacket) else frame.rssi_dbm
        try:
            return self.decoder.feed(frame.data, arrival_s, rssi_dbm)
        except Exception as error:  # No node ends a session: what is wrong with this frame is told.
            counts = self.decoder.counts
            counts["frames_failed"] += 1
            if counts["frames_failed"] == 1:
                text = Said(
                    "undecodable", "a frame could not be decoded: {error}", error=repr(error)
                )
                self.decoder.remarks.append(text)
            return []

    def _is_mark(self, frame: object) -> bool:
        """Set the virtual time if the frame marks one that an emulated team can have."""
        if not isinstance(frame, xbee.UnknownFrame) or frame.type != xbee.VIRTUAL_TIME:
            return False
        virtual_s = int.from_bytes(frame.data, "big") * 1e-6
        if (
            len(frame.data) != 8
            or self._unmarked >= UNMARKED_FRAMES
            or not (self.virtual_s or 0.0) <= virtual_s <= BOUNDS["time_s"][1]
        ):
            return False
        self.virtual_s = virtual_s
        return True

    def command(
        self,
        node: int,
        code: wire.CommandCode,
        value: int,
        *,
        token: int | None = None,
        broadcast: bool = False,
    ) -> tuple[int, bytes]:
        """Return token and serial bytes of a command; a node executes one token once.

        ``broadcast`` sends it to every radio module, for a node whose module has another address;
        only that node obeys.
        """
        token = self.next_token() if token is None else token
        values = {"token": token, "command": code, "value": value}
        return token, self.frame(wire.COMMAND, node, values, broadcast=broadcast)

    def new_keys(self, node: int, keys: bytes, *, token: int) -> bytes:
        """Return serial bytes that give ``node`` its own and the beacon's key, masked by the old.

        The node answers under the new key.
        """
        counter = self._next_counter(node)
        values = framing.masked_keys(self.key_of(node), token, counter, keys)
        return self._sealed(wire.NEW_KEY, node, counter, values, False)

    def key_of(self, node: int) -> bytes:
        """Return the key of frames to a node, or of beacons (:data:`wire.BROADCAST`)."""
        return self.node_keys.get(node) or framing.node_key(self.key, node)

    def accept_keys(self, *keys: bytes) -> None:
        """Send under the first team's key from now on, and accept frames under any of them."""
        self.key = keys[0]
        self.decoder.keys = keys

    def frame(
        self, message: Message, node: int, values: Mapping[str, Any], *, broadcast: bool = False
    ) -> bytes:
        """Return the serial bytes of a message to ``node``; ``broadcast``: see :meth:`command`."""
        return self._sealed(message, node, self._next_counter(node), values, broadcast)

    def _next_counter(self, node: int) -> int:
        counter = self._counters.setdefault(node, HostCounter(self._clock))
        newest = self.decoder.refused_counters.pop(node, None)
        wrong = None if newest is None else counter.follow(newest)
        if wrong is not None and node not in self._faults_told:
            self._faults_told.add(node)
            self.decoder.remarks.append(of_node(node, wrong))
        return counter.next()

    def _sealed(
        self, message: Message, node: int, counter: int, values: Mapping[str, Any], broadcast: bool
    ) -> bytes:
        fault = self.clock_fault()
        if fault and not self._faults_told:
            self._faults_told.add(node)
            self.decoder.remarks.append(fault)
        data = framing.encode(message, node, 0, counter, values, self.key_of(node))
        address = xbee.BROADCAST_16 if broadcast or node == wire.BROADCAST else node
        return xbee.encode(xbee.Transmit16(0, address, data))

    def challenges(self) -> bytes:
        """Return the bytes for nodes whose frame counters do not fit; see the decoder."""
        data, waiting = b"", self.decoder.challenges
        while waiting:
            c = waiting.popleft()
            data += self.command(c.node, wire.CommandCode.PING, c.value, token=c.token)[1]
        return data

    def clock_fault(self) -> str | None:
        """Say in a line why nodes may refuse what this host sends; None where nothing is wrong."""
        return clock_fault(self._clock())

    def next_token(self) -> int:
        """Return a token that the last 65,534 commands did not have."""
        self._token = self._token % 0xFFFF + 1
        return self._token

    def summary(self) -> dict[str, float]:
        """Return the counts of the whole link: frames, losses, rejections."""
        counters: dict[str, float] = {**self.decoder.counts, **asdict(self.parser.counts)}
        for track in self.decoder.nodes.values():
            for name, count in track.counts.items():
                counters[name] = counters.get(name, 0) + count
        return counters


def check_port(port: str) -> None:
    """Raise DeviceError where there is no such port, without opening it."""
    fault = _address_fault(port)
    if fault:
        raise _cannot_open(port, ValueError(fault))
    try:
        serial.serial_for_url(port, do_not_open=True)
    except (serial.SerialException, OSError, ValueError) as error:
        raise _cannot_open(port, error) from error
    if "://" not in port and os.name == "posix" and not Path(port).exists():
        raise _cannot_open(port, FileNotFoundError(port))


def open_port(port: str, baud: int = BAUD) -> serial.Serial:
    """Open the serial port (or pyserial URL) ``port`` exclusively; DeviceError with the reason."""
    try:
        # Two programs at one port would each get some of the bytes without noticing.
        device: serial.Serial = serial.serial_for_url(
            port, baudrate=baud, timeout=READ_TIMEOUT_S, exclusive=True
        )
    except UNOPENED as error:
        raise _cannot_open(port, error) from error
    return device


def _cannot_open(port: str, error: Exception) -> DeviceError:
    known = "://" in port or Path(port).exists()
    reason = (_address_fault(port) or _reason(error)) if known else "no such device"
    return DeviceError(
        Said(
            "port-closed",
            "{port}: cannot open the serial port: {reason}",
            port=port,
            reason=reason,
        )
    )


def _address_fault(port: str) -> str | None:
    """Say what is wrong with an address in the network: pyserial shows how its own check fails."""
    scheme, found, _ = port.partition("://")
    if not found or scheme.lower() not in ("socket", "rfc2217"):
        return None
    try:
        parts = urlsplit(port)
        complete = parts.hostname and parts.port is not None
    except ValueError as error:
        return str(error)
    return None if complete else f"HOST:PORT is missing, as in {scheme}://HOST:PORT"


def incarnation(port: str) -> object:
    """Return what tells the pseudo-terminal behind the name ``port`` from the next one there.

    None for any other port. Numbers of pseudo-terminals are given again at once, and to whoever
    asks: only a link to one that was made anew is known to lead to its successor.
    """
    if not os.path.realpath(port).startswith(PSEUDO_TERMINALS):
        return None
    try:
        found = os.lstat(port)
    except OSError:
        return port
    return (found.st_ino, found.st_ctime_ns) if stat.S_ISLNK(found.st_mode) else port


def send(device: Line, data: bytes) -> None:
    """Write ``data``, if there is any; DeviceError where the port has vanished."""
    if data:
        with plugged_in(device):
            device.write(data)


@contextmanager
def plugged_in(device: Line) -> Iterator[None]:
    """Raise DeviceError where the open port vanishes meanwhile."""
    try:
        yield
    except FAILURES as error:
        raise vanished(device, error) from error


def vanished(device: Line, error: Exception) -> DeviceError:
    """Return the error for an open port that fails."""
    return DeviceError(
        Said(
            "port-gone",
            "{port}: the port vanished: {reason}",
            port=str(device.port),
            reason=_reason(error),
        )
    )


def _reason(error: Exception) -> str:
    if "exclusively lock" in str(error):
        return "another program has it open"
    # termios says so, and pyserial's own error has no number.
    if getattr(error.__context__, "args", ())[:1] == (errno.ENOTTY,):
        return "not a serial port"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error.args[-1] if error.args else error).splitlines()[0]


def stopwatch() -> Callable[[], float]:
    """Return a clock: monotonic seconds from now."""
    start_s = time.monotonic()
    return lambda: time.monotonic() - start_s


def observe(
    device: Line,
    link: Link,
    clock: Callable[[], float] | None = None,
) -> Iterator[list[Observation]]:
    """Yield lists of observations as they arrive, an empty one after each silent READ_TIMEOUT_S.

    ``clock`` gives the host's time in seconds (default: monotonic, from 0 at the first call).
    DeviceError when the port vanishes, after everything received before has been yielded.
    """
    clock = clock or stopwatch()
    while True:
        with plugged_in(device):
            data = device.read(max(1, min(device.in_waiting, READ_BYTES)))
        yield link.feed(data, clock())
