"""Reference of :mod:`relpos.fusion.initialisation.kernels`: a hypothesis's cost term by term."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from relpos.fusion.initialisation.kernels import (
    BIAS_VARIANCE_M2,
    OUTLIER_FRACTION,
    OUTLIER_VARIANCE_M2,
    PER_NODE,
    SCALE_VARIANCE,
    Problem,
)

Floats = npt.NDArray[np.float64]


def pose_at(
    block: Floats, track: Floats, segment: int, knots: Floats
) -> tuple[npt.NDArray[np.complex128], float]:
    """Place (complex, as a scalar array) and heading of a node at one time.

    block (4 + K,): its parameters; track (3,): the dead-reckoned pose then as seen from now;
    knots (K + 1, 2): from now back. Every piece between two knots is turned by all turns since.
    """
    corners = [complex(*k) for k in knots[: segment + 1]] + [complex(track[0], track[1])]
    heading = block[2] + np.concatenate(([0.0], np.cumsum(block[PER_NODE : PER_NODE + segment])))
    pieces = np.diff(np.array(corners))
    place = complex(block[0], block[1]) + np.exp(block[3]) * (np.exp(1j * heading) @ pieces)
    return np.asarray(place), float(heading[-1] + track[2])


def cost(parameters: Floats, problem: Problem) -> float:
    """-2 log posterior of one hypothesis, as of ``kernels.normal_equations``."""
    tracks, priors, ranges, _ = problem
    nodes = tracks.poses.shape[1]
    blocks = parameters[:-1].reshape(nodes, -1)
    bias = parameters[-1]
    total = bias**2 / BIAS_VARIANCE_M2 + (blocks[:, 3] ** 2 / SCALE_VARIANCE).sum()
    total += (blocks[:, PER_NODE:].T ** 2 / tracks.turn_variance).sum()

    def pose(node: int, time: int) -> tuple[complex, float]:
        place, heading = pose_at(
            blocks[node],
            tracks.poses[time, node],
            int(tracks.segments[time, node]),
            tracks.knots[:, node],
        )
        return complex(place), heading

    for i in range(nodes):
        place, heading = pose(i, int(priors.at[i]))
        off = priors.mean[i] - (place.real, place.imag, heading)
        off[2] = np.angle(np.exp(1j * off[2]))
        total += (priors.precision[i] * off**2).sum()
    for (a, b), time, range_m, variance, height_m2, disc, place in zip(*ranges, strict=True):
        first = pose(a, time)[0] if a >= 0 else complex(*place[0])
        second = pose(b, time)[0] if b >= 0 else complex(*place[1])
        off = second - first
        if disc:
            spread = 0.5 * range_m**2 + variance
            total += _mixture(off.real, spread) + _mixture(off.imag, spread)
        else:
            distance = np.sqrt(abs(off) ** 2 + height_m2) + 1e-6
            total += _mixture(range_m - distance - bias, variance)
    return float(total)


def _mixture(off: float, variance: float) -> float:
    wide = variance + OUTLIER_VARIANCE_M2
    near = (1.0 - OUTLIER_FRACTION) * np.exp(-0.5 * off**2 / variance)
    far = OUTLIER_FRACTION * np.sqrt(variance / wide) * np.exp(-0.5 * off**2 / wide)
    return float(-2.0 * np.log(near + far))
