"""Odometry faults: noticed in the ranges, answered by perturbed hypotheses for a while.

Dead reckoning fails in ways that no noise level describes: a visual odometry loses its place and
reports metres that were never walked, a wearer is carried, a heading is off by a right angle after
a blow. The ranges of that one node then fit nothing for a while. Noise that adapts to it would
hide it, and hypotheses that are perturbed all the time cost accuracy, so:

* A fault is **noticed** by the ranges' innovations under the whole mixture *before* each update.
  With e = nu^2 / S, relative to its usual value for this team, the log likelihood ratio of "four
  times the variance" to "as usual",

      delta = (e (1 - 1/4) - log 4) / 2,

  is summed up as long as the sum is positive (CUSUM: Page 1954). Of a node's ranges of one
  instant the median is taken, which tells a node that fits none of several peers from the peers
  that fit all others, and counts for half of them, as so many are at least as odd. Each delta is
  clipped, so that one outlier raises no alarm.

* An alarm is **answered** by many hypotheses that perturb this node: its place (on the ring of
  a peer that ranged it), its heading (anywhere round the circle), or both. The ranges then
  choose, and the node is ``ambiguous`` until they have. The alarm may be raised again while the
  fault goes on.

* A displacement far above a node's usual speed needs no ranges: half the hypotheses leave it out
  (:class:`SpeedGate`).

* Reports that go nowhere are noise of a standing sensor (:class:`ZeroMotionDetector`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Bools, Floats, Indices
from relpos.fusion.compiled import compiled
from relpos.fusion.models.motion import known_sigmas
from relpos.fusion.timeline import Advance

JUMP_M = 3.0
"""How far a perturbed hypothesis is off. P1 with a start shifted by 4 m, seeds 23000 to 23007: .74
m with 1, .34 with 3, .37 with 6; kidnapped by 5 m .30, .26 and .26. That it turns, too, changed
nothing there, nor with 20 % NLOS or in ``lab``."""

# -- faults that the ranges show -------------------------------------------------------------------

CLIP = 3.0
"""One innovation counts at most so much: an outlier of 3 m would raise an alarm by itself."""

GROWN = 4.0
"""The fault hypothesis: so many times the innovations' usual variance."""

ALARM = 8.0
"""At least three instants; by chance alone once in e^8 = 3000 ranges of a lone pair. The price is
half the hypotheses for a few seconds."""

TEAM_ALARM = 14.0
"""As ``ALARM`` for three and more: a faulty node fits none of several, which is quicker seen, and
teams of few ranges raise more false alarms (scenario H, 12 seeds without any fault: 1.03 m
without any alarm, 1.15 m with 8, 1.04 m with 14)."""

WARY = 0.6
"""Share of the alarm's threshold that is enough soon after a fault."""

BASE_SHARE = 0.01
BASE_LEAST, BASE_MOST = 0.3, 1.0
"""The usual nu^2/S is averaged over a hundred ranges and kept within these: 1 for a consistent
filter, less for a cautious one."""


class CusumDetector(NamedTuple):
    """The cumulative sums of N nodes (rows); :func:`update_cusum` adds the ranges of an instant."""

    sums: Floats
    """(N,)"""
    base: Floats
    """(1,) the usual nu^2/S."""


@compiled
def update_cusum(
    detector: CusumDetector,
    first: Indices,
    second: Indices,
    square: Floats,
    effective: Floats,
    outliers: float,
    wary: bool,
) -> int:
    """Add the ranges (R,) of one instant, in place; return the faulty row, -1 where there is none.

    ``square`` is nu^2/S of the mixture before the update, ``effective`` how many independent
    ranges each counts, ``outliers`` the share of outliers as far as it is known. Soon after a
    fault be ``wary``: the place found then may have been wrong. Of two nodes alone either may be
    the faulty one: what is between them is perturbed in the same way.
    """
    sums, base = detector.sums, detector.base
    usual = min(max(base[0], BASE_LEAST), BASE_MOST)
    rise, fall = 0.5 * (1.0 - 1.0 / GROWN) / usual, 0.5 * math.log(GROWN)
    ranges = first.shape[0]
    delta = np.empty(ranges)
    for r in range(ranges):
        delta[r] = min(rise * square[r] - fall, CLIP)
    high = 0.0
    for row in range(sums.shape[0]):
        high = max(high, sums[row])
    if high < 0.25 * ALARM:
        for r in range(ranges):
            base[0] += BASE_SHARE * (min(square[r], 4.0) - base[0])
    own = np.empty(2 * ranges)
    highest, faulty = 0.0, 0
    for row in range(sums.shape[0]):
        several, independent = 0, 0.0
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
                    independent += effective[r]
        if several:
            median = 0.5 * (own[(several - 1) // 2] + own[several // 2])
            # The filter whitens what repeats itself, except for nodes that stand.
            half = max(several // 2, 1)
            median *= min(3.0 * independent, half)
            sums[row] = max(sums[row] + median - CLIP * outliers * half, 0.0)
            # Only one that is ranged now can be placed anew.
            if sums[row] > highest:
                highest, faulty = sums[row], row
    alarm = ALARM if sums.shape[0] < 3 else TEAM_ALARM
    if highest < (WARY if wary else 1.0) * alarm:
        return -1
    # Nodes that ranged with it have been drawn along: all begin anew.
    for row in range(sums.shape[0]):
        sums[row] = 0.0
    return faulty


HEADING_CELL_RAD = 0.3
ARC_M, RING_M = 0.7, 0.2
"""What a joint filter follows well enough: a new pose's deviation of heading, along the ring and
across it. A ring of 3 m and the circle of headings are covered by some six hundred."""


@dataclass(frozen=True, slots=True)
class Perturbations:
    """Possible poses (M, 3) of one node after a fault, with covariances (M, 3, 3).

    ``kept`` (M, 2) tells whether the place and whether the heading is still the old one.
    """

    poses: Floats
    covariances: Floats
    kept: Bools


def perturb(
    old: Floats, peers: Floats, range_m: Floats, place_m: float, rng: np.random.Generator,
    *, turned: bool = True,
) -> Perturbations:  # fmt: skip
    """Perturb each of a faulty node's poses ``old`` (M, 3).

    ``peers`` (M, 2) is where each hypothesis has the peer that ranged it, ``range_m`` (M,) how
    far away. Of six poses, one keeps the place, one the heading. A new place is up to some
    ``place_m`` away from the old one and on the peer's ring; new headings are drawn evenly round
    the circle, so that each has to be right only to its share of it. A node that has not
    ``turned`` keeps its heading.
    """
    count = len(old)
    kind = rng.permutation(count) % 6
    keeps = np.stack([kind == 0, (kind == 1) | (not turned)], axis=1)
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
    return Perturbations(poses, covariances, keeps)


LOST_M, LOST_RAD = 2.0, 0.7
"""Standard deviations from which on a report says too little for a joint filter (a node that
restarted after seconds), which would take a ring for a line. The node is relocalised on the ring
of its next range."""

VAGUE_M = 0.5
"""A report with a standard deviation from here on is off in any direction, not along its path."""

HYPOTHESES = 800
"""A bank that was smaller grows to so many while a fault is open."""

BELIEVING = 0.25
"""Share of the hypotheses that take the alarm for false."""


# -- faults that the displacement alone shows ------------------------------------------------------

USUAL_M_S = 1.3
"""Speed that a node is taken to have before it has shown its own (brisk walking)."""

PRIOR_STEPS = 3
"""``USUAL_M_S`` counts as so many displacements."""

FAR_FASTER = 4.0
HASTE_M_S = 1.5
"""The gate is at ``FAR_FASTER`` times the usual speed, and at least here: a node that stood may
begin to walk."""

LEAST_S = 0.5
"""A report is taken to be of at least so long a time."""

MOVING_M_S = 0.05
LEAST_SPEED_SHARE = 0.05
"""Least share of a new moving speed in the usual one."""


@dataclass(slots=True)
class SpeedGate:
    """Compares each displacement with its node's usual speed."""

    usual_m_s: dict[int, float] = field(default_factory=dict)
    _steps: dict[int, int] = field(default_factory=dict)

    def exceeded(self, step: Advance) -> bool:
        """Add a piece of a report; return whether it is far above the node's usual speed."""
        node, duration_s = step.node, step.duration_s
        length_m = math.hypot(step.dx_m, step.dy_m)
        if length_m <= MOVING_M_S * duration_s or duration_s <= 0.0:
            return False
        # Two reports whose clocks cross may be a millisecond apart.
        speed = length_m / max(duration_s, LEAST_S * step.fraction)
        usual = self.usual_m_s.get(node, USUAL_M_S)
        most = max(FAR_FASTER * usual, HASTE_M_S)
        seen = self._steps[node] = self._steps.get(node, PRIOR_STEPS) + 1
        # A speed above the gate counts as one at the gate: a node may change its ways.
        share_of_new = max(LEAST_SPEED_SHARE, 1.0 / seen)
        self.usual_m_s[node] = usual + share_of_new * (min(speed, most) - usual)
        return speed > most


STILL_M_S, STILL_RAD_S = 0.05, 0.05
"""A node that reports to be faster does not stand."""

STILL_REPORTS = 6
STILL_RATIO = 0.6
"""So many reports in a row whose sum is shorter than this share of what it would be, were they
all in one direction, are noise: of six random ones the sum is 0.4 on average, and one in seven
times longer than 0.6; of the slowest walk it is 1."""


@dataclass(slots=True)
class ZeroMotionDetector:
    """Tells standing from slow motion, by how reports of one node add up.

    The noise of a standing sensor would make its node wander off by centimetres a minute. What
    moves slowly moves somewhere; noise goes nowhere.
    """

    _open: dict[int, tuple[float, float, float, float]] = field(default_factory=dict)
    _recent: dict[int, tuple[tuple[float, float, float], ...]] = field(default_factory=dict)

    def update(self, step: Advance) -> bool:
        """Add a piece of a report; return whether the node stands there."""
        _, node, duration_s, dx_m, dy_m, dtheta_rad, share = step[:7]
        turns = abs(dtheta_rad) > STILL_RAD_S * duration_s
        if turns or math.hypot(dx_m, dy_m) > STILL_M_S * duration_s:
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
        x, y, turn = (sum(of) for of in zip(*recent, strict=True))
        return math.hypot(x, y) <= STILL_RATIO * way and abs(turn) <= STILL_RATIO * turned


def vagueness(step: Advance) -> tuple[float, float] | None:
    """Return standard deviations (m, rad) of a piece whose report says to know next to nothing."""
    along_m, left_m, sigma_rad = known_sigmas(step)
    sigma_m = min(along_m, left_m)
    whole = math.sqrt(max(step.fraction, 1e-9))
    if sigma_m / whole > VAGUE_M or sigma_rad / whole > LOST_RAD:
        return sigma_m, sigma_rad
    return None
