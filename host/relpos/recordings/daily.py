"""github.com/mobilise-d/mobgap: lower back at 100 Hz, indoor activity, motion capture in bouts.

The example data are MATLAB structures: acceleration in g, angular rate in degrees a second, and the
walking bouts that optical motion capture saw, with length and foot contacts.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy

from relpos.recordings.tables import Archive, ConvertedRun, described, event_lines, imu_lines

RATE_HZ = 100.0
G_M_S2 = 9.80665
PEOPLE = ("HA/002", "MS/001")


def convert(archive: Archive) -> Iterator[ConvertedRun]:
    """The trials in which motion capture measured the length of a bout."""
    for person in PEOPLE:
        folder = f"example_data/data/lab/{person}"
        about = _matlab(archive, f"{folder}/infoForAlgo.mat")["infoForAlgo"].TimeMeasure1
        tests = _matlab(archive, f"{folder}/data.mat")["data"].TimeMeasure1
        for test in ("Test11", "Test5"):
            for trial in getattr(tests, test)._fieldnames:
                data = getattr(getattr(tests, test), trial)
                bouts = data.Standards.Stereophoto.MicroWB
                bouts = [bouts] if hasattr(bouts, "Start") else list(bouts)
                bouts = [bout for bout in bouts if np.size(bout.Length)]
                if bouts:
                    name = f"{person.replace('/', '')}_{test}_{trial}"
                    yield _run(name, about, data.SU.LowerBack, bouts)


def _matlab(archive: Archive, name: str) -> dict[str, Any]:
    file = io.BytesIO(archive.read_bytes(name))
    return dict(scipy.io.loadmat(file, squeeze_me=True, struct_as_record=False))


def _run(name: str, about: Any, sensor: Any, bouts: list[Any]) -> ConvertedRun:
    samples = np.hstack([sensor.Acc * G_M_S2, np.radians(sensor.Gyr), sensor.Mag])
    marks = []
    for bout in bouts:
        marks.append((bout.Start, "bout_start", f"{bout.Length:.3f}"))
        marks.append((bout.End, "bout_end", ""))
        feet = zip(bout.InitialContact_Event, bout.InitialContact_LeftRight, strict=True)
        marks += [(t, "foot_contact", foot.lower()) for t, foot in feet if np.isfinite(t)]
    events = event_lines(marks, digits=3)
    description = described(
        f"walk_daily_lowerback/{name}",
        "github.com/mobilise-d/mobgap example_data (Apache-2.0)",
        'mount = "lower back, x up"',
        f"stature_m = {about.Height / 100.0:.2f}",
        f"sensor_height_m = {about.SensorHeight / 100.0:.3f}",
    )
    times_s = np.arange(len(samples)) / RATE_HZ
    return ConvertedRun(name, description, imu_lines(times_s, samples, 6), events)
