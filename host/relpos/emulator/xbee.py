"""XBee 802.15.4 modules (Series 1 / S2C, API mode 2) and the air between them.

A node's module takes bytes from the node's UART, the coordinator's module from the host's serial
port; both speak the API frames of link/xbee.py. Loss, delay and signal strength are the world's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from relpos.link.xbee import (
    ApiFrame,
    AtCommand,
    AtResponse,
    ModemStatus,
    Parser,
    Receive16,
    Receive64,
    Transmit16,
    TransmitStatus,
    UnknownFrame,
    encode,
)
from relpos.protocol.messages import CABLE_OPTIONS

DELIVERED = 0
NO_ACKNOWLEDGEMENT = 1
TOO_LARGE = 0x74
MOST_PAYLOAD = 100
"""RF data of a Series 1 module without encryption."""
BROADCAST = 0xFFFF
NO_ADDRESS = 0xFFFE
LONG_ADDRESS_ONLY = 0xFFFF
SERIAL_HIGH = 0x0013A200
PAN_BROADCAST = 0x04
ADDRESS_BROADCAST_OPTION = 0x02
TRANSMIT_64 = 0x00
QUEUED_AT_COMMAND = 0x09
HARDWARE_RESET = 0

AT_OK = 0
AT_BAD_COMMAND = 2
AT_BAD_PARAMETER = 3

Report = Callable[[int, int], None]
"""(time, transmit status) -> None."""

_BAUD_RATES = {1200: 0, 2400: 1, 4800: 2, 9600: 3, 19200: 4, 38400: 5, 57600: 6, 115200: 7}


def line_time_us(byte_count: int, baud: int) -> int:
    """Time of ``byte_count`` bytes, 10 bits each, on a serial line; rounded up."""
    return -(-byte_count * 10_000_000 // baud)


@dataclass(frozen=True, slots=True)
class Transmission:
    """What a module hands to the air: to a 16-bit address, or a serial number where ``long``."""

    sender: XbeeModule
    destination: int
    long: bool
    data: bytes
    time_us: int
    report: Report


class Air(Protocol):
    """What a module needs of the radio: who receives it, when, and how loud."""

    def send(self, sent: Transmission) -> None:
        """Transmit; later call ``sent.report(time_us, status)`` once."""


class XbeeModule:
    """One module: UART on one side, air on the other.

    ``on_serial(time_us, data)`` is called with what leaves the module's UART and the time its
    last byte has left. ``counts`` says what was sent, lost, refused and received.
    """

    def __init__(
        self,
        address: int,
        serial_number: int,
        air: Air,
        on_serial: Callable[[int, bytes], None],
        *,
        baud: int = 38_400,
        escaped: bool = True,
    ) -> None:
        self.serial_number = SERIAL_HIGH << 32 | serial_number
        self.baud = baud
        self.on_serial = on_serial
        self.counts: Counter[str] = Counter()
        self.air = air
        self.line_fault: Callable[[bytes, bool], bytes] = lambda data, _to_module: data
        """Fault: (bytes, whether they go to the module) -> what arrives of them."""
        self._escaped = escaped
        self._parser = Parser(escaped=escaped)
        self._line_free_us = 0
        self._last_rssi = 0
        self._queued: dict[bytes, bytes] = {}
        # As `relpos node radio` sets a module up.
        self._settings: dict[bytes, bytes] = {
            b"MY": address.to_bytes(2, "big"),
            b"ID": b"\x33\x32",
            b"CH": b"\x0c",
            b"SH": SERIAL_HIGH.to_bytes(4, "big"),
            b"SL": serial_number.to_bytes(4, "big"),
            b"AP": b"\2" if escaped else b"\1",
            b"BD": bytes((_BAUD_RATES.get(baud, 3),)),
            b"CE": b"\0",
            b"EE": b"\0",
            b"DH": bytes(4),
            b"DL": bytes(4),
            b"MM": b"\0",
            b"RR": b"\0",
            b"RN": b"\3",
            b"A1": b"\0",
            b"SM": b"\0",
            b"NI": f"NODE{address}".encode(),
            b"NP": MOST_PAYLOAD.to_bytes(2, "big"),
            b"PL": b"\4",
            b"VR": b"\x10\xe8",
            b"HV": b"\x17\x44",
        }

    @property
    def address(self) -> int:
        """16-bit address, MY."""
        return int.from_bytes(self._settings[b"MY"], "big")

    # -- from the UART ------------------------------------------------------------------------

    def from_serial(self, time_us: int, data: bytes) -> None:
        """Bytes that have arrived on the module's UART by ``time_us``."""
        for frame in self._parser.feed(self.line_fault(data, True)):
            self._handle(frame, time_us)

    def restart(self, time_us: int) -> None:
        """Supply off and on again: a frame half received is lost; the reset is reported."""
        self._parser = Parser(escaped=self._escaped)
        self._line_free_us = time_us
        self._emit(time_us, ModemStatus(HARDWARE_RESET))

    def _handle(self, frame: ApiFrame, time_us: int) -> None:
        if isinstance(frame, Transmit16):
            destination = BROADCAST if frame.options & PAN_BROADCAST else frame.destination
            self._transmit(frame.frame_id, destination, False, frame.data, time_us)
        elif isinstance(frame, AtCommand):
            self._at(frame, time_us)
        elif isinstance(frame, UnknownFrame) and frame.type == QUEUED_AT_COMMAND:
            if len(frame.data) < 3:
                self.counts["short_requests"] += 1
            else:
                self._at(AtCommand.parse(frame.data), time_us, queued=True)
        elif isinstance(frame, UnknownFrame) and frame.type == TRANSMIT_64:
            if len(frame.data) < 10:
                self.counts["short_requests"] += 1
                return
            destination = int.from_bytes(frame.data[1:9], "big")
            if destination <= 0xFFFF:  # 64-bit broadcast and coordinator
                self._transmit(frame.data[0], destination, False, frame.data[10:], time_us)
            else:
                self._transmit(frame.data[0], destination, True, frame.data[10:], time_us)
        else:
            self.counts["unknown_requests"] += 1

    def _transmit(
        self, frame_id: int, destination: int, long: bool, data: bytes, time_us: int
    ) -> None:
        def report(at_us: int, status: int) -> None:
            if status == DELIVERED:
                self.counts["sent"] += 1
            else:
                self.counts["not_sent"] += 1
            if frame_id:
                self._emit(at_us, TransmitStatus(frame_id, status))

        if len(data) > MOST_PAYLOAD:
            report(time_us, TOO_LARGE)
            return
        self.air.send(Transmission(self, destination, long, data, time_us, report))

    def _at(self, frame: AtCommand, time_us: int, *, queued: bool = False) -> None:
        """Carry out or answer a command.

        A queued value is in force from the next command on that is not queued; until then queries
        show the old value.
        """
        command = frame.command.upper()
        status, value = AT_OK, b""
        if not queued:
            self._settings |= self._queued
            self._queued.clear()
        if command in (b"WR", b"AC", b"RE", b"FR"):
            pass
        elif command == b"DB":
            value = bytes((self._last_rssi,))
        elif command not in self._settings:
            status = AT_BAD_COMMAND
        elif not frame.value:
            value = self._settings[command]
        elif command in (b"SH", b"SL", b"NP", b"VR", b"HV"):
            status = AT_BAD_COMMAND
        else:
            status = self._set(command, frame.value, self._queued if queued else self._settings)
        if frame.frame_id:
            self._emit(time_us, AtResponse(frame.frame_id, command, status, value))
        escaped = self._settings[b"AP"] == b"\2"
        if escaped is not self._escaped:
            self._escaped = escaped
            self._parser = Parser(escaped=self._escaped)

    def _set(self, command: bytes, value: bytes, settings: dict[bytes, bytes]) -> int:
        if command != b"NI":
            width = len(self._settings[command])
            value = value.lstrip(b"\0").rjust(width, b"\0")
            if len(value) > width:
                return AT_BAD_PARAMETER
        if command == b"AP" and value not in (b"\1", b"\2"):
            return AT_BAD_PARAMETER
        if command == b"BD" and value != self._settings[command]:
            # The line's other end keeps its speed: a module that left it would be deaf for good.
            return AT_BAD_PARAMETER
        settings[command] = value
        return AT_OK

    # -- to the UART --------------------------------------------------------------------------

    def deliver(
        self, source: XbeeModule, rssi_dbm: int, data: bytes, broadcast: bool, time_us: int
    ) -> None:
        """Data that came over the air at ``time_us``."""
        self._last_rssi = -rssi_dbm
        self.counts["received"] += 1
        options = ADDRESS_BROADCAST_OPTION if broadcast else 0
        frame: ApiFrame
        if source.address in (NO_ADDRESS, LONG_ADDRESS_ONLY):
            frame = Receive64(source.serial_number, rssi_dbm, data, options)
        else:
            frame = Receive16(source.address, rssi_dbm, data, options)
        self._emit(time_us, frame)

    def deliver_by_cable(self, data: bytes, time_us: int) -> None:
        """Data from a host on the board's USB cable, in the module's place."""
        self._emit(time_us, Receive16(0, 0, data, CABLE_OPTIONS))

    def _emit(self, time_us: int, frame: ApiFrame) -> None:
        data = self.line_fault(encode(frame, escaped=self._escaped), False)
        if not data:
            return
        begin = max(time_us, self._line_free_us)
        self._line_free_us = begin + line_time_us(len(data), self.baud)
        self.on_serial(self._line_free_us, data)
