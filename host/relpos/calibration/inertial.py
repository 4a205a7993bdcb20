"""Gyroscope bias and accelerometer bias and scale from a node at rest on several sides.

Gyroscope: its rate at rest is the bias (including the Earth's 0.004 deg/s).

Accelerometer: at rest |(force - bias) (1 + scale)| = g whatever the attitude, the six-parameter
calibration (for example Frosio, Pedersini and Borghese 2009, IEEE Trans. Instrum. Meas. 58(6)).
Six attitudes or more, on different sides, determine it; with three to five the scale is left at
one and the bias alone is fitted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from relpos.errors import DataError

FloatArray = NDArray[np.float64]

STANDARD_GRAVITY_M_S2 = 9.80665
"""Gravity differs from it by 0.3 % over the Earth: less than the accelerometer's scale."""

STILL_RATE_RAD_S = math.radians(0.35)
"""Spread of the mean rates of successive reports up to which a node counts as lying still: on a
table 0.02 deg/s, worn by a person who stands quietly 0.8 (docs/deadreckoning.md)."""
STILL_FORCE_M_S2 = 0.05
MIN_STILL_S = 3.0
MIN_POSE_S = 1.0
TEMPERATURE_SIGMA_RAD_S = math.radians(0.1)
"""Change of the gyroscope's bias between calibration and walk. The data sheet's
20 deg/s over the whole temperature range make 0.2 deg/s a kelvin at worst; a warm node varies by
less than a kelvin. Not verified on hardware."""
MAX_GYRO_BIAS_RAD_S = math.radians(40.0)
POSE_APART_RAD = math.radians(25.0)
"""Attitudes closer than this count as one."""
FORCE_OFF = 0.2
"""Share of gravity by which an attitude's force may be off: more is no sensor at rest."""
MIN_POSES = 3
POSES_FOR_SCALE = 6
MAX_BIAS_SIGMA_M_S2 = 0.05
MAX_SCALE_SIGMA = 0.005
FORCE_SIGMA_M_S2 = 0.01
"""Of one attitude's mean: noise, and the cross-axis terms that the model leaves out (0.5 % of
gravity in the worst attitude, less on the faces)."""


@dataclass(frozen=True)
class GyroFit:
    """Bias (3,) and its standard deviation (3,) from ``still_s`` of lying still.

    ``sigma_rad_s`` is the standard deviation in use: that of the fit and of the temperature.
    """

    bias_rad_s: FloatArray
    deviation_rad_s: FloatArray
    still_s: float

    @property
    def sigma_rad_s(self) -> float:
        """Standard deviation of the bias that remains, for the node's filter."""
        return math.hypot(float(np.max(self.deviation_rad_s)), TEMPERATURE_SIGMA_RAD_S)


def fit_gyro(rate_rad_s: FloatArray, duration_s: FloatArray) -> GyroFit:
    """Return the bias from mean rates (n, 3) over reports of ``duration_s`` (n,) at rest.

    DataError where the rest is too short, the node moved, or the bias is implausible.
    """
    total_s = float(duration_s.sum())
    if len(rate_rad_s) < 5 or total_s < MIN_STILL_S:
        raise DataError(
            f"{total_s:.1f} s at rest are too short for the gyroscope, {MIN_STILL_S:g} s are needed"
        )
    weights = duration_s / total_s
    bias = weights @ rate_rad_s
    spread = np.sqrt(weights @ (rate_rad_s - bias) ** 2)
    if float(np.max(spread)) > STILL_RATE_RAD_S:
        raise DataError(
            f"the node moved: its rate varied by {math.degrees(float(np.max(spread))):.1f} deg/s. "
            "Lay it on a firm surface and do not touch it"
        )
    if float(np.max(np.abs(bias))) > MAX_GYRO_BIAS_RAD_S:
        raise DataError(
            f"a gyroscope bias of {math.degrees(float(np.max(np.abs(bias)))):.0f} deg/s: the "
            "node turned steadily, or the sensor is broken"
        )
    return GyroFit(bias, spread / math.sqrt(len(rate_rad_s)), total_s)


@dataclass(frozen=True)
class Pose:
    """A still attitude: mean specific force (3,) over ``duration_s``."""

    force_m_s2: FloatArray
    duration_s: float


def still_stretches(
    force_m_s2: FloatArray, rate_rad_s: FloatArray, duration_s: FloatArray
) -> list[slice]:
    """Return stretches of successive reports in which neither force nor rate changes.

    Mean forces and rates (n, 3) over reports of ``duration_s`` (n,). A stretch ends before the
    report that leaves its running mean; those shorter than MIN_POSE_S are dropped, and so are the
    first and the last report of each, which may hold half a movement.
    """
    found: list[slice] = []
    begin = 0
    for k in range(1, len(force_m_s2) + 1):
        if k < len(force_m_s2):
            force = force_m_s2[begin:k].mean(axis=0)
            rate = rate_rad_s[begin:k].mean(axis=0)
            if (
                float(np.max(np.abs(force_m_s2[k] - force))) <= 3.0 * STILL_FORCE_M_S2
                and float(np.max(np.abs(rate_rad_s[k] - rate))) <= 3.0 * STILL_RATE_RAD_S
            ):
                continue
        inner = slice(begin + 1, k - 1)
        if float(duration_s[inner].sum()) >= MIN_POSE_S:
            found.append(inner)
        begin = k
    return found


def poses(force_m_s2: FloatArray, rate_rad_s: FloatArray, duration_s: FloatArray) -> list[Pose]:
    """Return the different attitudes at rest in order of time, of a repeated one the longest.

    Arguments as of :func:`still_stretches`. Both force and rate must be free of motion: a steady
    turn shows a rate that no other stretch shows, and is dropped; so is a force unlike gravity.
    """
    stretches = still_stretches(force_m_s2, rate_rad_s, duration_s)
    if not stretches:
        return []
    rates = np.array([rate_rad_s[s].mean(axis=0) for s in stretches])
    resting = np.median(rates, axis=0)
    kept: list[Pose] = []
    for stretch, rate in zip(stretches, rates, strict=True):
        if float(np.max(np.abs(rate - resting))) > 3.0 * STILL_RATE_RAD_S:
            continue
        weights = duration_s[stretch]
        pose = Pose(weights @ force_m_s2[stretch] / weights.sum(), float(weights.sum()))
        if abs(float(np.linalg.norm(pose.force_m_s2)) / STANDARD_GRAVITY_M_S2 - 1.0) > FORCE_OFF:
            continue
        for k, other in enumerate(kept):
            if _angle_rad(pose.force_m_s2, other.force_m_s2) < POSE_APART_RAD:
                kept[k] = max(pose, other, key=lambda one: one.duration_s)
                break
        else:
            kept.append(pose)
    return kept


def _angle_rad(a: FloatArray, b: FloatArray) -> float:
    cosine = float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b))
    return math.acos(max(-1.0, min(1.0, cosine)))


@dataclass(frozen=True)
class AccelerometerFit:
    """Bias (3,) and scale (3,) with (force - bias) (1 + scale) = specific force.

    ``partial``: the scale was left at zero.
    ``residual_before_m_s2`` and ``residual_m_s2`` are RMS of |force| - g over the attitudes.
    """

    bias_m_s2: FloatArray
    scale: FloatArray
    residual_before_m_s2: float
    residual_m_s2: float
    attitudes: int
    partial: bool


def fit_accelerometer(attitudes: list[Pose]) -> AccelerometerFit:
    """Fit attitudes at rest; DataError where they are too few or too similar."""
    if len(attitudes) < MIN_POSES:
        raise DataError(
            f"{len(attitudes)} attitudes at rest do not determine the accelerometer's bias: "
            f"{POSES_FOR_SCALE} are needed (each side down once), {MIN_POSES} for the bias alone"
        )
    forces = np.array([pose.force_m_s2 for pose in attitudes])
    partial = len(attitudes) < POSES_FOR_SCALE
    free = 3 if partial else 6

    def misfits(parameters: FloatArray) -> FloatArray:
        scale = np.zeros(3) if partial else parameters[3:]
        corrected = (forces - parameters[:3]) * (1.0 + scale)
        return np.asarray(np.linalg.norm(corrected, axis=1) - STANDARD_GRAVITY_M_S2)

    solution = scipy.optimize.least_squares(misfits, np.zeros(free))
    info = solution.jac.T @ solution.jac / FORCE_SIGMA_M_S2**2
    if np.linalg.cond(info) > 1e10:
        raise _too_similar()
    sigma = np.sqrt(np.diag(np.linalg.inv(info)))
    scale = np.zeros(3) if partial else solution.x[3:]
    sigma_scale = np.zeros(3) if partial else sigma[3:]
    if float(np.max(sigma[:3])) > MAX_BIAS_SIGMA_M_S2 or (
        float(np.max(sigma_scale)) > MAX_SCALE_SIGMA
    ):
        raise _too_similar()
    rest = misfits(solution.x)
    return AccelerometerFit(
        bias_m_s2=solution.x[:3],
        scale=scale,
        residual_before_m_s2=float(
            np.sqrt(np.mean((np.linalg.norm(forces, axis=1) - STANDARD_GRAVITY_M_S2) ** 2))
        ),
        residual_m_s2=float(np.sqrt(np.mean(rest**2))),
        attitudes=len(attitudes),
        partial=partial,
    )


def _too_similar() -> DataError:
    return DataError(
        "the attitudes at rest are too similar for the accelerometer's bias: lay the node "
        "on each of its six sides"
    )
