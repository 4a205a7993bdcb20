"""Kernels of the joint error-state filter over all users, for many hypotheses at once.

One hypothesis k is a mean ``x[k]`` (D,) and a covariance ``p[k]`` (D, D) over all users:
five entries a user in the order of :class:`Of`, then (where modelled) the range biases. All
kernels work in place on arrays whose first axis is the hypothesis; their twins are in
:mod:`relpos.fusion.twins.joint`.

Motion, with the heading's noise entering first (people turn, then move; a wearer's turn is
measured before the step that it directs):

    theta' = theta + w - drift dt/2,   p <- p + exp(scale) R(theta') (dx, dy),
    theta  <- theta + w + dtheta - drift dt

Range, to second order. With rho^2 = |p_j - p_i|^2 + dz^2 and the relative covariance's parts
along (a) and across (c) the line of sight, the moments of rho^2 give, without any clamp,

    m^2 = d^2 + dz^2 + c (+ a dz^2/m^2),   Cov(x, rho) = P u d/m,
    Var rho = a d^2/m^2 + (a^2 e^4 + c^2)/(2 m^2)

which for c << d^2 is the second-order extended Kalman filter (d + c/2d, a + c^2/2d^2), and
stays finite where two users meet.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from relpos.fusion import vectormath
from relpos.fusion.compiled import compiled, inlined

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


class Of(IntEnum):
    """A user's entries in the joint state: world metres, radians, and two constants.

    ``DRIFT`` (rad/s) is what the reported heading gains over the true one while moving (a node
    that reports nothing at all stands, and its heading with it), ``SCALE`` the logarithm of the
    true over the reported length.
    """

    X = 0
    Y = 1
    HEADING = 2
    DRIFT = 3
    SCALE = 4


PER_NODE = len(Of)
_X, _Y, _H, _W, _S = (int(v) for v in Of)
_N = PER_NODE
_TINY = 1e-12

STATS = 12
"""Columns of what :func:`update` tells of each range."""

_LANES = 32
"""Loops over a whole number of these are vector instructions only (four of eight doubles); 30 a
row would all be done one by one, which takes three times as long."""

DRIFT_WALK = 3e-9
SCALE_WALK = 3e-7
"""Random walks of the two constants, rad^2/s^2 and 1 per second of moving: 0.06 deg/s and 1 % in
five minutes. Without them resampling makes the reported sd up to twice too small."""

_POINTS = 11
_ASIDE = 2.5
"""P(heard) is averaged over so many points, out to so many standard deviations."""
_Z = _ASIDE * np.linspace(-1.0, 1.0, _POINTS)
_RULE_VARIANCE = float((_Z**2 * np.exp(-0.5 * _Z**2)).sum() / np.exp(-0.5 * _Z**2).sum())
_FAR = 9.0
"""Squared distance, in range variances, from which on noise of either sign is seen alike."""


@inlined
def _turn_sensitivity(t: Floats, east: float, north: float) -> None:
    """Carry one 3 x 3 sensitivity (xx, xy, yy, xh, yh, hh) over a displacement."""
    xh, yh, hh = t[3], t[4], t[5]
    t[0] += north * (north * hh - 2.0 * xh)
    t[1] += east * xh - north * yh - east * north * hh
    t[2] += east * (east * hh + 2.0 * yh)
    t[3] -= north * hh
    t[4] += east * hh


@inlined
def _correct_sensitivity(t: Floats, hx: float, hy: float, kx: float, ky: float, kh: float) -> float:
    """Carry one sensitivity over a range's update; return what it adds to the innovation's."""
    ax = t[0] * hx + t[1] * hy
    ay = t[1] * hx + t[2] * hy
    ah = t[3] * hx + t[4] * hy
    s: float = hx * ax + hy * ay
    t[0] += kx * (s * kx - 2.0 * ax)
    t[1] += s * kx * ky - kx * ay - ky * ax
    t[2] += ky * (s * ky - 2.0 * ay)
    t[3] += s * kx * kh - kx * ah - kh * ax
    t[4] += s * ky * kh - ky * ah - kh * ay
    t[5] += kh * (s * kh - 2.0 * ah)
    return s


@inlined
def _bound_sensitivity(levels: Floats, pk: Floats, b: int, most: float) -> None:
    """Keep what the levels explain of a covariance below ``most`` times the covariance.

    It is homogeneous in all variances, so that a true derivative obeys it with ``most`` 1.
    """
    ratio = 1.0
    for entry in range(3):
        at = 2 * entry + (entry == 2)
        explained = 0.0
        for part in range(3):
            explained += levels[part, at]
        ratio = max(ratio, explained / (most * pk[b + entry, b + entry] + _TINY))
    if ratio > 1.0:
        for part in range(3):
            for at in range(6):
                levels[part, at] /= ratio


@compiled
def advance(
    x: Floats,
    p: Floats,
    level: Floats,
    sens: Floats,
    rows: Indices,
    motion: Floats,
    sampled: Floats,
    share: float,
    cross: float,
) -> None:
    """Move users ``rows`` (M,) by ``motion`` (M, 7) in every hypothesis.

    ``motion`` is dx, dy, dtheta, duration, and the variances' bases: along the way (m^2), of
    the turn (rad^2) and white in heading (rad^2); ``level`` (K, N, 3) multiplies these three
    for each user. ``sens`` (K, N, 3, 6) is how each user's own pose covariance (xx, xy, yy, xh,
    yh, hh) changes with the logarithm of each of its levels; what leaks to others is left out.
    ``sampled`` (K, M) are standard normals: the share ``share`` of the heading's
    variance is drawn, the rest goes into the covariance. ``cross`` is the variance across the
    way relative to that along it.
    """
    nodes = level.shape[1]
    poses = _N * nodes
    # What a user's displacements did to x and y per heading, drift and scale, and to the heading.
    moved = np.empty((nodes, 5))
    for k in range(x.shape[0]):
        xk = x[k]
        pk = p[k]
        size = x.shape[1]
        if size > poses and pk[poses, poses] == 0.0:
            size = poses
        moved[:] = 0.0
        for m in range(rows.shape[0]):
            row = rows[m]
            b = _N * row
            bh, bw, bs = b + _H, b + _W, b + _S
            dx, dy, dt = motion[m, 0], motion[m, 1], motion[m, 3]
            turn = motion[m, 5] * level[k, row, 1]
            white = motion[m, 6] * level[k, row, 2]
            noise = turn + white
            if noise > 0.0:
                sens[k, row, 1, 5] += turn
                sens[k, row, 2, 5] += white
                xk[bh] += sampled[k, m] * math.sqrt(share * noise)
                pk[bh, bh] += (1.0 - share) * noise
            constant = pk[bw, bw] > 0.0 or pk[bs, bs] > 0.0
            if dx != 0.0 or dy != 0.0:
                c, s = vectormath.cos_sin(xk[bh] - 0.5 * dt * xk[bw])
                # E R(theta) of an uncertain heading is shorter by exp(-var/2); what that leaves
                # of the spread along and across the way is noise (statistical linearisation).
                vary = max(pk[bh, bh] - dt * pk[bh, bw], 0.0)
                short = math.exp(-0.5 * vary)
                shorter = short * short
                grow = math.exp(xk[bs]) if xk[bs] != 0.0 else 1.0
                full = grow * grow * (dx * dx + dy * dy)
                ahead, aside = c * dx - s * dy, s * dx + c * dy
                east, north = grow * short * ahead, grow * short * aside
                xk[b] += east
                xk[b + 1] += north
                _move_own(pk, b, east, north, 0.5 * dt, constant)
                moved[row, 0] += east
                moved[row, 1] += north
                # The heading that this displacement follows has itself drifted since.
                lag = moved[row, 4] + 0.5 * dt
                moved[row, 2] += north * lag
                moved[row, 3] -= east * lag
                for part in range(3):
                    _turn_sensitivity(sens[k, row, part], east, north)
                along = motion[m, 4] * level[k, row, 0]
                if full > _TINY:
                    unit = 1.0 / (dx * dx + dy * dy)
                    ee, nn, en = ahead * ahead * unit, aside * aside * unit, ahead * aside * unit
                    lost = 0.5 * full * (1.0 - shorter) * (1.0 - shorter)
                    swept = full * max(0.5 - 0.5 * shorter * shorter - vary * shorter, 0.0)
                    length = along + lost
                    width = along * cross + swept
                    pk[b, b] += length * ee + width * nn
                    pk[b + 1, b + 1] += length * nn + width * ee
                    pk[b, b + 1] += (length - width) * en
                    pk[b + 1, b] += (length - width) * en
                    sens[k, row, 0, 0] += along * (ee + cross * nn)
                    sens[k, row, 0, 1] += along * (1.0 - cross) * en
                    sens[k, row, 0, 2] += along * (nn + cross * ee)
            xk[bh] += motion[m, 2] - dt * xk[bw]
            if constant:
                if dt > 0.0 and pk[bw, bw] > 0.0:
                    moved[row, 4] += dt
                    for q in range(b, b + _N):
                        pk[bh, q] -= dt * pk[bw, q]
                    for q in range(b, b + _N):
                        pk[q, bh] -= dt * pk[q, bw]
                    pk[bw, bw] += DRIFT_WALK * dt
                if pk[bs, bs] > 0.0:
                    pk[bs, bs] += SCALE_WALK * dt
        for row in range(nodes):
            if moved[row, 0] != 0.0 or moved[row, 1] != 0.0 or moved[row, 4] != 0.0:
                _move_others(pk, _N * row, moved[row], poses, size)


@compiled
def _move_own(pk: Floats, b: int, east: float, north: float, half: float, constant: bool) -> None:
    """Carry a user's own block (5, 5) at ``b`` over a displacement."""
    bx, by, bh, bw, bs = b + _X, b + _Y, b + _H, b + _W, b + _S
    if constant:
        for q in range(b, b + _N):
            turned = pk[bh, q] - half * pk[bw, q]
            pk[bx, q] += east * pk[bs, q] - north * turned
            pk[by, q] += north * pk[bs, q] + east * turned
        for q in range(b, b + _N):
            turned = pk[q, bh] - half * pk[q, bw]
            pk[q, bx] += east * pk[q, bs] - north * turned
            pk[q, by] += north * pk[q, bs] + east * turned
        return
    xh, yh, hh = pk[bx, bh], pk[by, bh], pk[bh, bh]
    pk[bx, bx] += north * (north * hh - 2.0 * xh)
    pk[by, by] += east * (east * hh + 2.0 * yh)
    xy = pk[bx, by] + east * xh - north * yh - east * north * hh
    pk[bx, by] = xy
    pk[by, bx] = xy
    pk[bx, bh] = xh - north * hh
    pk[bh, bx] = xh - north * hh
    pk[by, bh] = yh + east * hh
    pk[bh, by] = yh + east * hh


@compiled
def _move_others(pk: Floats, b: int, moved: Floats, poses: int, size: int) -> None:
    """Carry a user's covariance with everything else over all its displacements at once.

    ``moved`` (5,) is east and north (m), what a unit of drift does to x and to y, and the time
    (s). Own constants that have no variance have no covariance either.
    """
    bx, by, bh, bw, bs = b + _X, b + _Y, b + _H, b + _W, b + _S
    east, north, drift_x, drift_y, time = moved[0], moved[1], moved[2], moved[3], moved[4]
    constant = pk[bw, bw] > 0.0 or pk[bs, bs] > 0.0
    o = 0
    while o < size:
        if o == b:
            o += _N
            continue
        stop = size if o >= poses else o + _N
        if o < poses and pk[o + _W, o + _W] == 0.0 and pk[o + _S, o + _S] == 0.0:
            stop = o + 3
        if constant:
            for q in range(o, stop):
                h, w, s = pk[bh, q], pk[bw, q], pk[bs, q]
                at_x = pk[bx, q] + east * s - north * h + drift_x * w
                at_y = pk[by, q] + north * s + east * h + drift_y * w
                h -= time * w
                pk[bx, q] = at_x
                pk[by, q] = at_y
                pk[bh, q] = h
                pk[q, bx] = at_x
                pk[q, by] = at_y
                pk[q, bh] = h
        else:
            for q in range(o, stop):
                h = pk[bh, q]
                at_x = pk[bx, q] - north * h
                at_y = pk[by, q] + east * h
                pk[bx, q] = at_x
                pk[by, q] = at_y
                pk[q, bx] = at_x
                pk[q, by] = at_y
        o = size if o >= poses else o + _N


@inlined
def _predict_range(
    xk: Floats, pk: Floats, bi: int, bj: int, dz: float
) -> tuple[float, float, float, float]:
    """Give the range's mean m, variance v, and the two gains' factors gx, gy."""
    ux = xk[bj] - xk[bi]
    uy = xk[bj + 1] - xk[bi + 1]
    xx = pk[bi, bi] + pk[bj, bj] - 2.0 * pk[bi, bj]
    yy = pk[bi + 1, bi + 1] + pk[bj + 1, bj + 1] - 2.0 * pk[bi + 1, bj + 1]
    xy = pk[bi, bi + 1] + pk[bj, bj + 1] - pk[bi, bj + 1] - pk[bi + 1, bj]
    flat2 = ux * ux + uy * uy
    if flat2 > _TINY:
        # Along the line of sight, without a square root.
        a = max((ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy) / flat2, 0.0)
    else:
        a = 0.5 * (xx + yy)
    # Across it; rounding may leave a trace of nothing on the wrong side.
    c = max(xx + yy - a, 0.0)
    tilt = dz * dz / (flat2 + dz * dz + _TINY)
    m2 = flat2 + dz * dz + c + tilt * a
    m = math.sqrt(m2) + _TINY
    v = (a * flat2 + 0.5 * (c * c + tilt * tilt * a * a)) / (m2 + _TINY)
    return m, v, ux / m, uy / m


@compiled
def _range_by_arms(
    xk: Floats,
    pk: Floats,
    bi: int,
    bj: int,
    dz: float,
    arm_i: Floats,
    arm_j: Floats,
    size: int,
    east: Floats,
    north: Floats,
    g: Floats,
) -> tuple[float, float, float, float]:
    """As ``_predict_range`` between antennas off their poses; ``g`` (D,) gets P h.

    An antenna at o = R(theta) arm moves by (-o_y, o_x) per radian of heading, so the heading has
    a share in the line of sight. ``east`` and ``north`` (D,) are working space.
    """
    ci, si = math.cos(xk[bi + _H]), math.sin(xk[bi + _H])
    cj, sj = math.cos(xk[bj + _H]), math.sin(xk[bj + _H])
    xi, yi = ci * arm_i[0] - si * arm_i[1], si * arm_i[0] + ci * arm_i[1]
    xj, yj = cj * arm_j[0] - sj * arm_j[1], sj * arm_j[0] + cj * arm_j[1]
    ux = xk[bj] + xj - xk[bi] - xi
    uy = xk[bj + 1] + yj - xk[bi + 1] - yi
    hi, hj = bi + _H, bj + _H
    for q in range(size):
        east[q] = pk[bj, q] - pk[bi, q] - yj * pk[hj, q] + yi * pk[hi, q]
        north[q] = pk[bj + 1, q] - pk[bi + 1, q] + xj * pk[hj, q] - xi * pk[hi, q]
    xx = east[bj] - east[bi] - yj * east[hj] + yi * east[hi]
    yy = north[bj + 1] - north[bi + 1] + xj * north[hj] - xi * north[hi]
    xy = north[bj] - north[bi] - yj * north[hj] + yi * north[hi]
    flat2 = ux * ux + uy * uy
    a = (
        (ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy) / flat2
        if flat2 > _TINY
        else 0.5 * (xx + yy)
    )
    a, c = max(a, 0.0), max(xx + yy - a, 0.0)
    tilt = dz * dz / (flat2 + dz * dz + _TINY)
    m2 = flat2 + dz * dz + c + tilt * a
    m = math.sqrt(m2) + _TINY
    v = (a * flat2 + 0.5 * (c * c + tilt * tilt * a * a)) / (m2 + _TINY)
    for q in range(size):
        g[q] = (ux * east[q] + uy * north[q]) / m
    return m, v, ux / m, uy / m


@compiled
def _lines(space: Floats, size: int) -> Floats:
    """Lay out a (size, padded) covariance in working space, each row on cache lines of its own.

    The loops below run to ``shape[1]``, which numba knows not to be negative: to any other
    bound they are not made into vector instructions.
    """
    stride = (size + _LANES - 1) // _LANES * _LANES
    off = (-(space.ctypes.data // 8)) % 8
    return space[off : off + size * stride].reshape(size, stride)


@compiled
def _load(pk: Floats, of: Floats) -> None:
    """Copy the first rows and columns of ``of`` (D, D) into ``pk`` (size, padded).

    Whole vectors: what is beyond a row's end is of the next ones, finite and of no account.
    """
    size, stride = pk.shape
    wide = of.shape[1]
    for o in range(size):
        if o * wide + stride <= wide * wide:
            for q in range(pk.shape[1]):
                pk[o, q] = of[o, q]
        else:
            for q in range(stride):
                pk[o, q] = of[o, q] if q < size else 0.0


@compiled
def _store(to: Floats, pk: Floats) -> None:
    """Copy ``pk`` (size, padded) back: what a row overwrites of the next ones, those put right."""
    size, stride = pk.shape
    wide = to.shape[1]
    for o in range(size):
        if o * wide + stride <= wide * wide:
            for q in range(pk.shape[1]):
                to[o, q] = pk[o, q]
        else:
            for q in range(size):
                to[o, q] = pk[o, q]


@compiled
def _gain(pk: Floats, bi: int, bj: int, gx: float, gy: float, g: Floats) -> None:
    """Write P h of a range into ``g`` (padded with zeros)."""
    for q in range(pk.shape[1]):
        g[q] = gx * (pk[bj, q] - pk[bi, q]) + gy * (pk[bj + 1, q] - pk[bi + 1, q])
    for q in range(pk.shape[0], pk.shape[1]):
        g[q] = 0.0


@compiled
def _take_away(pk: Floats, g: Floats, shrink: float) -> None:
    """Take ``shrink`` g g^T from a covariance; where ``g`` is 0 (no constants) there is nothing."""
    for o in range(pk.shape[0]):
        f = shrink * g[o]
        if f != 0.0:
            for q in range(pk.shape[1]):
                pk[o, q] -= f * g[q]


@compiled
def update(
    x: Floats,
    p: Floats,
    log_weight: Floats,
    sigma2: Floats,
    sens: Floats,
    first: Indices,
    second: Indices,
    bias: Indices,
    measured: Floats,
    dz: Floats,
    outlier: Floats,
    poses: int,
    worth: Floats,
    dz_variance: Floats,
    arms: Floats,
    stats: Floats,
) -> None:
    """Work in ranges (R,) one after another; each hypothesis' log weight gets their evidence.

    ``first``, ``second`` (R,) are users' rows, ``bias`` the state of a range's bias or -1;
    biases come after the first ``poses`` entries of the state, their common part first, and a
    hypothesis whose common part has no variance has none. ``sigma2`` (K,) is each hypothesis'
    range variance. ``outlier`` is the share, the variance
    (m^2), the share of these that are too short, and the whole motion noise over what of it is
    in the covariances. An innovation that may be an outlier's is
    used by its probability r of being none (probabilistic data association): the mean moves by
    r K nu, the covariance keeps the spread between used and not used.

    ``worth`` (R,) is how many independent ranges one is worth: the variance that the gain sees is
    divided by it, the evidence multiplied. ``dz_variance`` (R,) is the variance of ``dz``.
    ``arms`` (N, 2) are the antennas' places (forward, left) of the poses, or empty (0, 2) where
    all are zero. ``stats`` (K, R, STATS) receives m, S, the range's log evidence, r, and by how
    much S grows with the logarithms of the three levels of the first and of the second user and of
    the range variance (``sens``), and what of S is due to curvature.
    """
    count, size = x.shape
    space = np.empty(size * (size + _LANES) + 8)
    g = np.empty(size + _LANES)
    east = np.empty(size)
    north = np.empty(size)
    lever = arms.shape[0] > 0
    share, wide, short, most = outlier[0], outlier[1], outlier[2], outlier[3]
    for k in range(count):
        xk = x[k]
        total = 0.0
        size = x.shape[1]
        biased = size > poses and p[k, poses, poses] > 0.0
        if not biased:
            size = poses
        pk = _lines(space, size)
        g[:] = 0.0
        _load(pk, p[k])
        for r in range(first.shape[0]):
            bi, bj, e = _N * first[r], _N * second[r], bias[r] if biased else -1
            if lever:
                m, v, gx, gy = _range_by_arms(
                    xk, pk, bi, bj, dz[r], arms[first[r]], arms[second[r]], size, east, north, g
                )
            else:
                m, v, gx, gy = _predict_range(xk, pk, bi, bj, dz[r])
                _gain(pk, bi, bj, gx, gy, g)
            bent = v - gx * (g[bj] - g[bi]) - gy * (g[bj + 1] - g[bi + 1])
            v += dz[r] * dz[r] / (m * m) * dz_variance[r]
            innovation = measured[r] - m
            # No range is negative: between two who stand together noise alone looks like a bias.
            if e >= 0 and m * m > _FAR * sigma2[k]:
                innovation -= xk[e]
                v += 2.0 * g[e] + pk[e, e]
                for q in range(size):
                    g[q] += pk[e, q]
            s = v + sigma2[k]
            square = innovation * innovation
            good = (1.0 - share) * vectormath.exp(-0.5 * square / s) / math.sqrt(s)
            spread = s + wide
            side = 2.0 * (1.0 - short) if innovation > 0.0 else 2.0 * short
            bad = share * side * vectormath.exp(-0.5 * square / spread) / math.sqrt(spread)
            # Where both vanish, it is certainly no good one.
            both = good + bad + 1e-300
            trust = good / both
            evidence = vectormath.log(both)
            total += worth[r] * evidence
            heavy = v + sigma2[k] / worth[r]
            scaled = trust * innovation / heavy
            shrink = trust / heavy * (1.0 - (1.0 - trust) * square / heavy)
            for q in range(size):
                xk[q] += scaled * g[q]
            _take_away(pk, g, shrink)
            stats[k, r, 0] = measured[r] - innovation
            stats[k, r, 1] = s
            stats[k, r, 2] = evidence
            stats[k, r, 3] = trust
            kf = trust / heavy
            for part in range(3):
                stats[k, r, 4 + part] = _correct_sensitivity(
                    sens[k, first[r], part], -gx, -gy, kf * g[bi], kf * g[bi + 1], kf * g[bi + 2]
                )
                stats[k, r, 7 + part] = _correct_sensitivity(
                    sens[k, second[r], part], gx, gy, kf * g[bj], kf * g[bj + 1], kf * g[bj + 2]
                )
            _bound_sensitivity(sens[k, first[r]], pk, bi, most)
            _bound_sensitivity(sens[k, second[r]], pk, bj, most)
            stats[k, r, 10] = sigma2[k]
            stats[k, r, 11] = bent
        _store(p[k], pk)
        log_weight[k] += total


@compiled
def update_heading(
    x: Floats,
    p: Floats,
    log_weight: Floats,
    row: int,
    measured: float,
    sigma2: float,
    share: float,
    wide: float,
) -> None:
    """Work in one absolute heading of a user; outliers as in :func:`update`, both signs alike."""
    count, size = x.shape
    g = np.empty(size)
    b = _N * row + _H
    for k in range(count):
        xk = x[k]
        pk = p[k]
        innovation = measured - xk[b]
        innovation -= 2.0 * math.pi * np.rint(innovation / (2.0 * math.pi))
        for q in range(size):
            g[q] = pk[b, q]
        s = g[b] + sigma2
        square = innovation * innovation
        good = (1.0 - share) * math.exp(-0.5 * square / s) / math.sqrt(s)
        bad = share * math.exp(-0.5 * square / (s + wide)) / math.sqrt(s + wide)
        both = good + bad + 1e-300
        trust = good / both
        shrink = trust / s * (1.0 - (1.0 - trust) * square / s)
        for q in range(size):
            xk[q] += trust * innovation / s * g[q]
        for o in range(size):
            for q in range(size):
                pk[o, q] -= shrink * g[o] * g[q]
        log_weight[k] += math.log(both)


@inlined
def _outcome(place: float, heard: bool, tried: float, curve: Floats) -> float:
    """Probability that a pair is heard, or is silent, at a multiple of the curve's step."""
    last = curve.shape[0] - 2
    place = min(max(place, 0.0), last + 1.0)
    index = min(int(place), last)
    chance: float = curve[index] + (place - index) * (curve[index + 1] - curve[index])
    return chance if heard else 1.0 - tried * chance


@compiled
def hearing(
    x: Floats,
    p: Floats,
    log_weight: Floats,
    first: Indices,
    second: Indices,
    dz: Floats,
    heard: npt.NDArray[np.bool_],
    tried: Floats,
    weight: float,
    curve: Floats,
    step_m: float,
) -> None:
    """Work in which pairs (U,) of those tried were ``heard`` (U,), after their ranges.

    A range near the edge of hearing is more likely too long than one beyond the edge is heard:
    without the heard ones' share the silent ones would drive everybody apart. ``curve`` is
    P(heard | distance) at multiples of ``step_m``, ``tried`` (U,) the probability that a pair
    was tried at all, ``weight`` what one outcome counts (``detection.py``). The distance's
    Gaussian m, v times P(outcome | distance) has mass Z, mean m' and variance v'; Z weighs the
    hypothesis, and where that tells anything within it (an edge lies within the spread) the
    moments go to the state along g = Cov(x, distance):

        x += g (m' - m)/v,   P -= g g^T (v - v')/v^2
    """
    count, size = x.shape
    g = np.empty(size)
    bell = np.empty(_POINTS)
    for q in range(_POINTS):
        bell[q] = math.exp(-0.5 * (_ASIDE * (2.0 * q / (_POINTS - 1.0) - 1.0)) ** 2)
    per_step = 1.0 / step_m
    log_least, log_most = math.log(0.97), math.log(1.03)
    for k in range(count):
        xk = x[k]
        pk = p[k]
        total = 0.0
        product = 1.0
        for u in range(first.shape[0]):
            bi, bj = _N * first[u], _N * second[u]
            m, v, gx, gy = _predict_range(xk, pk, bi, bj, dz[u])
            sd = math.sqrt(max(v, 0.0))
            place, aside = per_step * m, per_step * sd
            middle = _outcome(place, heard[u], tried[u], curve)
            near = _outcome(place - _ASIDE * aside, heard[u], tried[u], curve)
            far = _outcome(place + _ASIDE * aside, heard[u], tried[u], curve)
            lowest, highest = min(near, far), max(near, far)
            # Almost everywhere the curve is flat. Roots differ by less than what they are of
            # (``weight`` is at most 1), so logarithms are only taken where that does not settle it.
            flat = lowest > 0.97 * middle and highest < 1.03 * middle
            if not flat:
                flat = (
                    weight * math.log(lowest / middle) > log_least
                    and weight * math.log(highest / middle) < log_most
                )
            if flat:
                product *= middle
                if product < 1e-250:
                    total += weight * math.log(product)
                    product = 1.0
                continue
            mass = 0.0
            shift = 0.0
            square = 0.0
            norm = 0.0
            for q in range(_POINTS):
                z = _ASIDE * (2.0 * q / (_POINTS - 1.0) - 1.0)
                norm += bell[q]
                chance = _outcome(place + z * aside, heard[u], tried[u], curve)
                density = bell[q] * math.exp(weight * math.log(chance))
                mass += density
                shift += density * z
                square += density * z * z
            total += math.log(mass / norm)
            shift /= mass
            # The rule's own variance is a little under 1: a flat curve must change nothing.
            after = min((square / mass - shift * shift) / _RULE_VARIANCE, 1.0)
            for q in range(size):
                g[q] = gx * (pk[bj, q] - pk[bi, q]) + gy * (pk[bj + 1, q] - pk[bi + 1, q])
            # g g^T / v never exceeds P: v also holds the curvature's part.
            move, shrink = shift / sd, (1.0 - after) / v
            for q in range(size):
                xk[q] += move * g[q]
            _take_away(pk, g, shrink)
        log_weight[k] += total + weight * math.log(product)


@compiled
def predicted_ranges(
    x: Floats, p: Floats, first: Indices, second: Indices, dz: Floats
) -> tuple[Floats, Floats]:
    """Give mean and standard deviation (K, U) of pairs' slant distances in every hypothesis."""
    count, pairs = x.shape[0], first.shape[0]
    mean = np.empty((count, pairs))
    sigma = np.empty((count, pairs))
    for k in range(count):
        for u in range(pairs):
            m, v, _, _ = _predict_range(x[k], p[k], _N * first[u], _N * second[u], dz[u])
            mean[k, u] = m
            sigma[k, u] = math.sqrt(max(v, 0.0))
    return mean, sigma


@compiled
def moments(x: Floats, p: Floats, weight: Floats, angles: Indices) -> tuple[Floats, Floats]:
    """Give the mixture's mean (D,) and full covariance (D, D).

    ``angles`` (N,) are the headings' places: they are averaged round the circle, about the
    heaviest hypothesis' value.
    """
    count, size = x.shape
    mean = np.zeros(size)
    cov = np.zeros((size, size))
    best = 0
    for k in range(count):
        if weight[k] > weight[best]:
            best = k
    turn = 2.0 * math.pi
    off = np.empty((count, size))
    for k in range(count):
        for q in range(size):
            off[k, q] = x[k, q] - x[best, q]
        for n in range(angles.shape[0]):
            off[k, angles[n]] -= turn * np.rint(off[k, angles[n]] / turn)
        for q in range(size):
            mean[q] += weight[k] * off[k, q]
    for k in range(count):
        w = weight[k]
        if w > 0.0:
            for q in range(size):
                off[k, q] -= mean[q]
            for o in range(size):
                f = w * off[k, o]
                # What is symmetric is read and summed but once: this is bound by memory.
                for q in range(o + 1):
                    cov[o, q] += w * p[k, o, q] + f * off[k, q]
    for q in range(size):
        mean[q] += x[best, q]
        for o in range(q):
            cov[o, q] = cov[q, o]
    return mean, cov
