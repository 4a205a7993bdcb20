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

from relpos.errors import DataError
from relpos.recordings.tables import Archive, ConvertedRun, number

RATE_HZ = 100.0
FIELD_UT = 45.0
HEADER_LINES = 2


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """Every trial with its lower-back file."""
    trials = [n for n in archive.names if n.startswith("GaitData/") and n.endswith(".json")]
    if not trials:
        raise DataError("walk_lowerback_20m: no GaitData/*.json: the source has changed")
    for trial in trials:
        meta = json.loads(archive.read(trial))
        name = PurePosixPath(trial).stem
        rows = archive.read(f"GaitData/{name}_lb.txt").splitlines()[HEADER_LINES:]
        imu = []
        for k, row in enumerate(rows):
            values = [float(v) for v in row.split("\t")[1:10]]
            if len(values) != 9:
                raise DataError(f"GaitData/{name}_lb.txt, row {k + 1}: the source has changed")
            cells = [*values[:6], *(FIELD_UT * v for v in values[6:])]
            imu.append(f"{k / RATE_HZ:.4f},1," + ",".join(map(number, cells)))
        yield ConvertedRun(name, _description(name, meta), imu, _events(meta))


def _events(meta: Mapping[str, Any]) -> list[str]:
    """Marks and the contacts inside the trial."""
    begin, end = meta["TrialBoundaries"]
    marks = [(begin, "trial_start", ""), (end, "trial_end", "")]
    turn = meta["UTurnBoundaries"]
    marks += [(turn[0], "uturn_start", ""), (turn[1], "uturn_end", "")]
    for foot in ("Left", "Right"):
        for _, contact in meta[f"{foot}FootEvents"]:
            if begin <= contact <= end:
                marks.append((contact, "foot_contact", foot.lower()))
    return [f"{t / RATE_HZ:.4f},1,{name},{value}" for t, name, value in sorted(marks)]


def _description(name: str, meta: Mapping[str, Any]) -> str:
    lines = [f'name = "walk_lowerback_20m/{name}"']
    lines.append('source = "github.com/CyrilVoisard/ipol_dataset_1 (AGPL-3.0)"')
    lines.append('mount = "lower back, x up"')
    height = meta.get("Height")
    if isinstance(height, int | float) and height > 0:
        lines.append(f"stature_m = {height / 100.0:.2f}")
    lines += ["true_distance_m = 20.0", "true_turn_deg = 180.0"]
    return "\n".join(lines) + "\n"
