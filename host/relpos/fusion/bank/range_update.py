"""Ranges: how a measured distance between two users corrects every hypothesis.

To second order. With rho^2 = |p_j - p_i|^2 + dz^2 and the relative covariance's parts along (a)
and across (c) the line of sight, the moments of rho^2 give, without any clamp,

    m^2 = d^2 + dz^2 + c (+ a dz^2/m^2),   Cov(x, rho) = P u d/m,
    Var rho = a d^2/m^2 + (a^2 e^4 + c^2)/(2 m^2)

which for c << d^2 is the second-order extended Kalman filter (d + c/2d, a + c^2/2d^2), and
stays finite where two users meet.

What many ranges have in common enters to first order. With the direction u from the first to the
second, the velocities v and the headings n (a body shadows who is behind it)

    E rho = m + bias + delay_i + delay_j + shadow (max(-u n_i, 0) + max(u n_j, 0))
              - lateness u (v_j - v_i) - (clock_i - clock_j) u v_j + growth log(m / 5 m)

as the first, whose clock dates the range, sees the second where it was when that clock was right.
Where heights are unknown dz has them, and a user's height the slope dz/m.
Reference implementation: :mod:`reference.joint`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank import lanes
from relpos.fusion.bank.lanes import Lanes, fill, greater, lesser, load, select, some, store
from relpos.fusion.bank.storage import (
    COMMON,
    CONSTANTS,
    PER_NODE,
    POSE,
    TINY,
    Block,
    Hypotheses,
    block_of,
    correct,
    place,
    row_place,
)
from relpos.fusion.compiled import compiled, inner
from relpos.fusion.models.motion import SCALES_TELL
from relpos.fusion.models.ranging import (
    AGAIN_M,
    GROWTH_LEAST_M,
    GROWTH_USUAL_M,
    OUTLIERS_SHORT,
    PASSING_SHARE,
    CommonIndex,
)

STATS = 12
MEAN, VARIANCE, EVIDENCE, INLIER, SHARES, RANGE_SHARE, CURVATURE = 0, 1, 2, 3, 4, 10, 11
"""Columns of the statistics that :func:`update` returns of each range; ``SHARES`` are six."""

FAR = 9.0
"""Squared distance, in range variances, from which on noise of either sign is seen alike."""


class Ranges(NamedTuple):
    """The ranges (R,) of one instant."""

    first: Indices
    """Row of the user at one end."""
    second: Indices
    range_m: Floats
    dz_m: Floats
    """Height difference of the antennas, root mean square."""
    dz_variance_m2: Floats
    """Of the height difference, Gaussian."""
    sample_count: Floats
    """How many independent ranges each counts as: the variance that the gain sees is divided by
    it, the evidence multiplied."""
    kept: Floats
    """What is left of a passing bias since the pair's last range."""
    bias: Indices
    """(R, 3): entries of the state that hold the range's bias and both users' antenna delays, or
    heights; -1 where there is none."""
    velocity_m_s: Floats
    """(R, 4): of the first, forward and left, and of the second; no motion is 0."""
    outliers: Floats
    """(R, 3): probability of being an outlier, the part of it that repeats the pair's last one, and
    by how much that was too long (m)."""


class RangeModel(NamedTuple):
    """What is known of all ranges."""

    outlier: Floats
    """(4,): share of outliers, their variance (m^2), the whole motion noise over its part in the
    covariances, the variance expected beforehand (m^2)."""
    lever_m: Floats
    """Antennas (N, 2), forward and left of the poses; (0, 2) where all are zero."""


@inner
def _second_order(
    ux: Lanes, uy: Lanes, xx: Lanes, xy: Lanes, yy: Lanes, dz2: Lanes
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Give a range's mean m, variance v, and the two gains' factors gx, gy."""
    flat2 = ux * ux + uy * uy
    # Along the line of sight, without a square root.
    along = (ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy) / greater(flat2, fill(TINY))
    nought = fill(0.0)
    a = greater(select(flat2 > TINY, along, 0.5 * (xx + yy)), nought)
    # Across it; rounding may leave a trace of nothing on the wrong side.
    c = greater(xx + yy - a, nought)
    # A division costs as much as ten products.
    m2, square = flat2 + c, c * c
    if some(dz2 > 0.0):
        tilt = dz2 / (flat2 + dz2 + TINY)
        m2 = m2 + (dz2 + tilt * a)
        square = square + tilt * tilt * a * a
    m = lanes.sqrt(m2) + TINY
    v = (a * flat2 + 0.5 * square) / (m2 + TINY)
    per_m = 1.0 / m
    return m, v, ux * per_m, uy * per_m


@inner
def predict_range(block: Block, i: int, j: int, dz2: Lanes) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """As ``_second_order``, between users whose poses begin at ``i`` and ``j``."""
    x, p, at_x, base, _ = block
    ux = load(x, at_x + j) - load(x, at_x + i)
    uy = load(x, at_x + j + 1) - load(x, at_x + i + 1)
    i_x, i_y = base + row_place(i) + i, base + row_place(i + 1) + i
    j_x, j_y = base + row_place(j) + j, base + row_place(j + 1) + j
    xx = load(p, i_x) + load(p, j_x) - 2.0 * load(p, base + place(i, j))
    yy = load(p, i_y + 1) + load(p, j_y + 1) - 2.0 * load(p, base + place(i + 1, j + 1))
    xy = load(p, i_y) + load(p, j_y)
    xy = xy - load(p, base + place(i, j + 1)) - load(p, base + place(i + 1, j))
    return _second_order(ux, uy, xx, xy, yy, dz2)


@inner
def _predict_by_lever(
    block: Block, i: int, j: int, dz2: Lanes, levers_m: tuple[Floats, Floats], off: Floats,
    g: Floats,
) -> tuple[Lanes, Lanes, Lanes, Lanes]:  # fmt: skip
    """As ``predict_range``, between antennas with lever arms; ``g`` (D, LANES) gets P h.

    An antenna at o = R(theta) lever moves by (-o_y, o_x) per radian of heading, so the heading has
    a share in the line of sight. ``off`` (2 D, LANES) is working space: east, then north.
    """
    x, p, at_x, base, active = block
    lever_i, lever_j = levers_m
    ci, si = lanes.cos_sin(load(x, at_x + i + 2))
    cj, sj = lanes.cos_sin(load(x, at_x + j + 2))
    xi, yi = ci * lever_i[0] - si * lever_i[1], si * lever_i[0] + ci * lever_i[1]
    xj, yj = cj * lever_j[0] - sj * lever_j[1], sj * lever_j[0] + cj * lever_j[1]
    ux = load(x, at_x + j) + xj - load(x, at_x + i) - xi
    uy = load(x, at_x + j + 1) + yj - load(x, at_x + i + 1) - yi
    n = x.shape[1]
    for q in range(active):
        hi, hj = load(p, base + place(i + 2, q)), load(p, base + place(j + 2, q))
        east = load(p, base + place(j, q)) - load(p, base + place(i, q))
        store(off, q, east - yj * hj + yi * hi)
        north = load(p, base + place(j + 1, q)) - load(p, base + place(i + 1, q))
        store(off, n + q, north + xj * hj - xi * hi)
    xx = load(off, j) - load(off, i) - yj * load(off, j + 2) + yi * load(off, i + 2)
    xy = load(off, n + j) - load(off, n + i) - yj * load(off, n + j + 2)
    xy = xy + yi * load(off, n + i + 2)
    yy = load(off, n + j + 1) - load(off, n + i + 1)
    yy = yy + xj * load(off, n + j + 2) - xi * load(off, n + i + 2)
    m, v, gx, gy = _second_order(ux, uy, xx, xy, yy, dz2)
    for q in range(active):
        store(g, q, gx * load(off, q) + gy * load(off, n + q))
    return m, v, gx, gy


@inner
def range_gain(block: Block, i: int, j: int, gx: Lanes, gy: Lanes, g: Floats) -> None:
    """Write P h of a range into ``g`` (D, LANES)."""
    p, base = block.p, block.base
    for q in range(block.active):
        off_x = load(p, base + place(j, q)) - load(p, base + place(i, q))
        off_y = load(p, base + place(j + 1, q)) - load(p, base + place(i + 1, q))
        store(g, q, gx * off_x + gy * off_y)


@inner
def _correct_sensitivity(
    sens: Floats, t: int, hx: Lanes, hy: Lanes, kx: Lanes, ky: Lanes, kh: Lanes
) -> Lanes:
    """Carry one sensitivity over a range's update; return what it adds to the innovation's."""
    xx, xy, yy = load(sens, t), load(sens, t + 1), load(sens, t + 2)
    xh, yh = load(sens, t + 3), load(sens, t + 4)
    ax = xx * hx + xy * hy
    ay = xy * hx + yy * hy
    ah = xh * hx + yh * hy
    s = hx * ax + hy * ay
    store(sens, t, xx + kx * (s * kx - 2.0 * ax))
    store(sens, t + 1, xy + s * kx * ky - kx * ay - ky * ax)
    store(sens, t + 2, yy + ky * (s * ky - 2.0 * ay))
    store(sens, t + 3, xh + s * kx * kh - kx * ah - kh * ax)
    store(sens, t + 4, yh + s * ky * kh - ky * ah - kh * ay)
    store(sens, t + 5, load(sens, t + 5) + kh * (s * kh - 2.0 * ah))
    return s


@inner
def _bound_sensitivity(sens: Floats, t: int, p: Floats, base: int, b: int, most: float) -> None:
    """Keep what the components explain of a covariance below ``most`` times the covariance.

    It is homogeneous in all variances, so that a true derivative obeys it with ``most`` 1.
    """
    ratio = fill(1.0)
    for entry in range(3):
        at = t + 2 * entry + (entry == 2)
        explained = load(sens, at) + load(sens, at + 6) + load(sens, at + 12)
        bound = most * load(p, base + place(b + entry, b + entry)) + TINY
        ratio = greater(ratio, explained / bound)
    if not some(ratio > 1.0):
        return
    for at in range(t, t + 18):
        store(sens, at, load(sens, at) / ratio)


@inner
def _share_inlier(
    innovation: Lanes, s: Lanes, expected: Floats, outlier: Floats
) -> tuple[Lanes, Lanes]:
    """Return an innovation's inlier probability and log evidence; ``s`` is its variance.

    ``expected`` (3,) is a row of :attr:`Ranges.outliers`.
    """
    share, again, last_m = expected[0], expected[1], expected[2]
    wide = outlier[1]
    square = innovation * innovation
    per_sd = 1.0 / lanes.sqrt(s)
    good = (1.0 - share) * lanes.exp(-0.5 * square * per_sd * per_sd) * per_sd
    per_wide = 1.0 / lanes.sqrt(s + wide)
    side = select(innovation > 0.0, fill(2.0 * (1.0 - OUTLIERS_SHORT)), fill(2.0 * OUTLIERS_SHORT))
    bad = (share - again) * side * lanes.exp(-0.5 * square * per_wide * per_wide) * per_wide
    if again > 0.0:
        per_sd = 1.0 / lanes.sqrt(s + AGAIN_M * AGAIN_M)
        off = (innovation - last_m) * per_sd
        bad = bad + again * lanes.exp(-0.5 * off * off) * per_sd
    # Where both vanish, it is certainly an outlier.
    both = good + bad + 1e-300
    return good / both, lanes.log(both)


@inner
def _common_terms(
    block: Block, users: tuple[int, int, int], velocity: Floats, bias: Indices,
    sight: tuple[Lanes, Lanes, Lanes, Lanes], slope: Floats, entry: Indices,
) -> int:  # fmt: skip
    """Write entries of the state that add to a range, and its slopes in them; return how many.

    These are its ``bias``, what ranges have in common, and the antenna delays where there are any.
    ``users`` are N and the two rows, ``velocity`` (4,) theirs as in :class:`Ranges`; ``sight`` is
    the direction gx, gy, the distance, and whether they are apart: no range is negative, so that
    between two who stand together noise alone looks like a bias, and nothing is added there.
    """
    nodes, first, second = users
    ux, uy, distance, seen = sight
    ux, uy = seen * ux, seen * uy
    ci, si = lanes.cos_sin(load(block.x, block.at_x + POSE * first + 2))
    cj, sj = lanes.cos_sin(load(block.x, block.at_x + POSE * second + 2))
    nought = fill(0.0)
    own = ux * (ci * velocity[0] - si * velocity[1]) + uy * (si * velocity[0] + ci * velocity[1])
    peer = ux * (cj * velocity[2] - sj * velocity[3]) + uy * (sj * velocity[2] + cj * velocity[3])
    common = PER_NODE * nodes
    store(slope, 0, seen)
    shadow = greater(nought - ux * ci - uy * si, nought) + greater(ux * cj + uy * sj, nought)
    entry[1] = common + CommonIndex.SHADOW
    store(slope, 1, shadow)
    entry[2] = common + CommonIndex.LATENESS
    store(slope, 2, own - peer)
    entry[3] = common + COMMON + first
    store(slope, 3, nought - peer)
    entry[4] = common + COMMON + second
    store(slope, 4, peer)
    entry[5] = common + CommonIndex.GROWTH
    far = greater(distance, fill(GROWTH_LEAST_M)) * (1.0 / GROWTH_USUAL_M)
    store(slope, 5, seen * lanes.log(far))
    entry[0] = bias[0]
    if bias[1] < 0:
        return 6
    for delay in (1, 2):
        entry[5 + delay] = bias[delay]
        store(slope, 5 + delay, seen)
    return 8


@inner
def _unknown_height(block: Block, bias: Indices, has: Lanes) -> tuple[Lanes, Lanes, Lanes]:
    """Return the square of an unknown difference of height, the difference, and its variance.

    Of a pair's own entry, which holds the square, the latter are 0, as all are where ``has`` is.
    """
    x, p, at_x, base, _ = block
    i, j = bias[1], bias[2]
    if i < 0:
        return has * greater(load(x, at_x + bias[0]), fill(0.0)), fill(0.0), fill(0.0)
    spread = load(p, base + place(i, i)) + load(p, base + place(j, j))
    spread = has * greater(spread - 2.0 * load(p, base + place(i, j)), fill(0.0))
    higher = has * (load(x, at_x + j) - load(x, at_x + i))
    return higher * higher, higher, spread


@inner
def _height_terms(
    slope: Floats, entry: Indices, bias: Indices, common: int, has: Lanes,
    lifted: tuple[Lanes, Lanes], ranges: tuple[Lanes, float],
) -> tuple[int, Lanes]:  # fmt: skip
    """Have entries of :func:`_common_terms` be heights where ``has``; return how many there are.

    And what the predicted range has of their mean. ``lifted`` are the square and the difference,
    ``ranges`` the predicted and the measured one (m).
    """
    (square, higher), (m, range_m), seen = lifted, ranges, load(slope, 0)
    if bias[1] >= 0:
        per_m = higher / m
        store(slope, 6, (1.0 - has) * seen - per_m)
        store(slope, 7, (1.0 - has) * seen + per_m)
        return 8, higher * per_m
    # m^2 is linear in the square of the height: its slope is that of the chord.
    chord = has / (m + greater(fill(range_m), fill(0.0)))
    entry[6] = common
    store(slope, 6, has * seen)
    store(slope, 0, chord + (1.0 - has) * seen)
    return 7, chord * square


@inner
def _add_terms(
    block: Block, slope: Floats, entry: Indices, terms: int, g: Floats
) -> tuple[Lanes, Lanes]:
    """Return what entries of the state add to a range, and to the innovation's variance.

    These are the first ``terms`` of ``entry``; ``g`` becomes the gain with them.
    """
    x, p, at_x, base, active = block
    length, variance = fill(0.0), fill(0.0)
    for t in range(terms):
        e, much = entry[t], load(slope, t)
        length = length + much * load(x, at_x + e)
        variance = variance + much * (2.0 * load(g, e) + much * load(p, base + row_place(e) + e))
        for q in range(active):
            store(g, q, load(g, q) + much * load(p, base + place(e, q)))
    return length, variance


@inner
def _pass_bias(block: Block, entry: int, common: int, kept: float, variance: Lanes) -> None:
    """Let a pair's bias return to the common one, but for what is ``kept``, by a random process.

    ``variance`` is that of the process, 0 where the bias does not pass.
    """
    lost = select(variance > 0.0, fill(1.0 - kept), fill(0.0))
    kept_here, new = 1.0 - lost, variance * (1.0 - kept * kept)
    x, p, at_x, base, active = block
    own, shared = load(x, at_x + entry), load(x, at_x + common)
    store(x, at_x + entry, kept_here * own + lost * shared)
    both = load(p, base + place(entry, common))
    of_common, at = load(p, base + place(common, common)), base + place(entry, entry)
    spread = kept_here * kept_here * load(p, at)
    spread = spread + lost * (2.0 * kept_here * both + lost * of_common) + new
    for q in range(active):
        if q != entry:
            here = base + place(entry, q)
            store(p, here, kept_here * load(p, here) + lost * load(p, base + place(common, q)))
    store(p, at, spread)


@inner
def _carry_sensitivities(
    sensitivity: Floats, stats: Floats, at: int, users: tuple[int, int], ends: tuple[int, int],
    slope: tuple[Lanes, Lanes, Lanes], g: Floats,
) -> None:  # fmt: skip
    """Carry both users' sensitivities over a range's update, and note its own in ``stats``.

    ``users`` are their numbers through all blocks, ``ends`` where their poses begin; ``slope`` is
    (gx, gy) of the range and the gain's factor; ``stats`` is written from line ``at`` on.
    """
    gx, gy, kf = slope
    blocks = stats.shape[2]
    (i, j), (t_i, t_j) = ends, (18 * users[0], 18 * users[1])
    back_x, back_y = 0.0 - gx, 0.0 - gy
    ix, iy, ih = kf * load(g, i), kf * load(g, i + 1), kf * load(g, i + 2)
    jx, jy, jh = kf * load(g, j), kf * load(g, j + 1), kf * load(g, j + 2)
    for part in range(3):
        grown = _correct_sensitivity(sensitivity, t_i + 6 * part, back_x, back_y, ix, iy, ih)
        store(stats, at + (SHARES + part) * blocks, grown)
        grown = _correct_sensitivity(sensitivity, t_j + 6 * part, gx, gy, jx, jy, jh)
        store(stats, at + (SHARES + 3 + part) * blocks, grown)


@inner
def _correct_partly(
    block: Block, users: tuple[int, int, int], g: Floats, predicted: Lanes,
    factors: tuple[Lanes, Lanes, Lanes], along: Floats,
) -> None:  # fmt: skip
    """Update with a range, but for its users' common step scale where it tells nothing of that.

    Where both walk side by side, the noise of their headings alone makes the range change with
    their common scale, and shorter steps explain that noise better. So it is partly updated, and
    the other scales as far as they follow from it (partial-update Schmidt-Kalman filter, Brink
    2017). ``users`` are N and the two rows, ``predicted`` is the predicted range's variance,
    ``factors`` are those of ``g``: of the means, of the covariances, and without outliers;
    ``along`` is scratch.
    """
    x, p, at_x, base, active = block
    move, shrink, gain_factor = factors
    correct(block, g, move, shrink)
    nodes, first, second = users
    if active <= POSE * nodes:
        return
    begin = POSE * nodes + 1
    i, j = begin + CONSTANTS * first, begin + CONSTANTS * second
    gain = 0.5 * (load(g, i) + load(g, j))
    # Covariances with the mean of both scales, as they were before the range.
    for k in range(nodes):
        q = begin + CONSTANTS * k
        both = load(p, base + place(q, i)) + load(p, base + place(q, j))
        store(along, k, 0.5 * both + shrink * gain * load(g, q))
    variance = 0.5 * (load(along, first) + load(along, second)) + TINY
    slope = gain / variance
    held = slope * lesser(SCALES_TELL * predicted / (slope * slope + TINY), fill(1.0))
    back, spread = held * move, held * held * gain_factor
    for k in range(nodes):
        q, own = begin + CONSTANTS * k, load(along, k)
        store(x, at_x + q, load(x, at_x + q) - back * own)
        row = base + row_place(q)
        for m in range(k + 1):
            r = row + begin + CONSTANTS * m
            store(p, r, load(p, r) + spread * own * load(along, m))


@compiled
def update(hypotheses: Hypotheses, ranges: Ranges, model: RangeModel, stats: Floats) -> None:
    """Update with ranges (R,) one after another; each hypothesis' log weight gets their evidence.

    What ranges have in common comes last in the state, its bias first, and a hypothesis whose bias
    has no variance has none of it. An innovation that may be an outlier's is used by its
    probability r of being none (probabilistic data association): the mean moves by r K nu, the
    covariance keeps the spread between used and not used.

    ``stats`` (R, STATS, B, LANES) receives m, S, the range's log evidence, r, and by how much S
    grows with the logarithms of the three variance components of the first and of the second user
    and of the range variance, and what of S is due to curvature.
    """
    x, p, log_weight = hypotheses.x, hypotheses.p, hypotheses.log_weight
    blocks, nodes = x.shape[0], hypotheses.sensitivity.shape[1]
    g, off = lanes.working_lines(x.shape[1]), lanes.working_lines(2 * x.shape[1])
    slope, entry = lanes.working_lines(8), np.empty(8, dtype=np.int64)
    own = PER_NODE * nodes + COMMON + nodes
    for b in range(blocks):
        block = block_of(x, p, b, nodes)
        biased = block.active > PER_NODE * nodes
        variance = load(hypotheses.range_variance, b)
        has_heights = load(hypotheses.has_heights, b)
        heights = biased and some(has_heights > 0.0)
        passing = load(hypotheses.has_passing, b) * (PASSING_SHARE * variance)
        passes = biased and some(passing > 0.0)
        common = PER_NODE * nodes + CommonIndex.BIAS
        total = fill(0.0)
        for r in range(ranges.first.shape[0]):
            first, second, dz = ranges.first[r], ranges.second[r], ranges.dz_m[r]
            i, j = POSE * first, POSE * second
            # What is common to all comes before a pair's own entry.
            bias = ranges.bias[r, 0]
            if passes and bias >= own:
                _pass_bias(block, bias, common, ranges.kept[r], passing)
            square, higher, vague_height = fill(0.0), fill(0.0), fill(0.0)
            if heights and bias >= 0:
                square, higher, vague_height = _unknown_height(block, ranges.bias[r], has_heights)
            dz2 = fill(dz * dz) + square + vague_height
            if model.lever_m.shape[0] > 0:
                levers = (model.lever_m[first], model.lever_m[second])
                m, v, gx, gy = _predict_by_lever(block, i, j, dz2, levers, off, g)
            else:
                m, v, gx, gy = predict_range(block, i, j, dz2)
                range_gain(block, i, j, gx, gy, g)
            curvature = v - gx * (load(g, j) - load(g, i)) - gy * (load(g, j + 1) - load(g, i + 1))
            if ranges.dz_variance_m2[r] > 0.0:
                # Var(dz^2) / (4 m^2) with the second order.
                vague = ranges.dz_variance_m2[r]
                v = v + (dz * dz - 0.5 * vague) * vague / (m * m)
            innovation = ranges.range_m[r] - m
            if biased and bias >= 0:
                seen = select(m * m > FAR * variance, fill(1.0), fill(0.0))
                users, sight = (nodes, first, second), (gx, gy, m, seen)
                velocity = ranges.velocity_m_s[r]
                terms = _common_terms(block, users, velocity, ranges.bias[r], sight, slope, entry)
                if heights:
                    lifted, seen_m = (square, higher), (m, ranges.range_m[r])
                    terms, known = _height_terms(
                        slope, entry, ranges.bias[r], common, has_heights, lifted, seen_m
                    )
                    innovation = innovation + known
                    v = v + 0.5 * vague_height * vague_height / (m * m)
                length, added = _add_terms(block, slope, entry, terms, g)
                innovation = innovation - length
                v = v + added
            s = v + variance
            inlier, evidence = _share_inlier(innovation, s, ranges.outliers[r], model.outlier)
            count = ranges.sample_count[r]
            total = total + count * evidence
            per_heavy = 1.0 / (v + variance * (1.0 / count))
            kf = inlier * per_heavy
            shrink = kf * (1.0 - (1.0 - inlier) * (innovation * innovation) * per_heavy)
            _correct_partly(block, (nodes, first, second), g, v, (kf * innovation, shrink, kf), off)
            at = r * STATS * blocks + b
            store(stats, at, ranges.range_m[r] - innovation)
            store(stats, at + VARIANCE * blocks, s)
            store(stats, at + EVIDENCE * blocks, evidence)
            store(stats, at + INLIER * blocks, inlier)
            store(stats, at + RANGE_SHARE * blocks, variance)
            store(stats, at + CURVATURE * blocks, curvature)
            rows = (b * nodes + first, b * nodes + second)
            _carry_sensitivities(hypotheses.sensitivity, stats, at, rows, (i, j), (gx, gy, kf), g)
            for user, pose in ((rows[0], i), (rows[1], j)):
                _bound_sensitivity(
                    hypotheses.sensitivity, 18 * user, p, block.base, pose, model.outlier[2]
                )
        store(log_weight, b, load(log_weight, b) + total)
