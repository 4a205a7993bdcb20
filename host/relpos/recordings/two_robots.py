"""github.com/y2d2/UPF_RPE: two robots with visual-inertial odometry, one UWB link and Vicon.

The source pickles its own objects, sampled at 10 Hz. Only arrays are read from them: a pickle can
run any code, so every other class is an empty one here.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np

from relpos.errors import DataError
from relpos.recordings.tables import (
    MOTION_COLUMNS,
    RANGE_COLUMNS,
    TRUTH_COLUMNS,
    Archive,
    Array,
    ConvertedRun,
    described,
    number,
)

FOLDER = "test_cases/RPE_2_agents_LOS/Experiments/"
RUNS = {
    "exp1_los": "Measurements/exp1_los_sampled.pkl",
    "exp3_los": "Measurements/exp3_los_sampled.pkl",
    "exp4_los": "Measurements/exp4_los_sampled.pkl",
    "exp1_unobservable": "Experiments/Unob_exp/Measurements/exp1_unobservable_sampled.pkl",
}
ROBOTS = {1: "tb2", 2: "tb3"}
TRUTH_EVERY, SECOND = 5, 10
"""Samples between two rows of truth, and in a second."""


class _Object:
    """What a class of the source becomes: its attributes, and nothing that runs."""

    def __init__(self, *_: object) -> None:
        pass


class _Arrays(pickle.Unpickler):
    """Loads numpy's arrays and numbers, and `_Object` for everything else."""

    _known: ClassVar[dict[str, Any]] = {
        "_reconstruct": np.empty(0).__reduce__()[0],
        "scalar": np.float64(0.0).__reduce__()[0],
        "ndarray": np.ndarray,
        "dtype": np.dtype,
    }

    def find_class(self, module: str, name: str) -> Any:
        """The constructor of a pickled thing."""
        if module.split(".")[0] == "numpy":
            return self._known[name]
        return _Object


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """The runs of the figures; the source has more."""
    for name, path in RUNS.items():
        try:
            run = _Arrays(io.BytesIO(archive.read_bytes(FOLDER + path))).load()
        except (pickle.UnpicklingError, EOFError, TypeError, KeyError) as error:
            raise DataError(f"two_robots_vio: {path}: the source has changed ({error})") from None
        uwb = run["uwb"]
        stamps_s = np.array(uwb.sampled_t, float)
        truth, motion = [], []
        for node, robot in ROBOTS.items():
            truth += _truth(node, run[robot].vicon_frame, stamps_s[0])
            motion += _motion(node, run[robot].vio_frame, stamps_s[0])
        ranges = [
            f"{stamp:.4f},1,2,{number(distance)}"
            for stamp, distance in zip(
                stamps_s[::SECOND] - stamps_s[0], uwb.sampled_d[::SECOND], strict=True
            )
        ]
        yield ConvertedRun(
            name,
            described(
                f"two_robots_vio/{name}",
                "github.com/y2d2/UPF_RPE (GPL-3.0): two robots, visual-inertial odometry, "
                "one UWB each, Vicon truth",
                "heading_known = false",
                'initial_pose = "unknown"',
            ),
            others={
                "truth.csv": [TRUTH_COLUMNS, *_in_time(truth)],
                "motion.csv": [MOTION_COLUMNS, *_in_time(motion)],
                "ranges.csv": [RANGE_COLUMNS, *ranges],
            },
        )


def _in_time(rows: list[tuple[float, int, str]]) -> list[str]:
    return [f"{time:.4f},{node},{cells}" for time, node, cells in sorted(rows)]


def _truth(node: int, frame: Any, zero_s: float) -> list[tuple[float, int, str]]:
    """Rows of truth; the robots drive along -y of their markers."""
    poses: Array = frame.sampled_T
    heading = np.unwrap(np.arctan2(poses[:, 1, 1], poses[:, 0, 1]) + np.pi)
    return [
        (
            round(float(frame.sampled_t[k] - zero_s), 4),
            node,
            ",".join(map(number, (*poses[k, :2, 3], heading[k]))),
        )
        for k in range(0, len(poses), TRUTH_EVERY)
    ]


def _motion(node: int, frame: Any, zero_s: float) -> list[tuple[float, int, str]]:
    """Rows of motion, a second each; the camera's x lies across, so headings are that axis's."""
    poses: Array = frame.sampled_T
    kept = np.r_[0, np.arange(SECOND + 1, len(poses), SECOND)]
    heading = np.unwrap(np.arctan2(poses[kept, 1, 0], poses[kept, 0, 0]))
    moved = np.diff(poses[kept, 0, 3] + 1j * poses[kept, 1, 3]) * np.exp(-1j * heading[:-1])
    return [
        (
            round(float(frame.sampled_t[k] - zero_s), 4),
            node,
            ",".join(map(number, (step.real, step.imag, turn))),
        )
        for k, step, turn in zip(kept[1:], moved, np.diff(heading), strict=True)
    ]
