"""Dead reckoning on simulated wearers: what is claimed, against the truth that is known.

The wearers are those of ``wearers.solo.make_walker``; the sensors are the emulator's
MPU-9150 (DLPF 4, 4 g, 1000 deg/s) and AK8975. `simulate` gives one walk for work on the filter:

    imu, field_ut, truth = simulate("mixed", seed=3)      # (n, 6), (n, 3) at 50 Hz, WearerTruth
    result = replay.reckon(imu, field_ut, leg_length_m=truth.person.leg_length_m)

``truth.position_m[::4]`` and all other arrays of the truth are at 200 Hz, on the same clock.

Run as ``.venv/bin/python bench/inertial/simulated.py [--wearers 50] [--processes 2]
[--only papers|activities]``: the paper's 310 m in 380 s, open and in laps, with a disturbed
magnetometer, without, and switched on while walking; then a table by activity. A simulator is no
recording: see docs/gait.md for how far it resembles them.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import replay
from numpy.typing import NDArray

from relpos.emulator import ak8975, mpu9150
from relpos.emulator.surroundings import (
    InertialErrors,
    MagneticErrors,
    Surroundings,
    draw_inertial_errors,
    draw_magnetic_errors,
)

sys.path.insert(0, str(Path(__file__).parents[1]))
from wearers.activities import ACTIVITIES, SCRIPTS
from wearers.indoor import INDOOR
from wearers.motion import WearerTruth
from wearers.solo import make_walker
from wearers.wearer import PLACES

Array = NDArray[np.float64]

WINDOW_S = 10.0
"""Motion between two readings this far apart is what the normalised errors are taken of."""


def inertial_errors(rng: np.random.Generator, calibrated: bool) -> InertialErrors:
    """One MPU-9150: as from the tray, or as a calibration leaves it.

    The gyroscope's bias is 1 deg/s (sd an axis) from the tray and 0.1 deg/s calibrated; a
    calibration leaves a fifth of the accelerometer's bias and of all scale errors.
    """
    errors = draw_inertial_errors(rng)
    bias = np.radians(0.1 if calibrated else 1.0) * rng.standard_normal(3)
    # The node takes its time from its own quartz: the chip's own clock does not show.
    errors = replace(errors, gyroscope_bias_rad_s=bias, sample_clock_ppm=0.0)
    if not calibrated:
        return errors
    return replace(
        errors,
        accelerometer_gain=np.eye(3) + 0.2 * (errors.accelerometer_gain - np.eye(3)),
        gyroscope_gain=np.eye(3) + 0.2 * (errors.gyroscope_gain - np.eye(3)),
        accelerometer_bias_m_s2=0.2 * errors.accelerometer_bias_m_s2,
    )


def magnetic_errors(rng: np.random.Generator, calibrated: bool) -> MagneticErrors:
    """One AK8975; a calibration leaves a fifth of its hard iron."""
    errors = draw_magnetic_errors(rng)
    return replace(errors, bias_ut=0.2 * errors.bias_ut) if calibrated else errors


def sense(truth: WearerTruth, rng: np.random.Generator, calibrated: bool) -> tuple[Array, Array]:
    """What the chips read of ``truth`` at 50 Hz: ``imu`` (n, 6) and field (n, 3) in SI and uT.

    The field is read at 5 Hz and held between.
    """
    around = Surroundings.of(truth)
    errors = magnetic_errors(rng, calibrated)
    chip = mpu9150.Mpu9150(around, inertial_errors(rng, calibrated))
    compass = ak8975.Ak8975(around, errors)
    for register, value in (
        (mpu9150.PWR_MGMT_1, 0),
        (mpu9150.CONFIG, 4),
        (mpu9150.GYRO_CONFIG, 1 << 3),
        (mpu9150.ACCEL_CONFIG, 1 << 3),
    ):
        chip.transfer(bytes((register, value)), b"", 0)
    force_unit = 9.80665 / mpu9150.ACCELEROMETER_LSB_PER_G[1]
    rate_unit = np.radians(1.0) / mpu9150.GYROSCOPE_LSB_PER_DEG_S[1]
    gain = (np.array(errors.adjustment) + 128.0) / 256.0
    count = (len(truth.time_s) + 3) // 4
    imu, field_ut = np.empty((count, 6)), np.empty((count, 3))
    latest = np.zeros(3)
    for k in range(count):
        now_us = 20_000 * k + 2_000  # the chip's first sample is there after a millisecond
        chip.advance(now_us)
        data = chip.transfer(bytes((mpu9150.ACCEL_XOUT_H,)), b"", 14)[1]
        words = np.frombuffer(data, dtype=">i2").astype(np.float64)
        imu[k, :3], imu[k, 3:] = words[:3] * force_unit, words[4:] * rate_unit
        if k % 10 == 0:
            compass.advance(now_us)
            compass.transfer(bytes((ak8975.CNTL, ak8975.SINGLE)), b"", 0)
            compass.advance(now_us + 10_000)
            raw = np.frombuffer(compass.transfer(bytes((ak8975.HXL,)), b"", 6)[1], dtype="<i2")
            value = raw * gain * ak8975.Ak8975.ut_per_lsb
            latest = np.array([value[1], value[0], -value[2]])
        field_ut[k] = latest
    return imu, field_ut


def simulate(
    kind: str,
    seed: int,
    *,
    calibrated: bool = False,
    begin_walking: bool = False,
    disturbed: bool = True,
    place: str | None = None,
) -> tuple[Array, Array, WearerTruth]:
    """Give one wearer's readings at 50 Hz, ``imu`` (n, 6) and field (n, 3), and the truth.

    ``kind`` is one of `SCRIPTS`; ``disturbed`` puts them into a building's magnetic field.
    """
    world = INDOOR if disturbed else None
    truth, _ = make_walker(kind, seed, world=world, begin_walking=begin_walking, place=place)
    rng = np.random.default_rng([seed, 0x5E])
    return *sense(truth, rng, calibrated), truth


BROKEN_BY = ("x_m", "y_m", "heading_rad", "variance_along_m2", "variance_heading_rad2")


# -- figures ----------------------------------------------------------------------------------


@dataclass
class Walk:
    """What one walk came to. Errors are claimed less true."""

    place: str
    """Where the sensor sat."""
    broken: bool
    """The filter gave something that is no number: in none of the other figures."""
    distance_error: float
    """Relative."""
    drift_deg_min: float
    end_error_m: float
    aligned_end_error_m: float
    """After turning the track to the first leg."""
    along: list[float] = field(default_factory=list)
    """Squared errors over their variances in windows of `WINDOW_S`, as the next two."""
    across: list[float] = field(default_factory=list)
    heading: list[float] = field(default_factory=list)
    windows: int = 0
    without_variance: int = 0
    """Windows with motion in which no variance is claimed for one of the three: not in the NEES."""
    whole_heading: float = 0.0
    claimed_m: dict[str, float] = field(default_factory=dict)
    true_m: dict[str, float] = field(default_factory=dict)
    found: dict[str, int] = field(default_factory=dict)
    extra: dict[str, int] = field(default_factory=dict)
    steps: dict[str, int] = field(default_factory=dict)
    straights: list[tuple[float, float, float]] = field(default_factory=list)
    """Speed, true and claimed distance of each stretch of walking of more than 8 m."""
    squares: dict[str, list[tuple[float, float, float]]] = field(default_factory=dict)
    """By activity: along, across, heading of windows that lie mostly in it."""


def smooth(values: Array) -> Array:
    """Mean over 1.2 s: the stride's own motion goes."""
    kernel = np.ones(61) / 61.0
    padded = np.pad(values, ((30, 30), (0, 0)), mode="edge")
    return np.stack([np.convolve(c, kernel, "valid") for c in padded.T], axis=1)


def planar(angle_rad: float) -> Array:
    """Rotation (2, 2)."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])


def judge(imu: Array, field_ut: Array | None, truth: WearerTruth) -> Walk:
    """Run the firmware's filter over one walk and compare."""
    result = replay.reckon(imu, field_ut, leg_length_m=truth.person.leg_length_m)
    rows = result.rows
    count = len(rows)
    claimed = np.stack([rows["x_m"], rows["y_m"]], axis=1).astype(np.float64)
    turned = np.unwrap(rows["heading_rad"].astype(np.float64))
    facing = truth.facing_rad[::4][:count]
    position = smooth(truth.position_m[::4, :2][:count])
    start = planar(-float(facing[:25].mean()))
    actual = (position - position[:25].mean(axis=0)) @ start.T
    path = truth.path_m[::4][:count]
    error = turned - (facing - facing[:25].mean())
    error -= 2 * np.pi * np.round(np.median(error) / (2 * np.pi))
    # The drift counts from the tenth step, when the forward axis is usually known.
    times = truth.steps.time_s
    first = int(50 * times[min(10, len(times) - 1)]) if len(times) else 0
    first = min(first, count - 100)
    minutes = (count - first) / 50.0 / 60.0
    drift = error[-50:].mean() - error[first : first + 50].mean()
    distance = truth.distance_m
    walk = Walk(
        place=truth.wearer.place,
        broken=not all(np.isfinite(rows[name]).all() for name in BROKEN_BY),
        distance_error=result.distance_m / distance - 1.0 if distance > 1.0 else float("nan"),
        drift_deg_min=float(np.degrees(drift) / minutes),
        end_error_m=float(np.linalg.norm(claimed[-1] - actual[-1])),
        aligned_end_error_m=_aligned_end(claimed, actual, path),
    )
    variance = {
        name: rows[f"variance_{name}"].astype(np.float64)
        for name in ("along_m2", "across_m2", "heading_rad2")
    }
    grown = float(variance["heading_rad2"][-1] - variance["heading_rad2"][first])
    walk.whole_heading = float(drift**2) / grown if grown > 0.0 else float("nan")
    labels = truth.activity[::4][:count]
    edges = np.arange(first, count - 1, round(WINDOW_S * 50))
    for a, b in pairwise(edges):
        moved = planar(-float(facing[a])) @ (position[b] - position[a])
        reported = planar(-float(turned[a])) @ (claimed[b] - claimed[a])
        delta = reported - moved
        turn = float(error[b - 25 : b + 25].mean() - error[max(a - 25, 0) : a + 25].mean())
        spans = {name: float(v[b] - v[a]) for name, v in variance.items()}
        if path[b] - path[a] > 0.3 or np.linalg.norm(reported) > 0.3:
            walk.windows += 1
            if min(spans.values()) <= 0.0:
                walk.without_variance += 1
                continue
            walk.along.append(float(delta[0] ** 2 / spans["along_m2"]))
            walk.across.append(float(delta[1] ** 2 / spans["across_m2"]))
            walk.heading.append(turn**2 / spans["heading_rad2"])
            inside = labels[a:b][labels[a:b] >= 0]
            if len(inside):
                most = np.bincount(inside).argmax()
                if np.mean(inside == most) > 0.6:
                    walk.squares.setdefault(ACTIVITIES[most], []).append(
                        (walk.along[-1], walk.across[-1], walk.heading[-1])
                    )
    _by_activity(walk, result, truth, path, labels)
    return walk


def _aligned_end(claimed: Array, actual: Array, path: Array) -> float:
    """Distance of the ends after turning the claimed track to the first 10 m (or a third)."""
    leg = min(10.0, float(path[-1]) / 3.0)
    at = int(np.searchsorted(path, leg))
    if leg < 1.0 or at >= len(path) or np.linalg.norm(claimed[at]) < 0.5:
        return float("nan")
    angle = np.arctan2(actual[at, 1], actual[at, 0]) - np.arctan2(claimed[at, 1], claimed[at, 0])
    return float(np.linalg.norm(planar(float(angle)) @ claimed[-1] - actual[-1]))


def _by_activity(
    walk: Walk,
    result: replay.Reckoning,
    truth: WearerTruth,
    path: Array,
    labels: NDArray[np.int8],
) -> None:
    step_s = result.step_ticks / 50.0
    lengths = result.step_lengths_m
    moved = np.diff(path, prepend=path[0])
    # Detection lags the mid-stance by the detector's own filters: one offset for the walk.
    offsets = np.arange(-0.3, 0.31, 0.05)
    best = max(offsets, key=lambda o: replay.pairs_within(step_s + o, truth.steps.time_s, 0.25))
    # A step's way lies before its mid-stance: a quarter of a second keeps it with its activity.
    place = np.clip(((step_s + best - 0.25) * 50).astype(int), 0, len(labels) - 1)
    label_of = labels[place]
    for index, name in enumerate(ACTIVITIES):
        inside = labels == index
        if not inside.any():
            continue
        true_s = truth.steps.time_s[truth.steps.activity == index]
        mine = step_s[label_of == index] + best
        found = replay.pairs_within(step_s + best, true_s, 0.25)
        walk.steps[name] = len(true_s)
        walk.found[name] = found
        walk.extra[name] = max(len(mine) - replay.pairs_within(mine, truth.steps.time_s, 0.25), 0)
        walk.true_m[name] = float(moved[inside].sum())
        walk.claimed_m[name] = float(lengths[label_of == index].sum())
    for begin, end, kind in truth.intervals:
        span = slice(int(begin * 50), int(end * 50))
        true_m = float(moved[span].sum())
        if kind == "walk" and true_m > 8.0:
            inside = (place >= span.start) & (place < span.stop)
            speed = true_m / (end - begin)
            walk.straights.append((speed, true_m, float(lengths[inside].sum())))


def interval(groups: Sequence[Sequence[float]]) -> str:
    """Mean of all with its 95 % interval, resampling whole walks."""
    kept = [np.asarray(g, dtype=np.float64) for g in groups if len(g)]
    if not kept:
        return "-"
    rng = np.random.default_rng(0)
    means = [
        np.concatenate([kept[i] for i in rng.integers(len(kept), size=len(kept))]).mean()
        for _ in range(1000)
    ]
    low, high = np.percentile(means, [2.5, 97.5])
    return f"{np.concatenate(kept).mean():.2f} ({low:.2f} to {high:.2f})"


@dataclass(frozen=True)
class Condition:
    """How a walk is simulated and replayed."""

    name: str
    magnetometer: bool = True
    begin_walking: bool = False
    calibrated: bool = False


CONDITIONS = (
    Condition("disturbed magnetometer"),
    Condition("disturbed magnetometer, calibrated", calibrated=True),
    Condition("no magnetometer", magnetometer=False),
    Condition("no magnetometer, calibrated", magnetometer=False, calibrated=True),
    Condition("started walking, disturbed magnetometer", begin_walking=True),
    Condition("started walking, no magnetometer", magnetometer=False, begin_walking=True),
)


def run(kind: str, condition: Condition, seed: int) -> Walk:
    """Simulate and judge one walk."""
    imu, field_ut, truth = simulate(
        kind, seed, calibrated=condition.calibrated, begin_walking=condition.begin_walking
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return judge(imu, field_ut if condition.magnetometer else None, truth)


def print_papers(walks: dict[tuple[str, str], list[Walk]]) -> None:
    """Print the 310 m walks: heading, distance, end and normalised errors."""
    for (kind, condition), everybody in walks.items():
        group = [w for w in everybody if not w.broken]
        drift = np.abs([w.drift_deg_min for w in group])
        distance = 100 * np.array([w.distance_error for w in group])
        end = np.array([w.end_error_m for w in group])
        aligned = np.array([w.aligned_end_error_m for w in group])
        lost = (
            f", {len(everybody) - len(group)} left out: no numbers"
            if len(group) < len(everybody)
            else ""
        )
        print(f"{kind}, {condition} ({len(everybody)} wearers{lost})")
        print(
            f"  heading drift {np.median(drift):.2f} deg/min median, "
            f"{np.percentile(drift, 90):.2f} p90; distance {distance.mean():+.1f} +- "
            f"{distance.std():.1f} %, mean absolute {np.abs(distance).mean():.1f} %"
        )
        print(
            f"  end error {np.median(end):.1f} m median, {np.percentile(end, 90):.1f} p90; "
            f"aligned to the first leg {np.nanmedian(aligned):.1f}, "
            f"{np.nanpercentile(aligned, 90):.1f} p90"
        )
        print(
            f"  NEES along {interval([w.along for w in group])}, across "
            f"{interval([w.across for w in group])}, heading {interval([w.heading for w in group])}"
            f", heading over the whole walk {interval([[w.whole_heading] for w in group])}; "
            f"no variance claimed in {sum(w.without_variance for w in group)} of "
            f"{sum(w.windows for w in group)} windows"
        )
        by_place = {p: [100 * w.distance_error for w in group if w.place == p] for p in PLACES}
        print(
            "  distance by place: "
            + ", ".join(
                f"{place} {np.mean(e):+.1f} +- {np.std(e):.1f} % ({len(e)})"
                for place, e in by_place.items()
                if e
            )
        )


def print_activities(everybody: list[Walk]) -> None:
    """Print what was claimed and what was true, by activity."""
    walks = [w for w in everybody if not w.broken]
    if len(walks) < len(everybody):
        print(f"{len(everybody) - len(walks)} walks left out: the filter gave no numbers")
    print(
        f"{'activity':12s} {'true m':>8s} {'claimed':>8s} {'ratio':>6s} {'steps':>6s} "
        f"{'found %':>8s} {'extra %':>8s}  NEES along, across, heading"
    )
    for name in ACTIVITIES:
        true = sum(w.true_m.get(name, 0.0) for w in walks)
        claimed = sum(w.claimed_m.get(name, 0.0) for w in walks)
        steps = sum(w.steps.get(name, 0) for w in walks)
        found = sum(w.found.get(name, 0) for w in walks)
        extra = sum(w.extra.get(name, 0) for w in walks)
        if not any(name in w.true_m for w in walks):
            continue
        squares = [
            interval([[s[k] for s in w.squares.get(name, [])] for w in walks]) for k in range(3)
        ]
        ratio = f"{claimed / true:6.2f}" if true > 1.0 else "     -"
        share = f"{100 * found / steps:8.1f} {100 * extra / steps:8.1f}" if steps else " " * 17
        print(
            f"{name:12s} {true:8.1f} {claimed:8.1f} {ratio} {steps:6d} {share}  "
            + ", ".join(squares)
        )
    print(
        f"no variance claimed in {sum(w.without_variance for w in walks)} of "
        f"{sum(w.windows for w in walks)} windows with motion"
    )


def print_speeds(walks: list[Walk]) -> None:
    """Print the distance's error by walking speed."""
    rows = np.array([s for w in walks if not w.broken for s in w.straights])
    print(f"{'walking at':>14s} {'stretches':>9s}  distance error of a stretch")
    for low, high in pairwise((0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.9)):
        some = rows[(rows[:, 0] >= low) & (rows[:, 0] < high)]
        if len(some):
            error = 100 * (some[:, 2] / some[:, 1] - 1.0)
            print(
                f"{low:.1f} to {high:.1f} m/s {len(some):9d}  {error.mean():+.1f} +- "
                f"{error.std():.1f} %, mean absolute {np.abs(error).mean():.1f} %"
            )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--wearers", type=int, default=50)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", choices=("papers", "activities"))
    parser.add_argument("--kind", choices=sorted(SCRIPTS), help="this script's table alone")
    options = parser.parse_args()
    seeds = range(1000, 1000 + options.wearers)
    replay.build()
    with multiprocessing.Pool(options.processes) as pool:
        if options.only != "activities" and options.kind is None:
            papers = {
                (kind, c.name): pool.map(partial(run, kind, c), seeds)
                for kind in ("paper310", "paper310_open")
                for c in CONDITIONS
            }
            print_papers(papers)
        if options.only != "papers":
            condition = Condition("no magnetometer, calibrated", False, calibrated=True)
            kinds = [options.kind] if options.kind else ["mixed", "daily", "speeds", "pauses"]
            for kind in kinds:
                print(f"\nscript {kind}, {options.wearers} wearers, {condition.name}")
                walks = pool.map(partial(run, kind, condition), seeds)
                print_activities(walks)
                if kind == "speeds":
                    print_speeds(walks)


if __name__ == "__main__":
    main()
