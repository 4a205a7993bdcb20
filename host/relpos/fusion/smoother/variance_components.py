"""Variance components by maximum marginal likelihood: how noisy motion, ranges and constants are.

The motion's components take Newton steps in their logarithms with the average information matrix
(Gilmour et al. 1995), each node's about the team's mean; the others take fixed-point steps. What
their own uncertainty makes of the track is added to its covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.models.motion import SCALE_WALK
from relpos.fusion.models.odometry_faults import JUMP_M
from relpos.fusion.models.ranging import GO_ON, GO_ON_RANGES, GROWTH_SD_M
from relpos.fusion.smoother import kernels
from relpos.fusion.smoother.block_solver import Covariance
from relpos.fusion.smoother.graph import Graph
from relpos.fusion.smoother.kernels import State
from relpos.fusion.smoother.problem import Inliers, Problem, Weights


class Motion(IntEnum):
    """What a chord's three variances are made of: columns of ``VarianceComponents.motion``."""

    ALONG_LENGTH = 0
    """Along the chord, per squared length (1)."""
    ALONG_TIME = 1
    """Per second (m^2/s)."""
    ACROSS_LENGTH = 2
    ACROSS_TIME = 3
    TURN_TURN = 4
    """Of the turn, per squared turn (1)."""
    TURN_WALKING = 5
    """Per second of walking (rad^2/s)."""
    TURN_TIME = 6


AXIS = np.array([0, 0, 1, 1, 2, 2, 2])
"""Which residual of a chord each of them belongs to."""

FIRST_MOTION = np.array(
    [0.1**2, 0.005**2, 0.03**2, 0.003**2, 0.02**2, math.radians(1.0) ** 2, math.radians(0.1) ** 2]
)
"""Components to begin with: between a good robot's odometry and a bad pedestrian's.

Noise across the way that begins far too small stays so, and headings take it: with 0.002 in place
of 0.03 of the length ``mission-base`` (0.06 true, six seeds from 2700) has a NEES of 1.11, not
0.94."""

LEAST_MOTION = np.array([0.005**2, 0.001**2, 0.002**2, 0.001**2, 0.005**2, 2e-4**2, 1e-4**2])
"""Lower limits; far below all sensors, and no trouble for the digits."""

FIRST_SCALE = 0.1**2
CALIBRATED_SCALE = 0.005**2
CALIBRATED_WALK = SCALE_WALK * CALIBRATED_SCALE / FIRST_SCALE
"""Of steps whose length was calibrated."""
FIRST_DRIFT = math.radians(0.05) ** 2
FIRST_PAIR_BIAS = 0.1**2
CALIBRATED_BIAS = 0.05**2
CALIBRATED_PAIR_BIAS = 0.03**2
CALIBRATED_GROWTH = 0.01**2
"""Of ranges whose antenna delays were calibrated: the common bias, a pair's, the growth (m^2)."""

MOST_GO_ON = 0.98

FAULT = np.array([JUMP_M**2, JUMP_M**2, math.pi**2 / 3.0])
"""Variances of a faulty report along, across (m^2) and of its turn, which is anything (rad^2)."""


@dataclass
class VarianceComponents:
    """What the alternation estimates; ``motion`` (N, 7) by :class:`Motion`."""

    motion: Floats
    range_m2: float = 0.15**2
    outliers: float = 0.05
    outliers_go_on: float = GO_ON
    """Probability that a pair's next range is an outlier, too."""
    scale: float = FIRST_SCALE
    scale_walk: float = SCALE_WALK
    """Variance that the logarithm of a scale gathers (1/s)."""
    drift_rad2_s2: float = FIRST_DRIFT
    common_bias_m2: float = 0.3**2
    pair_bias_m2: float = FIRST_PAIR_BIAS
    growth_m2: float = GROWTH_SD_M**2
    range_inflation: float = 1.0
    """Factor of the ranges' variance because their errors last: (1 + r) / (1 - r) for a correlation
    r of a pair's consecutive errors."""
    calibrated: bool = False
    """Whether ranges are known to have next to no bias."""
    to_scale: bool = False
    """Whether steps are known to have their reported length but for noise."""

    @classmethod
    def first(
        cls, nodes: int, *, calibrated: bool = False, to_scale: bool = False
    ) -> VarianceComponents:
        """Return generic components, the same for every run."""
        result = cls(np.tile(FIRST_MOTION, (nodes, 1)), calibrated=calibrated, to_scale=to_scale)
        if calibrated:
            result.common_bias_m2, result.pair_bias_m2 = CALIBRATED_BIAS, CALIBRATED_PAIR_BIAS
            result.growth_m2 = CALIBRATED_GROWTH
        if to_scale:
            result.scale, result.scale_walk = CALIBRATED_SCALE, CALIBRATED_WALK
        return result

    def copy(self) -> VarianceComponents:
        """Return one that can be changed by itself."""
        return replace(self, motion=self.motion.copy())

    def variances(self, graph: Graph, bases: Floats) -> Floats:
        """Variances of along, across and turn, (K - 1, N, 3); reported ones where greater."""
        parts = bases * self.motion
        along = parts[..., Motion.ALONG_LENGTH] + parts[..., Motion.ALONG_TIME]
        across = parts[..., Motion.ACROSS_LENGTH] + parts[..., Motion.ACROSS_TIME]
        turn = parts[..., Motion.TURN_TURN] + parts[..., Motion.TURN_WALKING]
        turn = turn + parts[..., Motion.TURN_TIME]
        along, turn = np.maximum(along, graph.sigma_m**2), np.maximum(turn, graph.sigma_rad**2)
        return np.stack([along + graph.unseen_m2, across + graph.unseen_m2, turn], axis=-1)

    def constant_weights(self, problem: Problem) -> Floats:
        """1 / prior variances of ``Problem.independent`` of the constants, (G,)."""
        variance, at = np.empty(problem.constants), problem.places
        variance[at.drift] = self.drift_rad2_s2
        variance[at.common_bias], variance[at.growth] = self.common_bias_m2, self.growth_m2
        variance[at.pair_bias] = self.pair_bias_m2
        variance[at.first_scale], variance[at.scale_step] = self.scale, self.scale_walk
        return 1.0 / variance


UNREST = 2.0
"""Standard deviations of a stride's turn beyond which it is a turn."""


def motion_bases(problem: Problem, state: State, components: VarianceComponents) -> Floats:
    """What the motion's components are multiplied by, (K - 1, N, 7); turns as now estimated."""
    graph = problem.graph
    duration = np.broadcast_to(graph.chords.duration_s[:, None], graph.walks.shape)
    # A turn that was reported too small is not more certain for it; but one that was not reported
    # is not to be had by believing in it.
    turn = np.abs(np.diff(state.poses[..., 2], axis=0))
    reported = np.abs(graph.chords.turn_rad)
    turn = np.clip(turn, 0.5 * reported, 2.0 * reported)
    # What is no more than a stride's own unrest is no turn, or unrest that happens to be great
    # would explain itself.
    unrest = np.sqrt(components.motion[:, Motion.TURN_WALKING] * duration * graph.walks)
    turn = np.maximum(turn - UNREST * unrest, 0.0)
    square = graph.usual_length_m**2
    return np.stack(
        [square, duration, square, duration, turn**2, duration * graph.walks, duration], axis=-1
    )


def weights_of(
    problem: Problem,
    components: VarianceComponents,
    bases: Floats,
    inliers: Inliers,
    widened_m: float = 0.0,
) -> Weights:
    """1 / variance of everything; outliers count nothing, ranges are ``widened_m`` wider."""
    variance, usual = components.variances(problem.graph, bases), inliers.reports[..., None]
    return Weights(
        usual / variance + (1.0 - usual) / (variance + FAULT),
        inliers.ranges / (components.range_inflation * components.range_m2 + widened_m**2),
        components.constant_weights(problem),
    )


# -- motion: Newton steps --------------------------------------------------------------------------

SPREAD_FIRST = 1.4
SPREAD_TEAM = 1.4
"""Standard deviations of the logarithms: of the team's mean about the first value, and of its
nodes' about the mean: they carry the same device, but walk differently."""

MOST_STEP = 1.5
"""No logarithm of a component moves by more in one step."""


class Linearisation(NamedTuple):
    """The problem at one state, and how the C = 7 N motion components move its solution."""

    state: State
    weights: Weights
    covariance: Covariance
    shares: Floats
    """(K - 1, N, 7) of each component in its residual's variance."""
    information: Floats
    """(C, C) what the data say of the components' logarithms."""
    poses: Floats
    constants: Floats
    """(K, b, C) and (G, C): derivative of the solution by each logarithm."""


def linearise(
    problem: Problem, state: State, components: VarianceComponents, bases: Floats, weights: Weights
) -> Linearisation:
    """Return the covariance and the components' influence; RelposError if not observable."""
    graph, nodes = problem.graph, problem.nodes
    w = weights.motion[..., AXIS]
    parts = bases * components.motion
    shares = parts * graph.has_report[..., None] * w
    # Where a reported deviation is the greater one, no component matters.
    shares[..., AXIS == 0] *= (parts[..., AXIS == 0].sum(axis=-1) >= graph.sigma_m**2)[..., None]
    shares[..., AXIS < 2] *= (graph.unseen_m2 == 0.0)[..., None]
    shares[..., AXIS == 2] *= (parts[..., AXIS == 2].sum(axis=-1) >= graph.sigma_rad**2)[..., None]
    residual = problem.motion_residuals(state)[..., AXIS]
    count = nodes * AXIS.size
    columns = np.zeros((graph.time_s.size, 3 * nodes, count))
    corner = np.zeros((problem.constants, count))
    force = shares * residual * w
    kernels.add_component_columns(state, graph.chords, force, AXIS, columns, corner)
    equations = problem.normal_equations(state, weights)
    covariance, poses, constants = equations.covariance_and_solution(columns, corner)
    forced = shares * residual * np.sqrt(w)
    own = np.einsum("knl,knm->nlm", forced, forced) * (AXIS[:, None] == AXIS)
    information = -(columns.reshape(-1, count).T @ poses.reshape(-1, count) + corner.T @ constants)
    for n in range(nodes):
        at = slice(n * AXIS.size, (n + 1) * AXIS.size)
        information[at, at] += own[n]
    return Linearisation(state, weights, covariance, shares, 0.5 * information, poses, constants)


def _prior_precision(nodes: int) -> Floats:
    """Precision (7 N + 7) of the logarithms of all components, then of the team's means."""
    count = nodes * AXIS.size
    a, first = SPREAD_TEAM**-2, SPREAD_FIRST**-2
    result = np.zeros((count + AXIS.size, count + AXIS.size))
    result[:count, :count] = a * np.eye(count)
    cross = -a * np.tile(np.eye(AXIS.size), (nodes, 1))
    result[:count, count:], result[count:, :count] = cross, cross.T
    result[count:, count:] = (nodes * a + first) * np.eye(AXIS.size)
    return result


def _step_motion(problem: Problem, at: Linearisation, components: VarianceComponents) -> float:
    """One Newton step of the motion components' logarithms; return the greatest change."""
    w = at.weights.motion
    posterior = kernels.motion_variances(at.state, problem.graph.chords, at.covariance)
    square = w * problem.motion_residuals(at.state) ** 2
    free = np.maximum(1.0 - posterior * w, 0.0)
    slope = 0.5 * np.sum(at.shares * (square - free)[..., AXIS], axis=0)
    count = slope.size
    precision = _prior_precision(problem.nodes)
    value = np.log(components.motion)
    # The team's means are where the nodes' components have them.
    n, a, first = problem.nodes, SPREAD_TEAM**-2, SPREAD_FIRST**-2
    mean = (a * value.sum(axis=0) + first * np.log(FIRST_MOTION)) / (n * a + first)
    gradient = np.concatenate(((slope - a * (value - mean)).ravel(), np.zeros(AXIS.size)))
    precision[:count, :count] += at.information
    least = np.tile(np.log(LEAST_MOTION), n)
    stuck = (value.ravel() <= least + 1e-9) & (gradient[:count] < 0.0)
    keep = np.append(~stuck, np.ones(AXIS.size, dtype=bool))
    step = np.zeros(count + AXIS.size)
    step[keep] = np.linalg.solve(precision[np.ix_(keep, keep)], gradient[keep])
    new = np.maximum(value.ravel() + np.clip(step[:count], -MOST_STEP, MOST_STEP), least)
    important = at.shares.sum(axis=0).ravel() > 1.0
    change = float(np.max(np.abs(new - value.ravel()) * important, initial=0.0))
    components.motion = np.exp(new).reshape(value.shape)
    return change


def widened(at: Linearisation) -> Covariance:
    """Add to the covariance what the components' own uncertainty makes of the solution."""
    covariance, count = at.covariance, at.poses.shape[2]
    precision = _prior_precision(count // AXIS.size)
    precision[:count, :count] += at.information
    unknown = np.linalg.inv(precision)[:count, :count]
    root = np.linalg.cholesky(0.5 * (unknown + unknown.T))
    poses, constants = at.poses @ root, at.constants @ root
    return Covariance(
        covariance.diagonal + poses @ poses.transpose(0, 2, 1),
        covariance.below + poses[1:] @ poses[:-1].transpose(0, 2, 1),
        covariance.with_constants + poses @ constants.T,
        covariance.constants + constants @ constants.T,
        covariance.log_determinant,
    )


# -- all components --------------------------------------------------------------------------------

FIRST_RANGE = 0.12**2
COUNT_RANGES = 20.0
"""What UWB is in the open, as if so many ranges had shown it."""

COUNT_CONSTANTS = 1.0
"""As if so many constants had shown their first variance: a standing node says nothing of its
scale, and a wide prior would let it say anything."""


def update_components(
    problem: Problem, at: Linearisation, components: VarianceComponents, sorted_out: Inliers
) -> float:
    """Move every component towards the greatest marginal likelihood; return the largest change.

    The fixed point of a component c whose share in a variance v is c u:

        c <- c sum(u r^2 / v^2) / sum(u (1 - p / v) / v)

    over its residuals r with posterior variances p (for the square root of the quotient, and
    with p = v - ..., Zhou et al. 2019 show ascent; the quotient itself is Foerstner's).
    """
    change = _step_motion(problem, at, components)
    inliers = sorted_out.ranges
    if not inliers.size:
        return change
    residual_m = problem.range_residuals(at.state)
    posterior_m2 = kernels.range_variances(at.state, problem.graph.ranges, at.covariance)
    v = components.range_m2
    # A sign that is not known adds to the error what it may have turned round.
    unsigned = problem.graph.range_m**2 - problem.range_m**2
    up = float(np.sum(inliers * (residual_m**2 + unsigned))) + COUNT_RANGES * FIRST_RANGE
    down = float(np.sum(inliers * np.maximum(1.0 - posterior_m2 * inliers / v, 0.0)))
    new_v = max(float(np.clip(up / (down + COUNT_RANGES), 0.1 * v, 10.0 * v)), 0.01**2)
    change = max(change, abs(math.log(new_v / v)))
    components.range_m2 = new_v
    components.range_inflation = _range_inflation(problem, at, residual_m, posterior_m2, inliers)

    constants = problem.independent @ at.state.constants
    spread = np.diag(problem.independent @ at.covariance.constants @ problem.independent.T)

    def fixed_point(old: float, part: slice, first: float) -> float:
        up = float(np.sum(constants[part] ** 2)) + COUNT_CONSTANTS * first
        down = float(np.sum(np.maximum(1.0 - spread[part] / old, 0.0)))
        new = float(np.clip(up / (down + COUNT_CONSTANTS), 0.1 * old, 10.0 * old))
        return min(max(new, 1e-4 * first), 4.0 * first)

    first_scale = CALIBRATED_SCALE if components.to_scale else FIRST_SCALE
    first_walk = CALIBRATED_WALK if components.to_scale else SCALE_WALK
    first_bias = CALIBRATED_PAIR_BIAS if components.calibrated else FIRST_PAIR_BIAS
    places = problem.places
    components.drift_rad2_s2 = fixed_point(components.drift_rad2_s2, places.drift, FIRST_DRIFT)
    components.pair_bias_m2 = fixed_point(components.pair_bias_m2, places.pair_bias, first_bias)
    # Not wider: where ranges hardly tell of scales, these would follow the noise and widen it more
    # (mission-two-abreast, 300 s, six seeds from 2700: NEES 2.7 with up to 0.2, 1.1 so).
    scale = fixed_point(components.scale, places.first_scale, first_scale)
    components.scale = min(scale, first_scale)
    components.scale_walk = fixed_point(components.scale_walk, places.scale_step, first_walk)
    outliers = float(np.sum(1.0 - inliers))
    components.outliers = (outliers + 0.5) / (inliers.size + 50.0)
    up, down = sorted_out.followed + GO_ON * GO_ON_RANGES, outliers + GO_ON_RANGES
    components.outliers_go_on = min(up / down, MOST_GO_ON)
    return change


MOST_CORRELATION = 0.7


def _range_inflation(
    problem: Problem, at: Linearisation, residual_m: Floats, posterior_m2: Floats, inliers: Floats
) -> float:
    """Factor of the ranges' variance because consecutive errors of a pair are correlated.

    The product of two consecutive errors is on average that of the residuals plus the posterior
    covariance of the two predictions.
    """
    graph = problem.graph
    correlation = _distance_correlation(problem, at)
    together = apart = 0.0
    for k in range(len(graph.pairs)):
        own = np.flatnonzero((graph.ranges.pair_index == k) & (inliers > 0.5))
        r, p, chord = residual_m[own], np.sqrt(posterior_m2[own]), graph.ranges.chord[own]
        same = correlation[own[1:]] ** np.diff(chord)
        together += float(np.sum(r[1:] * r[:-1] + same * p[1:] * p[:-1]))
        apart += float(np.sum(r**2 + p**2))
    rho = min(max(together / apart, 0.0), MOST_CORRELATION) if apart > 0.0 else 0.0
    return (1.0 + rho) / (1.0 - rho)


def _distance_correlation(problem: Problem, at: Linearisation) -> Floats:
    """Posterior correlation of each range's distance with itself one knot earlier, (M,)."""
    ranges, nodes, poses = problem.graph.ranges, problem.nodes, at.state.poses
    chord, (i, j) = ranges.chord, ranges.pair.T
    apart = poses[chord + 1, i, :2] - poses[chord + 1, j, :2]
    unit = apart / np.maximum(np.linalg.norm(apart, axis=1), 1e-9)[:, None]

    def along(blocks: Floats, where: Indices) -> Floats:
        parts = blocks.reshape(-1, nodes, 3, nodes, 3)
        difference = parts[where, i, :2, i, :2] + parts[where, j, :2, j, :2]
        difference = difference - parts[where, i, :2, j, :2] - parts[where, j, :2, i, :2]
        result: Floats = np.einsum("ma,mab,mb->m", unit, difference, unit)
        return result

    late = along(at.covariance.diagonal, chord + 1)
    early = along(at.covariance.diagonal, chord)
    cross = along(at.covariance.below, chord)
    return np.clip(cross / np.sqrt(np.maximum(late * early, 1e-18)), 0.0, 1.0)
