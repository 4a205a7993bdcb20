"""Detection: how received and missed attempts of a pair update every hypothesis.

Silence is negative information: those who are far apart do not receive each other. A range near
the edge of reception is more likely too long than one beyond the edge is received: without the
share of those received, the silent ones would drive all users apart.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Bools, Floats, Indices
from relpos.fusion.bank import lanes
from relpos.fusion.bank.lanes import Lanes, fill, greater, lesser, load, select, some, store
from relpos.fusion.bank.range_update import predict_range, range_gain
from relpos.fusion.bank.storage import POSE, Hypotheses, block_of, correct
from relpos.fusion.compiled import compiled, inner
from relpos.fusion.models.detection import STEP_M

_POINTS = 11
_ASIDE = 2.5
"""The detection probability is averaged over so many points, out to so many standard deviations."""
_Z = _ASIDE * np.linspace(-1.0, 1.0, _POINTS)
_BELL = np.exp(-0.5 * _Z**2)
_RULE_VARIANCE = float((_Z**2 * _BELL).sum() / _BELL.sum())
_NORM = float(_BELL.sum())


class Attempts(NamedTuple):
    """Pairs (U,) of users that attempted to range each other in one round."""

    first: Indices
    second: Indices
    dz_m: Floats
    received: Bools
    attempted: Floats
    """Probability that there was an attempt at all."""


@inner
def _outcome(place: Lanes, received: bool, attempted: float, curve: Floats) -> Lanes:
    """Probability that a pair is received, or silent, at a multiple of the curve's step."""
    last = curve.shape[0] - 2.0
    # In this order a place of NaN is 0, too: ``look_up`` checks no bounds.
    kept = lesser(greater(place, fill(0.0)), fill(last + 1.0))
    index = lesser(lanes.floor(kept), fill(last))
    here = lanes.look_up(curve, index)
    chance = here + (kept - index) * (lanes.look_up(curve, index + 1.0) - here)
    return chance if received else 1.0 - attempted * chance


@compiled
def update_detection(
    hypotheses: Hypotheses, attempts: Attempts, weight: float, curve: Floats
) -> None:
    """Update with which attempts were received, after their ranges.

    ``curve`` is the detection probability at multiples of ``STEP_M``, ``weight`` what one outcome
    counts (:mod:`relpos.fusion.models.detection`). The distance's Gaussian m, v times
    P(outcome | distance) has mass Z, mean m' and variance v'; Z weighs the hypothesis, and where
    that tells anything within it (an edge lies within the spread) the moments go to the state
    along g = Cov(x, distance):

        x += g (m' - m)/v,   P -= g g^T (v - v')/v^2
    """
    x, p, log_weight = hypotheses.x, hypotheses.p, hypotheses.log_weight
    nodes = hypotheses.component.shape[1]
    g = lanes.working_lines(x.shape[1])
    per_step = 1.0 / STEP_M
    nought, one = fill(0.0), fill(1.0)
    for b in range(x.shape[0]):
        block = block_of(x, p, b, nodes)
        total, product = nought, one
        for u in range(attempts.first.shape[0]):
            i, j = POSE * attempts.first[u], POSE * attempts.second[u]
            received, attempted = attempts.received[u], attempts.attempted[u]
            m, v, gx, gy = predict_range(block, i, j, fill(attempts.dz_m[u] ** 2))
            sd = lanes.sqrt(greater(v, nought))
            place, aside = per_step * m, per_step * sd
            middle = _outcome(place, received, attempted, curve)
            near = _outcome(place - _ASIDE * aside, received, attempted, curve)
            far = _outcome(place + _ASIDE * aside, received, attempted, curve)
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
                chance = _outcome(place + z * aside, received, attempted, curve)
                density = bell * lanes.exp(weight * lanes.log(chance))
                mass = mass + density
                shift = shift + density * z
                square = square + density * (z * z)
            shift = shift / mass
            # The rule's own variance is a little under 1: a flat curve must change nothing.
            after = lesser((square / mass - shift * shift) / _RULE_VARIANCE, one)
            range_gain(block, i, j, gx, gy, g)
            # g g^T / v never exceeds P: v also holds the curvature's part.
            move = select(steep > 0.0, shift / sd, nought)
            shrink = select(steep > 0.0, (1.0 - after) / v, nought)
            total = total + select(steep > 0.0, lanes.log(mass * (1.0 / _NORM)), nought)
            correct(block, g, move, shrink)
        store(log_weight, b, load(log_weight, b) + total + weight * lanes.log(product))
