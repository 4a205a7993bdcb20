"""How noisy each node's motion is, learned by a large team from what its ranges correct.

If the filter's noise is right, the corrections x+ - x- of a pose have the variance by which its
own fell: E (x+ - x-)^2 = P- - P+ (covariance matching, Myers and Tapley 1976). The quotient of
both is formed for every node and instant: along its path for the noise of steps, and of the
heading for that of turns or of walking straight, whichever came before. The logarithm of each
variance component follows its quotient, for the team by the mean over all nodes and for each node
by its difference from that mean.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.models.motion_variances import ALONG, COMPONENTS, TURN, WHITE

TEAM_GAIN = 0.3
"""How far the team's components follow the mean of an instant that many nodes contributed to."""

OWN_LEAST, OWN_BEGIN = 0.02, 10.0
"""A node's difference follows by 1 / (count + begin) and at least so much."""

CAP = 9.0
"""A quotient beyond three sigmas has another cause."""

SPAN = (-5.0, 3.0)
"""Of the component's logarithm: a twelfth of the base's standard deviation to 4.5 times it. A
little white noise always remains: a badly measured turn is corrected through it."""

MOVED_M = 0.2
TURNED_RAD = 0.2
"""From so much since the last ranges on a node has moved, or turned."""

FADE = 0.3
"""The fraction of a turn that still counts at the next instant."""

LEAST_RANGES = 3
"""With fewer ranges an instant says little about a node."""


@dataclass(slots=True)
class VarianceComponents:
    """Factors (N, 3) of the base variances of motion, in the order of ``motion_variances``."""

    factor: Floats = field(default_factory=lambda: np.empty((0, COMPONENTS)))
    _team: Floats = field(default_factory=lambda: np.zeros(COMPONENTS))
    _own: Floats = field(default_factory=lambda: np.empty((0, COMPONENTS)))
    _count: Floats = field(default_factory=lambda: np.empty((0, COMPONENTS)))
    _turned: Floats = field(default_factory=lambda: np.empty(0))
    _last: Floats = field(default_factory=lambda: np.empty((0, 2)))

    def add(self, poses: Floats) -> None:
        """Add nodes at poses (E, 3) with the team's components."""
        more = len(poses)
        self._own = np.concatenate([self._own, np.zeros((more, COMPONENTS))])
        self._count = np.concatenate([self._count, np.zeros((more, COMPONENTS))])
        self._turned = np.concatenate([self._turned, np.zeros(more)])
        self._last = np.concatenate([self._last, poses[:, :2]])
        self._refresh()

    def add_turns(self, rows: Indices, turn_rad: Floats) -> None:
        """Add the turns of nodes ``rows`` (E,)."""
        np.add.at(self._turned, rows, np.abs(turn_rad))

    def update(
        self, before: Floats, prior: Floats, after: Floats, posterior: Floats, ranged: Indices
    ) -> None:
        """Compare poses (N, 3) and marginals (N, 4) before and after the ranges of an instant.

        ``ranged`` are the rows at both ends of the ranges, one after the other.
        """
        path = before[:, :2] - self._last
        length = np.hypot(path[:, 0], path[:, 1])
        ux, uy = path.T / np.maximum(length, 1e-9)
        xx, yy, xy, hh = (prior - posterior).T
        step = after - before
        along = ux * ux * xx + uy * uy * yy + 2.0 * ux * uy * xy
        along_step = ux * step[:, 0] + uy * step[:, 1]
        enough = np.bincount(ranged, minlength=len(before)) >= LEAST_RANGES
        moved = enough & (length > MOVED_M)
        turned = self._turned > TURNED_RAD
        for which, square, expected, fits in (
            (ALONG, along_step**2, along, moved),
            (TURN, step[:, 2] ** 2, hh, enough & turned),
            (WHITE, step[:, 2] ** 2, hh, moved & ~turned),
        ):
            rows = np.flatnonzero(fits & (expected > 1e-9))
            if rows.size:
                self._follow(which, rows, np.minimum(square[rows] / expected[rows], CAP) - 1.0)
        self._turned *= FADE
        self._last = after[:, :2].copy()
        self._refresh()

    def _follow(self, which: int, rows: Indices, excess: Floats) -> None:
        mean = float(excess.mean())
        self._team[which] += TEAM_GAIN * mean * rows.size / (rows.size + 30.0)
        self._team[which] = np.clip(self._team[which], *SPAN)
        self._count[rows, which] += 1.0
        gain = np.maximum(1.0 / (self._count[rows, which] + OWN_BEGIN), OWN_LEAST)
        own = self._own[rows, which] + gain * (excess - mean)
        self._own[rows, which] = np.clip(own, -2.0, 2.0)

    def _refresh(self) -> None:
        self.factor = np.exp(np.clip(self._team + self._own, *SPAN))
