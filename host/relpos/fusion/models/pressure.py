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


@dataclass(slots=True)
class Weather:
    """Drift of the pressure since the first report, in metres of height, by a Kalman filter.

    The state is (drift m, rate m/s, fast m): the drift integrates the rate, rate and fast
    bias are Gauss-Markov; the reported height is drift + fast + noise. So a door's gust, which
    passes, moves the drift by little.
    """

    time_s: float = -math.inf
    _mean: Floats = field(default_factory=lambda: np.zeros(3))
    _covariance: Floats = field(default_factory=lambda: np.diag([0.0, RATE_M_S**2, 0.0]))
    _offset_m: dict[int, float] = field(default_factory=dict)
    """Node -> its reported height less the drift when it reported first."""

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
        offset_m = self._offset_m.setdefault(height.node, height.height_m - float(self._mean[0]))
        gain = self._covariance[:, 0] + self._covariance[:, 2]
        total = gain[0] + gain[2] + (height.sigma_m or NOISE_M) ** 2
        innovation_m = height.height_m - offset_m - self._mean[0] - self._mean[2]
        self._mean += gain * (innovation_m / total)
        self._covariance -= np.outer(gain, gain) / total

    def _predict(self, since_s: float) -> None:
        kept, fast = math.exp(-since_s / RATE_S), math.exp(-since_s / FAST_S)
        step = np.diag([1.0, kept, fast])
        step[0, 1] = RATE_S * (1.0 - kept)
        self._mean = step @ self._mean
        self._covariance = step @ self._covariance @ step.T
        self._covariance[1, 1] += RATE_M_S**2 * (1.0 - kept**2)
        self._covariance[2, 2] += FAST_M**2 * (1.0 - fast**2)
