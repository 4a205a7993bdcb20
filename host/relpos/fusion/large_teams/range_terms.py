"""What ranges have in common beside distances: how a range depends on it.

A body shadows who is behind it; a range that is dated late was measured where people were then;
all are too long, and the longer ones by more. The slopes are those of the bank
(``fusion/bank/range_update.py``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from relpos.fusion.models.ranging import growth_slope, shadow_slope

Vector = tuple[float, float]


def slopes_of(
    sight: Vector,
    distance_m: float,
    headings_rad: Sequence[float],
    velocities_m_s: Sequence[Vector],
) -> tuple[float, ...]:
    """Return a range's slopes in what ranges have in common, in the order of ``CommonIndex``.

    Then the peer's velocity along the sight, by which clocks are multiplied. ``sight`` is the
    direction from the node to the peer; the others are the node's and the peer's.
    """
    ends = zip(headings_rad, velocities_m_s, strict=True)
    own, other = (_along(sight, heading, velocity) for heading, velocity in ends)
    return 1.0, shadow_slope(sight, *headings_rad), own - other, growth_slope(distance_m), other


def _along(sight: Vector, heading_rad: float, velocity_m_s: Vector) -> float:
    """Return along ``sight`` the velocity (m/s) of a node, given forward and left."""
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    forward, left = velocity_m_s
    ahead, aside = sight[0] * c + sight[1] * s, sight[1] * c - sight[0] * s
    return ahead * forward + aside * left
