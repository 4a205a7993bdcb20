"""Arduinos on USB: candidate ports, and the board that answers at one."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import serial

from relpos.errors import DeviceError
from relpos.link.port import plugged_in

BOOT_BAUD = 115_200
"""Optiboot on the Uno, Arduino's STK500v2 on the Mega."""
RESET_S = 0.25
"""As long as avrdude holds DTR, so that the capacitor at the reset line discharges."""
BOOT_S = 0.05
SYNC_S = 0.2
SYNC_ATTEMPTS = 5
"""Optiboot waits for a second."""
ANSWER_S = 1.0
"""Silence of a boot loader that has answered before: a busy computer hears it late."""
_MEGA_LOADER, _MEGA_FLASH, _PAGE = 0x3E000, 0x40000, 256
_WDR = b"\xa8\x95"
SWITCH = (
    "put the XBee shield's switch to USB (SparkFun: DLINE; Arduino: USB), or take the XBee out of "
    "its socket, and try again"
)


@dataclass(frozen=True)
class Board:
    """A board that the firmware is built for."""

    name: str
    environment: str
    """PlatformIO's."""
    chip: str
    signature: bytes


BOARDS = {
    "uno": Board("uno", "uno", "ATmega328P", b"\x1e\x95\x0f"),
    "mega": Board("mega", "megaatmega2560", "ATmega2560", b"\x1e\x98\x01"),
}

_ARDUINO = (0x2341, 0x2A03)
_PRODUCTS = {0x0043: "Uno", 0x0001: "Uno", 0x0243: "Uno", 0x0010: "Mega", 0x0042: "Mega",
             0x0242: "Mega"}  # fmt: skip
_BRIDGES = {
    (0x1A86, 0x7523): "CH340 (many copies)",
    (0x1A86, 0x5523): "CH341 (many copies)",
    (0x0403, 0x6001): "FTDI (older boards, XBee adapters)",
    (0x0403, 0x6015): "FTDI (XBee adapters)",
    (0x10C4, 0xEA60): "CP2102 (copies)",
}


class UsbPort(Protocol):
    """A port as pyserial's list_ports describes it."""

    device: str
    vid: int | None
    pid: int | None


@dataclass(frozen=True)
class Candidate:
    """A port with a possible board; ``sure`` where its USB id is Arduino's own."""

    port: str
    what: str
    sure: bool


def candidates(ports: Iterable[UsbPort]) -> list[Candidate]:
    """Return ports that may be boards, by name."""
    found = []
    for port in ports:
        if port.vid is None or port.pid is None:
            continue
        if port.vid in _ARDUINO:
            name = _PRODUCTS.get(port.pid, "board")
            found.append(Candidate(port.device, f"Arduino {name}", True))
        elif (bridge := _BRIDGES.get((port.vid, port.pid))) is not None:
            found.append(Candidate(port.device, bridge, False))
    return sorted(found, key=lambda candidate: candidate.port)


def choose(ports: Iterable[UsbPort]) -> str:
    """Return the port of the only board; DeviceError where there is none, or more than one."""
    found = candidates(ports)
    sure = [candidate for candidate in found if candidate.sure] or found
    if not sure:
        raise DeviceError("no Arduino is found on USB: plug it in, or name its port")
    if len(sure) > 1:
        names = ", ".join(f"{candidate.port} ({candidate.what})" for candidate in sure)
        raise DeviceError(f"several boards are plugged in: {names}. Name the port of one")
    return sure[0].port


def find_port() -> str:
    """Return the port of the only board plugged in; DeviceError as in :func:`choose`."""
    from serial.tools.list_ports import comports

    return choose(comports())


def identify(device: serial.Serial) -> bytes:
    """Return the chip's signature from its boot loader; ``device`` is open at BOOT_BAUD.

    DeviceError where no boot loader answers.
    """
    for read_signature in (_stk500_signature, _stk500v2_signature):
        _reset(device)
        signature = read_signature(device)
        if signature is not None:
            return signature
    raise DeviceError(f"{device.port}: no board answers: {SWITCH}")


def check(device: serial.Serial, wanted: str | None) -> Board:
    """Return the board that answers; DeviceError where it is not ``wanted``, or unknown."""
    signature = identify(device)
    for board in BOARDS.values():
        if board.signature == signature:
            if wanted is not None and wanted != board.name:
                raise DeviceError(
                    f"{device.port}: this is an Arduino {board.name} ({board.chip}), not a "
                    f"{wanted}: nothing was written"
                )
            return board
    raise DeviceError(
        f"{device.port}: a chip with signature {signature.hex(' ')}, neither Uno nor Mega: nothing "
        "was written"
    )


def _reset(device: serial.Serial) -> None:
    """Restart the board through its USB chip; ports without modem lines need no reset."""
    with suppress(OSError, serial.SerialException):
        device.dtr = device.rts = False
        time.sleep(RESET_S)
        device.dtr = device.rts = True
        time.sleep(BOOT_S)


def _stk500_signature(device: serial.Serial) -> bytes | None:
    """Return the signature from an STK500 boot loader (Uno: optiboot); None where none answers.

    Atmel AVR061: 0x30 0x20 requests sync, 0x75 0x20 the signature; answers are enclosed in 0x14
    and 0x10.
    """
    if not _synced(lambda: _exchange(device, b"\x30\x20", 2, SYNC_S) == b"\x14\x10"):
        return None
    answer = _exchange(device, b"\x75\x20", 5)
    if len(answer) == 5 and answer[0] == 0x14 and answer[4] == 0x10:
        return answer[1:4]
    return None


def _synced(answered: Callable[[], bool]) -> bool:
    return any(answered() for _ in range(SYNC_ATTEMPTS))


def _exchange(
    device: serial.Serial, request: bytes, answer_bytes: int, silence_s: float = ANSWER_S
) -> bytes:
    """Return what is answered until it is whole, or nothing has come for ``silence_s``."""
    answer = b""
    with plugged_in(device):
        device.reset_input_buffer()
        device.write(request)
        until_s = time.monotonic() + silence_s
        while len(answer) < answer_bytes and time.monotonic() < until_s:
            if received := device.read(answer_bytes - len(answer)):
                answer += received
                until_s = time.monotonic() + silence_s
    return answer


class _Stk500v2:
    """The dialogue with an STK500v2 boot loader (Mega).

    Atmel AVR068: 0x1B, sequence, length (2), 0x0E, message, xor of all.
    """

    def __init__(self, device: serial.Serial) -> None:
        self._device = device
        self._sequence = 0

    def talk(self, message: bytes, answer_bytes: int, silence_s: float = ANSWER_S) -> bytes | None:
        """Return the answer's bytes from its command on; None where it is none, or a failure."""
        self._sequence = self._sequence % 255 + 1
        frame = bytes((0x1B, self._sequence, 0, len(message), 0x0E)) + message
        request = frame + bytes((_xor(frame),))
        answer = _exchange(self._device, request, 6 + answer_bytes, silence_s)
        good = (
            len(answer) == 6 + answer_bytes
            and answer[:2] == frame[:2]
            and _xor(answer) == 0
            and answer[5:7] == bytes((message[0], 0))
        )
        return answer[5:-1] if good else None

    def signs_on(self) -> bool:
        """Whether it answers: "AVRISP_2" and its length, eleven bytes."""
        return _synced(lambda: self.talk(b"\x01", 11, SYNC_S) is not None)

    def page(self, at: int) -> bytes | None:
        """Return a page of the flash; asked again where an answer is late or damaged."""
        address = (at // 2 | 1 << 31).to_bytes(4, "big")
        for _ in range(SYNC_ATTEMPTS):
            if self.talk(b"\x06" + address, 2) is None:
                continue
            read = self.talk(bytes((0x14, _PAGE >> 8, _PAGE & 0xFF, 0x20)), _PAGE + 3)
            if read is not None:
                return read[2:-1]
        return None


def _stk500v2_signature(device: serial.Serial) -> bytes | None:
    """Return the signature from an STK500v2 boot loader; None where none answers."""
    loader = _Stk500v2(device)
    if not loader.signs_on():
        return None
    signature = bytearray()
    for position in range(3):
        # 0x1B reads a byte by an ISP command: answers command, status, the byte, status.
        answer = loader.talk(bytes((0x1B, 4, 0x30, 0, position, 0)), 4)
        if answer is None:
            return None
        signature.append(answer[2])
    return bytes(signature)


def warning(device: serial.Serial, board: Board) -> str | None:
    """Return what is wrong with the boot loader that has just answered :func:`check`, or None.

    The Mega's of 2011 never touches the watchdog: its code has no WDR instruction.
    """
    if board.name != "mega":
        return None
    loader = _Stk500v2(device)
    code = bytearray()
    for at in range(_MEGA_LOADER, _MEGA_FLASH, _PAGE):
        page = loader.page(at)
        if page is None:
            return None  # an upload will tell
        code += page
    if any(code[at : at + 2] == _WDR for at in range(0, len(code), 2)):
        return None
    return (
        "this Mega's boot loader (of 2011) leaves the watchdog armed: should the firmware ever "
        "hang, the node is silent until its supply is switched off and on. A newer one cures that: "
        "Burn Bootloader of the Arduino IDE, with an ISP programmer"
    )


def _xor(data: bytes) -> int:
    value = 0
    for byte in data:
        value ^= byte
    return value
