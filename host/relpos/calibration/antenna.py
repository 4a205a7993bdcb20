"""What two nodes' ranges are too long by: the delays of their antennas, as distance.

A radio's antenna delay is in every range that it takes part in, always the same (Decawave APS014:
uncalibrated modules are off by some decimetres). Two nodes that lie still at a known distance show
the sum of both delays; how it is shared between them does not matter to their own ranges. Each node
keeps its share, and the host subtracts both ends' shares from every range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relpos.errors import DataError

LEAST_RANGES = 20
"""With 2 cm of noise the bias is then known to 6 mm."""
MOST_SPREAD_M = 0.25
"""Ranges between nodes at rest in sight of each other spread by 2 to 10 cm."""
MOST_BIAS_M = 3.0
"""Ten times what an uncalibrated module is off by: the distance was another one."""
MOST_SHARE_M = 5.0
"""What a node stores."""


@dataclass(frozen=True)
class RangeFit:
    """Ranges at a known distance: how many, what they are too long by, and how they spread.

    ``bias_m`` is the median's; ``spread_m`` a robust standard deviation of one range, ``sigma_m``
    that of the bias.
    """

    count: int
    bias_m: float
    spread_m: float
    sigma_m: float


def fit_ranges(ranges_m: Sequence[float], distance_m: float) -> RangeFit:
    """Bias and spread of ranges at a known distance. DataError where they cannot be believed."""
    if len(ranges_m) < LEAST_RANGES:
        raise DataError(
            f"only {len(ranges_m)} ranges between the two came in, {LEAST_RANGES} are needed: are "
            "they in sight of each other?"
        )
    errors_m = np.asarray(ranges_m) - distance_m
    bias_m = float(np.median(errors_m))
    # 1.4826: of a normal distribution's deviation to its median absolute deviation.
    spread_m = 1.4826 * float(np.median(np.abs(errors_m - bias_m)))
    if spread_m > MOST_SPREAD_M:
        raise DataError(
            f"the ranges spread by {spread_m:.2f} m: the nodes have to lie still, in sight of each "
            "other, a metre or more from walls, floor and people"
        )
    if abs(bias_m) > MOST_BIAS_M:
        raise DataError(
            f"the ranges are {bias_m:+.2f} m off: no antenna does that; is it {distance_m:g} m?"
        )
    # A median of n is as uncertain as a mean of 2 n / pi.
    sigma_m = math.sqrt(math.pi / 2.0 / len(ranges_m)) * spread_m
    return RangeFit(len(ranges_m), bias_m, spread_m, sigma_m)


def new_shares_mm(
    bias_m: float, shares_mm: tuple[int, int], reference: int | None = None
) -> tuple[int, int]:
    """Both nodes' shares so that ``bias_m`` (left with the shares they have) vanishes.

    Half at each end; with ``reference`` 0 or 1 that end keeps its share and the other takes all.
    DataError where a share would be more than a node stores.
    """
    bias_mm = round(1000.0 * bias_m)
    first = bias_mm // 2 if reference is None else 0 if reference == 0 else bias_mm
    shares = (shares_mm[0] + first, shares_mm[1] + bias_mm - first)
    if max(map(abs, shares)) > 1000.0 * MOST_SHARE_M:
        raise DataError(f"a node stores at most {MOST_SHARE_M:g} m, not {shares} mm")
    return shares
