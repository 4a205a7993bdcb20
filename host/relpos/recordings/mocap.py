"""github.com/NikonPic/imu_gait_analysis: Vicon markers of walks and stairs, 200 Hz.

The IMU is virtual: a rigid body through the four markers of the pelvis moves as they do, its
sensor at the sacrum, levelled on average. So a marker that was lost for a while is not needed.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import PurePosixPath

import numpy as np
import scipy

from relpos.errors import DataError
from relpos.recordings.tables import (
    TRUTH_COLUMNS,
    Archive,
    Array,
    ConvertedRun,
    described,
    imu_lines,
    number,
)

RATE_HZ = 200.0
LOW_PASS_HZ, ORDER = 14.0, 4
G_M_S2 = 9.80665
EDGE = 20  # frames: 0.1 s, which the filter spoils
LEG = 0.96
PEOPLE = ("F1", "F2", "F5", "M1", "M4")
MARKERS = ("LASI", "RASI", "LPSI", "RPSI")
HEADER_LINES = 5


def walks(archive: Archive) -> Iterator[ConvertedRun]:
    """Level walks."""
    yield from _convert(archive, "Gang", "walk_mocap_virtual")


def stairs(archive: Archive) -> Iterator[ConvertedRun]:
    """Walks over a block of steps."""
    yield from _convert(archive, "Treppe", "stairs_mocap_virtual")


def _convert(archive: Archive, kind: str, data_set: str) -> Iterator[ConvertedRun]:
    for person in PEOPLE:
        level = [_markers(archive, n) for n in archive.below(f"data/{person}/Gang/", ".csv")]
        legs_m = [LEG * float(np.nanmedian(markers[:, :2, 2])) for markers in level]
        for k, name in enumerate(archive.below(f"data/{person}/{kind}/", ".csv")):
            markers = level[k] if kind == "Gang" else _markers(archive, name)
            leg_m = legs_m[k] if kind == "Gang" else float(np.median(legs_m))
            yield _run(f"{data_set}/{PurePosixPath(name).stem}", person, leg_m, markers)


def _markers(archive: Archive, name: str) -> Array:
    """(frames, 4, 3) metres, not a number where a marker was lost."""
    rows = list(csv.reader(archive.read(name).splitlines()))
    begin = next((k for k, row in enumerate(rows) if row[:1] == ["Trajectories"]), None)
    if begin is None:
        raise DataError(f"{name}: no trajectories: the source has changed")
    columns = {cell.rpartition(":")[2]: k for k, cell in enumerate(rows[begin + 2]) if ":" in cell}
    frames = []
    for row in rows[begin + HEADER_LINES :]:
        if not row or not row[0]:
            break
        cells = [c for marker in MARKERS for c in row[columns[marker] : columns[marker] + 3]]
        frames.append([float(c) / 1e3 if c else np.nan for c in cells])
    return np.array(frames).reshape(-1, len(MARKERS), 3)


def _run(name: str, person: str, leg_m: float, markers: Array) -> ConvertedRun:
    seen = np.isfinite(markers[..., 0])
    enough = np.flatnonzero(seen.sum(axis=1) >= 3)
    runs = np.split(enough, np.flatnonzero(np.diff(enough) > 1) + 1)
    longest = max(runs, key=len)
    markers, seen = markers[longest], seen[longest]
    rotation, sacrum_m = _rigid_body(markers, seen)
    low_pass = scipy.signal.butter(ORDER, LOW_PASS_HZ / (RATE_HZ / 2.0))
    quaternions = rotation.as_quat()
    quaternions *= np.cumprod(np.sign([1.0, *(quaternions[1:] * quaternions[:-1]).sum(1)]))[:, None]
    attitude = scipy.spatial.transform.Rotation.from_quat(
        scipy.signal.filtfilt(*low_pass, quaternions, axis=0)
    )
    smooth_m = scipy.signal.filtfilt(*low_pass, sacrum_m, axis=0)
    acceleration = np.gradient(np.gradient(smooth_m, axis=0), axis=0) * RATE_HZ**2
    force = attitude.inv().apply(acceleration + np.array([0.0, 0.0, G_M_S2]))
    rate = np.zeros_like(force)
    rate[1:-1] = (attitude[:-2].inv() * attitude[2:]).as_rotvec() * RATE_HZ / 2.0
    # Rounded, so that no computer's last bit tells.
    samples: Array = np.hstack([force.round(4), rate.round(6)], dtype=np.float64)[EDGE:-EDGE:2]
    imu = imu_lines(np.arange(len(samples), dtype=np.float64) * (2.0 / RATE_HZ), samples)
    x, y = attitude.apply([1.0, 0.0, 0.0]).T[:2]
    heading = np.unwrap(np.arctan2(y, x))
    poses = np.column_stack([smooth_m[:, :2], heading, smooth_m[:, 2]])[EDGE:-EDGE:10]
    truth = [f"{TRUTH_COLUMNS},z_m"]
    for k, pose in enumerate(poses):
        truth.append(f"{k * 10 / RATE_HZ:.4f},1," + ",".join(number(v, 5) for v in pose))
    way_m = np.hypot(*np.diff(poses[::2, :2], axis=0).T).sum()
    description = described(
        name,
        f"github.com/NikonPic/imu_gait_analysis (no licence stated): person {person}, virtual IMU",
        'mount = "sacrum, x forward, y left, z up"',
        f"leg_length_m = {leg_m:.3f}   # {LEG} of the height of the front markers on the level",
        f"true_distance_m = {way_m:.3f}",
    )
    return ConvertedRun(PurePosixPath(name).name, description, imu, others={"truth.csv": truth})


def _rigid_body(markers: Array, seen: Array) -> tuple[scipy.spatial.transform.Rotation, Array]:
    """Attitude, and place of the sacrum, of the body that the markers span in the middle frame.

    The best rotation is Kabsch's; the body is level in that frame, its x axis forward.
    """
    whole = np.flatnonzero(seen.all(axis=1))
    if not len(whole):
        raise DataError("walk_mocap_virtual: no frame has all markers: the source has changed")
    middle = markers[whole[len(whole) // 2]]
    left = (middle[0] - middle[1]) * [1.0, 1.0, 0.0]
    left /= np.linalg.norm(left)
    axes = np.column_stack([np.cross(left, [0.0, 0.0, 1.0]), left, [0.0, 0.0, 1.0]])
    body = (middle - middle.mean(axis=0)) @ axes
    weights = seen / seen.sum(axis=1, keepdims=True)
    markers = np.nan_to_num(markers)
    centre, centre_of_body = np.einsum("tk,tki->ti", weights, markers), weights @ body
    apart = markers - centre[:, None]
    spread = np.einsum("tk,tki,tkj->tij", weights, body - centre_of_body[:, None], apart)
    u, _, v = np.linalg.svd(spread)
    v[:, 2] *= np.linalg.det(u @ v)[:, None]  # a rotation, no mirror image
    rotation = scipy.spatial.transform.Rotation.from_matrix((u @ v).transpose(0, 2, 1))
    return rotation, centre + rotation.apply(body[2:].mean(axis=0) - centre_of_body)
