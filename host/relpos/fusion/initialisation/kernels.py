"""Kernels of the search for unknown starts: many rigid fits of tracks on ranges at once.

The unknowns of one fit ("picture") are, node by node, the present pose and what its dead
reckoning did wrong on the way here,

    x, y (m), heading (rad), log of true over reported length, turn_1 ... turn_K (rad)

and one range bias (m) common to all. ``turn_k`` is a heading error made at the node's k-th knot,
counted back from now: everything older than it is turned about the place of the knot. The
reference is the present pose, not the start, so that old data count less (their variance has
grown) and the answer needs no extrapolation.

A range is predicted as |p_i(t) - p_j(t)| + bias. Its error is a mixture of a Gaussian and a wider
one (outliers); Gauss-Newton takes both with their shares. Where a range is short against its
error a circle is no use to a linear solver: such a range says that the two nodes' difference is
normal about nought with variance range^2 / 2 + sigma^2 along each axis.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from relpos.fusion.compiled import compiled, inner

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

POSE = 3
FIXED = 4
"""x, y, heading, log scale; the turns follow."""

OUTLIER_SHARE = 0.05
OUTLIER_VARIANCE_M2 = 9.0
"""Outlier mixture: 5 % with 3 m, as everywhere."""

_FEW = 1e-12


@compiled
def normal_equations(
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
    hessian: Floats,
    gradient: Floats,
) -> float:
    """Fill the Gauss-Newton system of one picture, and return its cost, -2 log posterior.

    picture (D,), D = N (4 + K) + 1. tracks (T, N, 3): dead-reckoned poses at the ranges' times as
    seen from the present pose; segments (T, N): knots between then and now. knots (K + 1, N, 2):
    places of the knots seen likewise, the first being now. turn_variance (K, N) in rad^2.
    prior_at (N,), prior (2, N, 3): time, mean and precision (0: none) of what is known of a pose.
    ends (E, 2): node, or -1 where the end's place is given by places (E, 2, 2). measured (E, 4):
    range (m), variance (m^2), height difference squared (m^2), 1 where it is a disc.
    """
    nodes = tracks.shape[1]
    count = knots.shape[0] - 1
    each = FIXED + count
    dimension = picture.size
    # Loops in place of expressions of arrays, which take the compiler seconds.
    for i in range(dimension):
        gradient[i] = 0.0
        for j in range(dimension):
            hessian[i, j] = 0.0
    cost = 0.0
    offset = np.zeros((nodes, count + 1, 2))
    angle = np.zeros((nodes, count + 1))
    for i in range(nodes):
        base = i * each
        stretch = math.exp(picture[base + 3])
        angle[i, 0] = picture[base + 2]
        for k in range(count):
            c, s = stretch * math.cos(angle[i, k]), stretch * math.sin(angle[i, k])
            dx, dy = knots[k + 1, i, 0] - knots[k, i, 0], knots[k + 1, i, 1] - knots[k, i, 1]
            offset[i, k + 1, 0] = offset[i, k, 0] + c * dx - s * dy
            offset[i, k + 1, 1] = offset[i, k, 1] + s * dx + c * dy
            angle[i, k + 1] = angle[i, k] + picture[base + FIXED + k]
            precision = 1.0 / turn_variance[k, i]
            turn = float(picture[base + FIXED + k])
            cost += precision * turn * turn
            hessian[base + FIXED + k, base + FIXED + k] += precision
            gradient[base + FIXED + k] -= precision * turn
        precision = 1.0 / scale_variance[i]
        cost += precision * float(picture[base + 3]) ** 2
        hessian[base + 3, base + 3] += precision
        gradient[base + 3] -= precision * picture[base + 3]
    bias = float(picture[dimension - 1])
    cost += bias * bias / bias_variance
    hessian[dimension - 1, dimension - 1] += 1.0 / bias_variance
    gradient[dimension - 1] -= bias / bias_variance

    place = np.zeros((2, 2))
    slope = np.zeros((2, 2, each))
    row = np.zeros(2 * each + 1)
    column = np.zeros(2 * each + 1, dtype=np.intp)
    # No literal: what takes it would be compiled for it, and once more for other numbers.
    nought: int = np.intp(0)  # type: ignore[assignment]

    for i in range(nodes):
        if prior[1, i, 0] == 0.0 and prior[1, i, 2] == 0.0:
            continue
        base, t = i * each, prior_at[i]
        segment = segments[t, i]
        _place(picture, i, t, tracks, segment, knots, offset, angle, place, slope, nought)
        for a in range(3):
            precision = prior[1, i, a]
            if precision == 0.0:
                continue
            for q in range(each):
                row[q] = slope[0, a, q] if a < 2 else 0.0
            if a < 2:
                off = prior[0, i, a] - place[0, a]
            else:
                off = prior[0, i, 2] - (angle[i, segment] + tracks[t, i, 2])
                off -= 2.0 * math.pi * math.floor(off / (2.0 * math.pi) + 0.5)
                row[2] = 1.0
                for k in range(segment):
                    row[FIXED + k] = 1.0
            cost += precision * off * off
            for p in range(each):
                gradient[base + p] += precision * off * row[p]
                for q in range(each):
                    hessian[base + p, base + q] += precision * row[p] * row[q]

    for e in range(measured.shape[0]):
        t = at[e]
        used = nought
        for end in range(2):
            i = ends[e, end]
            if i < 0:
                place[end, 0], place[end, 1] = places[e, end, 0], places[e, end, 1]
            else:
                _place(
                    picture, i, t, tracks, segments[t, i], knots, offset, angle, place, slope, end
                )
                for q in range(each):
                    column[used + q] = i * each + q
                used += each
        dx, dy = place[1, 0] - place[0, 0], place[1, 1] - place[0, 1]
        variance = measured[e, 1]
        if measured[e, 3] > 0.0:
            spread = 0.5 * measured[e, 0] ** 2 + variance
            for a in range(2):
                off = -(dx if a == 0 else dy)
                used = nought
                for end in range(2):
                    if ends[e, end] >= 0:
                        sign = 1.0 if end == 1 else -1.0
                        for q in range(each):
                            row[used + q] = sign * slope[end, a, q]
                        used += each
                cost += _add(off, spread, row, column, used, hessian, gradient)
            continue
        distance = math.sqrt(dx * dx + dy * dy + measured[e, 2]) + 1e-6
        off = measured[e, 0] - distance - bias
        used = nought
        for end in range(2):
            if ends[e, end] >= 0:
                sign = 1.0 if end == 1 else -1.0
                ux, uy = sign * dx / distance, sign * dy / distance
                for q in range(each):
                    row[used + q] = ux * slope[end, 0, q] + uy * slope[end, 1, q]
                used += each
        row[used], column[used] = 1.0, dimension - 1
        cost += _add(off, variance, row, column, used + 1, hessian, gradient)
    return cost


@inner
def _place(
    picture: Floats,
    i: int,
    t: int,
    tracks: Floats,
    segment: int,
    knots: Floats,
    offset: Floats,
    angle: Floats,
    place: Floats,
    slope: Floats,
    end: int,
) -> None:
    """Place of node i at time index t and its derivatives, slope[end] (2, 4 + K)."""
    each = slope.shape[2]
    base = i * each
    stretch = math.exp(picture[base + 3])
    c, s = stretch * math.cos(angle[i, segment]), stretch * math.sin(angle[i, segment])
    dx, dy = tracks[t, i, 0] - knots[segment, i, 0], tracks[t, i, 1] - knots[segment, i, 1]
    x = offset[i, segment, 0] + c * dx - s * dy
    y = offset[i, segment, 1] + s * dx + c * dy
    place[end, 0], place[end, 1] = picture[base] + x, picture[base + 1] + y
    slope[end, 0, 0], slope[end, 1, 0] = 1.0, 0.0
    slope[end, 0, 1], slope[end, 1, 1] = 0.0, 1.0
    slope[end, 0, 2], slope[end, 1, 2] = -y, x
    slope[end, 0, 3], slope[end, 1, 3] = x, y
    for k in range(each - FIXED):
        if k < segment:
            slope[end, 0, FIXED + k] = -(y - offset[i, k + 1, 1])
            slope[end, 1, FIXED + k] = x - offset[i, k + 1, 0]
        else:
            slope[end, 0, FIXED + k] = 0.0
            slope[end, 1, FIXED + k] = 0.0


@inner
def _add(
    off: float,
    variance: float,
    row: Floats,
    column: Indices,
    used: int,
    hessian: Floats,
    gradient: Floats,
) -> float:
    """Add one residual of the outlier mixture; returns its cost."""
    wide = variance + OUTLIER_VARIANCE_M2
    near = (1.0 - OUTLIER_SHARE) * math.exp(-0.5 * off * off / variance)
    far = OUTLIER_SHARE * math.sqrt(variance / wide) * math.exp(-0.5 * off * off / wide)
    both = near + far + 1e-300
    weight = near / both / variance + far / both / wide
    for p in range(used):
        pull = weight * row[p]
        gradient[column[p]] += pull * off
        for q in range(p + 1):
            hessian[column[p], column[q]] += pull * row[q]
    return -2.0 * math.log(both)


@inner
def _factor(matrix: Floats, damping: float, factor: Floats) -> bool:
    """Cholesky of the lower triangle with its diagonal times 1 + damping."""
    for j in range(matrix.shape[0]):
        total = matrix[j, j] * (1.0 + damping) + _FEW
        for k in range(j):
            total -= factor[j, k] * factor[j, k]
        if not total > 0.0:
            return False
        root = math.sqrt(total)
        factor[j, j] = root
        for i in range(j + 1, matrix.shape[0]):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = total / root
    return True


@compiled
def fit(
    pictures: Floats,
    iterations: int,
    cap: Floats,
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
    costs: Floats,
    log_volume: Floats,
    covariances: Floats,
) -> None:
    """Levenberg-Marquardt on pictures (M, D), in place; costs (M,), log_volume (M,).

    ``log_volume`` is half the log determinant of a picture's covariance; ``covariances``
    (M, 3 N, 3 N) are those of the present poses. Along what the data leave open both end at
    ``cap`` (3 N,), standard deviations: one picture stands for a cell of that size.
    """
    dimension = pictures.shape[1]
    nodes = tracks.shape[1]
    each = FIXED + knots.shape[0] - 1
    hessian = np.zeros((dimension, dimension))
    trial_hessian = np.zeros((dimension, dimension))
    gradient, trial_gradient = np.zeros(dimension), np.zeros(dimension)
    factor = np.zeros((dimension, dimension))
    step = np.zeros(dimension)
    trial = np.zeros(dimension)
    for m in range(pictures.shape[0]):
        damping = 1e-3
        cost = math.inf
        for i in range(dimension):
            step[i] = 0.0
        # The first round only looks where it stands. (One call alone: it is compiled into here.)
        for rounds in range(iterations + 1):
            for i in range(dimension):
                trial[i] = pictures[m, i] + step[i]
            trial_cost = normal_equations(
                trial, tracks, segments, knots, turn_variance, prior_at, prior, scale_variance,
                bias_variance, ends, at, measured, places, trial_hessian, trial_gradient,
            )  # fmt: skip
            if trial_cost < cost:
                gain = cost - trial_cost
                cost = trial_cost
                for i in range(dimension):
                    pictures[m, i] = trial[i]
                hessian, trial_hessian = trial_hessian, hessian
                gradient, trial_gradient = trial_gradient, gradient
                if rounds > 0:
                    damping = max(0.2 * damping, 1e-6)
                if gain < 0.01:
                    break
            else:
                damping *= 8.0
                if damping > 1e6:
                    break
            while not _factor(hessian, damping, factor) and damping < 1e9:
                damping = max(damping * 10.0, 1e-6)
            _solve(factor, gradient, step)
            # A turn of more than this leaves the neighbourhood the system was made for.
            largest = 0.0
            for i in range(nodes):
                largest = max(largest, abs(step[i * each + 2]), 2.0 * abs(step[i * each + 3]))
            shrink = min(1.0, 0.7 / (largest + _FEW))
            for i in range(dimension):
                step[i] *= shrink
        costs[m] = cost
        for i in range(nodes):
            for a in range(POSE):
                hessian[i * each + a, i * each + a] += 1.0 / cap[i * POSE + a] ** 2
        if not _factor(hessian, 0.0, factor):
            costs[m] = math.inf
            continue
        total = 0.0
        for i in range(dimension):
            total -= math.log(factor[i, i])
        log_volume[m] = total
        # Columns of the inverse that belong to poses.
        for i in range(nodes):
            for a in range(POSE):
                for j in range(dimension):
                    trial[j] = 0.0
                trial[i * each + a] = 1.0
                _solve(factor, trial, step)
                for j in range(nodes):
                    for b in range(POSE):
                        covariances[m, i * POSE + a, j * POSE + b] = step[j * each + b]


@inner
def _solve(factor: Floats, right: Floats, solution: Floats) -> None:
    """Solve L L^T x = b."""
    size = right.size
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= factor[i, k] * solution[k]
        solution[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        total = solution[i]
        for k in range(i + 1, size):
            total -= factor[k, i] * solution[k]
        solution[i] = total / factor[i, i]
