"""How noisy a reported displacement is: base variances, before anything about a wearer is learned.

A displacement has three independent errors: along the way (m^2 per metre), of turns (rad^2 per
radian turned) and white noise of the heading (rad^2 per second of moving). Filters multiply these
bases by variance components, one for each error and wearer, which they learn.
"""

from __future__ import annotations

import math

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.compiled import compiled

ALONG_M2_M = 0.004
"""7 % of half a metre at each half metre; people and sensors spread over 3 to 25 %."""

TURN_RAD2_RAD = 0.04
"""15 degrees at a right angle."""

WHITE_RAD2_S = math.radians(3.0) ** 2
"""3 degrees in a second's walking."""

SLOW_RAD_S = 0.5
"""Turning at this rate counts half as a turn."""

COMPONENTS = 3
ALONG, TURN, WHITE = range(COMPONENTS)
"""The errors, in the order of every array of variance components."""


@compiled
def base_variances(moves: Floats, reported: Floats) -> Floats:
    """Give the bases (M, 3) of displacements (M, 4): along (m^2), turn and white (rad^2).

    ``moves`` are dx, dy (m), dtheta (rad) and duration (s). ``reported`` (M, 3) are deviations
    (forward, left, turn) that reports bring, or NaN; they take the bases' place.
    """
    base = np.empty((moves.shape[0], COMPONENTS))
    for m in range(moves.shape[0]):
        way = math.sqrt(moves[m, 0] * moves[m, 0] + moves[m, 1] * moves[m, 1])
        size = abs(moves[m, 2])
        # A turn is what turns fast: slow changes of the heading are mostly its white noise.
        fourth = size**4
        slow = fourth + (SLOW_RAD_S * moves[m, 3]) ** 4 + 1e-300
        base[m, ALONG] = ALONG_M2_M * way
        base[m, TURN] = TURN_RAD2_RAD * size * fourth / slow
        base[m, WHITE] = WHITE_RAD2_S * moves[m, 3] if way > 0.0 or size != 0.0 else 0.0
        if not math.isnan(reported[m, 0]):
            left = 0.0 if math.isnan(reported[m, 1]) else reported[m, 1] ** 2
            base[m, ALONG] = max(reported[m, 0] ** 2, left)
        if not math.isnan(reported[m, 2]):
            base[m, TURN] = 0.0
            base[m, WHITE] = reported[m, 2] ** 2
    return base
