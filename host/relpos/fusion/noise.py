"""What is not told: how noisy each wearer's dead reckoning and the ranges are.

Noise has to be generic and is learned on line. A wearer's variances are three bases times three
levels: along the way (m^2 per metre), of turns (rad^2 per radian turned) and white in heading
(rad^2 per second of moving). Every hypothesis carries its own levels, drawn from a broad prior,
and its own range sigma; the evidence of the ranges selects them (see ``bank.py``). A sort of
heading noise may be absent altogether, so the prior has a spike there, shared by the team.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

ALONG_M2_M = 0.004
"""7 % of half a metre at each half metre; people and sensors spread over 3 to 25 %."""

TURN_RAD2_RAD = 0.04
"""15 degrees at a right angle."""

WHITE_RAD2_S = math.radians(3.0) ** 2
"""3 degrees in a second's walking."""

LEVELS = 3
ALONG, TURN, WHITE = range(LEVELS)

TEAM_SD = np.array([0.6, 0.8, 0.8])
OWN_SD = np.array([1.0, 0.8, 0.8])
"""Standard deviations of log variance: common to the team, and each wearer's own."""

ABSENT = np.array([0.0, 0.3, 0.5])
"""Probability that the team has none of a sort of noise."""

ABSENT_LOG = -6.0
"""What "none" means: a twentieth of the standard deviation."""

RANGE_SIGMA_M = (0.05, 1.5)
"""The range sigma's prior is log-uniform between these."""


def draw_team(count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Give log levels (count, 3) common to the team and log range variances (count,)."""
    levels = rng.standard_normal((count, LEVELS)) * TEAM_SD
    levels[rng.random((count, LEVELS)) < ABSENT] = ABSENT_LOG
    low, high = (2.0 * math.log(s) for s in RANGE_SIGMA_M)
    place = (rng.permutation(count) + rng.random(count)) / count
    return levels, low + (high - low) * place


def draw_node(team: Floats, rng: np.random.Generator) -> Floats:
    """Give one more node's log levels (K, 3), from its team's (K, 3)."""
    own = team + rng.standard_normal(team.shape) * OWN_SD
    return np.where(team <= ABSENT_LOG, team, own)


def motion_variances(
    dx: Floats, dy: Floats, dtheta: Floats, duration: Floats, sigmas: Floats
) -> Floats:
    """Give the bases (M, 3) of displacements (M,): along (m^2), turn and white (rad^2).

    ``sigmas`` (M, 3) are the report's own (forward, left, turn), NaN where it brings none; they
    take the bases' place.
    """
    way = np.hypot(dx, dy)
    moving = (way > 0.0) | (dtheta != 0.0)
    base = np.empty((len(way), LEVELS))
    base[:, ALONG] = ALONG_M2_M * way
    base[:, TURN] = TURN_RAD2_RAD * np.abs(dtheta)
    base[:, WHITE] = WHITE_RAD2_S * duration * moving
    told = ~np.isnan(sigmas)
    if told.any():
        own = np.where(told, sigmas, 0.0) ** 2
        base[:, ALONG] = np.where(told[:, 0], np.maximum(own[:, 0], own[:, 1]), base[:, ALONG])
        base[:, TURN] = np.where(told[:, 2], 0.0, base[:, TURN])
        base[:, WHITE] = np.where(told[:, 2], own[:, 2], base[:, WHITE])
    return base
