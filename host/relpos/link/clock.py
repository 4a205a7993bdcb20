"""A node's clock seen from the host: the only place where node time becomes host time.

A frame stamped ``node_s`` arrives at ``arrival_s = offset + (1 + drift) node_s + delay`` with a
delay that is never negative and often small. The line under all points that lies closest to them
is therefore the clock, late by the least delay (a few milliseconds, alike for all nodes). That
line is the edge of the points' lower convex hull below their mean (a linear program whose answer
is known), so it needs no noise model and no tuning.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

DRIFT_LIMIT = 0.006
"""Largest believable rate error. The Uno's and Mega's 16 MHz come from a ceramic resonator of
+-0.5 % (Arduino's own parts list), far worse than a crystal; 20 % more for temperature."""
WINDOW_S = 300.0
"""History kept: long enough that 20 ms of jitter leaves 0.1 ms/s of drift error, short enough to
follow a resonator that warms up against the body."""
MAX_POINTS = 512
MIN_SPAN_S = 20.0
"""Below this span the delays outweigh the drift: the clock is assumed to have none."""
CLOCK_MODULUS_S = 4294967.296
"""The wire's node time counts milliseconds in 32 bits."""


@dataclass
class NodeClock:
    """Maps the node time of one node, of one boot, to host time."""

    _points: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=MAX_POINTS))
    _offset_s: float = 0.0
    drift: float = 0.0
    """Host seconds gained per node second, less one."""
    _reference_s: float = 0.0
    _newest_s: float | None = None

    def unwrap(self, node_s: float) -> float:
        """Return node time without its 32-bit wrap (49.7 days), nearest to the newest seen."""
        if self._newest_s is None:
            return node_s
        ahead = (node_s - self._newest_s) % CLOCK_MODULUS_S
        if ahead >= CLOCK_MODULUS_S / 2:
            ahead -= CLOCK_MODULUS_S
        return self._newest_s + ahead

    def observe(self, node_s: float, arrival_s: float) -> None:
        """Add a frame stamped ``node_s`` (wrapped) that arrived at ``arrival_s`` (host clock)."""
        unwrapped_s = self.unwrap(node_s)
        if self._newest_s is None or unwrapped_s > self._newest_s:
            self._newest_s = unwrapped_s
        self._points.append((unwrapped_s, arrival_s - unwrapped_s))
        while self._newest_s - self._points[0][0] > WINDOW_S:
            self._points.popleft()
        self._fit()

    def to_host_s(self, node_s: float) -> float:
        """Return the host time of ``node_s`` (wrapped)."""
        unwrapped_s = self.unwrap(node_s)
        return unwrapped_s + self._offset_s + self.drift * (unwrapped_s - self._reference_s)

    def _fit(self) -> None:
        points = sorted(self._points)
        mean_s = sum(p[0] for p in points) / len(points)
        if points[-1][0] - points[0][0] < MIN_SPAN_S:
            self._set(mean_s, 0.0, points)
            return
        # The hull's edge that lies below the mean.
        left, right = next(e for e in pairwise(_lower_hull(points)) if mean_s <= e[1][0])
        drift = (right[1] - left[1]) / (right[0] - left[0])
        self._set(mean_s, min(max(drift, -DRIFT_LIMIT), DRIFT_LIMIT), points)

    def _set(self, reference_s: float, drift: float, points: list[tuple[float, float]]) -> None:
        self._reference_s = reference_s
        self.drift = drift
        self._offset_s = min(offset - drift * (s - reference_s) for s, offset in points)


def _lower_hull(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Lower convex hull of sorted points (Andrew's monotone chain)."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        if hull and hull[-1][0] == x:
            continue
        while len(hull) >= 2:
            (ax, ay), (bx, by) = hull[-2], hull[-1]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                break
            hull.pop()
        hull.append((x, y))
    return hull
