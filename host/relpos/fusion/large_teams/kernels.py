"""Compiled loops of the sparse filter over nodes, ranges and pairs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.compiled import compiled, inlined
from relpos.fusion.large_teams.layout import COVARIANCE, INFORMATION, Blocks, StripLayout
from relpos.fusion.models.motion import SCALE_WALK
from relpos.fusion.models.motion_variances import ALONG, TURN, WHITE
from relpos.fusion.models.ranging import AGAIN_M, OUTLIERS_SHORT

NEAREST_M = 1e-3
"""Below this distance a direction means nothing; it keeps divisions finite."""

LEVERS = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 1))
"""Component (x, y, heading) and what it depends on (heading, drift, scale), the heading last."""

ENTRIES = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2), (4, 4))
"""States (x, y, heading, drift, scale) between which moving adds covariance."""

ACROSS = 0.1
"""Variance of a displacement across its direction relative to that along it."""


@compiled
def displacements(moves: Floats, variances: Floats) -> Floats:
    """Give displacements as ``move`` takes them (E, 7), of forward, left, turn, duration (E, 4).

    ``variances`` (E, 3) are those of ``motion_variances``.
    """
    moved = np.empty((len(moves), 7))
    for e in range(len(moves)):
        dx, dy, turn, duration_s = moves[e, 0], moves[e, 1], moves[e, 2], moves[e, 3]
        # Along the path, and a tenth of that across, both in the frame of the body.
        square = max(dx * dx + dy * dy, 1e-12)
        along = variances[e, ALONG] / square
        moved[e, :3] = moves[e, :3]
        moved[e, 3] = math.sqrt(along * (dx * dx + ACROSS * dy * dy))
        moved[e, 4] = math.sqrt(along * (dy * dy + ACROSS * dx * dx))
        moved[e, 5] = math.sqrt(variances[e, TURN] + variances[e, WHITE])
        # Who reports nothing at all stands, and the heading with it.
        moved[e, 6] = duration_s if square > 1e-12 or turn != 0.0 else 0.0
    return moved


@compiled
def move(
    state: Floats, lever: Floats, noise: Floats, before: Floats, node: Indices, moved: Floats
) -> None:
    """Move nodes by pieces of reported displacements, one after the other.

    ``state`` (N, 5) is moved in place. ``moved`` (E, 7): forward, left, turn, their standard
    deviations, and for how long (s) the node moved. The turn's noise enters before the
    displacement (people turn, then move). What the covariance has to be changed by is collected
    per node: ``lever`` (N, 3, 3) is the derivative of the pose by heading, drift and scale of the
    last update (but for the heading's by itself), ``noise`` (N, 7) the covariance xx, xy, yy, xh,
    yh, hh, and the scale's variance, added since. ``before`` (N, 5, 5) are the nodes' own
    covariances at the last update.

    A heading error e of variance v turns the displacement d: on average it is shorter by
    exp(-v/2), and varies along itself by d^2 (1 - exp(-v))^2 / 2, across by d^2 (1 - exp(-2v)) / 2,
    of which the derivative has d^2 v exp(-v): statistical linearisation, as in the bank. Here it
    errs alike on the way w so far that the heading turns: for d^2 stands (w + d)^2 - w^2.
    """
    for e in range(len(node)):
        i = node[e]
        scale = math.exp(state[i, 4])
        forward, left = scale * moved[e, 0], scale * moved[e, 1]
        # Half of the drift before the displacement, half after it.
        half = 0.5 * moved[e, 6]
        heading = state[i, 2] - half * state[i, 3]
        lever[i, 2, 1] -= half
        c, s = math.cos(heading), math.sin(heading)
        # The turn's noise first: it turns this displacement, too.
        noise[i, 5] += moved[e, 5] * moved[e, 5]
        xh, yh, hh = noise[i, 3], noise[i, 4], noise[i, 5]
        # Covariances of states before it with the heading, then those of pose and heading now.
        old = before[i, :, 2] + lever[i, 2, 1] * before[i, :, 3]
        spread = hh + old[2] + lever[i, 2, 1] * old[3]
        x_now = xh + old[0] + (lever[i, 0] * old[2:]).sum()
        y_now = yh + old[1] + (lever[i, 1] * old[2:]).sum()
        shrunk = math.exp(-0.5 * spread)
        dx, dy = c * forward - s * left, s * forward + c * left
        short2 = shrunk * shrunk
        so_far = max(dx * y_now - dy * x_now, 0.0) / (spread * (dx * dx + dy * dy) + 1e-12)
        along = (1.0 + 2.0 * so_far) * 0.5 * (1.0 - short2) ** 2
        swept = (1.0 + 2.0 * so_far) * max(0.5 - 0.5 * short2 * short2 - spread * short2, 0.0)
        # Derivative of the displacement by the heading.
        hx, hy = -shrunk * dy, shrunk * dx
        sx, sy = moved[e, 3] * moved[e, 3], moved[e, 4] * moved[e, 4]
        noise[i, 0] += 2.0 * hx * xh + hx * hx * hh
        noise[i, 0] += c * c * sx + s * s * sy + along * dx * dx + swept * dy * dy
        noise[i, 1] += hx * yh + hy * xh + hx * hy * hh
        noise[i, 1] += c * s * (sx - sy) + (along - swept) * dx * dy
        noise[i, 2] += 2.0 * hy * yh + hy * hy * hh
        noise[i, 2] += s * s * sx + c * c * sy + along * dy * dy + swept * dx * dx
        noise[i, 3] += hx * hh
        noise[i, 4] += hy * hh
        noise[i, 6] += SCALE_WALK * moved[e, 6]
        lever[i, 0, 0] += hx
        lever[i, 1, 0] += hy
        lever[i, 0, 1] += hx * lever[i, 2, 1]
        lever[i, 1, 1] += hy * lever[i, 2, 1]
        lever[i, 0, 2] += shrunk * dx
        lever[i, 1, 2] += shrunk * dy
        lever[i, 2, 1] -= half
        state[i, 0] += shrunk * dx
        state[i, 1] += shrunk * dy
        state[i, 2] = heading + moved[e, 2] - half * state[i, 3]


@compiled
def _move_block(block: Floats, rows: Floats, columns: Floats) -> None:
    """F P G^T of one block, in place; F and G by the levers of its nodes (n, 3, 3), (p, 3, 3)."""
    n, p = len(rows), len(columns)
    for axis, by in LEVERS:
        for j in range(COVARIANCE * p):
            for i in range(n):
                block[axis * n + i, j] += rows[i, axis, by] * block[(2 + by) * n + i, j]
        for j in range(p):
            for i in range(COVARIANCE * n):
                block[i, axis * p + j] += columns[j, axis, by] * block[i, (2 + by) * p + j]


@compiled
def _add_noise(block: Floats, noise: Floats) -> None:
    """Add what moving the nodes of a strip added to their own covariances (n, 7)."""
    n = len(noise)
    for k, (a, b) in enumerate(ENTRIES):
        for i in range(n):
            block[a * n + i, b * n + i] += noise[i, k]
            block[b * n + i, a * n + i] = block[a * n + i, b * n + i]


def propagate(covariance: Floats, layout: StripLayout, lever: Floats, noise: Floats) -> None:
    """Bring the blocks up to the poses: P <- F P F^T + Q, F from the levers, Q the noise.

    Levers and noise are zero afterwards.
    """
    diagonal, following = layout.views(covariance, COVARIANCE)
    nodes = [layout.nodes_of(k) for k in range(len(diagonal))]
    blocks = [*zip(diagonal, nodes, nodes, strict=True)]
    blocks += zip(following, nodes, nodes[1:], strict=False)
    for block, rows, columns in blocks:
        _move_block(block, lever[rows], lever[columns])
    for block, rows in zip(diagonal, nodes, strict=True):
        _add_noise(block, noise[rows])
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


class Ranges(NamedTuple):
    """The ranges (E,) of one instant."""

    node: Indices
    """Row of the node at one end."""
    peer: Indices
    measured_m: Floats
    lift_m2: Floats
    """Mean squares of the differences of height."""
    counts: Floats
    """How many independent ranges each is worth."""
    variance_m2: Floats
    """What is known to add to the variance of each."""
    outliers: Floats
    """(E, 3): probability that it is an outlier, at least; the part of it that repeats the pair's
    last one, and by how much that was too long (m)."""
    slopes: Floats
    """(E, T): derivative by what all ranges have in common, and by what is each node's own."""


class RangeModel(NamedTuple):
    """Noise of all ranges, and their outliers."""

    sigma_m: float = 0.1
    outliers: float = 0.0
    """Fraction of outliers."""
    outlier_m: float = 3.0


@compiled
def range_information(
    layout: StripLayout, pairs: Floats, ranges: Ranges, model: RangeModel, carried: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the ranges of one instant as information about positions, at the present poses.

    ``pairs`` (4, E) are :func:`pair_moments`; ``carried`` (N, 5, T) is how the states depend on the
    T terms, which many ranges have in common. The result is the blocks of the information matrix A,
    right-hand sides (2N, 1 + T) strip by strip as the blocks' rows, each range's probability of not
    being an outlier, by which its information is multiplied, and a line for each range: weight,
    slopes ux, uy, innovation, and the innovation's derivatives by the T terms. The right-hand sides
    are those of the innovations and of these derivatives.

    Second order, finite where two nodes meet: with a and c the variances along and across, l the
    mean square of the heights' difference and t = l / (d^2 + l), m^2 = d^2 + l + c + t a, the
    range's variance is a d^2 / m^2 + (c^2 + t^2 a^2) / 2m^2 and its slope d / m.
    """
    blocks, sizes, strip, slot = layout.information, layout.sizes, layout.strip, layout.slot
    terms = carried.shape[2]
    information, push = np.zeros(blocks.total), np.zeros((2 * len(strip), 1 + terms))
    lines = np.zeros((len(ranges.node), 4 + terms))
    inlier = np.empty(len(ranges.node))
    for e in range(len(ranges.node)):
        i, j = ranges.node[e], ranges.peer[e]
        distance, along, across, bearing = pairs[0, e], pairs[1, e], pairs[2, e], pairs[3, e]
        flat, lift = distance * distance, ranges.lift_m2[e]
        tilted = along * lift / (flat + lift + NEAREST_M * NEAREST_M)
        square = flat + across + (lift + tilted) + NEAREST_M * NEAREST_M
        middle = math.sqrt(square)
        innovation = ranges.measured_m[e] - middle
        outliers, again = max(model.outliers, ranges.outliers[e, 0]), ranges.outliers[e, 1]
        curved = 0.5 * (across * across + tilted * tilted) / square
        noise = model.sigma_m * model.sigma_m + ranges.variance_m2[e]
        slope = distance / middle
        expected = slope * slope * along + noise + curved
        wide = expected + model.outlier_m * model.outlier_m
        side = 2.0 * (1.0 - OUTLIERS_SHORT if innovation > 0.0 else OUTLIERS_SHORT)
        usual = (1.0 - outliers) * math.exp(-0.5 * (innovation * innovation / expected))
        usual /= math.sqrt(expected)
        odd = (outliers - again) * side * math.exp(-0.5 * innovation * innovation / wide)
        odd /= math.sqrt(wide)
        if again > 0.0:
            off, like = innovation - ranges.outliers[e, 2], expected + AGAIN_M * AGAIN_M
            odd += again * math.exp(-0.5 * off * off / like) / math.sqrt(like)
        # Where both vanish, the range is an outlier.
        inlier[e] = usual / (usual + odd + 1e-300)
        if inlier[e] < 1e-3 or abs(strip[i] - strip[j]) > 1:
            continue
        weight = inlier[e] / (noise / ranges.counts[e] + curved)
        ux, uy = slope * math.cos(bearing), slope * math.sin(bearing)
        line = lines[e]
        line[0], line[1], line[2], line[3] = weight, ux, uy, innovation
        for t in range(terms):
            change_x = carried[j, 0, t] - carried[i, 0, t]
            change_y = carried[j, 1, t] - carried[i, 1, t]
            line[4 + t] = ranges.slopes[e, t] + ux * change_x + uy * change_y
        # The range grows with the peer along u and with the node against it.
        for who, sign in ((i, -1.0), (j, 1.0)):
            at = 2 * layout.first[strip[who]] + slot[who]
            for t in range(1 + terms):
                much = sign * weight * line[3 + t]
                push[at, t] += much * ux
                push[at + sizes[strip[who]], t] += much * uy
        for one, two, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            if one > two and strip[one] != strip[two]:
                continue  # adjacent strips have one block
            base, down, right = entry(blocks, layout, INFORMATION, one, two)
            information[base] += sign * weight * ux * ux
            information[base + down] += sign * weight * ux * uy
            information[base + right] += sign * weight * ux * uy
            information[base + down + right] += sign * weight * uy * uy
    return information, push, inlier, lines
