"""What a wearer does, from reported height against steps: an interacting multiple model (IMM).

Every mode predicts how far the pressure's height rises over one interval, with a variance, and has
a filter of that height of its own; modes follow each other as a Markov chain (Blom and Bar-Shalom
1988). All nodes are processed together: arrays (N, MODES).

Mode probabilities are smoothed backwards over the last few seconds: a flight of stairs is certain
after three or four steps, but then since its first one.
"""

from __future__ import annotations

import math
from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from relpos.fusion.estimator import Episode

Floats = npt.NDArray[np.float64]


class Mode(IntEnum):
    """Modes of the chain; a lift's first seconds are modes of their own, so that a ride lasts."""

    LEVEL = 0
    UP = 1
    DOWN = 2
    LIFT_UP_BEGINS = 3
    LIFT_UP = 4
    LIFT_DOWN_BEGINS = 5
    LIFT_DOWN = 6
    DISTURBED = 7
    JUMP = 8
    FALLING = 9
    UP_TWO = 10
    """Two steps at a time."""
    DOWN_TWO = 11
    COMMON = 12
    """The pressure changes for all: as those see it who stand."""
    UP_COMMON = 13
    """It does while the wearer climbs."""
    DOWN_COMMON = 14


MODES = len(Mode)
CLIMBS_COMMON = (Mode.UP_COMMON, Mode.DOWN_COMMON)
UP = (Mode.UP, Mode.UP_TWO, Mode.UP_COMMON)
DOWN = (Mode.DOWN, Mode.DOWN_TWO, Mode.DOWN_COMMON)
STAIRS = (*UP, *DOWN)
RISERS = (1.0, 2.0, 1.0, -1.0, -2.0, -1.0)
"""That a step goes up in each of them."""
LIFTS = (Mode.LIFT_UP_BEGINS, Mode.LIFT_UP, Mode.LIFT_DOWN_BEGINS, Mode.LIFT_DOWN)
BEGINNINGS = (Mode.LIFT_UP_BEGINS, Mode.LIFT_DOWN_BEGINS)
UNDER_WAY = (*LIFTS, Mode.FALLING)
"""The wearer rises or falls without a step."""
PRESSURE = (Mode.DISTURBED, Mode.JUMP, Mode.COMMON)
"""The pressure changes, the wearer's height does not."""
COMMON = (Mode.COMMON, *CLIMBS_COMMON)
LASTING = (Mode.DISTURBED, Mode.COMMON)
"""Of these, those that last."""

_EPISODES: dict[Episode, tuple[Mode, ...]] = {
    Episode.LEVEL: (Mode.LEVEL,),
    Episode.UP: UP,
    Episode.DOWN: DOWN,
    Episode.LIFT: LIFTS,
    Episode.DISTURBED: PRESSURE,
    Episode.FALLING: (Mode.FALLING,),
}
EPISODES = tuple(_EPISODES)
_OF_EPISODE = np.array([[mode in modes for modes in _EPISODES.values()] for mode in Mode], float)

RISER_M, SIGMA_RISER_M = 0.17, 0.05
"""Rise of a step on stairs: risers of 0.10 to 0.20 m, or twice that."""

STANDS_STEPS_S, WALKS_STEPS_S = 0.6, 1.2
"""Who makes fewer steps a second stands or has just stopped, who makes more walks: a lift is
ridden, a fall is fallen without."""
STEPS_PENALTY = 1e-3
"""Likelihood of walking in a lift or while falling, relative to standing."""

LIFT_M_S, SIGMA_LIFT_M_S = 1.0, 0.4
FAN_M_S = 0.25
"""Pressure of a fan, in metres a second: 25 Pa within 10 s are 0.21."""
JUMP_M = 1.0
"""Pressure of a door (10 Pa are 0.8 m), within one interval."""
FALL_M_S, SIGMA_FALL_M_S = 0.9, 0.35

COMMON_M_S = 0.05
"""By how much the pressure of all differs from one to the other."""

LEVEL_M = 0.03
"""What the pressure's height moves without reason, m/sqrt(s)."""

SIGMA_HEIGHT_M = 0.08
"""Of a reported height that brings no deviation: the node's filter leaves 0.06 m of 2 Pa."""

LIFT_AFTER_WALK = 0.05
"""Likelihood of a lift that starts as soon as somebody stops, relative to a later start."""

_RATES_HZ: dict[tuple[Mode, Mode], float] = {
    (Mode.LEVEL, Mode.UP): 1 / 90,
    (Mode.LEVEL, Mode.DOWN): 1 / 90,
    (Mode.LEVEL, Mode.LIFT_UP_BEGINS): 1 / 400,
    (Mode.LEVEL, Mode.LIFT_DOWN_BEGINS): 1 / 400,
    (Mode.LEVEL, Mode.DISTURBED): 1 / 400,
    (Mode.LEVEL, Mode.JUMP): 1 / 400,
    (Mode.LEVEL, Mode.FALLING): 1 / 5000,
    (Mode.LEVEL, Mode.COMMON): 1 / 400,
    (Mode.LEVEL, Mode.UP_TWO): 1 / 900,
    (Mode.LEVEL, Mode.DOWN_TWO): 1 / 900,
    (Mode.UP, Mode.LEVEL): 1 / 7,
    (Mode.UP, Mode.DOWN): 1 / 60,
    (Mode.UP, Mode.DISTURBED): 1 / 400,
    (Mode.UP, Mode.JUMP): 1 / 400,
    (Mode.UP, Mode.FALLING): 1 / 1000,
    (Mode.UP, Mode.UP_TWO): 1 / 100,
    (Mode.UP, Mode.COMMON): 1 / 400,
    (Mode.UP_TWO, Mode.LEVEL): 1 / 7,
    (Mode.UP_TWO, Mode.UP): 1 / 20,
    (Mode.DOWN_TWO, Mode.LEVEL): 1 / 7,
    (Mode.DOWN_TWO, Mode.DOWN): 1 / 20,
    (Mode.DOWN_TWO, Mode.FALLING): 1 / 500,
    (Mode.COMMON, Mode.UP_COMMON): 1 / 90,
    (Mode.COMMON, Mode.DOWN_COMMON): 1 / 90,
    (Mode.UP, Mode.UP_COMMON): 1 / 400,
    (Mode.DOWN, Mode.DOWN_COMMON): 1 / 400,
    (Mode.UP_COMMON, Mode.UP): 1 / 6,
    (Mode.DOWN_COMMON, Mode.DOWN): 1 / 6,
    (Mode.UP_COMMON, Mode.COMMON): 1 / 7,
    (Mode.DOWN_COMMON, Mode.COMMON): 1 / 7,
    (Mode.COMMON, Mode.LEVEL): 1 / 6,
    (Mode.COMMON, Mode.UP): 1 / 100,
    (Mode.COMMON, Mode.DOWN): 1 / 100,
    (Mode.DOWN, Mode.LEVEL): 1 / 7,
    (Mode.DOWN, Mode.UP): 1 / 60,
    (Mode.DOWN, Mode.DISTURBED): 1 / 400,
    (Mode.DOWN, Mode.JUMP): 1 / 400,
    (Mode.DOWN, Mode.FALLING): 1 / 500,
    (Mode.DOWN, Mode.DOWN_TWO): 1 / 100,
    (Mode.DOWN, Mode.COMMON): 1 / 400,
    (Mode.LIFT_UP_BEGINS, Mode.LIFT_UP): 1.0,
    (Mode.LIFT_UP, Mode.LEVEL): 1 / 6,
    (Mode.LIFT_DOWN_BEGINS, Mode.LIFT_DOWN): 1.0,
    (Mode.LIFT_DOWN, Mode.LEVEL): 1 / 6,
    (Mode.DISTURBED, Mode.LEVEL): 1 / 6,
    (Mode.DISTURBED, Mode.UP): 1 / 100,
    (Mode.DISTURBED, Mode.DOWN): 1 / 100,
    (Mode.JUMP, Mode.LEVEL): 2.0,
    (Mode.JUMP, Mode.DISTURBED): 0.2,
    (Mode.FALLING, Mode.LEVEL): 1 / 1.5,
}
"""How often a mode turns into another (assumed: flights of 5 to 10 s, a landing of 1 to 3 s)."""

WITNESSED = 40.0
"""So many times likelier is a common change of pressure while somebody who stands sees one."""


@lru_cache(maxsize=64)
def _transition(duration_s: float, witnessed: bool) -> Floats:
    """Return the probabilities (MODES, MODES) from row to column over an interval."""
    rates = np.zeros((MODES, MODES))
    for (before, after), rate_hz in _RATES_HZ.items():
        begins = after in COMMON and before not in COMMON
        rates[before, after] = rate_hz * (WITNESSED if witnessed and begins else 1.0)
    leaves = rates.sum(axis=1)
    share = np.where(leaves > 0.0, (1.0 - np.exp(-leaves * duration_s)) / leaves, 0.0)
    matrix: Floats = rates * share[:, None]
    np.fill_diagonal(matrix, 1.0 - matrix.sum(axis=1))
    return matrix


class Beliefs(NamedTuple):
    """Filtered belief of N nodes: probability, mean (m) and variance of every mode's height."""

    probability: Floats
    mean_m: Floats
    variance_m2: Floats


class Interval(NamedTuple):
    """What N nodes reported over ``duration_s``."""

    duration_s: float
    since_s: Floats
    """Time since the node's height before."""
    steps: Floats
    """In that time."""
    height_m: Floats
    """The newest; NaN without news."""
    variance_m2: Floats
    """Of its noise."""
    witnessed: npt.NDArray[np.bool_]
    """Whether somebody else who stands sees disturbed pressure."""
    common_m: Floats
    """By how much the height of the others who stand rose; NaN where nobody else stands."""
    walked: npt.NDArray[np.bool_]
    """Whether the node walked just before."""


class Update(NamedTuple):
    """Belief after an interval, and what smoothing needs: likelihoods (N, MODES), transitions."""

    beliefs: Beliefs
    likelihood: Floats
    transition: Floats
    """(N, MODES, MODES)"""


def begin(height_m: Floats, variance_m2: Floats) -> Beliefs:
    """Return the belief of nodes that stand level at their first heights (N,)."""
    probability = np.tile(np.where(np.arange(MODES) == Mode.LEVEL, 1.0, 0.0), (len(height_m), 1))
    each = np.ones((1, MODES))
    return Beliefs(probability, height_m[:, None] * each, variance_m2[:, None] * each)


def begin_again(
    beliefs: Beliefs, some: npt.NDArray[np.bool_], height_m: Floats, variance_m2: Floats
) -> Beliefs:
    """Let some nodes (N,) stand level at their heights."""
    first = begin(height_m, variance_m2)
    both = (np.where(some[:, None], new, old) for new, old in zip(first, beliefs, strict=True))
    return Beliefs(*both)


def _rise(interval: Interval) -> tuple[Floats, Floats]:
    """Return mean (m) and variance (m^2) of every mode's rise, (N, MODES)."""
    steps, dt = interval.steps, interval.since_s
    mean = np.zeros((len(steps), MODES))
    variance = np.repeat(LEVEL_M**2 * dt[:, None], MODES, axis=1)
    for mode, risers in zip(STAIRS, RISERS, strict=True):
        mean[:, mode] = risers * RISER_M * steps
        variance[:, mode] += (SIGMA_RISER_M * risers) ** 2 * (steps**2 + 1.0)
    for mode in LIFTS:
        up = mode in (Mode.LIFT_UP_BEGINS, Mode.LIFT_UP)
        mean[:, mode] = (LIFT_M_S if up else -LIFT_M_S) * dt
        variance[:, mode] += (SIGMA_LIFT_M_S * dt) ** 2
    unknown = np.isnan(interval.common_m)
    for mode in (Mode.COMMON, *CLIMBS_COMMON):
        mean[:, mode] += np.where(unknown, 0.0, interval.common_m)
        variance[:, mode] += (np.where(unknown, FAN_M_S, COMMON_M_S) * dt) ** 2
    variance[:, Mode.DISTURBED] += (FAN_M_S * dt) ** 2
    variance[:, Mode.JUMP] += JUMP_M**2
    mean[:, Mode.FALLING] = -FALL_M_S * dt
    variance[:, Mode.FALLING] += (SIGMA_FALL_M_S * dt) ** 2
    return mean, variance


def update(beliefs: Beliefs, interval: Interval) -> Update:
    """Add an interval; beliefs about nodes without news stay."""
    dt = round(interval.duration_s, 3)
    # A change that nobody can measure is no common one: each may be behind a door.
    witnessed = interval.witnessed & np.isfinite(interval.common_m)
    transition = np.where(witnessed[:, None, None], _transition(dt, True), _transition(dt, False))
    measured = np.isfinite(interval.height_m)[:, None]
    transition[~measured[:, 0]] = np.eye(MODES)
    # Mixing: where each mode's filter begins.
    joint = beliefs.probability[:, :, None] * transition
    prior = joint.sum(axis=1)
    weight = joint / np.maximum(prior, 1e-300)[:, None, :]
    mean = np.einsum("nij,ni->nj", weight, beliefs.mean_m)
    off = beliefs.mean_m[:, :, None] - mean[:, None, :]
    variance = np.einsum("nij,nij->nj", weight, beliefs.variance_m2[:, :, None] + off * off)
    rise, grown = _rise(interval)
    mean, variance = (
        np.where(measured, mean + rise, mean),
        np.where(measured, variance + grown, variance),
    )
    # Every mode's filter is corrected.
    innovation = np.where(measured, interval.height_m[:, None] - mean, 0.0)
    total = variance + interval.variance_m2[:, None]
    square = innovation * innovation / total
    rate_hz = interval.steps / interval.since_s
    walks = np.clip((rate_hz - STANDS_STEPS_S) / (WALKS_STEPS_S - STANDS_STEPS_S), 0.0, 1.0)
    likelihood = np.exp(-0.5 * square) / np.sqrt(total)
    likelihood[:, UNDER_WAY] *= np.exp(walks * math.log(STEPS_PENALTY))[:, None]
    likelihood[:, BEGINNINGS] *= np.where(interval.walked, LIFT_AFTER_WALK, 1.0)[:, None]
    likelihood = np.where(measured, np.maximum(likelihood, 1e-200), 1.0)
    gain = np.where(measured, variance / total, 0.0)
    probability = prior * likelihood
    probability /= probability.sum(axis=1, keepdims=True)
    corrected = Beliefs(probability, mean + gain * innovation, variance * (1.0 - gain))
    return Update(corrected, likelihood, transition)


def smooth(updates: list[Update]) -> list[Floats]:
    """Return the modes' probabilities (N, MODES) of each interval, given all of them."""
    after = np.ones_like(updates[-1].likelihood)
    smoothed: list[Floats] = []
    for k in range(len(updates) - 1, -1, -1):
        probability = updates[k].beliefs.probability * after
        smoothed.append(probability / probability.sum(axis=1, keepdims=True))
        after = np.matmul(updates[k].transition, (updates[k].likelihood * after)[:, :, None])[
            ..., 0
        ]
        after /= after.max(axis=1, keepdims=True)
    return smoothed[::-1]


def episodes_of(probability: Floats) -> Floats:
    """Sum the modes' probabilities (N, MODES) to those of ``EPISODES`` (N, 6)."""
    summed: Floats = probability @ _OF_EPISODE
    return summed
