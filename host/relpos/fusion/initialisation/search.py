"""The search for unknown initial poses: hypotheses fitted to everything that has been reported.

After every epoch a :class:`HypothesisSearch` fits many hypotheses to its log. A hypothesis is one
set of present poses with the covariance that the data leave; along what they leave open (the
rotation about the first node before it moves, the heading of a node that stands) it ends at the
size of a cell, and many hypotheses stand side by side. Its weight is the evidence of its
neighbourhood (Laplace): exp(-cost / 2) times the volume of its covariance.

Every round the hypotheses continue from where they were, those that have met are merged, and new
ones are tried: all nodes, or one node, placed afresh on the circles of the others. So a mode that
the data open later is found later, and a mirror image is dropped only when its evidence is gone.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.initial_poses import HEADING_RESOLVED_RAD, POSE, PoseMixture
from relpos.fusion.initialisation.hypotheses import Hypotheses, fitted, log_evidence
from relpos.fusion.initialisation.kernels import Problem
from relpos.fusion.initialisation.measurement_log import RANGE_SIGMA_M, MeasurementLog
from relpos.fusion.initialisation.proposals import Proposals
from relpos.fusion.modes import belief_of, best_mode, relative_poses
from relpos.fusion.timeline import Advance

HYPOTHESES = 96
"""At most so many are kept; twice as many are placed at first."""

PROPOSALS = 12
"""So many are tried in a round; three times as many where at most three nodes are sought."""

_COST_PER_RANGE = 0.4
_RANGE_SIGMAS_M = (0.18, 2.0)

_RESOLVED_M = 0.7
_RESOLVED_RAD = 0.2
"""A place as seen from another node is resolved when its standard deviation is below the greater
of these (the second times the distance): joint filters are then near enough to linear."""

MOVED_M = 0.5
"""A node that has not been farther from its start has no heading to be known."""

_OVER_IMAGE = 12.0
"""A team is resolved when its log evidence is so much greater than that of its mirror image: noise
alone has given the image up to 15 more. Teams drawn at random (``bench/missions.py``: ``mixed``,
150 s, eight users at most) that were resolved in 90 s, with a way that had bent by 0.7 m, 12, and
20: seeds 0 to 89 and 200 to 279, which chose, 87, 84, 80, of them mirrored 4, 0, 0; 100 to 189, 57,
56, 54, none; 300 to 369, 41 and 39, mirrored 2 and 1."""

_IMAGE_ROUNDS = 100
"""So many rounds the fit of an image may take: after 20 its evidence is still 40 to 60 lower."""

_REPORTED_VARIANCE = 0.7
"""Variances that are reported, relative to the search's own, whose range errors are assumed too
wide so that no mode is trusted too soon. Measured: in P1 (12 seeds) the 90 % region held the truth
in 98.4, 96.6 and 94.2 % of the epochs with 1, 0.6 and 0.4; with two robots in 86, 79 and 74 %."""


@dataclass(slots=True)
class HypothesisSearch:
    """Call ``advance`` and ``log.update``, then ``solve`` at an epoch, and read ``mixture``.

    Located nodes are not sought: a range to one brings its place and the variance of that.
    """

    seed: int = 0
    counters: Counter[str] = field(default_factory=Counter)
    frame: int | None = None
    """The node whose initial pose is the frame, while no other is located."""
    log: MeasurementLog = field(init=False)
    active: frozenset[int] = frozenset()
    """Nodes that ranges, or a prior, tie to the others."""
    range_sigma_m: float = RANGE_SIGMA_M
    _rng: np.random.Generator = field(init=False)
    _hypotheses: Hypotheses = field(default_factory=Hypotheses)
    _fitted_poses: dict[int, Floats] = field(default_factory=dict)
    """Node -> its dead-reckoned pose at the last fit."""
    _newly_tied: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self.log = MeasurementLog(self.counters)

    @property
    def nodes(self) -> list[int]:
        """The nodes that are sought."""
        return self.log.nodes

    # -- measurements --------------------------------------------------------------------------

    def add(self, node: int, time_s: float, mean: Floats, sigma: Floats) -> None:
        """Seek ``node`` from now on; ``mean`` and ``sigma`` (inf: unknown) of its pose now."""
        self.log.add(node, time_s, mean, sigma)
        self._fitted_poses[node] = np.zeros(POSE)
        self._hypotheses.add_node()

    def advance(self, step: Advance, *, faulty: bool = False) -> None:
        """Move a sought node; of a ``faulty`` displacement only the turn counts."""
        change = self.log.advance(step, faulty=faulty)
        if change is None:
            return
        node = self.nodes.index(change.node)
        self._hypotheses.insert_turn(node, change.knots)
        if change.merged is not None:
            # Turns count back from the newest, knots from the oldest.
            last = change.knots - 1
            self._hypotheses.merge_turns(node, last - change.merged - 1, last)

    # -- fits ----------------------------------------------------------------------------------

    def solve(self) -> None:
        """Bring all hypotheses up to now."""
        self._move_hypotheses()
        hypotheses = self._hypotheses
        if not self.log.changed and len(hypotheses):
            return
        self.log.changed = False
        tied = self.log.tied()
        if tied != self.active:
            self._newly_tied = sorted(tied - self.active) if len(hypotheses) else []
            self.active = tied
        if not self.active:
            return
        problem = self.log.problem(self.active, hypotheses.turns, self.range_sigma_m)
        proposals = self._proposals(problem)
        if not len(hypotheses):
            # A wide net once; later rounds only mend it.
            begun = proposals.place_all(hypotheses.zeros(2 * HYPOTHESES))
            hypotheses.fits = fitted(begun, 12, problem)
            hypotheses.merge(HYPOTHESES)
        elif self._newly_tied:
            parameters = self._draw(2 * HYPOTHESES)
            new = [self.nodes.index(n) for n in self._newly_tied]
            self._newly_tied = []
            proposals.place_new(parameters, new, set(proposals.active) - set(new))
            hypotheses.fits = fitted(parameters, 12, problem)
            hypotheses.merge(HYPOTHESES)
        else:
            hypotheses.fit(3, problem)
        if proposals.movable():
            count = PROPOSALS * (3 if len(self.nodes) <= 3 else 1)
            tried = proposals.vary(self._draw(count))
            if len(tried):
                hypotheses.fit(0, problem)
                hypotheses.add(fitted(tried, 8, problem))
        hypotheses.merge(HYPOTHESES)
        self._learn_range_sigma(len(problem.ranges.at))

    def _draw(self, count: int) -> Floats:
        """Draw the parameters of hypotheses by their weights."""
        drawn = self._rng.choice(len(self._hypotheses), size=count, p=self._hypotheses.weights)
        return self._hypotheses.fits.parameters[drawn]

    def _proposals(self, problem: Problem) -> Proposals:
        nodes = self.nodes
        return Proposals(
            self._rng,
            problem,
            [i for i, n in enumerate(nodes) if n in self.active],
            None if self.frame is None else nodes.index(self.frame),
            [i for i, n in enumerate(nodes) if self.log.extent_m(n) >= MOVED_M],
        )

    def _learn_range_sigma(self, count: int) -> None:
        """Let the range sigma follow what the best hypothesis leaves unexplained, slowly.

        Twice the error that is seen counts (``_COST_PER_RANGE``): evidence is a product over
        ranges whose errors repeat, and a mode is soon trusted too much.
        """
        seen = (float(self._hypotheses.fits.costs[0]) + _COST_PER_RANGE * 20.0) / (count + 20.0)
        low, high = _RANGE_SIGMAS_M
        self.range_sigma_m *= min(max(seen / _COST_PER_RANGE, 0.3), 4.0) ** 0.05
        self.range_sigma_m = min(max(self.range_sigma_m, low), high)

    def _move_hypotheses(self) -> None:
        """Compose the displacements since the last fit."""
        for i, node in enumerate(self.nodes):
            pose, fitted_pose = self.log.pose(node), self._fitted_poses[node]
            c, s = math.cos(fitted_pose[2]), math.sin(fitted_pose[2])
            off = pose - fitted_pose
            dx_m, dy_m = c * off[0] + s * off[1], c * off[1] - s * off[0]
            self._fitted_poses[node] = pose.copy()
            self._hypotheses.move(i, dx_m, dy_m, off[2])

    # -- results -------------------------------------------------------------------------------

    @property
    def mixture(self) -> PoseMixture:
        """All hypotheses as they were at the last ``solve``, the most probable first."""
        hypotheses = self._hypotheses
        scales = np.ones(len(self.nodes))
        if len(hypotheses):
            scales = np.exp(hypotheses.by_node[0, :, 3])
        return PoseMixture(
            tuple(self.nodes), hypotheses.weights, hypotheses.poses, hypotheses.fits.covariances,
            scales,
        )  # fmt: skip

    @property
    def active_mixture(self) -> PoseMixture | None:
        """The hypotheses about the active nodes, with the variances to be reported."""
        active = [i for i, n in enumerate(self.nodes) if n in self.active]
        if not active or not len(self._hypotheses):
            return None
        part = self.mixture.part(active)
        return replace(
            part,
            covariances=_REPORTED_VARIANCE * part.covariances,
            best=best_mode(part.weights, part.poses, part.place_covariances()),
        )

    def resolved(self, least: float) -> list[int]:
        """Return the nodes whose relative pose the hypotheses agree on, with weight ``least``.

        Relative to the node ``frame``, where there is one, so that what is open of the common
        frame does not count. A node that has not moved need not have a heading.
        """
        if not len(self._hypotheses):
            return []
        mixture, found = self.mixture, []
        for i, node in enumerate(self.nodes):
            if node not in self.active or node == self.frame:
                continue
            if self.frame is None:
                poses, covariances = mixture.of(i)
                distance_m = 0.0
            else:
                first = self.nodes.index(self.frame)
                poses, covariances = relative_poses(mixture.poses, mixture.covariances, first, i)
                distance_m = float(np.median(np.hypot(*poses[:, :2].T)))
            belief = belief_of(mixture.weights, poses, covariances)
            most_m = max(_RESOLVED_M, _RESOLVED_RAD * distance_m)
            if belief.mode_weight < least or belief.mode_sigma_m > most_m:
                continue
            if belief.sigma_heading_rad > HEADING_RESOLVED_RAD and self.has_moved(node):
                continue
            found.append(node)
        return found

    def has_moved(self, node: int) -> bool:
        """Whether a node has been away from where it was added."""
        return self.log.extent_m(node) > MOVED_M

    def may_be_mirrored(self) -> bool:
        """Whether the evidence hardly tells the team from its mirror image.

        That has the same distances: nothing but ways that turn and a second known heading tell
        them apart.
        """
        if self.frame is None:
            return False
        hypotheses, active = self._hypotheses, [self.nodes.index(n) for n in self.active]
        problem = self.log.problem(self.active, hypotheses.turns, self.range_sigma_m)
        start = problem.priors.mean[self.nodes.index(self.frame)]
        image = fitted(hypotheses.mirror_image(start), _IMAGE_ROUNDS, problem)
        off = image.parameters[0, :-1].reshape(hypotheses.nodes, -1)[:, :2]
        off_m = np.hypot(*(off - hypotheses.by_node[0, :, :2])[active].T)
        if off_m.max() < _RESOLVED_M:
            return False
        return float(log_evidence(hypotheses.fits)[0] - log_evidence(image)[0]) < _OVER_IMAGE

    def release(self, nodes: Sequence[int]) -> PoseMixture:
        """Return the poses of ``nodes``, which are sought no more.

        Hypotheses that do not agree with the best one on these nodes are dropped. In the ranges of
        the others the nodes stay as places, along the best hypothesis.
        """
        hypotheses = self._hypotheses
        leaving = [self.nodes.index(n) for n in nodes]
        staying = [i for i in range(len(self.nodes)) if i not in leaving]
        agree = hypotheses.agreeing(leaving)
        released = self.mixture.part(leaving, agree)
        variance = hypotheses.fits.covariances[0].diagonal().reshape(-1, POSE)
        best = hypotheses.by_node[0]
        self.log.remove(nodes, best, variance[:, 0] + variance[:, 1], hypotheses.turns)
        hypotheses.select(agree, staying)
        for node in nodes:
            del self._fitted_poses[node]
        if self.frame in nodes:
            self.frame = None
        self.active -= set(nodes)
        return released
