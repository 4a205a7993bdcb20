"""Single filters on the simulated Uno: the inertial library, Mahony's and Madgwick's.

Each is a program of this folder around ``harness.cpp``, compiled with the firmware's flags and
fed with samples over the UART; only the update lies between the cycle marks.
"""

from __future__ import annotations

import configparser
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from relpos.emulator.avr.board import BOARDS, Board
from relpos.emulator.avr.elf import Firmware, read_firmware
from relpos.emulator.avr.library import SimulatorError
from relpos.simulation.team import make_team
from relpos.simulation.walker import RATE_HZ as SIMULATED_HZ

Array = NDArray[np.float64]

PROGRAMS = Path(__file__).resolve().parent
ROOT = PROGRAMS.parents[1]
INERTIAL = ROOT / "firmware" / "lib" / "inertial"
TICK_CYCLES = 320_000
TICK_HZ = 50
FIELD_TICKS = 10
"""The firmware reads its magnetometer at 5 Hz."""
RECORD = struct.Struct("<9fB")
OUTPUTS = 3
# What PlatformIO adds to the flags of platformio.ini, and Debian's avr-gcc needs (DECIMAL_DIG).
ARDUINO_FLAGS = (
    "-Os", "-ffunction-sections", "-fdata-sections", "-flto", "-fuse-linker-plugin",
    "-Wl,--gc-sections", "-fno-exceptions", "-fno-threadsafe-statics", "-DF_CPU=16000000L",
    "-DARDUINO=10808", "-DDECIMAL_DIG=__DECIMAL_DIG__",
)  # fmt: skip


@dataclass(frozen=True)
class Samples:
    """What a filter is fed with: n ticks of 20 ms."""

    imu: Array
    """(n, 6): specific force m/s^2 and angular rate rad/s, sensor axes."""
    field_ut: Array
    """(n, 3)."""
    field_is_new: NDArray[np.bool_]
    """(n,)."""


@dataclass(frozen=True)
class FilterRun:
    """What came back."""

    outputs: NDArray[np.float32]
    """(n, 3), as the program's head says."""
    cycles: NDArray[np.int64]
    """(n,), of each update."""


def board_flags() -> list[str]:
    """The boards' compiler flags of platformio.ini, relative to the repository."""
    settings = configparser.ConfigParser(interpolation=None)
    settings.read(ROOT / "platformio.ini", encoding="utf-8")
    shared = settings["env"]["build_flags"]
    return settings["board"]["build_flags"].replace("${env.build_flags}", shared).split()


def build(name: str) -> Firmware:
    """``NAME.cpp`` in its harness; SimulatorError where it does not compile."""
    sources = [PROGRAMS / "harness.cpp", PROGRAMS / f"{name}.cpp"]
    if name == "relpos":
        sources += sorted(INERTIAL.glob("*.cpp"))
    with tempfile.TemporaryDirectory() as folder:
        elf = Path(folder) / "program.elf"
        _compile([*map(str, sources), "-o", str(elf), "-lm"])
        return read_firmware(elf)


def ram_parts() -> dict[str, int]:
    """Bytes of each part of the node on the Uno, by the names of ``ram_parts.cpp``."""
    with tempfile.TemporaryDirectory() as folder:
        unit = Path(folder) / "parts.o"
        _compile(["-fno-lto", "-c", str(PROGRAMS / "ram_parts.cpp"), "-o", str(unit)])
        listed = subprocess.run(
            ["avr-nm", "--print-size", "--radix=d", str(unit)],
            capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
    rows = (line.split() for line in listed.splitlines())
    return {row[3]: int(row[1]) for row in rows if len(row) == 4 and row[2] == "B"}


def _compile(arguments: Sequence[str]) -> None:
    if shutil.which("avr-g++") is None:
        raise SimulatorError("avr-g++ is not there (apt install gcc-avr avr-libc)")
    command = ["avr-g++", f"-mmcu={BOARDS['uno'].mmcu}", *ARDUINO_FLAGS, *board_flags(), *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    if result.returncode:
        complaints = [line for line in result.stderr.splitlines() if "error" in line]
        raise SimulatorError(f"avr-g++: {(complaints or ['failed without a word'])[0]}")


def run(firmware: Firmware, samples: Samples) -> FilterRun:
    """Feed the samples one every 20 ms of the chip's time; the chip sleeps between them."""
    count = len(samples.imu)
    with Board(BOARDS["uno"], firmware) as board:
        values = np.hstack([samples.imu, samples.field_ut]).astype(np.float32)
        for i in range(count):
            record = RECORD.pack(*values[i].tolist(), bool(samples.field_is_new[i]))
            board.run((i + 1) * TICK_CYCLES)
            board.receive(record, (i + 1) * TICK_CYCLES)
        board.run((count + 2) * TICK_CYCLES)
        marks = board.take_marks()
        sent = bytes(byte for _, byte in board.take_sent())
    at = np.array([cycle for cycle, _ in marks], dtype=np.int64)
    if len(sent) != 4 * OUTPUTS * count or [value for _, value in marks] != [1, 0] * count:
        raise SimulatorError(f"the filter answered {len(sent)} bytes to {count} samples")
    outputs = np.frombuffer(sent, "<f4").reshape(count, OUTPUTS)
    return FilterRun(outputs, at[1::2] - at[::2])


def walk(seconds: float, seed: int, scenario: str = "lab") -> Samples:
    """A simulated walker's samples, with a sensor's noise and gyroscope bias."""
    truth = make_team(scenario, 2, seconds + 1.0, seed)[0][0]
    rng = np.random.default_rng([seed, 0xAF])
    pick = slice(0, round(seconds * SIMULATED_HZ), int(SIMULATED_HZ) // TICK_HZ)
    force = truth.specific_force_m_s2[pick]
    rate = truth.angular_rate_rad_s[pick]
    field = truth.magnetic_field_ut[pick]
    imu = np.hstack(
        [
            force + 0.03 * rng.standard_normal(force.shape),
            rate + np.radians(0.05 * rng.standard_normal(rate.shape) + rng.standard_normal(3)),
        ]
    )
    return Samples(
        imu, field + 0.3 * rng.standard_normal(field.shape), np.arange(len(imu)) % FIELD_TICKS == 0
    )


COMPARED: tuple[tuple[str, str, int], ...] = (
    ("relpos dead reckoning, field at 5 Hz", "relpos", FIELD_TICKS),
    ("relpos dead reckoning, no field", "relpos", 0),
    ("Mahony 2008, 6 axes", "mahony", 0),
    ("Mahony 2008, 9 axes", "mahony", 1),
    ("Madgwick 2010, 6 axes", "madgwick", 0),
    ("Madgwick 2010, 9 axes", "madgwick", 1),
)
"""What is shown, the program, and every how many ticks there is a new field (0: never)."""


def with_field_every(samples: Samples, ticks: int) -> Samples:
    """The same samples with a new field every so many ticks; 0: never."""
    index = np.arange(len(samples.imu))
    new = index % ticks == 0 if ticks else np.zeros(len(index), dtype=np.bool_)
    return Samples(samples.imu, samples.field_ut, new)


def comparison(seconds: float, seed: int) -> Table:
    """Cycles of each filter alone over the same walk."""
    shown = Table(title=f"Filters alone on the ATmega328P, {seconds:g} s of a walk")
    shown.add_column("")
    for head in ("mean cycles", "worst cycles", "worst of 20 ms", "program"):
        shown.add_column(head, justify="right")
    samples = walk(seconds, seed)
    programs = {name: build(name) for name in ("relpos", "mahony", "madgwick")}
    for label, name, ticks in COMPARED:
        cycles = run(programs[name], with_field_every(samples, ticks)).cycles
        worst = int(cycles.max())
        shown.add_row(
            label,
            f"{cycles.mean():.0f}",
            f"{worst}",
            f"{worst / TICK_CYCLES:.1%}",
            f"{programs[name].flash_bytes} B",
        )
    return shown
