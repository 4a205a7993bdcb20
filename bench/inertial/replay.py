"""The inertial library, compiled for this machine and driven from Python with recordings.

``build`` compiles ``firmware/lib/inertial`` with the C interface beside this file (g++, float32 as
on the board); ``reckon`` replays samples through it.
"""

from __future__ import annotations

import contextlib
import csv
import ctypes
import functools
import gzip
import hashlib
import io
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from relpos.calibration.steps import LEG_OF_STATURE

# At the end: `recordings` is this folder's.
sys.path.append(str(Path(__file__).parents[1]))
from shared_data import DATA as DATA

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / "firmware" / "lib" / "inertial"
RATE_HZ = 50.0
BANDWIDTH_HZ = 20.0  # the MPU-9150's DLPF 4: 21 Hz
DEFAULT_STATURE_M = 1.75

ROW = np.dtype(
    [
        *((name, "f8") for name in ("x_m", "y_m", "heading_rad", "variance_along_m2")),
        *((name, "f8") for name in ("variance_across_m2", "variance_heading_rad2", "path_m")),
        *((name, "f8") for name in ("last_step_length_m", "magnetic_heading_rad", "forward_rad")),
        ("scale_error_m", "f8"),
        *((name, "u4") for name in ("steps", "last_step_tick", "flags", "moving")),
    ]
)
COUNTERS = (
    "refused_samples",
    "saturated_samples",
    "doubtful_steps",
    "rejected_magnetic",
    "lost_steps",
    "covariance_repairs",
    "turned_sensors",
)


TUNABLE = ("kTurn_rad", "kSmallRise_m", "kWalkRatio_m_s", "kLimpShare")
_tuned = False  # whether the build with constants that can be set is in force


@functools.cache
def build(*, tunable: bool = False) -> ctypes.CDLL:
    """Compile (cached by content) and load the library.

    With ``tunable`` the constants of `TUNABLE` are variables of the library; nothing else differs.
    """
    sources = {p: p.read_text() for p in (*LIBRARY.glob("*.cpp"), *LIBRARY.glob("*.h"))}
    sources[Path(__file__).with_name("c_abi.cpp")] = (
        Path(__file__).with_name("c_abi.cpp").read_text()
    )
    if tunable:
        text = "\n".join(sources.values())
        values = {n: re.findall(rf"const float {n} = ([\d.]+)f;", text) for n in TUNABLE}
        for path, source in sources.items():
            for name in TUNABLE:
                source = re.sub(rf"const float {name} = [\d.]+f;", "", source)
            sources[path] = source
        head = "".join(f'extern "C" float {name};\n' for name in TUNABLE)
        sources[LIBRARY / "attitude.h"] = head + sources[LIBRARY / "attitude.h"]
        for name, (value,) in values.items():
            sources[LIBRARY / "attitude.cpp"] += f"float {name} = {value}f;\n"
    flags = ["-std=gnu++11", "-O2", "-fPIC", "-shared", "-Wall", "-Wextra", "-Werror"]
    flags += ["-ffp-contract=off", "-Wdouble-promotion"]
    digest = hashlib.sha256(" ".join(flags).encode())
    for path in sorted(sources):
        digest.update(sources[path].encode())
    target = ROOT / ".build" / "inertial" / f"inertial-{digest.hexdigest()[:16]}.so"
    if not target.exists():
        folder = target.with_suffix(f".{os.getpid()}.d")
        (folder / "inertial").mkdir(parents=True)
        for path, source in sources.items():
            (folder / "inertial" / path.name).write_text(source)
        scratch = target.with_suffix(f".{os.getpid()}")
        code = [str(folder / "inertial" / p.name) for p in sorted(sources) if p.suffix == ".cpp"]
        include = [f"-I{folder / 'inertial'}", f"-I{folder}"]
        subprocess.run(["g++", *flags, *include, *code, "-o", str(scratch)], check=True)
        scratch.replace(target)
        shutil.rmtree(folder)
    library = ctypes.CDLL(str(target))
    library.inertial_create.restype = ctypes.c_void_p
    library.inertial_default_gain.restype = ctypes.c_float
    return library


def default_gain() -> float:
    """The step gain of a new node."""
    return float(build().inertial_default_gain())


@contextlib.contextmanager
def constants(values: Mapping[str, float]) -> Iterator[None]:
    """While it lasts `reckon` uses these values of constants of `TUNABLE`."""
    global _tuned
    library = build(tunable=True)
    variables = {name: ctypes.c_float.in_dll(library, name) for name in values}
    before = {name: variable.value for name, variable in variables.items()}
    for name, value in values.items():
        variables[name].value = value
    _tuned = True
    try:
        yield
    finally:
        _tuned = False
        for name, value in before.items():
            variables[name].value = value


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
        """The run's own, else from the stature, the population's where neither is known."""
        stature_m = float(self.meta.get("stature_m", DEFAULT_STATURE_M))
        return float(self.meta.get("leg_length_m", LEG_OF_STATURE * stature_m))

    def times_of(self, event: str) -> Array:
        """Times of the events of that name, in order."""
        return np.array([time for time, name, _ in self.events if name == event])

    @property
    def trials_s(self) -> list[tuple[float, float]]:
        """Beginnings and ends of the trial or the bouts, cut to the recording."""
        begins = np.append(self.times_of("trial_start"), self.times_of("bout_start"))
        ends = np.append(self.times_of("trial_end"), self.times_of("bout_end"))
        first, last = float(self.time_s[0]), float(self.time_s[-1])
        if len(begins) != len(ends) or len(begins) == 0:
            return [(first, last)]
        return [(max(first, b), min(last, e)) for b, e in zip(begins, ends, strict=True)]

    def during_trials(self, times_s: Array, margin_s: float = 0.0) -> Array:
        """Those of the times that lie in a trial or bout, or ``margin_s`` around it."""
        inside = np.zeros(len(times_s), bool)
        for begin, end in self.trials_s:
            inside |= (times_s >= begin - margin_s) & (times_s <= end + margin_s)
        return times_s[inside]

    @property
    def contacts_s(self) -> Array:
        """Foot contacts inside the trials and the recording."""
        return self.during_trials(self.times_of("foot_contact"))


@dataclass
class Reckoning:
    """Outcome of a replay: one structured row a sample, and the state at the end."""

    rows: NDArray[np.void]
    covariance: Array
    bias_rad_s: Array
    counters: dict[str, int]

    @property
    def step_ticks(self) -> NDArray[np.int64]:
        """Sample index of each mid-stance (0-based), in order.

        A step is counted some ticks after its mid-stance: one at the very end is not there yet.
        """
        ticks = self.rows["last_step_tick"].astype(np.int64)
        return (np.unique(ticks[ticks > 0]) - 1)[: int(self.rows["steps"][-1])]

    @property
    def distance_m(self) -> float:
        """Sum of the step lengths."""
        return float(self.rows["path_m"][-1])

    @property
    def turn_rad(self) -> float:
        """Net heading change, unwrapped."""
        return float(np.unwrap(self.rows["heading_rad"])[-1])

    @property
    def step_lengths_m(self) -> Array:
        """Length of each step of ``step_ticks``; differences of the path, so that none is lost."""
        path, ticks = self.rows["path_m"].astype(np.float64), self.step_ticks
        ends = np.append(ticks, len(path))[1:] - 1
        return np.diff(path[ends], prepend=0.0)


def load(folder: Path) -> Recording:
    """Read a run directory's inertial data, low-passed to 20 Hz and resampled to 50 Hz."""
    with gzip.open(folder / "imu.csv.gz", "rt") as stream:
        text = re.sub(r",(?=[,\n])", ",nan", stream.read())  # a field that was not measured
    raw = np.loadtxt(io.StringIO(text), delimiter=",", skiprows=1, ndmin=2)
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
        sos = scipy.signal.butter(2, BANDWIDTH_HZ / (rate / 2.0), output="sos")
        values = scipy.signal.sosfiltfilt(sos, values, axis=0)
    grid = np.arange(time[0], time[-1], 1.0 / RATE_HZ)
    even = np.stack([np.interp(grid, time, column) for column in values.T], axis=1)
    return Recording(folder.name, grid, even[:, :6], even[:, 6:], meta, events)


def reckon(
    imu: Array,
    field_ut: Array | None = None,
    *,
    leg_length_m: float = LEG_OF_STATURE * DEFAULT_STATURE_M,
    step_gain: float | None = None,
    scale_sigma: float | None = None,
    dt_s: float | Array = 1.0 / RATE_HZ,
) -> Reckoning:
    """Replay samples ``imu`` (n, 6); ``field_ut`` (n, 3) is used at 5 Hz where given.

    ``dt_s`` is one span for all samples or (n,) of them. Gain and scale sigma are the library's
    own where they are None.
    """
    library = build(tunable=_tuned)
    count = len(imu)
    samples = np.ascontiguousarray(imu, dtype=np.float32)
    magnetic = np.ascontiguousarray(
        field_ut if field_ut is not None else np.zeros((1, 3)), dtype=np.float32
    )
    spans_s = np.full(count, dt_s, dtype=np.float32)
    rows = np.zeros(count, dtype=ROW)
    handle = ctypes.c_void_p(library.inertial_create())
    try:
        library.inertial_configure(
            handle,
            ctypes.c_float(leg_length_m),
            ctypes.c_float(step_gain or 0.0),
            ctypes.c_float(scale_sigma or 0.0),
        )
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


LONGEST_STEP_S = 1.5


def walked_m(step_times_s: Array, lengths_m: Array, at_s: Array) -> Array:
    """Distance walked at any time: each step spread evenly over the time since the one before.

    A step after a pause of ``LONGEST_STEP_S`` or at the beginning took 0.6 s.
    """
    if len(step_times_s) == 0:
        return np.zeros(len(at_s))
    since_s = np.diff(step_times_s, prepend=-np.inf)
    since_s[since_s > LONGEST_STEP_S] = 0.6
    knots_s = np.stack([step_times_s - since_s, step_times_s], axis=1).ravel()
    total = np.cumsum(lengths_m)
    knots_m = np.stack([total - lengths_m, total], axis=1).ravel()
    return np.interp(at_s, knots_s, knots_m)


@dataclass
class StepScore:
    """Steps against foot contacts, one to one as run-format.md says."""

    contacts: int
    found: int
    extra: int
    offset_s: float


def pairs_within(first_s: Array, second_s: Array, tolerance_s: float) -> int:
    """Most pairs that can be formed one to one between two sorted sets of times.

    With one tolerance for all, pairing the earliest that fit is the best there is.
    """
    pairs = i = j = 0
    while i < len(first_s) and j < len(second_s):
        gap_s = first_s[i] - second_s[j]
        if abs(gap_s) <= tolerance_s:
            pairs, i, j = pairs + 1, i + 1, j + 1
        elif gap_s < 0.0:
            i += 1
        else:
            j += 1
    return pairs


def score_steps(recording: Recording, step_times_s: Array) -> StepScore:
    """Match steps to the contacts inside trial and recording, 0.3 s after one constant offset.

    The offset, up to 0.5 s, is the one with the most steps found less extra. Extra are the steps
    inside the trial (shifted, 0.3 s around it) that no contact is left for.
    """
    tolerance_s = 0.3
    contacts = recording.contacts_s
    scores = []
    for offset_s in np.arange(-0.5, 0.505, 0.02):
        inside = recording.during_trials(step_times_s + offset_s, tolerance_s)
        found = pairs_within(inside, contacts, tolerance_s)
        scores.append(StepScore(len(contacts), found, len(inside) - found, float(offset_s)))
    return max(scores, key=lambda score: (score.found - score.extra, -abs(score.offset_s)))
