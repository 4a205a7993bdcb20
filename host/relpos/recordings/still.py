"""Chips at rest: eight MPU-9150 of one board (MIMU4444), and one MPU-6050 for eleven minutes.

github.com/hcarlsso/Self-Calibration-Inertial-Sensor-Arrays-BCD.jl: the board's own packets, of
which the first 330 s are still poses. github.com/sunsided/sensor-fusion: MATLAB tables whose time
stamps came in clumps over USB, so that samples are spread evenly.
"""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np

from relpos.errors import DataError
from relpos.extras import missing_extra
from relpos.recordings.tables import Archive, Array, ConvertedRun, described, imu_lines

G_M_S2 = 9.80665
# A packet: 0xAA, counter, length of what follows (100), clock at 64 MHz, 8 x 6 values, checksum.
PACKET = np.dtype(
    {
        "names": ["mark", "size", "clock", "values"],
        "formats": ["u1", "u1", ">u4", (">i2", (8, 6))],
        "offsets": [0, 3, 4, 8],
        "itemsize": 106,
    }
)
HEADER, MARK, SIZE, CLOCK_HZ = 4, 0xAA, 100, 64e6
STILL_S = 330.0
UNITS = np.repeat([G_M_S2 / 2048.0, np.radians(1.0 / 16.4)], 3)  # +-16 g, +-2000 degrees a second
FIELD_UT = 100.0  # gauss


def chips(archive: Archive) -> Iterator[ConvertedRun]:
    """The still poses of the first experiment, chips 1 to 8 as nodes."""
    raw = archive.read_bytes("experimental_data/calibration/exp_1/data.bin")
    packets = np.frombuffer(raw, PACKET, (len(raw) - HEADER) // PACKET.itemsize, HEADER)
    if len(packets) < 2 or (packets["mark"] != MARK).any() or (packets["size"] != SIZE).any():
        raise DataError("still_mpu9150_8chips: no packets of the board: the source has changed")
    ticks = np.diff(packets["clock"].astype(np.uint32))  # wraps every 67 s
    times_s = np.concatenate([[0.0], np.cumsum(ticks, dtype=np.float64) / CLOCK_HZ])
    still = times_s <= STILL_S
    values = packets["values"][still] * UNITS
    nodes = [imu_lines(times_s[still], values[:, k], node=k + 1) for k in range(8)]
    description = described(
        "still_mpu9150_8chips/exp1",
        "github.com/hcarlsso/Self-Calibration-Inertial-Sensor-Arrays-BCD.jl (MIT): MIMU4444",
        'mount = "bench"',
    )
    yield ConvertedRun(
        "exp1", description, [row for rows in zip(*nodes, strict=True) for row in rows]
    )


def ten_minutes(archive: Archive) -> Iterator[ConvertedRun]:
    """Accelerometer and gyroscope of a chip, with the magnetometer (HMC5883L) beside it."""
    acceleration = _buffer(archive, "mpu6050_accelerometer", "accelBuffer")
    rate = _buffer(archive, "mpu6050_gyroscope", "gyroBuffer")
    field = _buffer(archive, "hmc5883l_compass", "compassBuffer")
    stamps_s, field_s = (np.linspace(t[0], t[-1], len(t)) for t in (acceleration[0], field[0]))
    magnetic = [np.interp(stamps_s, field_s, row) for row in field[1:]]
    samples = np.vstack(
        [acceleration[1:] * G_M_S2, np.radians(rate[1:]), np.array(magnetic) * FIELD_UT]
    )
    description = described(
        "still_mpu6050_10min/set2",
        "github.com/sunsided/sensor-fusion (EUPL-1.2): MPU-6050, +-8 g, +-250 deg/s, unmoved",
        'mount = "bench"',
    )
    yield ConvertedRun("set2", description, imu_lines(stamps_s - stamps_s[0], samples.T))


def _buffer(archive: Archive, file: str, name: str) -> Array:
    """Rows time, x, y, z of a MATLAB 7.3 file, which is HDF5."""
    try:
        import h5py
    except ImportError:
        raise missing_extra("h5py", "recordings") from None
    folder = "data/set-2/unmoved-with-x-pointing-forward-10min/"
    with h5py.File(io.BytesIO(archive.read_bytes(f"{folder}{file}.mat"))) as tables:
        return np.asarray(tables[name], np.float64)
