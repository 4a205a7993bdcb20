"""Absolute headings: how a compass reading corrects every hypothesis."""

from __future__ import annotations

import math

from relpos.fusion.bank import lanes
from relpos.fusion.bank.lanes import load, store
from relpos.fusion.bank.storage import POSE, Hypotheses, block_of, correct, place
from relpos.fusion.compiled import compiled

OUTLIERS = 0.1
OUTLIER_RAD = 1.0
"""Share of readings that are outliers, and how far these are off."""


@compiled
def update_heading(
    hypotheses: Hypotheses, row: int, heading_rad: float, variance_rad2: float
) -> None:
    """Update with one absolute heading of a user; outliers as in the update with ranges."""
    x, p, log_weight = hypotheses.x, hypotheses.p, hypotheses.log_weight
    nodes = hypotheses.component.shape[1]
    g = lanes.working_lines(x.shape[1])
    h = POSE * row + 2
    turn = 2.0 * math.pi
    wide = OUTLIER_RAD**2
    for b in range(x.shape[0]):
        block = block_of(x, p, b, nodes)
        innovation = heading_rad - load(x, block.at_x + h)
        innovation = innovation - turn * lanes.floor(innovation * (1.0 / turn) + 0.5)
        for q in range(block.active):
            store(g, q, load(p, block.base + place(h, q)))
        s = load(g, h) + variance_rad2
        square = innovation * innovation
        good = (1.0 - OUTLIERS) * lanes.exp(-0.5 * square / s) / lanes.sqrt(s)
        bad = OUTLIERS * lanes.exp(-0.5 * square / (s + wide)) / lanes.sqrt(s + wide)
        both = good + bad + 1e-300
        inlier = good / both
        kf = inlier / s
        correct(block, g, kf * innovation, kf * (1.0 - (1.0 - inlier) * square / s))
        store(log_weight, b, load(log_weight, b) + lanes.log(both))
