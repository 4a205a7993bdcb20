"""Which ranges are outliers, and which reports odometry faults: two-state Markov chains.

One chain a pair of nodes: where a wall stands in between, outliers follow each other, and would be
taken for a noise that all ranges have. One chain a node: dead reckoning that fails does so for some
reports, and would be taken for ranges without sight.
"""

from __future__ import annotations

import math

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.models.ranging import AGAIN_M, ALIKE, OUTLIERS_SHORT
from relpos.fusion.normal import normal_density
from relpos.fusion.smoother import kernels
from relpos.fusion.smoother.kernels import State
from relpos.fusion.smoother.problem import Inliers, Problem
from relpos.fusion.smoother.variance_components import FAULT, VarianceComponents

SPAN_M = 10.0
"""An outlier may be anywhere within this."""

FAULTS, FAULT_LASTS = 3e-3, 0.2
"""Share of the reports that are faults, and how probably one is followed by another. With 0.001
the evidence of ``two_robots_vio/exp1_los`` has a metre's fault for ranges without sight."""


def inlier_probabilities(
    problem: Problem,
    state: State,
    components: VarianceComponents,
    bases: Floats,
    widened_m: float = 0.0,
) -> Inliers:
    """Tell inliers from outliers and faults, ranges being ``widened_m`` wider."""
    ranges, followed, of_ranges = _ranges(problem, state, components, widened_m)
    reports, of_reports = _reports(problem, state, components.variances(problem.graph, bases))
    return Inliers(ranges, reports, followed, of_ranges + of_reports)


def _ranges(
    problem: Problem, state: State, components: VarianceComponents, widened_m: float
) -> tuple[Floats, float, float]:
    """Return the ranges' (M,), how many outliers follow another, and the log likelihood."""
    pair = problem.graph.ranges.pair_index
    order = np.argsort(pair, kind="stable")
    variance = components.range_m2 + widened_m**2
    measured = problem.graph.range_m[order]
    predicted = (problem.range_residuals(state) + problem.range_m)[order]
    excess_m = measured - predicted
    density = np.empty((pair.size, 3))
    density[:, 0] = normal_density(excess_m, variance) + normal_density(
        predicted + measured, variance
    )
    density[:, 1:] = 1.0 / max(SPAN_M, 10.0 * math.sqrt(variance))
    share = go_on = components.outliers
    # Between two nodes alone nothing tells ranges without sight from an odometry that is wrong.
    if len(problem.graph.pairs) > 1:
        go_on = max(components.outliers_go_on, share)
        side = np.where(excess_m > 0.0, 1.0 - OUTLIERS_SHORT, OUTLIERS_SHORT)
        density[:, 1:] *= 2.0 * side[:, None]
        # As far off as the last one: what stands in between makes ranges too long, never too short.
        alike = normal_density(np.diff(excess_m), AGAIN_M**2 + 2.0 * variance)
        density[1:, 2] += np.where(excess_m[:-1] > 0.0, ALIKE, 0.0) * (alike - density[1:, 1])
    probability, inlier = np.empty(pair.size), np.empty(pair.size)
    followed, log_likelihood = kernels.two_states(density, pair[order], share, go_on, inlier)
    probability[order] = inlier
    return probability, followed, log_likelihood


def _reports(problem: Problem, state: State, variance: Floats) -> tuple[Floats, float]:
    """Return the reports' (K - 1, N) and their log likelihood, up to a constant."""
    square = problem.motion_residuals(state) ** 2
    usual, fault = (
        -0.5 * np.sum(square / v + np.log(v), axis=-1).T.ravel()
        for v in (variance, variance + FAULT)
    )
    best = np.maximum(usual, fault)
    likelihood = np.exp(np.stack([usual - best, fault - best, fault - best], axis=-1))
    node = np.repeat(np.arange(problem.nodes), square.shape[0])
    inlier = np.empty(best.size)
    _, log_likelihood = kernels.two_states(likelihood, node, FAULTS, FAULT_LASTS, inlier)
    return inlier.reshape(problem.nodes, -1).T, log_likelihood + float(best.sum())
