"""Where the real walks are, and what their truth says."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import replay
from numpy.typing import NDArray
from replay import RATE_HZ, Array, Recording

Track = NDArray[np.complex128]  # places as complex metres
TILT_TIME_S = 3.0  # of the attitude that gives the vertical: over a stride, under a turn
CORRIDOR = ("Data__test1Data__kar_to_rita", "Data__test2Data__rita_to_kar")  # of walk_chest


def folders(data_set: str) -> list[Path]:
    """Recordings of a data set, in the order of their names' numbers."""

    def numbers(folder: Path) -> list[tuple[int, str]]:
        return [(int(p), "") if p.isdigit() else (-1, p) for p in folder.name.split("-")]

    return sorted((replay.DATA / data_set).iterdir(), key=numbers)


def waypoints_of(folder: Path) -> tuple[Array, Track]:
    """Times (n,) and places (n,) as complex metres of the surveyed waypoints."""
    keys = ("time_s", "x_m", "y_m")
    with (folder / "truth.csv").open() as stream:
        table = np.array([[float(row[key]) for key in keys] for row in csv.DictReader(stream)])
    return table[:, 0], table[:, 1] + 1j * table[:, 2]


def at_waypoints(recording: Recording, track: Track, times_s: Array) -> Track:
    """The track (complex metres) at the waypoints' times.

    A waypoint up to 1 s outside the recording takes its first or last sample; nan further off.
    """
    time = recording.time_s
    out = np.interp(times_s, time, track.real) + 1j * np.interp(times_s, time, track.imag)
    return np.where((times_s < time[0] - 1.0) | (times_s > time[-1] + 1.0), np.nan, out)


def aligned(estimate: Track, places: Track) -> Track:
    """The estimate, moved to the first waypoint and turned so that the first leg points right.

    Not scaled. A first leg that was not walked at all cannot be turned.
    """
    moved = estimate - estimate[0]
    turn = (places[1] - places[0]) * np.conj(moved[1])
    return np.asarray(places[0] + moved * (turn / abs(turn) if abs(turn) > 0.0 else 1.0))


def fitted(estimate: Track, places: Track, *, scale: bool = False) -> Track:
    """The estimate from the first waypoint, turned (and scaled) to fit all waypoints best."""
    moved, truth = estimate - estimate[0], places - places[0]
    turn = np.nansum(truth * np.conj(moved))
    if scale:
        power = np.nansum(np.abs(moved) ** 2)
        return np.asarray(places[0] + moved * (turn / power if power > 0.0 else 1.0))
    return np.asarray(places[0] + moved * (turn / abs(turn) if abs(turn) > 0.0 else 1.0))


def upwards(recording: Recording) -> Array:
    """The vertical (n, 3) in sensor axes: the gyroscope carries it, gravity corrects it."""
    force, rate = recording.imu[:, :3], recording.imu[:, 3:]
    up = force[:25].mean(axis=0)
    up /= np.linalg.norm(up)
    out = np.empty_like(force)
    axes = np.cross(np.eye(3), rate[:, None, :])  # (n, 3, 3): axes @ up is the cross product
    turns = np.eye(3) - axes / RATE_HZ
    share = 1.0 / (RATE_HZ * TILT_TIME_S)
    for i, turn in enumerate(turns):
        up = (1.0 - share) * (turn @ up) + share * force[i] / 9.81
        up /= math.sqrt(up @ up)
        out[i] = up
    return out


def gyro_heading_rad(recording: Recording) -> Array:
    """Yaw (n,) from the raw gyroscope about the vertical: no bias, no correction."""
    return np.cumsum(np.sum(recording.imu[:, 3:] * upwards(recording), axis=1)) / RATE_HZ
