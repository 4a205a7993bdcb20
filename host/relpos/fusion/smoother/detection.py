"""Detection as factors: what received and missed attempts to range say of distances.

The curve P(received | distance) is learned from the track itself
(:mod:`relpos.fusion.models.detection`); each attempt's outcome becomes a Gaussian of its distance
by expectation propagation (Minka 2001).
"""

from __future__ import annotations

import math

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.models.detection import GRID_M, STEP_M, Detection
from relpos.fusion.smoother.kernels import State
from relpos.fusion.smoother.problem import DetectionFactors, Problem

BLUR_M = 0.5
"""No edge is taken for sharper than the step of the tabulated curve."""
_BLUR = np.exp(-0.5 * (np.arange(-3, 4) * STEP_M / BLUR_M) ** 2)
_BLUR /= _BLUR.sum()

ATTEMPT_SHARE = 0.2
"""How much an attempt counts beside its own correlation in time: the curve itself is off by some
percent, and for all attempts alike. ``paper-h``, seeds 202 to 208: 0.5 gave 1.006 x the bound with
NEES 1.30, 0.2 1.016 with 1.22; no detection factors 1.10."""


def _learn(problem: Problem, distance_m: Floats, sigma_m: Floats) -> tuple[Detection, Floats]:
    """Learn the curve from all rounds, and how surely each attempt was made, (Q,)."""
    attempts = problem.graph.attempts
    detection = Detection()
    weight = np.zeros(distance_m.size)
    for k, done in enumerate(attempts.rounds):
        first, last = attempts.first[k], attempts.first[k + 1]
        middle = first + len(done.received)
        weight[first:middle] = done.observable
        weight[middle:last] = detection.update(done, distance_m[first:last], sigma_m[first:last])
    return detection, weight


def learn_curve(problem: Problem, distance_m: Floats, sigma_m: Floats) -> tuple[Floats, Floats]:
    """Learn from all attempts, whose distances (Q,) are known to ``sigma_m``.

    Returns P(received | distance) as ``Detection`` tabulates it, and each attempt's weight (Q,).
    """
    detection, weight = _learn(problem, distance_m, sigma_m)
    curve = np.convolve(np.pad(detection.curve, 3, mode="edge"), _BLUR, mode="valid")
    return curve, ATTEMPT_SHARE * detection.weight * weight


STEP = 0.1
"""Share of a change that an attempt's Gaussian takes at once. Hundreds of attempts of a pair tell
of nearly one distance and answer together: with 0.3 they overshot and diverged; 0.05 and 0.15 end
at the same (``paper-h``, seeds 202 to 211)."""

_POINTS = np.linspace(-5.0, 5.0, 41)
_POINT_SHARES = np.exp(-0.5 * _POINTS**2)
# Of unit variance to the last digit: else thousands of attempts that say nothing would add up.
_POINTS /= math.sqrt(float(_POINT_SHARES @ _POINTS**2 / _POINT_SHARES.sum()))


def update_factors(
    problem: Problem, distance_m: Floats, variance_m2: Floats, curve: Floats, weight: Floats
) -> float:
    """Update every attempt's Gaussian; return the greatest change of its pull, in deviations.

    Expectation propagation: with the distance's posterior N(m, v), ``distance_m`` and
    ``variance_m2`` (Q,), freed of what this outcome has said before, its product with
    P(outcome | distance) is matched in mean and variance.
    """
    missed = problem.graph.attempts.missed
    distance, variance, sigma = distance_m, variance_m2, np.sqrt(variance_m2)
    old_m, old = problem.detection
    precision = np.maximum(1.0 / variance - old, 0.1 / variance)
    mean = (distance / variance - old * old_m) / precision
    deviation = 1.0 / np.sqrt(precision)
    place = np.maximum(mean[:, None] + deviation[:, None] * _POINTS, 0.0)
    chance = np.interp(place, GRID_M, curve)
    outcome = np.where(missed[:, None], np.log1p(-chance), np.log(chance))
    mass = _POINT_SHARES * np.exp(weight[:, None] * outcome)
    mass /= mass.sum(axis=1, keepdims=True)
    z = mass @ _POINTS
    spread = np.maximum(mass @ _POINTS**2 - z**2, 1e-3)
    new = np.clip(1.0 / spread - 1.0, 0.0, 20.0) * precision
    pull = (z / spread) / deviation + mean * new
    telling = (new * variance > 1e-3) | (np.abs(pull - new * distance) * sigma > 1e-2)
    new = np.where(telling, old + STEP * (np.maximum(new, 1e-6) - old), 0.0)
    pull = np.where(telling, old * old_m + STEP * (pull - old * old_m), 0.0)
    moved = np.abs(pull - new * distance - old * (old_m - distance)) * sigma
    mean_m = np.where(telling, pull / np.where(telling, new, 1.0), 0.0)
    problem.detection = DetectionFactors(mean_m, new)
    return float(moved.max())


EVIDENCE_SIGMA_M = 0.5
"""How well a distance is known when solutions are compared."""


def negative_log_probability(problem: Problem, state: State) -> float:
    """Minus the log probability of all outcomes, the curve learned from these very distances.

    It shows wrong modes, in which nodes stand near each other and do not receive each other.
    """
    distance = problem.attempt_distances(state)
    detection, weight = _learn(problem, distance, np.full(distance.size, EVIDENCE_SIGMA_M))
    chance = detection.probability(distance, EVIDENCE_SIGMA_M)
    outcome = np.where(problem.graph.attempts.missed, np.log1p(-chance), np.log(chance))
    return -float(detection.weight * np.sum(weight * outcome))
