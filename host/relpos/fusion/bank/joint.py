"""Kernels of the joint error-state filter over all users, for many hypotheses at once.

One hypothesis is a mean (D,) and a covariance (D, D) over all users: five entries a user in the
order of :class:`Of`, then (where modelled) the range biases. Kernels work in place, eight
hypotheses at a time (:mod:`relpos.fusion.bank.lanes`): ``x`` (B, D, LANES) and ``p`` (B, D (D + 1)
/ 2,
LANES) are B blocks of eight, of a covariance the lower triangle alone, row by row. In this
storage all users' poses (x, y, heading) come first, then all constants (drift, scale), then the
biases, so that what a block does not model is at its end; :func:`pack` and :func:`unpack` convert.
Their twins are in :mod:`reference.joint`.

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
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from relpos.fusion.bank import lanes
from relpos.fusion.bank.lanes import LANES, Lanes, fill, greater, lesser, load, select, some, store
from relpos.fusion.compiled import compiled, inner

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
_POSE = 3
_CONSTANTS = 2
_TINY = 1e-12

STATS = 12
MEAN, VARIANCE, EVIDENCE, TRUST, SHARES, RANGE_SHARE, BENT = 0, 1, 2, 3, 4, 10, 11
"""Columns of what :func:`update` tells of each range; of ``SHARES`` there are six."""

DRIFT_WALK = 3e-9
SCALE_WALK = 3e-7
"""Random walks of the two constants, rad^2/s^2 and 1 per second of moving: 0.06 deg/s and 1 % in
five minutes. Without them resampling makes the reported sd up to twice too small."""

_POINTS = 11
_ASIDE = 2.5
"""P(heard) is averaged over so many points, out to so many standard deviations."""
_Z = _ASIDE * np.linspace(-1.0, 1.0, _POINTS)
_BELL = np.exp(-0.5 * _Z**2)
_RULE_VARIANCE = float((_Z**2 * _BELL).sum() / _BELL.sum())
_NORM = float(_BELL.sum())
_FAR = 9.0
"""Squared distance, in range variances, from which on noise of either sign is seen alike."""


# -- storage ---------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def order(nodes: int, size: int) -> Indices:
    """Give the state's entry (D,) that each place of the storage holds."""
    user = PER_NODE * np.arange(nodes)[:, None]
    poses, constants = user + np.arange(_POSE), user + _POSE + np.arange(_CONSTANTS)
    return np.concatenate(
        [poses.ravel(), constants.ravel(), np.arange(PER_NODE * nodes, size)]
    ).astype(np.int64)


def place_of(entry: int, nodes: int) -> int:
    """Give the storage's place of an entry of the state."""
    user, part = divmod(entry, PER_NODE)
    if user >= nodes:
        return entry
    if part < _POSE:
        return _POSE * user + part
    return _POSE * nodes + _CONSTANTS * user + part - _POSE


def pack(x: Floats, p: Floats, nodes: int) -> tuple[Floats, Floats]:
    """Store means (K, D) and covariances (K, D, D); what is left of a block repeats the first."""
    count, size = x.shape
    blocks = lanes.blocks_of(count)
    stored = lanes.empty_lines(blocks, size), lanes.empty_lines(blocks, size * (size + 1) // 2)
    _pack(np.ascontiguousarray(x), np.ascontiguousarray(p), order(nodes, size), *stored)
    return stored


def unpack(x: Floats, p: Floats, nodes: int, count: int) -> tuple[Floats, Floats]:
    """Give means (K, D) and covariances (K, D, D) as they are stored."""
    size = x.shape[1]
    given = np.empty((count, size)), np.empty((count, size, size))
    _unpack(x, p, order(nodes, size), *given)
    return given


def means(x: Floats, nodes: int, count: int) -> Floats:
    """Give the means (K, D) alone."""
    flat = x.transpose(0, 2, 1).reshape(-1, x.shape[1])[:count]
    given = np.empty_like(flat)
    given[:, order(nodes, x.shape[1])] = flat
    return given


def triangle_place(i: int, j: int) -> int:
    """Give the place of a covariance in the triangle."""
    return i * (i + 1) // 2 + j if i >= j else j * (j + 1) // 2 + i


def take(of: Floats, chosen: Indices) -> Floats:
    """Give the hypotheses ``chosen`` (M,) of an array (B, ..., LANES) as another."""
    taken = lanes.empty_lines(lanes.blocks_of(len(chosen)), of.shape[1])
    _take(of, chosen, taken)
    return taken


@compiled
def _pack(x: Floats, p: Floats, of: Indices, to_x: Floats, to_p: Floats) -> None:
    count, size = x.shape
    for b in range(to_x.shape[0]):
        for lane in range(LANES):
            k = b * LANES + lane
            if k >= count:
                k = 0
            t = 0
            for i in range(size):
                to_x[b, i, lane] = x[k, of[i]]
                for j in range(i + 1):
                    to_p[b, t, lane] = p[k, of[i], of[j]]
                    t += 1


@compiled
def _unpack(x: Floats, p: Floats, of: Indices, to_x: Floats, to_p: Floats) -> None:
    count, size = to_x.shape
    for k in range(count):
        b, lane = k // LANES, k % LANES
        t = 0
        for i in range(size):
            to_x[k, of[i]] = x[b, i, lane]
            for j in range(i + 1):
                to_p[k, of[i], of[j]] = p[b, t, lane]
                to_p[k, of[j], of[i]] = p[b, t, lane]
                t += 1


@compiled
def _take(of: Floats, chosen: Indices, to: Floats) -> None:
    count, rows = chosen.shape[0], of.shape[1]
    taken, given = of.reshape(-1), to.reshape(-1)
    # Unsigned, and in registers: a sixth of the time.
    begin = np.empty(LANES, dtype=np.uintp)
    for b in range(to.shape[0]):
        for at in range(LANES):
            k = chosen[min(b * LANES + at, count - 1)]
            begin[at] = (k // LANES) * rows * LANES + k % LANES
        b0, b1, b2, b3 = begin[0], begin[1], begin[2], begin[3]
        b4, b5, b6, b7 = begin[4], begin[5], begin[6], begin[7]
        for t in range(rows):
            line = np.uintp(t * LANES)
            own = np.uintp(b * rows * LANES) + line
            given[own] = taken[b0 + line]
            given[own + np.uintp(1)] = taken[b1 + line]
            given[own + np.uintp(2)] = taken[b2 + line]
            given[own + np.uintp(3)] = taken[b3 + line]
            given[own + np.uintp(4)] = taken[b4 + line]
            given[own + np.uintp(5)] = taken[b5 + line]
            given[own + np.uintp(6)] = taken[b6 + line]
            given[own + np.uintp(7)] = taken[b7 + line]


@inner
def _row(i: int) -> int:
    """Where a row of the triangle begins."""
    return (i * (i + 1)) >> 1


@inner
def _at(i: int, j: int) -> int:
    """Place of an entry in the triangle."""
    return ((i * (i + 1)) >> 1) + j if i >= j else ((j * (j + 1)) >> 1) + i


@inner
def _extent(p: Floats, base: int, nodes: int, size: int) -> int:
    """Give how many entries of the state vary in a block: poses, and constants, and biases."""
    poses = PER_NODE * nodes
    if size > poses and some(load(p, base + _at(poses, poses)) > 0.0):
        return size
    for i in range(_POSE * nodes, poses):
        if some(load(p, base + _at(i, i)) > 0.0):
            return poses
    return _POSE * nodes


# -- motion ----------------------------------------------------------------------------------------


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
    the turn (rad^2) and white in heading (rad^2); ``level`` (B, N, 3, LANES) multiplies these
    three for each user. ``sens`` (B, N, 3, 6, LANES) is how each user's own pose covariance (xx,
    xy, yy, xh, yh, hh) changes with the logarithm of each of its levels; what leaks to others is
    left out. ``sampled`` (K, M) are standard normals: the share ``share`` of the heading's
    variance is drawn, the rest goes into the covariance. ``cross`` is the variance across the
    way relative to that along it.
    """
    nodes = level.shape[1]
    size = x.shape[1]
    count = sampled.shape[0]
    # What a user's displacements did to x and y per heading, drift and scale, and to the heading.
    moved = lanes.working_lines(PER_NODE * nodes)
    normals = lanes.working_lines(rows.shape[0])
    touched = np.empty(nodes, dtype=np.bool_)
    for b in range(x.shape[0]):
        for lane in range(LANES):
            k = min(b * LANES + lane, count - 1)
            for m in range(rows.shape[0]):
                normals[m, lane] = sampled[k, m]
        for row in range(nodes):
            touched[row] = False
            for entry in range(PER_NODE):
                store(moved, PER_NODE * row + entry, fill(0.0))
        base = b * p.shape[1]
        active = _extent(p, base, nodes, size)
        constant = active > _POSE * nodes
        for m in range(rows.shape[0]):
            row = rows[m]
            moves = motion[m, 0] != 0.0 or motion[m, 1] != 0.0
            touched[row] |= moves or (constant and motion[m, 3] > 0.0)
            _move(
                x, p, level, sens, moved, b * size, base, b * nodes, nodes, row, motion[m],
                load(normals, m), share, cross, moves, constant,
            )  # fmt: skip
        for row in range(nodes):
            if touched[row]:
                _move_others(p, base, moved, nodes, row, active)


@inner
def _move(
    x: Floats, p: Floats, level: Floats, sens: Floats, moved: Floats, at_x: int, base: int,
    at_user: int, nodes: int, row: int, motion: Floats, normal: Lanes, share: float, cross: float,
    moves: bool, constant: bool,
) -> None:  # fmt: skip
    """Make one displacement of one user in one block: its own poses and covariances."""
    px, py, ph = _POSE * row, _POSE * row + 1, _POSE * row + 2
    pw = _POSE * nodes + _CONSTANTS * row
    i_xx, i_xy, i_yy = base + _row(px) + px, base + _row(py) + px, base + _row(py) + py
    i_xh = base + _row(ph) + px
    i_yh, i_hh = i_xh + 1, i_xh + 2
    i_xw, i_xs = base + _row(pw) + px, base + _row(pw + 1) + px
    i_ww, i_ws = base + _row(pw) + pw, base + _row(pw + 1) + pw
    dx, dy, dt = motion[0], motion[1], motion[3]
    user = (at_user + row) * 3
    t = user * 6
    turn = motion[5] * load(level, user + 1)
    white = motion[6] * load(level, user + 2)
    noise = turn + white
    store(sens, t + 11, load(sens, t + 11) + turn)
    store(sens, t + 17, load(sens, t + 17) + white)
    heading = load(x, at_x + ph) + normal * lanes.sqrt(share * noise)
    hh = load(p, i_hh) + (1.0 - share) * noise
    nought = fill(0.0)
    drift, hw, ww = nought, nought, nought
    if constant:
        drift, hw, ww = load(x, at_x + pw), load(p, i_xw + 2), load(p, i_ww)
    if moves:
        c, s = lanes.cos_sin(heading - (0.5 * dt) * drift)
        # E R(theta) of an uncertain heading is shorter by exp(-var/2); what that leaves
        # of the spread along and across the way is noise (statistical linearisation).
        vary = greater(hh - dt * hw, nought)
        short = lanes.exp(-0.5 * vary)
        shorter = short * short
        grow = fill(1.0)
        if constant:
            grow = lanes.exp(load(x, at_x + pw + 1))
        way2 = dx * dx + dy * dy
        full = grow * grow * way2
        ahead, aside = c * dx - s * dy, s * dx + c * dy
        east, north = grow * short * ahead, grow * short * aside
        store(x, at_x + px, load(x, at_x + px) + east)
        store(x, at_x + py, load(x, at_x + py) + north)
        xx, xy, yy = load(p, i_xx), load(p, i_xy), load(p, i_yy)
        xh, yh = load(p, i_xh), load(p, i_yh)
        if constant:
            half = 0.5 * dt
            xw, yw = load(p, i_xw), load(p, i_xw + 1)
            xs, ys, hs = load(p, i_xs), load(p, i_xs + 1), load(p, i_xs + 2)
            ws, ss = load(p, i_ws), load(p, i_ws + 1)
            th, tw, ts = hh - half * hw, hw - half * ww, hs - half * ws
            tx, ty = xh - half * xw, yh - half * yw
            x_x, x_y = xx - north * tx + east * xs, xy - north * ty + east * ys
            y_y = yy + east * ty + north * ys
            xh, yh = xh - north * th + east * hs, yh + east * th + north * hs
            xw, yw = xw - north * tw + east * ws, yw + east * tw + north * ws
            xs, ys = xs - north * ts + east * ss, ys + east * ts + north * ss
            tx, ty = xh - half * xw, yh - half * yw
            xx, xy = x_x - north * tx + east * xs, x_y + east * tx + north * xs
            yy = y_y + east * ty + north * ys
            store(p, i_xw, xw)
            store(p, i_xw + 1, yw)
            store(p, i_xs, xs)
            store(p, i_xs + 1, ys)
        else:
            xx = xx + north * (north * hh - 2.0 * xh)
            yy = yy + east * (east * hh + 2.0 * yh)
            xy = xy + east * xh - north * yh - east * north * hh
            xh, yh = xh - north * hh, yh + east * hh
        # The heading that this displacement follows has itself drifted since.
        lag = load(moved, PER_NODE * row + 4) + 0.5 * dt
        for entry, much in enumerate((east, north, north * lag, 0.0 - east * lag)):
            at = PER_NODE * row + entry
            store(moved, at, load(moved, at) + much)
        for part in range(3):
            _turn_sensitivity(sens, t + 6 * part, east, north)
        along = motion[4] * load(level, user)
        if way2 > _TINY:
            unit = 1.0 / way2
            ee, nn, en = ahead * ahead * unit, aside * aside * unit, ahead * aside * unit
            lost = 0.5 * full * (1.0 - shorter) * (1.0 - shorter)
            swept = full * greater(0.5 - 0.5 * shorter * shorter - vary * shorter, nought)
            length = along + lost
            width = along * cross + swept
            xx = xx + length * ee + width * nn
            yy = yy + length * nn + width * ee
            xy = xy + (length - width) * en
            store(sens, t, load(sens, t) + along * (ee + cross * nn))
            store(sens, t + 1, load(sens, t + 1) + along * (1.0 - cross) * en)
            store(sens, t + 2, load(sens, t + 2) + along * (nn + cross * ee))
        store(p, i_xx, xx)
        store(p, i_xy, xy)
        store(p, i_yy, yy)
        store(p, i_xh, xh)
        store(p, i_yh, yh)
    heading = heading + (motion[2] - dt * drift)
    store(x, at_x + ph, heading)
    if constant and dt > 0.0:
        store(moved, PER_NODE * row + 4, load(moved, PER_NODE * row + 4) + dt)
        store(p, i_xh, load(p, i_xh) - dt * load(p, i_xw))
        store(p, i_yh, load(p, i_yh) - dt * load(p, i_xw + 1))
        hh = hh - dt * (2.0 * hw - dt * ww)
        store(p, i_xw + 2, hw - dt * ww)
        store(p, i_xs + 2, load(p, i_xs + 2) - dt * load(p, i_ws))
        store(p, i_ww, select(ww > 0.0, ww + DRIFT_WALK * dt, ww))
        ss = load(p, i_ws + 1)
        store(p, i_ws + 1, select(ss > 0.0, ss + SCALE_WALK * dt, ss))
    store(p, i_hh, hh)


@inner
def _turn_sensitivity(sens: Floats, t: int, east: Lanes, north: Lanes) -> None:
    """Carry one sensitivity (xx, xy, yy, xh, yh, hh) at ``t`` over a displacement."""
    xh, yh, hh = load(sens, t + 3), load(sens, t + 4), load(sens, t + 5)
    store(sens, t, load(sens, t) + north * (north * hh - 2.0 * xh))
    store(sens, t + 1, load(sens, t + 1) + east * xh - north * yh - east * north * hh)
    store(sens, t + 2, load(sens, t + 2) + east * (east * hh + 2.0 * yh))
    store(sens, t + 3, xh - north * hh)
    store(sens, t + 4, yh + east * hh)


@inner
def _move_others(p: Floats, base: int, moved: Floats, nodes: int, row: int, active: int) -> None:
    """Carry a user's covariance with everything else over all its displacements at once.

    ``moved`` (5 N, LANES) is for each user east and north (m), what a unit of drift does to x and
    to y, and the time (s).
    """
    px, pw = _POSE * row, _POSE * nodes + _CONSTANTS * row
    m = PER_NODE * row
    east, north, time = load(moved, m), load(moved, m + 1), load(moved, m + 4)
    drift_x, drift_y = load(moved, m + 2), load(moved, m + 3)
    r_x, r_y, r_h = base + _row(px), base + _row(px + 1), base + _row(px + 2)
    if active == _POSE * nodes:
        for q in range(px):
            h = load(p, r_h + q)
            store(p, r_x + q, load(p, r_x + q) - north * h)
            store(p, r_y + q, load(p, r_y + q) + east * h)
        for q in range(px + _POSE, active):
            at = base + _row(q) + px
            h = load(p, at + 2)
            store(p, at, load(p, at) - north * h)
            store(p, at + 1, load(p, at + 1) + east * h)
        return
    r_w, r_s = base + _row(pw), base + _row(pw + 1)
    for q in range(active):
        if px <= q < px + _POSE or pw <= q <= pw + 1:
            continue
        at = base + _row(q)
        i_x, i_y, i_h = at + px, at + px + 1, at + px + 2
        i_w, i_s = at + pw, at + pw + 1
        if q < px:
            i_x, i_y, i_h = r_x + q, r_y + q, r_h + q
        if q < pw:
            i_w, i_s = r_w + q, r_s + q
        h, w, s = load(p, i_h), load(p, i_w), load(p, i_s)
        store(p, i_x, load(p, i_x) + east * s - north * h + drift_x * w)
        store(p, i_y, load(p, i_y) + north * s + east * h + drift_y * w)
        store(p, i_h, h - time * w)


# -- ranges ----------------------------------------------------------------------------------------


@inner
def _second_order(
    ux: Lanes, uy: Lanes, xx: Lanes, xy: Lanes, yy: Lanes, dz: float
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Give a range's mean m, variance v, and the two gains' factors gx, gy."""
    flat2 = ux * ux + uy * uy
    # Along the line of sight, without a square root.
    along = (ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy) / greater(flat2, fill(_TINY))
    nought = fill(0.0)
    a = greater(select(flat2 > _TINY, along, 0.5 * (xx + yy)), nought)
    # Across it; rounding may leave a trace of nothing on the wrong side.
    c = greater(xx + yy - a, nought)
    # A division costs as much as ten products.
    m2, square = flat2 + c, c * c
    if dz != 0.0:
        tilt = (dz * dz) / (flat2 + (dz * dz + _TINY))
        m2 = m2 + (dz * dz + tilt * a)
        square = square + tilt * tilt * a * a
    m = lanes.sqrt(m2) + _TINY
    v = (a * flat2 + 0.5 * square) / (m2 + _TINY)
    per_m = 1.0 / m
    return m, v, ux * per_m, uy * per_m


@inner
def _predict_range(
    x: Floats, p: Floats, at_x: int, base: int, i: int, j: int, dz: float
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """As ``_second_order``, between users whose poses begin at ``i`` and ``j``."""
    ux = load(x, at_x + j) - load(x, at_x + i)
    uy = load(x, at_x + j + 1) - load(x, at_x + i + 1)
    i_x, i_y = base + _row(i) + i, base + _row(i + 1) + i
    j_x, j_y = base + _row(j) + j, base + _row(j + 1) + j
    xx = load(p, i_x) + load(p, j_x) - 2.0 * load(p, base + _at(i, j))
    yy = load(p, i_y + 1) + load(p, j_y + 1) - 2.0 * load(p, base + _at(i + 1, j + 1))
    xy = load(p, i_y) + load(p, j_y)
    xy = xy - load(p, base + _at(i, j + 1)) - load(p, base + _at(i + 1, j))
    return _second_order(ux, uy, xx, xy, yy, dz)


@inner
def _range_by_arms(
    x: Floats, p: Floats, at_x: int, base: int, i: int, j: int, dz: float, arm_i: Floats,
    arm_j: Floats, active: int, east: Floats, north: Floats, g: Floats,
) -> tuple[Lanes, Lanes, Lanes, Lanes]:  # fmt: skip
    """As ``_predict_range`` between antennas off their poses; ``g`` (D, LANES) gets P h.

    An antenna at o = R(theta) arm moves by (-o_y, o_x) per radian of heading, so the heading has
    a share in the line of sight. ``east`` and ``north`` (D, LANES) are working space.
    """
    ci, si = lanes.cos_sin(load(x, at_x + i + 2))
    cj, sj = lanes.cos_sin(load(x, at_x + j + 2))
    xi, yi = ci * arm_i[0] - si * arm_i[1], si * arm_i[0] + ci * arm_i[1]
    xj, yj = cj * arm_j[0] - sj * arm_j[1], sj * arm_j[0] + cj * arm_j[1]
    ux = load(x, at_x + j) + xj - load(x, at_x + i) - xi
    uy = load(x, at_x + j + 1) + yj - load(x, at_x + i + 1) - yi
    for q in range(active):
        hi, hj = load(p, base + _at(i + 2, q)), load(p, base + _at(j + 2, q))
        off = load(p, base + _at(j, q)) - load(p, base + _at(i, q))
        store(east, q, off - yj * hj + yi * hi)
        off = load(p, base + _at(j + 1, q)) - load(p, base + _at(i + 1, q))
        store(north, q, off + xj * hj - xi * hi)
    xx = load(east, j) - load(east, i) - yj * load(east, j + 2) + yi * load(east, i + 2)
    xy = load(north, j) - load(north, i) - yj * load(north, j + 2) + yi * load(north, i + 2)
    yy = load(north, j + 1) - load(north, i + 1)
    yy = yy + xj * load(north, j + 2) - xi * load(north, i + 2)
    m, v, gx, gy = _second_order(ux, uy, xx, xy, yy, dz)
    for q in range(active):
        store(g, q, gx * load(east, q) + gy * load(north, q))
    return m, v, gx, gy


@inner
def _gain(
    p: Floats, base: int, i: int, j: int, gx: Lanes, gy: Lanes, active: int, g: Floats
) -> None:
    """Write P h of a range into ``g`` (D, LANES)."""
    if i > j:
        i, j, gx, gy = j, i, 0.0 - gx, 0.0 - gy
    i_x, i_y, j_x, j_y = (base + _row(i), base + _row(i + 1), base + _row(j), base + _row(j + 1))
    for q in range(i):
        off_x = load(p, j_x + q) - load(p, i_x + q)
        off_y = load(p, j_y + q) - load(p, i_y + q)
        store(g, q, gx * off_x + gy * off_y)
    for q in range(i, i + 2):
        off_x = load(p, j_x + q) - load(p, base + _at(q, i))
        off_y = load(p, j_y + q) - load(p, base + _at(q, i + 1))
        store(g, q, gx * off_x + gy * off_y)
    for q in range(i + 2, j):
        at = base + _row(q) + i
        off_x = load(p, j_x + q) - load(p, at)
        off_y = load(p, j_y + q) - load(p, at + 1)
        store(g, q, gx * off_x + gy * off_y)
    for q in range(j, j + 2):
        at = base + _row(q) + i
        off_x = load(p, base + _at(q, j)) - load(p, at)
        off_y = load(p, base + _at(q, j + 1)) - load(p, at + 1)
        store(g, q, gx * off_x + gy * off_y)
    for q in range(j + 2, active):
        at = base + _row(q)
        off_x = load(p, at + j) - load(p, at + i)
        off_y = load(p, at + j + 1) - load(p, at + i + 1)
        store(g, q, gx * off_x + gy * off_y)


@inner
def _correct(
    x: Floats, p: Floats, at_x: int, base: int, g: Floats, move: Lanes, shrink: Lanes, active: int
) -> None:
    """Add ``move`` g to a block's means and take ``shrink`` g g^T from its covariances."""
    t = base
    for o in range(active):
        own = load(g, o)
        store(x, at_x + o, load(x, at_x + o) + move * own)
        f = shrink * own
        for q in range(o + 1):
            store(p, t + q, load(p, t + q) - f * load(g, q))
        t += o + 1


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
    """Keep what the levels explain of a covariance below ``most`` times the covariance.

    It is homogeneous in all variances, so that a true derivative obeys it with ``most`` 1.
    """
    excess = fill(0.0)
    for entry in range(3):
        at = t + 2 * entry + (entry == 2)
        explained = load(sens, at) + load(sens, at + 6) + load(sens, at + 12)
        bound = most * load(p, base + _at(b + entry, b + entry)) + _TINY
        excess = greater(excess, explained - bound)
    if not some(excess > 0.0):
        return
    ratio = fill(1.0)
    for entry in range(3):
        at = t + 2 * entry + (entry == 2)
        explained = load(sens, at) + load(sens, at + 6) + load(sens, at + 12)
        bound = most * load(p, base + _at(b + entry, b + entry)) + _TINY
        ratio = greater(ratio, explained / bound)
    for at in range(t, t + 18):
        store(sens, at, load(sens, at) / ratio)


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
    worth: Floats,
    dz_variance: Floats,
    arms: Floats,
    stats: Floats,
) -> None:
    """Work in ranges (R,) one after another; each hypothesis' log weight gets their evidence.

    ``first``, ``second`` (R,) are users' rows, ``bias`` the place of a range's bias or -1;
    biases come last in the state, their common part first, and a
    hypothesis whose common part has no variance has none. ``log_weight`` and ``sigma2`` (B, LANES)
    are each hypothesis' log weight and range variance. ``outlier`` is the share, the variance
    (m^2), the share of these that are too short, and the whole motion noise over what of it is
    in the covariances. An innovation that may be an outlier's is
    used by its probability r of being none (probabilistic data association): the mean moves by
    r K nu, the covariance keeps the spread between used and not used.

    ``worth`` (R,) is how many independent ranges one is worth: the variance that the gain sees is
    divided by it, the evidence multiplied. ``dz_variance`` (R,) is the variance of ``dz``.
    ``arms`` (N, 2) are the antennas' places (forward, left) of the poses, or empty (0, 2) where
    all are zero. ``stats`` (R, STATS, B, LANES) receives m, S, the range's log evidence, r, and by
    how much S grows with the logarithms of the three levels of the first and of the second user
    and of the range variance (``sens``), and what of S is due to curvature.
    """
    blocks, size = x.shape[0], x.shape[1]
    nodes = sens.shape[1]
    g, east, north = (
        lanes.working_lines(size), lanes.working_lines(size), lanes.working_lines(size),
    )  # fmt: skip
    share, wide, short, most = outlier[0], outlier[1], outlier[2], outlier[3]
    for b in range(blocks):
        at_x, base = b * size, b * p.shape[1]
        active = _extent(p, base, nodes, size)
        biased = active > PER_NODE * nodes
        variance = load(sigma2, b)
        total = fill(0.0)
        for r in range(first.shape[0]):
            i, j = _POSE * first[r], _POSE * second[r]
            if arms.shape[0] > 0:
                m, v, gx, gy = _range_by_arms(
                    x, p, at_x, base, i, j, dz[r], arms[first[r]], arms[second[r]], active,
                    east, north, g,
                )  # fmt: skip
            else:
                m, v, gx, gy = _predict_range(x, p, at_x, base, i, j, dz[r])
                _gain(p, base, i, j, gx, gy, active, g)
            bent = v - gx * (load(g, j) - load(g, i)) - gy * (load(g, j + 1) - load(g, i + 1))
            if dz_variance[r] > 0.0:
                v = v + (dz[r] * dz[r] * dz_variance[r]) / (m * m)
            innovation = measured[r] - m
            if biased and bias[r] >= 0:
                # No range is negative: between two who stand together noise alone looks like
                # a bias.
                e = bias[r]
                far = m * m > _FAR * variance
                nought, one = fill(0.0), fill(1.0)
                seen = select(far, one, nought)
                innovation = innovation - seen * load(x, at_x + e)
                v = v + seen * (2.0 * load(g, e) + load(p, base + _row(e) + e))
                for q in range(active):
                    store(g, q, load(g, q) + seen * load(p, base + _at(e, q)))
            s = v + variance
            square = innovation * innovation
            per_sd = 1.0 / lanes.sqrt(s)
            good = (1.0 - share) * lanes.exp(-0.5 * square * per_sd * per_sd) * per_sd
            per_wide = 1.0 / lanes.sqrt(s + wide)
            side = select(innovation > 0.0, fill(2.0 * (1.0 - short)), fill(2.0 * short))
            bad = share * side * lanes.exp(-0.5 * square * per_wide * per_wide) * per_wide
            # Where both vanish, it is certainly no good one.
            both = good + bad + 1e-300
            trust = good / both
            evidence = lanes.log(both)
            total = total + worth[r] * evidence
            per_heavy = 1.0 / (v + variance * (1.0 / worth[r]))
            kf = trust * per_heavy
            shrink = kf * (1.0 - (1.0 - trust) * square * per_heavy)
            _correct(x, p, at_x, base, g, kf * innovation, shrink, active)
            at = r * STATS * blocks + b
            store(stats, at, measured[r] - innovation)
            store(stats, at + VARIANCE * blocks, s)
            store(stats, at + EVIDENCE * blocks, evidence)
            store(stats, at + TRUST * blocks, trust)
            store(stats, at + RANGE_SHARE * blocks, variance)
            store(stats, at + BENT * blocks, bent)
            back_x, back_y = 0.0 - gx, 0.0 - gy
            user_i, user_j = (b * nodes + first[r]) * 18, (b * nodes + second[r]) * 18
            ix, iy, ih = kf * load(g, i), kf * load(g, i + 1), kf * load(g, i + 2)
            jx, jy, jh = kf * load(g, j), kf * load(g, j + 1), kf * load(g, j + 2)
            for part in range(3):
                grown = _correct_sensitivity(sens, user_i + 6 * part, back_x, back_y, ix, iy, ih)
                store(stats, at + (SHARES + part) * blocks, grown)
                grown = _correct_sensitivity(sens, user_j + 6 * part, gx, gy, jx, jy, jh)
                store(stats, at + (SHARES + 3 + part) * blocks, grown)
            _bound_sensitivity(sens, user_i, p, base, i, most)
            _bound_sensitivity(sens, user_j, p, base, j, most)
        store(log_weight, b, load(log_weight, b) + total)


@compiled
def update_heading(
    x: Floats,
    p: Floats,
    log_weight: Floats,
    nodes: int,
    row: int,
    measured: float,
    sigma2: float,
    share: float,
    wide: float,
) -> None:
    """Work in one absolute heading of a user; outliers as in :func:`update`, both signs alike."""
    size = x.shape[1]
    g = lanes.working_lines(size)
    h = _POSE * row + 2
    turn = 2.0 * math.pi
    for b in range(x.shape[0]):
        at_x, base = b * size, b * p.shape[1]
        active = _extent(p, base, nodes, size)
        innovation = measured - load(x, at_x + h)
        innovation = innovation - turn * lanes.floor(innovation * (1.0 / turn) + 0.5)
        for q in range(active):
            store(g, q, load(p, base + _at(h, q)))
        s = load(g, h) + sigma2
        square = innovation * innovation
        good = (1.0 - share) * lanes.exp(-0.5 * square / s) / lanes.sqrt(s)
        bad = share * lanes.exp(-0.5 * square / (s + wide)) / lanes.sqrt(s + wide)
        both = good + bad + 1e-300
        trust = good / both
        kf = trust / s
        _correct(
            x, p, at_x, base, g, kf * innovation, kf * (1.0 - (1.0 - trust) * square / s), active
        )
        store(log_weight, b, load(log_weight, b) + lanes.log(both))


# -- who is heard ----------------------------------------------------------------------------------


@inner
def _outcome(place: Lanes, heard: bool, tried: float, curve: Floats) -> Lanes:
    """Probability that a pair is heard, or is silent, at a multiple of the curve's step."""
    last = curve.shape[0] - 2.0
    kept = lesser(greater(place, fill(0.0)), fill(last + 1.0))
    index = lesser(lanes.floor(kept), fill(last))
    here = lanes.look_up(curve, index)
    chance = here + (kept - index) * (lanes.look_up(curve, index + 1.0) - here)
    return chance if heard else 1.0 - tried * chance


@compiled
def hearing(
    x: Floats,
    p: Floats,
    log_weight: Floats,
    nodes: int,
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
    size = x.shape[1]
    g = lanes.working_lines(size)
    per_step = 1.0 / step_m
    nought, one = fill(0.0), fill(1.0)
    for b in range(x.shape[0]):
        at_x, base = b * size, b * p.shape[1]
        active = _extent(p, base, nodes, size)
        total, product = nought, one
        for u in range(first.shape[0]):
            i, j = _POSE * first[u], _POSE * second[u]
            m, v, gx, gy = _predict_range(x, p, at_x, base, i, j, dz[u])
            sd = lanes.sqrt(greater(v, nought))
            place, aside = per_step * m, per_step * sd
            middle = _outcome(place, heard[u], tried[u], curve)
            near = _outcome(place - _ASIDE * aside, heard[u], tried[u], curve)
            far = _outcome(place + _ASIDE * aside, heard[u], tried[u], curve)
            # Almost everywhere the curve is flat. Roots differ by less than what they are of
            # (``weight`` is at most 1), so logarithms are only taken where that does not settle it.
            low, high = lesser(near, far) / middle, greater(near, far) / middle
            steep = greater(0.97 - low, high - 1.03)
            if some(steep > 0.0):
                low, high = weight * lanes.log(low), weight * lanes.log(high)
                steep = select(
                    steep > 0.0, greater(math.log(0.97) - low, high - math.log(1.03)), steep
                )
            product = product * select(steep > 0.0, one, middle)
            if some(product < 1e-200):
                total = total + weight * lanes.log(product)
                product = one
            if not some(steep > 0.0):
                continue
            mass, shift, square = nought, nought, nought
            for q in range(_POINTS):
                z, bell = _Z[q], _BELL[q]
                chance = _outcome(place + z * aside, heard[u], tried[u], curve)
                density = bell * lanes.exp(weight * lanes.log(chance))
                mass = mass + density
                shift = shift + density * z
                square = square + density * (z * z)
            shift = shift / mass
            # The rule's own variance is a little under 1: a flat curve must change nothing.
            after = lesser((square / mass - shift * shift) / _RULE_VARIANCE, one)
            _gain(p, base, i, j, gx, gy, active, g)
            # g g^T / v never exceeds P: v also holds the curvature's part.
            move = select(steep > 0.0, shift / sd, nought)
            shrink = select(steep > 0.0, (1.0 - after) / v, nought)
            total = total + select(steep > 0.0, lanes.log(mass * (1.0 / _NORM)), nought)
            _correct(x, p, at_x, base, g, move, shrink, active)
        store(log_weight, b, load(log_weight, b) + total + weight * lanes.log(product))


# -- what is known ---------------------------------------------------------------------------------


@compiled
def predicted_ranges(
    x: Floats, p: Floats, weight: Floats, first: Indices, second: Indices, dz: Floats
) -> tuple[Floats, Floats]:
    """Give mean and standard deviation (U,) of pairs' slant distances over all hypotheses.

    ``weight`` (B, LANES) are the normalised weights, 0 where a block has no hypothesis.
    """
    blocks, size = x.shape[0], x.shape[1]
    mean = np.empty(first.shape[0])
    sigma = np.empty(first.shape[0])
    ranges, variances = lanes.working_lines(blocks), lanes.working_lines(blocks)
    for u in range(first.shape[0]):
        middle = fill(0.0)
        for b in range(blocks):
            m, v, _, _ = _predict_range(
                x, p, b * size, b * p.shape[1], _POSE * first[u], _POSE * second[u], dz[u]
            )
            store(ranges, b, m)
            store(variances, b, v)
            middle = middle + load(weight, b) * m
        mean[u] = lanes.total(middle)
        spread = fill(0.0)
        for b in range(blocks):
            off = load(ranges, b) - mean[u]
            spread = spread + load(weight, b) * (greater(load(variances, b), fill(0.0)) + off * off)
        sigma[u] = math.sqrt(lanes.total(spread))
    return mean, sigma


@compiled
def moments(
    x: Floats, p: Floats, weight: Floats, nodes: int, of: Indices, places: int, size: int
) -> tuple[Floats, Floats]:
    """Give the mixture's mean (D,) and full covariance (D, D), in the state's order.

    ``weight`` (B, LANES) as for ``predicted_ranges``, ``of`` (D,) is ``order``. Of the storage
    beyond the first ``places`` only means and variances are given, its covariances as 0, and
    nothing beyond ``size``. Headings are averaged round the circle, about the heaviest
    hypothesis' value.
    """
    blocks, whole, triangle = x.shape[0], x.shape[1], p.shape[1]
    best, best_lane = 0, 0
    for b in range(blocks):
        for lane in range(LANES):
            if weight[b, lane] > weight[best, best_lane]:
                best, best_lane = b, lane
    mean = np.zeros(whole)
    cov = np.zeros((whole, whole))
    turn = 2.0 * math.pi
    off = lanes.working_lines(blocks * size)
    for i in range(size):
        about = x[best, i, best_lane]
        angle = i < _POSE * nodes and i % _POSE == 2
        middle = fill(0.0)
        for b in range(blocks):
            away = load(x, b * whole + i) - about
            if angle:
                away = away - turn * lanes.floor(away * (1.0 / turn) + 0.5)
            store(off, b * size + i, away)
            middle = middle + load(weight, b) * away
        away_from = lanes.total(middle)
        mean[of[i]] = about + away_from
        for b in range(blocks):
            store(off, b * size + i, load(off, b * size + i) - away_from)
    sums = lanes.working_lines(_row(places))
    for t in range(_row(places)):
        store(sums, t, fill(0.0))
    for b in range(blocks):
        w = load(weight, b)
        base, at_x = b * triangle, b * size
        t = 0
        for i in range(places):
            f = w * load(off, at_x + i)
            for j in range(i + 1):
                term = w * load(p, base + t + j) + f * load(off, at_x + j)
                store(sums, t + j, load(sums, t + j) + term)
            t += i + 1
    t = 0
    for i in range(places):
        for j in range(i + 1):
            cov[of[i], of[j]] = lanes.total(load(sums, t))
            cov[of[j], of[i]] = cov[of[i], of[j]]
            t += 1
    for i in range(places, size):
        variance = fill(0.0)
        for b in range(blocks):
            away = load(off, b * size + i)
            own = load(p, b * triangle + _row(i) + i)
            variance = variance + load(weight, b) * (own + away * away)
        cov[of[i], of[i]] = lanes.total(variance)
    return mean, cov
