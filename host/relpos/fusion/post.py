"""The command post's node: nobody wears it, and it lies still.

Before any estimator (:class:`Reference`) its motion becomes none, and the drift of its pressure
is taken from the heights of all: what a barometer that does not move shows is the weather, and for
a while what the air around it does (:class:`Weather`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from relpos.fusion.estimator import Estimate, Estimator
from relpos.fusion.models.ranging import Mounting
from relpos.fusion.timeline import refusal
from relpos.measurements import Height, Measurement, Motion, at_rest

Floats = npt.NDArray[np.float64]

RATE_M_S, RATE_S = 2.5e-3, 3600.0
"""The weather's rate, a standard deviation: 1 hPa an hour; and how long it keeps."""
LOCAL_M, LOCAL_S = 0.2, 90.0
"""What the air around a barometer adds, and how long it keeps (as in ``vertical/heights``)."""
NOISE_M = 0.06
"""Of a reported height (docs/building.md)."""


def posts_of(nodes: Mapping[int, Mounting] | None) -> frozenset[int]:
    """Return the nodes that are the command post's."""
    return frozenset(node for node, info in (nodes or {}).items() if info.post)


@dataclass(slots=True)
class Weather:
    """Drift of the pressure since the first report, in metres of height, by a Kalman filter.

    The state is (drift m, rate m/s, local m): the drift integrates the rate, rate and local
    pressure are Gauss-Markov; the reported height is drift + local + noise. So a door's gust, which
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
        kept, local = math.exp(-since_s / RATE_S), math.exp(-since_s / LOCAL_S)
        step = np.diag([1.0, kept, local])
        step[0, 1] = RATE_S * (1.0 - kept)
        self._mean = step @ self._mean
        self._covariance = step @ self._covariance @ step.T
        self._covariance[1, 1] += RATE_M_S**2 * (1.0 - kept**2)
        self._covariance[2, 2] += LOCAL_M**2 * (1.0 - local**2)


@dataclass(slots=True)
class Reference:
    """Refers what a team measures to its nodes at the command post (``posts``)."""

    posts: frozenset[int]
    weather: Weather = field(default_factory=Weather)
    _start_m: dict[int, float] = field(default_factory=dict)
    """Node -> drift at its first height, which is over its own start."""

    def refer(self, measured: Measurement) -> Measurement:
        """Return a measurement without the weather; the posts' own show no motion."""
        if isinstance(measured, Motion) and measured.node in self.posts:
            return at_rest(measured)
        if not isinstance(measured, Height) or refusal(measured) is not None:
            return measured
        if measured.node in self.posts:
            self.weather.measure(measured)
            return replace(measured, height_m=0.0)
        drift_m = self.weather.at(measured.time_s)
        drift_m -= self._start_m.setdefault(measured.node, drift_m)
        return replace(measured, height_m=measured.height_m - drift_m)


@dataclass(slots=True)
class Referring:
    """An estimator that gets everything through a :class:`Reference`."""

    estimator: Estimator
    reference: Reference

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Take one measurement; return the estimates it completes."""
        return self.estimator.process(self.reference.refer(measurement))

    def finish(self) -> list[Estimate]:
        """Process what waits for a later motion."""
        return self.estimator.finish()

    def counters(self) -> Mapping[str, int]:
        """Count what the estimator counts."""
        return self.estimator.counters()


def referring(estimator: Estimator, nodes: Mapping[int, Mounting] | None) -> Estimator:
    """Let an estimator use the command post's nodes; without any it stays as it is."""
    posts = posts_of(nodes)
    return Referring(estimator, Reference(posts)) if posts else estimator
