"""github.com/SintMaartenskliniek/MovingReality: lumbar Xsens at 100 Hz, treadmill, after a stroke.

What is true are the strides of both foot-worn sensors; on the belt the foot stands still at
mid-stance, see `strides`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from relpos.errors import DataError
from relpos.recordings.strides import RATE_HZ, stances, way_m
from relpos.recordings.tables import Archive, Array, ConvertedRun, described, event_lines, imu_lines

FIELD_UT = 45.0  # the field comes in units of the earth's
BOUT_S, LEAD_S = 60.0, 4.0
STATURES_M = {
    "01": 1.775, "02": 1.71, "04": 1.63, "05": 1.83, "07": 1.83, "08": 1.72, "10": 1.88, "11": 1.7
}  # fmt: skip
SENSORS = (
    {"lumbar": "00B47791", "left": "00B4778E", "right": "00B47793"},
    {"lumbar": "00B4778F", "left": "00B47787", "right": "00B47796"},
)
# Trial, export, first sample of the minute in which the belt's speed is steady.
TRIALS = {
    "01": "2FB 3 1205, FBIC 6 1132, Reg1 0 1330, Reg2 7 131",
    "02": "2FB 3 1289, FBIC 1 1274, FBPO 2 1247, Reg1 0 710, Reg2 4 418",
    "04": "2FB 3 1178, FBIC 1 1246, FBPO 2 1231, Reg1 0 70, Reg2 4 291",
    "05": "2FB 4 1207, FBIC 3 1231, FBPO 2 1117, Reg1 1 273, Reg2 5 589",
    "07": "2FB 3 1156, FBIC 2 1089, FBPO 1 1121, Reg1 0 896, Reg2 4 405",
    "08": "2FB 6 1304, FBIC 4 1202, FBPO 5 1370, Reg1 1 479, Reg2 7 744",
    "10": "2FB 3 1393, FBIC 1 1161, FBPO 2 1210, Reg1 0 809, Reg2 4 423",
    "11": "2FB 3 1220, FBIC 2 1188, FBPO 1 1115, Reg1 0 939, Reg2 4 653",
}


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """The minutes of the trials that were recorded well."""
    for person, trials in TRIALS.items():
        for trial in trials.split(", "):
            name, export, begin = trial.split()
            folder = f"data/1019_pp{person}/Xsens/exported{int(export):03d}/"
            files = archive.below(folder, ".txt")
            worn = SENSORS[not any(SENSORS[0]["lumbar"] in file for file in files)]
            tables = {
                part: _table(archive, next(f for f in files if sensor in f))
                for part, sensor in worn.items()
            }
            yield _run(person, name, int(begin), tables)


def _table(archive: Archive, name: str) -> Array:
    """Acceleration, angular rate, field, acceleration without gravity (east, north, up)."""
    rows = [r.split("\t") for r in archive.read(name).splitlines() if not r.startswith("//")]
    names = [f"{kind}_{axis}" for kind in ("Acc", "Gyr", "Mag") for axis in "XYZ"]
    try:
        columns = [rows[0].index(n) for n in (*names, "FreeAcc_E", "FreeAcc_N", "FreeAcc_U")]
    except ValueError as error:
        raise DataError(f"{name}: {error}: the source has changed") from None
    return np.array([[float(row[k]) for k in columns] for row in rows[1:]])


def _run(person: str, trial: str, begin: int, tables: dict[str, Array]) -> ConvertedRun:
    lead = min(begin, round(LEAD_S * RATE_HZ)) if trial.startswith("Reg") else 0
    first, end = begin - lead, begin + round(BOUT_S * RATE_HZ)
    samples = tables["lumbar"][first : end + 1, :9] * np.repeat([1.0, 1.0, FIELD_UT], 3)
    ways_m, marks = [], []
    for foot in ("left", "right"):
        instants, lengths_m = strides(tables[foot])
        inside = (instants[1:] >= first) & (instants[1:] <= end)
        for at, length_m in zip(instants[1:][inside], lengths_m[inside], strict=True):
            time_s = (at - first) / RATE_HZ
            marks.append((time_s, "foot_contact", foot))
            marks.append((time_s, f"stride_length_{foot}_m", f"{length_m:.3f}"))
        travelled = np.interp([begin, end], instants, np.append(0.0, np.cumsum(lengths_m)))
        ways_m.append(float(travelled[1] - travelled[0]))
    way_m = sum(ways_m) / 2.0
    marks += [
        (lead / RATE_HZ, "bout_start", f"{way_m:.3f}"),
        ((end - first) / RATE_HZ, "bout_end", ""),
    ]
    events = event_lines(marks)
    description = described(
        f"walk_treadmill_stroke_lumbar/pp{person}_{trial}",
        "github.com/SintMaartenskliniek/MovingReality (MIT)",
        'mount = "lumbar (Xsens MTw Awinda)"',
        f"stature_m = {STATURES_M[person]:.3f}",
        f"true_distance_m = {way_m:.2f}   # feet {ways_m[0]:.2f} and {ways_m[1]:.2f}",
        "true_turn_deg = 0.0",
    )
    imu = imu_lines(np.arange(len(samples), dtype=np.float64) / RATE_HZ, samples)
    return ConvertedRun(f"pp{person}_{trial}", description, imu, events)


def strides(foot: Array) -> tuple[Array, Array]:
    """Mid-stance instants as samples, and the horizontal way between each two of them."""
    instants = [stillest for _, stillest, _ in stances(foot[:, 3:6])]
    lengths_m = [way_m(foot[begin : end + 1, 9:11]) for begin, end in itertools.pairwise(instants)]
    return np.array(instants, np.float64), np.array(lengths_m, np.float64)
