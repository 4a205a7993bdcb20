"""TUM trajectories, the format of ``evo``: one file a node, ``time x y z qx qy qz qw`` a line.

Times are the run's own seconds and the frame is the run's. A heading is the turn about z; where
none is known the quaternion is the unit one, which the format cannot distinguish from heading 0.
An unknown height is 0 likewise.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

from relpos.errors import DataError
from relpos.exchange.content import Point
from relpos.exchange.formats import Kind
from relpos.files import write_output
from relpos.runs.table import number, read_text

UNIX_TIME_S = 1.0e8
"""No run lasts three years: a time so large counts from 1970."""

_NORM_SLACK = 0.01
"""A unit quaternion with three decimals is this far from norm 1 at most."""


def file_name(kind: Kind, node: int) -> str:
    """Return the name of one node's file, which says what it holds when it is read back."""
    return f"{kind}_{node}.tum"


def write_tum(path: Path, points: Sequence[Point]) -> None:
    """Write one node's trajectory."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for p in points:
        z_m = p.z_m if math.isfinite(p.z_m) else 0.0
        half_rad = 0.5 * p.heading_rad if math.isfinite(p.heading_rad) else 0.0
        lines.append(
            f"{p.time_s:.6f} {p.x_m:.6f} {p.y_m:.6f} {z_m:.6f} "
            f"0 0 {math.sin(half_rad):.9f} {math.cos(half_rad):.9f}"
        )
    write_output(path, "\n".join(lines) + "\n")


def read_tum(path: Path, node: int, start_unix_s: float | None) -> list[Point]:
    """Read one node's trajectory; of a full attitude its turn about z is the heading.

    Unix times are counted from ``start_unix_s``. DataError names the line of the first fault.
    """
    points: list[Point] = []
    for line, text in enumerate(read_text(path).splitlines(), start=1):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        points.append(_point(f"{path}: line {line}", words, node, start_unix_s))
    if not points:
        raise DataError(f"{path}: no pose in it")
    points.sort(key=lambda p: p.time_s)
    for before, after in pairwise(points):
        if before.time_s == after.time_s:
            raise DataError(f"{path}: two poses at {after.time_s:g} s")
    return points


def _point(where: str, words: Sequence[str], node: int, start_unix_s: float | None) -> Point:
    if len(words) != 8:
        raise DataError(
            f"{where}: {len(words)} values, 8 are wanted: timestamp tx ty tz qx qy qz qw, "
            "separated by spaces"
        )
    values: list[float] = []
    for word in words:
        try:
            values.append(number(word))
        except ValueError as error:
            raise DataError(f"{where}: {word!r} {error}") from None
    time_s, x_m, y_m, z_m, qx, qy, qz, qw = values
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    heading_rad = math.nan
    if norm > 0.0:
        if abs(norm - 1.0) > _NORM_SLACK:
            raise DataError(f"{where}: the quaternion's norm is {norm:.3f}, not 1")
        heading_rad = math.atan2(2.0 * (qw * qz + qx * qy), norm**2 - 2.0 * (qy * qy + qz * qz))
    if time_s > UNIX_TIME_S:
        if start_unix_s is None:
            raise DataError(
                f"{where}: {words[0]} counts from 1970; say when the run's second 0 was (--start)"
            )
        time_s = round(time_s - start_unix_s, 6)
    return Point(time_s, node, x_m, y_m, z_m, heading_rad)


def find_files(source: Path) -> list[Path]:
    """Return the trajectories in a directory, or the one that is named."""
    return sorted(source.glob("*.tum")) if source.is_dir() else [source]


def node_of(path: Path, node: int | None) -> int:
    """Return the node of a file's trajectory: ``node``, else the last number in its name."""
    if node is not None:
        return node
    numbers = re.findall(r"[0-9]+", path.stem)
    if not numbers:
        raise DataError(f"{path}: which node's trajectory is this? (--node N)")
    return int(numbers[-1])


def kind_of(path: Path, kind: Kind | None) -> Kind:
    """Return what a file holds: ``kind``, else by its name."""
    if kind is not None:
        return kind
    for known in Kind:
        if path.name.startswith(known):
            return known
    raise DataError(f"{path}: is this truth or an estimate? (--as truth, --as estimate)")


def read_files(
    files: Iterable[Path], node: int | None, kind: Kind | None, start_unix_s: float | None
) -> dict[Kind, list[Point]]:
    """Read trajectories by what they are; two of one node and one kind are refused."""
    points: dict[Kind, list[Point]] = {}
    seen: dict[tuple[Kind, int], Path] = {}
    for path in files:
        key = (kind_of(path, kind), node_of(path, node))
        if key in seen:
            raise DataError(f"{path}: node {key[1]}'s {key[0]} is in {seen[key].name} already")
        seen[key] = path
        points.setdefault(key[0], []).extend(read_tum(path, key[1], start_unix_s))
    return points
