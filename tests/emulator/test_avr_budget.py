"""The whole firmware stays within its budgets, and a firmware that does not is refused."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from avr_programs import MISSING, Builder

import avr_budget as budget
from avr_budget import main, measure
from relpos.emulator.avr.elf import default_build_folder, find_firmware

pytestmark = pytest.mark.skipif(MISSING is not None, reason=f"{MISSING} is not installed")


def place(elf: Path, folder: Path) -> None:
    """Put a program where PlatformIO would."""
    target = folder / "uno" / "firmware.elf"
    target.parent.mkdir(parents=True)
    target.write_bytes(elf.read_bytes())


TICKING = r"""
volatile uint8_t variables[VARIABLES];
const uint8_t filler[FILLER] PROGMEM = {1};
#ifndef OTHERS_MS
#define OTHERS_MS 1
#endif
#define TICK(ms) { GPIOR0 = 1; _delay_ms(ms); GPIOR0 = 0; _delay_ms(20 - ms); }
int main(void) {
  uart(51);
  variables[1] = pgm_read_byte(filler);
  for (;;) { TICK(BUSY_MS) TICK(OTHERS_MS) TICK(OTHERS_MS) TICK(OTHERS_MS) }
}
"""


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("-DVARIABLES=2", "-DFILLER=2", "-DBUSY_MS=10"), "worst tick 1600"),
        (("-DVARIABLES=2", "-DFILLER=2", "-DBUSY_MS=6", "-DOTHERS_MS=6"), "mean tick 960"),
        (("-DVARIABLES=1925", "-DFILLER=2", "-DBUSY_MS=1"), "static RAM and deepest stack 19"),
        (("-DVARIABLES=2", "-DFILLER=31500", "-DBUSY_MS=1"), "flash 31"),
    ],
)
def test_each_budget_that_is_exceeded_is_named(
    tmp_path: Path, options: tuple[str, ...], complaint: str
) -> None:
    elf = Builder(tmp_path).elf("#include <avr/pgmspace.h>\n" + TICKING, "atmega328p", *options)
    faults = measure("uno", elf, 5.0).faults
    past = [fault for fault in faults if " past " in fault]
    assert len(past) == 1
    assert complaint in past[0]


def test_a_firmware_that_does_nothing_is_not_within_budget(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place(Builder(tmp_path).elf("int main(void) { for (;;); }"), tmp_path)
    assert main(["--board", "uno", "--seconds", "5", "--build", str(tmp_path)]) == 1
    assert "uno: only 0 ticks in 5 s" in capsys.readouterr().err


def test_what_another_compiler_has_built_is_measured_beside_ours(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    elf = Builder(tmp_path).elf("int main(void) { for (;;); }")
    folders = [tmp_path / "ours", tmp_path / "theirs"]
    for folder in folders:
        place(elf, folder)
    theirs = folders[1] / "uno" / "firmware.elf"
    version = rb"GCC: \(GNU\) [0-9.]+"
    # As long as ours, lest the sections that follow move.
    theirs.write_bytes(
        re.sub(
            version,
            lambda ours: b"GCC: (GNU) 7.3.0".ljust(len(ours[0]), b"\0"),
            theirs.read_bytes(),
        )
    )
    monkeypatch.setattr(budget, "build_folders", lambda: folders)
    assert main(["--board", "uno", "--seconds", "5"]) == 1
    captured = capsys.readouterr()
    ours, other = re.findall(r"Firmware on simavr, avr-gcc ([0-9.]+)", captured.out)
    assert other == "7.3.0" != ours
    assert captured.err.count("uno: only 0 ticks in 5 s") == 2


def test_a_firmware_that_crashes_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place(Builder(tmp_path).elf('int main(void) { asm volatile(".word 1"); }'), tmp_path)
    assert main(["--board", "uno", "--seconds", "5", "--build", str(tmp_path)]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if "budget:" in line]
    assert len(lines) == 1
    assert "Invalid Opcode" in lines[0]


def test_a_firmware_that_is_not_built_is_one_line_that_says_how(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--board", "mega", "--build", str(tmp_path)]) == 1
    assert "run `make firmware`" in capsys.readouterr().err


BOARDS = ("uno", "mega", "uno-mpu9250")  # the fourth, which has room: `make firmware`


@pytest.mark.parametrize("board", BOARDS)
def test_the_whole_firmware_stays_within_its_budgets(board: str) -> None:
    cost = measure(board, find_firmware(board, default_build_folder()), 20.0)
    assert cost.faults == (), cost
