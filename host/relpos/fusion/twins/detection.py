"""NumPy twin of the kernel in :mod:`relpos.fusion.detection`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from relpos.fusion.detection import expected

Floats = npt.NDArray[np.float64]


def log_silence(
    distance_m: Floats, sigma_m: Floats, tried: Floats, weight: float, curve: Floats
) -> Floats:
    """Log P(all pairs silent) of each hypothesis, (H,); arguments as those of the kernel."""
    chance = expected(curve, distance_m.ravel(), sigma_m.ravel()).reshape(distance_m.shape)
    missed: Floats = 1.0 - tried * chance
    total: Floats = weight * np.log(missed).sum(axis=1)
    return total
