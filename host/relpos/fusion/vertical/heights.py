"""How high every node is: height, fast and slow bias of its barometer, by a Kalman filter a node.

    h = z + b + s + c + noise

h is the reported height, z the height over a floor (:mod:`relpos.fusion.vertical.floors`), b a
Gauss-Markov bias (the air in a room), s a random walk that also takes what fans and doors do, c the
weather, which all share. A wearer's height changes on stairs, in a lift and by falling alone, as
:mod:`relpos.fusion.vertical.episodes` tells; so what h does otherwise goes into biases, and z stays
where it is.

The weather is the mean drift of all nodes that are level. It is taken as known: what is wrong of it
is wrong for all alike, and a relative height does not see it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.models.pressure import FAST_M, FAST_S

Z, FAST, SLOW = 0, 1, 2
"""Entries of a node's state."""

START_M = 0.1
"""Of the heights of people who start together."""
UNKNOWN_M = 5.0
"""Of the height of a node that joins later."""

SLOW_M = 0.005
"""Slow bias, m/sqrt(s)."""
LEVEL_M = 0.003
"""What a wearer's height changes without stairs, m/sqrt(s): ramps, half a step."""
UNSEEN_M = 0.25
"""What it may change without a reported height, m/sqrt(s): a floor in three minutes."""
UNSEEN_SLOW_M = 0.05
"""A node that was silent may have restarted, and begins at another pressure; m/sqrt(s)."""
UNSEEN_S = 3.0
"""A node is without heights after so long."""


@dataclass(slots=True)
class Heights:
    """Means (N, 3) in m and covariances (N, 3, 3) of N nodes; the weather is ``common_m``."""

    mean: Floats = field(default_factory=lambda: np.empty((0, 3)))
    covariance: Floats = field(default_factory=lambda: np.empty((0, 3, 3)))
    base_m: Floats = field(default_factory=lambda: np.empty(0))
    """What barometers measure between the start and the floor that z is over (N,)."""
    common_m: float = 0.0

    def add(self, height_m: float, sigma_m: float, *, late: bool) -> None:
        """Add a node at its first reported height."""
        self.mean = np.vstack([self.mean, (height_m, 0.0, -self.common_m)])
        self.base_m = np.append(self.base_m, 0.0)
        z_m2 = (UNKNOWN_M if late else START_M) ** 2
        first = np.diag([z_m2, 0.0, sigma_m**2])
        if late:
            # The height says where it is over its own start alone.
            first[SLOW, SLOW] += z_m2
            first[Z, SLOW] = first[SLOW, Z] = -z_m2
        self.covariance = np.concatenate([self.covariance, first[None]])

    def advance(
        self,
        duration_s: float,
        rise_m: Floats,
        moving: Floats,
        disturbed: Floats,
        silent: Floats,
        pressed_m: Floats,
    ) -> None:
        """Go on by an interval.

        ``rise_m`` (N,) is how much the reported height rose, ``moving`` and ``disturbed`` (N,) the
        probabilities that the wearer did, or the pressure alone; ``silent`` (N,) for how much of
        the interval (s) no height came. ``pressed_m`` of a climber's rise is the pressure's.
        """
        level = 1.0 - moving - disturbed
        drifting = level > 0.8
        if drifting.any():
            count = max(float(drifting.sum()), 0.5 * len(level))
            self.common_m += float(rise_m[drifting].sum()) / count
        self.mean[:, Z] += moving * rise_m - pressed_m
        self.mean[:, SLOW] += disturbed * rise_m + pressed_m
        kept = math.exp(-duration_s / FAST_S)
        self.mean[:, FAST] *= kept
        p = self.covariance
        p[:, FAST, :] *= kept
        p[:, :, FAST] *= kept
        p[:, FAST, FAST] += FAST_M**2 * (1.0 - kept * kept)
        p[:, Z, Z] += LEVEL_M**2 * duration_s + UNSEEN_M**2 * silent
        p[:, SLOW, SLOW] += SLOW_M**2 * duration_s + UNSEEN_SLOW_M**2 * silent

    def moved(self, variance_m2: Floats) -> None:
        """Add what the noise of reported heights does to the rise of nodes that move (N,)."""
        self.covariance[:, Z, Z] += variance_m2

    def doubt(self, row: int, rise_m: float) -> None:
        """Doubt whether a node's height rose, or its bias: the sum of both is measured."""
        self.covariance[row, [Z, Z, SLOW, SLOW], [Z, SLOW, Z, SLOW]] += rise_m**2 * np.array(
            [1.0, -1.0, -1.0, 1.0]
        )

    @property
    def over_m(self) -> Floats:
        """Heights over the start that pressure shows, less the weather (N,)."""
        over: Floats = self.base_m + self.mean.sum(axis=1)
        return over

    def rebase(self, row: int, rise_m: float) -> None:
        """Count a node's height from a floor so much higher."""
        self.base_m[row] += rise_m
        self.mean[row, Z] -= rise_m

    def correct(self, height_m: Floats, variance_m2: Floats) -> None:
        """Update with reported heights (N,), NaN where there is none."""
        measured = np.isfinite(height_m)
        gain = self.covariance.sum(axis=2)
        total = gain.sum(axis=1) + variance_m2
        innovation = np.where(measured, height_m - self.common_m - self.over_m, 0.0)
        per_total = np.where(measured, 1.0 / total, 0.0)
        self.mean += gain * (innovation * per_total)[:, None]
        self.covariance -= gain[:, :, None] * gain[:, None, :] * per_total[:, None, None]

    def observe(self, row: int, z_m: float, variance_m2: float) -> None:
        """Update one node with a height of another source."""
        gain = self.covariance[row, :, Z].copy()
        total = gain[Z] + variance_m2
        self.mean[row] += gain * ((z_m - self.mean[row, Z]) / total)
        self.covariance[row] -= np.outer(gain, gain) / total
