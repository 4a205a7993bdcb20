"""The Uno's receiver under noise, and what comes while the firmware falls asleep."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from avr.service import Service
from relpos.emulator.avr.board import BOARDS
from relpos.emulator.avr.elf import default_build_folder, find_firmware, read_firmware
from relpos.emulator.avr.library import missing_parts
from relpos.protocol import messages as wire

MISSING = missing_parts()
pytestmark = pytest.mark.skipif(MISSING is not None, reason=str(MISSING))


@pytest.fixture(scope="module")
def uno() -> Path:
    return find_firmware("uno", default_build_folder())


def test_noise_on_the_receiver_is_counted_and_costs_no_command(uno: Path) -> None:
    with Service(BOARDS["uno"], read_firmware(uno), 24.0, seed=1) as service:
        noise = 0
        for at_us in range(2_000_000, 22_000_000, 150_000):
            service.run(at_us)
            service.engine.board.receive(b"\x00\x7e", service.engine.board.cycle, damaged=True)
            noise += 2
        service.run(24_000_000)
        statuses = [f.values for f in service.frames if f.message is wire.STATUS]
        _, faults = service.work_done()
    counted = statuses[-1]["damaged_bytes"]
    assert 0.4 * noise < counted <= noise  # the last status came some seconds before the end
    assert statuses[-1]["lost_bytes"] == 0
    # Not even what a damaged delimiter would begin.
    assert statuses[-1]["bad_frames"] == 0
    assert faults == ()


def test_a_byte_that_comes_before_the_sleep_is_not_slept_over(uno: Path) -> None:
    # Interrupts are off from the last look at the receiver until the very instruction that sleeps.
    listed = subprocess.run(
        ["avr-objdump", "-d", str(uno)], capture_output=True, text=True, check=True
    ).stdout
    code = [match[1] for match in re.finditer(r"^ +[0-9a-f]+:\t[0-9a-f ]+\t(\w+)", listed, re.M)]
    (sleep,) = [place for place, name in enumerate(code) if name == "sleep"]
    assert code[sleep - 1] == "sei"
    before = code[sleep - 20 : sleep - 1]
    assert "cli" in before
    assert "sei" not in before[before.index("cli") :]
