"""A Pozyx that holds the bus' clock, and a slow bus: what the Uno's firmware makes of them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from avr.service import Service
from avr_budget import TICK_CYCLES
from relpos.emulator import ak8975, pozyx
from relpos.emulator.avr.board import BOARDS
from relpos.emulator.avr.elf import default_build_folder, find_firmware, read_firmware
from relpos.emulator.avr.library import missing_parts
from relpos.emulator.bus import I2cDevice
from relpos.emulator.mpu9150 import Mpu9150
from relpos.protocol import messages as wire

MISSING = missing_parts()
pytestmark = pytest.mark.skipif(MISSING is not None, reason=str(MISSING))
ROOT = Path(__file__).resolve().parents[2]
SECONDS = 15.0


@pytest.fixture(scope="module")
def uno() -> Path:
    return find_firmware("uno", default_build_folder())


def serve(elf: Path) -> tuple[int, Service]:
    """Ranges reported in a quarter of a minute of service, and what served."""
    with Service(BOARDS["uno"], read_firmware(elf), SECONDS, seed=1) as service:
        service.run(round(SECONDS * 1e6))
        ranges = sum(
            len(frame.values["ranges"]) for frame in service.frames if frame.message is wire.RANGES
        )
        service.work_done()
        counters = service.engine.board.counters()
        assert counters.ticks > 45 * (SECONDS - 2.0)
        assert counters.tick_cycles_max < 0.45 * TICK_CYCLES
        return ranges, service


@pytest.fixture(scope="module")
def unstretched(uno: Path) -> int:
    ranges, _ = serve(uno)
    assert ranges > 10
    return ranges


@pytest.mark.parametrize(
    ("stretch_us", "share"),
    [
        (650, 0.8),
        *(pytest.param(us, 0.8, marks=pytest.mark.soak) for us in (750, 2_000)),
        (5_000, 0.5),
    ],
)
def test_ranges_flow_from_a_tag_that_holds_the_clock(
    uno: Path,
    unstretched: int,
    monkeypatch: pytest.MonkeyPatch,
    stretch_us: int,
    share: float,
) -> None:
    monkeypatch.setattr(pozyx, "FUNCTION_STRETCH_US", stretch_us)
    assert serve(uno)[0] >= share * unstretched


def test_a_tag_that_never_lets_go_of_the_clock_costs_no_motion(
    uno: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pozyx, "FUNCTION_STRETCH_US", 50_000)
    ranges, service = serve(uno)
    assert ranges == 0
    assert sum(frame.message is wire.MOTION for frame in service.frames) >= SECONDS - 3


def test_slow_inertial_chips_cost_no_motion(uno: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Their data sheets know no stretching: what a transaction's millisecond leaves is enough.
    for chip in (Mpu9150, ak8975._HostSide):
        start = chip.start

        def slow(self: I2cDevice, read: bool, start: Any = start) -> bool:
            self.stretch_us = 150
            return bool(start(self, read))

        monkeypatch.setattr(chip, "start", slow)
    _, service = serve(uno)
    assert sum(frame.message is wire.MOTION for frame in service.frames) >= SECONDS - 3
    statuses = [frame.values for frame in service.frames if frame.message is wire.STATUS]
    assert statuses[-1]["bus_errors"] <= 2
    assert statuses[-1]["missed_ticks"] == 0


@pytest.mark.soak  # builds the firmware anew
def test_the_bus_at_100_khz_is_a_build_that_works(tmp_path: Path) -> None:
    built = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "pio"), "run", "-e", "uno"],
        env={
            **os.environ,
            "PLATFORMIO_BUILD_DIR": str(tmp_path),
            "PLATFORMIO_BUILD_FLAGS": "-DRELPOS_TWI_HZ=100000",
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stdout[-2000:] + built.stderr[-2000:]
    with Service(BOARDS["uno"], read_firmware(find_firmware("uno", tmp_path)), 15.0, 1) as service:
        service.run(15_000_000)
        words, faults = service.work_done()
        counters = service.engine.board.counters()
    assert faults == (), words
    # Beyond the budget of 400 kHz, within the 20 ms.
    assert counters.tick_cycles_max < 0.6 * TICK_CYCLES
