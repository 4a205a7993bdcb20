"""github.com/eternalamit5/An-improved-wearable-...: an Xsens DOT on the chest, 100 Hz.

Its logs count time in 100 us; the field is in units of the Earth's, taken as 45 uT.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from relpos.errors import DataError
from relpos.recordings.tables import Archive, ConvertedRun, described, imu_lines

FOLDERS = {"Data/": "Data", "Robust Adaptive Kalman Filter Algorithm/RawData/": "L"}
COLUMNS = "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z,Mag_X,Mag_Y,Mag_Z"
EARTH_UT = 45.0
FEWEST = 1000
"""Samples; one log of three seconds holds nothing."""


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """Every raw log, named by its path."""
    for folder, prefix in FOLDERS.items():
        for path in archive.below(folder, ".txt"):
            head, *lines = archive.read(path).splitlines()
            if not head.startswith(COLUMNS):
                raise DataError(f"walk_chest: {path} has other columns: the source has changed")
            if len(lines) < FEWEST:
                continue
            rows = np.array([line.split(",")[1:11] for line in lines], np.float32)
            name = f"{prefix}__{path[len(folder) : -4]}".replace("/", "__").replace(" ", "_")
            description = described(
                f"walk_chest/{name}",
                "github.com/eternalamit5/An-improved-wearable-multi-sensor-fusion-"
                "Pedestrian-Dead-Reckoning-system-for-indoor-localisation (MIT)",
                'mount = "chest, x up"',
            )
            samples = np.hstack([rows[:, 1:7], rows[:, 7:] * np.float32(EARTH_UT)])
            yield ConvertedRun(
                name, description, imu_lines((rows[:, 0] - rows[0, 0]) / 1e4, samples, 6)
            )
