"""github.com/location-competition/indoor-location-competition-20: phones in the hand, site1/F1.

Samples are in milliseconds of the phone's clock; waypoints are where the walker pressed a button at
a surveyed point. The time begins with the first accelerometer sample.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import PurePosixPath

import numpy as np

from relpos.recordings.tables import Archive, ConvertedRun, described, imu_lines

FOLDER = "data/site1/F1/path_data_files/"
KINDS = ("TYPE_ACCELEROMETER", "TYPE_GYROSCOPE", "TYPE_MAGNETIC_FIELD")


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """Every path of the floor with two waypoints or more."""
    for path in archive.below(FOLDER):
        run = _run(PurePosixPath(path).stem, archive.read(path))
        if run is not None:
            yield run


def _run(name: str, text: str) -> ConvertedRun | None:
    rows: dict[str, list[list[float]]] = {kind: [] for kind in (*KINDS, "TYPE_WAYPOINT")}
    for line in text.splitlines():
        cells = line.split("\t")
        if len(cells) < 4 or cells[1] not in rows:
            continue
        width = 2 if cells[1] == "TYPE_WAYPOINT" else 3
        rows[cells[1]].append([float(cells[0]) / 1e3, *map(float, cells[2 : 2 + width])])
    if len(rows["TYPE_WAYPOINT"]) < 2 or min(len(rows[kind]) for kind in KINDS) < 2:
        return None
    tables = [np.array(rows[kind]) for kind in KINDS]
    zero_s = tables[0][0, 0]
    times_s = tables[0][:, 0]
    columns = [
        np.interp(times_s, table[:, 0], column) for table in tables for column in table[:, 1:].T
    ]
    imu = imu_lines(times_s - zero_s, np.column_stack(columns), 6)
    truth = [f"{t - zero_s:.4f},1,{x:.6g},{y:.6g}," for t, x, y in rows["TYPE_WAYPOINT"]]
    description = described(
        f"walk_handheld_waypoints/{name}",
        f"github.com/location-competition/indoor-location-competition-20 (MIT), {name}",
        'mount = "phone held flat at the chest, Android axes: x right, y forward, z up"',
    )
    return ConvertedRun(name, description, imu, truth=truth)
