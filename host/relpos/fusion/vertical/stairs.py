"""How much of its way somebody on stairs truly goes; dead reckoning claims level steps."""

from __future__ import annotations

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.vertical.track import STEP_M

TREAD_M, RISER_M, STEEPER = 0.28, 0.175, 1.0
"""A usual tread, and by how much it is shorter per metre of a higher riser. Builders keep
2 risers + tread = 0.63 m, and many stairs are as they are: this is in between."""
LEAST_TREAD_M = 0.22
TWO_STEPS_M = 0.26
"""A rise by so much is two steps."""
FEW_STEPS = 3.0
"""So few do not tell how long a step is claimed to be."""
MOST_SHARE = 1.3
"""Of the claimed way of an interval: what pressure took too much before is given back."""


def true_shares(
    steps: Floats, way_m: Floats, rise_m: Floats, up: Floats, down: Floats
) -> tuple[Floats, Floats]:
    """Return which share of its claimed way each of N nodes truly went in I intervals, (I, N).

    ``steps``, ``way_m`` and ``rise_m`` (I, N) are what was reported, ``up`` and ``down`` (I, N) the
    probabilities of a flight. The second value (N,) is the share to be expected of the next way.

    The surplus follows the rise: each riser is a step that is claimed to be a level one. So it need
    not be known in which second a flight began, and steps on landings count in full.
    """
    stairs = up + down
    count = (stairs * steps).sum(axis=0)
    climbed_m = (up - down) * rise_m
    rise_of_one = np.abs(climbed_m.sum(axis=0)) / np.maximum(count, 1e-9)
    treads = 1.0 + np.clip((rise_of_one - TWO_STEPS_M) / 0.04 + 0.5, 0.0, 1.0)
    # Of steps that rise by less some were on a landing.
    riser = np.maximum(rise_of_one / treads, RISER_M)
    tread = np.clip(TREAD_M - STEEPER * (riser - RISER_M), LEAST_TREAD_M, TREAD_M)
    taken = steps.sum(axis=0)
    step_m = np.where(taken > FEW_STEPS, way_m.sum(axis=0) / np.maximum(taken, FEW_STEPS), STEP_M)
    surplus_m = np.maximum(step_m - treads * tread, 0.0)
    shares = 1.0 - climbed_m * surplus_m / (treads * riser) / np.maximum(way_m, 0.2)
    expected = 1.0 - stairs[-1] * surplus_m / np.maximum(step_m, 1e-9)
    return np.clip(shares, 0.0, MOST_SHARE), expected
