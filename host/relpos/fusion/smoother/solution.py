"""The most probable track of a whole run: what alternates until nothing changes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.smoother import detection, kernels
from relpos.fusion.smoother.block_solver import Covariance
from relpos.fusion.smoother.inliers import inlier_probabilities
from relpos.fusion.smoother.kernels import State
from relpos.fusion.smoother.problem import Inliers, Problem
from relpos.fusion.smoother.variance_components import (
    Linearisation,
    VarianceComponents,
    linearise,
    motion_bases,
    update_components,
    weights_of,
    widened,
)


@dataclass
class Solution:
    """A smoothed run: the state, its covariance, the variance components and the evidence."""

    state: State
    covariance: Covariance
    components: VarianceComponents
    cost: float
    """Minus the logarithm of the marginal likelihood (Laplace), up to the run's own constant."""
    inliers: Inliers


PASSES = 21
"""At most so many alternations."""

WIDENED_M = (1.0, 0.5, 0.2)
"""In the first passes ranges are taken to be so much wider, so that a wrong beginning can slide
over what would hold it fast."""

DETECTION_FROM = 6
"""The pass from which on attempts count: tracks that are still wrong by metres would teach a wrong
edge."""

CURVE_EVERY = 4
"""Passes from one learning of the curve to the next: it hardly changes, and takes longest."""

SETTLED_COMPONENTS, SETTLED_DETECTION = 0.02, 0.1
"""The alternation ends when no component changes by a greater share, and no attempt's pull by more
deviations."""


def beginnings(problem: Problem, state: State) -> Iterator[Inliers | None]:
    """Give what may be believed of a first state: its outliers and odometry faults, or nothing.

    A fault is hardly found where it is not believed; but corrections of the online estimator look
    like faults, and what it takes for outliers may be its own error.
    """
    components = VarianceComponents.first(problem.nodes)
    bases = motion_bases(problem, state, components)
    yield inlier_probabilities(problem, state, components, bases)
    yield None


PARTED, MOST_PARTED = 1.1, 2.0
"""From so many reports in a chord on its noise is corrected, and by at most so much."""


def smooth(
    problem: Problem,
    state: State,
    components: VarianceComponents | None = None,
    inliers: Inliers | None = None,
) -> Solution:
    """Alternate between the best track at given variances and the variances at a given track.

    Where ``inliers`` are given the state is believed from the first pass on. RelposError where the
    trajectory is not observable.
    """
    components = (components or VarianceComponents.first(problem.nodes)).copy()
    problem.detection = problem.no_detection()
    bases = motion_bases(problem, state, components)
    widened_m: Sequence[float] = () if inliers else WIDENED_M
    inliers = inliers or Inliers.all_of(problem.graph)
    for k in range(PASSES):
        wider_m = widened_m[k] if k < len(widened_m) else 0.0
        problem.resolve_signs(state, components.range_m2)
        weights = weights_of(problem, components, bases, inliers, wider_m)
        state = problem.optimise(state, weights, steps=12, tolerance=1e-4)
        bases = motion_bases(problem, state, components)
        if k >= 1:
            inliers = inlier_probabilities(problem, state, components, bases, wider_m)
        if k < len(WIDENED_M) - 1:
            continue
        weights = weights_of(problem, components, bases, inliers, wider_m)
        at = linearise(problem, state, components, bases, weights)
        change = update_components(problem, at, components, inliers)
        if k < DETECTION_FROM:
            continue
        pulled = 0.0
        if problem.graph.attempts.missed.any():
            distance = problem.attempt_distances(state)
            attempts = problem.graph.attempts.ranges
            variance = np.maximum(kernels.range_variances(state, attempts, at.covariance), 1e-6)
            if (k - DETECTION_FROM) % CURVE_EVERY == 0:
                curve, weight = detection.learn_curve(problem, distance, np.sqrt(variance))
            pulled = detection.update_factors(problem, distance, variance, curve, weight)
        if change < SETTLED_COMPONENTS and pulled < SETTLED_DETECTION:
            break
    weights = weights_of(problem, components, bases, inliers)
    state = problem.optimise(state, weights, steps=20, tolerance=1e-7)
    at = linearise(problem, state, components, bases, weights)
    cost = negative_evidence(problem, at, components, bases)
    parted = np.minimum(problem.graph.reports, MOST_PARTED)[..., None]
    if parted.max() > PARTED:
        # Over several chords the noise grows as that of whole reports.
        weights = weights._replace(motion=weights.motion / parted)
        state = problem.optimise(state, weights, steps=20, tolerance=1e-7)
        at = linearise(problem, state, components, bases, weights)
    return Solution(state, widened(at), components, cost, inliers)


def negative_evidence(
    problem: Problem, at: Linearisation, components: VarianceComponents, bases: Floats
) -> float:
    """Minus the log marginal likelihood by Laplace's method, up to the run's own constant."""
    state = at.state
    total = -inlier_probabilities(problem, state, components, bases).log_likelihood
    prior = components.constant_weights(problem)
    constants = problem.independent @ state.constants
    total += 0.5 * np.sum(prior * constants**2 - np.log(prior))
    # A chord's noise is so wide in reported metres; as a density of where it ends, in true ones,
    # it is exp(2 c) times as wide. Without this every longer team would be likelier.
    scales = problem.graph.chords.scale_at[:, None] + np.arange(problem.nodes)
    total += 2.0 * float(np.sum(state.constants[scales]))
    total += detection.negative_log_probability(problem, state)
    weight = problem.graph.prior_weight
    total += 0.5 * np.sum(weight * problem.prior_residuals(state) ** 2)
    return float(total + 0.5 * at.covariance.log_determinant)
