"""Progress and result of a sensor calibration from raw samples in any order.

Rest gives the gyroscope's bias, six attitudes the accelerometer's, readings in all directions the
magnetometer's ellipsoid. The samples themselves show to which part they belong, so that the steps
may come in any order and repeatedly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from relpos.calibration import inertial, magnetometer
from relpos.calibration.sensors import SensorCalibration
from relpos.errors import DataError
from relpos.measurements import RawSample

FloatArray = NDArray[np.float64]

SAMPLE_S = 0.02
"""The firmware's inertial samples come at 50 Hz."""
STILL_S = 6.0
"""Leaves 0.02 deg/s of noise in the gyroscope's bias, less than its temperature causes."""
COVERAGE = 0.9
READINGS = 300
"""A minute at five a second: the worst direction is then known to half a percent."""


@dataclass(frozen=True)
class Samples:
    """Raw samples as arrays: force and rate (n, 3), field (n, 3; NaN where none), seconds (n,)."""

    force_m_s2: FloatArray
    rate_rad_s: FloatArray
    field_ut: FloatArray
    duration_s: FloatArray


def gather(samples: Sequence[RawSample]) -> Samples:
    """Return the samples with inertial data as arrays."""
    missing = (np.nan, np.nan, np.nan)
    kept = [s for s in samples if s.acceleration_m_s2]
    return Samples(
        np.array([s.acceleration_m_s2 for s in kept]).reshape(-1, 3),
        np.array([s.angular_rate_rad_s for s in kept]).reshape(-1, 3),
        np.array([s.magnetic_field_ut or missing for s in kept]).reshape(-1, 3),
        np.array([s.samples * SAMPLE_S for s in kept]),
    )


@dataclass(frozen=True)
class Progress:
    """Seconds of the longest rest, attitudes, fraction of directions, and readings so far."""

    still_s: float
    attitudes: int
    coverage: float
    readings: int

    def done(self, *, with_magnetometer: bool) -> bool:
        """Return whether the samples are sufficient."""
        inertial_done = self.still_s >= STILL_S and self.attitudes >= inertial.POSES_FOR_SCALE
        turned = self.coverage >= COVERAGE and self.readings >= READINGS
        return inertial_done and (turned or not with_magnetometer)


def _longest_rest(data: Samples) -> slice | None:
    rests = inertial.still_stretches(data.force_m_s2, data.rate_rad_s, data.duration_s)
    return max(rests, key=lambda s: float(data.duration_s[s].sum()), default=None)


def _fields(data: Samples) -> FloatArray:
    return np.asarray(data.field_ut[np.isfinite(data.field_ut).all(axis=1)])


def progress(samples: Sequence[RawSample]) -> Progress:
    """Return the progress of the samples so far."""
    data = gather(samples)
    rest = _longest_rest(data)
    fields = _fields(data)
    covered = 0.0
    if len(fields) >= 2:
        covered = magnetometer.coverage(fields - magnetometer.centre_guess(fields))
    return Progress(
        0.0 if rest is None else float(data.duration_s[rest].sum()),
        len(inertial.poses(data.force_m_s2, data.rate_rad_s, data.duration_s)),
        covered,
        len(fields),
    )


@dataclass(frozen=True)
class Result:
    """The calibration and its fits."""

    calibration: SensorCalibration
    gyro: inertial.GyroFit
    accelerometer: inertial.AccelerometerFit | None
    magnetometer: magnetometer.MagnetometerFit | None
    fields_ut: FloatArray
    """Readings (n, 3) that the magnetometer's fit used."""
    remarks: tuple[str, ...]
    """What was not calibrated, and why."""


def solve(
    samples: Sequence[RawSample],
    before: SensorCalibration | None = None,
    *,
    with_magnetometer: bool = True,
) -> Result:
    """Fit gyroscope, accelerometer and magnetometer; what is not fitted stays as ``before``.

    DataError, with a remedy, where the node never lay still or the magnetometer cannot be fitted;
    with too few attitudes the accelerometer stays as it is, with a remark.
    """
    data = gather(samples)
    rest = _longest_rest(data)
    if rest is None:
        raise DataError(
            "the node never lay still: put it on a firm surface for ten seconds without touching it"
        )
    gyro = inertial.fit_gyro(data.rate_rad_s[rest], data.duration_s[rest])
    remarks: list[str] = []
    accelerometer: inertial.AccelerometerFit | None = None
    try:
        accelerometer = inertial.fit_accelerometer(
            inertial.poses(data.force_m_s2, data.rate_rad_s, data.duration_s)
        )
    except DataError as error:
        remarks.append(f"accelerometer not calibrated: {error}")
    still = replace(
        before or SensorCalibration(),
        gyro_bias_rad_s=gyro.bias_rad_s,
        gyro_bias_sigma_rad_s=gyro.sigma_rad_s,
        **(
            {}
            if accelerometer is None
            else {
                "acceleration_bias_m_s2": accelerometer.bias_m_s2,
                "acceleration_scale": accelerometer.scale,
            }
        ),
    )
    fields = _fields(data)
    if not with_magnetometer:
        return Result(still, gyro, accelerometer, None, fields, tuple(remarks))
    up = still.correct_acceleration(data.force_m_s2)
    fit = magnetometer.fit(data.field_ut, up)
    calibration = replace(still, field_offset_ut=fit.offset_ut, field_matrix=fit.matrix)
    return Result(calibration, gyro, accelerometer, fit, fields, tuple(remarks))
