"""Raw inertial recordings: ``imu.csv``, long and regular, so read by numpy in one go."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from relpos.measurements import BOUNDS
from relpos.runs.table import (
    MOST_WHOLE,
    Column,
    bounded,
    find_columns,
    find_table,
    node_id,
    number,
    numbered_rows,
    read_text,
)

_COLUMNS = (
    Column("time_s", bounded("time_s")),
    Column("node", node_id),
    *(Column(f"{axis}_m_s2", number) for axis in ("ax", "ay", "az")),
    *(Column(f"{axis}_rad_s", number) for axis in ("gx", "gy", "gz")),
    # A magnetometer is slower than the rest or not there at all: its cells may be empty.
    *(Column(f"{axis}_ut", number, optional=True) for axis in ("mx", "my", "mz")),
    Column("pressure_pa", bounded("pressure_pa"), optional=True),
)
IMU_COLUMNS = tuple(column.name for column in _COLUMNS)


@dataclass(frozen=True)
class ImuRecording:
    """One node's raw inertial data in sensor axes, sorted by time.

    ``time_s`` is (n,); ``acceleration_m_s2`` (specific force), ``angular_rate_rad_s`` and
    ``magnetic_field_ut`` are (n, 3), the last NaN where no sample was taken, as is the air's
    ``pressure_pa`` (n,); None: no barometer.
    """

    time_s: npt.NDArray[np.float64]
    acceleration_m_s2: npt.NDArray[np.float64]
    angular_rate_rad_s: npt.NDArray[np.float64]
    magnetic_field_ut: npt.NDArray[np.float64]
    pressure_pa: npt.NDArray[np.float64] | None = None


def read_imu(directory: Path) -> dict[int, ImuRecording]:
    """Read every node's inertial recording of a run directory; empty where there is no imu.csv."""
    path = find_table(directory, "imu.csv")
    if path is None:
        return {}
    text = read_text(path)
    table = _read_fast(path, text)
    if table is None:
        table = _read_exactly(path, text)
    recordings: dict[int, ImuRecording] = {}
    for node in np.unique(table[:, 1]):
        rows = table[table[:, 1] == node]
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        pressure_pa = rows[:, 11] if np.isfinite(rows[:, 11]).any() else None
        recordings[int(node)] = ImuRecording(
            rows[:, 0], rows[:, 2:5], rows[:, 5:8], rows[:, 8:11], pressure_pa
        )
    return recordings


def _read_fast(path: Path, text: str) -> npt.NDArray[np.float64] | None:
    """Read the (n, 12) table, or None where anything is unusual and deserves a closer look."""
    if '"' in text:
        return None
    header_line, _, body = text.partition("\n")
    header = header_line.rstrip("\r").split(",")
    places = [place for _, place in find_columns(path, header, _COLUMNS)]
    present = [place for place in places if place is not None]
    if not body.strip():
        return None
    try:
        values = np.loadtxt(
            io.StringIO(body), delimiter=",", usecols=present, comments=None, ndmin=2
        )
    except (ValueError, IndexError):
        return None
    nodes = values[:, 1]  # time and node are never missing, so they come first
    regular = body.count(",") == values.shape[0] * (len(header) - 1)
    if not (regular and np.isfinite(values).all() and _are_node_ids(nodes)):
        return None
    table = np.full((values.shape[0], len(_COLUMNS)), np.nan)
    table[:, [k for k, place in enumerate(places) if place is not None]] = values
    return table if _are_within_bounds(table) else None


def _are_node_ids(nodes: npt.NDArray[np.float64]) -> bool:
    return bool(((nodes >= 0) & (nodes <= MOST_WHOLE) & (nodes == np.floor(nodes))).all())


def _are_within_bounds(table: npt.NDArray[np.float64]) -> bool:
    for k, column in enumerate(_COLUMNS):
        low, high = BOUNDS.get(column.name, (-np.inf, np.inf))
        if ((table[:, k] < low) | (table[:, k] > high)).any():
            return False
    return True


def _read_exactly(path: Path, text: str) -> npt.NDArray[np.float64]:
    """Row by row: slow, but it knows which cell is wrong."""
    rows: list[tuple[Any, ...]] = [cells for _, cells in numbered_rows(path, text, _COLUMNS)]
    # None becomes NaN; the shape keeps a file without rows a table.
    return np.array(rows, dtype=np.float64).reshape(-1, len(_COLUMNS))
