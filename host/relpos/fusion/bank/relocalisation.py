"""What happens when a user's pose is doubtful: its covariance is inflated, or it is relocalised.

After an odometry fault (:mod:`relpos.fusion.models.odometry_faults`) most hypotheses move the user
to the ring of its next range, and the ranges choose. Until then the user is ambiguous.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank.adaptive_count import AdaptiveCount
from relpos.fusion.bank.hypothesis_set import HypothesisSet
from relpos.fusion.bank.mirrored import mirror_image
from relpos.fusion.bank.mixture import PERTURBED_UPDATES
from relpos.fusion.bank.storage import PER_NODE, POSE, StateIndex
from relpos.fusion.estimator import ANY_ANGLE_RAD
from relpos.fusion.models.odometry_faults import (
    BELIEVING,
    HEADING_CELL_RAD,
    HYPOTHESES,
    JUMP_M,
    LOST_M,
    LOST_RAD,
    perturb,
)
from relpos.fusion.rigid_motion import about_origin

OPEN_UPDATES = 60
"""Many hypotheses are kept for so many instants of ranges at most: what has not resolved a pose
by then (few peers, standing) will not soon."""

FOUND_M, FOUND_RAD = 1.0, 0.4
"""A user is found when its place relative to another user, and its heading, are known so well."""

ODD_M = 0.3
"""How far a doubtful displacement may be off, whether it is left out or not."""

SOUGHT, SOUGHT_IN_S = 8, 10.0
"""A user is sought so often in so long at most: where every report says that it is lost, searches
would take longer than the session, as each costs as much as a hundred ranges. After an outage
several in a row are worth theirs (two inertial sensors off for 40 and 30 s, two seeds: with one in
five seconds errors are 15 and 27 % more)."""

FAULT_UPDATES = 10.0
"""As ``PERTURBED_UPDATES``, of all hypotheses after an odometry fault."""


class Relocalisation:
    """Perturbs the poses of users in a :class:`HypothesisSet`."""

    def __init__(
        self, hypotheses: HypothesisSet, adaptive: AdaptiveCount, counters: Counter[str]
    ) -> None:
        """Begin with no user lost."""
        self._hypotheses, self._adaptive, self._counters = hypotheses, adaptive, counters
        self.ambiguous: set[int] = set()
        """Rows that had an odometry fault and are not found again yet."""
        self.lost: dict[int, tuple[float, float]] = {}
        """Row -> standard deviations of its place (m) and heading (rad), until it is ranged."""
        self.diffused_m2: dict[int, float] = {}
        """Row -> variance of its walk without a report since it was last ranged."""
        self.since_fault = 0
        """Instants of ranges since the last relocalisation."""
        self._sought_s: dict[int, deque[float]] = {}
        """Row -> when it was sought, the last times."""

    @property
    def open(self) -> bool:
        """Whether a user is ambiguous, and that for not too long."""
        return bool(self.ambiguous) and self.since_fault <= OPEN_UPDATES

    def inflate_covariance(self, row: int, sigma_m: float, sigma_rad: float) -> None:
        """Know less of a user: isotropic in place (m), and in heading (rad).

        A user that is lost by this is relocalised when it is ranged next.
        """
        self._adaptive.grow()
        these = self._hypotheses
        off = math.sqrt(0.5) * sigma_m * these.rng.standard_normal((these.count, 2))
        these.shift(row, StateIndex.X, off[:, 0])
        these.shift(row, StateIndex.Y, off[:, 1])
        kept = min(0.5 * sigma_rad**2, HEADING_CELL_RAD**2)
        turned = math.sqrt(sigma_rad**2 - kept) * these.rng.standard_normal(these.count)
        these.shift(row, StateIndex.HEADING, turned)
        for entry, variance in ((0, 0.5 * sigma_m**2), (1, 0.5 * sigma_m**2), (2, kept)):
            these.inflate(row, entry, variance)
        these.perturbed[:] = FAULT_UPDATES
        before = self.lost.get(row, (0.0, 0.0))
        total = math.hypot(sigma_m, before[0]), math.hypot(sigma_rad, before[1])
        if these.settings.hypotheses > 1 and (total[0] > LOST_M or total[1] > LOST_RAD):
            self.lost[row] = total
            self.ambiguous.add(row)

    def diffuse(self, row: int, way_m: Floats, covariance: Floats) -> None:
        """Let a user walk unseen: a way (2,), and the covariance (2, 2) of what is not known of it.

        Every hypothesis widens: a filter that hears its ranges follows the user. Lost where that
        grows without a range.
        """
        self._hypotheses.diffuse(row, way_m, covariance)
        total_m2 = self.diffused_m2.get(row, 0.0) + float(covariance.trace())
        self.diffused_m2[row] = total_m2
        if self._hypotheses.settings.hypotheses > 1 and total_m2 > LOST_M**2:
            self.lost[row] = math.sqrt(total_m2), self.lost.get(row, (0.0, 0.0))[1]
            self.ambiguous.add(row)

    def relocalise_lost(
        self, time_s: float, first: Indices, second: Indices, range_m: Floats
    ) -> None:
        """Place lost users on the rings of the ranges (R,) that the next update will use."""
        for row in list(self.diffused_m2):
            if (first == row).any() or (second == row).any():
                del self.diffused_m2[row]
        for row, (sigma_m, sigma_rad) in sorted(self.lost.items()):
            sought_s = self._sought_s.setdefault(row, deque([-math.inf] * SOUGHT, SOUGHT))
            often = time_s < sought_s[0] + SOUGHT_IN_S
            if not often and ((first == row).any() or (second == row).any()):
                del self.lost[row]
                sought_s.append(time_s)
                self._counters["nodes_sought_again"] += 1
                lost = (sigma_m > LOST_M, sigma_rad > LOST_RAD)
                self.relocalise(row, (first, second, range_m), sigma_m, lost)

    def relocalise(
        self,
        row: int,
        ranges: tuple[Indices, Indices, Floats],
        place_m: float,
        lost: tuple[bool, bool] | None = None,
        *,
        turned: bool = True,
    ) -> None:
        """Move a user to the ring of a range in most hypotheses, ``place_m`` off at most.

        In all hypotheses, where its place or heading or both are ``lost``. Where it has not
        ``turned``, the heading stays.
        """
        first, second, range_m = ranges
        these = self._hypotheses
        # Of two alone either may be the one: what is between them is perturbed in the same way.
        self._open_up([row] if these.nodes > 2 or lost else range(these.nodes))
        believing = BELIEVING if lost is None else 0.0
        which = these.rng.permutation(these.count)[round(believing * these.count) :]
        sights = np.flatnonzero((first == row) | (second == row))
        sight = sights[np.arange(len(which)) % len(sights)]
        peer = np.where(first[sight] == row, second[sight], first[sight])
        at, lane = (a[:, None] for a in these.at(which))
        own, beside = POSE * row + np.arange(POSE), POSE * peer[:, None] + np.arange(2)
        x = these.arrays.x
        old, peers_m = x[at, own, lane], x[at, beside, lane]
        made = perturb(old, peers_m, range_m[sight], place_m, these.rng, turned=turned)
        x[at, own, lane] = made.poses
        # What was lost is no longer correlated with anything else.
        for kept, part in zip(made.kept.T, (np.array([0, 1]), np.array([2])), strict=True):
            lost_there = made.covariances[~kept][:, part[:, None], part]
            these.decorrelate(own[part], lost_there, which[~kept])
        # Neither the perturbed nor the others may say how noisy anything is.
        these.perturbed[:] = FAULT_UPDATES

    def reflect_team(self, *, north_known: bool) -> None:
        """Let half the hypotheses be the team's mirror image; the ranges choose.

        How the image is turned in the world only absolute headings tell, if north is known.
        """
        these = self._hypotheses
        if these.settings.hypotheses == 1 or these.nodes < 2:
            return
        self._open_up(range(these.nodes))
        half = these.rng.permutation(these.count)[: these.count // 2]
        x, p = these.dense()
        x[half], p[half] = mirror_image(x[half], p[half], these.nodes)
        these.store(x, p)
        these.perturbed[:] = FAULT_UPDATES
        if not north_known:
            mean, _ = these.moments(poses_alone=True)
            at = PER_NODE * np.arange(these.nodes)
            middle_m = (float(mean[at + e].mean()) for e in (StateIndex.X, StateIndex.Y))
            these.common += about_origin(np.diag([0.0, 0.0, ANY_ANGLE_RAD**2]), *middle_m)
        self._counters["teams_reflected"] += 1

    def _open_up(self, rows: Sequence[int]) -> None:
        """Take ``rows`` for ambiguous, and have enough hypotheses to find them again."""
        self.since_fault = 0
        self._adaptive.grow()
        self.ambiguous.update(rows)
        these = self._hypotheses
        these.resample(these.weights(), max(these.count, HYPOTHESES))

    def end_ambiguity(self, covariance: Floats) -> None:
        """Take users for found again, by the mixture's covariance (D, D)."""
        for row in list(self.ambiguous):
            at = PER_NODE * row
            others = PER_NODE * np.delete(np.arange(self._hypotheses.nodes), row)
            spread = [
                covariance[at + e, at + e] + covariance[others + e, others + e]
                - 2.0 * covariance[at + e, others + e]
                for e in (StateIndex.X, StateIndex.Y)
            ]  # fmt: skip
            near = float(np.min(spread[0] + spread[1], initial=math.inf))
            heading = float(covariance[at + StateIndex.HEADING, at + StateIndex.HEADING])
            if near < FOUND_M**2 and heading < FOUND_RAD**2:
                self.ambiguous.discard(row)

    def split_motion(self, row: int, moved: Floats) -> None:
        """Let half the hypotheses leave out a displacement (K, 3) just made, world axes."""
        these = self._hypotheses
        skip = np.flatnonzero(np.arange(these.count) % 2 == 0)
        for entry in (StateIndex.X, StateIndex.Y):
            these.shift(row, entry, -moved[skip, entry], skip)
            these.inflate(row, entry, ODD_M**2)
        these.perturbed[:] = FAULT_UPDATES
        self._counters["motions_doubted"] += 1

    def perturb_some(self, surprise: Sequence[float], usual: float) -> None:
        """Perturb a user's pose in some hypotheses where its ranges do not fit.

        ``surprise`` (N,) is each user's share of odd ranges, ``usual`` the ordinary one.
        """
        these = self._hypotheses
        s = these.settings
        if not these.nodes or these.count < 2:
            return
        rate = [s.jumps_most * min(max((much - usual) / 0.35, 0.0), 1.0) for much in surprise]
        total = sum(rate)
        if total <= 0.0:
            return
        which = np.flatnonzero(these.rng.random(these.count) < total)
        if not which.size:
            return
        these.perturbed[which] = PERTURBED_UPDATES
        edges = np.cumsum(rate) / total
        edges[-1] = 1.0
        drawn = [(these.rng.random(), these.rng.standard_normal(2)) for _ in which]
        rows = np.searchsorted(edges, [place for place, _ in drawn], side="right")
        offsets_m = math.sqrt(0.5) * JUMP_M * np.array([offset for _, offset in drawn])
        for row in set(rows.tolist()):
            its = rows == row
            for entry in (StateIndex.X, StateIndex.Y):
                these.shift(row, entry, offsets_m[its, entry], which[its])
                these.inflate(row, entry, 0.5 * JUMP_M**2, which[its])
        self._counters["jumps"] += len(which)
