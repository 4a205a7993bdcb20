"""What a node has reported lately: motion by its time, and the newest height."""

from __future__ import annotations

import cmath
import math
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

from relpos.fusion.timeline import Advance

STEP_M = 0.56
"""A step on stairs as dead reckoning claims it; where steps are not reported, way is taken so."""

STUCK_REPORTS, STUCK_STEPS = 8, 12
"""A sensor that shows one height to the digit in so many reports, over so many steps, is stuck if
most of its heights had changed before (exact heights of a plan never do): of the emulated chips'
heights 4 % are the ones before, and never more than three in a row are alike (four teams, 300 s).
``building-stuck``, seeds 920 to 923: NEES 1.3, 34 before."""

HEIGHT_LATE_S = 0.4
"""A reported height is that of so long before (``firmware/lib/node/barometer.cpp``)."""


class Moved(NamedTuple):
    """Motion since some time: steps, length of the way, displacement in the node's own frame."""

    steps: float = 0.0
    way_m: float = 0.0
    displacement_m: complex = 0j
    made_m: complex = 0j
    """As the plane has been moved by it."""

    def to(self, later: Moved, share: float = 1.0) -> Moved:
        """Return a share of what lies between this and a later one."""
        return Moved(*(share * (b - a) for a, b in zip(self, later, strict=True)))  # type: ignore[arg-type]

    def plus(self, more: Moved) -> Moved:
        """Return the sum."""
        return Moved(*(a + b for a, b in zip(self, more, strict=True)))  # type: ignore[arg-type]


NOT_MOVED = Moved()


@dataclass(slots=True)
class Track:
    """One node's reports since it was taken from last."""

    sigma_m: float
    """Standard deviation of its heights."""
    height_m: float = math.nan
    height_s: float = -math.inf
    taken_s: float = -math.inf
    """Time of the height that was taken last."""
    heading: complex = 1.0 + 0j
    """In the frame of its own dead reckoning."""
    expected: float = 1.0
    """Share of the next displacement that is true, by what the node did last."""
    _same: int = 0
    _same_since_s: float = -math.inf
    _same_steps: float = 0.0
    """Reports in a row of one height, when the first came, and the steps until then."""
    _reports: int = 0
    _changes: int = 0
    """Reports in all, and how many showed another height than the one before."""
    _reached: Moved = NOT_MOVED
    _taken: Moved = NOT_MOVED
    _points: deque[tuple[float, Moved]] = field(default_factory=deque)
    """Totals at the ends of pieces that are not taken wholly."""

    def report(self, height_m: float, time_s: float, sigma_m: float | None) -> float:
        """Add a height; return for how long there was none, where the sensor proves stuck (s)."""
        if height_m != self.height_m:
            self._same, self._same_since_s, self._same_steps = 0, time_s, self._reached.steps
            self._changes += 1
        self._same += 1
        self._reports += 1
        walked = self._reached.steps - self._same_steps >= STUCK_STEPS
        varied = self._changes > max(0.5 * (self._reports - self._same), STUCK_REPORTS)
        if walked and varied and self._same >= STUCK_REPORTS:
            unseen_s, self.height_s = self.height_s - self._same_since_s, self._same_since_s
            return unseen_s
        self.height_m, self.height_s = height_m, time_s
        self.sigma_m = sigma_m or self.sigma_m
        return 0.0

    def move(self, step: Advance) -> Advance:
        """Add a piece of motion; return it as it is expected to be true."""
        way_m = math.hypot(step.dx_m, step.dy_m)
        steps = way_m / STEP_M if step.steps is None else step.steps
        x, y, reported, made = self._reached
        moved = self.heading * complex(step.dx_m, step.dy_m)
        if not self._points:
            self._points.append((step.time_s - step.duration_s, self._reached))
        share = self.expected
        self._reached = Moved(x + steps, y + way_m, reported + moved, made + share * moved)
        self._points.append((step.time_s, self._reached))
        if self.height_s <= self.taken_s:
            # The next height is newer: without one (a dead sensor) nothing may pile up.
            self._forget(step.time_s - HEIGHT_LATE_S)
        self.heading *= cmath.rect(1.0, step.dtheta_rad)
        if share == 1.0:
            return step
        return step._replace(dx_m=share * step.dx_m, dy_m=share * step.dy_m)

    def take(self) -> Moved:
        """Return the motion up to the newest height."""
        until_s, points = self.height_s - HEIGHT_LATE_S, self._points
        self._forget(until_s)
        total = self._taken
        if points and points[0][0] <= until_s:
            (begin_s, total), *rest = points
            if rest:
                end_s, after = rest[0]
                share = (until_s - begin_s) / max(end_s - begin_s, 1e-9)
                total = total.plus(total.to(after, share))
        since = self._taken.to(total)
        self._taken, self.taken_s = total, self.height_s
        return since

    def _forget(self, until_s: float) -> None:
        """Drop the pieces that end before, but for the last one's end."""
        points = self._points
        while len(points) > 1 and points[1][0] <= until_s:
            points.popleft()
