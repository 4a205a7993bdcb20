"""Compiled loops of the sparse filter over nodes, ranges and pairs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from relpos.fusion.compiled import compiled, inlined
from relpos.fusion.large_teams.layout import COVARIANCE, INFORMATION, Blocks, StripLayout

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

NEAREST_M = 1e-3
"""Below this distance a direction means nothing; it keeps divisions finite."""


@compiled
def move(
    pose: Floats, lever: Floats, noise: Floats, variance: Floats, node: Indices, moved: Floats
) -> None:
    """Move nodes by pieces of reported displacements, one after the other.

    ``pose`` (N, 3) is moved in place. ``moved`` (E, 6): forward, left, turn and their standard
    deviations. The turn's noise enters before the displacement (people turn, then move). What the
    covariance has to be changed by is collected per node: ``lever`` (N, 2) is the derivative of
    the position by the heading of the last update, ``noise`` (N, 6) the covariance xx, xy, yy,
    xh, yh, hh added since. ``variance`` (N,) is the heading's at the last update.

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
def propagate(covariance: Floats, layout: StripLayout, lever: Floats, noise: Floats) -> None:
    """Bring the blocks up to the poses: P <- F P F^T + Q, F from the levers, Q the noise.

    Levers and noise are zero afterwards.
    """
    members, first, sizes, blocks = layout.members, layout.first, layout.sizes, layout.covariance
    for k in range(len(sizes)):
        n = sizes[k]
        m = 3 * n
        nodes = members[first[k] : first[k + 1]]
        for other in range(k, min(k + 2, len(sizes))):
            p = sizes[other]
            peers = members[first[other] : first[other + 1]]
            start = blocks.diagonal[k] if other == k else blocks.following[k]
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


@inlined
def entry(blocks: Blocks, layout: StripLayout, each: int, i: int, j: int) -> tuple[int, int, int]:
    """Return where the matrix of nodes i and j stands in a buffer with ``each`` states a node.

    State a of i and state b of j meet at ``base + down * a + right * b``; base is -1 where the
    strips of the two are not adjacent.
    """
    k, q = layout.strip[i], layout.strip[j]
    n, p = layout.sizes[k], layout.sizes[q]
    row, column = layout.slot[i], layout.slot[j]
    base, down, right = -1, n, each * n * p
    if k == q:
        base = blocks.diagonal[k] + each * n * column + row
    elif q == k + 1:
        base = blocks.following[k] + each * n * column + row
    elif k == q + 1:
        base = blocks.following[q] + each * p * row + column
        down, right = each * n * p, p
    return base, down, right


@compiled
def pair_moments(
    covariance: Floats, layout: StripLayout, pose: Floats, node: Indices, peer: Indices
) -> Floats:
    """Return distance, variances along and across the line, and bearing of pairs (E,): (4, E).

    Nodes whose strips are not adjacent count as independent.
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
            base, down, right = entry(layout.covariance, layout, COVARIANCE, one, two)
            if base >= 0:
                xx += sign * covariance[base]
                yy += sign * covariance[base + down + right]
                xy += sign * 0.5 * (covariance[base + down] + covariance[base + right])
        along = ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy
        result[0, e] = distance
        result[1, e] = max(along, 0.0)
        result[2, e] = max(xx + yy - along, 0.0)
        result[3, e] = math.atan2(dy, dx)
    return result


class RangeModel(NamedTuple):
    """Noise of all ranges, and their outliers."""

    sigma_m: float = 0.1
    outliers: float = 0.0
    """Fraction of outliers."""
    outlier_m: float = 3.0
    outliers_short: float = 0.1
    """Fraction of the outliers that are too short."""


@compiled
def range_information(
    layout: StripLayout,
    pairs: Floats,
    node: Indices,
    peer: Indices,
    measured: Floats,
    model: RangeModel,
) -> tuple[Floats, Floats, Floats]:
    """Return the ranges of one instant as information about positions, at the present poses.

    ``pairs`` (4, E) are :func:`pair_moments`, ``measured`` (E,) in m. The result is the blocks of
    the information matrix A, the right-hand side b (2N,) strip by strip as the blocks' rows, and
    each range's probability of not being an outlier, by which its information is multiplied.

    Second order, finite where two nodes meet: with c the variance across, m^2 = d^2 + c, the
    range's variance is a d^2 / m^2 + c^2 / 2m^2 and its slope d / m.
    """
    blocks, sizes, strip, slot = layout.information, layout.sizes, layout.strip, layout.slot
    information, push = np.zeros(blocks.total), np.zeros(2 * len(strip))
    inlier = np.empty(len(node))
    short = model.outliers_short
    for e in range(len(node)):
        i, j = node[e], peer[e]
        distance, along, across, bearing = pairs[0, e], pairs[1, e], pairs[2, e], pairs[3, e]
        square = distance * distance + across + NEAREST_M * NEAREST_M
        middle = math.sqrt(square)
        innovation = measured[e] - middle
        noise = model.sigma_m * model.sigma_m + 0.5 * across * across / square
        slope = distance / middle
        expected = slope * slope * along + noise
        wide = expected + model.outlier_m * model.outlier_m
        side = 2.0 * (1.0 - short) if innovation > 0.0 else 2.0 * short
        usual = (1.0 - model.outliers) * math.exp(-0.5 * (innovation * innovation / expected))
        usual /= math.sqrt(expected)
        odd = model.outliers * side * math.exp(-0.5 * innovation * innovation / wide)
        odd /= math.sqrt(wide)
        # Where both vanish, the range is an outlier.
        inlier[e] = usual / (usual + odd + 1e-300)
        if inlier[e] < 1e-3 or abs(strip[i] - strip[j]) > 1:
            continue
        weight = inlier[e] / noise
        ux, uy = slope * math.cos(bearing), slope * math.sin(bearing)
        # The range grows with the peer along u and with the node against it.
        for who, sign in ((i, -1.0), (j, 1.0)):
            at = 2 * layout.first[strip[who]] + slot[who]
            push[at] += sign * (weight * innovation) * ux
            push[at + sizes[strip[who]]] += sign * (weight * innovation) * uy
        for one, two, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            if one > two and strip[one] != strip[two]:
                continue  # adjacent strips have one block
            base, down, right = entry(blocks, layout, INFORMATION, one, two)
            information[base] += sign * weight * ux * ux
            information[base + down] += sign * weight * ux * uy
            information[base + right] += sign * weight * ux * uy
            information[base + down + right] += sign * weight * uy * uy
    return information, push, inlier


class FarCovariances(NamedTuple):
    """Covariances of nodes that change strips with the strip beyond the next.

    ``values[start[i]:]`` holds those of node i with the n nodes of strip ``strip[i]``, (3, 3n);
    ``start[i]`` is -1 for a node without any.
    """

    values: Floats
    start: Indices
    strip: Indices


@compiled
def change_layout(
    before: Floats, old: StripLayout, far: FarCovariances, after: Floats, new: StripLayout
) -> int:
    """Copy covariances from one layout to another; return how many are unknown, and so zero."""
    unknown = 0
    for k in range(len(new.sizes)):
        for other in range(k, min(k + 2, len(new.sizes))):
            for j in new.members[new.first[other] : new.first[other + 1]]:
                for i in new.members[new.first[k] : new.first[k + 1]]:
                    to, to_down, to_right = entry(new.covariance, new, COVARIANCE, i, j)
                    base, down, right = entry(old.covariance, old, COVARIANCE, i, j)
                    source = before
                    if base < 0:
                        source = far.values
                        si, sj = old.strip[i], old.strip[j]
                        if far.start[i] >= 0 and far.strip[i] == sj:
                            base = far.start[i] + old.slot[j]
                            down, right = 3 * old.sizes[sj], old.sizes[sj]
                        elif far.start[j] >= 0 and far.strip[j] == si:
                            base = far.start[j] + old.slot[i]
                            down, right = old.sizes[si], 3 * old.sizes[si]
                        else:
                            unknown += 1
                    for b in range(3):
                        for a in range(3):
                            after[to + to_down * a + to_right * b] = (
                                source[base + down * a + right * b] if base >= 0 else 0.0
                            )
    return unknown


@compiled
def mirror(covariance: Floats, layout: StripLayout) -> None:
    """Fill the upper halves of the diagonal blocks from the lower ones."""
    for k in range(len(layout.sizes)):
        m = 3 * layout.sizes[k]
        start = layout.covariance.diagonal[k]
        block = covariance[start : start + m * m].reshape(m, m)
        # block[column, row], so the lower half is column < row.
        for column in range(m):
            for row in range(column + 1, m):
                block[row, column] = block[column, row]


@compiled
def marginals(covariance: Floats, layout: StripLayout) -> Floats:
    """Return xx, yy, xy and heading variance of every node: (N, 4)."""
    result = np.empty((len(layout.strip), 4))
    for i in range(len(layout.strip)):
        base, down, right = entry(layout.covariance, layout, COVARIANCE, i, i)
        result[i, 0] = covariance[base]
        result[i, 1] = covariance[base + down + right]
        result[i, 2] = covariance[base + down]
        result[i, 3] = covariance[base + 2 * (down + right)]
    return result
