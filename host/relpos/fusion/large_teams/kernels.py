"""Compiled loops of :mod:`relpos.fusion.large_teams.sparse_filter`: over nodes, ranges and pairs.

The joint covariance stands in one buffer, strip after strip: block (k, k) of strip k and block
(k, k + 1) between it and the next, each in columns (Fortran's order) over the states x of all its
nodes, then y, then heading. ``at_diagonal[k]`` and ``at_next[k]`` say where they begin,
``sizes[k]`` how many nodes the strip has; ``strip[i]`` and ``slot[i]`` say where node i stands.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from relpos.fusion.compiled import compiled

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

NEAREST_M = 1e-3
"""Below this distance a direction means nothing; it keeps divisions finite."""


@compiled
def advance(
    pose: Floats, lever: Floats, noise: Floats, variance: Floats, node: Indices, moved: Floats
) -> None:
    """Move nodes by pieces of reported displacements, one after the other.

    ``pose`` (N, 3) is moved in place. ``moved`` (E, 6): forward, left, turn and their standard
    deviations. The turn's noise enters before the displacement (people turn, then move). What the
    covariance has to be changed by is gathered per node: ``lever`` (N, 2) is the derivative of
    the position by the heading of the last update, ``noise`` (N, 6) the covariance xx, xy, yy,
    xh, yh, hh of what has been added since. ``variance`` (N,) is the heading's at the last update.

    A heading error e of variance v turns the displacement d: on average it is shorter by
    exp(-v/2), and varies along itself by d^2 (1 - exp(-v))^2 / 2, the second-order terms.
    """
    for e in range(len(node)):
        i = node[e]
        forward, left, turn = moved[e, 0], moved[e, 1], moved[e, 2]
        c, s = math.cos(pose[i, 2]), math.sin(pose[i, 2])
        # The turn's noise first: it turns this displacement, too.
        noise[i, 5] += moved[e, 5] * moved[e, 5]
        spread = variance[i] + noise[i, 5]
        shrunk = math.exp(-0.5 * spread)
        dx, dy = c * forward - s * left, s * forward + c * left
        along = 0.5 * (1.0 - shrunk * shrunk) ** 2
        # Derivative of the displacement by the heading.
        hx, hy = -shrunk * dy, shrunk * dx
        xh, yh, hh = noise[i, 3], noise[i, 4], noise[i, 5]
        sx, sy = moved[e, 3] * moved[e, 3], moved[e, 4] * moved[e, 4]
        noise[i, 0] += 2.0 * hx * xh + hx * hx * hh
        noise[i, 0] += c * c * sx + s * s * sy + along * dx * dx
        noise[i, 1] += hx * yh + hy * xh + hx * hy * hh
        noise[i, 1] += c * s * (sx - sy) + along * dx * dy
        noise[i, 2] += 2.0 * hy * yh + hy * hy * hh
        noise[i, 2] += s * s * sx + c * c * sy + along * dy * dy
        noise[i, 3] += hx * hh
        noise[i, 4] += hy * hh
        lever[i, 0] += hx
        lever[i, 1] += hy
        pose[i, 0] += shrunk * dx
        pose[i, 1] += shrunk * dy
        pose[i, 2] += turn


@compiled
def pass_time(
    covariance: Floats, at_diagonal: Indices, at_next: Indices, sizes: Indices,
    members: Indices, first: Indices, lever: Floats, noise: Floats,
) -> None:  # fmt: skip
    """Bring the blocks up to the poses: P <- F P F^T + Q, F the levers, Q the noise.

    ``members`` are the nodes strip by strip, those of strip k from ``first[k]``. Levers and noise
    are zero afterwards.
    """
    for k in range(len(sizes)):
        n = sizes[k]
        m = 3 * n
        nodes = members[first[k] : first[k + 1]]
        for other in range(k, min(k + 2, len(sizes))):
            p = sizes[other]
            peers = members[first[other] : first[other + 1]]
            start = at_diagonal[k] if other == k else at_next[k]
            block = covariance[start : start + m * 3 * p].reshape(3 * p, m)
            # block[column, row]: first the rows of every column, then columns among each other.
            for column in range(3 * p):
                line = block[column]
                for r in range(n):
                    line[r] += lever[nodes[r], 0] * line[2 * n + r]
                    line[n + r] += lever[nodes[r], 1] * line[2 * n + r]
            for q in range(p):
                x, y = lever[peers[q], 0], lever[peers[q], 1]
                for r in range(m):
                    block[q, r] += x * block[2 * p + q, r]
                    block[p + q, r] += y * block[2 * p + q, r]
            if other == k:
                for r in range(n):
                    i = nodes[r]
                    block[r, r] += noise[i, 0]
                    block[n + r, r] += noise[i, 1]
                    block[r, n + r] += noise[i, 1]
                    block[n + r, n + r] += noise[i, 2]
                    block[2 * n + r, r] += noise[i, 3]
                    block[r, 2 * n + r] += noise[i, 3]
                    block[2 * n + r, n + r] += noise[i, 4]
                    block[n + r, 2 * n + r] += noise[i, 4]
                    block[2 * n + r, 2 * n + r] += noise[i, 5]
    lever[:] = 0.0
    noise[:] = 0.0


@compiled
def pair_spread(
    covariance: Floats, at_diagonal: Indices, at_next: Indices, sizes: Indices,
    strip: Indices, slot: Indices, pose: Floats, node: Indices, peer: Indices,
) -> Floats:  # fmt: skip
    """Of pairs (E,) the distance and the variances along and across the line between: (4, E).

    The fourth row is the bearing of the peer. Pairs further apart than two strips count as
    independent.
    """
    result = np.empty((4, len(node)))
    for e in range(len(node)):
        i, j = node[e], peer[e]
        dx, dy = pose[j, 0] - pose[i, 0], pose[j, 1] - pose[i, 1]
        distance = math.sqrt(dx * dx + dy * dy)
        ux, uy = dx / max(distance, NEAREST_M), dy / max(distance, NEAREST_M)
        if distance < NEAREST_M:
            ux, uy = 1.0, 0.0
        xx = xy = yy = 0.0
        for one, two, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            k, q = strip[one], strip[two]
            start, height = 0, 3 * sizes[k]
            row, column, turned = slot[one], slot[two], False
            if k == q:
                start = at_diagonal[k]
            elif q == k + 1:
                start = at_next[k]
            elif k == q + 1:
                start, height, turned = at_next[q], 3 * sizes[q], True
                row, column = column, row
            else:
                continue
            # Steps from x to y within rows and within columns.
            down, right = sizes[k], sizes[q]
            if turned:
                down, right = right, down
            base = start + height * column + row
            xx += sign * covariance[base]
            yy += sign * covariance[base + height * right + down]
            xy += sign * 0.5 * (covariance[base + down] + covariance[base + height * right])
        along = ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy
        result[0, e] = distance
        result[1, e] = max(along, 0.0)
        result[2, e] = max(xx + yy - along, 0.0)
        result[3, e] = math.atan2(dy, dx)
    return result


@compiled
def gather(
    spread: Floats, node: Indices, peer: Indices, measured: Floats, variance: Floats,
    outlier: Floats, strip: Indices, slot: Indices, sizes: Indices, at_diagonal: Indices,
    at_next: Indices, information: Floats, push: Floats, weight: Floats, surprise: Floats,
) -> None:  # fmt: skip
    """Put the ranges of one instant into information about positions, linear at the present poses.

    ``spread`` is :func:`pair_spread`'s, ``measured`` and ``variance`` (E,) are m and m^2.
    ``information`` holds blocks as the covariance's, but of positions alone (2n states);
    ``push`` (2N,) the right-hand side, strip by strip as the blocks' rows (both are set to zero
    first). ``weight`` (E,) is each range's probability to be good, by which its information is
    multiplied, ``surprise`` (E,) its squared innovation over the expected variance.

    Second order, finite where two meet (as ``bank/range_update.py``): with c the variance
    across,
    m^2 = d^2 + c, the range's variance is a d^2 / m^2 + c^2 / 2m^2 and its slope d / m.
    ``outlier`` holds the share of outliers, their variance (m^2)
    and the share of these that are too short.
    """
    information[:] = 0.0
    push[:] = 0.0
    starts = np.zeros(len(sizes) + 1, dtype=np.int64)
    for k in range(len(sizes)):
        starts[k + 1] = starts[k] + 2 * sizes[k]
    for e in range(len(node)):
        i, j = node[e], peer[e]
        distance, along, across = spread[0, e], spread[1, e], spread[2, e]
        square = distance * distance + across + NEAREST_M * NEAREST_M
        middle = math.sqrt(square)
        innovation = measured[e] - middle
        doubt = variance[e] + 0.5 * across * across / square
        slope = distance / middle
        expected = slope * slope * along + doubt
        surprise[e] = innovation * innovation / expected
        wide = expected + outlier[1]
        side = 2.0 * (1.0 - outlier[2]) if innovation > 0.0 else 2.0 * outlier[2]
        usual = (1.0 - outlier[0]) * math.exp(-0.5 * surprise[e]) / math.sqrt(expected)
        odd = outlier[0] * side * math.exp(-0.5 * innovation * innovation / wide) / math.sqrt(wide)
        # Where both vanish, it is certainly no good one.
        believed = usual / (usual + odd + 1e-300)
        weight[e] = believed
        if believed < 1e-3 or abs(strip[i] - strip[j]) > 1:
            continue
        each = believed / doubt
        bearing = spread[3, e]
        ux, uy = slope * math.cos(bearing), slope * math.sin(bearing)
        # The range grows with the peer along u and with the node against it.
        pushed = each * innovation
        for who, sign in ((i, -1.0), (j, 1.0)):
            k = strip[who]
            n = sizes[k]
            at = starts[k] + slot[who]
            push[at] += sign * pushed * ux
            push[at + n] += sign * pushed * uy
            start = at_diagonal[k] + 2 * n * slot[who] + slot[who]
            information[start] += each * ux * ux
            information[start + n] += each * ux * uy
            information[start + 2 * n * n] += each * ux * uy
            information[start + 2 * n * n + n] += each * uy * uy
        k, q = strip[i], strip[j]
        row, column = slot[i], slot[j]
        if k > q:
            k, q, row, column = q, k, column, row
        n, p = sizes[k], sizes[q]
        start = (at_diagonal[k] if k == q else at_next[k]) + 2 * n * column + row
        information[start] -= each * ux * ux
        information[start + n] -= each * ux * uy
        information[start + 2 * n * p] -= each * ux * uy
        information[start + 2 * n * p + n] -= each * uy * uy
        if k == q:
            start = at_diagonal[k] + 2 * n * row + column
            information[start] -= each * ux * ux
            information[start + n] -= each * ux * uy
            information[start + 2 * n * n] -= each * ux * uy
            information[start + 2 * n * n + n] -= each * uy * uy


@compiled
def lay_over(
    before: Floats, diagonal_before: Indices, next_before: Indices, sizes_before: Indices,
    strip_before: Indices, slot_before: Indices, far: Floats, far_start: Indices,
    far_strip: Indices, after: Floats, diagonal_after: Indices, next_after: Indices,
    sizes_after: Indices, members: Indices, first: Indices,
) -> int:  # fmt: skip
    """Copy blocks from one layout to another; count pairs of nodes whose covariance is unknown.

    For a node i that moves over, ``far[far_start[i]:]`` (3, 3n) holds its covariance with the
    n nodes of strip ``far_strip[i]`` of the layout before, two strips off.
    """
    unknown = 0
    for k in range(len(sizes_after)):
        n = sizes_after[k]
        for other in range(k, min(k + 2, len(sizes_after))):
            p = sizes_after[other]
            start = diagonal_after[k] if other == k else next_after[k]
            for q in range(p):
                j = members[first[other] + q]
                sj, tj = strip_before[j], slot_before[j]
                for r in range(n):
                    i = members[first[k] + r]
                    si, ti = strip_before[i], slot_before[i]
                    # Where (a of i, b of j) stood: base + down * a + right * b.
                    if si == sj:
                        base = diagonal_before[si] + 3 * sizes_before[si] * tj + ti
                        down = sizes_before[si]
                        right = 3 * sizes_before[si] * sizes_before[si]
                    elif sj == si + 1:
                        base = next_before[si] + 3 * sizes_before[si] * tj + ti
                        down = sizes_before[si]
                        right = 3 * sizes_before[si] * sizes_before[sj]
                    elif si == sj + 1:
                        base = next_before[sj] + 3 * sizes_before[sj] * ti + tj
                        down = 3 * sizes_before[sj] * sizes_before[si]
                        right = sizes_before[sj]
                    else:
                        base = -1
                        down = 0
                        right = 0
                    to = start + 3 * n * q + r
                    if base >= 0:
                        for b in range(3):
                            for a in range(3):
                                after[to + 3 * n * p * b + n * a] = before[
                                    base + down * a + right * b
                                ]
                        continue
                    if far_start[i] >= 0 and far_strip[i] == sj:
                        base = far_start[i] + tj
                        down, right = 3 * sizes_before[sj], sizes_before[sj]
                    elif far_start[j] >= 0 and far_strip[j] == si:
                        base = far_start[j] + ti
                        down, right = sizes_before[si], 3 * sizes_before[si]
                    else:
                        unknown += 1
                    for b in range(3):
                        for a in range(3):
                            after[to + 3 * n * p * b + n * a] = (
                                far[base + down * a + right * b] if base >= 0 else 0.0
                            )
    return unknown


@compiled
def mirror(covariance: Floats, at_diagonal: Indices, sizes: Indices) -> None:
    """Fill the upper halves of the diagonal blocks from the lower ones."""
    for k in range(len(sizes)):
        m = 3 * sizes[k]
        block = covariance[at_diagonal[k] : at_diagonal[k] + m * m].reshape(m, m)
        # block[column, row], so the lower half is column < row.
        for column in range(m):
            for row in range(column + 1, m):
                block[row, column] = block[column, row]


@compiled
def marginals(covariance: Floats, at_diagonal: Indices, sizes: Indices, strip: Indices,
              slot: Indices) -> Floats:  # fmt: skip
    """Of every node xx, yy, xy and heading variance: (N, 4)."""
    result = np.empty((len(strip), 4))
    for i in range(len(strip)):
        n = sizes[strip[i]]
        m = 3 * n
        at = at_diagonal[strip[i]] + slot[i] * (m + 1)
        result[i, 0] = covariance[at]
        result[i, 1] = covariance[at + n * (m + 1)]
        result[i, 2] = covariance[at + n]
        result[i, 3] = covariance[at + 2 * n * (m + 1)]
    return result
