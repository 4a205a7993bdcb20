"""What a boot loader is asked, where no simulated board is needed to see it."""

from functools import reduce
from operator import xor
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from relpos.cli.main import app
from relpos.nodes import boards
from support.pulled_out import pulled_out

LOADS_ADDRESS, READS_FLASH = 0x06, 0x14
READ_S, CHUNK = 0.15, 64


class LateMega:
    """A Mega's boot loader whose answers reach a busy computer in pieces."""

    def __init__(self, flash):
        self.flash, self.at, self.answer, self.now_s = flash, 0, b"", 0.0

    def reset_input_buffer(self):
        self.answer = b""

    def write(self, frame):
        assert reduce(xor, frame) == 0
        command, told = frame[5], frame[5:-1]
        body = bytes((command, 0))
        if command == LOADS_ADDRESS:
            self.at = 2 * (int.from_bytes(told[1:5], "big") & 0x7FFFFFFF)
        elif command == READS_FLASH:
            size = int.from_bytes(told[1:3], "big")
            body += self.flash[self.at : self.at + size] + b"\0"
        answer = bytes((0x1B, frame[1], *len(body).to_bytes(2, "big"), 0x0E)) + body
        self.answer = answer + bytes((reduce(xor, answer),))

    def read(self, size):
        self.now_s += READ_S
        read, self.answer = self.answer[: min(size, CHUNK)], self.answer[min(size, CHUNK) :]
        return read


@pytest.mark.parametrize("feeds_the_watchdog", [True, False])
def test_a_busy_computer_reads_a_boot_loader_to_its_end(monkeypatch, feeds_the_watchdog):
    flash = bytearray(0x40000)
    if feeds_the_watchdog:
        flash[-2:] = b"\xa8\x95"
    mega = LateMega(bytes(flash))
    clock = SimpleNamespace(monotonic=lambda: mega.now_s)
    monkeypatch.setattr(boards, "time", clock)
    warning = boards.warning(mega, boards.BOARDS["mega"])
    assert (warning is None) == feeds_the_watchdog


def test_a_board_that_is_pulled_out_is_one_line_with_its_port():
    with pulled_out() as path:
        done = CliRunner().invoke(app, ["node", "flash", path])
    assert done.exit_code == 1
    assert done.stderr.startswith(f"relpos: {path}: the port vanished: ")


@pytest.mark.parametrize("option", ["--key-file", "--old-key-file"])
def test_a_key_that_cannot_be_read_is_told_before_a_board_is_touched(tmp_path, option):
    with pulled_out() as path:
        done = CliRunner().invoke(app, ["node", "flash", path, option, str(tmp_path / "no.key")])
    assert done.exit_code == 1
    assert "no.key: no key can be read: No such file" in done.stderr
