"""github.com/Hossein-Shoushtari/IPIN21Data: phone before the chest, over three floors.

Two walks at 100 Hz, all sensors on one clock (Unix time in ms), and points of the plan with their
heights (Shoushtari et al., IPIN 2021, ieeexplore.ieee.org/document/9662636).
"""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np

from relpos.errors import DataError
from relpos.recordings.tables import (
    PA_OF_MBAR,
    TRUTH_COLUMNS,
    Archive,
    Array,
    ConvertedRun,
    described,
    imu_lines,
)

WALKS = {"eight": "EightExperiment", "zero2four": "Zero2fourExperiment"}


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """Both walks; points are metres from the first one."""
    for name, folder in WALKS.items():
        acc, gyr, mag, bar, points = (
            _table(archive, f"SensorLog/{folder}/{kind}.csv")
            for kind in ("acc", "gyr", "mag", "bar", "ref")
        )
        if not len(acc) == len(gyr) == len(mag) == len(bar):
            raise DataError(f"{folder}: sensors of different lengths: the source has changed")
        begin_ms = acc[0, 0]
        samples = np.hstack([acc[:, 1:], gyr[:, 1:], mag[:, 1:], bar[:, 1:] * PA_OF_MBAR])
        truth = [f"{TRUTH_COLUMNS},z_m"]
        for time_ms, *place_m in points:
            x, y, z = np.array(place_m) - points[0, 1:]
            truth.append(f"{(time_ms - begin_ms) / 1e3:.3f},1,{x:.1f},{y:.1f},,{z:.1f}")
        yield ConvertedRun(
            name,
            described(
                f"height_phone_hamburg/{name}",
                "github.com/Hossein-Shoushtari/IPIN21Data (no licence stated)",
                'mount = "phone before the chest, screen up"',
            ),
            imu_lines((acc[:, 0] - begin_ms) / 1e3, samples),
            others={"truth.csv": truth},
        )


def _table(archive: Archive, name: str) -> Array:
    table: Array = np.loadtxt(io.StringIO(archive.read(name)), ndmin=2)
    return table
