"""What episodes of heights take from the way that dead reckoning claims on recorded stairs.

Run as ``.venv/bin/python bench/inertial/stairs.py``. Each person of ``stairs_mocap_virtual`` climbs
a block of steps (.75 m up and over) ten times, through the firmware; heights are the true ones,
late and with the noise of a tag's.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import replay

from relpos.emulator.deadreckoning import WearerSettings, leg_length_m, play
from relpos.emulator.recorded_team import one_mission, runs_of
from relpos.fusion.vertical.offline import as_climbed
from relpos.fusion.vertical.track import HEIGHT_LATE_S
from relpos.measurements import Height, Measurement, Motion

NOISE_M = 0.06
TIMES = 2  # each recording
PAUSE_S = 2.0  # between recordings


def way_m(measurements: Sequence[Measurement]) -> float:
    """Sum of the reported displacements."""
    return sum(math.hypot(m.dx_m, m.dy_m) for m in measurements if isinstance(m, Motion))


def errors(data: Path, person: str, rng: np.random.Generator) -> tuple[float, float]:
    """Relative errors of the way, as the node reports it and with episodes."""
    folders = sorted(data.glob(f"{person}Treppe*"))
    runs = [run for folder in folders for run in runs_of(str(folder))]
    recordings = [next(iter(run.load_imu().values())) for run in runs]
    lasts_s = sum(float(np.ptp(r.time_s)) + PAUSE_S for r in recordings)
    mission, placed = one_mission(recordings, TIMES * lasts_s - PAUSE_S)
    motions = play(1, mission, WearerSettings(leg_length_m(runs[0], 1))).motions
    knots, true_m = [], 0.0
    for k, shift_s in placed:
        truth = np.loadtxt(folders[k] / "truth.csv", delimiter=",", skiprows=1)[:, [0, 5]]
        knots.append(truth + np.array([shift_s, -truth[0, 1]]))
        true_m += runs[k].description.true_distance_m or math.nan
    time_s, z_m = np.concatenate(knots).T
    heights = [
        Height(m.time_s, 1, float(np.interp(m.time_s - HEIGHT_LATE_S, time_s, z_m)) + noise_m)
        for m, noise_m in zip(motions, NOISE_M * rng.standard_normal(len(motions)), strict=True)
    ]
    reported = [*motions, *heights]
    return way_m(reported) / true_m - 1.0, way_m(as_climbed(reported, [1])) / true_m - 1.0


def main() -> None:
    """Print a line a person and the mean."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    data, rng = replay.DATA / "stairs_mocap_virtual", np.random.default_rng(0)
    people = sorted({folder.name.partition("Treppe")[0] for folder in data.iterdir()})
    found = 100.0 * np.array([errors(data, person, rng) for person in people])
    for name, (alone, climbed) in zip([*people, "mean"], [*found, found.mean(axis=0)], strict=True):
        print(f"{name:5} dead reckoning {alone:+.1f} %, with episodes {climbed:+.1f} %")


if __name__ == "__main__":
    main()
