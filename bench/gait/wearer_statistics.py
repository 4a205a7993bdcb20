"""The wide wearers of `solo.make_walker` beside real recordings: tables and pictures.

``python bench/gait/wearer_statistics.py [DATA] [--pictures FOLDER]`` prints what
docs/gait.md shows of them; DATA is the folder of recordings, by default RELPOS_DATA or
../shared/data. Both sides go through the same functions.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import scipy

from gait_statistics import (
    GaitStatistics,
    about,
    apparent_gain,
    events_of,
    gait_statistics,
    print_statistics,
    read_samples,
    recorded_walk,
    recorded_ways_out,
)
from relpos.calibration.steps import LEG_OF_STATURE
from relpos.simulation.torso import rotation
from relpos.simulation.world import FloatArray

sys.path.insert(0, str(Path(__file__).parents[1]))
from shared_data import DATA
from wearers.activities import Activity
from wearers.indoor import INDOOR
from wearers.motion import WearerTruth
from wearers.solo import make_walker
from wearers.wearer import make_wearer

LOWER_BACK = "walk_lowerback_20m"
STAND = Activity("stand", seconds=4.0)


# -- step length against excursion ------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Excursions:
    """One row a walk: person (k,), then length, cadence, rise, stature and pendulum gain (k, 5)."""

    person: np.ndarray[tuple[int], np.dtype[np.int64]]
    rows: FloatArray

    def within(self, column: int) -> float:
        """Relative sd within a person, of walks."""
        values = np.log(self.rows[:, column])
        parts = [values[self.person == p] for p in np.unique(self.person)]
        return math.sqrt(float(np.mean([v.var(ddof=1) for v in parts if len(v) > 1])))

    def between(self, column: int) -> float:
        """Relative sd of the persons' means."""
        values = np.log(self.rows[:, column])
        means = [values[self.person == p].mean() for p in np.unique(self.person)]
        return float(np.std(means, ddof=1))

    def regression(
        self, outcome: int, on: Sequence[int], *, by_person: bool
    ) -> tuple[FloatArray, float]:
        """Exponents of ``outcome`` on columns ``on`` and the relative sd that is left."""
        log = np.log(self.rows)
        persons = np.unique(self.person)
        level = (self.person[:, None] == persons) if by_person else np.ones((len(log), 1))
        design = np.hstack([log[:, list(on)], level.astype(np.float64)])
        solution = np.linalg.lstsq(design, log[:, outcome], rcond=None)[0]
        left = log[:, outcome] - design @ solution
        freedom = len(log) - design.shape[1]
        return solution[: len(on)], math.sqrt(float((left**2).sum()) / freedom)

    def errors(self) -> tuple[float, float, float]:
        """Mean absolute error of a constant step, one gain, a gain a person (leave one out)."""
        length, gain = np.log(self.rows[:, 0]), np.log(self.rows[:, 4])
        one = [np.abs(np.expm1(v.mean() - v)).mean() for v in (length, gain)]
        own = []
        for person in np.unique(self.person):
            values = gain[self.person == person]
            if len(values) > 1:
                rest = (values.sum() - values) / (len(values) - 1)
                own.append(np.abs(np.expm1(rest - values)))
        return float(one[0]), float(one[1]), float(np.concatenate(own).mean())


def recorded_excursions(folder: Path) -> Excursions:
    """Walks of walk_lowerback_20m whose person has a stature; rise on the way out."""
    return Excursions(*recorded_ways_out(folder / LOWER_BACK))


def simulated_excursions(people: int, walks: int, seed: int) -> Excursions:
    """Measure the same of wearers with the sensor on the lower back: 10 m, a U-turn, 10 m.

    Their speeds are spread like the recorded ones: 1.08 m/s, 13 % between people, 8 % within.
    """
    person, rows = [], []
    script = [STAND, Activity("walk", 10.0), Activity("walk", 1.5, math.pi), Activity("walk", 10.0)]
    for p in range(people):
        rng = np.random.default_rng([seed, p])
        wearer = make_wearer(rng, place="lower_back", limping=False)
        own = float(np.clip(rng.normal(1.08, 0.14), 0.75, 1.5))
        for k in range(walks):
            walker = make_walker(
                script,
                1000 * seed + 10 * p + k,
                wearer=replace(wearer, speed_m_s=own * math.exp(rng.normal(0.0, 0.08))),
            )[0]
            steps = walker.steps.time_s
            out = steps[steps < np.interp(10.0, walker.path_m, walker.time_s)]
            part = (walker.time_s > out[1]) & (walker.time_s < out[-1])
            cadence = (len(out) - 2) / (out[-1] - out[1])
            length = 20.0 / len(steps)
            rise, gain = apparent_gain(
                walker.specific_force_m_s2[part],
                200.0,
                cadence,
                length,
                LEG_OF_STATURE * wearer.stature_m,
            )
            person.append(p)
            rows.append((length, cadence, rise, wearer.stature_m, gain))
    return Excursions(np.array(person), np.array(rows))


def print_excursions(title: str, e: Excursions) -> None:
    """Print the table of docs/gait.md's section on step length and excursion."""
    mean = e.rows.mean(axis=0)
    print(f"{title}: {len(e.rows)} walks of {len(np.unique(e.person))} people")
    names = ("step length, m", "cadence, 1/s", "rise, m", "", "pendulum gain")
    for k in (0, 1, 2, 4):
        print(
            f"  {names[k]:16s} {mean[k]:.3f}  within {100 * e.within(k):.1f} %, "
            f"between {100 * e.between(k):.1f} %"
        )
    constant, one, own = (100 * x for x in e.errors())
    print(
        f"  mean absolute error: constant step {constant:.1f} %, one gain {one:.1f} %, "
        f"a gain a person {own:.1f} %"
    )
    for label, outcome, on, by_person in (
        ("rise on length, cadence, within people", 2, (0, 1), True),
        ("rise on length, cadence, stature", 2, (0, 1, 3), False),
        ("length on rise, cadence, within people", 0, (2, 1), True),
        ("length on rise, stature", 0, (2, 3), False),
        ("length on cadence, stature", 0, (1, 3), False),
    ):
        power, left = e.regression(outcome, on, by_person=by_person)
        powers = ", ".join(f"{p:+.2f}" for p in power)
        print(f"  {label}: exponents {powers}, left over {100 * left:.1f} %")


# -- acceleration by place --------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Walking:
    """Statistics of a walk, and its vertical acceleration's density over 0 to 25 Hz."""

    statistics: GaitStatistics
    density: FloatArray


DENSITY_HZ = np.arange(0.0, 25.01, 0.25)


def _density(force: FloatArray, rate_hz: float) -> FloatArray:
    mean = force.mean(axis=0)
    vertical = force @ mean / np.linalg.norm(mean)
    frequency, power = scipy.signal.welch(
        vertical - vertical.mean(), rate_hz, nperseg=min(len(vertical), round(4 * rate_hz))
    )
    return np.asarray(np.interp(DENSITY_HZ, frequency, power))


def recorded_walking(folder: Path) -> list[Walking]:
    """Every walk in a folder of runs that is long enough."""
    out = []
    for run in sorted(folder.iterdir()):
        statistics = recorded_walk(run)
        if statistics is None:
            continue
        time_s, values = read_samples(run)
        norm = np.linalg.norm(values[:, :3], axis=1)
        spread = np.convolve((norm - norm.mean()) ** 2, np.ones(200) / 200, "same")
        walking = np.flatnonzero(spread > 0.5)
        part = slice(int(walking[0]), int(walking[-1]) + 1)
        rate_hz = 1.0 / float(np.median(np.diff(time_s)))
        out.append(Walking(statistics, _density(values[part, :3], rate_hz)))
    return out


def simulated_walking(
    place: str, speed_m_s: tuple[float, float], people: int, seed: int
) -> list[Walking]:
    """Straight walks of 45 s with the sensor at ``place``, sampled at 100 Hz."""
    out = []
    for p in range(people):
        rng = np.random.default_rng([seed, p])
        speed = float(rng.uniform(*speed_m_s))
        wearer = make_wearer(rng, place=place, speed_m_s=speed, limping=False)
        walker = make_walker(
            [STAND, Activity("walk", 45.0 * speed)], 1000 * seed + p, wearer=wearer
        )[0]
        part = slice(6 * 200, -5 * 200)
        force, rate = (
            scipy.signal.decimate(values[part], 2, ftype="fir", axis=0)
            for values in (walker.specific_force_m_s2, walker.angular_rate_rad_s)
        )
        out.append(Walking(gait_statistics(force, rate, 100.0), _density(force, 100.0)))
    return out


# -- slow indoor bouts ------------------------------------------------------------------------


def _height(force: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Height between 0.5 and 5 Hz and vertical acceleration, (n,) each."""
    mean = force.mean(axis=0)
    vertical = force @ (mean / np.linalg.norm(mean)) - np.linalg.norm(mean)
    frequency = np.fft.rfftfreq(len(vertical), 1.0 / rate_hz)
    kept = (frequency > 0.5) & (frequency < 5.0)
    omega = 2 * np.pi * np.maximum(frequency, 1e-9)
    height = np.fft.irfft(np.where(kept, -np.fft.rfft(vertical) / omega**2, 0.0), len(vertical))
    return height, np.asarray(vertical)


def bout(
    force: FloatArray, rate_hz: float, steps_s: FloatArray, length_m: float, leg_m: float
) -> tuple[float, float, float, float, float]:
    """Step length, cadence, median rise, pendulum gain and vertical rms of one bout of steps."""
    begin = max(round((steps_s[0] - 2.0) * rate_hz), 0)
    height, vertical = _height(force[begin : round((steps_s[-1] + 2.0) * rate_hz)], rate_hz)
    at = np.round(steps_s * rate_hz).astype(int) - begin
    rise = np.array([np.ptp(height[a:b]) for a, b in pairwise(at) if b > a + 5])
    chord = 2 * np.sqrt(2 * leg_m * rise - rise**2)
    step = length_m / (len(steps_s) - 1)
    return (
        step,
        (len(steps_s) - 1) / float(steps_s[-1] - steps_s[0]),
        float(np.median(rise)),
        step / float(chord.mean()),
        float(vertical[at[0] : at[-1]].std()),
    )


def recorded_bouts(folder: Path) -> FloatArray:
    """Rows of `bout` (k, 5) of walk_daily_lowerback's bouts slower than 0.7 m/s."""
    rows = []
    for run in sorted((folder / "walk_daily_lowerback").iterdir()):
        events = events_of(run)
        time_s, values = read_samples(run)
        leg = LEG_OF_STATURE * float(about(run)["stature_m"])
        rate_hz = 1.0 / float(np.median(np.diff(time_s)))
        begins = [(t, float(v)) for t, event, v in events if event == "bout_start"]
        ends = [t for t, event, _ in events if event == "bout_end"]
        for (begin, length), end in zip(begins, ends, strict=True):
            steps = np.array(
                sorted(t for t, e, _ in events if e == "foot_contact" and begin <= t <= end)
            )
            # One bout has lost contacts: steps of a metre.
            if length / (end - begin) < 0.7 and length / (len(steps) - 1) < 0.8:
                rows.append(bout(values[:, :3], rate_hz, steps - time_s[0], length, leg))
    return np.array(rows)


def simulated_bouts(people: int, seed: int) -> FloatArray:
    """Rows of `bout` (k, 5) of the script ``daily``, sensor on the lower back, under 0.7 m/s."""
    rows = []
    for p in range(people):
        walker = make_walker("daily", 1000 * seed + p, place="lower_back")[0]
        leg = LEG_OF_STATURE * walker.person.stature_m
        for begin, end, kind in walker.intervals:
            steps = walker.steps.time_s
            steps = steps[(steps >= begin) & (steps <= end)]
            if kind not in ("walk", "shuffle") or len(steps) < 5:
                continue
            first, last = np.interp(steps[[0, -1]], walker.time_s, walker.path_m)
            if (last - first) / (steps[-1] - steps[0]) < 0.7:
                rows.append(
                    bout(walker.specific_force_m_s2, 200.0, steps, float(last - first), leg)
                )
    return np.array(rows)


def print_bouts(title: str, rows: FloatArray) -> None:
    """Print medians with the 10th and 90th percentile."""
    print(f"{title} ({len(rows)} bouts)")
    names = ("step length, m", "cadence, 1/s", "rise, m", "pendulum gain", "vertical rms, m/s2")
    for k, name in enumerate(names):
        low, middle, high = np.percentile(rows[:, k], [10, 50, 90])
        print(f"  {name:20s} {middle:6.3f}  from {low:.3f} to {high:.3f}")


# -- the magnetic field indoors ---------------------------------------------------------------

LAGS_S = (1.0, 2.0, 5.0, 10.0)


def field_direction(
    time_s: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Direction of the horizontal field in the gyroscope's level frame, norm and dip, (n,) each.

    The direction (rad, unwrapped) would be constant in an undisturbed field but for the
    gyroscope's drift; tilt follows gravity with 5 s.
    """
    count = len(time_s)
    force, rate, field = values[:, :3], values[:, 3:6], values[:, 6:9]
    spans = np.diff(time_s, prepend=time_s[0] - 0.02)
    up = force[:100].mean(axis=0)
    up /= np.linalg.norm(up)
    other = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.8 else np.array([0.0, 1.0, 0.0])
    east = np.cross(other, up)
    east /= np.linalg.norm(east)
    attitude = np.stack([east, np.cross(up, east), up])
    level = np.empty((count, 3))
    turns = rotation(*(rate * spans[:, None]).T)
    for k in range(count):
        attitude = attitude @ turns[k]
        x, y, z = attitude @ force[k]
        pull = spans[k] / 5.0 / math.hypot(x, y, z)
        tilt = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
        attitude = attitude + pull * tilt @ attitude
        if k % 50 == 0:
            u, _, v = np.linalg.svd(attitude)
            attitude = u @ v
        level[k] = attitude @ field[k]
    flat = np.hypot(level[:, 0], level[:, 1])
    return (
        np.unwrap(np.arctan2(level[:, 1], level[:, 0])),
        np.linalg.norm(level, axis=1),
        np.arctan2(-level[:, 2], flat),
    )


def field_statistics(time_s: FloatArray, values: FloatArray) -> FloatArray:
    """One walk's figures: deviations of heading (median, 95 %), norm, dip, changes over lags.

    In degrees, the norm relative; heading less a straight line for the gyroscope's drift.
    """
    direction, norm, dip = field_direction(time_s, values)
    direction = np.degrees(direction)
    away = np.abs(direction - np.polyval(np.polyfit(time_s, direction, 1), time_s))
    row = [
        float(np.median(away)),
        float(np.quantile(away, 0.95)),
        float(norm.std() / norm.mean()),
        float(np.degrees(dip.std())),
    ]
    rate_hz = 1.0 / float(np.median(np.diff(time_s)))
    for lag_s in LAGS_S:
        k = round(lag_s * rate_hz)
        change = np.abs(direction[k:] - direction[:-k]) if len(direction) > 2 * k else np.array([])
        row += [float(np.quantile(change, q)) if len(change) else math.nan for q in (0.5, 0.95)]
    return np.array(row)


def recorded_fields(folder: Path, runs: Sequence[Path] | None = None) -> FloatArray:
    """Rows of `field_statistics` of walk_handheld_waypoints, or of those ``runs`` of it."""
    rows = []
    for run in runs or sorted((folder / "walk_handheld_waypoints").iterdir()):
        time_s, values = read_samples(run)
        known = np.isfinite(values).all(axis=1) & (np.linalg.norm(values[:, :3], axis=1) > 0.1)
        if known.sum() > 500:
            rows.append(field_statistics(time_s[known], values[known]))
    return np.array(rows)


def sensed(walker: WearerTruth, rng: np.random.Generator) -> FloatArray:
    """Rows (n, 9) at 50 Hz: gyroscope off by 0.1 deg/s, field with 0.4 uT of noise."""
    rate = walker.angular_rate_rad_s[::4] + np.radians(0.1) * rng.standard_normal(3)
    field = walker.magnetic_field_ut[::4]
    field = field + 0.4 * rng.standard_normal(field.shape)
    return np.hstack([walker.specific_force_m_s2[::4], rate, field])


def simulated_fields(buildings: int, seed: int) -> FloatArray:
    """Rows of `field_statistics` of walks of 3 to 12 m between right angles, one a building."""
    rows = []
    for k in range(buildings):
        rng = np.random.default_rng([seed, k])
        speed = float(rng.uniform(1.0, 1.4))
        wearer = make_wearer(rng, place="chest", rigid=True, limping=False, speed_m_s=speed)
        script = [Activity("stand", seconds=2.0)]
        for _ in range(int(rng.integers(2, 8))):
            turn = float(rng.choice((-1.0, 1.0))) * math.pi / 2
            script += [Activity("walk", float(rng.uniform(3, 12))), Activity("walk", 1.5, turn)]
        walker = make_walker(script, 1000 * seed + k, wearer=wearer, world=INDOOR)[0]
        rows.append(field_statistics(walker.time_s[::4], sensed(walker, rng)))
    return np.array(rows)


def print_fields(title: str, rows: FloatArray) -> None:
    """Print the median walk with the 10th and 90th percentile of walks."""
    print(f"{title} ({len(rows)} walks): median walk, 10th to 90th percentile of walks")
    names = ["heading off, median deg", "heading off, 95 % deg", "norm sd, %", "dip sd, deg"]
    for lag_s in LAGS_S:
        names += [f"change in {lag_s:g} s, median deg", f"change in {lag_s:g} s, 95 % deg"]
    for k, name in enumerate(names):
        scale = 100.0 if k == 2 else 1.0
        low, middle, high = scale * np.nanpercentile(rows[:, k], [10, 50, 90])
        print(f"  {name:26s} {middle:5.1f}  {low:5.1f} to {high:5.1f}")


# -- pictures ---------------------------------------------------------------------------------


def draw(
    folder: Path,
    excursions: tuple[Excursions, Excursions],
    walking: Sequence[tuple[str, list[Walking], list[Walking]]],
) -> list[Path]:
    """Write ``gait-excursion.png`` and ``gait-spectrum.png`` into ``folder``."""
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for ax, e, title in zip(axes, excursions, ("recorded", "simulated"), strict=True):
        for person in np.unique(e.person):
            rows = e.rows[e.person == person]
            ax.plot(1000 * rows[:, 2], rows[:, 0], "o-", ms=3, lw=0.5, alpha=0.7)
        ax.set_title(f"lower back, {title}", fontsize=9)
        ax.set_xlabel("rise of the sensor in a step, mm", fontsize=8)
        ax.grid(alpha=0.3)
        ax.tick_params(labelsize=8)
        rise = np.linspace(0.01, 0.09, 50)
        chord = 2 * np.sqrt(2 * 0.91 * rise - rise**2)
        ax.plot(1000 * rise, 1.14 * chord, "k--", lw=1, label="pendulum, gain 1.14")
        ax.legend(fontsize=7)
    axes[0].set_ylabel("step length, m", fontsize=8)
    first = folder / "gait-excursion.png"
    figure.savefig(first, dpi=90, metadata={"Software": None})

    figure = Figure(figsize=(8.0, 3.0), layout="constrained")
    axes = figure.subplots(1, len(walking), sharex=True, sharey=True)
    for ax, (title, real, made) in zip(axes, walking, strict=True):
        for walks, colour, label in ((real, "C3", "recorded"), (made, "C0", "simulated")):
            density = np.array([w.density for w in walks])
            low, middle, high = np.percentile(density, [10, 50, 90], axis=0)
            ax.fill_between(DENSITY_HZ, low, high, color=colour, alpha=0.25, lw=0)
            ax.semilogy(DENSITY_HZ, middle, color=colour, lw=1, label=label)
        ax.set_title(title, fontsize=9)
        ax.set_xlabel("frequency, Hz", fontsize=8)
        ax.set_ylim(1e-4, 20.0)
        ax.grid(alpha=0.3)
        ax.tick_params(labelsize=8)
    axes[0].set_ylabel("vertical, (m/s2)2/Hz", fontsize=8)
    axes[0].legend(fontsize=7)
    second = folder / "gait-spectrum.png"
    figure.savefig(second, dpi=90, metadata={"Software": None})
    return [first, second]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print simulated and recorded walks side by side."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("data", nargs="?", type=Path, default=DATA)
    parser.add_argument("--pictures", type=Path, help="write the pictures into this folder")
    options = parser.parse_args(arguments)
    folder: Path = options.data
    if not folder.is_dir():
        print("no recordings: give their folder, or set RELPOS_DATA", file=sys.stderr)
        return 1
    excursions = recorded_excursions(folder), simulated_excursions(40, 5, 7)
    print_excursions(f"recorded {LOWER_BACK}", excursions[0])
    print_excursions("simulated, sensor on the lower back", excursions[1])
    chest, back = (recorded_walking(folder / name) for name in ("walk_chest", LOWER_BACK))
    walking = []
    for title, real, place, speeds in (
        ("chest, 1.4 to 1.68 steps/s", _paced(chest, 1.4, 1.68), "chest", (0.85, 0.95)),
        ("chest, 1.68 to 1.9 steps/s", _paced(chest, 1.68, 1.9), "chest", (1.0, 1.08)),
        ("back, 1.3 to 1.75 steps/s", _paced(back, 1.3, 1.75), "lower_back", (0.85, 1.0)),
        ("back, 1.75 to 2.3 steps/s", _paced(back, 1.75, 2.3), "lower_back", (1.05, 1.3)),
    ):
        made = simulated_walking(place, speeds, 24, 8)
        walking.append((title, real, made))
        print_statistics(f"recorded {title}", [walk.statistics for walk in real])
        simulated = f"simulated {place}, {speeds[0]} to {speeds[1]} m/s"
        print_statistics(simulated, [walk.statistics for walk in made])
    print_bouts("recorded walk_daily_lowerback, under 0.7 m/s", recorded_bouts(folder))
    print_bouts("simulated daily, under 0.7 m/s", simulated_bouts(20, 9))
    print_fields("recorded walk_handheld_waypoints", recorded_fields(folder))
    print_fields("simulated indoors", simulated_fields(60, 10))
    if options.pictures is not None:
        for path in draw(options.pictures, excursions, walking):
            print(path)
    return 0


def _paced(walks: list[Walking], low: float, high: float) -> list[Walking]:
    return [w for w in walks if low <= w.statistics.step_frequency_hz < high]


if __name__ == "__main__":
    raise SystemExit(main())
