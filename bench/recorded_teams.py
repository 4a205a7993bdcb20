"""Teams of real walkers: the standard set that docs/results.md quotes.

    python bench/recorded_teams.py [--seconds 1200] [--seed 0] [--seeds 1] [--only TEXT] [--known]

Six wearers each, in sight and in an office with walls: people on the lower back, with three people
after a stroke, and with phones in the hand. For each: aligned RMSE, distance NEES and dead
reckoning's aligned RMSE from a known start; the smoother's RMSE and NEES; and when an unknown start
is resolved (aligned error under 1 m for 10 s; within 150 s). ``--known`` leaves the smoother and
the unknown start out.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np

import relpos
from relpos.emulator.recorded_team import record_team
from relpos.evaluation.metrics import Metrics
from relpos.runs import Run
from shared_data import DATA

# Sets, and who: only people whose recordings lost no samples. Nobody says who carried a phone, so a
# wearer is one recording, again and again: the six longest.
TEAMS = {
    "lower back": [f"walk_lowerback_20m/{person}-*" for person in (10, 11, 13, 14, 16, 19)],
    "with stroke": [
        *(f"walk_lowerback_20m/{person}-*" for person in (11, 13, 19)),
        *(f"walk_treadmill_stroke_lumbar/pp{person}*" for person in ("04", "08", "10")),
    ],
    "phones": [f"walk_handheld_waypoints/0{walk}" for walk in (34, 85, 25, 54, 61, 46)],
}
RESOLVED_M, HELD_S, WITHIN_S = 1.0, 10, 150.0


def metrics_of(run: Run, result: relpos.Result) -> Metrics:
    """The figures of a result."""
    return relpos.evaluate(result, run, bound=False).metrics


def resolved_s(run: Run) -> float:
    """When an unknown start is found; nan where it is not."""
    begun = replace(
        run,
        measurements=tuple(m for m in run.measurements if m.time_s < WITHIN_S),
        truth=tuple(t for t in run.truth if t.time_s < WITHIN_S),
    )
    found = metrics_of(begun, relpos.fuse(begun, initial="unknown"))
    good = found.position_rmse_over_time_m < RESOLVED_M
    held = np.convolve(good, np.ones(HELD_S), "valid") == HELD_S
    return float(found.time_s[int(np.argmax(held))]) if held.any() else math.nan


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=1, help="so many, from --seed on")
    parser.add_argument("--only", default="", help="teams whose name has this text")
    parser.add_argument("--known", action="store_true", help="nothing but the known start")
    options = parser.parse_args()
    print(
        "|team|seed|aligned|NEES|dead reckoning|smoothed|NEES|resolved|\n"
        "|---|---|---|---|---|---|---|---|"
    )
    rows = [
        (name, place, walls, seed)
        for name in TEAMS
        for place, walls in (("in sight", 0), ("office", 1))
        for seed in range(options.seed, options.seed + options.seeds)
        if options.only in f"{name}, {place}"
    ]
    for name, place, walls, seed in rows:
        settings = {"seconds": options.seconds, "walls": walls}
        run = record_team([str(DATA / who) for who in TEAMS[name]], seed, settings)
        known = metrics_of(run, relpos.fuse(run))
        alone = metrics_of(run, relpos.fuse(run, "deadreckoning"))
        cells = [f"{name}, {place}", str(seed), f"{known.relative_position_rmse_m:.2f}"]
        cells += [f"{known.nees_distance:.2f}", f"{alone.relative_position_rmse_m:.2f}"]
        if not options.known:
            smooth = metrics_of(run, relpos.fuse(run, smooth=True))
            cells += [f"{smooth.relative_position_rmse_m:.2f}", f"{smooth.nees_distance:.2f}"]
            cells += [f"{resolved_s(run):.0f} s"]
        print("|" + "|".join(cells) + "|", flush=True)


if __name__ == "__main__":
    main()
