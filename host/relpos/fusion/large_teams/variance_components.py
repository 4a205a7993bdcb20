"""How noisy each wearer's motion is, learned by a large team from what its ranges correct.

If the filter's noise is right, the corrections x+ - x- of a pose have the variance by which its
own fell: E (x+ - x-)^2 = P- - P+ (Myers and Tapley's covariance matching). The quotient of both
is taken of every user and instant, along its way for the step's noise and of the heading for a
turn's and for that of walking straight on, whichever came before; the logarithm of the level in
force follows it, for the team by the mean over all and for each user by what it differs.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from relpos.fusion.models.motion_variances import ALONG, COMPONENTS, TURN, WHITE

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

TEAM_GAIN = 0.3
"""How far the team's levels follow the mean of an instant, where all users told something."""

OWN_LEAST, OWN_BEGIN = 0.02, 10.0
"""A user's own level follows by 1 / (count + begin) and at least so much."""

CAP = 9.0
"""A quotient beyond three sigmas says that something else is wrong."""

SPAN = (-5.0, 3.0)
"""Of the logarithm of the level: a twelfth of the base's standard deviation to 4.5 times it. A
little white noise always stays: it is what a badly measured turn can be corrected by."""

MOVED_M = 0.2
TURNED_RAD = 0.2
"""From so much since the last ranges on a user has moved, or turned."""

FADE = 0.3
"""How much of a turn still counts at the next instant."""

HEARD = 3
"""With fewer ranges an instant says little of a user."""


@dataclass(slots=True)
class TeamLevels:
    """Levels (N, 3) by which the bases of the motion variances are multiplied."""

    level: Floats = field(default_factory=lambda: np.empty((0, COMPONENTS)))
    _team: Floats = field(default_factory=lambda: np.zeros(COMPONENTS))
    _own: Floats = field(default_factory=lambda: np.empty((0, COMPONENTS)))
    _count: Floats = field(default_factory=lambda: np.empty((0, COMPONENTS)))
    _turned: Floats = field(default_factory=lambda: np.empty(0))
    _last: Floats = field(default_factory=lambda: np.empty((0, 2)))

    def add(self, poses: Floats) -> None:
        """Take in users at poses (E, 3) with the team's levels."""
        more = len(poses)
        self._own = np.concatenate([self._own, np.zeros((more, COMPONENTS))])
        self._count = np.concatenate([self._count, np.zeros((more, COMPONENTS))])
        self._turned = np.concatenate([self._turned, np.zeros(more)])
        self._last = np.concatenate([self._last, poses[:, :2]])
        self._refresh()

    def turn(self, rows: Indices, turn_rad: Floats) -> None:
        """Note the turns of users (E,)."""
        np.add.at(self._turned, rows, np.abs(turn_rad))

    def learn(
        self, before: Floats, prior: Floats, after: Floats, posterior: Floats, heard: Indices
    ) -> None:
        """Compare poses (N, 3) and marginals (N, 4) before and after the ranges of an instant.

        ``heard`` are the rows at both ends of the ranges, one after the other.
        """
        way = before[:, :2] - self._last
        length = np.hypot(way[:, 0], way[:, 1])
        ux, uy = way.T / np.maximum(length, 1e-9)
        fallen = prior - posterior
        step = after - before
        along = ux * ux * fallen[:, 0] + uy * uy * fallen[:, 1] + 2.0 * ux * uy * fallen[:, 2]
        along_step = ux * step[:, 0] + uy * step[:, 1]
        clear = np.bincount(heard, minlength=len(before)) >= HEARD
        moved = clear & (length > MOVED_M)
        turned = self._turned > TURNED_RAD
        for which, square, expected, fits in (
            (ALONG, along_step**2, along, moved),
            (TURN, step[:, 2] ** 2, fallen[:, 3], clear & turned),
            (WHITE, step[:, 2] ** 2, fallen[:, 3], moved & ~turned),
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
        self.level = np.exp(np.clip(self._team + self._own, *SPAN))
