"""Compiled loops of the paper's particle filter, over all nodes at once.

A set of particles is ``poses`` (3, K, M), x, y (m) and heading (rad) of M particles of K nodes,
and ``weights`` (K, M), each row summing to one. Random numbers are arguments, so that a kernel
and its reference implementation in the tests can use the same ones. The equations are in
:mod:`relpos.fusion.models.motion`, :mod:`relpos.fusion.models.ranging` and
:mod:`relpos.fusion.particle.particle_set`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from relpos.fusion import vectormath
from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.compiled import compiled

Integers = npt.NDArray[np.uint64]


class NodeRanges(NamedTuple):
    """The ranges of one instant, each once for either of its nodes, sorted by node (E in all).

    Node k measured the ranges offset[k] to offset[k + 1].
    """

    centres_m: Floats
    """Mean positions (2, K) of all nodes before the correction."""
    offset: Indices
    """(K + 1,)"""
    peer: Indices
    """Row of the other node (E,)."""
    range_m: Floats
    """(E,)"""
    height_m: Floats
    """Height difference of the two nodes (E,)."""


@compiled
def normals(random: Integers, result: Floats) -> None:
    """Turn 64 random bits each of ``random`` (P,) into two standard normals (Box, Muller 1958).

    ``result`` (2 P,) receives one in each half. 32 bits a uniform: up to 6.8 standard deviations.
    """
    half = random.shape[0]
    # Slices, because an index of i + half keeps the loop from becoming vector instructions.
    first, second = result[:half], result[half:]
    for i in range(half):
        first[i] = np.float64(np.uint32(random[i] >> np.uint64(32))) * 2.0**-32 + 2.0**-33
        second[i] = np.float64(np.uint32(random[i])) * 2.0**-32
    for i in range(half):
        radius = math.sqrt(-2.0 * vectormath.log(first[i]))
        c, s = vectormath.cos_sin_turns(second[i])
        first[i] = radius * c
        second[i] = radius * s


@compiled
def predict(poses: Floats, rows: Indices, mean: Floats, sigma: Floats, noise: Floats) -> None:
    """Move nodes ``rows`` (R,) by body-frame displacements ``mean`` (R, 3) with ``sigma`` (R, 3).

    ``noise`` contains standard normals: M for every sigma that is not zero, in the order of the
    rows and of x, y, heading; at least M in all.
    """
    count = poses.shape[2]
    taken = 0
    for r in range(rows.shape[0]):
        x, y, heading = poses[0, rows[r]], poses[1, rows[r]], poses[2, rows[r]]
        along, left, turn = mean[r, 0], mean[r, 1], mean[r, 2]
        s_along, s_left, s_turn = sigma[r, 0], sigma[r, 1], sigma[r, 2]
        # A sigma of zero takes no normals: it multiplies whatever is there.
        first = taken if s_along > 0.0 else 0
        taken += count if s_along > 0.0 else 0
        second = taken if s_left > 0.0 else 0
        taken += count if s_left > 0.0 else 0
        third = taken if s_turn > 0.0 else 0
        taken += count if s_turn > 0.0 else 0
        for m in range(count):
            dx = along + s_along * noise[first + m]
            dy = left + s_left * noise[second + m]
            c, s = vectormath.cos_sin(heading[m])
            x[m] += c * dx - s * dy
            y[m] += s * dx + c * dy
            heading[m] += turn + s_turn * noise[third + m]


@compiled
def moments(poses: Floats, weights: Floats, result: Floats) -> None:
    """Fill ``result`` (K, 7): mean x, y, variance x, y, covariance, mean cosine and sine."""
    count = poses.shape[2]
    for k in range(poses.shape[1]):
        x, y, heading, w = poses[0, k], poses[1, k], poses[2, k], weights[k]
        at_x, at_y, cosine, sine = 0.0, 0.0, 0.0, 0.0
        for m in range(count):
            c, s = vectormath.cos_sin(heading[m])
            at_x += w[m] * x[m]
            at_y += w[m] * y[m]
            cosine += w[m] * c
            sine += w[m] * s
        xx, yy, xy = 0.0, 0.0, 0.0
        for m in range(count):
            dx, dy = x[m] - at_x, y[m] - at_y
            xx += w[m] * dx * dx
            yy += w[m] * dy * dy
            xy += w[m] * dx * dy
        result[k, 0], result[k, 1] = at_x, at_y
        result[k, 2], result[k, 3], result[k, 4] = xx, yy, xy
        result[k, 5], result[k, 6] = cosine, sine


@compiled
def means(poses: Floats, weights: Floats, result: Floats) -> None:
    """Fill ``result`` (2, K) with the weighted mean positions."""
    for k in range(poses.shape[1]):
        x, y, w = poses[0, k], poses[1, k], weights[k]
        at_x, at_y = 0.0, 0.0
        for m in range(x.shape[0]):
            at_x += w[m] * x[m]
            at_y += w[m] * y[m]
        result[0, k], result[1, k] = at_x, at_y


@compiled
def sort_by_node(first: Indices, second: Indices, rows: int) -> tuple[Indices, Indices, Indices]:
    """Sort the ranges between ``first`` and ``second`` (R,) by node, each range once for either.

    Returns ``offset`` (rows + 1,), ``peer`` (E,) and ``which`` (E,): the entries offset[k] to
    offset[k + 1] are the ranges ``which`` of node k to the nodes ``peer``.
    """
    offset = np.zeros(rows + 1, dtype=np.int64)
    for r in range(first.shape[0]):
        offset[first[r] + 1] += 1
        offset[second[r] + 1] += 1
    for k in range(rows):
        offset[k + 1] += offset[k]
    place = offset[:rows].copy()
    peer = np.empty(offset[rows], dtype=np.int64)
    which = np.empty(offset[rows], dtype=np.int64)
    for r in range(first.shape[0]):
        a, b = first[r], second[r]
        peer[place[a]], which[place[a]] = b, r
        place[a] += 1
        peer[place[b]], which[place[b]] = a, r
        place[b] += 1
    return offset, peer, which


@compiled
def correct(
    poses: Floats, weights: Floats, ranges: NodeRanges, sigma_m: float, floor: float, result: Floats
) -> None:
    """Multiply the weights by the ranges' likelihoods, eq. (6); each row of ``result`` sums to one.

    ``floor`` is the outliers' density relative to the Gaussian's peak (0: none). Nodes without a
    range keep their weights.
    """
    centres, offset, peer, range_m, height_m = ranges
    count = poses.shape[2]
    total = np.empty(count)
    for k in range(poses.shape[1]):
        prior, new = weights[k], result[k]
        if offset[k] == offset[k + 1]:
            # A loop, because assignments of whole arrays take seconds to compile.
            for m in range(count):
                new[m] = prior[m]
            continue
        x, y = poses[0, k], poses[1, k]
        total[:] = 0.0
        for e in range(offset[k], offset[k + 1]):
            at_x, at_y = centres[0, peer[e]], centres[1, peer[e]]
            h2, z = height_m[e] * height_m[e], range_m[e]
            if floor > 0.0:
                for m in range(count):
                    dx, dy = x[m] - at_x, y[m] - at_y
                    off = (z - math.sqrt(dx * dx + dy * dy + h2)) / sigma_m
                    total[m] += vectormath.log(vectormath.exp(-0.5 * off * off) + floor)
            else:
                for m in range(count):
                    dx, dy = x[m] - at_x, y[m] - at_y
                    off = (z - math.sqrt(dx * dx + dy * dy + h2)) / sigma_m
                    total[m] -= 0.5 * off * off
        # Only particles that still have weight may set the scale, or all of them could underflow.
        peak = -math.inf
        for m in range(count):
            peak = max(peak, total[m] if prior[m] > 0.0 else -math.inf)
        mass = 0.0
        for m in range(count):
            new[m] = prior[m] * vectormath.exp(min(total[m] - peak, 0.0))
            mass += new[m]
        for m in range(count):
            new[m] /= mass


MIN_BANDWIDTH_M = 1e-3
"""The bandwidth of particles that coincide: their density stays finite."""

CELLS = 128
CELL = 0.5
WINDOW = 10
"""The binned density: a grid of CELLS x CELLS cells of CELL bandwidths about the mean, of which
the WINDOW cells around a point (5 bandwidths: a kernel is 4e-6 of its peak there) are summed."""

THINNED = 512
"""Particles (about) that represent all where a point has no mass within the window."""


@compiled
def log_density(
    px: Floats, py: Floats, x: Floats, y: Floats, w: Floats, cells: Floats, result: Floats
) -> None:
    """Log density (D,) at points of particles at ``x``, ``y`` with weights ``w`` (M,).

    A Gaussian kernel with Silverman's bandwidth for two dimensions, per axis, from the effective
    sample size. With ``cells``, (CELLS, CELLS) of working memory, particles are added up in cells
    first: O(M + D); with none, (0, 0), it is the plain sum, O(M D).
    """
    count = x.shape[0]
    at_x, at_y, square = 0.0, 0.0, 0.0
    for m in range(count):
        at_x += w[m] * x[m]
        at_y += w[m] * y[m]
        square += w[m] * w[m]
    xx, yy = 0.0, 0.0
    for m in range(count):
        xx += w[m] * (x[m] - at_x) ** 2
        yy += w[m] * (y[m] - at_y) ** 2
    shrink = square ** (1.0 / 6.0)
    width_x = max(math.sqrt(xx) * shrink, MIN_BANDWIDTH_M)
    width_y = max(math.sqrt(yy) * shrink, MIN_BANDWIDTH_M)
    per_x, per_y = 1.0 / width_x, 1.0 / width_y
    peak_log = math.log(2.0 * math.pi * width_x * width_y)
    if cells.shape[0] == 0:
        for d in range(px.shape[0]):
            result[d] = _plain(px[d], py[d], x, y, w, per_x, per_y) - peak_log
        return
    cells[:] = 0.0
    low_x, low_y = at_x - 0.5 * CELLS * CELL * width_x, at_y - 0.5 * CELLS * CELL * width_y
    to_x, to_y = per_x / CELL, per_y / CELL
    outside = np.empty(count, dtype=np.int64)
    left_out = 0
    for m in range(count):
        u, v = (x[m] - low_x) * to_x, (y[m] - low_y) * to_y
        if u >= 0.0 and v >= 0.0 and u < CELLS - 1.0 and v < CELLS - 1.0:
            i, j = int(u), int(v)
            f, g = u - i, v - j
            a = w[m] * f
            b = w[m] - a
            cells[i, j] += b * (1.0 - g)
            cells[i, j + 1] += b * g
            cells[i + 1, j] += a * (1.0 - g)
            cells[i + 1, j + 1] += a * g
        else:
            outside[left_out] = m
            left_out += 1
    far_x, far_y, far_w = np.empty(left_out), np.empty(left_out), np.empty(left_out)
    for m in range(left_out):
        far_x[m], far_y[m], far_w[m] = x[outside[m]], y[outside[m]], w[outside[m]]
    # Distributing a particle over four cells widens it by CELL^2/6 an axis, on average: the
    # kernel is narrower by as much.
    squared = 1.0 - CELL * CELL / 6.0
    scale = -0.5 * CELL * CELL / squared
    along = np.empty(2 * WINDOW + 1)
    # Copies, because strided reads are slow.
    stride = max(count // THINNED, 1)
    thin_x, thin_y, thin_w = x[::stride].copy(), y[::stride].copy(), w[::stride] * stride
    for d in range(px.shape[0]):
        u, v = (px[d] - low_x) * to_x, (py[d] - low_y) * to_y
        total = 0.0
        if u > -WINDOW and v > -WINDOW and u < CELLS + WINDOW and v < CELLS + WINDOW:
            i, j = math.floor(u), math.floor(v)
            lowest, highest = max(j - WINDOW, 0), min(j + WINDOW + 1, CELLS)
            for c in range(lowest, highest):
                along[c - lowest] = vectormath.exp(scale * (c - v) ** 2)
            for r in range(max(i - WINDOW, 0), min(i + WINDOW + 1, CELLS)):
                row = cells[r]
                mass = 0.0
                for c in range(lowest, highest):
                    mass += row[c] * along[c - lowest]
                if mass > 0.0:
                    total += mass * vectormath.exp(scale * (r - u) ** 2)
        total /= squared
        if left_out > 0:
            far = _plain(px[d], py[d], far_x, far_y, far_w, per_x, per_y)
            total += math.exp(far) if far > -600.0 else 0.0
        if total > 1e-300:
            result[d] = math.log(total) - peak_log
        else:
            # Far from everything only the distance counts: some particles represent all.
            result[d] = _plain(px[d], py[d], thin_x, thin_y, thin_w, per_x, per_y) - peak_log


FAR_OUT = math.log(1e4)
"""Where all kernels underflow, the nearest counts as one particle of very many."""


@compiled
def _plain(
    px: float, py: float, x: Floats, y: Floats, w: Floats, per_x: float, per_y: float
) -> float:
    """Log of the sum of all kernels at one point, without the peak's factor."""
    total = 0.0
    for m in range(x.shape[0]):
        u, v = (x[m] - px) * per_x, (y[m] - py) * per_y
        total += w[m] * vectormath.exp(-0.5 * (u * u + v * v))
    if total > 1e-300:
        return math.log(total)
    # A point very far out has density zero in every kernel: the nearest one keeps it comparable.
    # (A loop of its own: one that also compares does not become vector instructions.)
    nearest = math.inf
    for m in range(x.shape[0]):
        u, v = (x[m] - px) * per_x, (y[m] - py) * per_y
        nearest = min(nearest, u * u + v * v)
    return -0.5 * nearest - FAR_OUT


LEAST_MASS = 1e-290
"""Particles that weigh less together count as none."""

DUAL_DRAWS = 5
"""Uniforms per dual particle: whose ring, radius (two), angle, heading."""

DIRECT_MOST = 8_000
"""Kernels per node (points times particles) up to which the density is their plain sum.

Above it the binned sum is faster. At M 500 five points (2,500 kernels) took 2.8 us a node plain and
7.6 us binned, at M 50,000 and 500 points 17,800 and 345 (one thread, AVX-512)."""


@compiled
def dual_step(
    poses: Floats,
    predicted: Floats,
    corrected: Floats,
    ranges: NodeRanges,
    sigma_m: float,
    floor: float,
    alpha: float,
    uniforms: Floats,
) -> None:
    """Redraw a fraction alpha of the particles of every node that ranged, eq. (7), in place.

    ``uniforms`` (K, DUAL_DRAWS * D + 1) make D dual particles a node; ``predicted`` and
    ``corrected`` (K, M) are the weights before and after the ranges. The dual particles' weights
    in ``corrected`` sum to alpha.
    """
    centres, offset, peer, range_m, height_m = ranges
    count = poses.shape[2]
    fresh = (uniforms.shape[1] - 1) // DUAL_DRAWS
    side = CELLS if fresh * count > DIRECT_MOST else 0
    cells = np.empty((side, side))
    px, py, weight = np.empty(fresh), np.empty(fresh), np.empty(fresh)
    ring = np.empty(fresh, dtype=np.int64)
    heading, edges = np.empty(fresh), np.empty(count)
    for k in range(poses.shape[1]):
        first, seen = offset[k], offset[k + 1] - offset[k]
        if seen == 0:
            continue
        x, y, w, new, draws = poses[0, k], poses[1, k], predicted[k], corrected[k], uniforms[k]
        for d in range(fresh):
            # On the ring of a random neighbour.
            e = first + min(int(draws[d] * seen), seen - 1)
            ring[d] = e
            c, _ = vectormath.cos_sin_turns(draws[2 * fresh + d])
            normal = c * math.sqrt(-2.0 * vectormath.log(1.0 - draws[fresh + d]))
            radius = range_m[e] + sigma_m * normal
            if height_m[e] != 0.0:
                # The range is a slant one.
                radius = math.sqrt(max(radius * radius - height_m[e] ** 2, 0.0))
            c, s = vectormath.cos_sin_turns(draws[3 * fresh + d])
            px[d] = centres[0, peer[e]] + radius * c
            py[d] = centres[1, peer[e]] + radius * s
        log_density(px, py, x, y, w, cells, weight)
        for d in range(fresh):
            for e in range(first, first + seen):
                # The points are drawn by the likelihood of their own ring.
                if e != ring[d]:
                    dx, dy = px[d] - centres[0, peer[e]], py[d] - centres[1, peer[e]]
                    off = range_m[e] - math.sqrt(dx * dx + dy * dy + height_m[e] ** 2)
                    exponent = -0.5 * (off / sigma_m) ** 2
                    if floor > 0.0:
                        exponent = math.log(math.exp(exponent) + floor)
                    weight[d] += exponent
        peak = weight.max()
        total = 0.0
        for d in range(fresh):
            weight[d] = vectormath.exp(weight[d] - peak)
            total += weight[d]

        run = 0.0
        for m in range(count):
            run += w[m]
            edges[m] = run
        for d in range(fresh):
            at = np.searchsorted(edges, draws[4 * fresh + d] * run, side="right")
            heading[d] = poses[2, k, min(at, count - 1)]
        # Evenly spaced slots with a random start: every particle is as likely to be replaced.
        start = draws[5 * fresh]
        for d in range(fresh):
            new[int((start + d) * (count / fresh)) % count] = 0.0
        rest = 0.0
        for m in range(count):
            rest += new[m]
        # Where those that are left have next to no weight, its inverse would overflow.
        keep = (1.0 - alpha) / rest if rest > LEAST_MASS else 0.0
        mass = keep * rest + alpha
        for m in range(count):
            new[m] *= keep / mass
        for d in range(fresh):
            slot = int((start + d) * (count / fresh)) % count
            new[slot] = alpha / mass * weight[d] / total
            poses[0, k, slot], poses[1, k, slot], poses[2, k, slot] = px[d], py[d], heading[d]


@compiled
def resample(poses: Floats, weights: Floats, rows: Indices, uniforms: Floats) -> None:
    """Resample nodes ``rows`` (R,) from their weights (multinomial), in place.

    ``uniforms`` (R, M + 1): the spacings of M sorted uniforms are exponentials divided by the sum
    of M + 1 of them (Devroye 1986, sect. V.3), which saves sorting.
    """
    count = poses.shape[2]
    spacing = np.empty(count + 1)
    source = np.empty(count, dtype=np.int64)
    old = np.empty(count)
    for r in range(rows.shape[0]):
        k = rows[r]
        w = weights[k]
        total, mass = 0.0, 0.0
        for m in range(count + 1):
            spacing[m] = -vectormath.log(1.0 - uniforms[r, m])
            total += spacing[m]
        for m in range(count):
            mass += w[m]
        scale = mass / total
        # Either the draw or the particle advances; conditional values avoid unpredictable branches.
        at, m = 0, 0
        edge, wanted = w[0], spacing[0] * scale
        while m < count and at < count - 1:
            source[m] = at
            here = wanted < edge
            m += 1 if here else 0
            at += 0 if here else 1
            wanted += spacing[m] * scale if here else 0.0
            edge += 0.0 if here else w[at]
        source[m:] = count - 1
        for axis in range(3):
            values = poses[axis, k]
            for m in range(count):
                old[m] = values[m]
            for m in range(count):
                values[m] = old[source[m]]
        w[:] = 1.0 / count
