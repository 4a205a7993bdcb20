"""A whole mission, smoothed: the estimator behind ``relpos fuse --smooth``.

It passes everything on to an online estimator, keeps it, and smooths when the run has ended. The
online estimates are where the optimisation begins; because they may have been in a wrong mode, it
begins from further runs of the estimator until two have ended at the same best solution.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.estimator import (
    ANY_ANGLE_RAD,
    Estimate,
    Estimator,
    NodeEstimate,
    NodeStatus,
    PairEstimate,
    Parameter,
    by_silence,
    named_pairs,
    pair_moments,
)
from relpos.fusion.models.ranging import RANGE_SCALE_SD, Mounting
from relpos.fusion.models.unseen_walk import TURNS_RAD2_S, WALKING_M_S
from relpos.fusion.post import posts_of
from relpos.fusion.smoother.as_learned import as_learned, learned_rises, range_scale_sd
from relpos.fusion.smoother.graph import Graph, build_graph
from relpos.fusion.smoother.lasting import without_lasting_errors
from relpos.fusion.smoother.problem import Problem
from relpos.fusion.smoother.solution import Solution, beginnings, smooth
from relpos.fusion.smoother.variance_components import VarianceComponents
from relpos.fusion.vertical.offline import as_climbed
from relpos.measurements import Measurement, Prior

SURE_M = 1.0
"""A node that the online estimator left ambiguous, and that smoothing does not place within
this, stays ambiguous."""

FACING_KNOTS, WAY_RAD = 2, 0.5
"""Over so many knots before and after the way is taken, and how well a gap's way is known."""

SAME = 0.1
"""Costs that differ by less are those of one solution.

In one of 69 missions a further run found a likelier solution than that of the two that agreed
(``docs/notebook/smoother.md``)."""

SIMPLER_BY = 3.0
"""How much more (logarithmic) evidence a team without biases or scales must have: errors that last
make evidence look stronger than it is, and what is left out makes the rest look surer."""

UNBIASED_SHARE = 0.1
"""Nothing is left out where the online estimator gave more weight than this, in the mean over the
run, to biases that lengthen ranges in proportion.

Teams in an office (``bench/recorded_teams.py``, lower back, seeds 1 and 4; phones, seed 0) have
0.39, 0.40 and 1.14 m, NEES 1.2, 1.3 and 1.8; 0.41, 0.67 and 1.30 m, NEES 1.5, 4.5 and 3.1 where
evidence alone decides. ``paper-p1``, where nothing is biased, has 0.095 m for 0.080 without."""


@dataclass
class Smoother:
    """An :class:`~relpos.fusion.estimator.Estimator` that gives everything at the end.

    ``online`` is the estimator whose estimates begin the first attempt; ``others`` make those of
    further attempts (they see the whole run again), until one ends where the best had ended.
    """

    online: Estimator
    others: Sequence[Estimator] = ()
    priors: Sequence[Prior] = ()
    mountings: Mapping[int, Mounting] = field(default_factory=dict)
    solutions: list[Solution] = field(default_factory=list)
    """All attempts of :meth:`finish`, the best first."""
    _measurements: list[Measurement] = field(default_factory=list)
    _estimates: list[Estimate] = field(default_factory=list)
    _own: Counter[str] = field(default_factory=Counter)

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Take one measurement; nothing is known for sure before the end."""
        self._estimates += self.online.process(measurement)
        self._measurements.append(measurement)
        return []

    def finish(self) -> list[Estimate]:
        """Smooth the whole run; RelposError if the data were unfit."""
        self._estimates += self.online.finish()
        nodes = [prior.node for prior in self.priors]
        learned = as_learned(self._measurements, self._estimates)
        climbed = as_climbed(learned, nodes, posts_of(self.mountings))
        rises = learned_rises(self._estimates)
        graph, unused = build_graph(climbed, self.priors, self.mountings, rises)
        self._own.update(unused)
        graph = _with_frame(graph, self._estimates)
        problem = Problem(graph)
        others = (_replay(estimator, self._measurements) for estimator in self.others)
        least, begun = math.inf, np.empty(0)
        for estimates in chain([self._estimates], others):
            poses = _poses(graph, estimates)
            if np.array_equal(poses, begun):  # a large team's estimate draws no random numbers
                break
            state, begun = problem.first_state(poses), poses
            found = [
                smooth(problem, state, inliers=believed) for believed in beginnings(problem, state)
            ]
            self.solutions += found
            cost = min(s.cost for s in found)
            if abs(cost - least) < SAME:
                break
            least = min(cost, least)
        self.solutions.sort(key=lambda s: s.cost)
        best = without_lasting_errors(problem, self.solutions[0])
        scale_sd = range_scale_sd(self._estimates)
        if scale_sd < UNBIASED_SHARE * RANGE_SCALE_SD:
            best = _without_needless_constants(problem, best)
        self.solutions.insert(0, best)
        self._own["smoother_attempts"] += len(self.solutions) - 1
        self._own["smoother_outliers"] += int(np.sum(best.inliers.ranges < 0.5))
        return list(_estimates(problem, best, self._estimates, scale_sd))

    def counters(self) -> Mapping[str, int]:
        """Count what the online estimator counts, and the smoother's own."""
        return {**self.online.counters(), **self._own}


def _without_needless_constants(problem: Problem, best: Solution) -> Solution:
    """Leave out range biases, step scales or both where the run is clearly likelier without."""
    chosen, least = best, best.cost - SIMPLER_BY
    for calibrated, to_scale in ((True, True), (True, False), (False, True)):
        components = VarianceComponents.first(
            problem.nodes, calibrated=calibrated, to_scale=to_scale
        )
        simpler = smooth(problem, best.state, components, best.inliers)
        if simpler.cost < least:
            chosen, least = simpler, simpler.cost
    return chosen


def _replay(estimator: Estimator, measurements: Iterable[Measurement]) -> list[Estimate]:
    estimates = [e for measurement in measurements for e in estimator.process(measurement)]
    return estimates + estimator.finish()


def _with_frame(graph: Graph, estimates: Sequence[Estimate]) -> Graph:
    """Where no start is known, hold the node whose pose at the start is the frame."""
    if (graph.prior_weight[:, :2] > 1e-3).any():
        return graph
    located = [
        (node.node, abs(node.x_m) + abs(node.y_m))
        for estimate in estimates[:1]
        for node in estimate.nodes
        if node.status is not NodeStatus.UNLOCATED
    ]
    name = min(located, key=lambda pair: pair[1])[0] if located else graph.node_ids[0]
    row = graph.node_ids.index(name)
    weight, prior = graph.prior_weight.copy(), graph.prior.copy()
    weight[row], prior[row] = 1e6, 0.0
    return replace(graph, prior=prior, prior_weight=weight)


def _poses(graph: Graph, estimates: Sequence[Estimate]) -> Floats:
    """Poses (K, N, 3) from an online estimate; dead reckoning where it has none.

    Before a node was located it is reckoned backwards from where it first was.
    """
    knots, nodes = graph.time_s.size, len(graph.node_ids)
    row = {node: k for k, node in enumerate(graph.node_ids)}
    poses = np.full((knots, nodes, 3), np.nan)
    for estimate in estimates:
        k = int(np.argmin(np.abs(graph.time_s - estimate.time_s)))
        for node in estimate.nodes:
            if node.status is not NodeStatus.UNLOCATED and node.node in row:
                poses[k, row[node.node]] = (node.x_m, node.y_m, node.heading_rad)
    known = graph.prior_weight[:, 0] > 1e-3
    poses[0, known] = graph.prior[known]
    reckoned = graph.dead_reckoned(graph.prior)
    for n in range(nodes):
        there = np.flatnonzero(np.isfinite(poses[:, n, 0]))
        if not there.size:
            poses[:, n] = reckoned[:, n]
            continue
        for gap in np.flatnonzero(~np.isfinite(poses[:, n, 0])):
            k = int(gap)
            before = there[there < k]
            anchor = int(before[-1] if before.size else there[0])
            poses[k, n] = _carried(poses[anchor, n], reckoned[anchor, n], reckoned[k, n])
    # Headings go on from one another as the reports turn.
    reported = graph.chords.turn_rad
    turn = np.diff(poses[..., 2], axis=0) - reported
    turn = (turn + np.pi) % (2.0 * np.pi) - np.pi + reported
    poses[1:, :, 2] = poses[0, :, 2] + np.cumsum(turn, axis=0)
    first = np.round((poses[0, :, 2] - graph.prior[:, 2]) / (2.0 * np.pi)) * 2.0 * np.pi
    poses[..., 2] -= first
    return poses


def _carried(pose: Floats, reckoned_there: Floats, reckoned_here: Floats) -> Floats:
    """Move a pose along dead reckoning, forwards or backwards."""
    turn = pose[2] - reckoned_there[2]
    c, s = math.cos(turn), math.sin(turn)
    dx, dy = reckoned_here[:2] - reckoned_there[:2]
    return np.array([pose[0] + c * dx - s * dy, pose[1] + s * dx + c * dy, reckoned_here[2] + turn])


def _estimates(
    problem: Problem, solution: Solution, online: Sequence[Estimate], scale_sd: float
) -> Iterable[Estimate]:
    """Turn a solution into the rows of the run format, one epoch after another."""
    graph, poses = problem.graph, solution.state.poses
    knots, nodes = poses.shape[:2]
    facing = _facing(graph, poses)
    blocks = solution.covariance.diagonal.reshape(knots, nodes, 3, nodes, 3)
    alone = blocks[:, np.arange(nodes), :, np.arange(nodes), :].transpose(1, 0, 2, 3)
    news = graph.has_report & (graph.unseen_m2 == 0.0)
    for chord, pair in zip(graph.ranges.chord, graph.ranges.pair, strict=True):
        news[chord, pair] = True
    begun = np.logical_or.accumulate(news, axis=0) | (graph.prior_weight[:, 0] > 1e-3)
    silent = np.zeros(nodes, dtype=int)
    vertical = {(e.time_s, n.node): n.vertical[1:] for e in online for n in e.nodes}
    ambiguous = {
        n.node for n in (online[-1].nodes if online else ()) if n.status is NodeStatus.AMBIGUOUS
    }
    ranged = np.isin(np.arange(nodes), graph.pairs) | (graph.prior_weight[:, 0] > 1e-3)
    for k in range(1, knots):
        time_s = float(graph.time_s[k])
        silent = (silent + 1) * ~news[k - 1]
        rows = []
        for n, name in enumerate(graph.node_ids):
            p = alone[k, n]
            heading, sigma_rad = facing.get(
                (k, n), (float(poses[k, n, 2]), math.sqrt(max(float(p[2, 2]), 0.0)))
            )
            spread = math.sqrt(max(float(p[0, 0] + p[1, 1]), 0.0))
            if not (begun[k - 1, n] and ranged[n]):
                status = NodeStatus.UNLOCATED
            elif name in ambiguous and spread > SURE_M:
                status = NodeStatus.AMBIGUOUS
            else:
                status = by_silence(int(silent[n]))
            rows.append(
                NodeEstimate(
                    name, float(poses[k, n, 0]), float(poses[k, n, 1]),
                    math.remainder(heading, 2.0 * math.pi),
                    float(p[0, 0]), float(p[1, 1]), float(p[0, 1]),
                    min(sigma_rad, ANY_ANGLE_RAD), status,
                    float(graph.height_m[k, n]), *vertical.get((time_s, name), ()),
                )
            )  # fmt: skip
        shown = [n for n, node in enumerate(rows) if node.status is not NodeStatus.UNLOCATED]
        pairs = _pairs(graph.node_ids, poses[k], blocks[k], shown, scale_sd)
        yield Estimate(time_s, tuple(rows), pairs, (), _parameters(problem, solution, time_s))


def _facing(graph: Graph, poses: Floats) -> dict[tuple[int, int], tuple[float, float]]:
    """Return headings (rad) within gaps of the reports, and deviations, by knot and row of a node.

    A gap's turns are known by their sum alone: who walks faces the way, and who stands may have
    turned (:mod:`relpos.fusion.models.unseen_walk`).
    """
    result, time_s, gap = {}, graph.time_s, graph.unseen_m2 > 0.0
    going_on = np.vstack([gap[1:], np.ones(gap.shape[1], dtype=bool)])
    for chord, row in np.argwhere(gap & going_on):
        knot, n = int(chord) + 1, int(row)
        first, last = max(knot - FACING_KNOTS, 0), min(knot + FACING_KNOTS, len(poses) - 1)
        way_m, duration_s = poses[last, n] - poses[first, n], time_s[last] - time_s[first]
        east, north = (way_m[:2] / duration_s).tolist()
        if math.hypot(east, north) > WALKING_M_S:
            result[knot, n] = math.atan2(north, east), WAY_RAD
        else:
            begun = int(np.flatnonzero(~gap[:chord, n]).max(initial=-1)) + 1
            turned_rad = math.sqrt(TURNS_RAD2_S * float(time_s[knot] - time_s[begun]))
            result[knot, n] = float(poses[knot, n, 2]), turned_rad
    return result


def _pairs(
    names: Sequence[int], poses: Floats, blocks: Floats, shown: Sequence[int], scale_sd: float
) -> tuple[PairEstimate, ...]:
    moments = pair_moments(poses[shown, :2], blocks[np.ix_(shown, (0, 1), shown, (0, 1))])
    moments[:, 1] = np.hypot(moments[:, 1], scale_sd * moments[:, 0])
    return named_pairs([names[n] for n in shown], moments)


def _parameters(problem: Problem, solution: Solution, time_s: float) -> tuple[Parameter, ...]:
    """The constants of the whole run, and the step scales of this part of it."""
    places, names = problem.places, problem.graph.node_ids
    value, spread = solution.state.constants, solution.covariance.constants
    rows = []
    growth = float(value[places.growth]), math.sqrt(spread[places.growth, places.growth])
    chord = max(int(np.searchsorted(problem.graph.time_s, time_s)) - 1, 0)
    scale_at = int(problem.graph.chords.scale_at[chord])
    for k, name in enumerate(names):
        own = scale_at + k
        grow = math.exp(float(value[own]))
        scale = grow, grow * math.sqrt(spread[own, own])
        drift = float(value[k]), math.sqrt(spread[k, k])
        rows += [
            Parameter(time_s, name, None, "range_growth_m", *growth),
            Parameter(time_s, name, None, "step_scale", *scale),
            Parameter(time_s, name, None, "heading_drift_rad_s", *drift),
        ]
    common = places.common_bias
    for own, (i, j) in enumerate(problem.graph.pairs, places.pair_bias.start):
        variance = spread[common, common] + spread[own, own] + 2.0 * spread[common, own]
        bias = float(value[common] + value[own]), math.sqrt(max(float(variance), 0.0))
        rows.append(Parameter(time_s, names[i], names[j], "range_bias_m", *bias))
    return tuple(rows)
