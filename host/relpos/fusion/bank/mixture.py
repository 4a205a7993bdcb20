"""What all hypotheses together say: weights, moments and ranges of the mixture."""

from __future__ import annotations

import math

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank import lanes
from relpos.fusion.bank.lanes import LANES, fill, greater, load, store
from relpos.fusion.bank.range_update import predict_range
from relpos.fusion.bank.storage import POSE, Block, row_place
from relpos.fusion.compiled import compiled

PERTURBED_UPDATES = 5.0
"""For so many instants of ranges a perturbed hypothesis teaches nothing about noise."""

PERTURBED_LOSS = 20.0
"""Log likelihood that is subtracted from perturbed hypotheses where they do not count."""


@compiled
def normalise(log_weight: Floats, count: int, weight: Floats) -> float:
    """Write weights (B, LANES) that sum to 1 over the first ``count``, and 0 beyond them.

    The log weights are shifted so that their greatest is 0. Returns the effective sample count.
    """
    logs, weights = log_weight.reshape(-1), weight.reshape(-1)
    most = -np.inf
    for k in range(count):
        most = max(most, logs[k])
    for k in range(logs.shape[0]):
        logs[k] -= most
    for b in range(weight.shape[0]):
        store(weight, b, lanes.exp(load(log_weight, b)))
    for k in range(count, weights.shape[0]):
        weights[k] = 0.0
    total, squares = 0.0, 0.0
    for k in range(count):
        total += weights[k]
    for k in range(count):
        weights[k] /= total
        squares += weights[k] * weights[k]
    return 1.0 / squares


@compiled
def predicted_ranges(
    x: Floats, p: Floats, weight: Floats, first: Indices, second: Indices, dz_m: Floats
) -> tuple[Floats, Floats]:
    """Give mean and standard deviation (U,) of pairs' slant distances over all hypotheses.

    ``weight`` (B, LANES) are the normalised weights, 0 where a block has no hypothesis.
    """
    blocks, size = x.shape[0], x.shape[1]
    mean = np.empty(first.shape[0])
    sigma = np.empty(first.shape[0])
    ranges, variances = lanes.working_lines(blocks), lanes.working_lines(blocks)
    for u in range(first.shape[0]):
        middle, dz2 = fill(0.0), fill(dz_m[u] * dz_m[u])
        for b in range(blocks):
            block = Block(x, p, b * size, b * p.shape[1], 0)
            m, v, _, _ = predict_range(block, POSE * first[u], POSE * second[u], dz2)
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
    x: Floats, p: Floats, weight: Floats, nodes: int, of: Indices, places: int
) -> tuple[Floats, Floats]:
    """Give the mixture's mean (D,) and full covariance (D, D), in the state's order.

    ``weight`` (B, LANES) as for ``predicted_ranges``, ``of`` (D,) is ``order``. Of the storage
    beyond the first ``places`` only means and variances are given, its covariances as 0. Headings
    are averaged round the circle, about the heaviest hypothesis' value.
    """
    blocks, size, triangle = x.shape[0], x.shape[1], p.shape[1]
    best, best_lane = 0, 0
    for b in range(blocks):
        for lane in range(LANES):
            if weight[b, lane] > weight[best, best_lane]:
                best, best_lane = b, lane
    mean = np.zeros(size)
    cov = np.zeros((size, size))
    turn = 2.0 * math.pi
    off = lanes.working_lines(blocks * size)
    for i in range(size):
        about = x[best, i, best_lane]
        angle = i < POSE * nodes and i % POSE == 2
        middle = fill(0.0)
        for b in range(blocks):
            away = load(x, b * size + i) - about
            if angle:
                away = away - turn * lanes.floor(away * (1.0 / turn) + 0.5)
            store(off, b * size + i, away)
            middle = middle + load(weight, b) * away
        away_from = lanes.total(middle)
        mean[of[i]] = about + away_from
        for b in range(blocks):
            store(off, b * size + i, load(off, b * size + i) - away_from)
    sums = lanes.working_lines(row_place(places))
    for t in range(row_place(places)):
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
            own = load(p, b * triangle + row_place(i) + i)
            variance = variance + load(weight, b) * (own + away * away)
        cov[of[i], of[i]] = lanes.total(variance)
    return mean, cov
