"""Odometry that slips: noticed by what the ranges say, answered by many hypotheses for a while.

Dead reckoning fails in ways that no noise level describes: a visual odometry loses its place and
reports metres that nobody went, a wearer is carried, a heading is off by a right angle after a
blow. The ranges of that one node then fit nothing for a while. Noise that adapts to it would
hide it, and hypotheses that doubt everything all the time cost accuracy, so:

* **Noticed** is a slip by the ranges' innovations under the whole mixture *before* each update.
  With e = nu^2 / S, relative to what it has been for this team, the log likelihood ratio of "four
  times the variance" to "as ever",

      delta = (e (1 - 1/4) - log 4) / 2,

  is summed up as long as it is positive (Page's cumulative sum, 1954). A node's is the median
  over its ranges of one instant, so one that fits none of several peers is told from the peers
  that fit all others; each is clipped, so that outliers need company.

* **Answered** is an alarm by many hypotheses that doubt this node: its place (on the ring of
  somebody who ranged it), its heading (anywhere round the circle), or both. The ranges then
  choose, and the node is ``ambiguous`` until they have. An alarm may be raised again while the
  slip goes on.

* A displacement that is far out of a node's own habit (``FAR_FASTER`` times its usual speed and
  more) needs no ranges to be doubted: half the hypotheses leave it out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from relpos.fusion.compiled import compiled

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

CLIP = 3.0
"""One innovation counts at most so much: an outlier of 3 m would otherwise be a slip by itself."""

GROWN = 4.0
"""What a slip makes of the innovations' variance, for the ratio's sake."""

ALARM = 8.0
"""At least three instants; by chance alone once in e^8 = 3000 ranges of a lone pair. The price is
half the hypotheses for a few seconds."""

TEAM_ALARM = 14.0
"""As ``ALARM`` for three and more: who slips then fits none of several, which is quicker seen, and
teams of few ranges raise more false alarms (scenario H, 12 seeds, where nothing slips: 1.03 m
without any alarm, 1.15 m with 8, 1.04 m with 14)."""

WARY = 0.6
"""Share of ``ALARM`` that is enough soon after a slip."""

BASE_SHARE = 0.01
BASE_LEAST, BASE_MOST = 0.3, 1.0
"""The usual nu^2/S is averaged over a hundred ranges and kept within these: 1 for a consistent
filter, less for a cautious one."""

USUAL_M_S = 1.3
"""Speed that a node is taken to have before it has shown its own (brisk walking)."""

FAR_FASTER = 4.0
HASTE_M_S = 1.5
"""A displacement is doubted beyond ``FAR_FASTER`` times the usual speed, and beyond this: whoever
stood may walk."""

LEAST_S = 0.5
"""A report is taken to be of at least so long a time."""

MOVING_M_S = 0.05
HABIT = 0.05
"""Least share of a new moving speed in the usual one."""

PRIOR_STEPS = 3
"""``USUAL_M_S`` counts as so many displacements."""


@dataclass(slots=True)
class Watch:
    """The cumulative sums of N users (rows), fed with the ranges of each instant."""

    sums: Floats = field(default_factory=lambda: np.zeros(0))
    base: Floats = field(default_factory=lambda: np.ones(1))
    """The usual nu^2/S."""

    def add_node(self) -> None:
        """Watch one more."""
        self.sums = np.append(self.sums, 0.0)


@compiled
def update_cusum(
    sums: Floats,
    base: Floats,
    first: Indices,
    second: Indices,
    square: Floats,
    worth: Floats,
    outliers: float,
    wary: bool,
) -> int:
    """Update the sums with the ranges (R,) of one instant; return the row with a fault, or -1.

    ``square`` is nu^2/S of the mixture before the update, ``worth`` how many independent ranges
    each is worth, ``outliers`` the share of outliers. ``wary`` lowers the threshold for a while
    after a fault: the node may have been relocalised wrongly.
    """
    usual = min(max(base[0], BASE_LEAST), BASE_MOST)
    rise, fall = 0.5 * (1.0 - 1.0 / GROWN) / usual, 0.5 * math.log(GROWN)
    ranges = first.shape[0]
    # The filter whitens what repeats itself but for those who stand.
    delta = np.empty(ranges)
    for r in range(ranges):
        told = min(rise * square[r] - fall, CLIP) * min(3.0 * worth[r], 1.0)
        delta[r] = told - CLIP * outliers
    high = 0.0
    for row in range(sums.shape[0]):
        high = max(high, sums[row])
    if high < 0.25 * ALARM:
        for r in range(ranges):
            base[0] += BASE_SHARE * (min(square[r], 4.0) - base[0])
    own = np.empty(2 * ranges)
    highest, slipped = 0.0, 0
    for row in range(sums.shape[0]):
        several = 0
        for r in range(ranges):
            for end in (first[r], second[r]):
                if end == row:
                    # Sorted in, for the median.
                    at = several
                    while at > 0 and own[at - 1] > delta[r]:
                        own[at] = own[at - 1]
                        at -= 1
                    own[at] = delta[r]
                    several += 1
        if several:
            median = 0.5 * (own[(several - 1) // 2] + own[several // 2])
            sums[row] = max(sums[row] + median, 0.0)
        if sums[row] > highest:
            highest, slipped = sums[row], row
    alarm = ALARM if sums.shape[0] < 3 else TEAM_ALARM
    if highest < (WARY if wary else 1.0) * alarm:
        return -1
    # Who ranged with it has been drawn along; all begin anew.
    for row in range(sums.shape[0]):
        sums[row] = 0.0
    return slipped


@dataclass(slots=True)
class Habit:
    """How fast each node usually is."""

    usual_m_s: dict[int, float] = field(default_factory=dict)
    _steps: dict[int, int] = field(default_factory=dict)

    def is_odd(self, node: int, way_m: float, duration_s: float, share: float = 1.0) -> bool:
        """Whether a displacement is far out of the node's habit; it is taken note of.

        Of a piece of a report, ``share`` is how much of it.
        """
        if way_m <= MOVING_M_S * duration_s or duration_s <= 0.0:
            return False
        # Two reports whose clocks cross may be a millisecond apart.
        speed = way_m / max(duration_s, LEAST_S * share)
        usual = self.usual_m_s.get(node, USUAL_M_S)
        most = max(FAR_FASTER * usual, HASTE_M_S)
        seen = self._steps[node] = self._steps.get(node, PRIOR_STEPS) + 1
        # An odd one counts as the fastest that would not have been: habits may change.
        self.usual_m_s[node] = usual + max(HABIT, 1.0 / seen) * (min(speed, most) - usual)
        return speed > most


STILL_M_S, STILL_RAD_S = 0.05, 0.05
"""Whoever reports to be faster does not stand."""

STILL_REPORTS = 6
STILL_RATIO = 0.6
"""So many reports in a row whose sum is shorter than this share of what it would be, were they
all in one direction, are noise: of six random ones the sum is 0.4 on average, and one in seven
times longer than 0.6; of the slowest walk it is 1."""


@dataclass(slots=True)
class Stillness:
    """Tells standing from slow motion, by how reports of one node add up.

    The noise of a standing sensor would make its node wander off by centimetres a minute. What
    moves slowly moves somewhere; noise goes nowhere.
    """

    _open: dict[int, tuple[float, float, float, float]] = field(default_factory=dict)
    _recent: dict[int, tuple[tuple[float, float, float], ...]] = field(default_factory=dict)

    def is_still(
        self,
        node: int,
        dx_m: float,
        dy_m: float,
        dtheta_rad: float,
        duration_s: float,
        share: float,
        way_m: float | None = None,
    ) -> bool:
        """Take a piece of a report (``share`` of it) and tell whether the node stands there.

        ``way_m`` is its length where that is known.
        """
        if way_m is None:
            way_m = math.hypot(dx_m, dy_m)
        if way_m > STILL_M_S * duration_s or abs(dtheta_rad) > STILL_RAD_S * duration_s:
            if node in self._open:
                del self._open[node]
            if node in self._recent:
                del self._recent[node]
            return False
        x, y, turn, done = self._open.pop(node, (0.0, 0.0, 0.0, 0.0))
        x, y, turn, done = x + dx_m, y + dy_m, turn + dtheta_rad, done + share
        recent = self._recent.get(node, ())
        if done > 0.999:
            recent = self._recent[node] = (*recent[1 - STILL_REPORTS :], (x, y, turn))
        else:
            self._open[node] = (x, y, turn, done)
        if len(recent) < STILL_REPORTS:
            return False
        way = sum(math.hypot(x, y) for x, y, _ in recent)
        turned = sum(abs(turn) for _, _, turn in recent)
        net = math.hypot(sum(x for x, _, _ in recent), sum(y for _, y, _ in recent))
        return net <= STILL_RATIO * way and abs(sum(t for _, _, t in recent)) <= (
            STILL_RATIO * turned
        )


@dataclass(frozen=True, slots=True)
class Doubts:
    """Poses (M, 3) of one user that might be, with covariances (M, 3, 3).

    ``kept`` (M, 2) tells whether the place and whether the heading is still the old one.
    """

    poses: Floats
    covariances: Floats
    kept: npt.NDArray[np.bool_]


def doubts(
    old: Floats,
    peers: Floats,
    range_m: Floats,
    place_m: float,
    rng: np.random.Generator,
    lost: tuple[bool, bool] | None = None,
) -> Doubts:
    """Make a doubt of each of a slipped user's poses ``old`` (M, 3).

    ``peers`` (M, 2) is where each hypothesis has somebody who has just ranged it, ``range_m``
    (M,) how far away. Of six, one keeps the place, one the heading. A new place is up to some
    ``place_m`` away from the old one and on the peer's ring; new headings are drawn evenly round
    the circle, so that each has to be right only to its share of it.
    """
    count = len(old)
    kind = rng.permutation(count) % 6
    keeps = np.stack([kind == 0, kind == 1], axis=1)
    poses = old.copy()
    off = old[:, :2] + place_m * rng.standard_normal((count, 2)) - peers
    distance = np.maximum(np.hypot(off[:, 0], off[:, 1]), 1e-6)
    unit = off / distance[:, None]
    poses[:, :2] = np.where(keeps[:, :1], old[:, :2], peers + range_m[:, None] * unit)
    comb = 2.0 * math.pi * (rng.permutation(count) + rng.random()) / count
    poses[:, 2] = np.where(keeps[:, 1], old[:, 2], comb)
    covariances = np.zeros((count, 3, 3))
    outer = unit[:, :, None] * unit[:, None, :]
    covariances[:, :2, :2] = ARC_M**2 * np.eye(2) + (RING_M**2 - ARC_M**2) * outer
    covariances[:, 2, 2] = HEADING_CELL_RAD**2
    return Doubts(poses, covariances, keeps)


HEADING_CELL_RAD = 0.3
ARC_M, RING_M = 0.7, 0.2
"""What a joint filter follows well enough: a new pose's deviation of heading, along the ring and
across it. A ring of 3 m and the circle of headings are covered by some six hundred."""

LOST_M, LOST_RAD = 2.0, 0.7
"""A report that is as vague as this (a node that restarted after seconds) places nobody: joint
filters would take a ring for a line. The node is sought on the ring of its next range."""

VAGUE_M = 0.5
"""A report that says of itself to be so far off is not off along its way, but in any direction."""

HYPOTHESES = 800
"""A bank that was smaller grows to so many while a slip is open."""

BELIEVING = 0.25
"""Share of the hypotheses that take the alarm for false."""
