"""How a person walks of whom no motion is reported, as the ranges show it.

An Ornstein-Uhlenbeck velocity v of ``WALK_M_S`` and ``WALK_S`` beside the filter's position p. The
filter knows nothing of v: what it corrects p by corrects v, too, by the cross-covariance kept here,

    v += C_vp C_pp^-1 (p' - p),   C_vp' = C_vp C_pp^-1 C_pp',
    C_vv' = C_vv - C_vp C_pp^-1 (C_pp - C_pp') C_pp^-1 C_pv
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.models.motion import WALK_M_S, WALK_S

AXIS_M2_S2 = 0.5 * WALK_M_S**2
"""Variance of the velocity along each axis, before anything is known."""

LAST_M2_S2 = 0.1
"""Variance along each axis of the velocity that was reported last."""

LEAST_M2 = 1e-6
"""Added to a position's variance: of two people all but their distance may have been taken out."""

MOST_EXPLAINED = 0.95
"""Share of the velocity's variance that a position may explain."""

TURNS_RAD2_S = 0.12
"""Variance by which a heading may change in a second: a right angle in twenty."""

WALKING_M_S, ASIDE_RAD = 0.3, 0.2
"""Who walks at least so fast faces the way, give or take so much."""


def _last() -> Floats:
    return LAST_M2_S2 * np.eye(2)


@dataclass(slots=True)
class UnseenWalk:
    """One person's velocity (m/s, world axes) since the report at ``since_s``."""

    since_s: float
    velocity_m_s: Floats
    _variance: Floats = field(default_factory=_last)
    """C_vv (2, 2)."""
    _cross: Floats = field(default_factory=lambda: np.zeros((2, 2)))
    """C_vp (2, 2)."""

    @property
    def speed_m_s(self) -> float:
        """Root mean square of the speed."""
        return math.sqrt(float(self.velocity_m_s @ self.velocity_m_s + self._variance.trace()))

    def walk(self, duration_s: float) -> tuple[Floats, Floats]:
        """Go on; return the way (2,) and by how much the position is less certain (2, 2)."""
        kept = math.exp(-duration_s / WALK_S)
        reach_s = WALK_S * (1.0 - kept)
        way_m = reach_s * self.velocity_m_s
        # What the velocity has changed by meanwhile (``motion.unseen_variance``).
        fresh_m2 = AXIS_M2_S2 * (2.0 * WALK_S * (duration_s - reach_s) - reach_s**2)
        grown = reach_s * (self._cross + self._cross.T) + reach_s**2 * self._variance
        grown += fresh_m2 * np.eye(2)
        self._cross = kept * (self._cross + reach_s * self._variance)
        self._cross += AXIS_M2_S2 * WALK_S * (1.0 - kept) ** 2 * np.eye(2)
        self._variance = kept**2 * self._variance + AXIS_M2_S2 * (1.0 - kept**2) * np.eye(2)
        self.velocity_m_s = kept * self.velocity_m_s
        size, axes = np.linalg.eigh(grown)
        return way_m, (axes * np.maximum(size, 0.0)) @ axes.T

    def facing(self, time_s: float, heading_rad: float, sigma_rad: float) -> tuple[float, float]:
        """Return the heading and its deviation: of the last report, or the way that is walked."""
        turned = math.hypot(sigma_rad, math.sqrt(TURNS_RAD2_S * max(time_s - self.since_s, 0.0)))
        east, north = self.velocity_m_s.tolist()
        speed = math.hypot(east, north)
        walking = math.hypot(ASIDE_RAD, math.sqrt(0.5 * self._variance.trace()) / max(speed, 1e-9))
        if speed > WALKING_M_S and walking < turned:
            return math.atan2(north, east), walking
        return heading_rad, turned

    def correct(self, moved_m: Floats, before: Floats, after: Floats) -> None:
        """Learn from what ranges moved the position by (2,), its covariances (2, 2) around it."""
        gain = np.linalg.solve(before + LEAST_M2 * np.eye(2), self._cross.T).T
        # Other things correct the position, too: what is said to be common may be too much.
        explained = np.linalg.eigvals(np.linalg.solve(self._variance, gain @ before @ gain.T))
        gain *= min(1.0, math.sqrt(MOST_EXPLAINED / max(float(explained.real.max()), 1e-12)))
        self.velocity_m_s = self.velocity_m_s + gain @ moved_m
        self._variance = self._variance - gain @ (before - after) @ gain.T
        self._cross = gain @ after
