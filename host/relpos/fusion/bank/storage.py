"""How the bank's hypotheses are stored: eight to a block, as kernels read and write them.

One hypothesis is a mean (D,) and a covariance (D, D) over all users: five entries a user in the
order of :class:`StateIndex`, then (where modelled) what many ranges have in common
(:class:`~relpos.fusion.models.ranging.CommonIndex`, and a clock offset a user), then the pairs'
biases. ``x`` (B, D, LANES) and ``p`` (B, D (D + 1) / 2, LANES) are B blocks of eight hypotheses
(:mod:`.lanes`); of a covariance the lower triangle alone is stored, row by row. All users' poses
(x, y, heading) come first, then all constants (drift, scale), then the biases, so that what a block
does not model is at its end. :func:`pack` and :func:`unpack` convert.
"""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank import lanes
from relpos.fusion.bank.lanes import LANES, Lanes, load, some, store
from relpos.fusion.compiled import compiled, inner
from relpos.fusion.models.ranging import CommonIndex

IndicesOrInt = Indices | int


class StateIndex(IntEnum):
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


COMMON = len(CommonIndex)
"""Entries of the team after the users', before their clock offsets."""
PER_NODE = len(StateIndex)
POSE = 3
"""x, y and heading of a user are stored side by side."""
CONSTANTS = 2
TINY = 1e-12


class Hypotheses(NamedTuple):
    """B blocks of hypotheses about N users; kernels change the arrays in place."""

    x: Floats
    """Means (B, D, LANES)."""
    p: Floats
    """Covariances (B, D (D + 1) / 2, LANES)."""
    log_weight: Floats
    """Unnormalised log weights (B, LANES)."""
    sensitivity: Floats
    """(B, N, 3, 6, LANES): derivative of each user's pose covariance (xx, xy, yy, xh, yh, hh)
    with respect to the logarithm of each of its variance components; what leaks to other users is
    left out."""
    component: Floats
    """(B, N, 3, LANES): variance components by which each user's base variances are multiplied."""
    range_variance: Floats
    """Variance of a range (B, LANES), m^2."""
    has_heights: Floats
    """(B, LANES): 1 where a pair's entry is no bias but the square of its difference of height."""
    has_passing: Floats
    """(B, LANES): 1 where a pair's bias passes as its users walk."""


class Block(NamedTuple):
    """One block of eight hypotheses within the arrays."""

    x: Floats
    p: Floats
    at_x: int
    """Line of ``x`` where the block begins."""
    base: int
    """Line of ``p`` where the block begins."""
    active: int
    """So many entries of the state vary: poses, or also constants, or also biases."""


# -- conversion ------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def order(nodes: int, size: int) -> Indices:
    """Give the state's entry (D,) that each place of the storage holds."""
    user = PER_NODE * np.arange(nodes)[:, None]
    poses, constants = user + np.arange(POSE), user + POSE + np.arange(CONSTANTS)
    return np.concatenate(
        [poses.ravel(), constants.ravel(), np.arange(PER_NODE * nodes, size)]
    ).astype(np.int64)


def lay_out(values: Floats) -> Floats:
    """Lay out numbers (K, ...) as (B, ..., LANES); what is left of a block repeats the first."""
    count, *rest = values.shape
    which = np.arange(lanes.blocks_of(count) * LANES)
    which[count:] = 0
    laid = lanes.empty_lines(len(which) // LANES, *rest)
    laid[...] = np.moveaxis(values[which].reshape(-1, LANES, *rest), 1, -1)
    return laid


def of_each(laid: Floats, count: int) -> Floats:
    """Give numbers (B, ..., LANES) of each hypothesis, (K, ...)."""
    last = laid.ndim - 1
    rows = laid.transpose(0, last, *range(1, last)).reshape(-1, *laid.shape[1:last])
    return np.ascontiguousarray(rows[:count])


def triangle_place(i: IndicesOrInt, j: IndicesOrInt) -> Indices:
    """Give the place of a covariance in the triangle."""
    later = np.maximum(i, j)
    place: Indices = later * (later + 1) // 2 + np.minimum(i, j)
    return place


@lru_cache(maxsize=64)
def every_pair(count: int) -> tuple[Indices, Indices]:
    """Return the first and the second of every two of ``count``, in order."""
    first, second = np.triu_indices(count, 1)
    return first, second


def pack(x: Floats, p: Floats, nodes: int) -> tuple[Floats, Floats]:
    """Store means (K, D) and covariances (K, D, D)."""
    of = order(nodes, x.shape[1])
    row, column = np.tril_indices(len(of))
    return lay_out(x[:, of]), lay_out(p[:, of[row], of[column]])


def unpack(x: Floats, p: Floats, nodes: int, count: int) -> tuple[Floats, Floats]:
    """Give means (K, D) and covariances (K, D, D) as they are stored."""
    place = np.argsort(order(nodes, x.shape[1]))
    pairs = triangle_place(place[:, None], place)
    return of_each(x[:, place], count), of_each(p[:, pairs], count)


@compiled
def select_hypotheses(of: Floats, chosen: Indices) -> Floats:
    """Give the hypotheses ``chosen`` (M,) of an array (B, R, LANES) as another."""
    count, rows = chosen.shape[0], of.shape[1]
    given = lanes.working_lines((count + LANES - 1) // LANES * rows).reshape(-1, rows, LANES)
    for b in range(given.shape[0]):
        for t in range(rows):
            for lane in range(LANES):
                parent = chosen[min(b * LANES + lane, count - 1)]
                given[b, t, lane] = of[parent // LANES, t, parent % LANES]
    return given


# -- places ----------------------------------------------------------------------------------------


@inner
def row_place(i: int) -> int:
    """Where a row of the triangle begins."""
    return (i * (i + 1)) >> 1


@inner
def place(i: int, j: int) -> int:
    """Place of an entry in the triangle."""
    return ((i * (i + 1)) >> 1) + j if i >= j else ((j * (j + 1)) >> 1) + i


@inner
def block_of(x: Floats, p: Floats, b: int, nodes: int) -> Block:
    """Return block ``b``; ``active`` covers every entry of the state that varies in it."""
    size = x.shape[1]
    base = b * p.shape[1]
    poses = PER_NODE * nodes
    active = POSE * nodes
    if size > poses and some(load(p, base + place(poses, poses)) > 0.0):
        active = size
    else:
        for i in range(POSE * nodes, poses):
            if some(load(p, base + place(i, i)) > 0.0):
                active = poses
                break
    return Block(x, p, b * size, base, active)


@inner
def correct(block: Block, gain: Floats, move: Lanes, shrink: Lanes) -> None:
    """Add ``move`` g to a block's means and subtract ``shrink`` g g^T from its covariances."""
    x, p, at_x, t, active = block
    for o in range(active):
        own = load(gain, o)
        store(x, at_x + o, load(x, at_x + o) + move * own)
        f = shrink * own
        for q in range(o + 1):
            store(p, t + q, load(p, t + q) - f * load(gain, q))
        t += o + 1
