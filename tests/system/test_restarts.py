"""Boards come back from every restart behind every boot loader, and tell its cause if they can."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from boot_loaders import (
    MEGA_ADDRESS,
    OPTIBOOT_ADDRESS,
    build_optiboot,
    mega_loader,
    needs,
)

from relpos.emulator.avr.board import BOARDS, Board, ResetCause
from relpos.emulator.avr.elf import default_build_folder, find_firmware, read_firmware
from relpos.link import xbee
from relpos.protocol import framing
from relpos.protocol import messages as wire

pytestmark = pytest.mark.skipif(needs() is not None, reason=str(needs()))

CYCLES_A_MS = 16_000
BACK_WITHIN_MS = 3_000
TIMSK1, RUNNING = 0x6F, 0x03
"""The firmware's clock is on: its start-up is over."""
CAUSES = ("POWER_ON", "EXTERNAL", "BROWN_OUT", "WATCHDOG", "COMMAND")

# What other loaders do with a reset, as their sources say; neither is packaged by Debian.
CURRENT_OPTIBOOT = r"""
#include <avr/io.h>
#include <avr/wdt.h>
__attribute__((naked, used, section(".init9"))) int main(void) {
  asm volatile("clr r1");
  uint8_t cause = MCUSR;
  if ((cause & (_BV(WDRF) | _BV(EXTRF))) != _BV(EXTRF)) {
    if (cause & _BV(EXTRF)) MCUSR = (uint8_t)~_BV(WDRF);
    WDTCSR = _BV(WDCE) | _BV(WDE);
    WDTCSR = 0;
    asm volatile("jmp 0");
  }
  WDTCSR = _BV(WDCE) | _BV(WDE);
  WDTCSR = _BV(WDE) | _BV(WDP2) | _BV(WDP1);  /* gives up after a second */
  for (;;);
}
"""
MEGA_OF_2011 = r"""
#include <avr/io.h>
#include <util/delay.h>
int main(void) {
  UCSR0A = _BV(U2X0); UBRR0 = 16; UCSR0B = _BV(RXEN0) | _BV(TXEN0);
  _delay_ms(1000);  /* for an upload; an armed watchdog bites meanwhile */
  UCSR0A = UCSR0B = UBRR0 = 0;
  asm volatile("jmp 0");
}
"""


def compiled(source: str, board: str, address: int, folder: Path) -> bytes:
    program = folder / "loader.c"
    program.write_text(source)
    elf = program.with_suffix(".elf")
    options = (
        f"-mmcu={BOARDS[board].mmcu} -DF_CPU=16000000UL -Os -Wl,--section-start=.text={address:#x}"
    )
    start = ["-nostartfiles"] if "naked" in source else []
    subprocess.run(["avr-gcc", *options.split(), *start, str(program), "-o", str(elf)], check=True)
    return read_firmware(elf).flash[address:]


LOADERS: dict[tuple[str, str], tuple[int, Callable[[Path], bytes]]] = {
    ("uno", "none"): (0, lambda _: b""),
    ("uno", "Optiboot 4.4"): (
        OPTIBOOT_ADDRESS,
        lambda folder: build_optiboot(folder).flash[OPTIBOOT_ADDRESS:],
    ),
    ("uno", "current Optiboot"): (
        OPTIBOOT_ADDRESS,
        lambda folder: compiled(CURRENT_OPTIBOOT, "uno", OPTIBOOT_ADDRESS, folder),
    ),
    ("mega", "none"): (0, lambda _: b""),
    ("mega", "2011"): (
        MEGA_ADDRESS,
        lambda folder: compiled(MEGA_OF_2011, "mega", MEGA_ADDRESS, folder),
    ),
    ("mega", "current"): (MEGA_ADDRESS, lambda _: mega_loader().flash[MEGA_ADDRESS:]),
}
CLEARING = (("uno", "Optiboot 4.4"), ("mega", "current"))
"""They clear MCUSR: the supply and the button cannot be told from each other."""


class Started:
    """A board behind a loader; no chips, and a radio module that always delivers."""

    def __init__(self, kind: str, loader: str, folder: Path) -> None:
        address, read = LOADERS[kind, loader]
        self.elf = find_firmware(kind, default_build_folder())
        program = read_firmware(self.elf)
        image = bytearray(program.flash)
        if address:
            code = read(folder)
            image.extend(b"\xff" * (address + len(code) - len(image)))
            image[address : address + len(code)] = code
        self.board = Board(BOARDS[kind], replace(program, flash=bytes(image)))
        self.board.set_reset_vector(address)
        self.parser = xbee.Parser()
        self.statuses: list[framing.Frame] = []

    def run(self, ms: int) -> None:
        """Run so long, answering the module's part."""
        for _ in range(ms):
            self.board.run(self.board.cycle + CYCLES_A_MS)
            sent = bytes(value for _, value in self.board.take_sent())
            for request in self.parser.feed(sent):
                if isinstance(request, xbee.Transmit16):
                    frame = framing.decode(request.data)
                    if frame.message is wire.STATUS:
                        self.statuses.append(frame)
                    status = xbee.TransmitStatus(request.frame_id, 0)
                    self.board.receive(xbee.encode(status), self.board.cycle)

    def running(self) -> bool:
        return self.board.data(TIMSK1, 1)[0] == RUNNING

    def back_after_ms(self) -> int | None:
        """Milliseconds until the firmware runs, or None where it does not in time."""
        for ms in range(BACK_WITHIN_MS):
            if self.running():
                return ms
            self.run(1)
        return None

    def status(self) -> framing.Frame:
        """The first status from now on."""
        self.statuses.clear()
        for _ in range(400):
            self.run(10)
            if self.statuses:
                return self.statuses[0]
        raise AssertionError("no status within 4 s")

    def hang(self) -> None:
        """Let the program run in circles until the watchdog bites."""
        listed = subprocess.run(
            ["avr-nm", str(self.elf)], capture_output=True, text=True, check=True
        ).stdout
        (address,) = [int(line.split()[0], 16) for line in listed.splitlines() if "__stop_" in line]
        self.board.jump(address)
        resets = self.board.counters().watchdog_resets
        for _ in range(2_000):
            self.run(1)
            if self.board.counters().watchdog_resets > resets:
                return
        raise AssertionError("the watchdog does not bite")

    def command(self, code: wire.CommandCode, node: int) -> None:
        values = {"token": 77, "command": int(code), "value": 0}
        data = framing.encode(wire.COMMAND, node, 0, 1, values)
        self.board.receive(xbee.encode(xbee.Receive16(0, -40, data)), self.board.cycle)


def restart(kind: str, loader: str, cause: str, folder: Path) -> tuple[int | None, str | None]:
    """How long the board is away, and the cause that it then reports."""
    started = Started(kind, loader, folder)
    with started.board as board:
        assert started.back_after_ms() is not None
        first = started.status()
        if cause == "COMMAND":
            started.command(wire.CommandCode.REBOOT, first.node)
            started.run(200)
        elif cause == "WATCHDOG":
            started.hang()
        else:
            board.reset(ResetCause[cause])
        away_ms = started.back_after_ms()
        if away_ms is None:
            return None, None
        again = started.status()
        assert again.boot == first.boot + 1
        return away_ms, wire.ResetCause(again.values["reset_cause"]).name


@pytest.mark.parametrize("cause", CAUSES)
@pytest.mark.parametrize(("kind", "loader"), LOADERS, ids=lambda name: name)
def test_a_board_comes_back_and_tells_why_it_restarted(kind, loader, cause, tmp_path):
    away_ms, told = restart(kind, loader, cause, tmp_path)
    if (loader, cause) == ("2011", "WATCHDOG"):
        assert away_ms is None  # dead until its supply is switched: `relpos node flash` warns of it
        return
    assert away_ms is not None
    hidden = (kind, loader) in CLEARING and cause not in ("WATCHDOG", "COMMAND")
    assert told == ("UNKNOWN" if hidden else cause)
