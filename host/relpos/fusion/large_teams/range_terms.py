"""What ranges have in common beside distances: how a range depends on it.

A body shadows who is behind it; a range that is dated late was measured where people were then;
all are too long, and the longer ones by more. The slopes are those of the bank
(``fusion/bank/range_update.py``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from relpos.fusion.models.motion import velocity_m_s
from relpos.fusion.models.ranging import growth_slope, shadow_slope
from relpos.fusion.timeline import Advance


@dataclass(slots=True)
class RangeSlopes:
    """Slopes of ranges in the body's shadow, the lateness of time stamps, their bias and growth."""

    _velocity_m_s: dict[int, tuple[float, float]] = field(default_factory=dict)
    """Node -> velocity forward and left, by its newest displacement."""

    def move(self, step: Advance) -> None:
        """Note how fast a node moves."""
        self._velocity_m_s[step.node] = velocity_m_s(step)

    def of(
        self,
        sight: tuple[float, float],
        distance_m: float,
        node: tuple[int, float],
        peer: tuple[int, float],
    ) -> tuple[float, ...]:
        """Return a range's slopes: ``sight`` is the direction from the node to the peer.

        ``node`` and ``peer`` are ids and headings (rad).
        """
        lateness = self._along(sight, *node) - self._along(sight, *peer)
        return shadow_slope(sight, node[1], peer[1]), lateness, 1.0, growth_slope(distance_m)

    def _along(self, sight: tuple[float, float], node: int, heading_rad: float) -> float:
        """Return the velocity (m/s) of a node along ``sight``."""
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        forward, left = self._velocity_m_s.get(node, (0.0, 0.0))
        ahead, aside = sight[0] * c + sight[1] * s, sight[1] * c - sight[0] * s
        return ahead * forward + aside * left
