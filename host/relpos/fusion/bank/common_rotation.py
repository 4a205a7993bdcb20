"""The team's common rotation, which no range can measure, is kept apart from the hypotheses.

Headings err, so that the whole team turns and shifts slowly in the world's frame. Ranges say
nothing of that. Left in the covariances it grows without end, and what is linear for small angles
alone (the mean of a displacement, the mean of two places) becomes too short by it: distances
shrink. With G and S of :mod:`relpos.fusion.rigid_motion`, P - G S G^T, the covariance of what the
ranges concern, remains in the hypotheses, and S is summed up in ``HypothesisSet.common``. As the
world's frame is arbitrary, all else is unchanged. Absolute headings do measure the rotation: before
them it is put back. Reference implementation: :mod:`reference.bank`.
"""

from __future__ import annotations

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.bank import lanes
from relpos.fusion.bank.lanes import Lanes, fill, greater, load, select, store
from relpos.fusion.bank.storage import PER_NODE, POSE, Hypotheses, block_of, place, row_place
from relpos.fusion.compiled import compiled, inner
from relpos.fusion.rigid_motion import RIGID, rigid_motion

LEAST_RAD = 0.03
"""From this deviation of the common rotation on it is taken out. A mean direction of so much is
too short by 0.05 %; two users for an hour keep distances unbiased with it (``mission-two-hour``:
1.39 m without, 0.30 with)."""

LEFT = 1e-4, 1e-5
"""Variances (m^2, rad^2) of it that are left: the rest of a covariance keeps an inverse."""

KNOWN = 1e-9, 1e-12
"""Share of variances, and m^2 or rad^2, added to them: what is known exactly has an inverse."""


def estimate(mean: Floats, covariance: Floats, nodes: int) -> tuple[Floats, Floats]:
    """Return T (3, 3 N) and S (3, 3) of a mixture with the moments (D,), (D, D).

    T times a small change of all poses is the rigid motion in it; S see above. Both are about the
    team's middle, where they are well conditioned.
    """
    poses = (PER_NODE * np.arange(nodes)[:, None] + np.arange(POSE)).ravel()
    x_m, y_m = mean[poses[0::3]], mean[poses[1::3]]
    g = rigid_motion(x_m - x_m.mean(), y_m - y_m.mean())
    own = covariance[np.ix_(poses, poses)]
    solved = np.linalg.solve(own + np.diag(KNOWN[0] * own.diagonal() + KNOWN[1]), g)
    s = np.linalg.inv(g.T @ solved)
    return np.asarray(s @ solved.T, np.float64), np.asarray(s, np.float64)


@inner
def _rigid_motion(x: Floats, at_x: int, nodes: int, middle_m: Floats, g: Floats) -> None:
    """Write G into ``g`` (9 N lines), row by row, of rigid motions about ``middle_m`` (2,)."""
    for n in range(nodes):
        at, line = at_x + POSE * n, RIGID * POSE * n
        for entry in range(RIGID * POSE):
            store(g, line + entry, fill(1.0 if entry % (RIGID + 1) == 0 else 0.0))
        store(g, line + 2, middle_m[1] - load(x, at + 1))
        store(g, line + RIGID + 2, load(x, at) - middle_m[0])


@inner
def _product(g: Floats, i: int, s: Floats, h: Floats, q: int) -> Lanes:
    """Return row ``i`` of G times S times row ``q`` of H."""
    total = fill(0.0)
    for row in range(RIGID):
        for column in range(RIGID):
            part = load(s, place(row, column)) * load(h, RIGID * q + column)
            total = total + load(g, RIGID * i + row) * part
    return total


@inner
def _add_rigid(p: Floats, base: int, entries: int, g: Floats, s: Floats, sign: float) -> None:
    """Add G S G^T, times ``sign``, to a block's covariances of poses."""
    for i in range(entries):
        for q in range(i + 1):
            at = base + row_place(i) + q
            store(p, at, load(p, at) + sign * _product(g, i, s, g, q))


@inner
def _remains_positive(p: Floats, base: int, nodes: int, g: Floats, s: Floats) -> Lanes:
    """Return 1 where every user's own place and heading keep a covariance without G S G^T."""
    sound, nought = fill(1.0), fill(0.0)
    for n in range(nodes):
        i = POSE * n
        xx = load(p, base + row_place(i) + i) - _product(g, i, s, g, i)
        xy = load(p, base + row_place(i + 1) + i) - _product(g, i + 1, s, g, i)
        yy = load(p, base + row_place(i + 1) + i + 1) - _product(g, i + 1, s, g, i + 1)
        hh = load(p, base + row_place(i + 2) + i + 2) - _product(g, i + 2, s, g, i + 2)
        sound = select(xx > 0.0, sound, nought)
        sound = select(xx * yy > xy * xy, sound, nought)
        sound = select(hh > 0.0, sound, nought)
    return sound


@inner
def _inverse_of_symmetric(m: Floats, s: Floats) -> None:
    """Write the inverse of a 3 x 3 matrix, both given by lines xx, xy, yy, xh, yh, hh."""
    xx, xy, yy = load(m, 0), load(m, 1), load(m, 2)
    xh, yh, hh = load(m, 3), load(m, 4), load(m, 5)
    c_xx, c_xy, c_xh = yy * hh - yh * yh, xh * yh - xy * hh, xy * yh - xh * yy
    per = 1.0 / (xx * c_xx + xy * c_xy + xh * c_xh)
    store(s, 0, per * c_xx)
    store(s, 1, per * c_xy)
    store(s, 2, per * (xx * hh - xh * xh))
    store(s, 3, per * c_xh)
    store(s, 4, per * (xy * xh - xx * yh))
    store(s, 5, per * (xx * yy - xy * xy))


@inner
def _solve(p: Floats, base: int, size: int, factor: Floats, g: Floats) -> None:
    """Replace the first ``size`` rows of ``g`` (3 D lines: three columns) by P^-1 g.

    ``factor`` receives the Cholesky factor of P, row by row.
    """
    for i in range(size):
        at_i = row_place(i)
        for j in range(i + 1):
            at_j = row_place(j)
            rest = load(p, base + at_i + j)
            if i == j:
                rest = rest + rest * KNOWN[0] + KNOWN[1]
            for q in range(j):
                rest = rest - load(factor, at_i + q) * load(factor, at_j + q)
            if i == j:
                store(factor, at_i + j, 1.0 / lanes.sqrt(greater(rest, fill(0.01 * KNOWN[1]))))
            else:
                store(factor, at_i + j, rest * load(factor, at_j + j))
        for column in range(RIGID):
            solved = load(g, RIGID * i + column)
            for q in range(i):
                solved = solved - load(factor, at_i + q) * load(g, RIGID * q + column)
            store(g, RIGID * i + column, solved * load(factor, at_i + i))
    for back in range(size):
        i = size - 1 - back
        for column in range(RIGID):
            solved = load(g, RIGID * i + column)
            for q in range(i + 1, size):
                solved = solved - load(factor, row_place(q) + i) * load(g, RIGID * q + column)
            store(g, RIGID * i + column, solved * load(factor, row_place(i) + i))


@inner
def _project_sensitivity(sens: Floats, t: int, j: Floats) -> None:
    """Replace a sensitivity E (xx, xy, yy, xh, yh, hh at ``t``) by J E J^T; ``j`` has 9 lines."""
    e = (load(sens, t), load(sens, t + 1), load(sens, t + 3),
         load(sens, t + 1), load(sens, t + 2), load(sens, t + 4),
         load(sens, t + 3), load(sens, t + 4), load(sens, t + 5))  # fmt: skip
    at = t
    for row in range(3):
        a, b, c = load(j, 3 * row), load(j, 3 * row + 1), load(j, 3 * row + 2)
        je_x, je_y = a * e[0] + b * e[3] + c * e[6], a * e[1] + b * e[4] + c * e[7]
        je_h = a * e[2] + b * e[5] + c * e[8]
        for column in range(row + 1):
            k = 3 * column
            store(sens, at, je_x * load(j, k) + je_y * load(j, k + 1) + je_h * load(j, k + 2))
            at += 1


@compiled
def take_out(hypotheses: Hypotheses, middle_m: Floats, taken: Floats) -> None:
    """Subtract G S G^T from every covariance; ``taken`` (B, 6, LANES) receives S less ``LEFT``.

    Rigid motions are about ``middle_m`` (2,), S is given by xx, xy, yy, xh, yh, hh.
    """
    x, p = hypotheses.x, hypotheses.p
    nodes = hypotheses.sensitivity.shape[1]
    entries = POSE * nodes
    factor = lanes.working_lines(p.shape[1])
    solved, g = lanes.working_lines(RIGID * x.shape[1]), lanes.working_lines(RIGID * entries)
    m, s, j = lanes.working_lines(6), lanes.working_lines(6), lanes.working_lines(9)
    nought = fill(0.0)
    for b in range(x.shape[0]):
        block = block_of(x, p, b, nodes)
        for line in range(RIGID * block.active):
            store(solved, line, nought)
        _rigid_motion(x, block.at_x, nodes, middle_m, g)
        for line in range(RIGID * entries):
            store(solved, line, load(g, line))
        _solve(p, block.base, block.active, factor, solved)
        t = 0
        for row in range(RIGID):
            for column in range(row + 1):
                total = nought
                for i in range(entries):
                    total = total + load(g, RIGID * i + row) * load(solved, RIGID * i + column)
                store(m, t, total)
                t += 1
        _inverse_of_symmetric(m, s)
        for row in range(RIGID):
            own = place(row, row)
            store(s, own, load(s, own) - (LEFT[0] if row < 2 else LEFT[1]))
        # Where rounding has left a covariance that contains none such, nothing is taken out.
        sound = _remains_positive(p, block.base, nodes, g, s)
        for t in range(6):
            store(s, t, select(sound > 0.0, load(s, t), nought))
            store(taken, 6 * b + t, load(s, t))
        _add_rigid(p, block.base, entries, g, s, -1.0)
        for n in range(nodes):
            # J = 1 - G S (P^-1 G)^T, of the user's own entries.
            for i in range(POSE):
                for q in range(POSE):
                    much = _product(g, POSE * n + i, s, solved, POSE * n + q)
                    # Of what has no inverse, ``solved`` may be infinite: 0 times it is no number.
                    much = select(sound > 0.0, much, nought)
                    store(j, POSE * i + q, (1.0 if i == q else 0.0) - much)
            for part in range(3):
                at = 18 * (b * nodes + n) + 6 * part
                _project_sensitivity(hypotheses.sensitivity, at, j)


@compiled
def put_back(hypotheses: Hypotheses, common: Floats) -> None:
    """Add G S G^T to every covariance; ``common`` (6,) is S about the origin (``take_out``)."""
    x, p = hypotheses.x, hypotheses.p
    nodes = hypotheses.sensitivity.shape[1]
    g, s = lanes.working_lines(RIGID * POSE * nodes), lanes.working_lines(6)
    for t in range(6):
        store(s, t, fill(common[t]))
    for b in range(x.shape[0]):
        _rigid_motion(x, b * x.shape[1], nodes, np.zeros(2), g)
        _add_rigid(p, b * p.shape[1], POSE * nodes, g, s, 1.0)


@compiled
def align(hypotheses: Hypotheses, middle_m: Floats, motion: Floats) -> None:
    """Undo a rigid motion about ``middle_m`` (2,) of every hypothesis: ``motion`` (B, 3, LANES)."""
    x, p, sens = hypotheses.x, hypotheses.p, hypotheses.sensitivity
    size, nodes = x.shape[1], sens.shape[1]
    for b in range(x.shape[0]):
        c, s = lanes.cos_sin(load(motion, RIGID * b + 2))
        base = b * p.shape[1]
        for n in range(nodes):
            at = b * size + POSE * n
            east = load(x, at) - load(motion, RIGID * b) - middle_m[0]
            north = load(x, at + 1) - load(motion, RIGID * b + 1) - middle_m[1]
            store(x, at, c * east + s * north + middle_m[0])
            store(x, at + 1, c * north - s * east + middle_m[1])
            store(x, at + 2, load(x, at + 2) - load(motion, RIGID * b + 2))
            # Rows and columns of the user: what lies across from them, then its own block.
            i = POSE * n
            for q in range(size):
                if q == i or q == i + 1:
                    continue
                e, f = base + place(i, q), base + place(i + 1, q)
                east, north = load(p, e), load(p, f)
                store(p, e, c * east + s * north)
                store(p, f, c * north - s * east)
            at = base + row_place(i) + i
            _rotate_own(p, at, base + row_place(i + 1) + i, c, s)
            for part in range(3):
                t = 18 * (b * nodes + n) + 6 * part
                _rotate_own(sens, t, t + 1, c, s)
                east, north = load(sens, t + 3), load(sens, t + 4)
                store(sens, t + 3, c * east + s * north)
                store(sens, t + 4, c * north - s * east)


@inner
def _rotate_own(of: Floats, at_xx: int, at_xy: int, c: Lanes, s: Lanes) -> None:
    """Rotate a 2 x 2 covariance clockwise; yy is beside xy."""
    xx, xy, yy = load(of, at_xx), load(of, at_xy), load(of, at_xy + 1)
    store(of, at_xx, c * c * xx + 2.0 * c * s * xy + s * s * yy)
    store(of, at_xy, c * s * (yy - xx) + (c * c - s * s) * xy)
    store(of, at_xy + 1, s * s * xx - 2.0 * c * s * xy + c * c * yy)


def full(entries: Floats) -> Floats:
    """Return a symmetric matrix (3, 3) of its entries xx, xy, yy, xh, yh, hh."""
    s = np.zeros((RIGID, RIGID))
    s[np.tril_indices(RIGID)] = entries
    return s + np.tril(s, -1).T
