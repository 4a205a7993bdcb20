"""What the bank's hypotheses are reported as: the rows of an estimate.

Located nodes are given by the mixture's moments; a node that is ambiguous after an odometry fault
by its most probable position, and the team by alternatives. Nodes whose initial pose is unknown are
reported as the initialiser has them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from statistics import median

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.hypothesis_models import RangeErrors
from relpos.fusion.bank.mirrored import VAGUE_RAD
from relpos.fusion.bank.range_biases import Learned
from relpos.fusion.bank.storage import PER_NODE, StateIndex, every_pair
from relpos.fusion.clocks import Clocks
from relpos.fusion.estimator import (
    ANY_ANGLE_RAD,
    Alternative,
    Estimate,
    MagneticNorth,
    NodeEstimate,
    NodeStatus,
    PairEstimate,
    Parameter,
    Presence,
    named_pairs,
    pair_moments,
)
from relpos.fusion.initial_poses import POSE, Initialiser, PoseMixture, sought_node
from relpos.fusion.models.detection import Detection
from relpos.fusion.models.ranging import RANGE_SCALE_SD, CommonIndex, deviations_within
from relpos.fusion.modes import alternatives_of, belief_of

VAGUE_M = 2.0
"""A user whose distance to every peer has a larger standard deviation is ambiguous."""

MOST_LISTED = 200
"""Hypotheses that alternatives are made of after an odometry fault."""


@dataclass(frozen=True, slots=True)
class Report:
    """Everything that one estimate is made of."""

    time_s: float
    row: Mapping[int, int]
    """Located node -> its row in the core."""
    presence: Mapping[int, Presence]
    """Every node, located or not."""
    core: BankCore
    mean: Floats
    covariance: Floats
    """Moments of the mixture, (D,) and (D, D), without the team's rigid motion."""
    world_covariance: Floats
    """As ``covariance``, with it (D, D)."""
    initialiser: Initialiser
    detection: Detection
    clocks: Clocks
    """What of the time stamps has been put right, beside the state."""
    distances: tuple[Floats, Floats]
    """Means and deviations (P,) of the distances of every two located nodes, in order (m)."""
    unsure: Collection[int]
    """Nodes whose heading is not known relative to any other's, or may be mirrored."""

    def estimate(self, north: MagneticNorth | None) -> Estimate:
        """Make the estimate."""
        sought = [
            sought_node(self.initialiser, node, presence)
            for node, presence in self.presence.items()
            if node not in self.row
        ]
        ambiguous = {n for n, row in self.row.items() if row in self.core.relocalisation.ambiguous}
        pairs = self._pairs()
        vague = self._vague(pairs)
        nodes = [self._node(node, vague) for node in sorted(self.row)]
        if len(pairs) == 1:
            nodes = self._moved_apart(nodes[0], nodes[1], pairs[0])
        alternatives: tuple[Alternative, ...] = ()
        mixture = self.initialiser.mixture
        if ambiguous:
            team = self._hypotheses()
            nodes = [_at_mode(n, team) if n.node in ambiguous else n for n in nodes]
            pairs = [
                p if ambiguous.isdisjoint((p.node, p.peer)) else _pair(team, p.node, p.peer)
                for p in pairs
            ]
            if mixture is None:
                likely = np.argsort(-team.weights, kind="stable")[:MOST_LISTED]
                alternatives = self._alternatives(team.part(range(len(nodes)), likely))
        if mixture is not None:
            team, open_ = self._with_located(mixture), set(mixture.nodes)
            every = combinations(sorted(team.nodes), 2)
            pairs += [_pair(team, *two) for two in every if not open_.isdisjoint(two)]
            if not open_ <= self.initialiser.resolved:
                alternatives = self._alternatives(team)
        together = sorted([*nodes, *sought], key=lambda n: n.node)
        return Estimate(
            self.time_s, tuple(together), tuple(pairs), alternatives, self._parameters(), north
        )

    # -- located nodes -------------------------------------------------------------------------

    def _vague(self, pairs: Sequence[PairEstimate]) -> set[int]:
        """Return the nodes that are known too badly relative to every other one.

        What all have in common, the team's place and its rotation, does not count.
        """
        if len(self.row) < 2:
            return set()
        near = dict.fromkeys(self.row, math.inf)
        for pair in pairs:
            for node in (pair.node, pair.peer):
                near[node] = min(near[node], pair.sigma_distance_m)
        return {
            node
            for node in self.row
            if node in self.unsure
            or near[node] > VAGUE_M
            or self.presence[node].facing(self.time_s, 0.0, 0.0)[1] > VAGUE_RAD
        }

    def _node(self, node: int, vague: Collection[int]) -> NodeEstimate:
        row, presence = self.row[node], self.presence[node]
        status = presence.status
        doubtful = row in self.core.relocalisation.ambiguous or node in vague
        if doubtful and status is NodeStatus.OK:
            status = NodeStatus.AMBIGUOUS
        at = PER_NODE * row
        x, y, heading = self.mean[at : at + 3].tolist()
        own = self.world_covariance[at : at + 3, at : at + 3].tolist()
        within = float(self.covariance[at + 2, at + 2])
        heading, sigma = presence.facing(self.time_s, heading, math.sqrt(within))
        # The way that is walked is turned in the world as the team is.
        sigma = math.hypot(sigma, math.sqrt(own[2][2] - within))
        return NodeEstimate(
            node, x, y, math.remainder(heading, math.tau), own[0][0], own[1][1], own[0][1],
            min(sigma, ANY_ANGLE_RAD), status, *presence.vertical,
        )  # fmt: skip

    def _moved_apart(
        self, one: NodeEstimate, other: NodeEstimate, pair: PairEstimate
    ) -> list[NodeEstimate]:
        """Report a team of two as far apart as their distance is known to be.

        The mean of all places on an arc lies inside it, so that means are nearer to each other
        than people are: ``mission-two-hour``, 0.35 m so, 0.24 moved. All pairs of six moved so
        made the body-frame error of ``mission-line`` a tenth greater.
        """
        i, j = PER_NODE * self.row[one.node], PER_NODE * self.row[other.node]
        off_m = self.mean[j : j + 2] - self.mean[i : i + 2]
        distance_m = float(np.hypot(*off_m))
        if distance_m == 0.0:
            return [one, other]
        slope = np.zeros(len(self.mean))
        slope[j : j + 2] = off_m / distance_m
        slope[i : i + 2] = -slope[j : j + 2]
        along_m2 = max(float(slope @ self.covariance @ slope), 0.0)
        gain = along_m2 / (along_m2 + pair.sigma_distance_m**2 + 1e-12)
        east_m, north_m = 0.5 * gain * (pair.distance_m / distance_m - 1.0) * off_m
        return [
            replace(one, x_m=one.x_m - east_m, y_m=one.y_m - north_m),
            replace(other, x_m=other.x_m + east_m, y_m=other.y_m + north_m),
        ]

    def _parameters(self) -> tuple[Parameter, ...]:
        means, variances = self.mean.tolist(), self.covariance.diagonal().tolist()
        time_s, parameters = self.time_s, []
        for node, row in sorted(self.row.items()):
            drift, scale = PER_NODE * row + StateIndex.DRIFT, PER_NODE * row + StateIndex.SCALE
            sigma_drift = math.sqrt(max(variances[drift], 0.0))
            sigma_scale = math.sqrt(max(variances[scale], 0.0))
            grow = math.exp(means[scale])
            parameters += [
                Parameter(time_s, node, None, "step_scale", grow, grow * sigma_scale),
                Parameter(time_s, node, None, "heading_drift_rad_s", means[drift], sigma_drift),
            ]
        learned = self.core.hypotheses.biases.learned()
        parameters += self._pair_parameters(learned) + self._common_parameters()
        parameters += self._delays(learned)
        if self.detection.known:
            # One curve for the team; every node has it.
            curve = self.detection.range_m, self.detection.range_sigma_m
            parameters += [
                Parameter(time_s, node, None, "detection_range_m", *curve)
                for node in sorted(self.row)
            ]
        return tuple(parameters)

    def _pair_parameters(self, learned: Learned) -> list[Parameter]:
        """Return the pairs' range biases, or differences of height where hypotheses have these."""
        named, parameters = {row: node for node, row in self.row.items()}, []
        for (a, b), (value, variance) in sorted(learned.pairs.items()):
            name, sigma = "range_bias_m", math.sqrt(max(variance, 0.0))
            if learned.heights:
                # d(h^2) = 2 h dh; of next to nothing the square's own deviation is left.
                name, square_m2 = "height_difference_m", max(value, 0.0)
                value = math.sqrt(square_m2)
                sigma = (
                    math.sqrt(square_m2 + sigma) - value if value < sigma else sigma / (2 * value)
                )
            node, peer = sorted((named[a], named[b]))
            parameters.append(Parameter(self.time_s, node, peer, name, value, sigma))
        return parameters

    def _common_parameters(self) -> list[Parameter]:
        """Return what ranges have in common; the team's figures stand beside every node."""
        these, clocks, nodes = self.core.hypotheses, self.clocks, sorted(self.row)
        if not nodes or not these.models.has_biases.any():
            return []

        def learned(index: CommonIndex) -> tuple[float, float]:
            entry = these.common_entry(index)
            variance = max(float(self.covariance[entry, entry]), 0.0)
            return float(self.mean[entry]), math.sqrt(variance)

        shadow, (lateness, sigma) = learned(CommonIndex.SHADOW), learned(CommonIndex.LATENESS)
        growth = learned(CommonIndex.GROWTH)
        late = lateness + clocks.lateness_s, sigma
        entries = these.clock_entries()
        offsets, sigmas = self.mean[entries], deviations_within(self.covariance, entries)
        offset = {n: float(offsets[self.row[n]]) + clocks.offset_s.get(n, 0.0) for n in nodes}
        # Ranges say how clocks differ, and most are right.
        usual = median(offset.values())
        scale = 1.0, self._range_scale_sd()
        parameters = []
        for node in nodes:
            own = offset[node] - usual, float(sigmas[self.row[node]])
            parameters += [
                Parameter(self.time_s, node, None, "body_shadow_m", *shadow),
                Parameter(self.time_s, node, None, "range_growth_m", *growth),
                Parameter(self.time_s, node, None, "range_scale", *scale),
                Parameter(self.time_s, node, None, "range_lateness_s", *late),
                Parameter(self.time_s, node, None, "clock_offset_s", *own),
            ]
        return parameters

    def _delays(self, learned: Learned) -> list[Parameter]:
        """Return antenna delays (m)."""
        named = {row: node for node, row in self.row.items()}
        return [
            Parameter(self.time_s, named[row], None, "antenna_delay_m", *delay)
            for row, delay in sorted(learned.delays.items())
        ]

    def _pairs(self) -> list[PairEstimate]:
        nodes = sorted(self.row)
        rows = np.array([self.row[node] for node in nodes], dtype=np.int64)
        places = PER_NODE * rows[:, None] + np.arange(2)
        covariance = self.world_covariance[places[:, :, None, None], places]
        moments = pair_moments(self.mean[places], covariance)
        i, k = every_pair(len(nodes))
        distances, sigmas = self.distances
        own_m2 = np.array([self.presence[node].within.variance_m2 for node in nodes])
        scale_m = self._range_scale_sd() * distances
        sigmas = np.sqrt(sigmas**2 + own_m2[i] + own_m2[k] + scale_m**2)
        # Two on one spot, known exactly, are 0 m apart, whatever was added to divide by.
        moments[:, 0], moments[:, 1] = np.round(distances, 9), np.round(sigmas, 9)
        return list(named_pairs(nodes, moments))

    def _range_scale_sd(self) -> float:
        """Return the deviation of what ranges' biases share in proportion to distance."""
        these = self.core.hypotheses
        wide = these.models.has(RangeErrors.PASSING)
        if not these.biases.pairs:
            wide = wide + these.models.has(RangeErrors.CONSTANT)
        lasting = RANGE_SCALE_SD * float(these.weights() @ wide)
        return math.hypot(lasting, self.detection.range_scale_sd)

    # -- the team while a node is ambiguous or sought ------------------------------------------

    def _hypotheses(self) -> PoseMixture:
        """Return what each hypothesis says of the located nodes; their mean may be nowhere."""
        these, nodes = self.core.hypotheses, sorted(self.row)
        poses, covariances = these.poses_of(*(self.row[node] for node in nodes))
        poses = poses.reshape(these.count, -1, POSE)
        return PoseMixture(tuple(nodes), these.weights(), poses, covariances, np.ones(len(nodes)))

    def _with_located(self, mixture: PoseMixture) -> PoseMixture:
        """Return the mixture of sought nodes with the located ones, alike in all modes, behind."""
        sought, nodes = len(mixture.nodes), (*mixture.nodes, *sorted(self.row))
        poses = np.zeros((len(mixture.weights), len(nodes), POSE))
        covariances = np.zeros((len(poses), POSE * len(nodes), POSE * len(nodes)))
        poses[:, :sought] = mixture.poses
        covariances[:, : POSE * sought, : POSE * sought] = mixture.covariances
        for i, node in enumerate(nodes[sought:], sought):
            at, to = PER_NODE * self.row[node], POSE * i
            own = slice(at, at + POSE)
            poses[:, i] = self.mean[own]
            covariances[:, to : to + POSE, to : to + POSE] = self.world_covariance[own, own]
        return PoseMixture(nodes, mixture.weights, poses, covariances, np.ones(len(nodes)))

    def _alternatives(self, team: PoseMixture) -> tuple[Alternative, ...]:
        """List the modes of the team."""
        spread = team.place_covariances()
        return alternatives_of(self.time_s, team.nodes, team.weights, team.poses, spread)


def _at_mode(node: NodeEstimate, team: PoseMixture) -> NodeEstimate:
    """Report an ambiguous node at its most probable position, not at the mean of them."""
    belief = belief_of(team.weights, *team.of(team.nodes.index(node.node)))
    spread = belief.covariance_m2
    return replace(
        node, x_m=belief.x_m, y_m=belief.y_m,
        heading_rad=math.remainder(belief.heading_rad, math.tau),
        variance_x_m2=float(spread[0, 0]), variance_y_m2=float(spread[1, 1]),
        covariance_xy_m2=float(spread[0, 1]),
        sigma_heading_rad=min(belief.sigma_heading_rad, ANY_ANGLE_RAD),
    )  # fmt: skip


def _pair(team: PoseMixture, node: int, peer: int) -> PairEstimate:
    """Distance and bearing of a pair by all hypotheses about the team."""
    i, j = team.nodes.index(node), team.nodes.index(peer)
    here, there = (slice(POSE * k, POSE * k + 2) for k in (i, j))
    p, weights = team.covariances, team.weights
    off, cross = team.poses[:, j, :2] - team.poses[:, i, :2], p[:, here, there]
    spread = p[:, here, here] + p[:, there, there] - cross - cross.transpose(0, 2, 1)
    distance = np.hypot(off[:, 0], off[:, 1])
    both = np.trace(spread, axis1=1, axis2=2)
    # On the same spot no direction is along; one is as good as the other.
    apart = distance > 1e-3 * np.sqrt(both)
    unit = np.where(apart[:, None], off / np.where(apart, distance, 1.0)[:, None], 0.0)
    along = np.where(apart, np.einsum("ka,kab,kb->k", unit, spread, unit), 0.5 * both)
    across = both - along
    # To second order, as the joint filter's range: E d^2 = |off|^2 + across.
    distance = np.sqrt(distance**2 + across)
    middle = float(weights @ distance)
    variance = float(weights @ (along + (distance - middle) ** 2))
    together = complex((weights * (unit[:, 0] + 1j * unit[:, 1])).sum())
    length = min(max(abs(together), 1e-3), 1.0)
    bearing_sd = math.sqrt(
        -2.0 * math.log(length) + float(weights @ across) / max(middle, 1e-3) ** 2
    )
    return PairEstimate(
        node, peer, middle, math.sqrt(max(variance, 0.0)), float(np.angle(together)),
        min(bearing_sd, ANY_ANGLE_RAD),
    )  # fmt: skip
