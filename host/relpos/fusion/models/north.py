"""Where an absolute heading's x axis lies in the frame of the estimate.

A compass reports headings from magnetic east; the frame's x axis is where the priors, or the first
node that was located, had it. The angle in between is unknown and estimated: one number for the
team, whose innovation is a reported heading less the node's own heading less the angle.

Indoors iron nearby disturbs a compass, in the same way for some metres: readings of one node within
:data:`CORRELATED_S` of each other tell no more together than one alone, so their variance is raised
accordingly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from relpos.fusion.estimator import ANY_ANGLE_RAD, MagneticNorth

CORRELATED_S = 10.0
"""Iron in a building disturbs over 3 to 10 m, some ten seconds of walking."""
LEAST_SIGMA_RAD = math.radians(3.0)
"""Magnetic east itself is not one direction all over a building."""
GATE = 3.0
"""Standard deviations; a reading farther off says something of its place, not of the frame."""


@dataclass(slots=True)
class North:
    """The angle and its deviation; ``sigma_rad`` is :data:`ANY_ANGLE_RAD` while it is unknown."""

    angle_rad: float = 0.0
    sigma_rad: float = ANY_ANGLE_RAD
    _reported_s: dict[int, float] = field(default_factory=dict)

    def known(self) -> MagneticNorth | None:
        """Where north lies; None before the first reading."""
        if self.sigma_rad >= ANY_ANGLE_RAD:
            return None
        # A heading of pi/2 from magnetic east is north, and the frame's own is less the angle.
        return MagneticNorth(
            math.remainder(0.5 * math.pi - self.angle_rad, math.tau), self.sigma_rad
        )

    def alone_sigma_rad(self, node: int, time_s: float, sigma_rad: float) -> float:
        """Deviation of a reading such that its node's readings may be taken as independent."""
        since_s = time_s - self._reported_s.get(node, -math.inf)
        self._reported_s[node] = time_s
        return sigma_rad * math.sqrt(max(CORRELATED_S / max(since_s, 0.01), 1.0))

    def learn(
        self, reported_rad: float, reported_sigma_rad: float, own_rad: float, own_var: float
    ) -> bool:
        """Learn from a reading of a node whose own heading and its variance are these.

        False where it contradicts what is known of the angle.
        """
        variance = self.sigma_rad**2
        expected = variance + reported_sigma_rad**2 + own_var
        innovation = math.remainder(reported_rad - own_rad - self.angle_rad, math.tau)
        if innovation**2 > GATE**2 * expected:
            return False
        gain = variance / expected
        self.angle_rad = math.remainder(self.angle_rad + gain * innovation, math.tau)
        self.sigma_rad = max(math.sqrt((1.0 - gain) * variance), LEAST_SIGMA_RAD)
        return True
