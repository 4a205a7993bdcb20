"""The normal density."""

from __future__ import annotations

import numpy as np

from relpos.fusion.arrays import Floats


def normal_density(off: Floats, variance: Floats | float) -> Floats:
    """Return the densities of deviations ``off`` from the mean."""
    return np.exp(-0.5 * off**2 / variance) / np.sqrt(2.0 * np.pi * variance)
