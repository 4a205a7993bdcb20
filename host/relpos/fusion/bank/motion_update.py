"""Motion: how a reported displacement moves a user in every hypothesis.

The heading's noise enters first (people turn, then move; a wearer's turn is measured before the
step that it directs):

    theta' = theta + w - drift dt/2,   p <- p + exp(scale) R(theta') (dx, dy),
    theta  <- theta + w + dtheta - drift dt

A share of the heading's noise is drawn for each hypothesis, the rest goes into its covariance.
Reference implementation: :mod:`reference.joint`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank import lanes
from relpos.fusion.bank.lanes import LANES, Lanes, fill, greater, load, select, store
from relpos.fusion.bank.storage import (
    CONSTANTS,
    PER_NODE,
    POSE,
    TINY,
    Block,
    Hypotheses,
    block_of,
    row_place,
)
from relpos.fusion.compiled import compiled, inner
from relpos.fusion.models.motion import SCALE_WALK
from relpos.fusion.models.motion_variances import COMPONENTS, WHITE, base_variances

DRIFT_WALK = 3e-9
"""Random walk of the drift, rad^2/s^2 per second of moving: 0.06 deg/s in five minutes. Without it
resampling makes the reported sd up to twice too small."""

CROSS = 0.3
"""Variance across the way relative to along it; turns err apart from that.

Where it is too small, headings take what people swerve (docs/notebook/bank.md)."""

LEAST_TURN_RAD, TURN_STANDS_OUT = 0.05, 3.5
"""A change of heading is a turn beyond both: so much, and so many deviations of white noise."""
MISJUDGED, MISJUDGED_RAD = 0.1, 1.0
"""Share of hypotheses that misjudge a turn, and by how much. In P1 one right angle in some hundred
is reported as less than 20 degrees, and cost 0.5 m for a minute: seeds 1000 to 1009 0.206 m
without, 0.214 with a share of 0.05, 0.195 with 0.1 (worst 0.27, 0.38, 0.24); seeds 500 to 515,
where it does not happen, 0.192 and 0.195."""

STRAIGHT_S = 10.0
"""After going straight for so long. Without it, robots that turn every second (exp3, exp4 of
`two_robots_vio`) lost 0.08 and 0.10 m of 0.15."""


class Noise(NamedTuple):
    """How the noise of displacements enters."""

    normals: Floats
    """(K, M) standard normals, one for each hypothesis and displacement."""
    sampled: float
    """Share of the heading's variance that is drawn."""
    cross: float
    """Variance across the way relative to that along it."""


class _Places(NamedTuple):
    """Lines of one user's covariances in a block: the first of each row of the triangle."""

    xx: int
    xy: int
    """Then yy."""
    xh: int
    """Then yh, hh."""
    xw: int
    """Drift with x, y, heading."""
    xs: int
    """Scale with x, y, heading."""
    ww: int
    ws: int
    """Then ss."""


class _Heading(NamedTuple):
    """A user's heading in a block, its drift, and their (co)variances."""

    angle: Lanes
    drift: Lanes
    hh: Lanes
    hw: Lanes
    ww: Lanes


@compiled
def advance(hypotheses: Hypotheses, rows: Indices, motion: Floats, noise: Noise) -> None:
    """Move users ``rows`` (M,) by ``motion`` (M, 7) in every hypothesis.

    ``motion`` is dx, dy (m), dtheta (rad), duration (s), and the base variances: along the way
    (m^2), of the turn (rad^2) and white in heading (rad^2); ``hypotheses.component`` multiplies
    these three.
    """
    x, p = hypotheses.x, hypotheses.p
    nodes = hypotheses.component.shape[1]
    count = noise.normals.shape[0]
    # What a user's displacements did to x and y per heading, drift and scale, and to the heading.
    moved = lanes.working_lines(PER_NODE * nodes)
    normals = lanes.working_lines(rows.shape[0])
    touched = np.empty(nodes, dtype=np.bool_)
    for b in range(x.shape[0]):
        for lane in range(LANES):
            k = min(b * LANES + lane, count - 1)
            for m in range(rows.shape[0]):
                normals[m, lane] = noise.normals[k, m]
        for row in range(nodes):
            touched[row] = False
            for entry in range(PER_NODE):
                store(moved, PER_NODE * row + entry, fill(0.0))
        block = block_of(x, p, b, nodes)
        constant = block.active > POSE * nodes
        for m in range(rows.shape[0]):
            row = rows[m]
            moves = motion[m, 0] != 0.0 or motion[m, 1] != 0.0
            touched[row] |= moves or (constant and motion[m, 3] > 0.0)
            _move(hypotheses, block, moved, b * nodes + row, motion[m], load(normals, m), noise)
        for row in range(nodes):
            if touched[row]:
                _move_others(block, moved, nodes, row)


@inner
def _places_of(base: int, nodes: int, row: int) -> _Places:
    px, pw = POSE * row, POSE * nodes + CONSTANTS * row
    w, s = base + row_place(pw), base + row_place(pw + 1)
    return _Places(
        base + row_place(px) + px,
        base + row_place(px + 1) + px,
        base + row_place(px + 2) + px,
        w + px,
        s + px,
        w + pw,
        s + pw,
    )


@inner
def _move(
    hypotheses: Hypotheses, block: Block, moved: Floats, user: int, motion: Floats,
    normal: Lanes, noise: Noise,
) -> None:  # fmt: skip
    """Make one displacement of one user in one block: its own pose and covariances.

    ``user`` counts through all blocks: block times N plus row.
    """
    x, p, at_x, base, active = block
    sensitivity, component = hypotheses.sensitivity, hypotheses.component
    nodes = component.shape[1]
    row = user % nodes
    constant = active > POSE * nodes
    at = _places_of(base, nodes, row)
    place, pw, dt = at_x + POSE * row, at_x + POSE * nodes + CONSTANTS * row, motion[3]
    turn = motion[5] * load(component, 3 * user + 1)
    white = motion[6] * load(component, 3 * user + 2)
    variance = turn + white
    t = 18 * user
    store(sensitivity, t + 11, load(sensitivity, t + 11) + turn)
    store(sensitivity, t + 17, load(sensitivity, t + 17) + white)
    angle = load(x, place + 2) + normal * lanes.sqrt(noise.sampled * variance)
    hh = load(p, at.xh + 2) + (1.0 - noise.sampled) * variance
    drift, hw, ww = fill(0.0), fill(0.0), fill(0.0)
    if constant:
        drift, hw, ww = load(x, pw), load(p, at.xw + 2), load(p, at.ww)
    if motion[0] != 0.0 or motion[1] != 0.0:
        heading = _Heading(angle, drift, hh, hw, ww)
        _displace(hypotheses, block, moved, user, motion, heading, noise.cross)
    store(x, place + 2, angle + (motion[2] - dt * drift))
    if constant and dt > 0.0:
        elapsed = PER_NODE * row + 4
        store(moved, elapsed, load(moved, elapsed) + dt)
        store(p, at.xh, load(p, at.xh) - dt * load(p, at.xw))
        store(p, at.xh + 1, load(p, at.xh + 1) - dt * load(p, at.xw + 1))
        hh = hh - dt * (2.0 * hw - dt * ww)
        store(p, at.xw + 2, hw - dt * ww)
        store(p, at.xs + 2, load(p, at.xs + 2) - dt * load(p, at.ws))
        store(p, at.ww, select(ww > 0.0, ww + DRIFT_WALK * dt, ww))
        ss = load(p, at.ws + 1)
        store(p, at.ws + 1, select(ss > 0.0, ss + SCALE_WALK * dt, ss))
    store(p, at.xh + 2, hh)


@inner
def _displace(
    hypotheses: Hypotheses, block: Block, moved: Floats, user: int, motion: Floats,
    heading: _Heading, cross: float,
) -> None:  # fmt: skip
    """Move a user's position along its heading, with what follows for its covariances."""
    x, p, at_x, base, active = block
    nodes = hypotheses.component.shape[1]
    row = user % nodes
    constant = active > POSE * nodes
    at = _places_of(base, nodes, row)
    dx, dy, dt = motion[0], motion[1], motion[3]
    c, s = lanes.cos_sin(heading.angle - (0.5 * dt) * heading.drift)
    # E R(theta) of an uncertain heading is shorter by exp(-var/2); what that leaves
    # of the spread along and across the way is noise (statistical linearisation).
    vary = greater(heading.hh - dt * heading.hw, fill(0.0))
    short = lanes.exp(-0.5 * vary)
    shorter = short * short
    grow = fill(1.0)
    if constant:
        grow = lanes.exp(load(x, at_x + POSE * nodes + CONSTANTS * row + 1))
    way2 = dx * dx + dy * dy
    full = grow * grow * way2
    ahead, aside = c * dx - s * dy, s * dx + c * dy
    east, north = grow * short * ahead, grow * short * aside
    px = at_x + POSE * row
    store(x, px, load(x, px) + east)
    store(x, px + 1, load(x, px + 1) + north)
    if constant:
        xx, xy, yy = _turn_with_constants(p, at, east, north, 0.5 * dt, heading)
    else:
        xx, xy, yy = _turn(p, at, east, north, heading.hh)
    # The heading that this displacement follows has itself drifted since.
    lag = load(moved, PER_NODE * row + 4) + 0.5 * dt
    for entry, much in enumerate((east, north, north * lag, 0.0 - east * lag)):
        line = PER_NODE * row + entry
        store(moved, line, load(moved, line) + much)
    sensitivity, t = hypotheses.sensitivity, 18 * user
    for part in range(3):
        _turn_sensitivity(sensitivity, t + 6 * part, east, north)
    along = motion[4] * load(hypotheses.component, 3 * user)
    if way2 > TINY:
        unit = 1.0 / way2
        ee, nn, en = ahead * ahead * unit, aside * aside * unit, ahead * aside * unit
        lost = 0.5 * full * (1.0 - shorter) * (1.0 - shorter)
        swept = full * greater(0.5 - 0.5 * shorter * shorter - vary * shorter, fill(0.0))
        length = along + lost
        width = along * cross + swept
        xx = xx + length * ee + width * nn
        yy = yy + length * nn + width * ee
        xy = xy + (length - width) * en
        store(sensitivity, t, load(sensitivity, t) + along * (ee + cross * nn))
        store(sensitivity, t + 1, load(sensitivity, t + 1) + along * (1.0 - cross) * en)
        store(sensitivity, t + 2, load(sensitivity, t + 2) + along * (nn + cross * ee))
    store(p, at.xx, xx)
    store(p, at.xy, xy)
    store(p, at.xy + 1, yy)


@inner
def _turn(
    p: Floats, at: _Places, east: Lanes, north: Lanes, hh: Lanes
) -> tuple[Lanes, Lanes, Lanes]:
    """Carry a user's covariances over a displacement; return xx, xy, yy, store the others."""
    xx, xy, yy = load(p, at.xx), load(p, at.xy), load(p, at.xy + 1)
    xh, yh = load(p, at.xh), load(p, at.xh + 1)
    xx = xx + north * (north * hh - 2.0 * xh)
    yy = yy + east * (east * hh + 2.0 * yh)
    xy = xy + east * xh - north * yh - east * north * hh
    store(p, at.xh, xh - north * hh)
    store(p, at.xh + 1, yh + east * hh)
    return xx, xy, yy


@inner
def _turn_with_constants(
    p: Floats, at: _Places, east: Lanes, north: Lanes, half: float, heading: _Heading
) -> tuple[Lanes, Lanes, Lanes]:
    """As :func:`_turn`, where drift and scale vary; ``half`` is half the duration (s)."""
    xx, xy, yy = load(p, at.xx), load(p, at.xy), load(p, at.xy + 1)
    xh, yh = load(p, at.xh), load(p, at.xh + 1)
    hh, hw, ww = heading.hh, heading.hw, heading.ww
    xw, yw = load(p, at.xw), load(p, at.xw + 1)
    xs, ys, hs = load(p, at.xs), load(p, at.xs + 1), load(p, at.xs + 2)
    ws, ss = load(p, at.ws), load(p, at.ws + 1)
    th, tw, ts = hh - half * hw, hw - half * ww, hs - half * ws
    tx, ty = xh - half * xw, yh - half * yw
    x_x, x_y = xx - north * tx + east * xs, xy - north * ty + east * ys
    y_y = yy + east * ty + north * ys
    xh, yh = xh - north * th + east * hs, yh + east * th + north * hs
    xw, yw = xw - north * tw + east * ws, yw + east * tw + north * ws
    xs, ys = xs - north * ts + east * ss, ys + east * ts + north * ss
    tx, ty = xh - half * xw, yh - half * yw
    store(p, at.xw, xw)
    store(p, at.xw + 1, yw)
    store(p, at.xs, xs)
    store(p, at.xs + 1, ys)
    store(p, at.xh, xh)
    store(p, at.xh + 1, yh)
    return x_x - north * tx + east * xs, x_y + east * tx + north * xs, y_y + east * ty + north * ys


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
def _move_others(block: Block, moved: Floats, nodes: int, row: int) -> None:
    """Carry a user's covariance with everything else over all its displacements at once.

    ``moved`` (5 N, LANES) is for each user east and north (m), what a unit of drift does to x and
    to y, and the time (s).
    """
    p, base, active = block.p, block.base, block.active
    px, pw = POSE * row, POSE * nodes + CONSTANTS * row
    m = PER_NODE * row
    east, north, time = load(moved, m), load(moved, m + 1), load(moved, m + 4)
    drift_x, drift_y = load(moved, m + 2), load(moved, m + 3)
    r_x, r_y, r_h = base + row_place(px), base + row_place(px + 1), base + row_place(px + 2)
    r_w, r_s = base + row_place(pw), base + row_place(pw + 1)
    for q in range(active):
        if px <= q < px + POSE or pw <= q <= pw + 1:
            continue
        at = base + row_place(q)
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


@compiled
def prepare_motion(
    rows: Indices,
    moves: Floats,
    reported: Floats,
    component: Floats,
    count: int,
    since_turn_s: Floats,
) -> tuple[Floats, Floats]:
    """Return what ``advance`` takes of displacements (M, 4), (M, 7), and who misjudges their turns.

    ``reported`` (M, 3) are the reported deviations, NaN where there are none. The second result
    (M,) is the share of hypotheses that are to misjudge a turn, -1 where there is none.

    A turn's noise grows with the turn, of which only the report is known: one of a right
    angle that was reported as next to nothing would pass for exact. Only what sticks out of
    the wearer's white heading noise is a turn, and only reports that bring no sigma need it;
    who turns all the time is judged by the next turn, and is left alone.
    """
    several = rows.shape[0]
    motion, misjudged = np.empty((several, 7)), np.full(several, -1.0)
    base = base_variances(moves, reported)
    for m in range(several):
        for part in range(4):
            motion[m, part] = moves[m, part]
        for part in range(COMPONENTS):
            motion[m, 4 + part] = base[m, part]
        # Who reports nothing at all stands: no time passes for the heading.
        if motion[m, 0] == 0.0 and motion[m, 1] == 0.0 and motion[m, 2] == 0.0:
            motion[m, 3] = 0.0
        row = rows[m]
        if count < 2:
            continue
        mean = 0.0
        if motion[m, 2] != 0.0:
            for k in range(count):
                mean += component[k // LANES, row, WHITE, k % LANES]
        white = motion[m, 6] * mean / count
        turn = motion[m, 2] ** 2 > LEAST_TURN_RAD**2 + TURN_STANDS_OUT**2 * white
        if turn and math.isnan(reported[m, 2]):
            misjudged[m] = MISJUDGED * min(since_turn_s[row] / STRAIGHT_S, 1.0) ** 2
            since_turn_s[row] = 0.0
        else:
            since_turn_s[row] += motion[m, 3]
    return motion, misjudged
