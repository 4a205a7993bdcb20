"""What a barometer shows beside the height: the weather, the air around it, noise.

Of a barometer that does not move, the drift is the weather (:class:`Weather`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.measurements import Height

RATE_M_S, RATE_S = 2.5e-3, 3600.0
"""The weather's rate, a standard deviation: 1 hPa an hour; and how long it keeps."""
FAST_M, FAST_S = 0.2, 90.0
"""Fast bias. Phones that came back to a surveyed point after a minute or more were off by 0.30 m
(IPIN 2023, 264 returns, RMS): twice this bias's variance."""
NOISE_M = 0.06
"""Of a reported height (docs/building.md)."""

UNKNOWN_M = 1e3
"""Of a node's offset, before it has reported a height."""


@dataclass(slots=True)
class Weather:
    """Drift of the pressure since the first report, in metres of height, by a Kalman filter.

    The state is (drift m, rate m/s), then (fast m, offset m) of each node of the command post: the
    drift integrates the rate, rate and fast biases are Gauss-Markov; a reported height is drift +
    its node's fast bias and offset + noise. So a door's gust, which passes, moves the drift by
    little. Fast biases count from the first report of all.
    """

    time_s: float = -math.inf
    _first_s: float = math.inf
    _mean: Floats = field(default_factory=lambda: np.zeros(2))
    _covariance: Floats = field(default_factory=lambda: np.diag([0.0, RATE_M_S**2]))
    _place: dict[int, int] = field(default_factory=dict)
    """Node -> place of its fast bias in the state."""

    def at(self, time_s: float) -> float:
        """Return the drift at a time: 0 before the first report, predicted after the last one."""
        later_s = max(time_s - self.time_s, 0.0)
        if math.isinf(later_s):
            return 0.0
        return float(self._mean[0] + self._mean[1] * RATE_S * -math.expm1(-later_s / RATE_S))

    def measure(self, height: Height) -> None:
        """Update with a height that a node of the command post reports."""
        since_s = height.time_s - self.time_s
        if math.isfinite(since_s) and since_s > 0.0:
            self._predict(since_s)
        self.time_s = max(self.time_s, height.time_s)
        if height.node not in self._place:
            self._place[height.node] = at = len(self._mean)
            self._first_s = min(self._first_s, height.time_s)
            self._mean = np.pad(self._mean, (0, 2))
            self._covariance = np.pad(self._covariance, (0, 2))
            later_s = self.time_s - self._first_s
            self._covariance[at, at] = FAST_M**2 * -math.expm1(-2.0 * later_s / FAST_S)
            self._covariance[at + 1, at + 1] = UNKNOWN_M**2
        fast = self._place[height.node]
        seen = [0, fast, fast + 1]
        gain = self._covariance[:, seen].sum(axis=1)
        total = gain[seen].sum() + (height.sigma_m or NOISE_M) ** 2
        self._mean += gain * ((height.height_m - self._mean[seen].sum()) / total)
        self._covariance -= np.outer(gain, gain) / total

    def _predict(self, since_s: float) -> None:
        kept, fast = math.exp(-since_s / RATE_S), math.exp(-since_s / FAST_S)
        step = np.diag([1.0, kept, *(len(self._place) * [fast, 1.0])])
        step[0, 1] = RATE_S * (1.0 - kept)
        self._mean = step @ self._mean
        self._covariance = step @ self._covariance @ step.T
        self._covariance[1, 1] += RATE_M_S**2 * (1.0 - kept**2)
        for place in self._place.values():
            self._covariance[place, place] += FAST_M**2 * (1.0 - fast**2)
