"""github.com/Marpino/Walking-dataset: back and both feet at 100 Hz; 5 m, rectangles, circles.

What is true are the strides of both feet: from mid-stance to mid-stance the gyroscope carries the
vertical that gravity gives, see `strides`. Statures are those of the source's lists of people, in
the order of date and number.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Iterator

import numpy as np

from relpos.errors import DataError
from relpos.extras import missing_extra
from relpos.recordings.strides import RATE_HZ, stances, way_m
from relpos.recordings.tables import Archive, Array, ConvertedRun, described, event_lines, imu_lines

G_M_S2 = 9.80665
SCALES = np.repeat([G_M_S2 / 10000.0, math.pi / 18000.0, 0.1], 3)  # to m/s2, rad/s, uT
SENSORS = {"right": 1, "left": 6, "back": 7}
STANDING, LEAD = 60, 12  # samples: who stood longer sets off so long before the foot moves
SHORTEST_STANCE = 10  # samples: what is shorter is a swing's turning point
SHORTEST_STRIDE_M = 0.1
LEVELLED = 5  # samples on both sides of mid-stance whose mean force is vertical

# Run, file, stature.
PEOPLE = """
elderly_09 Elderly/20180417_2 1.49, elderly_10 Elderly/20180417_3 1.53,
elderly_12 Elderly/20180417_5 1.49, elderly_13 Elderly/20180417_7 1.50,
elderly_15 Elderly/20180417_11 1.54, elderly_16 Elderly/20180605_1 1.45,
elderly_18 Elderly/20180605_3 1.51, elderly_19 Elderly/20180605_4 1.43,
young_01 Young/20180518_1 1.74, young_02 Young/20180518_2 1.60,
young_04 Young/20180518_4 1.72, young_05 Young/20180518_5 1.65,
young_07 Young/20180518_8 1.74, young_08 Young/20180621_1 1.73
"""
AUTHOR = (2, 4, 6, 7, *range(9, 20), *range(23, 28), 29, 30, *range(32, 35))


def people(archive: Archive) -> Iterator[ConvertedRun]:
    """5 m of each person."""
    for entry in PEOPLE.split(","):
        name, file, stature_m = entry.split()
        yield _run(archive, f"walk_5m_back/{name}", file, f"stature_m = {float(stature_m):.3f}")


def author(archive: Archive) -> Iterator[ConvertedRun]:
    """Lines, rectangles and circles of one person."""
    for number in AUTHOR:
        yield _run(archive, f"walk_author_back/a_{number}", f"Additional/Marzia/{number}")


def _run(archive: Archive, name: str, file: str, *lines: str) -> ConvertedRun:
    tables = _tables(archive, f"Dataset/{file}.xlsx")
    marks, ways_m = [], []
    for foot in ("right", "left"):
        ends, lengths_m = strides(tables[foot])
        ways_m.append(sum(lengths_m))
        for end, length_m in zip(ends, lengths_m, strict=True):
            marks.append((end / RATE_HZ, f"stride_length_{foot}_m", f"{length_m:.3f}"))
    description = described(
        name,
        f"github.com/Marpino/Walking-dataset (no licence stated), Dataset/{file}.xlsx",
        'mount = "back"',
        *lines,
        f"true_distance_m = {sum(ways_m) / 2:.2f}   # feet {ways_m[0]:.2f} and {ways_m[1]:.2f}",
        "# The source calls the back sensor unsynchronised: use strides for lengths and order.",
    )
    back = tables["back"]
    imu = imu_lines(np.arange(len(back), dtype=np.float64) / RATE_HZ, back)
    events = event_lines(marks)
    return ConvertedRun(name.partition("/")[2], description, imu, events)


def _tables(archive: Archive, name: str) -> dict[str, Array]:
    """Acceleration, angular rate and field (n, 9) of each sensor."""
    try:
        import openpyxl
    except ImportError:
        raise missing_extra("openpyxl", "recordings") from None
    book = openpyxl.load_workbook(io.BytesIO(archive.read_bytes(name)), read_only=True)
    rows = book[book.sheetnames[0]].iter_rows(values_only=True)
    header = [str(cell).strip() for cell in next(rows)]
    kinds = [f"{kind}_read_{axis}" for kind in ("Acc", "Gyro", "Mag") for axis in "xyz"]
    try:
        columns = [header.index(f"{k}_{n}") for n in SENSORS.values() for k in kinds]
    except ValueError as error:
        raise DataError(f"{name}: {error}: the source has changed") from None
    values = np.array([[row[k] for k in columns] for row in rows], np.float64)
    parts = values.reshape(len(values), len(SENSORS), len(SCALES)) * SCALES
    return {sensor: parts[:, k] for k, sensor in enumerate(SENSORS)}


def strides(foot: Array) -> tuple[list[int], list[float]]:
    """Samples at which strides end, and their horizontal lengths, of a foot's sensor (n, 6 or 9).

    Its scale and the gyroscope's bias are those of the longest stance.
    """
    found = [s for s in stances(foot[:, 3:6]) if s[2] - s[0] >= SHORTEST_STANCE]
    rest = max(found, key=lambda stance: stance[2] - stance[0])
    still = foot[rest[0] : rest[2] + 1]
    force = foot[:, :3] * (G_M_S2 / np.linalg.norm(still[:, :3], axis=1).mean())
    rate = foot[:, 3:6] - still[:, 3:6].mean(axis=0)
    ends, lengths_m = [], []
    for (begun, begin, left), (reached, end, ended) in itertools.pairwise(found):
        first = max(begin, left - LEAD) if left - begun > STANDING else begin
        last = min(end, reached + LEAD) if ended - reached > STANDING else end
        up = force[max(first - LEVELLED, 0) : first + LEVELLED + 1].mean(axis=0)
        length_m = way_m(_levelled(force[first : last + 1], rate[first : last + 1], up))
        if length_m > SHORTEST_STRIDE_M:
            ends.append(end)
            lengths_m.append(length_m)
    return ends, lengths_m


def _levelled(force: Array, rate: Array, up: Array) -> Array:
    """Horizontal part (n, 2) of forces (n, 3); a rate is that of the span that its sample ends."""
    from scipy.spatial.transform import Rotation

    attitude = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0]
    out = [attitude.apply(force[0])]
    for one, turn in zip(force[1:], rate[1:], strict=True):
        attitude = attitude * Rotation.from_rotvec(turn / RATE_HZ)
        out.append(attitude.apply(one))
    return np.array(out)[:, :2]
