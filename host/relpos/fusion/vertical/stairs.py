"""The true way on stairs, of which dead reckoning claims a level step's length each step."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

TREAD_M, RISER_M, STEEPER = 0.28, 0.175, 1.0
"""A usual tread, and by how much it is shorter per metre of a higher riser. Builders keep
2 risers + tread = 0.63 m, and many stairs are as they are: this is in between."""
LEAST_TREAD_M = 0.22
TWO_STEPS_M = 0.26
"""A rise by so much is two steps."""


def way_on_stairs(steps: Floats, rise_m: Floats, way_m: Floats) -> Floats:
    """Return the true way (m) of steps that rise by so much and are claimed to go so far.

    The rise tells how many of the steps were on stairs: landings and the first steps behind a
    flight are level.
    """
    rise_of_one = rise_m / np.maximum(steps, 1e-9)
    treads = 1.0 + np.clip((rise_of_one - TWO_STEPS_M) / 0.04 + 0.5, 0.0, 1.0)
    riser = rise_of_one / treads
    climbs = np.minimum(riser / RISER_M, 1.0)
    tread = np.clip(TREAD_M - STEEPER * np.maximum(riser - RISER_M, 0.0), LEAST_TREAD_M, TREAD_M)
    way: Floats = way_m * (1.0 - climbs) + climbs * steps * treads * tread
    return way
