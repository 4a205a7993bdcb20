"""Kernels of the joint error-state filter over all users, for many hypotheses at once.

One hypothesis k is a mean ``x[k]`` (D,) and a covariance ``p[k]`` (D, D) over all users:
five entries a user in the order of :class:`Of`, then (where modelled) the range biases. All
kernels work in place on arrays whose first axis is the hypothesis; their twins are in
:mod:`relpos.fusion.twins.joint`.

Motion, with the heading's noise entering first (people turn, then move; a wearer's turn is
measured before the step that it directs):

    theta' = theta + w + drift dt/2,   p <- p + exp(scale) R(theta') (dx, dy),
    theta  <- theta + w + dtheta + drift dt

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

from relpos.fusion.compiled import compiled, inlined

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


class Of(IntEnum):
    """A user's entries in the joint state: world metres, radians, rad/s, log(true/reported)."""

    X = 0
    Y = 1
    HEADING = 2
    DRIFT = 3
    SCALE = 4


PER_NODE = len(Of)
_X, _Y, _H, _W, _S = (int(v) for v in Of)
_N = PER_NODE
_TINY = 1e-12
_FAR = 9.0
"""Squared distance, in range variances, from which on noise of either sign is seen alike."""


@compiled
def advance(
    x: Floats,
    p: Floats,
    level: Floats,
    rows: Indices,
    motion: Floats,
    sampled: Floats,
    share: float,
    cross: float,
) -> None:
    """Move users ``rows`` (M,) by ``motion`` (M, 7) in every hypothesis.

    ``motion`` is dx, dy, dtheta, duration, and the variances' bases: along the way (m^2), of
    the turn (rad^2) and white in heading (rad^2); ``level`` (K, N, 3) multiplies these three
    for each user. ``sampled`` (K, M) are standard normals: the share ``share`` of the heading's
    variance is drawn, the rest goes into the covariance. ``cross`` is the variance across the
    way relative to that along it.
    """
    count, size = x.shape
    poses = _N * level.shape[1]
    for k in range(count):
        xk = x[k]
        pk = p[k]
        size = x.shape[1]
        if size > poses and pk[poses, poses] == 0.0:
            size = poses
        for m in range(rows.shape[0]):
            row = rows[m]
            b = _N * row
            bx, by, bh, bw, bs = b + _X, b + _Y, b + _H, b + _W, b + _S
            dx, dy, dt = motion[m, 0], motion[m, 1], motion[m, 3]
            noise = motion[m, 5] * level[k, row, 1] + motion[m, 6] * level[k, row, 2]
            if noise > 0.0:
                xk[bh] += sampled[k, m] * math.sqrt(share * noise)
                pk[bh, bh] += (1.0 - share) * noise
            if dx != 0.0 or dy != 0.0:
                at = xk[bh] + 0.5 * dt * xk[bw]
                c, s = math.cos(at), math.sin(at)
                grow = math.exp(xk[bs])
                east, north = grow * (c * dx - s * dy), grow * (s * dx + c * dy)
                half = 0.5 * dt
                xk[bx] += east
                xk[by] += north
                for q in range(size):
                    turned = pk[bh, q] + half * pk[bw, q]
                    pk[bx, q] += east * pk[bs, q] - north * turned
                    pk[by, q] += north * pk[bs, q] + east * turned
                for q in range(size):
                    turned = pk[q, bh] + half * pk[q, bw]
                    pk[q, bx] += east * pk[q, bs] - north * turned
                    pk[q, by] += north * pk[q, bs] + east * turned
                square = east * east + north * north
                along = motion[m, 4] * level[k, row, 0]
                if square > _TINY:
                    ee, nn, en = east * east / square, north * north / square, east * north / square
                    pk[bx, bx] += along * (ee + cross * nn)
                    pk[by, by] += along * (nn + cross * ee)
                    pk[bx, by] += along * (1.0 - cross) * en
                    pk[by, bx] += along * (1.0 - cross) * en
            xk[bh] += motion[m, 2] + dt * xk[bw]
            if pk[bw, bw] > 0.0:
                for q in range(size):
                    pk[bh, q] += dt * pk[bw, q]
                for q in range(size):
                    pk[q, bh] += dt * pk[q, bw]


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
        # Along and across the line of sight, both without a square root.
        a = (ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy) / flat2
        c = xx + yy - a
    else:
        a = 0.5 * (xx + yy)
        c = a
    tilt = dz * dz / (flat2 + dz * dz + _TINY)
    m2 = flat2 + dz * dz + c + tilt * a
    m = math.sqrt(m2) + _TINY
    v = (a * flat2 + 0.5 * (c * c + tilt * tilt * a * a)) / (m2 + _TINY)
    return m, v, ux / m, uy / m


@compiled
def update(
    x: Floats,
    p: Floats,
    log_weight: Floats,
    sigma2: Floats,
    first: Indices,
    second: Indices,
    bias: Indices,
    measured: Floats,
    dz: Floats,
    outlier: Floats,
    poses: int,
    stats: Floats,
) -> None:
    """Work in ranges (R,) one after another; each hypothesis' log weight gets their evidence.

    ``first``, ``second`` (R,) are users' rows, ``bias`` the state of a range's bias or -1;
    biases come after the first ``poses`` entries of the state, their common part first, and a
    hypothesis whose common part has no variance has none. ``sigma2`` (K,) is each hypothesis'
    range variance. ``outlier`` is the share, the variance
    (m^2) and the share of these that are too short. An innovation that may be an outlier's is
    used by its probability r of being none (probabilistic data association): the mean moves by
    r K nu, the covariance keeps the spread between used and not used. ``stats`` (K, R, 3)
    receives r, nu^2/S and the range's log evidence.
    """
    count, size = x.shape
    g = np.empty(size)
    share, wide, short = outlier[0], outlier[1], outlier[2]
    for k in range(count):
        xk = x[k]
        pk = p[k]
        total = 0.0
        size = x.shape[1]
        biased = size > poses and pk[poses, poses] > 0.0
        if not biased:
            size = poses
        for r in range(first.shape[0]):
            bi, bj, e = _N * first[r], _N * second[r], bias[r] if biased else -1
            m, v, gx, gy = _predict_range(xk, pk, bi, bj, dz[r])
            innovation = measured[r] - m
            # No range is negative: between two who stand together noise alone looks like a bias.
            if e >= 0 and m * m > _FAR * sigma2[k]:
                innovation -= xk[e]
                for q in range(size):
                    g[q] = (
                        gx * (pk[bj, q] - pk[bi, q]) + gy * (pk[bj + 1, q] - pk[bi + 1, q])
                    ) + pk[e, q]
                v += g[e] + gx * (pk[bj, e] - pk[bi, e]) + gy * (pk[bj + 1, e] - pk[bi + 1, e])
            else:
                for q in range(size):
                    g[q] = gx * (pk[bj, q] - pk[bi, q]) + gy * (pk[bj + 1, q] - pk[bi + 1, q])
            s = v + sigma2[k]
            square = innovation * innovation
            good = (1.0 - share) * math.exp(-0.5 * square / s) / math.sqrt(s)
            spread = s + wide
            side = 2.0 * (1.0 - short) if innovation > 0.0 else 2.0 * short
            bad = share * side * math.exp(-0.5 * square / spread) / math.sqrt(spread)
            # Where both vanish, it is certainly no good one.
            both = good + bad + 1e-300
            trust = good / both
            total += math.log(both)
            scaled = trust * innovation / s
            shrink = trust / s * (1.0 - (1.0 - trust) * square / s)
            for q in range(size):
                xk[q] += scaled * g[q]
            for o in range(size):
                f = shrink * g[o]
                for q in range(size):
                    pk[o, q] -= f * g[q]
            stats[k, r, 0] = trust
            stats[k, r, 1] = square / s
            stats[k, r, 2] = math.log(both)
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
                for q in range(size):
                    cov[o, q] += w * p[k, o, q] + f * off[k, q]
    for q in range(size):
        mean[q] += x[best, q]
    return mean, cov
