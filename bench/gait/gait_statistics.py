"""Numbers that describe a walk seen by a torso IMU, for synthesised and recorded walks alike.

``python bench/gait/gait_statistics.py [DATA]`` prints the comparison of docs/gait.md;
DATA is the folder of recordings, by default RELPOS_DATA or ../shared/data.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy

from relpos.calibration.steps import LEG_OF_STATURE
from relpos.simulation.team import SCENARIOS, make_team
from relpos.simulation.world import FloatArray

sys.path.insert(0, str(Path(__file__).parents[1]))
from shared_data import DATA

HARMONICS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0)
"""In multiples of the step frequency: halves belong to the stride."""


@dataclass(frozen=True, slots=True)
class GaitStatistics:
    """Root mean squares of a stretch of walking; harmonics (8,) as in `HARMONICS`.

    Vertical is along the mean specific force, fore-aft the horizontal direction that moves most
    at the step frequency, lateral across both.
    """

    step_frequency_hz: float
    vertical_rms_m_s2: float
    vertical_peak_m_s2: float
    horizontal_rms_m_s2: float
    vertical: FloatArray
    fore_aft: FloatArray
    lateral: FloatArray
    yaw_rate: FloatArray
    pitch_rate: FloatArray
    roll_rate: FloatArray
    step_similarity: float
    """Autocorrelation of the vertical acceleration one step later, 1 for equal steps."""
    stride_similarity: float
    above_15_hz: float
    """Share of the vertical acceleration's rms that lies above 15 Hz."""


def gait_statistics(force: FloatArray, rate: FloatArray, rate_hz: float) -> GaitStatistics:
    """Statistics of specific force and angular rate, both (n, 3), sampled at ``rate_hz``."""
    mean = force.mean(axis=0)
    up = mean / np.linalg.norm(mean)
    vertical = force @ up - float(np.linalg.norm(mean))
    frequency, power = _spectrum(vertical, rate_hz)
    band = (frequency > 0.8) & (frequency < 2.6)
    step = float(frequency[band][np.argmax(power[band])])
    horizontal = force - np.outer(force @ up, up)
    horizontal = horizontal - horizontal.mean(axis=0)
    sos = scipy.signal.butter(2, (0.85 * step, 1.15 * step), "band", fs=rate_hz, output="sos")
    moving = scipy.signal.sosfiltfilt(sos, horizontal, axis=0)
    fore = np.linalg.svd(moving, full_matrices=False)[2][0]
    left = np.cross(up, fore)
    correlation = scipy.signal.correlate(vertical, vertical, "full", "fft")[len(vertical) - 1 :]
    correlation = correlation / correlation[0]
    lag = rate_hz / step

    def near(middle: float) -> float:
        return float(correlation[round(0.85 * middle) : round(1.15 * middle) + 1].max())

    high = power[frequency > 15.0].sum() / power.sum()
    return GaitStatistics(
        step_frequency_hz=step,
        vertical_rms_m_s2=float(vertical.std()),
        vertical_peak_m_s2=float(np.quantile(vertical, 0.995)),
        horizontal_rms_m_s2=float(np.sqrt((horizontal**2).sum(axis=1).mean())),
        vertical=_harmonics(vertical, step, rate_hz),
        fore_aft=_harmonics(horizontal @ fore, step, rate_hz),
        lateral=_harmonics(horizontal @ left, step, rate_hz),
        yaw_rate=_harmonics(rate @ up, step, rate_hz),
        pitch_rate=_harmonics(rate @ left, step, rate_hz),
        roll_rate=_harmonics(rate @ fore, step, rate_hz),
        step_similarity=near(lag),
        stride_similarity=near(2 * lag),
        above_15_hz=math.sqrt(float(high)),
    )


def _spectrum(values: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    segment = min(len(values), round(10 * rate_hz))
    frequency, power = scipy.signal.welch(
        values - values.mean(), rate_hz, nperseg=segment, nfft=8 * segment
    )
    return np.asarray(frequency), np.asarray(power)


def _harmonics(values: FloatArray, step_hz: float, rate_hz: float) -> FloatArray:
    frequency, power = _spectrum(values, rate_hz)
    width = frequency[1] - frequency[0]
    return np.array(
        [
            math.sqrt(float(power[np.abs(frequency - k * step_hz) < 0.2].sum() * width))
            for k in HARMONICS
        ]
    )


def read_samples(folder: Path) -> tuple[FloatArray, FloatArray]:
    """Times (n,) of a run's inertial samples and (n, 9): force, rate, field."""
    raw = np.loadtxt(folder / "imu.csv.gz", delimiter=",", skiprows=1)
    return raw[:, 0], raw[:, 2:11]


def recorded_walk(folder: Path) -> GaitStatistics | None:
    """Statistics of a recording's walking part; None where there is less than 8 s of it."""
    time_s, values = read_samples(folder)
    rate_hz = 1.0 / float(np.median(np.diff(time_s)))
    force, rate = values[:, :3], values[:, 3:6]
    norm = np.linalg.norm(force, axis=1)
    # Walking: the norm moves by more than 0.7 m/s2 rms within two seconds.
    kernel = np.ones(round(2 * rate_hz)) / round(2 * rate_hz)
    spread = np.convolve((norm - norm.mean()) ** 2, kernel, "same")
    walking = np.flatnonzero(spread > 0.5)
    if len(walking) < 8 * rate_hz:
        return None
    part = slice(int(walking[0]), int(walking[-1]) + 1)
    return gait_statistics(force[part], rate[part], rate_hz)


def simulated_walks(
    speed_m_s: tuple[float, float], walkers: int, seed: int, seconds: float = 70.0
) -> list[GaitStatistics]:
    """Statistics of walkers on the rectangle at given speeds, sampled at 100 Hz like the data."""
    scenario = replace(
        SCENARIOS["lab"],
        speed_m_s=speed_m_s,
        spacing_m=0.0,
        path_m=(60.0, 30.0),
    )
    team, _ = make_team(scenario, walkers, seconds, seed)
    part = slice(round(8.0 * 200), None)
    return [
        gait_statistics(
            scipy.signal.decimate(w.specific_force_m_s2[part], 2, ftype="fir", axis=0),
            scipy.signal.decimate(w.angular_rate_rad_s[part], 2, ftype="fir", axis=0),
            100.0,
        )
        for w in team
    ]


def apparent_gain(
    force: FloatArray, rate_hz: float, step_hz: float, length_m: float, leg_m: float
) -> tuple[float, float]:
    """Rise of the sensor within a step, in metres, and the pendulum gain it would take.

    The rise is the median over steps of the peak-to-peak height, from the vertical acceleration
    integrated twice between 0.6 and 3.5 times the step frequency; the gain is ``length_m`` over
    the plain pendulum's step for that rise.
    """
    mean = force.mean(axis=0)
    vertical = force @ (mean / np.linalg.norm(mean)) - np.linalg.norm(mean)
    frequency = np.fft.rfftfreq(len(vertical), 1.0 / rate_hz)
    kept = (frequency > 0.6 * step_hz) & (frequency < 3.5 * step_hz)
    spectrum = np.where(
        kept, -np.fft.rfft(vertical) / (2 * np.pi * np.maximum(frequency, 1e-9)) ** 2, 0.0
    )
    edge, step = round(rate_hz), round(rate_hz / step_hz)
    height = np.fft.irfft(spectrum, len(vertical))[edge:-edge]
    steps = height[: len(height) // step * step].reshape(-1, step)
    rise = float(np.median(np.ptp(steps, axis=1)))
    return rise, length_m / (2.0 * math.sqrt(2.0 * leg_m * rise - rise**2))


def events_of(run: Path) -> list[tuple[float, str, str]]:
    """Times, names and values of a run's events."""
    with (run / "events.csv").open(encoding="utf-8") as file:
        return [(float(r["time_s"]), r["event"], r["value"]) for r in csv.DictReader(file)]


def about(run: Path) -> dict[str, float]:
    """What is said of a run."""
    return dict(tomllib.loads((run / "run.toml").read_text(encoding="utf-8")))


def recorded_ways_out(folder: Path) -> tuple[FloatArray, FloatArray]:
    """Of the ways out in walk_lowerback_20m: person (k,) and figures (k, 5).

    Step length, cadence, rise, stature and pendulum gain. The step length is the nominal 20 m over
    the number of foot contacts; runs without stature or with fewer than 8 contacts before the turn
    are left out.
    """
    person, rows = [], []
    for run in sorted(folder.iterdir()):
        known, events = about(run), events_of(run)
        contacts = np.array([t for t, event, _ in events if event == "foot_contact"])
        turn = next((t for t, event, _ in events if event == "uturn_start"), math.inf)
        out = contacts[contacts < turn]
        if "stature_m" not in known or len(out) < 8:
            continue
        time_s, values = read_samples(run)
        force = values[(time_s > out[1]) & (time_s < out[-1]), :3]
        step_hz, length = (len(out) - 2) / (out[-1] - out[1]), 20.0 / len(contacts)
        stature = float(known["stature_m"])
        rise, gain = apparent_gain(force, 100.0, step_hz, length, LEG_OF_STATURE * stature)
        person.append(int(run.name.split("-")[0]))
        rows.append((length, step_hz, rise, stature, gain))
    return np.array(person), np.array(rows)


def recorded_gains(folder: Path) -> FloatArray:
    """Speed, step length, walk ratio, rise and gain (k, 5) of :func:`recorded_ways_out`."""
    length, step_hz, rise, _, gain = recorded_ways_out(folder)[1].T
    return np.column_stack([length * step_hz, length, length / step_hz, rise, gain])


def simulated_gains(speed_m_s: tuple[float, float], walkers: int, seed: int) -> FloatArray:
    """Compute the same (k, 5) for walkers of given speeds, over ten seconds of a straight."""
    scenario = replace(SCENARIOS["lab"], speed_m_s=speed_m_s, spacing_m=0.0, path_m=(60.0, 30.0))
    rows = []
    for walker in make_team(scenario, walkers, 30.0, seed)[0]:
        part = (walker.time_s > 10.0) & (walker.time_s < 20.0)
        steps = (walker.steps.time_s > 10.0) & (walker.steps.time_s < 20.0)
        length = float(walker.steps.length_m[steps].mean())
        step_hz = 1.0 / float(np.diff(walker.steps.time_s[steps]).mean())
        leg = LEG_OF_STATURE * walker.person.stature_m
        rise, gain = apparent_gain(walker.specific_force_m_s2[part], 200.0, step_hz, length, leg)
        rows.append((length * step_hz, length, length / step_hz, rise, gain))
    return np.array(rows)


def _print_gains(title: str, gains: FloatArray) -> None:
    names = ("speed_m_s", "step_length_m", "walk_ratio_m_s", "excursion_m", "pendulum_gain")
    print(f"{title} ({len(gains)} walks)")
    for name, mean, sd in zip(names, gains.mean(axis=0), gains.std(axis=0), strict=True):
        print(f"  {name:22s} {mean:6.3f} +- {sd:.3f}")


def print_statistics(title: str, walks: list[GaitStatistics]) -> None:
    """Print means over walks, with the range of the sizes."""

    def mean(name: str) -> FloatArray:
        return np.asarray(np.mean([getattr(w, name) for w in walks], axis=0))

    def row(values: FloatArray) -> str:
        return " ".join(f"{v:5.2f}" for v in values)

    scalar = (
        "step_frequency_hz",
        "vertical_rms_m_s2",
        "vertical_peak_m_s2",
        "horizontal_rms_m_s2",
        "step_similarity",
        "stride_similarity",
        "above_15_hz",
    )
    print(f"{title} ({len(walks)} walks)")
    for name in scalar:
        values = [getattr(w, name) for w in walks]
        print(f"  {name:22s} {np.mean(values):5.2f}  from {min(values):.2f} to {max(values):.2f}")
    print(f"  {'harmonic':22s} " + row(np.array(HARMONICS)))
    for name in ("vertical", "fore_aft", "lateral", "yaw_rate", "pitch_rate", "roll_rate"):
        print(f"  {name:22s} " + row(mean(name)))


def main() -> int:
    """Print simulated and recorded walks side by side."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=DATA)
    folder: Path = parser.parse_args().data
    if not folder.is_dir():
        print("no recordings: give their folder, or set RELPOS_DATA", file=sys.stderr)
        return 1
    for name, groups in (("walk_chest", ((1.4, 1.68), (1.68, 1.9))), ("walk_lowerback_20m", ())):
        walks = [w for f in sorted((folder / name).iterdir()) if (w := recorded_walk(f))]
        for low, high in groups or ((0.8, 2.6),):
            some = [w for w in walks if low <= w.step_frequency_hz < high]
            print_statistics(f"recorded {name}, {low} to {high} steps/s", some)
    for speeds in ((0.88, 0.95), (1.07, 1.15), (0.5, 0.6)):
        print_statistics(
            f"simulated, {speeds[0]} to {speeds[1]} m/s", simulated_walks(speeds, 20, 3)
        )
    gains = recorded_gains(folder / "walk_lowerback_20m")
    _print_gains("recorded walk_lowerback_20m, under 1 m/s", gains[gains[:, 0] < 1.0])
    _print_gains("recorded walk_lowerback_20m, from 1 m/s", gains[gains[:, 0] >= 1.0])
    for speeds in ((0.5, 0.6), (0.85, 1.0), (1.0, 1.3)):
        _print_gains(f"simulated, {speeds[0]} to {speeds[1]} m/s", simulated_gains(speeds, 20, 3))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
