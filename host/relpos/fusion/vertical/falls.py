"""Falls of one wearer, told as heights arrive.

The vertical filter waits for the team's motion and looks back; an alarm must not wait. So this runs
the modes of :mod:`~relpos.fusion.vertical.episodes` for one node alone, over its last heights.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.vertical import episodes
from relpos.fusion.vertical.episodes import STANDS_STEPS_S, Beliefs, Interval, Update
from relpos.fusion.vertical.heights import UNSEEN_S
from relpos.fusion.vertical.modes import Mode
from relpos.measurements import Height

LEAST_FALL_M = 0.9
"""A fall is told from here on. Emulated falls of 1.7 m (seeds 100 to 111) show at least 1.1 m, and
0.9 m by 1.1 s after their end; a door of 10 Pa is 0.8 m."""
LEAST_DROP_M = 2.5
"""So much at once is no door's pressure (:data:`~relpos.fusion.vertical.filter.LOST_M`) but a free
fall: 3 m take 0.8 s."""
INTERVALS, FREE_INTERVALS = 5, 2
SHORTEST_S = 0.75
"""Nodes may report ten times a second (``report-period``); five intervals have to hold a fall, and
the modes are those of about a second."""


@dataclass(slots=True)
class FallDetector:
    """Feed every motion's steps to :meth:`step` and every height to :meth:`measure`."""

    _beliefs: Beliefs | None = None
    _steps: float = 0.0
    """Since the last height."""
    _walked: bool = False
    _height_m: float = 0.0
    _time_s: float = 0.0
    _recent: deque[tuple[Update, float]] = field(default_factory=lambda: deque(maxlen=INTERVALS))
    """The last intervals, and by how much the height rose."""

    def step(self, steps: float) -> None:
        """Add reported steps."""
        self._steps += steps

    def measure(self, measured: Height) -> bool:
        """Add a height; return whether the wearer has fallen. A fall is told once."""
        since_s = measured.time_s - self._time_s
        height_m = np.array([measured.height_m])
        variance_m2 = np.array([(measured.sigma_m or episodes.SIGMA_HEIGHT_M) ** 2])
        if self._beliefs is not None and since_s < SHORTEST_S:
            return False
        self._time_s = measured.time_s
        rise_m, self._height_m = measured.height_m - self._height_m, measured.height_m
        steps, self._steps = self._steps, 0.0
        if self._beliefs is None or since_s > UNSEEN_S:
            self._begin(height_m, variance_m2)
            return False
        interval = Interval(
            since_s, np.array([since_s]), np.array([steps]), height_m, variance_m2,
            np.array([self._walked]),
        )  # fmt: skip
        update = episodes.update(self._beliefs, interval)
        self._beliefs, self._walked = update.beliefs, steps > 0.0
        self._recent.append((update, rise_m))
        did = np.array([modes[0, 0] for modes in episodes.smooth([one for one, _ in self._recent])])
        rises_m = np.array([rise for _, rise in self._recent])
        fallen_m = -float(did[:, Mode.FALLING] @ rises_m)
        # A free fall looks like a door's pressure. It is over at once, which no lift's ride is.
        falling = rises_m < -LEAST_FALL_M / INTERVALS
        at_once = 0 < falling.sum() <= FREE_INTERVALS and not (falling[0] or falling[-1])
        dropped_m = 0.0
        if at_once and steps <= STANDS_STEPS_S * since_s:
            dropped_m = -float(did[:, [Mode.FALLING, Mode.JUMP]].sum(axis=1) @ rises_m)
        if fallen_m < LEAST_FALL_M and dropped_m < LEAST_DROP_M:
            return False
        self._begin(height_m, variance_m2)
        return True

    def _begin(self, height_m: Floats, variance_m2: Floats) -> None:
        self._beliefs = episodes.begin(height_m, variance_m2, airs=1)
        self._recent.clear()
