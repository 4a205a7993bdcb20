"""Dead reckoning on the real walks: what docs/deadreckoning.md quotes.

Run as ``.venv/bin/python bench/inertial/evaluate.py [--gain K] [--people fit|report|all]``.
No constant was fitted to these walks. The groups "fit" (odd numbers) and "report" (even) are for
fitting that is still to come; all 74 walks were printed during development, so that the even
people are no untouched test set.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np
import replay


def lowerback(gain: float, people: str, verbose: bool) -> None:
    """Print distance, steps and turn of walk_lowerback_20m."""
    errors: list[float] = []
    turns: list[float] = []
    nees: list[float] = []
    contacts = found = extra = 0
    by_person: dict[str, list[float]] = defaultdict(list)
    for folder in sorted((replay.data_folder() / "walk_lowerback_20m").iterdir()):
        person = folder.name.split("-")[0]
        if people != "all" and (int(person) % 2 == 1) != (people == "fit"):
            continue
        recording = replay.load(folder)
        result = replay.reckon(recording.imu, leg_length_m=recording.leg_length_m, step_gain=gain)
        score = replay.score_steps(recording, recording.time_s[result.step_ticks])
        contacts += score.contacts
        found += score.found
        extra += score.extra
        error = result.distance_m / 20.0 - 1.0
        begin = min((t for t, name, _ in recording.events if name == "trial_start"), default=0.0)
        end = max((t for t, name, _ in recording.events if name == "trial_end"), default=np.inf)
        inside = (recording.time_s >= begin) & (recording.time_s <= end)
        heading = np.unwrap(result.rows["heading_rad"])[inside]
        turn = abs(np.degrees(heading[-1] - heading[0])) - 180.0
        errors.append(error)
        turns.append(turn)
        by_person[person].append(error)
        nees.append((20.0 * error) ** 2 / result.rows["variance_along_m2"][-1])
        if verbose:
            forward = np.degrees(result.rows["forward_rad"][-1])
            print(
                f"  {folder.name:6} {100 * error:+6.1f} % turn {turn:+6.1f} deg steps "
                f"{score.found}/{score.contacts} +{score.extra} forward {forward:+5.0f} "
                f"y {result.rows['y_m'][-1]:+5.2f} x {result.rows['x_m'][-1]:+5.2f} "
                f"{result.counters['doubtful_steps']} doubtful"
            )
    e, a = np.array(errors), np.abs(errors)
    gains = np.concatenate([np.array(v) - np.mean(v) for v in by_person.values()])
    print(
        f"walk_lowerback_20m ({people}, {len(e)} walks, gain {gain}): distance "
        f"{100 * e.mean():+.1f} +- {100 * e.std():.1f} %, mean abs {100 * a.mean():.1f}, median "
        f"{100 * np.median(a):.1f}, worst {100 * a.max():.1f}; within a person sd "
        f"{100 * gains.std():.1f} %; steps {found}/{contacts} ({100 * found / contacts:.1f} %), "
        f"extra {extra} ({100 * extra / contacts:.1f} %); turn inside the trial "
        f"{np.median(np.abs(turns)):.1f} median abs, worst {np.abs(turns).max():.1f} deg; "
        f"NEES along {np.mean(nees):.2f}"
    )


def chest(gain: float) -> None:
    """Print distance and steps of every walk_chest recording."""
    for folder in sorted((replay.data_folder() / "walk_chest").iterdir()):
        recording = replay.load(folder)
        for field in (None, recording.field_ut):
            result = replay.reckon(recording.imu, field, leg_length_m=0.93, step_gain=gain)
            last = result.rows[-1]
            print(
                f"  {folder.name[:46]:46} {'mag' if field is not None else '   '} "
                f"{result.distance_m:7.2f} m {last['steps']:4d} steps turn "
                f"{np.degrees(result.turn_rad):+7.1f} deg end ({last['x_m']:+7.2f},"
                f"{last['y_m']:+7.2f}) sd heading "
                f"{np.degrees(np.sqrt(last['variance_heading_rad2'])):.1f} deg bias z "
                f"{np.degrees(np.linalg.norm(result.bias_rad_s)):.2f} deg/s "
                f"{result.counters['rejected_magnetic']} mag rejected"
            )


def daily(gain: float) -> None:
    """Print distance inside and outside the bouts of walk_daily_lowerback."""
    for folder in sorted((replay.data_folder() / "walk_daily_lowerback").iterdir()):
        recording = replay.load(folder)
        result = replay.reckon(recording.imu, leg_length_m=recording.leg_length_m, step_gain=gain)
        path = result.rows["path_m"]
        total = inside = 0.0
        starts = [(t, float(v)) for t, name, v in recording.events if name == "bout_start"]
        ends = [t for t, name, _ in recording.events if name == "bout_end"]
        parts = []
        for (begin, length), end in zip(starts, ends, strict=True):
            claimed = float(
                np.interp(end, recording.time_s, path) - np.interp(begin, recording.time_s, path)
            )
            total += length
            inside += claimed
            parts.append(f"{claimed:.1f}/{length:.1f}")
        print(
            f"  {folder.name:22} bouts {inside:6.2f} of {total:6.2f} m "
            f"({100 * (inside / total - 1):+.0f} %), outside {path[-1] - inside:5.1f} m, "
            f"steps {result.rows['steps'][-1]}: {' '.join(parts)}"
        )


def main() -> None:
    """Evaluate all three sets."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--gain", type=float, default=1.25)
    parser.add_argument("--people", choices=["fit", "report", "all"], default="all")
    parser.add_argument("--only")
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    if options.only in (None, "lowerback"):
        lowerback(options.gain, options.people, options.verbose)
    if options.only in (None, "chest"):
        chest(options.gain)
    if options.only in (None, "daily"):
        daily(options.gain)


if __name__ == "__main__":
    main()
