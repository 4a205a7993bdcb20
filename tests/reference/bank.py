"""The bank's small kernels in NumPy and plain Python."""

from __future__ import annotations

import math
from statistics import median

import numpy as np
import numpy.typing as npt

from relpos.fusion.estimator import ANY_ANGLE_RAD
from relpos.fusion.models import odometry_faults as slips
from relpos.fusion.models.motion_variances import (
    ALONG,
    ALONG_M2_M,
    COMPONENTS,
    SLOW_RAD_S,
    TURN,
    TURN_RAD2_RAD,
    WHITE,
    WHITE_RAD2_S,
)

Floats = npt.NDArray[np.float64]

PER_NODE = 5


def base_variances(
    dx: Floats, dy: Floats, dtheta: Floats, duration: Floats, sigmas: Floats
) -> Floats:
    """Bases (M, 3) of displacements (M,); ``sigmas`` (M, 3) NaN where a report brings none."""
    way = np.hypot(dx, dy)
    moving = (way > 0.0) | (dtheta != 0.0)
    base = np.empty((len(way), COMPONENTS))
    base[:, ALONG] = ALONG_M2_M * way
    # A turn is what turns fast: slow changes of the heading are mostly its white noise.
    size = np.abs(dtheta)
    fourth = size**4
    base[:, TURN] = TURN_RAD2_RAD * size * fourth / (fourth + (SLOW_RAD_S * duration) ** 4 + 1e-300)
    base[:, WHITE] = WHITE_RAD2_S * duration * moving
    result = ~np.isnan(sigmas)
    if result.any():
        own = np.where(result, sigmas, 0.0) ** 2
        base[:, ALONG] = np.where(result[:, 0], np.maximum(own[:, 0], own[:, 1]), base[:, ALONG])
        base[:, TURN] = np.where(result[:, 2], 0.0, base[:, TURN])
        base[:, WHITE] = np.where(result[:, 2], own[:, 2], base[:, WHITE])
    return base


def nonlinearity_index(
    mean: Floats, covariance: Floats, sigma_range_m: float, sigma_metre_m: Floats
) -> float:
    """Return the nonlinearity index by the mixture's moments (D,) and (D, D).

    ``sigma_metre_m`` (N,) is how noisy the length of a metre is that each user walks.
    """
    nodes = len(sigma_metre_m)
    at = PER_NODE * np.arange(nodes)
    heading = np.maximum(covariance[at + 2, at + 2], 0.0)
    shorter = float((0.5 * heading / sigma_metre_m).max(initial=0.0))
    if nodes < 2:
        return shorter
    a, b = np.triu_indices(nodes, 1)
    i, j = at[a], at[b]

    def apart(r: int, s: int) -> Floats:
        off: Floats = (
            covariance[i + r, i + s] + covariance[j + r, j + s]
            - covariance[i + r, j + s] - covariance[j + r, i + s]
        )  # fmt: skip
        return off

    xx, yy, xy = apart(0, 0), apart(1, 1), apart(0, 1)
    ux, uy = mean[j] - mean[i], mean[j + 1] - mean[i + 1]
    distance2 = np.maximum(ux * ux + uy * uy, 1e-6)
    across = (uy * uy * xx - 2.0 * ux * uy * xy + ux * ux * yy) / distance2
    arcs = np.maximum(across, 0.0) / (2.0 * np.sqrt(distance2))
    nearest = np.full(nodes, np.inf)
    place = np.maximum(xx + yy, 0.0)
    np.minimum.at(nearest, a, place)
    np.minimum.at(nearest, b, place)
    ways = 0.5 * np.sqrt(nearest * heading)
    return max(float(max(arcs.max(), ways.max())) / sigma_range_m, shorter)


def update_cusum(
    sums: list[float],
    base: float,
    pairs: list[tuple[int, int]],
    square: list[float],
    worth: list[float],
    outliers: float,
    alarm: float,
) -> tuple[list[float], float, int]:
    """One step of the cumulative sums: those, the usual nu^2/S, and who slipped or -1."""
    usual = min(max(base, slips.BASE_LEAST), slips.BASE_MOST)
    rise, fall = 0.5 * (1.0 - 1.0 / slips.GROWN) / usual, 0.5 * math.log(slips.GROWN)
    delta = [min(rise * one - fall, slips.CLIP) for one in square]
    if max(sums) < 0.25 * slips.ALARM:
        for one in square:
            base += slips.BASE_SHARE * (min(one, 4.0) - base)
    after = []
    for row, so_far in enumerate(sums):
        own = [k for k, pair in enumerate(pairs) if row in pair]
        if not own:
            after.append(so_far)
            continue
        half = max(len(own) // 2, 1)
        count = min(3.0 * sum(worth[k] for k in own), half)
        added = count * median(delta[k] for k in own) - slips.CLIP * outliers * half
        after.append(max(so_far + added, 0.0))
    ranged = {row for pair in pairs for row in pair}
    row = max(sorted(ranged), key=lambda row: after[row])
    if after[row] < alarm:
        return after, base, -1
    return [0.0] * len(sums), base, row


def bearings(mean: Floats, covariance: Floats, rows: list[int]) -> Floats:
    """Bearing and its deviation (P, 2) of every two users, by rotation."""
    result = []
    for n, a in enumerate(rows):
        for b in rows[n + 1 :]:
            i, j = PER_NODE * a, PER_NODE * b
            off = mean[j : j + 2] - mean[i : i + 2]
            own = covariance[i : i + 2, i : i + 2] + covariance[j : j + 2, j : j + 2]
            spread = own - covariance[i : i + 2, j : j + 2] - covariance[j : j + 2, i : i + 2]
            distance = float(np.hypot(*off))
            if distance == 0.0:
                result.append((0.0, ANY_ANGLE_RAD))
                continue
            aside = np.array([-off[1], off[0]]) / distance
            bearing_sd = math.sqrt(aside @ spread @ aside) / distance
            result.append((math.atan2(off[1], off[0]), min(bearing_sd, ANY_ANGLE_RAD)))
    return np.array(result).reshape(-1, 2)


def rigid_motion(x: Floats, nodes: int, middle_m: Floats) -> Floats:
    """G (D, 3): the change of a state (D,) with a small rigid motion about a point (2,)."""
    g = np.zeros((x.size, 3))
    for n in range(nodes):
        at = PER_NODE * n
        g[at : at + 3] = np.eye(3)
        g[at : at + 2, 2] = middle_m[1] - x[at + 1], x[at] - middle_m[0]
    return g
