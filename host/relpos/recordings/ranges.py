"""Tables of range errors: outdoors in sight and behind objects, and through a university's walls.

github.com/cucudasluv/UWB-dataset: one file a distance on the ground and height of the anchor; the
tag stands 1 m over ground. github.com/JaronFontaine/UWB-dataset-...: ranges of Stocker et al. 2021
with the true ones.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import PurePosixPath

from relpos.recordings.tables import Archive, ConvertedRun, number

TAG_M = 1.0
READINGS = 40
"""Of some hundreds of each place, taken within minutes: the first ones."""


def outdoor(archive: Archive) -> Iterator[ConvertedRun]:
    """One table: condition, height of the anchor, true and measured distance, signal strengths."""
    lines = ["condition,anchor_height_m,true_m,range_m,rss_dbm,rss_first_path_dbm"]
    for name in archive.below("Static_measurements/", ".csv"):
        condition, height, file = PurePosixPath(name).parts[1:]
        height_m = float(height.removeprefix("height_").removesuffix("cm")) / 100.0
        true_m = math.hypot(float(file.removesuffix("m.csv")), height_m - TAG_M)
        rows = csv.DictReader(archive.read(name).splitlines())
        read = [
            row for row in rows if (row["Distance"] or "").strip()
        ]  # not the means below the readings
        for row in read[:READINGS]:
            values = (row["Distance"], row["RSSI(dBm)"], row["RSSI_fp(dBm)"])
            cells = (height_m, true_m, *map(float, values))
            lines.append(f"{condition.lower()}," + ",".join(number(v, 5) for v in cells))
    yield ConvertedRun(".", "github.com/cucudasluv/UWB-dataset\n", others={"errors.csv": lines})


def university(archive: Archive) -> Iterator[ConvertedRun]:
    """One table: condition, rooms, true and measured distance, signal strengths, bias of device."""
    lines = ["condition,place,true_m,range_m,rss_dbm,rss_first_path_dbm,device_bias_m"]
    names = ("real_rng", "rng", "rssi", "fp_power", "bias")
    for row in csv.DictReader(archive.read("meta_University.csv").splitlines()):
        cells = (number(float(row[name]), 5) for name in names)
        lines.append(f"{row['condition']},{row['env']}," + ",".join(cells))
    yield ConvertedRun(".", "github.com/JaronFontaine/UWB-dataset\n", others={"errors.csv": lines})
