"""github.com/Kenny5269/2023_IPIN_Competition_Track03: phone in the hand (zenodo 8362205).

Logs of the app GetSensorData: lines of kind, the app's seconds, the sensor's seconds and values;
POSI where the walker pressed a button at a surveyed point. Sensors come each at its own times: rows
are the accelerometer's, from a second before the first point to a second behind the last; the other
sensors are interpolated. Points are metres east and north of the first one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from relpos.errors import DataError
from relpos.recordings.tables import (
    PA_OF_MBAR,
    Archive,
    Array,
    ConvertedRun,
    described,
    event_lines,
    imu_lines,
)

FOLDER = "01 Logfiles/01 IPIN2023_T3_TrainingTrials (training)/IPIN2023_T3_TrainingTrial"
WALKS = ("01", "02", "03", "05", "21", "23", "24", "26")
TRIALS = (
    *(f"{walk}_{repetition}" for walk in WALKS for repetition in ("01", "04")),
    "51_02",
)
FLOOR_TRIALS = (
    *(f"{walk:02d}_{k:02d}" for walk in (*range(1, 6), *range(21, 28)) for k in range(1, 5)),
    "51_02",
    "52_01",
)
"""All on one floor, but the last two."""
VALUES = {"PRES": 4}
"""End of a line's values, where it is not 6."""
MARGIN_S = 1.0
LONGEST_S = 152.0
EQUATOR_M, FLATTENING = 6378137.0, 1.0 / 298.257223563
"""WGS84."""


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """The first and the last repetition of eight training walks, and one over the stairs."""
    for trial in TRIALS:
        yield _run("walk_phone_museum", trial, archive, ("GYRO", "MAGN"), LONGEST_S)


def heights(archive: Archive) -> Iterator[ConvertedRun]:
    """Training walks whole, with pressure, and as events the floors of the points."""
    for trial in FLOOR_TRIALS:
        yield _run("height_phone_museum", trial, archive, ("GYRO", "MAGN", "PRES"), math.inf)


def _run(
    folder: str, trial: str, archive: Archive, kinds: tuple[str, ...], longest_s: float
) -> ConvertedRun:
    walk, repetition = trial.split("_")
    name = f"T{walk}_R{repetition}"
    text = archive.read(f"{FOLDER}{walk}_repetition{repetition}.txt")
    lines = [line.split(";") for line in text.splitlines()]
    tables = {
        kind: np.array(
            [row[1 : VALUES.get(kind, 6)] for row in lines if row[0] == kind], np.float64
        )
        for kind in ("ACCE", "POSI", *kinds)
    }
    if not all(map(len, tables.values())):
        raise DataError(f"{name}: no sensors or points: the source has changed")
    acceleration, points = tables["ACCE"], tables["POSI"]
    points_s = points[:, 0] + np.median(acceleration[:, 1] - acceleration[:, 0])
    begin_s = points_s[0] - MARGIN_S
    end_s = min(begin_s + longest_s, points_s[-1] + MARGIN_S)
    points, points_s = points[points_s <= end_s], points_s[points_s <= end_s]
    sensor_s = acceleration[:, 1]
    rows = acceleration[(sensor_s >= begin_s) & (sensor_s <= end_s)]
    columns = [rows[:, 2:5]]
    for kind in kinds:
        table = tables[kind]
        values = table[:, 2:3] * PA_OF_MBAR if kind == "PRES" else table[:, 2:5]
        columns += [np.interp(rows[:, 1], table[:, 1], v)[:, None] for v in values.T]
    times_s = points_s - rows[0, 1]
    truth = [
        f"{time:.4f},1,{x:.5g},{y:.5g},"
        for time, (x, y) in zip(times_s, _plane(points[:, 2:4]), strict=True)
    ]
    floors = [(t, "floor", f"{f:.0f}") for t, f in zip(times_s, points[:, 4], strict=True)]
    description = described(
        f"{folder}/{name}",
        "IPIN 2023 track 3 (zenodo 8362205)",
        'mount = "phone in the hand, screen up"',
    )
    imu = imu_lines(rows[:, 1] - rows[0, 1], np.hstack(columns))
    events = event_lines(floors) if "PRES" in kinds else ()
    return ConvertedRun(name, description, imu, events=events, truth=truth)


def _plane(degrees: Array) -> Array:
    """Metres east and north of the first of (n, 2) latitudes and longitudes."""
    eccentricity2 = FLATTENING * (2.0 - FLATTENING)
    latitude = math.radians(degrees[0, 0])
    w = 1.0 - eccentricity2 * math.sin(latitude) ** 2
    across_m = EQUATOR_M / math.sqrt(w)
    north, east = np.radians(degrees - degrees[0]).T
    along_m = across_m * (1.0 - eccentricity2) / w
    return np.column_stack([across_m * math.cos(latitude) * east, along_m * north])
