"""The MPU-9250 with its compass: the chips, and the firmware that is built for them."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from chips import GRAVITY, Host, constant, of_signal, words

from avr.service import Service
from avr_budget import BUDGETS, TICK_CYCLES
from relpos.emulator.ak8975 import Ak8963
from relpos.emulator.avr.board import BOARDS
from relpos.emulator.avr.elf import default_build_folder, find_firmware, read_firmware
from relpos.emulator.avr.library import missing_parts
from relpos.emulator.mpu9150 import Mpu9150
from relpos.emulator.mpu9250 import Mpu9250
from relpos.emulator.surroundings import MagneticErrors
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link.port import Link
from relpos.measurements import Motion, Status
from relpos.protocol import messages as wire

MISSING = missing_parts()
needs_avr = pytest.mark.skipif(MISSING is not None, reason=str(MISSING))
ROOT = Path(__file__).resolve().parents[2]
MPU, MAG = 0x68, 0x0C


def test_it_boots_awake_and_says_who_it_is() -> None:
    host = Host((MPU, Mpu9250(constant(), None, {}))).at(100_000)
    assert host.byte(MPU, 0x75) == 0x71
    assert host.byte(MPU, 0x6B) == 0x01
    assert words(host.read(MPU, 0x3B, 14))[2] == 16384  # 1 g along z at 2 g


def _swing(filter_of_gyroscope: int, filter_of_accelerometer: int) -> float:
    """What passes of 1 g at 40 Hz, in g."""
    chip = Mpu9250(of_signal(3.0, force=lambda t: GRAVITY * np.sin(80.0 * np.pi * t)), None, {})
    host = Host((MPU, chip)).at(100_000)
    host.write(MPU, 0x1A, filter_of_gyroscope)
    host.write(MPU, 0x1D, filter_of_accelerometer)
    found = [words(host.at(1_000_000 + 1_700 * k).read(MPU, 0x3B, 2))[0] for k in range(500)]
    return float(np.max(np.abs(found))) / 16384.0


def test_its_accelerometer_has_a_filter_of_its_own() -> None:
    assert _swing(6, 0) > 0.8
    assert _swing(0, 4) < 0.5


@pytest.mark.parametrize(("wide", "ut_per_lsb"), [(0x00, 0.6), (0x10, 0.15)])
def test_its_compass_has_14_or_16_bits(wide: int, ut_per_lsb: float) -> None:
    adjustment = (100, 128, 190)
    chip = Ak8963(constant(field=(20.0, 5.0, -40.0)), MagneticErrors(adjustment=adjustment))
    host = Host((MAG, chip)).at(1_000)
    host.write(MAG, 0x0A, 0x01 | wide)
    data = host.at(20_000).read(MAG, 0x02, 8)
    assert data[0] == 0x01
    gain = (np.array(adjustment) - 128.0) * 0.5 / 128.0 + 1.0
    field = np.array(words(data[1:7], "little")) * ut_per_lsb * gain
    assert field == pytest.approx([5.0, 20.0, 40.0], abs=0.6 * ut_per_lsb * gain.max())
    assert data[7] == wide


def _served(
    elf: Path, *, successor: bool, seconds: float = 12.0
) -> tuple[Service, tuple[str, ...]]:
    with Service(BOARDS["uno"], read_firmware(elf), seconds, 1, successor=successor) as service:
        service.run(round(seconds * 1e6))
        _, faults = service.work_done()
        counters = service.engine.board.counters()
        assert counters.tick_cycles_max < BUDGETS["uno"].worst_tick_share * TICK_CYCLES
    return service, faults


def _health(service: Service) -> wire.Health:
    statuses = [frame.values for frame in service.frames if frame.message is wire.STATUS]
    return wire.Health(statuses[-1]["health"])


@needs_avr
def test_firmware_built_for_it_walks_ranges_and_stays_in_its_budget() -> None:
    elf = find_firmware("uno-mpu9250", default_build_folder())
    assert read_firmware(elf).flash_bytes <= BUDGETS["uno"].flash_bytes
    service, faults = _served(elf, successor=True, seconds=24.0)
    assert faults == ()
    assert wire.Health.IMU in _health(service)
    assert wire.Health.MAGNETOMETER in _health(service)
    # And the other way round: it does not take an MPU-9150 for its own.
    service, _ = _served(elf, successor=False)
    assert wire.Health.IMU not in _health(service)


@needs_avr
def test_firmware_built_for_the_mpu_9150_reports_the_successor_as_missing() -> None:
    service, _ = _served(find_firmware("uno", default_build_folder()), successor=True)
    assert wire.Health.IMU not in _health(service)


@needs_avr
def test_an_unknown_sensor_is_refused_by_the_build(tmp_path: Path) -> None:
    given = {
        "PLATFORMIO_BUILD_DIR": str(tmp_path),
        "PLATFORMIO_BUILD_FLAGS": "-DRELPOS_IMU=MPU6500",
    }
    done = subprocess.run(
        [ROOT / "tools" / "pio", "run", "-e", "uno"],
        env={**os.environ, **given},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert "RELPOS_IMU is MPU9150 or MPU9250" in done.stdout + done.stderr


def _team_health(**imu: str) -> list[wire.Health]:
    """What two nodes report after a walk of some seconds."""
    link = Link()
    with EmulatedTeam(TeamConfig("straight", 2, 16.0, 1, **imu)) as team:  # type: ignore[arg-type]
        seen = [o for at, data in team.stream() for o in link.feed(data, at * 1e-6)]
    statuses = [o for o in seen if isinstance(o, Status) and o.name == "health"]
    newest = {status.node: wire.Health(int(status.value)) for status in statuses}
    moved = {o.node for o in seen if isinstance(o, Motion) and o.dx_m > 0.3}
    sensors = wire.Health.IMU | wire.Health.MAGNETOMETER
    assert moved == {node for node, health in newest.items() if health & sensors == sensors}
    return list(newest.values())


def test_an_emulated_team_has_it() -> None:
    assert all(wire.Health.IMU in health for health in _team_health(imu="mpu9250"))


def test_a_team_with_firmware_for_the_other_sensor_reports_it_missing() -> None:
    for imu, built_for in (("mpu9250", "mpu9150"), ("mpu9150", "mpu9250")):
        for health in _team_health(imu=imu, built_for=built_for):
            assert not health & (wire.Health.IMU | wire.Health.MAGNETOMETER)
            assert wire.Health.POZYX in health


@pytest.mark.parametrize("make", [Mpu9150, Mpu9250])
def test_self_tests_move_each_axis_by_what_the_factory_measured(make: type[Mpu9150]) -> None:
    """As the makers' drivers reckon: ranges of 250 deg/s and 8 g (MPU-9250: 2 g)."""
    successor = make is Mpu9250
    host = Host((MPU, make(constant(), None, {}))).at(100_000)
    host.write(MPU, 0x6B, 1)
    host.write(MPU, 0x1C, 0x00 if successor else 0x10)
    before = np.array(words(host.at(200_000).read(MPU, 0x3B, 14)))
    host.write(MPU, 0x1B, 0xE0)
    host.write(MPU, 0x1C, 0xE0 if successor else 0xF0)
    moved = np.array(words(host.at(300_000).read(MPU, 0x3B, 14))) - before
    if successor:
        codes = np.array([*host.read(MPU, 0x0D, 3), *host.read(MPU, 0x00, 3)], dtype=float)
        expected = 2620.0 * 1.01 ** (codes - 1.0)
    else:
        x, y, z, a = host.read(MPU, 0x0D, 4)
        force = [x >> 3 & 28 | a >> 4 & 3, y >> 3 & 28 | a >> 2 & 3, z >> 3 & 28 | a & 3]
        expected = np.array(
            [4096 * 0.34 * (0.92 / 0.34) ** ((code - 1) / 30) for code in force]
            + [s * 25 * 131 * 1.046 ** ((c & 31) - 1) for s, c in ((1, x), (-1, y), (1, z))]
        )
    assert moved[[0, 1, 2, 4, 5, 6]] == pytest.approx(expected, rel=0.01)
