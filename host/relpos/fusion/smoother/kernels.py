"""The smoother's arithmetic: normal equations of a team's whole way, and their solution.

K knots in time, N nodes, poses (x, y, heading): a block of b = 3 N unknowns a knot, and a border
of G constants (per node log scale and heading drift, one common range bias, pair biases):

    [ A_0  E_0'              B_0 ]
    [ E_0  A_1  E_1'         B_1 ]          A (K, b, b), E (K - 1, b, b), B (K, b, G), C (G, G)
    [      E_1  A_2  ...     ... ]
    [ B_0' B_1' ...          C   ]

The twins are in :mod:`reference.smoother`.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from relpos.fusion.compiled import compiled

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@compiled
def motion_residuals(
    poses: Floats,
    log_scale: Floats,
    drift_rad_s: Floats,
    duration_s: Floats,
    length_m: Floats,
    direction_rad: Floats,
    turn_rad: Floats,
    follow: Floats,
) -> Floats:
    """Residuals (K - 1, N, 3) of the reported chords: along (m), across (m), turn (rad).

    With the turn's error r_t = h' - h - turn - drift dt, a chord of the reported length and
    direction (in the frame of its beginning) is seen under h + follow r_t + direction; ``follow``
    is the share of a turn that its chord follows (1: turned first, then walked).
    """
    knots, nodes = poses.shape[0], poses.shape[1]
    result = np.empty((knots - 1, nodes, 3))
    for k in range(knots - 1):
        for i in range(nodes):
            turn = poses[k + 1, i, 2] - poses[k, i, 2] - turn_rad[k, i]
            turn -= drift_rad_s[i] * duration_s[k]
            angle = poses[k, i, 2] + follow[i] * turn + direction_rad[k, i]
            c, s = math.cos(angle), math.sin(angle)
            shrink = math.exp(-log_scale[i])
            dx, dy = poses[k + 1, i, 0] - poses[k, i, 0], poses[k + 1, i, 1] - poses[k, i, 1]
            result[k, i, 0] = shrink * (c * dx + s * dy) - length_m[k, i]
            result[k, i, 1] = shrink * (c * dy - s * dx)
            result[k, i, 2] = turn
    return result


@compiled
def _motion_derivative(
    before: Floats,
    after: Floats,
    log_scale: float,
    drift_rad_s: float,
    duration_s: float,
    length_m: float,
    direction_rad: float,
    turn_rad: float,
    follow: float,
    residual: Floats,
    j: Floats,
) -> None:
    """One chord's residuals (3) and derivatives (3, 8): pose before, after, log scale, drift."""
    turn = after[2] - before[2] - turn_rad - drift_rad_s * duration_s
    angle = before[2] + follow * turn + direction_rad
    shrink = math.exp(-log_scale)
    c, s = shrink * math.cos(angle), shrink * math.sin(angle)
    dx, dy = after[0] - before[0], after[1] - before[1]
    along, across = c * dx + s * dy, c * dy - s * dx
    residual[0], residual[1], residual[2] = along - length_m, across, turn
    g = 1.0 - follow
    late = follow * duration_s
    j[0, 0], j[0, 1], j[0, 2] = -c, -s, g * across
    j[0, 3], j[0, 4], j[0, 5] = c, s, follow * across
    j[0, 6], j[0, 7] = -along, -late * across
    j[1, 0], j[1, 1], j[1, 2] = s, -c, -g * along
    j[1, 3], j[1, 4], j[1, 5] = -s, c, -follow * along
    j[1, 6], j[1, 7] = -across, late * along
    j[2, 0], j[2, 1], j[2, 2] = 0.0, 0.0, -1.0
    j[2, 3], j[2, 4], j[2, 5] = 0.0, 0.0, 1.0
    j[2, 6], j[2, 7] = 0.0, -duration_s


@compiled
def add_motions(
    poses: Floats,
    log_scale: Floats,
    drift_rad_s: Floats,
    duration_s: Floats,
    length_m: Floats,
    direction_rad: Floats,
    turn_rad: Floats,
    follow: Floats,
    weight: Floats,
    a: Floats,
    e: Floats,
    border: Floats,
    corner: Floats,
    gradient: Floats,
    corner_gradient: Floats,
) -> None:
    """Add the chords' normal equations; ``weight`` (K - 1, N, 3) is 1 / variance.

    Constants: column i is node i's log scale, N + i its drift. Gradients are of half the squares.
    """
    knots, nodes = poses.shape[0], poses.shape[1]
    j = np.empty((3, 8))
    r = np.empty(3)
    for k in range(knots - 1):
        for i in range(nodes):
            _motion_derivative(
                poses[k, i], poses[k + 1, i], log_scale[i], drift_rad_s[i], duration_s[k],
                length_m[k, i], direction_rad[k, i], turn_rad[k, i], follow[i], r, j,
            )  # fmt: skip
            r0, r1, r2 = r[0], r[1], r[2]
            w0, w1, w2 = weight[k, i, 0], weight[k, i, 1], weight[k, i, 2]
            at = 3 * i
            for p in range(8):
                v0, v1, v2 = w0 * j[0, p], w1 * j[1, p], w2 * j[2, p]
                slope = v0 * r0 + v1 * r1 + v2 * r2
                if p < 3:
                    gradient[k, at + p] += slope
                elif p < 6:
                    gradient[k + 1, at + p - 3] += slope
                elif p == 6:
                    corner_gradient[i] += slope
                else:
                    corner_gradient[nodes + i] += slope
                for q in range(8):
                    value = v0 * j[0, q] + v1 * j[1, q] + v2 * j[2, q]
                    if p < 3:
                        if q < 3:
                            a[k, at + p, at + q] += value
                        elif q >= 6:
                            border[k, at + p, (q - 6) * nodes + i] += value
                    elif p < 6:
                        if q < 3:
                            e[k, at + p - 3, at + q] += value
                        elif q < 6:
                            a[k + 1, at + p - 3, at + q - 3] += value
                        else:
                            border[k + 1, at + p - 3, (q - 6) * nodes + i] += value
                    elif q >= 6:
                        corner[(p - 6) * nodes + i, (q - 6) * nodes + i] += value


@compiled
def add_level_columns(
    poses: Floats,
    log_scale: Floats,
    drift_rad_s: Floats,
    duration_s: Floats,
    length_m: Floats,
    direction_rad: Floats,
    turn_rad: Floats,
    follow: Floats,
    force: Floats,
    axis: Integers,
    columns: Floats,
    corner: Floats,
) -> None:
    """Add how the gradient changes with the logarithm of each motion level (sign turned round).

    ``force`` (K - 1, N, L) is share r / V of a level in its residual's variance; level l acts on
    residual ``axis[l]`` (0 along, 1 across, 2 turn). Column i L + l of ``columns`` (K, b, N L) and
    of ``corner`` (G, N L) is level l of node i.
    """
    knots, nodes, levels = poses.shape[0], poses.shape[1], force.shape[2]
    j = np.empty((3, 8))
    r = np.empty(3)
    for k in range(knots - 1):
        for i in range(nodes):
            _motion_derivative(
                poses[k, i], poses[k + 1, i], log_scale[i], drift_rad_s[i], duration_s[k],
                length_m[k, i], direction_rad[k, i], turn_rad[k, i], follow[i], r, j,
            )  # fmt: skip
            at = 3 * i
            for level in range(levels):
                column, f, a = levels * i + level, force[k, i, level], axis[level]
                for p in range(3):
                    columns[k, at + p, column] += f * j[a, p]
                    columns[k + 1, at + p, column] += f * j[a, 3 + p]
                corner[i, column] += f * j[a, 6]
                corner[nodes + i, column] += f * j[a, 7]


@compiled
def _range_derivative(
    poses: Floats,
    slot: int,
    i: int,
    j: int,
    share: float,
    bend: Floats,
    antenna_m: Floats,
    rise_m: float,
    row: Floats,
) -> float:
    """Distance of one range without biases; its derivative goes into ``row`` (12).

    Order: node i before (x, y, h), i after, j before, j after.
    """
    f, g = share, 1.0 - share
    x0, y0 = 0.0, 0.0
    for side in range(2):
        node, sign = (i, 1.0) if side == 0 else (j, -1.0)
        before, after = poses[slot, node], poses[slot + 1, node]
        x, y = g * before[0] + f * after[0], g * before[1] + f * after[1]
        c, s = math.cos(before[2]), math.sin(before[2])
        bx = c * bend[2 * side] - s * bend[2 * side + 1]
        by = s * bend[2 * side] + c * bend[2 * side + 1]
        heading = g * before[2] + f * after[2]
        c, s = math.cos(heading), math.sin(heading)
        ox = c * antenna_m[node, 0] - s * antenna_m[node, 1]
        oy = s * antenna_m[node, 0] + c * antenna_m[node, 1]
        x0 += sign * (x + bx + ox)
        y0 += sign * (y + by + oy)
        # Kept here until the direction is known: the lever arms turned by a right angle.
        row[6 * side + 0], row[6 * side + 1] = -by - g * oy, bx + g * ox
        row[6 * side + 3], row[6 * side + 4] = -f * oy, f * ox
    distance = math.sqrt(x0 * x0 + y0 * y0 + rise_m * rise_m)
    # Where two stand at one place no direction is nearer: the range is left without a derivative.
    scale = 1.0 / distance if distance > 1e-6 else 0.0
    ux, uy = x0 * scale, y0 * scale
    for side in range(2):
        sign = 1.0 - 2.0 * side
        at = 6 * side
        row[at + 2] = sign * (ux * row[at] + uy * row[at + 1])
        row[at + 5] = sign * (ux * row[at + 3] + uy * row[at + 4])
        row[at], row[at + 1] = sign * g * ux, sign * g * uy
        row[at + 3], row[at + 4] = sign * f * ux, sign * f * uy
    return distance


@compiled
def range_residuals(
    poses: Floats,
    bias_m: Floats,
    slots: Integers,
    pairs: Integers,
    shares: Floats,
    bends: Floats,
    antenna_m: Floats,
    rise_m: Floats,
    range_m: Floats,
    pair_index: Integers,
) -> Floats:
    """Predicted minus measured ranges, (M,); ``bias_m`` is the common one, then one a pair.

    A negative ``pair_index`` stands for a distance without any bias.
    """
    result = np.empty(range_m.size)
    row = np.empty(12)
    for m in range(range_m.size):
        distance = _range_derivative(
            poses, slots[m], pairs[m, 0], pairs[m, 1], shares[m], bends[m], antenna_m, rise_m[m],
            row,
        )  # fmt: skip
        result[m] = distance - range_m[m]
        if pair_index[m] >= 0:
            result[m] += bias_m[0] + bias_m[1 + pair_index[m]]
    return result


@compiled
def add_ranges(
    poses: Floats,
    bias_m: Floats,
    slots: Integers,
    pairs: Integers,
    shares: Floats,
    bends: Floats,
    antenna_m: Floats,
    rise_m: Floats,
    range_m: Floats,
    pair_index: Integers,
    weight: Floats,
    a: Floats,
    e: Floats,
    border: Floats,
    corner: Floats,
    gradient: Floats,
    corner_gradient: Floats,
) -> None:
    """Add the ranges' normal equations; ``weight`` (M,) is 1 / variance.

    Constants: column 2 N is the common bias, 2 N + 1 + pair that of a pair.
    """
    nodes = poses.shape[1]
    row = np.empty(12)
    for m in range(range_m.size):
        w = weight[m]
        if w <= 0.0:
            continue
        k, f = slots[m], shares[m]
        distance = _range_derivative(
            poses, k, pairs[m, 0], pairs[m, 1], f, bends[m], antenna_m, rise_m[m], row
        )
        common, own = 2 * nodes, 2 * nodes + 1 + pair_index[m]
        biased = pair_index[m] >= 0
        r = distance - range_m[m]
        if biased:
            r += bias_m[0] + bias_m[1 + pair_index[m]]
        for p in range(12):
            value = w * row[p]
            if value == 0.0:
                continue
            late_p = (p // 3) % 2
            at_p = 3 * pairs[m, p // 6] + p % 3
            gradient[k + late_p, at_p] += value * r
            if biased:
                border[k + late_p, at_p, common] += value
                border[k + late_p, at_p, own] += value
            for q in range(12):
                late_q = (q // 3) % 2
                at_q = 3 * pairs[m, q // 6] + q % 3
                if late_p == late_q:
                    a[k + late_p, at_p, at_q] += value * row[q]
                elif late_p == 1:
                    e[k, at_p, at_q] += value * row[q]
        if not biased:
            continue
        corner[common, common] += w
        corner[own, own] += w
        corner[common, own] += w
        corner[own, common] += w
        corner_gradient[common] += w * r
        corner_gradient[own] += w * r


@compiled
def _cholesky_inverse(matrix: Floats, inverse: Floats) -> bool:
    """Inverse of the lower Cholesky factor, in place of ``inverse``; False if not definite."""
    n = matrix.shape[0]
    low = np.zeros((n, n))
    for j in range(n):
        total = matrix[j, j]
        for p in range(j):
            total -= low[j, p] * low[j, p]
        if not total > 0.0:
            return False
        pivot = math.sqrt(total)
        low[j, j] = pivot
        for i in range(j + 1, n):
            total = matrix[i, j]
            for p in range(j):
                total -= low[i, p] * low[j, p]
            low[i, j] = total / pivot
    inverse[:] = 0.0
    for i in range(n):
        scale = 1.0 / low[i, i]
        inverse[i, i] = scale
        for p in range(i):
            factor = -low[i, p] * scale
            for j in range(p + 1):
                inverse[i, j] += factor * inverse[p, j]
    return True


@compiled
def factorise(a: Floats, e: Floats, right: Floats, lower: Floats, w: Floats, v: Floats) -> bool:
    """Block Cholesky of the poses' part, and the border through it; False if not definite.

    ``right`` (K, b, R) is the border with the gradient as a last column. Fills ``lower``
    (K, b, b) with the inverse L^-1 of each diagonal factor, ``w`` (K - 1, b, b) = E L^-T and
    ``v`` (K, b, R) = L^-1 (right - W v of before).
    """
    knots = a.shape[0]
    for k in range(knots):
        block = a[k]
        side = right[k]
        if k > 0:
            block = block - np.dot(w[k - 1], w[k - 1].T)
            side = side - np.dot(w[k - 1], v[k - 1])
        if not _cholesky_inverse(block, lower[k]):
            return False
        # Not ``v[k] = ...``: with the words for shapes that differ it takes seconds to compile.
        np.dot(lower[k], side, v[k])
        if k < knots - 1:
            np.dot(e[k], lower[k].T, w[k])
    return True


@compiled
def back_substitute(lower: Floats, w: Floats, v: Floats) -> Floats:
    """Solve the poses' part for every right side: (K, b, R)."""
    knots = lower.shape[0]
    result = np.empty_like(v)
    for k in range(knots - 1, -1, -1):
        side = v[k]
        if k < knots - 1:
            side = side - np.dot(w[k].T, result[k + 1])
        np.dot(lower[k].T, side, result[k])
    return result


@compiled
def selected_inverse(lower: Floats, w: Floats) -> tuple[Floats, Floats]:
    """Diagonal blocks (K, b, b) of the inverse and those below them (K - 1, b, b).

    Without the border: X C^-1 X' of the solved border is added to it.
    """
    knots, b = lower.shape[0], lower.shape[1]
    diagonal = np.empty((knots, b, b))
    below = np.empty((knots - 1, b, b))
    for k in range(knots - 1, -1, -1):
        np.dot(lower[k].T, lower[k], diagonal[k])
        if k < knots - 1:
            step = np.dot(w[k], lower[k])
            moved = np.dot(diagonal[k + 1], step)
            further = np.dot(step.T, moved)
            for i in range(b):
                for j in range(b):
                    below[k, i, j] = -moved[i, j]
                    diagonal[k, i, j] += further[i, j]
    return diagonal, below


@compiled
def motion_variances(
    poses: Floats,
    log_scale: Floats,
    drift_rad_s: Floats,
    duration_s: Floats,
    length_m: Floats,
    direction_rad: Floats,
    turn_rad: Floats,
    follow: Floats,
    diagonal: Floats,
    below: Floats,
    with_constants: Floats,
    constants: Floats,
) -> Floats:
    """Posterior variances (K - 1, N, 3) of the chords' residuals.

    From the covariance's blocks: ``diagonal`` (K, b, b), ``below`` (K - 1, b, b) of a knot with
    the one before, ``with_constants`` (K, b, G) and ``constants`` (G, G), the last two with no
    columns where no constants are estimated.
    """
    knots, nodes = poses.shape[0], poses.shape[1]
    used = 8 if constants.shape[0] > 0 else 6
    result = np.empty((knots - 1, nodes, 3))
    j, r, own = np.empty((3, 8)), np.empty(3), np.zeros((8, 8))
    for k in range(knots - 1):
        for i in range(nodes):
            _motion_derivative(
                poses[k, i], poses[k + 1, i], log_scale[i], drift_rad_s[i], duration_s[k],
                length_m[k, i], direction_rad[k, i], turn_rad[k, i], follow[i], r, j,
            )  # fmt: skip
            at = 3 * i
            for p in range(3):
                for q in range(3):
                    own[p, q] = diagonal[k, at + p, at + q]
                    own[3 + p, 3 + q] = diagonal[k + 1, at + p, at + q]
                    own[3 + p, q] = own[q, 3 + p] = below[k, at + p, at + q]
            if used == 8:
                for c in range(2):
                    column = c * nodes + i
                    for p in range(3):
                        own[p, 6 + c] = own[6 + c, p] = with_constants[k, at + p, column]
                        own[3 + p, 6 + c] = with_constants[k + 1, at + p, column]
                        own[6 + c, 3 + p] = own[3 + p, 6 + c]
                    for d in range(2):
                        own[6 + c, 6 + d] = constants[column, d * nodes + i]
            for axis in range(3):
                total = 0.0
                for p in range(used):
                    for q in range(used):
                        total += j[axis, p] * own[p, q] * j[axis, q]
                result[k, i, axis] = total
    return result


@compiled
def range_variances(
    poses: Floats,
    slots: Integers,
    pairs: Integers,
    shares: Floats,
    bends: Floats,
    antenna_m: Floats,
    rise_m: Floats,
    pair_index: Integers,
    diagonal: Floats,
    below: Floats,
    with_constants: Floats,
    constants: Floats,
) -> Floats:
    """Posterior variances (M,) of the predicted ranges, biases included where they have any."""
    nodes = poses.shape[1]
    result = np.empty(slots.size)
    row = np.empty(12)
    for m in range(slots.size):
        k = slots[m]
        _range_derivative(
            poses, k, pairs[m, 0], pairs[m, 1], shares[m], bends[m], antenna_m, rise_m[m], row
        )
        total = 0.0
        common, own = 2 * nodes, 2 * nodes + 1 + pair_index[m]
        biased = constants.shape[0] > 0 and pair_index[m] >= 0
        for p in range(12):
            if row[p] == 0.0:
                continue
            late_p = (p // 3) % 2
            at_p = 3 * pairs[m, p // 6] + p % 3
            inner = 0.0
            for q in range(12):
                late_q = (q // 3) % 2
                at_q = 3 * pairs[m, q // 6] + q % 3
                if late_p == late_q:
                    inner += row[q] * diagonal[k + late_p, at_p, at_q]
                elif late_p == 1:
                    inner += row[q] * below[k, at_p, at_q]
                else:
                    inner += row[q] * below[k, at_q, at_p]
            if biased:
                inner += 2.0 * with_constants[k + late_p, at_p, common]
                inner += 2.0 * with_constants[k + late_p, at_p, own]
            total += row[p] * inner
        if biased:
            total += constants[common, common] + constants[own, own] + 2.0 * constants[common, own]
        result[m] = total
    return result
