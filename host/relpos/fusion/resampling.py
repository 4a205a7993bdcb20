"""Systematic resampling: the draw of weighted samples with the least variance."""

from __future__ import annotations

import numpy as np

from relpos.fusion.arrays import Floats, Indices


def systematic(weight: Floats, count: int, rng: np.random.Generator) -> Indices:
    """Draw ``count`` indices by weights (K,) of any sum, in ascending order.

    Index k is drawn floor or ceil of ``count`` times its normalised weight (Carpenter, Clifford
    and Fearnhead 1999).
    """
    edges = np.cumsum(weight)
    points = (np.arange(count) + rng.random()) / max(count, 1) * edges[-1]
    index = np.searchsorted(edges, points, side="right")
    chosen: Indices = np.minimum(index, len(weight) - 1).astype(np.int64)
    return chosen
