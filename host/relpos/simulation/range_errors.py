"""How far UWB ranges of real modules err: in sight, past a body, through walls.

Fitted to two public tables of DW1000 ranges with surveyed distances, one outdoors (in sight and
past an obstacle, 2 to 30 m) and one in 15 rooms (in sight and through walls, .4 to 13 m);
``tests/simulation/test_range_errors.py`` compares the model with both. An error has three parts: a
bias that grows with distance, because a weaker first path is detected later; what the place adds
(reflections, the wall's own delay), the same as long as both stay where they are; and noise.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

BIAS_M, UNBIASED_M = 0.11, 3.8
"""In sight the bias is ``BIAS_M`` times the logarithm of distance over ``UNBIASED_M``."""
NEAREST_M = 0.4
"""Nearer than this the bias grows no more."""
PLACE_M, NOISE_M = 0.06, 0.03
"""In sight: standard deviations of place (.025 outdoors, .06 to .2 in rooms) and noise."""
BODY_M, BODY_PLACE_M = 0.05, 0.05
"""What a body adds to the bias, and its own place."""
WALL_M, WALL_DISTANCE_M, WALL_SPREAD = 0.70, 2.5, 0.95
"""Through walls the median excess rises towards ``WALL_M`` with distance; the logarithm's spread
over places."""
WALL_NOISE_M = 0.08
PLACE_SIZE_M = 1.0
"""Relative movement after which the place's part is another by 1/e."""


def in_sight_bias_m(distance_m: Floats) -> Floats:
    """Mean error in sight at distances (n,)."""
    bias: Floats = BIAS_M * np.log(np.maximum(distance_m, NEAREST_M) / UNBIASED_M)
    return bias


def errors_m(
    distance_m: Floats,
    place: Floats,
    noise: Floats,
    *,
    body: npt.NDArray[np.bool_] | bool = False,
    wall: npt.NDArray[np.bool_] | bool = False,
) -> Floats:
    """Errors (n,) at distances (n,), from standard normals (n,) of the place and of the noise."""
    clear = in_sight_bias_m(distance_m) + PLACE_M * place + NOISE_M * noise
    past = clear + np.where(body, BODY_M + (BODY_PLACE_M - PLACE_M) * place, 0.0)
    median_m = WALL_M * (1.0 - np.exp(-distance_m / WALL_DISTANCE_M))
    through = median_m * np.exp(WALL_SPREAD * place) + WALL_NOISE_M * noise
    return np.where(wall, through, past)


def places(moved_m: Floats, rng: np.random.Generator) -> Floats:
    """Standard normals (n,) of a pair's places, after relative movements (n,) since the one before.

    A first-order process: places nearer than ``PLACE_SIZE_M`` are alike.
    """
    kept = np.exp(-moved_m / PLACE_SIZE_M)
    fresh = np.sqrt(1.0 - kept**2) * rng.standard_normal(len(moved_m))
    out = np.empty(len(moved_m))
    last = rng.standard_normal()
    for k, (share, new) in enumerate(zip(kept, fresh, strict=True)):
        out[k] = last = share * last + new
    return out
