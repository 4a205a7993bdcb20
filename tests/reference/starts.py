"""NumPy twin of :mod:`relpos.fusion.initialisation.kernels`: the cost of one picture, term by
term."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from relpos.fusion.initialisation.kernels import FIXED, OUTLIER_SHARE, OUTLIER_VARIANCE_M2

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]


def pose_at(
    block: Floats, track: Floats, segment: int, knots: Floats
) -> tuple[npt.NDArray[np.complex128], float]:
    """Place (complex, as a scalar array) and heading of a node at one time.

    block (4 + K,): its parameters; track (3,): the dead-reckoned pose then as seen from now;
    knots (K + 1, 2): from now back. Every piece between two knots is turned by all turns since.
    """
    corners = [complex(*k) for k in knots[: segment + 1]] + [complex(track[0], track[1])]
    heading = block[2] + np.concatenate(([0.0], np.cumsum(block[FIXED : FIXED + segment])))
    pieces = np.diff(np.array(corners))
    place = complex(block[0], block[1]) + np.exp(block[3]) * (np.exp(1j * heading) @ pieces)
    return np.asarray(place), float(heading[-1] + track[2])


def cost(
    picture: Floats,
    tracks: Floats,
    segments: Indices,
    knots: Floats,
    turn_variance: Floats,
    prior_at: Indices,
    prior: Floats,
    scale_variance: Floats,
    bias_variance: float,
    ends: Indices,
    at: Indices,
    measured: Floats,
    places: Floats,
) -> float:
    """-2 log posterior of one picture; arguments as of ``starts_kernels.normal_equations``."""
    nodes = tracks.shape[1]
    blocks = picture[:-1].reshape(nodes, -1)
    bias = picture[-1]
    total = bias**2 / bias_variance + (blocks[:, 3] ** 2 / scale_variance).sum()
    total += (blocks[:, FIXED:].T ** 2 / turn_variance).sum()

    def pose(node: int, time: int) -> tuple[complex, float]:
        place, heading = pose_at(
            blocks[node], tracks[time, node], int(segments[time, node]), knots[:, node]
        )
        return complex(place), heading

    for i in range(nodes):
        place, heading = pose(i, int(prior_at[i]))
        off = prior[0, i] - (place.real, place.imag, heading)
        off[2] = np.angle(np.exp(1j * off[2]))
        total += (prior[1, i] * off**2).sum()
    for (a, b), time, (range_m, variance, height_m2, disc), place in zip(
        ends, at, measured, places, strict=True
    ):
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
    near = (1.0 - OUTLIER_SHARE) * np.exp(-0.5 * off**2 / variance)
    far = OUTLIER_SHARE * np.sqrt(variance / wide) * np.exp(-0.5 * off**2 / wide)
    return float(-2.0 * np.log(near + far))
