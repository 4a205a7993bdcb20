"""The inertial library, compiled for this machine and driven from Python with recordings.

``build`` compiles ``firmware/lib/inertial`` with the C interface beside this file (g++, float32 as
on the board); ``reckon`` replays samples through it.
"""

from __future__ import annotations

import csv
import ctypes
import functools
import gzip
import hashlib
import os
import subprocess
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / "firmware" / "lib" / "inertial"
RATE_HZ = 50.0
BANDWIDTH_HZ = 20.0  # the MPU-9150's DLPF 4: 21 Hz
LEG_OF_STATURE = 0.53  # Zijlstra and Hof 1997
DEFAULT_STATURE_M = 1.75

ROW = np.dtype(
    [
        *((name, "f8") for name in ("x_m", "y_m", "heading_rad", "variance_along_m2")),
        *((name, "f8") for name in ("variance_across_m2", "variance_heading_rad2", "path_m")),
        *((name, "f8") for name in ("last_step_length_m", "magnetic_heading_rad", "forward_rad")),
        *((name, "u4") for name in ("steps", "last_step_tick", "flags", "moving")),
    ]
)
COUNTERS = (
    "refused_samples",
    "saturated_samples",
    "rejected_steps",
    "doubtful_steps",
    "rejected_magnetic",
    "lost_steps",
    "covariance_repairs",
)


def data_folder() -> Path:
    """Folder of the recordings: ``RELPOS_DATA``, else ``../shared/data`` beside the project."""
    return Path(os.environ.get("RELPOS_DATA", ROOT.parent / "shared" / "data"))


@functools.cache
def build() -> ctypes.CDLL:
    """Compile (cached by content) and load the library."""
    sources = [Path(__file__).with_name("c_abi.cpp"), *sorted(LIBRARY.glob("*.cpp"))]
    flags = ["-std=gnu++11", "-O2", "-fPIC", "-shared", "-Wall", "-Wextra", "-Werror"]
    flags += ["-ffp-contract=off", "-Wdouble-promotion"]
    digest = hashlib.sha256(" ".join(flags).encode())
    for path in [*sources, *sorted(LIBRARY.glob("*.h"))]:
        digest.update(path.read_bytes())
    target = ROOT / ".build" / "inertial" / f"inertial-{digest.hexdigest()[:16]}.so"
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = target.with_suffix(f".{os.getpid()}")
        command = ["g++", *flags, f"-I{LIBRARY}", *map(str, sources), "-o", str(scratch)]
        subprocess.run(command, check=True)
        scratch.replace(target)
    library = ctypes.CDLL(str(target))
    library.inertial_create.restype = ctypes.c_void_p
    return library


@dataclass
class Recording:
    """Samples at 50 Hz and what is known about the walk."""

    name: str
    time_s: Array
    imu: Array  # (n, 6) m/s^2, rad/s
    field_ut: Array  # (n, 3)
    meta: dict[str, Any] = field(default_factory=dict)
    events: list[tuple[float, str, str]] = field(default_factory=list)

    @property
    def leg_length_m(self) -> float:
        """From the stature, the population's where it is not known."""
        return LEG_OF_STATURE * float(self.meta.get("stature_m", DEFAULT_STATURE_M))


@dataclass
class Reckoning:
    """Outcome of a replay: one structured row a sample, and the state at the end."""

    rows: NDArray[np.void]
    covariance: Array
    bias_rad_s: Array
    counters: dict[str, int]

    @property
    def step_ticks(self) -> NDArray[np.int64]:
        """Sample index of each mid-stance (0-based), in order."""
        ticks = self.rows["last_step_tick"].astype(np.int64)
        return np.unique(ticks[ticks > 0]) - 1

    @property
    def distance_m(self) -> float:
        """Sum of the step lengths."""
        return float(self.rows["path_m"][-1])

    @property
    def turn_rad(self) -> float:
        """Net heading change, unwrapped."""
        return float(np.unwrap(self.rows["heading_rad"])[-1])


def load(folder: Path) -> Recording:
    """Read a run directory's inertial data, low-passed to 20 Hz and resampled to 50 Hz."""
    with gzip.open(folder / "imu.csv.gz", "rt") as stream:
        raw = np.loadtxt(stream, delimiter=",", skiprows=1, ndmin=2)
    meta = tomllib.loads((folder / "run.toml").read_text())
    events: list[tuple[float, str, str]] = []
    if (folder / "events.csv").exists():
        with (folder / "events.csv").open() as stream:
            events = [
                (float(row["time_s"]), row["event"], row["value"]) for row in csv.DictReader(stream)
            ]
    time, values = raw[:, 0], raw[:, 2:11]
    rate = 1.0 / float(np.median(np.diff(time)))
    if rate > 2.2 * BANDWIDTH_HZ:
        sos = butter(2, BANDWIDTH_HZ / (rate / 2.0), output="sos")
        values = sosfiltfilt(sos, values, axis=0)
    grid = np.arange(time[0], time[-1], 1.0 / RATE_HZ)
    even = np.stack([np.interp(grid, time, column) for column in values.T], axis=1)
    return Recording(folder.name, grid, even[:, :6], even[:, 6:], meta, events)


def reckon(
    imu: Array,
    field_ut: Array | None = None,
    *,
    leg_length_m: float = LEG_OF_STATURE * DEFAULT_STATURE_M,
    step_gain: float = 1.25,
    dt_s: float | Array = 1.0 / RATE_HZ,
) -> Reckoning:
    """Replay samples ``imu`` (n, 6); ``field_ut`` (n, 3) is used at 5 Hz where given.

    ``dt_s`` is one span for all samples or (n,) of them.
    """
    library = build()
    count = len(imu)
    samples = np.ascontiguousarray(imu, dtype=np.float32)
    magnetic = np.ascontiguousarray(
        field_ut if field_ut is not None else np.zeros((1, 3)), dtype=np.float32
    )
    spans_s = np.full(count, dt_s, dtype=np.float32)
    rows = np.zeros(count, dtype=ROW)
    handle = ctypes.c_void_p(library.inertial_create())
    try:
        library.inertial_configure(handle, ctypes.c_float(leg_length_m), ctypes.c_float(step_gain))
        library.inertial_run(
            handle,
            samples.ctypes.data_as(ctypes.c_void_p),
            magnetic.ctypes.data_as(ctypes.c_void_p),
            ctypes.c_uint32(count),
            ctypes.c_uint32(10 if field_ut is not None else 0),
            spans_s.ctypes.data_as(ctypes.c_void_p),
            rows.ctypes.data_as(ctypes.c_void_p),
        )
        covariance = np.zeros((12, 12))
        bias = np.zeros(3)
        counts = (ctypes.c_uint32 * len(COUNTERS))()
        library.inertial_covariance(handle, covariance.ctypes.data_as(ctypes.c_void_p))
        library.inertial_bias(handle, bias.ctypes.data_as(ctypes.c_void_p))
        library.inertial_counters(handle, counts)
    finally:
        library.inertial_destroy(handle)
    return Reckoning(rows, covariance, bias, dict(zip(COUNTERS, counts, strict=True)))


def predict(covariance: Array, rotation: Array, impulse_m_s: Array, dt_s: float) -> Array:
    """Predict one span of ``dt_s`` on a (12, 12) covariance; returns the new one."""
    matrix = np.ascontiguousarray(covariance, dtype=np.float64).copy()
    r = np.ascontiguousarray(rotation, dtype=np.float32)
    impulse = np.ascontiguousarray(impulse_m_s, dtype=np.float32)
    build().inertial_predict(
        matrix.ctypes.data_as(ctypes.c_void_p),
        r.ctypes.data_as(ctypes.c_void_p),
        impulse.ctypes.data_as(ctypes.c_void_p),
        ctypes.c_float(dt_s),
    )
    return matrix


@dataclass
class StepScore:
    """Steps against foot contacts, one to one as run-format.md says."""

    contacts: int
    found: int
    extra: int


def score_steps(recording: Recording, step_times_s: Array) -> StepScore:
    """Match steps to the contacts inside the trial within 0.3 s after one constant offset."""
    events = recording.events
    begin = min((t for t, name, _ in events if name == "trial_start"), default=-np.inf)
    end = max((t for t, name, _ in events if name == "trial_end"), default=np.inf)
    contacts = np.array(
        [t for t, name, _ in events if name == "foot_contact" and begin <= t <= end]
    )
    best: StepScore | None = None
    for offset in np.arange(-0.5, 0.51, 0.05):
        shifted = step_times_s + offset
        inside = shifted[(shifted >= begin - 0.3) & (shifted <= end + 0.3)]
        used = np.zeros(len(inside), dtype=bool)
        found = 0
        for contact in contacts:
            gap = np.where(used, np.inf, np.abs(inside - contact))
            if gap.size and gap.min() <= 0.3:
                used[int(gap.argmin())] = True
                found += 1
        score = StepScore(len(contacts), found, int((~used).sum()))
        if best is None or score.found - score.extra > best.found - best.extra:
            best = score
    assert best is not None
    return best
