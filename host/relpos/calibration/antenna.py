"""Range offsets from the antenna delays of two nodes at a known distance.

A radio's antenna delay adds a constant to each of its ranges (Decawave APS014: some decimetres in
uncalibrated modules). Two nodes at rest at a known distance show the sum of both delays; its
division between them does not matter to their own ranges. Each node stores its offset, and the host
subtracts both ends' offsets from every range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relpos.errors import DataError

MIN_RANGES = 20
"""With 2 cm of noise the bias is then known to 6 mm."""
MAX_SPREAD_M = 0.25
"""Ranges between nodes at rest in sight of each other spread by 2 to 10 cm."""
MAX_BIAS_M = 3.0
"""Ten times the delay of an uncalibrated module: the distance must be wrong."""
MAX_OFFSET_M = 5.0
"""What a node stores."""


@dataclass(frozen=True)
class RangeFit:
    """Ranges at a known distance: their number, bias and spread.

    ``bias_m`` is the median's; ``spread_m`` a robust standard deviation of one range, ``sigma_m``
    that of the bias.
    """

    count: int
    bias_m: float
    spread_m: float
    sigma_m: float


def fit_ranges(ranges_m: Sequence[float], distance_m: float) -> RangeFit:
    """Return bias and spread of ranges at a known distance; DataError if they are implausible."""
    if len(ranges_m) < MIN_RANGES:
        raise DataError(
            f"only {len(ranges_m)} ranges received, {MIN_RANGES} are needed: are the nodes in "
            "sight of each other?"
        )
    errors_m = np.asarray(ranges_m) - distance_m
    bias_m = float(np.median(errors_m))
    # 1.4826: of a normal distribution's deviation to its median absolute deviation.
    spread_m = 1.4826 * float(np.median(np.abs(errors_m - bias_m)))
    if spread_m > MAX_SPREAD_M:
        raise DataError(
            f"the ranges spread by {spread_m:.2f} m: the nodes have to lie still, in sight of each "
            "other, a metre or more from walls, floor and people"
        )
    if abs(bias_m) > MAX_BIAS_M:
        raise DataError(
            f"the ranges are {bias_m:+.2f} m off, too much for an antenna: is the distance "
            f"{distance_m:g} m?"
        )
    # A median of n is as uncertain as a mean of 2 n / pi.
    sigma_m = math.sqrt(math.pi / 2.0 / len(ranges_m)) * spread_m
    return RangeFit(len(ranges_m), bias_m, spread_m, sigma_m)


def new_offsets_mm(
    bias_m: float, offsets_mm: tuple[int, int], reference: int | None = None
) -> tuple[int, int]:
    """Both nodes' offsets so that ``bias_m`` (left with the offsets they have) vanishes.

    Half at each end; with ``reference`` 0 or 1 that end keeps its share and the other takes all.
    DataError where a share would be more than a node stores.
    """
    bias_mm = round(1000.0 * bias_m)
    first = bias_mm // 2 if reference is None else 0 if reference == 0 else bias_mm
    offsets = (offsets_mm[0] + first, offsets_mm[1] + bias_mm - first)
    if max(map(abs, offsets)) > 1000.0 * MAX_OFFSET_M:
        raise DataError(f"a node stores at most {MAX_OFFSET_M:g} m, not {offsets} mm")
    return offsets
