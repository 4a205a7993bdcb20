"""github.com/Archeries/StrideLengthEstimation: a phone before the chest, every stride of a foot.

One line a sample: flag, acceleration, angular rate, magnetic field, milliseconds, and the stride's
length, number and the way so far of the foot-mounted reference, which change when a stride ends.
The ten walks are those of 24 and 25 October 2018.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from relpos.recordings.tables import Archive, Array, ConvertedRun, described, imu_lines

FOLDER = "Benchmark-Dataset-for-Adaptive-Stride-Length-Estimation/PDR_Raw_2018-"
WALKS = (
    "10-24-07-37-35",
    "10-25-11-33-56",
    "10-25-11-34-35",
    "10-25-11-35-12",
    "10-25-11-37-09",
    "10-25-11-37-52",
    "10-25-11-38-58",
    "10-25-11-39-50",
    "10-25-11-40-45",
    "10-25-11-41-50",
)
LONGEST_S = 240.0
"""The first walk goes on; four minutes are enough."""
SOURCE = "github.com/Archeries/StrideLengthEstimation (no licence stated): Huawei Mate 9"


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """The walks, in the order of their time."""
    for walk in WALKS:
        rows = [line.split() for line in archive.read(f"{FOLDER}{walk}.txt").splitlines()]
        yield _run(f"w{walk.replace('-', '')}", np.array([row[1:] for row in rows], np.float64))


def _run(name: str, rows: Array) -> ConvertedRun:
    times_s = (rows[:, 9] - rows[0, 9]) / 1e3
    rows, times_s = rows[times_s <= LONGEST_S], times_s[times_s <= LONGEST_S]
    length_m, count, way_m = rows[:, 10], rows[:, 11], rows[:, 12]
    total_m = way_m[-1] - way_m[0]
    events = [f"{times_s[0]:.4f},1,bout_start,{total_m:.3f}"]
    for k in np.flatnonzero(np.diff(count) > 0) + 1:
        events.append(f"{times_s[k]:.4f},1,stride_length_right_m,{length_m[k]:.3f}")
        events.append(f"{times_s[k]:.4f},1,right_stride_end,{count[k]:.0f}")
    events.append(f"{times_s[-1]:.4f},1,bout_end,")
    description = described(
        f"walk_phone_strides/{name}",
        f"{SOURCE}, foot-mounted x-IMU reference",
        'mount = "phone held flat before the chest, Android axes: x right, y forward, z up"',
        f"true_distance_m = {total_m:.2f}",
    )
    return ConvertedRun(name, description, imu_lines(times_s, rows[:, :9]), events)
