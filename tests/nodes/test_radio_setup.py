"""Setting an XBee module on a USB adapter, whatever state it comes in."""

import os
import re
import select
import termios
import threading
import tty
from contextlib import contextmanager
from functools import partial

import pytest

from relpos.emulator.xbee import XbeeModule
from relpos.errors import DeviceError
from relpos.link.port import open_port
from relpos.nodes import radio
from support.command import relpos
from support.pulled_out import pulled_out

BAUD_OF_SPEED = {getattr(termios, f"B{baud}"): baud for baud in radio.BAUD_CODES}


class Adapter(threading.Thread):
    """A pseudo-terminal with a module behind it, which hears only its own speed."""

    def __init__(self, module):
        super().__init__(daemon=True)
        self.module = module
        self.terminal, self.port = os.openpty()
        tty.setraw(self.port)
        self.stop = threading.Event()

    def run(self):
        while not self.stop.is_set():
            if not select.select([self.terminal], [], [], 0.02)[0]:
                continue
            data = os.read(self.terminal, 4096)
            speed = BAUD_OF_SPEED[termios.tcgetattr(self.port)[5]]
            if speed == self.module.baud:
                answer = self.module.update_without_link(data)
                if answer:
                    os.write(self.terminal, answer)


class FromTheShelf:
    """A module as Digi delivers it: transparent at 9600 baud, set by text in command mode.

    Written from the manual's description of command mode, not from what we send.
    """

    def __init__(self):
        self.baud = 9600
        self.values = dict.fromkeys(
            [
                "CH",
                "ID",
                "MY",
                "DH",
                "DL",
                "MM",
                "RR",
                "RN",
                "PL",
                "CE",
                "A1",
                "SM",
                "EE",
                "AP",
                "BD",
            ],
            0,
        ) | {"CH": 0xC, "ID": 0x3332, "BD": 3, "PL": 4}
        self.kept = dict(self.values)
        self.listening = False
        self.line = b""
        self.api = None

    def update_without_link(self, data):
        if self.api is not None:
            return self.api.update_without_link(data)
        if not self.listening:
            self.listening = data == b"+++"
            return b"OK\r" if self.listening else b""
        self.line += data
        answer = b""
        while b"\r" in self.line:
            line, _, self.line = self.line.partition(b"\r")
            answer += self._obey(line.decode()) + b"\r"
        return answer

    def _obey(self, line):
        command, value = line[2:4], line[4:]
        if command == "WR":
            self.kept = dict(self.values)
        elif command == "CN":
            self.listening = False
            if self.values["AP"] == 2:
                self.api = Emulated(0x1234)
                for name, number in self.values.items():
                    self.api.module._settings[name.encode()] = number.to_bytes(4, "big")
                self.baud = 38400
        elif command not in self.values:
            return b"ERROR"
        elif value:
            self.values[command] = int(value, 16)
        else:
            return f"{self.values[command]:X}".encode()
        return b"OK"


class Emulated:
    """The emulator's module, which speaks API frames alone."""

    baud = 38400

    def __init__(self, address, escaped=True):
        self.sent = self.heard = b""
        self.module = XbeeModule(address, 7, None, self._emit, escaped=escaped)

    def _emit(self, _time_us, data):
        self.sent += data

    def update_without_link(self, data):
        self.heard += data
        self.module.from_serial(0, data)
        sent, self.sent = self.sent, b""
        return sent


@contextmanager
def adapter(module):
    thread = Adapter(module)
    thread.start()
    try:
        yield os.ttyname(thread.port)
    finally:
        thread.stop.set()
        thread.join()
        os.close(thread.terminal)
        os.close(thread.port)


def test_a_module_from_the_shelf_is_set_in_command_mode_and_kept(monkeypatch):
    monkeypatch.setattr(radio, "GUARD_S", 0.1)
    module = FromTheShelf()
    with adapter(module) as path:
        written = radio.configure(partial(open_port, path), radio.parameters(3, 0x4242, 0x0E))
    assert module.kept["MY"] == 3
    assert module.kept["ID"] == 0x4242
    assert module.kept["CH"] == 0x0E
    assert module.kept["AP"] == 2
    assert module.kept["BD"] == 5
    assert {w.parameter.command: w.before for w in written}["BD"] == 3


@pytest.mark.parametrize("escaped", [True, False])
def test_a_module_that_speaks_frames_is_set_by_frames(escaped):
    module = Emulated(9, escaped=escaped)
    with adapter(module) as path:
        radio.configure(partial(open_port, path), radio.parameters(4))
    assert module.module.address == 4
    assert module.module._settings[b"AP"] == b"\2"
    assert module.module._settings[b"RN"] == b"\3"
    assert b"WR" in module.heard


class OfItsOwnSpeed(Emulated):
    """A module that speaks API frames at 9600 baud until it is set to another speed."""

    def __init__(self):
        super().__init__(9)
        self.baud = 9600
        self.module._settings[b"BD"] = b"\3"

    def update_without_link(self, data):
        if b"BD\5" in data:  # which the emulator's refuses
            self.baud = 38400
            self.module._settings[b"BD"] = b"\5"
        return super().update_without_link(data)


def test_a_module_that_speaks_frames_at_another_speed_is_followed_to_the_teams(monkeypatch):
    monkeypatch.setattr(radio, "GUARD_S", 0.1)
    module = OfItsOwnSpeed()
    with adapter(module) as path:
        written = radio.configure(partial(open_port, path), radio.parameters(3))
    assert module.baud == 38400
    assert b"WR" in module.heard
    assert {w.parameter.command: w.before for w in written}["BD"] == 3


class Lossy:
    """A module some of whose answers are lost."""

    def __init__(self, module, lost):
        self.module = module
        self.lost = lost
        self.answers = 0

    @property
    def baud(self):
        return self.module.baud

    def update_without_link(self, data):
        answer = self.module.update_without_link(data)
        self.answers += bool(answer)
        return b"" if answer and self.answers in self.lost else answer


@pytest.mark.parametrize("make", [FromTheShelf, partial(Emulated, 9)])
def test_a_lost_answer_is_asked_for_again(monkeypatch, make):
    monkeypatch.setattr(radio, "GUARD_S", 0.1)
    module = Lossy(make(), {4, 12, 13, 24})
    with adapter(module) as path:
        written = radio.configure(partial(open_port, path), radio.parameters(3, 0x4242, 0x0E))
    assert module.answers > 24
    assert [w.parameter.command for w in written][-2:] == ["AP", "BD"]


def test_a_port_without_a_module_is_reported(monkeypatch):
    monkeypatch.setattr(radio, "GUARD_S", 0.01)
    monkeypatch.setattr(radio, "ANSWER_S", 0.02)

    class Deaf:
        baud = 0

    with adapter(Deaf()) as path, pytest.raises(DeviceError, match="no XBee module answers"):
        radio.find_module(partial(open_port, path))


def test_other_firmware_is_named():
    module = Emulated(1)
    del module.module._settings[b"MM"]
    with adapter(module) as path, pytest.raises(DeviceError, match=r"ATMM.*802\.15\.4 firmware"):
        radio.configure(partial(open_port, path), radio.parameters(1))


node_radio = partial(relpos, "node", "radio")


def test_the_lines_are_printed_without_a_port():
    lines = node_radio("--node", 18).stdout.splitlines()
    words = [line.split()[0] for line in lines]
    assert words[0] == "+++"
    assert "ATMY12" in words  # hexadecimal
    assert words[-4:] == ["ATAP2", "ATBD5", "ATWR", "ATCN"]
    assert "ATMY0" in node_radio("--coordinator").stdout


def test_the_command_writes_a_module():
    with adapter(Emulated(9)) as path:
        done = node_radio(path, "--node", 5)
    assert done.exit_code == 0, done.stderr
    assert re.search(r"MY\W+9\W+5", done.stdout)


@pytest.mark.parametrize(
    "arguments", [(), ("--node", 1, "--coordinator"), ("--node", 1, "--channel", "1B")]
)
def test_contradicting_arguments_are_wrong_usage(arguments):
    assert node_radio(*arguments).exit_code == 2


def test_an_adapter_that_is_pulled_out_is_one_line_with_its_port(monkeypatch):
    monkeypatch.setattr(radio, "GUARD_S", 0.1)
    with pulled_out() as path:
        done = node_radio(path, "--node", 5)
    assert done.exit_code == 1
    assert done.stderr.splitlines()[-1].startswith(f"relpos: {path}: the port vanished: ")
