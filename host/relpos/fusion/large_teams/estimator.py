"""The estimator for large teams: the sparse filter behind measurements and estimates.

It learns the noise of ranges and motion, inflates nodes whose ranges contradict their poses, and
lets nodes join that the initialiser has found. ``Estimate.pairs`` holds the pairs within reach of
each other, not all.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Bools, Floats, Indices
from relpos.fusion.clocks import Clocks
from relpos.fusion.estimator import (
    ANY_ANGLE_RAD,
    Estimate,
    NodeEstimate,
    PairEstimate,
    Parameter,
    Presence,
    Vertical,
    heights_apart,
    refuse_unmoved,
    refuse_unranged,
    unlocated,
)
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.initial_poses import Initialiser, PoseMixture, by_node
from relpos.fusion.large_teams.kernels import NEAREST_M, RangeModel, Ranges, displacements
from relpos.fusion.large_teams.sparse_filter import (
    NeighbourhoodFilter,
    OwnTerm,
    own_term,
    prior_information,
)
from relpos.fusion.large_teams.variance_components import VarianceComponents
from relpos.fusion.models.detection import Detection, on_one_floor
from relpos.fusion.models.motion import WALK_M_S, reported_sigmas, velocity_m_s
from relpos.fusion.models.motion_variances import base_variances
from relpos.fusion.models.odometry_faults import JUMP_M
from relpos.fusion.models.ranging import (
    CLOCK_SD_S,
    DELAY_SHARE,
    CommonIndex,
    Mounting,
    OutlierPersistence,
    RangeCorrelation,
    antenna_m,
    common_slopes,
    tag_height_m,
)
from relpos.fusion.post import posts_of
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Step, Timeline
from relpos.fusion.vertical.filter import VerticalFilter
from relpos.measurements import Height, Prior, Range, nodes_of

SIGMA_R_M = 0.3
"""Range sigma to begin with; a few instants of many ranges determine the true one."""

SIGMA_R_COUNT = 50.0
SIGMA_R_MEMORY = 20_000.0
"""The beginning counts as so many ranges; so many are remembered."""

OUTLIERS, OUTLIER_M = 0.01, 3.0
"""A large team's fraction of outliers is not learned: 0.05 and 5 m cost a crowd 0.002 m of
0.12."""

ONE_STRIP = 50
"""Up to so many nodes are in one strip, where nothing is assumed of far ones, at no more time.

``mission-base``, area 10 + 1.25 n m, seed 4, processor time of 60 s in strips and in one: 24 people
4.2 and 3.8 s, 40 6.5 and 6.3, 60 9.0 and 8.8; of 30 s: 100 people 5.7 and 8.0, 150 7.5 and 16.2.

Up to so many have antenna delays and clocks of their own, too: T terms make as many right-hand
sides, each of 2 N numbers. A team that outgrows them has what all ranges have in common, and no
more. Detection is learned of so many: pairs grow with the square."""

REACH_SLACK = 1.05
"""Strips are this much wider than the longest range of the first instant."""

REACH_FADE = 0.999
"""The reach by which pairs are listed shrinks so slowly where ranges become shorter."""

LEAST_REACH_M = 5.0
"""Nodes nearer than this are listed as pairs, however short the ranges are."""

TOGETHER_S = 0.05
"""Ranges of so many seconds correct the team together: one correction costs as much as a hundred
ranges. In the meantime people walk on, so that each range is brought forward by how the estimated
distance has changed since; what a heading error of 10 degrees does to that is 0.02 m."""

HEIGHTS_WITHIN_S, APART_M = 1.0, 1.0
"""So long after the first height all nodes have reported one. Where they are farther apart, ranges
between floors were taken for level ones until then; what all ranges have in common was learned from
them, and is forgotten. 24 people on two floors with heights (15 m, seeds 3000 and 3001): .16 m,
NEES 1.9 where it is not."""

MOSTLY_OUTLYING = 0.5
"""From this fraction of outliers on a node's pose, and not its ranges, is taken to be wrong."""
TURNED_RAD = 0.3
"""How uncertain its heading is then."""

FORGET = 0.3
"""Weight of an instant in that fraction: at a range every 2 s, three instants or so; of one with a
single range half of it."""


class _Collected(NamedTuple):
    """A range that is not used yet."""

    measured: Range
    excess_m: float
    """By how much it exceeded the slant distance that was estimated at its instant."""
    lift_m2: float
    """Mean square of the difference of heights."""
    slopes: tuple[float, ...]
    variance_m2: float
    """What uncertain heights, and ways within reports, add to the range's."""


def _within_m2(of: Presence, time_s: float) -> float:
    """Return the variance by which a range of a node within a long report is less exact (m^2).

    Reports every second need no such doubt (21 people: .14 m for .13, NEES .6 with it). Where a
    node walks unseen, its ranges alone say where it is.
    """
    variance_m2 = of.within.range_variance_m2()
    return variance_m2 if of.within.long and of.diffused_s < time_s else 0.0


@dataclass(slots=True)
class LargeTeam:
    """The core of the estimator (:class:`~relpos.fusion.rewind.Core`)."""

    priors: Sequence[Prior]
    initialiser: Initialiser
    settings: BankSettings
    mountings: Mapping[int, Mounting]
    filter: NeighbourhoodFilter = field(init=False)
    vertical: VerticalFilter = field(init=False)
    clocks: Clocks = field(default_factory=Clocks)
    _nodes: list[int] = field(default_factory=list)
    _row: dict[int, int] = field(default_factory=dict)
    _known: dict[int, Presence] = field(default_factory=dict)
    _pending: list[Advance] = field(default_factory=list)
    _collected: list[_Collected] = field(default_factory=list)
    """Ranges not used yet."""
    _collected_s: float = math.inf
    """When the first of them was measured."""
    _own: Counter[str] = field(default_factory=Counter)
    _outlying: Floats = field(default_factory=lambda: np.empty(0))
    """Fraction of outliers in each node's latest ranges."""
    _components: VarianceComponents = field(default_factory=VarianceComponents)
    _detection: Detection = field(default_factory=Detection)
    _outliers: OutlierPersistence = field(default_factory=OutlierPersistence)
    _correlation: RangeCorrelation = field(default_factory=RangeCorrelation)
    _sigma_count: float = SIGMA_R_COUNT
    _reach_m: float = 0.0
    _moved: bool = False
    _ranges_used: int = 0
    _heights_reported: bool = False
    """By all nodes that report any."""
    _epoch_s: float = -math.inf

    def __post_init__(self) -> None:
        self.vertical = VerticalFilter(posts=posts_of(self.mountings))
        model = RangeModel(SIGMA_R_M, OUTLIERS, OUTLIER_M)
        self.filter = NeighbourhoodFilter(
            math.inf,
            model,
            terms_information=prior_information(self.settings.bias_m),
            own_sd=(DELAY_SHARE * self.settings.pair_bias_m, CLOCK_SD_S),
        )
        known: list[Prior] = []
        for p in by_node(self.priors):
            self._presence(p.node)
            if p.is_known:
                known.append(p)
            else:
                self.initialiser.add(p.node, p)
        poses = np.array([(p.x_m, p.y_m, p.heading_rad) for p in known]).reshape(-1, 3)
        sigmas = np.array([(p.sigma_m, p.sigma_m, p.sigma_rad) for p in known]).reshape(-1, 3)
        self._add([p.node for p in known], poses, sigmas[:, :, None] ** 2 * np.eye(3))

    @property
    def shared(self) -> tuple[object, ...]:
        """Objects that copies of the core refer to (:class:`~relpos.fusion.rewind.Core`)."""
        return self.priors, self.settings, self.mountings

    def update(self, step: Step, timeline: Timeline) -> Estimate | None:
        """Process one step; an estimate at the end of an epoch."""
        match step:
            case Advance():
                self._moved = True
                step = self.vertical.move(step)
                self._presence(step.node).received(step.time_s)
                self._pending.append(step)
            case Ranging():
                self._predict()
                if step.time_s > self._collected_s + TOGETHER_S:
                    self._correct()
                self._use_ranges(step, timeline)
            case Sensed(measurement=Height() as height):
                self._presence(height.node)
                self._own["heights_stuck"] += not self.vertical.measure(height, step.time_s)
            case Sensed():
                self._presence(step.measurement.node)
                self._own[step.unused] += 1
            case Epoch():
                self._predict()
                self._correct()
                self._climb(step.time_s)
                self._diffuse(self._row, step.time_s, timeline)
                self._add_found(self.initialiser.find(step.time_s))
                if self._reach_m > 0.0:
                    # Before any range nothing seems to measure it, and all are in one strip still.
                    self.filter.take_out_common_motion()
                self._slew_clocks(step.time_s, timeline)
                return self._estimate(step.time_s)
        return None

    def cost_s(self, step: Step) -> float:
        """Return about how many seconds of a processor ``update`` needs for a step."""
        if isinstance(step, Advance):
            return 2e-5
        search_s = self.initialiser.cost_s() if isinstance(step, Epoch) else 0.0
        return 5e-5 * len(self._nodes) + search_s

    def check_run(self, counters: Mapping[str, int]) -> None:
        """Raise RelposError if the run cannot give relative positions."""
        refuse_unmoved(self._moved)
        refuse_unranged(self._ranges_used, counters)

    def counters(self) -> Counter[str]:
        """Count everything inflated or found."""
        return self._own + self.filter.counters + self.initialiser.counters

    # -- nodes ---------------------------------------------------------------------------------

    def _presence(self, node: int) -> Presence:
        if node not in self._known:
            self._known[node] = Presence(Vertical(tag_height_m(self.mountings, node)))
        return self._known[node]

    def _climb(self, time_s: float) -> None:
        """Update heights at the end of an epoch; take back what stairs have added to motion."""
        if not self.vertical.active:
            return
        corrections = self.vertical.close(time_s)
        self._own["stairs_corrected"] += len(corrections)
        self._move(corrections)
        for node, known in self._known.items():
            vertical, tag_m = self.vertical.of(node, time_s), tag_height_m(self.mountings, node)
            known.vertical = vertical._replace(z_m=tag_m + vertical.z_m)
        if not self._heights_reported and self.vertical.first_s < time_s - HEIGHTS_WITHIN_S:
            self._heights_reported = True
            z_m = [known.vertical.z_m for known in self._known.values()]
            if max(z_m) - min(z_m) > APART_M:
                self.filter.forget_terms(prior_information(self.settings.bias_m))

    def _add(self, nodes: Sequence[int], poses: Floats, covariances: Floats) -> None:
        if not nodes:
            return
        if len(self._nodes) + len(nodes) > ONE_STRIP:
            self.filter.own_sd = ()
        self.filter.add(poses, covariances, (self.settings.drift_rad_s, self.settings.scale))
        for node in nodes:
            self._row[node] = len(self._nodes)
            self._nodes.append(node)
            self.filter.antenna_m[self._row[node]] = antenna_m(self.mountings, node)
        self._outlying = np.append(self._outlying, np.zeros(len(nodes)))
        self._components.add(poses)

    def _slew_clocks(self, time_s: float, timeline: Timeline) -> None:
        """Let what has been learned of time stamps go into those of later ranges."""
        if self._epoch_s > -math.inf:
            learned = (
                float(self.filter.terms[CommonIndex.LATENESS]),
                float(self.filter.sigma_of_terms()[CommonIndex.LATENESS]),
            )
            own = (each.tolist() for each in self.filter.own_terms(OwnTerm.CLOCK))
            offsets = dict(zip(self._nodes, zip(*own, strict=True), strict=False))
            late_s, steps = self.clocks.slew(time_s - self._epoch_s, learned, offsets)
            self.filter.terms[CommonIndex.LATENESS] -= late_s
            for node, step_s in steps.items():
                self.filter.terms[own_term(self._row[node], OwnTerm.CLOCK)] -= step_s
        timeline.reorder_s = self.settings.reorder_s + self.clocks.longest_s

    # -- motion --------------------------------------------------------------------------------

    def _predict(self) -> None:
        """Apply the displacements since the last call."""
        steps, self._pending = self._pending, []
        for a in steps:
            known = self._known[a.node]
            known.velocity_m_s = velocity_m_s(a)
            known.move(a, WALK_M_S, self._known.values())
            self._correlation.move(a.node, math.hypot(a.dx_m, a.dy_m), a.dtheta_rad)
        self._move(steps)

    def _move(self, steps: Sequence[Advance]) -> None:
        """Move nodes, the sought ones, too."""
        for a in steps:
            if a.node not in self._row:
                self.initialiser.advance(a)
        steps = [a for a in steps if a.node in self._row]
        if not steps:
            return
        rows = np.array([self._row[a.node] for a in steps], dtype=np.int64)
        moves = np.array([(a.dx_m, a.dy_m, a.dtheta_rad, a.duration_s) for a in steps])
        for a, move in zip(steps, moves, strict=True):
            if self._known[a.node].leads_nowhere(a):
                move[:2] = 0.0
                self._walk_unseen(a.node, a.time_s)
            else:
                move[:2] *= self._known[a.node].undiffused(a.time_s, a.duration_s)
        reported = np.array([reported_sigmas(a) for a in steps])
        variances = base_variances(moves, reported) * self._components.factor[rows]
        self._components.add_turns(rows, moves[:, 2])
        self.filter.predict(rows, displacements(moves, variances))

    def _diffuse(self, nodes: Iterable[int], time_s: float, timeline: Timeline) -> None:
        """Let nodes whose motion is missing be anywhere that they can have walked to."""
        for node in sorted((self._row.keys() & nodes) - self.vertical.posts):
            known, heading = self._known[node], partial(self._heading_rad, node)
            if known.is_unseen(time_s, timeline.reported_s(node), heading):
                self._walk_unseen(node, time_s)

    def _walk_unseen(self, node: int, time_s: float) -> None:
        """Let a node walk on without a report."""
        walked = self._known[node].walk_unseen(time_s)
        if walked is not None:
            path_m, way_m, unknown = walked
            self._correlation.move(node, path_m, 0.0)
            self.filter.diffuse(self._row[node], way_m, unknown)
            self._own["diffusions"] += 1

    def _heading_rad(self, node: int) -> float:
        return float(self.filter.pose[self._row[node], 2])

    # -- ranges --------------------------------------------------------------------------------

    def _use_ranges(self, step: Ranging, timeline: Timeline) -> None:
        ends = nodes_of(step.ranges)
        self._diffuse(ends, step.time_s, timeline)
        for node in ends:
            self._presence(node).ranged(step.time_s)
        for measured in step.ranges:
            self.vertical.ranged(measured)
        located = [r for r in step.ranges if r.node in self._row and r.peer in self._row]
        if located:
            if len(self._nodes) <= ONE_STRIP:
                self._learn_detection(step.time_s, located, timeline)
            self._collect(step.time_s, located)
        self._seek(step)

    def _learn_detection(self, time_s: float, ranges: Sequence[Range], timeline: Timeline) -> None:
        """Learn which ranges are lost: where walls lose them, they make the others too long."""
        ended = self._detection.rounds.add(time_s, ranges, timeline.reported_s, self._on_one_floor)
        for done in ended:
            pairs = done.received + done.missed
            if not pairs:
                continue
            rows = np.array([[self._row[n] for n in ends] for ends in zip(*pairs, strict=True)])
            distance_m, along_m2, *_ = self.filter.pairs(*rows)
            self._detection.update(done, distance_m, np.sqrt(along_m2))

    def _on_one_floor(self, pairs: Sequence[tuple[int, int]]) -> Bools:
        return on_one_floor(*heights_apart(self._known, pairs))

    def _collect(self, time_s: float, ranges: Sequence[Range]) -> None:
        """Put ranges aside, as excesses over the distances that are estimated at their instant."""
        rows = np.array([self._row[n] for r in ranges for n in (r.node, r.peer)])
        places_m = self.filter.antennas_m(rows).reshape(-1, 4).tolist()
        headings = self.filter.pose[rows, 2].reshape(-1, 2).tolist()
        apart = heights_apart(self._known, [(r.node, r.peer) for r in ranges])
        heights = zip(*(each.tolist() for each in apart), strict=True)
        for r, (x, y, peer_x, peer_y), facing, (height_m, variance_m2) in zip(
            ranges, places_m, headings, heights, strict=True
        ):
            ends = self._known[r.node], self._known[r.peer]
            lift_m2 = height_m**2 + variance_m2
            # Var(dz^2) / (4 r^2), as in the bank (``fusion/bank/range_update.py``).
            lifted_m2 = (height_m**2 + 0.5 * variance_m2) * variance_m2 / r.range_m**2
            slant_m = math.sqrt((peer_x - x) ** 2 + (peer_y - y) ** 2 + lift_m2)
            near_m = max(slant_m, NEAREST_M)
            sight = (peer_x - x) / near_m, (peer_y - y) / near_m
            slopes = common_slopes(sight, slant_m, facing, [k.velocity_at(time_s) for k in ends])
            vague_m2 = lifted_m2 + sum(_within_m2(k, time_s) for k in ends)
            excess_m = r.range_m - slant_m
            self._collected.append(_Collected(r, excess_m, lift_m2, slopes, vague_m2))
            self._reach_m = max(self._reach_m * REACH_FADE, r.range_m)
        self._collected_s = min(self._collected_s, time_s)
        self._ranges_used += len(ranges)

    def _correct(self) -> None:
        """Use the ranges that were collected."""
        if not self._collected:
            return
        time_s = self._collected_s
        pairs = [(c.measured.node, c.measured.peer) for c in self._collected]
        node, peer = (np.array([self._row[n] for n in ends]) for ends in zip(*pairs, strict=True))
        common = np.array([c.slopes for c in self._collected])
        excess = np.array([c.excess_m for c in self._collected])
        lift = np.array([c.lift_m2 for c in self._collected])
        vague = np.array([c.variance_m2 for c in self._collected])
        self._collected, self._collected_s = [], math.inf
        f = self.filter
        if not math.isfinite(f.width_m) and len(self._nodes) > ONE_STRIP:
            f.widen(self._reach_m * REACH_SLACK)
        slopes = f.slopes_in_terms(node, peer, common[:, :-1], common[:, -1])
        apart_m, spread_m2 = f.antenna_pairs(node, peer)[:2]
        slant = np.sqrt(apart_m**2 + lift)
        measured = excess + slant
        before, prior = f.pose.copy(), f.marginals()
        counts = self._correlation.repeats(pairs).sample_count
        spread_m2 *= (apart_m / np.maximum(slant, NEAREST_M)) ** 2
        innovation = (excess - slopes @ f.terms) / np.sqrt(spread_m2 + f.model.sigma_m**2 + vague)
        outliers = self._outliers.expected(time_s, pairs)
        inlier = f.update(Ranges(node, peer, measured, lift, counts, vague, outliers, slopes))
        self._correct_unseen(pairs, time_s, before[:, :2], prior)
        measured -= slopes @ f.terms
        corrected = f.antenna_pairs(node, peer)
        slant = np.sqrt(corrected[0] ** 2 + lift)
        self._outliers.learn(time_s, pairs, inlier, measured - slant)
        self._correlation.learn(pairs, innovation, inlier)
        both = np.concatenate([node, peer])
        self._components.update(before, prior, f.pose, f.marginals(), both)
        self._own["ranges_distrusted"] += int((inlier < 0.5).sum())
        self._learn_sigma(corrected, measured, lift, inlier)
        news = 1.0 - outliers[:, 0]
        self._inflate(time_s, both, np.tile(inlier, 2), np.tile(news, 2))

    def _correct_unseen(
        self, pairs: Sequence[tuple[int, int]], time_s: float, place_m: Floats, prior: Floats
    ) -> None:
        """Learn how people walk unseen from what the ranges since ``time_s`` corrected.

        ``place_m`` (N, 2) and ``prior`` (N, 4) were the places and marginals before.
        """
        posterior = self.filter.marginals()
        for node in {node for pair in pairs for node in pair}:
            known, row = self._known[node], self._row[node]
            if known.unseen is not None and known.diffused_s >= time_s:
                moved_m = self.filter.pose[row, :2] - place_m[row]
                covariances = (of[row][[0, 2, 2, 1]].reshape(2, 2) for of in (prior, posterior))
                known.unseen.correct(moved_m, *covariances)

    def _learn_sigma(self, pairs: Floats, measured: Floats, lift: Floats, inlier: Floats) -> None:
        """Learn the range sigma by online expectation maximisation.

        E |z - d|^2 after the ranges is the residual's square plus what is still uncertain of d.
        What is known to add to it is not taken off: around long reports more errs than that (24
        people, ranges .6 s late, gaps of 5 s: NEES 1.2, and 1.9 where it is).
        """
        model, square_m2 = self.filter.model, pairs[0] ** 2 + pairs[2] + lift
        square = (measured - np.sqrt(square_m2)) ** 2
        square += pairs[1] * (1.0 - lift / np.maximum(square_m2, NEAREST_M**2))
        total = float(inlier.sum())
        summed = model.sigma_m**2 * self._sigma_count + float((inlier * square).sum())
        sigma_m = max(math.sqrt(summed / (self._sigma_count + total)), 0.01)
        self.filter.model = model._replace(sigma_m=sigma_m)
        self._sigma_count = min(self._sigma_count + total, SIGMA_R_MEMORY)

    def _inflate(self, time_s: float, rows: Indices, inlier: Floats, news: Floats) -> None:
        """Inflate nodes most of whose ranges are outliers: carried nodes, odometry faults.

        ``news`` is how probably each was expected to be none: walls are no news of a node.
        """
        count = np.bincount(rows, weights=news, minlength=self._outlying.size)
        outliers = np.bincount(rows, weights=news * (1.0 - inlier), minlength=self._outlying.size)
        some = count > 0.0
        weight = FORGET * np.minimum(0.5 * count[some], 1.0)
        self._outlying[some] += weight * (outliers[some] / count[some] - self._outlying[some])
        wrong = np.flatnonzero(self._outlying > MOSTLY_OUTLYING)
        if wrong.size:
            self.filter.inflate(wrong, JUMP_M, TURNED_RAD)
            self._outlying[wrong] = 0.0
            self._own["jumps"] += int(wrong.size)
            for row in wrong.tolist():
                self._known[self._nodes[row]].contradict(time_s)

    # -- nodes that are not located ------------------------------------------------------------

    def _seek(self, step: Ranging) -> None:
        """Let the initialiser use the ranges of nodes that are not located."""
        ranges = [r for r in step.ranges if r.node not in self._row or r.peer not in self._row]
        if not ranges:
            return
        nodes = sorted(nodes_of(ranges))
        own = self.filter.marginals()
        located: dict[int, tuple[float, float, float]] = {}
        for node in nodes:
            row = self._row.get(node)
            if row is not None:
                x, y = self.filter.pose[row, :2]
                located[node] = float(x), float(y), 0.5 * float(own[row, 0] + own[row, 1])
            elif node not in self.initialiser:
                self.initialiser.add(node)
        heights = {node: self._known[node].vertical.z_m for node in nodes}
        self.initialiser.update(step.time_s, ranges, located, heights)
        self._ranges_used += len(ranges)

    def _add_found(self, found: PoseMixture | None) -> None:
        """Add the nodes whose poses have been found to the filter, each as one Gaussian."""
        if found is None:
            return
        moments = [found.moments(k) for k in range(len(found.nodes))]
        poses, covariances = (np.stack(each) for each in zip(*moments, strict=True))
        self._add(found.nodes, poses, covariances)
        self._own["joined"] += len(moments)

    # -- estimates -----------------------------------------------------------------------------

    def _estimate(self, time_s: float) -> Estimate:
        for known in self._known.values():
            known.close_epoch(self._epoch_s)
        self._epoch_s = time_s
        own, common = self.filter.marginals(), self.filter.common_marginals()
        places, headings_rad2 = (own[:, :3] + common[:, :3]).tolist(), own[:, 3].tolist()
        turned_rad, pose = math.sqrt(self.filter.common[2, 2]), self.filter.pose.tolist()
        nodes = []
        for node in sorted(self._known):
            known = self._known[node]
            row = self._row.get(node)
            if row is None:
                nodes.append(unlocated(node, known.vertical))
                continue
            (x, y, heading), (xx, yy, xy) = pose[row], places[row]
            heading, sigma = known.facing(time_s, heading, math.sqrt(headings_rad2[row]))
            nodes.append(
                NodeEstimate(
                    node, x, y, math.remainder(heading, 2.0 * math.pi), xx, yy, xy,
                    min(math.hypot(sigma, turned_rad), ANY_ANGLE_RAD), known.status,
                    *known.vertical,
                )
            )  # fmt: skip
        return Estimate(time_s, tuple(nodes), self._pairs(), parameters=self._parameters(time_s))

    def _parameters(self, time_s: float) -> tuple[Parameter, ...]:
        """Return what ranges have in common; the team's figures stand beside every node.

        Antenna delays and clocks are each node's own, relative to the mean of the team.
        """
        terms, sigmas = self.filter.terms.tolist(), self.filter.sigma_of_terms().tolist()
        late_s = terms[CommonIndex.LATENESS] + self.clocks.lateness_s
        learned = (
            ("body_shadow_m", terms[CommonIndex.SHADOW], sigmas[CommonIndex.SHADOW]),
            ("range_lateness_s", late_s, sigmas[CommonIndex.LATENESS]),
            ("range_growth_m", terms[CommonIndex.GROWTH], sigmas[CommonIndex.GROWTH]),
            ("range_scale", 1.0, self._detection.range_scale_sd),
        )
        delays, clocks = (self.filter.own_terms(term) for term in OwnTerm)
        own: dict[int, list[tuple[str, float, float]]] = {}
        for row, node in enumerate(self._nodes[: delays[0].size]):
            offset_s = float(clocks[0][row]) + self.clocks.offset_s.get(node, 0.0)
            own[node] = [
                ("antenna_delay_m", float(delays[0][row]), float(delays[1][row])),
                ("clock_offset_s", offset_s, float(clocks[1][row])),
            ]
        return tuple(
            Parameter(time_s, node, None, *one)
            for node in sorted(self._row)
            for one in (*learned, *own.get(node, ()))
        )

    def _pairs(self) -> tuple[PairEstimate, ...]:
        """Return the pairs within reach of each other, in the order of ids."""
        if len(self._row) < 2:
            return ()
        from scipy.spatial import cKDTree  # 7 MB, which smaller teams do not need

        ids = np.array(self._nodes)
        near = cKDTree(self.filter.pose[:, :2]).query_pairs(
            max(self._reach_m, LEAST_REACH_M), output_type="ndarray"
        )
        swap = ids[near[:, 0]] > ids[near[:, 1]]
        near[swap] = near[swap][:, ::-1]
        near = near[np.lexsort((ids[near[:, 1]], ids[near[:, 0]]))]
        near = near.astype(np.int64)
        one, two = near[:, 0].copy(), near[:, 1].copy()
        distance, along, across, bearing = self.filter.pairs(one, two)
        unknown = self.filter.spread_of_terms(one, two, bearing)
        along, across = along + unknown[0], across + unknown[1]
        along += (self._detection.range_scale_sd * distance) ** 2
        bearing_rad2 = across / np.maximum(distance, 1e-9) ** 2 + self.filter.common[2, 2]
        sigma_bearing = np.minimum(np.sqrt(bearing_rad2), ANY_ANGLE_RAD)
        rows = zip(
            ids[near[:, 0]].tolist(), ids[near[:, 1]].tolist(), distance.tolist(),
            np.sqrt(along).tolist(), bearing.tolist(), sigma_bearing.tolist(), strict=True,
        )  # fmt: skip
        return tuple(PairEstimate(*row) for row in rows)
