"""An XBee module on a USB adapter: what it has to be set to, and setting it.

802.15.4 firmware (Series 1, S2C or XBee 3 with 802.15.4). A module from the shelf is transparent at
9600 baud and is set in command mode ("+++"); one that has been set up before speaks API frames.
Meaning of the parameters: Digi's 802.15.4 manual, from memory: check.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import serial

from relpos.errors import DeviceError
from relpos.link import xbee
from relpos.link.port import BAUD, plugged_in

FACTORY_BAUD = 9600
BAUD_CODES = {1200: 0, 2400: 1, 4800: 2, 9600: 3, 19200: 4, 38400: 5, 57600: 6, 115200: 7}
DEFAULT_PAN = 0x3332
DEFAULT_CHANNEL = 0x0C
CHANNELS = range(0x0B, 0x1B)
GUARD_S = 1.1
"""Silence before and after "+++": GT is one second from the shelf."""
ANSWER_S = 0.5
"""A module answers within some 10 ms; writing its memory takes longer."""
WRITE_S = 2.0
ATTEMPTS = 3
"""A command may be asked again: it sets, or says, the same."""
_STATUS = {1: "error", 2: "unknown command", 3: "bad value"}


@dataclass(frozen=True)
class Parameter:
    """One AT parameter and the value it has to have."""

    command: str
    value: int
    meaning: str

    def line(self) -> str:
        """As it is typed in command mode."""
        return f"AT{self.command}{self.value:X}"


def parameters(
    address: int, pan: int = DEFAULT_PAN, channel: int = DEFAULT_CHANNEL
) -> list[Parameter]:
    """Everything a module is set to; ``address`` is the node's id, 0 for the coordinator.

    ``AP`` and ``BD`` come last: they change how one speaks with the module.
    """
    whose = "the coordinator" if address == 0 else f"node {address}"
    return [
        Parameter("CH", channel, f"channel {channel}, the same for all"),
        Parameter("ID", pan, "network, the same for all"),
        Parameter("MY", address, f"16-bit address: {whose}"),
        Parameter("DH", 0, "destination, high: 16-bit addresses"),
        Parameter("DL", 0, "destination, low: the coordinator"),
        Parameter("MM", 0, "MAC mode: acknowledged, repetitions dropped by the receiver"),
        Parameter("RR", 0, "no retries besides the MAC's three: the next total makes up for it"),
        Parameter("RN", 3, "random delay before the first attempt: nodes do not collide in step"),
        Parameter("PL", 4, "full power"),
        Parameter("CE", 0, "no coordinator in the MAC's sense"),
        Parameter("A1", 0, "no association"),
        Parameter("SM", 0, "no sleep"),
        Parameter("EE", 0, "no encryption: frames carry their own tag"),
        Parameter("AP", 2, "API frames with escapes"),
        Parameter("BD", BAUD_CODES[BAUD], f"{BAUD} baud"),
    ]


def command_lines(wanted: Sequence[Parameter]) -> list[tuple[str, str]]:
    """(line, what it does) for X-CTU's console or any terminal."""
    return [
        ("+++", "no Enter, a second of silence before and after; the module says OK"),
        *((parameter.line(), parameter.meaning) for parameter in wanted),
        ("ATWR", "keep it all"),
        ("ATCN", "leave command mode: from here on API frames at the new speed"),
    ]


class Access(Protocol):
    """A module that answers."""

    device: serial.Serial

    def get(self, command: str) -> int:
        """A parameter's value. DeviceError where the module does not know it or is silent."""

    def set(self, command: str, value: int) -> None:
        """Set it. DeviceError where the module refuses or is silent."""

    def keep(self) -> None:
        """Write everything into the module's memory and let it take effect."""


class CommandMode:
    """Text commands after "+++"."""

    def __init__(self, device: serial.Serial) -> None:
        self.device = device

    def enter(self) -> bool:
        """Whether the module answers "+++"."""
        time.sleep(GUARD_S)
        _write(self.device, b"+++")
        return self._answer(GUARD_S + ANSWER_S) == "OK"

    def get(self, command: str) -> int:
        """See Access."""
        answer = self._ask(f"AT{command}")
        try:
            return int(answer, 16)
        except ValueError:
            raise DeviceError(_refused(command, None, answer)) from None

    def set(self, command: str, value: int) -> None:
        """See Access."""
        answer = self._ask(f"AT{command}{value:X}")
        if answer != "OK":
            raise DeviceError(_refused(command, value, answer))

    def keep(self) -> None:
        """See Access."""
        for command in ("ATWR", "ATCN"):
            if self._ask(command, WRITE_S) != "OK":
                raise DeviceError(f"the XBee module does not confirm {command}")

    def _ask(self, line: str, wait_s: float = ANSWER_S) -> str:
        for _ in range(ATTEMPTS):
            _write(self.device, line.encode() + b"\r")
            answer = self._answer(wait_s)
            if answer:
                return answer
        return ""

    def _answer(self, wait_s: float) -> str:
        until_s = time.monotonic() + wait_s
        answer = bytearray()
        with plugged_in(self.device):
            while time.monotonic() < until_s and not answer.endswith(b"\r"):
                answer += self.device.read(1)
        return answer.decode("ascii", errors="replace").strip()


class ApiMode:
    """AT commands in API frames; takes effect at once."""

    def __init__(self, device: serial.Serial, *, escaped: bool = True) -> None:
        self.device = device
        self.escaped = escaped
        self._frame_id = 0

    def answers(self) -> bool:
        """Whether there is a module that speaks so; learns whether it escapes."""
        # Neither the question (as frame 1) nor the answer holds a byte that would be escaped.
        answer = self._ask_once("AP", b"")  # Once: most speeds have nobody.
        if answer is None or answer.status != 0:
            return False
        self.escaped = int.from_bytes(answer.value, "big") == 2
        return True

    def get(self, command: str) -> int:
        """See Access."""
        return int.from_bytes(self._ask(command, b"").value, "big")

    def set(self, command: str, value: int) -> None:
        """See Access."""
        width = max((value.bit_length() + 7) // 8, 1)
        self._ask(command, value.to_bytes(width, "big"), value)

    def keep(self) -> None:
        """See Access."""
        self._ask("WR", b"", wait_s=WRITE_S)

    def _ask(
        self, command: str, value: bytes, shown: int | None = None, wait_s: float = ANSWER_S
    ) -> xbee.AtResponse:
        for _ in range(ATTEMPTS):
            answer = self._ask_once(command, value, wait_s)
            if answer is not None and answer.status != 0:
                refused = _STATUS.get(answer.status, "refused")
                raise DeviceError(_refused(command, shown, refused))
            if answer is not None:
                return answer
        raise DeviceError(_refused(command, shown, ""))

    def _ask_once(
        self, command: str, value: bytes, wait_s: float = ANSWER_S
    ) -> xbee.AtResponse | None:
        self._frame_id = self._frame_id % 255 + 1
        request = xbee.AtCommand(self._frame_id, command.encode(), value)
        # A module in use also delivers what it hears: only the answer to this frame counts.
        parser = xbee.Parser(escaped=self.escaped)
        _write(self.device, xbee.encode(request, escaped=self.escaped))
        until_s = time.monotonic() + wait_s
        while time.monotonic() < until_s:
            with plugged_in(self.device):
                data = self.device.read(max(1, self.device.in_waiting))
            for frame in parser.feed(data):
                if isinstance(frame, xbee.AtResponse) and frame.frame_id == self._frame_id:
                    return frame
        return None


def _write(device: serial.Serial, data: bytes) -> None:
    """Send; what has come in before is no answer."""
    with plugged_in(device):
        device.reset_input_buffer()
        device.write(data)


def _refused(command: str, value: int | None, answer: str) -> str:
    what = f"AT{command}" + ("" if value is None else f"{value:X}")
    if not answer:
        return f"the XBee module does not answer {what}"
    return f"the XBee module refuses {what} ({answer.lower()}): does it have 802.15.4 firmware?"


def find_module(open_at: Callable[[int], serial.Serial]) -> Access:
    """The module behind ``open_at(baud)``, however it is set. DeviceError where none answers.

    Tries what the project sets, then what the shelf has, then everything else.
    """
    for baud in dict.fromkeys((BAUD, FACTORY_BAUD, 115200, 57600, 19200, 4800, 2400, 1200)):
        if (access := _answering(open_at(baud))) is not None:
            return access
    raise DeviceError(
        "no XBee module answers on this port: is it in a USB adapter of its own (on a node's "
        "shield the microcontroller drives the same line)?"
    )


def _answering(device: serial.Serial) -> Access | None:
    """The module as it answers at this speed; None, and the device closed, where it does not."""
    api = ApiMode(device)
    if api.answers():
        return api
    text = CommandMode(device)
    if text.enter():
        return text
    device.close()
    return None


@dataclass(frozen=True)
class Written:
    """A parameter, and what the module had before."""

    parameter: Parameter
    before: int


def configure(
    open_at: Callable[[int], serial.Serial], wanted: Sequence[Parameter]
) -> list[Written]:
    """Set a module, keep it, and read everything back at the speed it then has.

    DeviceError says what was refused or is not as it was set. What was set before a refusal is not
    kept: the module has forgotten it once it is unplugged.
    """
    access = find_module(open_at)
    try:
        written = [Written(parameter, access.get(parameter.command)) for parameter in wanted]
        for parameter in wanted:
            access.set(parameter.command, parameter.value)
            if isinstance(access, ApiMode) and parameter.command == "AP":
                access.escaped = parameter.value == 2
            if isinstance(access, ApiMode) and parameter.command == "BD":
                access = _after_baud(access, open_at, parameter.value)
        access.keep()
    finally:
        access.device.close()
    device = open_at(BAUD)
    try:
        api = ApiMode(device)
        for parameter in wanted:
            value = api.get(parameter.command)
            if value != parameter.value:
                raise DeviceError(
                    f"the XBee module has {parameter.command}={value:X} instead of "
                    f"{parameter.value:X}"
                )
    finally:
        device.close()
    return written


def _after_baud(access: ApiMode, open_at: Callable[[int], serial.Serial], code: int) -> ApiMode:
    """The same module at its new speed."""
    baud = next(rate for rate, known in BAUD_CODES.items() if known == code)
    if access.device.baudrate == baud:
        return access
    access.device.close()
    return ApiMode(open_at(baud), escaped=access.escaped)
