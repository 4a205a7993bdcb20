"""Hard and soft iron from readings in many directions.

In a uniform field the readings of a perfect magnetometer lie on a sphere. Magnetised iron on the
node (hard iron) moves its centre; soft iron and the sensor's own errors make it an ellipsoid:

    reading = offset + M^-1 R field,   |M (reading - offset)| = |field|

1. The best sphere starts. Least squares of the first-order geometric distance, (|M d| - r) /
   |grad|, over centre and symmetric M: maximum likelihood where the sensor's noise is white and
   alike in all axes. The loss is Huber's, against a few readings beside steel: twice, because the
   distances from a sphere do not show yet which readings these are.
2. The norm alone does not determine the rotation of M. Gravity does: the field's dip is the same
   in every attitude, so up . (Q M d) must be one number for all readings, which gives the rotation
   Q. Without it the sphere would be round, but the *heading* wrong.

det M = 1 keeps the field's norm in microtesla: the true strength is unknown, and the mean semi-axis
is its best estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from relpos.errors import DataError

FloatArray = NDArray[np.float64]

DIRECTIONS = 60
"""Equal patches of the sphere by which coverage is counted: 30 degrees across."""
MIN_READINGS = 60
MIN_COVERAGE = 0.6
"""Of the patches. A band around the equator (a node turned about one axis only) fills 30 to 40 %,
two bands 60 %; the guide asks for more."""
MIN_EARTH_UT, MAX_EARTH_UT = 20.0, 75.0
"""The Earth's field is 22 to 67 uT; the firmware takes no reading outside this."""
MAX_RESIDUAL = 0.05
"""RMS distance from the ellipsoid over its radius. Noise makes 1 %, a non-uniform field more:
such a fit would carry the disturbance of one place to all others."""
MAX_UNCERTAINTY = 0.02
"""Of a corrected reading in the worst direction, over the radius: 1 degree of heading."""
MAX_CONDITION = 3.0
"""Longest over shortest semi-axis. Worse is a node beside a magnet, or no ellipsoid at all."""
MAX_MISALIGNMENT_RAD = math.radians(20.0)
ALIGNED_WITHIN_RAD = math.radians(1.0)
"""A rotation with a larger standard deviation is ignored."""
QUASI_STATIC = 0.05
"""Relative deviation of |force| from gravity up to which the accelerometer shows the vertical."""


@dataclass(frozen=True)
class MagnetometerFit:
    """``matrix @ (reading - offset_ut)`` is the field, ``radius_ut`` its mean norm.

    ``residual`` is the RMS of norm / radius - 1 after, ``residual_before`` of norm / mean norm - 1
    without any calibration. ``uncertainty`` is the standard deviation of a corrected reading in the
    worst direction, over the radius, from the parameters alone. ``dip_rad`` is how far the field
    points below the horizon; None where gravity was not given or is not sufficient.
    """

    offset_ut: FloatArray
    matrix: FloatArray
    radius_ut: float
    residual: float
    residual_before: float
    uncertainty: float
    coverage: float
    readings: int
    dip_rad: float | None = None

    def correct(self, field_ut: FloatArray) -> FloatArray:
        """Corrected readings (n, 3)."""
        corrected: FloatArray = (field_ut - self.offset_ut) @ self.matrix.T
        return corrected


def _directions() -> FloatArray:
    """Unit vectors (DIRECTIONS, 3), evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(DIRECTIONS) + 0.5
    z = 1.0 - 2.0 * k / DIRECTIONS
    angle = np.pi * (1.0 + math.sqrt(5.0)) * k
    level = np.sqrt(1.0 - z * z)
    return np.column_stack((level * np.cos(angle), level * np.sin(angle), z))


_PATCHES = _directions()


def visited(vectors: FloatArray) -> NDArray[np.bool_]:
    """Return which patches of the sphere (DIRECTIONS,) contain one of the vectors (n, 3)."""
    seen = np.zeros(DIRECTIONS, dtype=np.bool_)
    norms = np.linalg.norm(vectors, axis=1)
    good = norms > 0.0
    if good.any():
        seen[np.argmax(vectors[good] @ _PATCHES.T, axis=1)] = True
    return seen


def coverage(vectors: FloatArray) -> float:
    """Return the fraction of the sphere's patches that contain one of the vectors (n, 3)."""
    return float(visited(vectors).mean())


def centre_guess(field_ut: FloatArray) -> FloatArray:
    """Centre (3,) of the best sphere, if it is one.

    Least squares of |x|^2 = 2 c . x + const, held to the readings' own box where they are few.
    """
    low, high = field_ut.min(axis=0), field_ut.max(axis=0)
    middle = 0.5 * (low + high)
    shifted = field_ut - middle
    design = np.column_stack((2.0 * shifted, np.ones(len(shifted))))
    solution = np.linalg.lstsq(design, (shifted**2).sum(axis=1), rcond=1e-3)[0]
    return np.asarray(np.clip(middle + solution[:3], low, high))


def fit(field_ut: FloatArray, up: FloatArray | None = None) -> MagnetometerFit:
    """Fit readings (n, 3) in microtesla; ``up`` (n, 3) turns the result into gravity's axes.

    ``up`` is the specific force at the same moments in the same axes, NaN where it is unknown.
    Raises DataError, with a remedy, where the readings do not determine an ellipsoid: too few,
    too much of the sphere unseen, a field that is not uniform, or no Earth's field.
    """
    good = np.isfinite(field_ut).all(axis=1)
    readings = field_ut[good]
    if len(readings) < MIN_READINGS:
        raise DataError(
            f"{len(readings)} magnetometer readings are too few, at least {MIN_READINGS} are "
            "needed: turn the node for a minute"
        )
    if float(np.linalg.norm(readings - readings.mean(axis=0), axis=1).mean()) < 1.0:
        raise DataError("the magnetometer readings do not change: turn the node in all directions")
    offset, matrix, radius, uncertainty = _ellipsoid(readings)
    corrected = (readings - offset) @ matrix.T
    norms = np.linalg.norm(corrected, axis=1)
    raw = np.linalg.norm(readings, axis=1)
    result = MagnetometerFit(
        offset_ut=offset,
        matrix=matrix,
        radius_ut=radius,
        residual=float(np.sqrt(np.mean((norms / radius - 1.0) ** 2))),
        residual_before=float(np.std(raw) / np.mean(raw)),
        uncertainty=uncertainty,
        coverage=coverage(corrected),
        readings=len(readings),
    )
    _check(result)
    if up is None:
        return result
    return _aligned(result, readings, up[good])


def _check(result: MagnetometerFit) -> None:
    if result.coverage < MIN_COVERAGE:
        raise DataError(
            f"only {100 * result.coverage:.0f} % of the directions were seen, at least "
            f"{100 * MIN_COVERAGE:.0f} % are needed: point each side of the node up, down and "
            "all around"
        )
    axes = np.linalg.svd(result.matrix, compute_uv=False)
    if axes[0] / axes[-1] > MAX_CONDITION:
        raise DataError(
            f"the readings make an ellipsoid {axes[0] / axes[-1]:.1f} times as long as wide: "
            "iron or a magnet is close to the sensor, or the field changed meanwhile"
        )
    if result.residual > MAX_RESIDUAL:
        raise DataError(
            f"the readings lie {100 * result.residual:.0f} % of the field off the best ellipsoid, "
            f"at most {100 * MAX_RESIDUAL:.0f} % are acceptable: the field is not uniform here; go "
            "outside or away from steel, and turn the node on the spot"
        )
    if result.uncertainty > MAX_UNCERTAINTY:
        raise DataError(
            f"a corrected field would still be uncertain by {100 * result.uncertainty:.1f} % in "
            f"the worst direction, at most {100 * MAX_UNCERTAINTY:.0f} % are acceptable: turn the "
            "node longer and in all directions"
        )
    if not MIN_EARTH_UT <= result.radius_ut <= MAX_EARTH_UT:
        raise DataError(
            f"the corrected field is {result.radius_ut:.0f} uT strong, the Earth's is 22 to 67: "
            "a magnet is close by, or the sensor's scale is wrong"
        )


def _no_ellipsoid() -> DataError:
    return DataError(
        "the readings lie on no ellipsoid: turn the node in all directions, not about one axis"
    )


_SYMMETRIC = np.triu_indices(3)


def _symmetric(six: FloatArray) -> FloatArray:
    matrix = np.zeros((3, 3))
    matrix[_SYMMETRIC] = six
    return matrix + np.triu(matrix, 1).T


def _ellipsoid(readings: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
    """Return centre, matrix of determinant 1, radius and the worst uncertainty."""
    centre = centre_guess(readings)
    radius = float(np.linalg.norm(readings - centre, axis=1).mean())

    def distances(parameters: FloatArray) -> FloatArray:
        matrix = _symmetric(parameters[3:])
        d = (readings - parameters[:3] * radius) / radius
        u = d @ matrix
        norm = np.maximum(np.linalg.norm(u, axis=1), 1e-9)
        gradient = np.maximum(np.linalg.norm(u @ matrix, axis=1) / norm, 1e-9)
        return np.asarray((norm - 1.0) / gradient)

    found = np.concatenate((centre / radius, np.eye(3)[_SYMMETRIC]))
    for _ in range(2):
        spread = float(np.median(np.abs(distances(found)))) * 1.4826
        solution = scipy.optimize.least_squares(
            distances, found, loss="huber", f_scale=max(2.0 * spread, 1e-4), x_scale="jac"
        )
        found = solution.x
    offset, matrix = found[:3] * radius, _symmetric(found[3:])
    if np.min(np.linalg.eigvalsh(matrix)) <= 0.0:
        raise _no_ellipsoid()
    size = float(np.linalg.det(matrix) ** (1.0 / 3.0))
    # What the parameters' covariance does to a corrected reading, direction by direction.
    noise = float(np.mean(distances(found) ** 2)) * len(readings) / (len(readings) - 9)
    info = solution.jac.T @ solution.jac
    try:
        covariance = noise * np.linalg.inv(info)
    except np.linalg.LinAlgError as error:
        raise _no_ellipsoid() from error
    worst = 0.0
    for u in _PATCHES:
        d = np.linalg.solve(matrix, u)
        jacobian = np.zeros((3, 9))
        jacobian[:, :3] = -matrix
        for k, (i, j) in enumerate(zip(*_SYMMETRIC, strict=True)):
            jacobian[i, 3 + k] += d[j]
            if i != j:
                jacobian[j, 3 + k] += d[i]
        spread_here = jacobian @ covariance @ jacobian.T
        worst = max(worst, float(np.max(np.linalg.eigvalsh(spread_here))))
    return offset, matrix / size, radius / size, math.sqrt(worst)


def _aligned(result: MagnetometerFit, readings: FloatArray, up: FloatArray) -> MagnetometerFit:
    """Turn the fit so that the field's dip is the same in every attitude.

    Unchanged where gravity was not seen from enough sides. DataError where the rotation is too
    large for a mounting error.
    """
    norms = np.linalg.norm(up, axis=1)
    typical = float(np.nanmedian(norms)) if np.isfinite(norms).any() else math.nan
    still = np.isfinite(norms) & (np.abs(norms - typical) < QUASI_STATIC * typical)
    if still.sum() < MIN_READINGS or coverage(up[still]) < MIN_COVERAGE:
        return result
    field = result.correct(readings[still]) / result.radius_ut
    vertical = up[still] / norms[still, None]

    def misfits(parameters: FloatArray) -> FloatArray:
        turned = scipy.spatial.transform.Rotation.from_rotvec(parameters[:3]).apply(field)
        return np.asarray((turned * vertical).sum(axis=1) - parameters[3])

    start = np.array([0.0, 0.0, 0.0, float(np.median((field * vertical).sum(axis=1)))])
    solution = scipy.optimize.least_squares(misfits, start, loss="huber", f_scale=0.05)
    noise = float(np.mean(misfits(solution.x) ** 2))
    try:
        sigma = np.sqrt(noise * np.diag(np.linalg.inv(solution.jac.T @ solution.jac)))
    except np.linalg.LinAlgError:
        return result
    if float(np.max(sigma[:3])) > ALIGNED_WITHIN_RAD:
        return result
    turned_rad = float(np.linalg.norm(solution.x[:3]))
    if turned_rad > MAX_MISALIGNMENT_RAD:
        raise DataError(
            f"magnetometer and accelerometer disagree by {math.degrees(turned_rad):.0f} degrees "
            "about directions: their axes differ from the firmware's"
        )
    rotation = scipy.spatial.transform.Rotation.from_rotvec(solution.x[:3]).as_matrix()
    return replace(
        result,
        matrix=rotation @ result.matrix,
        dip_rad=-math.asin(max(-1.0, min(1.0, float(solution.x[3])))),
    )
