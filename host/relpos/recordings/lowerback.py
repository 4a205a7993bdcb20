"""github.com/CyrilVoisard/ipol_dataset_1: lower back, 10 m, U-turn, 10 m back, at 100 Hz.

Voisard et al., "A Dataset of Healthy Gait Recordings with IMUs", Image Processing On Line. Marks
are sample numbers; a foot's events are pairs of toe-off and contact. The field comes in the
sensor's own unit, about 45 uT.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from relpos.errors import DataError
from relpos.recordings.tables import Archive, ConvertedRun, described, event_lines, imu_lines

RATE_HZ = 100.0
FIELD_UT = 45.0
HEADER_LINES = 2


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """Every trial with its lower-back file."""
    for trial in archive.below("GaitData/", ".json"):
        meta = json.loads(archive.read(trial))
        name = PurePosixPath(trial).stem
        rows = archive.read(f"GaitData/{name}_lb.txt").splitlines()[HEADER_LINES:]
        values = np.array([row.split("\t")[1:10] for row in rows], np.float64)
        if values.shape[1:] != (9,):
            raise DataError(f"GaitData/{name}_lb.txt: other columns: the source has changed")
        samples = values * np.repeat([1.0, 1.0, FIELD_UT], 3)
        imu = imu_lines(np.arange(len(samples)) / RATE_HZ, samples, 6)
        yield ConvertedRun(name, _description(name, meta), imu, _events(meta))


def _events(meta: Mapping[str, Any]) -> list[str]:
    """Marks and the contacts inside the trial."""
    begin, end = meta["TrialBoundaries"]
    turn = meta["UTurnBoundaries"]
    marks = [
        (begin, "trial_start", ""), (end, "trial_end", ""),
        (turn[0], "uturn_start", ""), (turn[1], "uturn_end", ""),
    ]  # fmt: skip
    for foot in ("Left", "Right"):
        for _, contact in meta[f"{foot}FootEvents"]:
            if begin <= contact <= end:
                marks.append((contact, "foot_contact", foot.lower()))
    return event_lines((sample / RATE_HZ, name, value) for sample, name, value in marks)


def _description(name: str, meta: Mapping[str, Any]) -> str:
    height = meta.get("Height")
    stature = []
    if isinstance(height, int | float) and height > 0:
        stature = [f"stature_m = {height / 100.0:.2f}"]
    return described(
        f"walk_lowerback_20m/{name}",
        "github.com/CyrilVoisard/ipol_dataset_1 (AGPL-3.0)",
        'mount = "lower back, x up"',
        *stature,
        "true_distance_m = 20.0",
        "true_turn_deg = 180.0",
    )
