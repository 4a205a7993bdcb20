"""What a UWB range says about two positions: the paper's eqs. (5) and (6).

    p(z_ij | x_i, x_j) = N(z_ij; |x_i - x_j|, sigma_r^2)

Only positive measurements are considered (paper sect. IV-C). An optional outlier share mixes in
a density that is flat over ``outlier_span_m``, so that one wrong range cannot outvote all others;
it is zero in the paper.

Heights make the distance slant: where the nodes' heights differ by h, the predicted range is
sqrt(|x_i - x_j|^2 + h^2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RangeNoise:
    """Parameters of the ranging model: metres, and the share of outliers (0 to 1)."""

    sigma_r_m: float = 2.0
    outliers: float = 0.0
    outlier_span_m: float = 30.0


def predicted_range(dx_m: Floats, dy_m: Floats, dz_m: Floats | float = 0.0) -> Floats:
    """Slant distance over the given differences."""
    squared: Floats = dx_m * dx_m
    squared += dy_m * dy_m
    squared += np.square(dz_m)
    return np.sqrt(squared, out=squared)


def log_likelihood(measured_m: Floats, predicted_m: Floats, noise: RangeNoise) -> Floats:
    """Give eq. (6) as a logarithm, up to a constant; with outliers the mixture's."""
    scaled: Floats = (measured_m - predicted_m) / noise.sigma_r_m
    exponent: Floats = -0.5 * scaled * scaled
    if noise.outliers <= 0.0:
        return exponent
    peak = (1.0 - noise.outliers) / (math.sqrt(2.0 * math.pi) * noise.sigma_r_m)
    flat = noise.outliers / noise.outlier_span_m
    mixed: Floats = np.logaddexp(exponent, math.log(flat / peak))
    return mixed
