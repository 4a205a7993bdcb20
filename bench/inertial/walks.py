"""Every recorded walk by what its files hold, and how far the library errs on it.

``find`` reads all runs below a folder. A run with a known length, with bouts or with surveyed
points is a `Walk`; its `Part` s are judged alike, whoever recorded them. The constants of the step
model that are fitted (`CONSTANTS` and the gain) are chosen again for each set or person that is
left out (`Fit`), so that no figure comes from people the constants have seen.
"""

from __future__ import annotations

import contextlib
import gzip
import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import replay
from replay import Array, Reckoning, Recording

import recordings
from relpos.calibration.steps import posterior_scale

SLOW_M_S = 0.6  # below it steps are shuffled: reported apart, and to be flagged
DENSE_S = 0.5  # truth rows closer than this are a track, others are surveyed points
LOOP_M = 1.0  # ends nearer to the beginning than this are a loop
LOST_TURN_DEG = 30.0  # less than a U-turn by this: nobody leaves a corridor so, samples are missing
SETTLE_S = 1.0  # over which a heading is averaged: a stride
CALIBRATED_SIGMA = 0.05  # scale error left after one calibration walk
IRREGULAR = 1 << 8  # flag of the library: a step was doubtful or irregular, last two seconds

# Who walked: what a folder's name says of it. Other sets have a person a run.
PEOPLE = {
    "walk_lowerback_20m": r"\d+",
    "walk_treadmill_stroke_lumbar": r"[a-z]+\d+",
    "walk_mocap_virtual": r"[A-Z]\d+",
    "stairs_mocap_virtual": r"[A-Z]\d+",
    "walk_daily_lowerback": r"[A-Z]+\d+",
    "walk_phone_strides": r"w",
    "walk_author_back": r"a",
}
# Nobody fits constants to these: stairs, and lengths along chords.
NOT_FITTED = ("stairs", "waypoints", "museum")


@dataclass(frozen=True)
class Part:
    """A stretch of known length."""

    begin_s: float
    end_s: float
    true_m: float


@dataclass
class Walk:
    """A recording and what is true of it."""

    data_set: str
    person: str
    recording: Recording
    parts: list[Part]
    turn_deg: float | None = None  # net, counter-clockwise; its size where the sense is not known
    points: tuple[Array, recordings.Track] | None = None  # times and places of surveyed points
    loop: bool = False
    whole: bool = False  # the length is that of the whole recording

    @property
    def group(self) -> str:
        """Line of the table: the set, by age and speed where the people differ in them."""
        name = self.data_set.removeprefix("walk_").replace("_", " ")
        for age in ("elderly", "young"):
            if age in self.recording.name:
                name += f", {age}"
        moved = sum(part.true_m for part in self.parts)
        taken_s = sum(part.end_s - part.begin_s for part in self.parts)
        if self.data_set in ("walk_treadmill_stroke_lumbar", "walk_daily_lowerback"):
            name += f", under {SLOW_M_S} m/s (slow)" if moved < SLOW_M_S * taken_s else ""
        return name

    def reckon(
        self,
        gain: float | None = None,
        sigma: float | None = None,
        bias_rad_s: Array | None = None,
    ) -> Reckoning:
        """The library's answer, with the constants in force; ``bias_rad_s`` (3,) is added."""
        imu = self.recording.imu
        return replay.reckon(
            imu if bias_rad_s is None else imu + np.concatenate([np.zeros(3), bias_rad_s]),
            leg_length_m=self.recording.leg_length_m,
            step_gain=gain,
            scale_sigma=sigma,
        )


def find(root: Path, prefixes: Sequence[str] = ("walk_", "stairs_")) -> list[Walk]:
    """All walks below the folder of data sets, in the order of their names."""
    walks = []
    for data_set in sorted(p for p in root.iterdir() if p.name.startswith(tuple(prefixes))):
        for folder in sorted(p for p in data_set.iterdir() if (p / "imu.csv.gz").exists()):
            walk = read(folder)
            if walk.parts or walk.points:
                walks.append(walk)
    return walks


def read(folder: Path) -> Walk:
    """A run directory with the truth that it holds."""
    recording = replay.load(folder)
    data_set = folder.parent.name
    match = re.match(PEOPLE.get(data_set, r".*"), folder.name)
    walk = Walk(data_set, match.group() if match else folder.name, recording, [])
    time = recording.time_s
    bouts = [(t, float(v)) for t, name, v in recording.events if name == "bout_start"]
    ends = recording.times_of("bout_end")
    if "true_distance_m" in recording.meta:
        walk.whole = True
        walk.parts = [Part(*recording.trials_s[0], float(recording.meta["true_distance_m"]))]
    else:
        walk.parts = [Part(t, float(e), v) for (t, v), e in zip(bouts, ends, strict=True)]
    if "true_turn_deg" in recording.meta:
        walk.turn_deg = float(recording.meta["true_turn_deg"])
    # Where the feet ended stands in a remark of the run. So does how far they turned, but people
    # turn on after the last stride.
    text = (folder / "run.toml").read_text()
    if ended := re.search(r"ended ([\d.]+) and ([\d.]+) m from the start", text):
        walk.loop = max(map(float, ended.groups())) < LOOP_M
    if (folder / "truth.csv").exists():
        times_s, places = recordings.waypoints_of(folder)
        if np.median(np.diff(times_s)) > DENSE_S:
            walk.points = times_s, places
            way = float(np.abs(np.diff(places)).sum())
            begin, end = max(times_s[0], time[0]), min(times_s[-1], time[-1])
            walk.parts = [Part(float(begin), float(end), way)]
    return walk


# --- one walk's errors ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Score:
    """What the library made of a part."""

    walk: Walk
    measured_m: float
    true_m: float
    variance_m2: float
    flagged: float  # fraction of its steps within two seconds of an irregular one

    @property
    def error(self) -> float:
        """Relative."""
        return self.measured_m / self.true_m - 1.0

    @property
    def square(self) -> float:
        """Normalised squared error along the way."""
        return (self.measured_m - self.true_m) ** 2 / self.variance_m2


def scores(walk: Walk, result: Reckoning) -> list[Score]:
    """Errors of all parts. A run of one part is judged whole, with its first and last step."""
    rows, time = result.rows, walk.recording.time_s
    steps_s = time[result.step_ticks]
    out = []
    for part in walk.parts:
        edges = np.array([time[0], time[-1]] if walk.whole else [part.begin_s, part.end_s])
        if walk.whole:
            measured = result.distance_m
        else:
            measured = float(np.diff(replay.walked_m(steps_s, result.step_lengths_m, edges))[0])
        scale_m = np.diff(np.interp(edges, time, rows["scale_error_m"]))[0]
        own = rows["variance_along_m2"] - rows["scale_error_m"] ** 2
        variance = np.diff(np.interp(edges, time, own))[0] + scale_m**2
        inside = (steps_s >= edges[0]) & (steps_s <= edges[1])
        flags = rows["flags"][result.step_ticks[inside]] & IRREGULAR
        out.append(
            Score(
                walk,
                measured,
                part.true_m,
                float(max(variance, 1e-4)),
                float(np.mean(flags > 0)) if inside.any() else 1.0,
            )
        )
    return out


def turn_error(walk: Walk, result: Reckoning) -> tuple[float, float] | None:
    """Error of the net turn in degrees, and its normalised square; None where it is not known."""
    if walk.turn_deg is None:
        return None
    time, heading = walk.recording.time_s, np.unwrap(result.rows["heading_rad"])
    if len(ends := walk.recording.times_of("uturn_end")):
        begin, end = float(walk.recording.times_of("uturn_start")[0]) - 0.5, float(ends[0]) + 0.5
        span_s = 2.0 * SETTLE_S
    else:
        part, span_s = walk.parts[0], SETTLE_S
        begin, end = part.begin_s + SETTLE_S, part.end_s - SETTLE_S

    def mean(after: float, before: float) -> float:
        return float(heading[(time >= after) & (time <= before)].mean())

    turn = np.degrees(mean(end, end + span_s) - mean(begin - span_s, begin))
    true = walk.turn_deg
    error = abs(turn) - abs(true) if abs(true) == 180.0 else turn - true
    variance = np.diff(np.interp([begin, end], time, result.rows["variance_heading_rad2"]))[0]
    # The trunk's own swing about the walking direction, averaged over two strides: 2 degrees.
    return float(error), float(error**2 / (np.degrees(1.0) ** 2 * variance + 2.0 * 2.0**2))


def turn_errors(walk: Walk, gain: float, biases_rad_s: Array) -> list[tuple[float, float]]:
    """`turn_error` s with a node's chip: others than the sensors of the recordings, and not zeroed.

    Of three of the chips whose turn-on ``biases_rad_s`` (n, 3) were measured. None where samples
    of the turn are missing: a gyroscope turns by 180 degrees with its wearer.
    """
    if walk.turn_deg is None:
        return []
    if len(starts := walk.recording.times_of("uturn_start")):
        times_s = [starts[0] - SETTLE_S, walk.recording.times_of("uturn_end")[0] + SETTLE_S]
        heading_rad = recordings.gyro_heading_rad(walk.recording)
        raw_deg = np.degrees(np.diff(np.interp(times_s, walk.recording.time_s, heading_rad))[0])
        if abs(raw_deg) < abs(walk.turn_deg) - LOST_TURN_DEG:
            return []
    first = sum(map(ord, walk.recording.name))
    chosen = [biases_rad_s[(first + 3 * k) % len(biases_rad_s)] for k in range(3)]
    found = [turn_error(walk, walk.reckon(gain, bias_rad_s=bias)) for bias in chosen]
    return [turn for turn in found if turn]


def chip_biases_rad_s(root: Path) -> Array:
    """Turn-on biases (n, 3) of the chips of ``still_mpu9150_8chips``, one where it is not there."""
    folder = root / "still_mpu9150_8chips" / "exp1"
    if not folder.is_dir():
        return np.zeros((1, 3))
    with gzip.open(folder / "imu.csv.gz", "rt") as stream:
        columns = np.loadtxt(stream, delimiter=",", skiprows=1, usecols=(1, 5, 6, 7))
    nodes = np.unique(columns[:, 0])
    return np.array([np.median(columns[columns[:, 0] == n, 1:], axis=0) for n in nodes])


# --- constants with a set or a person left out ----------------------------------------------------

CONSTANTS = {
    "kTurn_rad": (1.0, 1.15, 1.3, 1.5, 1.7),
    "kLimpShare": (0.0, 0.5, 1.0, 1.5),
}
"""Values tried, by the firmware's name for them (gait.cpp, gait.h, dead_reckoning.cpp)."""


@dataclass(frozen=True)
class Choice:
    """Constants that fit some people best."""

    values: tuple[float, ...]
    gain: float


class Fit:
    """Chooses constants on all walks but those that are left out.

    The loss is the mean absolute logarithm of measured over true length; every person counts alike.
    """

    def __init__(
        self, walks: Sequence[Walk], tried: Mapping[str, tuple[float, ...]] = CONSTANTS
    ) -> None:
        self.walks = [w for w in walks if not any(word in w.group for word in NOT_FITTED)]
        self.grid = list(itertools.product(*tried.values()))
        self.default_gain = replay.default_gain()
        logs = []
        for values in self.grid:
            with replay.constants(dict(zip(CONSTANTS, values, strict=True))):
                logs.append([self._log(walk) for walk in self.walks])
        self.logs = np.array(logs)  # (grid, walks)

    @staticmethod
    def _log(walk: Walk) -> float:
        found = scores(walk, walk.reckon())
        ratio = sum(s.measured_m for s in found) / sum(s.true_m for s in found)
        return float(np.log(max(ratio, 0.05)))

    def without(self, leave_out: Callable[[Walk], bool]) -> Choice:
        """The constants that are best for the others."""
        kept = np.array([not leave_out(walk) for walk in self.walks])
        if not kept.any():
            return Choice(self.grid[0], self.default_gain)
        weights = np.zeros(len(self.walks))
        names = np.array([f"{w.group} {w.person}" for w in self.walks])
        for name in np.unique(names[kept]):
            own = kept & (names == name)
            weights[own] = 1.0 / own.sum()
        best = (np.inf, self.grid[0], 0.0)
        for values, logs in zip(self.grid, self.logs, strict=True):
            shift = weighted_median(logs, weights)
            best = min(best, (float(weights @ np.abs(logs - shift)), values, shift))
        return Choice(best[1], self.default_gain * float(np.exp(-best[2])))

    def without_set(self, data_set: str) -> Choice:
        """The constants that are best for all other sets."""
        return self.without(lambda walk: walk.data_set == data_set)


def weighted_median(values: Array, weights: Array) -> float:
    """Value with half of the weight below it: the shift with the least mean absolute rest."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def choose(choice: Choice) -> contextlib.AbstractContextManager[None]:
    """Context in which the library has the constants of a choice."""
    return replay.constants(dict(zip(CONSTANTS, choice.values, strict=False)))


# --- calibration ---------------------------------------------------------------------------------


def calibrated(walks: Sequence[Walk], gain: float) -> list[Score]:
    """Every ordered pair of a person's walks: the first calibrates, the second is judged."""
    out = []
    for person in sorted({w.person for w in walks}):
        own = [w for w in walks if w.person == person]
        for first in own:
            result = first.reckon(gain)
            found = scores(first, result)
            asked = sum(s.true_m for s in found) / max(sum(s.measured_m for s in found), 0.01)
            scale = posterior_scale([asked], [max(int(result.rows["steps"][-1]), 1)])
            for walk in own:
                if walk is not first:
                    out += scores(walk, walk.reckon(gain * scale, CALIBRATED_SIGMA))
    return out


def groups_of(walks: Sequence[Walk]) -> Iterator[tuple[str, list[Walk]]]:
    """Walks by group."""
    for group in sorted({w.group for w in walks}):
        yield group, [w for w in walks if w.group == group]
