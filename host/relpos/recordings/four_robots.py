"""github.com/TIERS/uwb-cooperative-mrs-localization: four robots, six UWB links, OptiTrack.

Ranges and truth are the source's, at 7 Hz. It has no odometry for this run, so motion is the truth
with noise, drawn here (the published recording has another draw of the same size).
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterator

import numpy as np

from relpos.recordings.tables import (
    MOTION_COLUMNS,
    RANGE_COLUMNS,
    TRUTH_COLUMNS,
    Archive,
    ConvertedRun,
    described,
    number,
)

FILE = "script/data_fit/data/4robots_data_01.npz"
ROBOTS = (1, 3, 4, 5)
RATE_HZ, TRUTH_EVERY = 7, 4
NOISE_M, NOISE_RAD, SHARE = 0.01, np.radians(0.5), 0.05
"""A second's motion errs by this, and along the way and in heading by a share of it."""


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """The one run."""
    rng = np.random.default_rng(0)
    source = np.load(io.BytesIO(archive.read_bytes(FILE)))
    places, headings = (
        {n: source[f"optitrack_turtle{n:02d}_{what}_np"] for n in ROBOTS}
        for what in ("pose", "orientation")
    )
    headings = {n: np.unwrap(turning) for n, turning in headings.items()}
    count = len(headings[1])
    truth = [
        f"{k / RATE_HZ:.4f},{n}," + ",".join(map(number, (*places[n][k], headings[n][k])))
        for k in range(0, count, TRUTH_EVERY)
        for n in ROBOTS
    ]
    motion, ranges = [], []
    for k in range(0, count, RATE_HZ):
        ranges += [
            f"{k / RATE_HZ:.4f},{a},{b},{number(source[f'uwb_range_{b}_{a}_np'][k])}"
            for a, b in itertools.combinations(ROBOTS, 2)
        ]
        for n in ROBOTS if k else ():
            before = k - RATE_HZ
            way = complex(*(places[n][k] - places[n][before])) * np.exp(-1j * headings[n][before])
            turn = headings[n][k] - headings[n][before]
            told = (
                way.real + np.hypot(NOISE_M, SHARE * abs(way)) * rng.standard_normal(),
                way.imag + NOISE_M * rng.standard_normal(),
                turn + np.hypot(NOISE_RAD, SHARE * turn) * rng.standard_normal(),
            )
            motion.append(f"{k / RATE_HZ:.4f},{n}," + ",".join(map(number, told)))
    yield ConvertedRun(
        "run1",
        described(
            "four_robots_uwb/run1",
            "github.com/TIERS/uwb-cooperative-mrs-localization (MIT): real UWB ranges "
            "(uncalibrated antenna delay), OptiTrack truth; motion is synthesised from the truth "
            "with noise",
            "heading_known = true",
            'initial_pose = "from truth"',
        ),
        others={
            "truth.csv": [TRUTH_COLUMNS, *truth],
            "motion.csv": [MOTION_COLUMNS, *motion],
            "ranges.csv": [RANGE_COLUMNS, *ranges],
        },
    )
