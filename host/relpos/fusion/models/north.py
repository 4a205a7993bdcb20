"""Where an absolute heading's x axis lies in the frame of the estimate.

A compass reports headings from magnetic east; the frame's x axis is where the priors, or the first
node that was located, had it. The angle in between is unknown and estimated: one number for the
team, whose innovation is a reported heading less the node's own heading less the angle.

Indoors iron nearby disturbs a compass, in the same way for some metres: readings of one node within
:data:`CORRELATED_S` of each other tell no more together than one alone, so their variance is raised
accordingly. What its wearer carries disturbs it for good: that offset of each compass is estimated
beside the angle, and only several compasses make the angle better known than one offset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.estimator import ANY_ANGLE_RAD, MagneticNorth

CORRELATED_S = 10.0
"""Iron in a building disturbs over 3 to 10 m, some ten seconds of walking."""
OFFSET_RAD = math.radians(6.0)
"""Deviation of what a compass errs by for good: mounting, calibration, what its wearer carries.
10 degrees cost emulated teams, whose compasses err in places alone, 4 % of the body frame."""
EXPECTED = 4.0
"""That deviation is as well known as from so many compasses; those there are tell of it, too."""
USABLE_RAD = 0.5
"""Headings are used once north is known so well."""
LEAST_SIGMA_RAD = math.radians(3.0)
"""Magnetic east itself is not one direction all over a building."""
GATE = 3.0
"""Standard deviations; a reading farther off says something of its place, not of the frame."""


@dataclass(slots=True)
class North:
    """The angle and its deviation; ``sigma_rad`` is :data:`ANY_ANGLE_RAD` while it is unknown."""

    angle_rad: float = 0.0
    sigma_rad: float = ANY_ANGLE_RAD
    _offset_rad: dict[tuple[int, str | None], float] = field(default_factory=dict)
    """Compass, by node and source -> what it errs by."""
    _covariance: Floats = field(init=False)
    """Of the angle and these offsets, in this order (1 + C, 1 + C)."""
    _reported_s: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._covariance = np.array([[self.sigma_rad**2]])

    @property
    def is_usable(self) -> bool:
        """Whether headings may be used; before, they only teach where north is."""
        return self.sigma_rad < USABLE_RAD

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
        self,
        compass: tuple[int, str | None],
        reported_rad: float,
        sigma_rad: float,
        own_rad: float,
        own_var: float,
    ) -> bool:
        """Learn from a reading of a node whose own heading and its variance are these.

        ``compass`` is the node and its source. False where the reading contradicts what is known
        of the angle and of this compass.
        """
        offset_rad, covariance = self._offset_rad.get(compass, 0.0), self._covariance
        if compass not in self._offset_rad:
            covariance = np.pad(covariance, (0, 1))
            covariance[-1, -1] = OFFSET_RAD**2
        place = 1 + [*self._offset_rad, compass].index(compass)
        carried = covariance[0] + covariance[place]
        expected = float(carried[0] + carried[place]) + sigma_rad**2 + own_var
        innovation = math.remainder(reported_rad - own_rad - self.angle_rad - offset_rad, math.tau)
        if innovation**2 > GATE**2 * expected:
            return False
        gain = carried / expected
        self._covariance = covariance - np.outer(gain, carried)
        self._offset_rad[compass] = offset_rad
        for learned, part in zip(self._offset_rad, gain[1:].tolist(), strict=True):
            self._offset_rad[learned] += part * innovation
        self.angle_rad = math.remainder(self.angle_rad + float(gain[0]) * innovation, math.tau)
        angle_sigma_rad = self._spread() * math.sqrt(float(self._covariance[0, 0]))
        self.sigma_rad = max(angle_sigma_rad, LEAST_SIGMA_RAD)
        return True

    def used_sigma_rad(self, sigma_rad: float, own_var: float) -> float | None:
        """Deviation with which a reading leaves a heading no better known than a compass can be.

        ``sigma_rad`` is that of the reading and ``own_var`` the heading's variance before. None
        where readings are not used yet, or the heading is known as well already.
        """
        within = (self._spread() * OFFSET_RAD) ** 2
        if not self.is_usable or own_var <= within:
            return None
        least_rad = 1.0 / math.sqrt(1.0 / within - 1.0 / own_var)
        return max(math.hypot(sigma_rad, self.sigma_rad), least_rad)

    def _spread(self) -> float:
        """How far compasses are off, over what is expected (conjugate to an inverse gamma)."""
        seen = sum(off**2 for off in self._offset_rad.values()) / OFFSET_RAD**2
        return math.sqrt((EXPECTED + seen) / (EXPECTED + max(len(self._offset_rad) - 1, 0)))
