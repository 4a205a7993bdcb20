"""What wearers do, from reported heights against steps: an interacting multiple model (IMM).

Every mode predicts how far the pressure's height rises over one interval, with a variance, and has
a filter of that height of its own; modes follow each other as a Markov chain (Blom and Bar-Shalom
1988). All nodes are processed together. Each node's belief is about pairs of the air, which all
share, and its mode: arrays (N, AIRS, MODES).

Probabilities are smoothed backwards over the last few seconds: a flight of stairs is certain
after three or four steps, but then since its first one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Bools, Floats
from relpos.fusion.estimator import Episode
from relpos.fusion.normal import normal_density
from relpos.fusion.vertical.air import FAN_M_S, CommonRises, common_rises, of_others
from relpos.fusion.vertical.modes import (
    AIRS,
    BEGINNINGS,
    DOWN,
    FOLLOWS,
    LIFTS,
    MODES,
    PRESSURE,
    RISERS,
    STAIRS,
    UNDER_WAY,
    UP,
    Air,
    Mode,
    transition,
)  # fmt: skip

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


class Beliefs(NamedTuple):
    """Filtered belief of N nodes about airs and modes: arrays (N, airs, MODES)."""

    probability: Floats
    mean_m: Floats
    """Of the height that barometers measure."""
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
    walked: Bools
    """Whether the node walked just before."""


class Update(NamedTuple):
    """Belief after an interval, and what smoothing needs."""

    beliefs: Beliefs
    likelihood: Floats
    """(N, airs * MODES), with what the others say of the air."""
    transition: Floats
    """(N, airs * MODES, airs * MODES)"""
    blown: CommonRises | None
    """What heights say of blown air; None for nodes of which each has an air of its own."""


def begin(height_m: Floats, variance_m2: Floats, airs: int = AIRS) -> Beliefs:
    """Return the belief of nodes that stand level at their first heights (N,), in calm air.

    With one air for each node alone there is calm air only.
    """
    probability = np.zeros((len(height_m), airs, MODES))
    probability[:, Air.CALM, Mode.LEVEL] = 1.0
    each = np.ones((1, airs, MODES))
    return Beliefs(probability, height_m[:, None, None] * each, variance_m2[:, None, None] * each)


def begin_again(beliefs: Beliefs, some: Bools, height_m: Floats, variance_m2: Floats) -> Beliefs:
    """Let some nodes (N,) stand level at their heights."""
    first = begin(height_m, variance_m2, beliefs.probability.shape[1])
    both = (np.where(some[:, None, None], a, b) for a, b in zip(first, beliefs, strict=True))
    return Beliefs(*both)


def _rise(interval: Interval, airs: int) -> tuple[Floats, Floats]:
    """Return mean (m) and variance (m^2) of every rise, less a common one, (N, airs, MODES)."""
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
    variance[:, Mode.DISTURBED] += (FAN_M_S * dt) ** 2
    variance[:, Mode.JUMP] += JUMP_M**2
    mean[:, Mode.FALLING] = -FALL_M_S * dt
    variance[:, Mode.FALLING] += (SIGMA_FALL_M_S * dt) ** 2
    each = np.ones((1, airs, 1))
    mean, variance = each * mean[:, None], each * variance[:, None]
    if airs == AIRS:
        # Who is behind a door then sees nothing.
        own_m2 = np.where(FOLLOWS > 0.0, COMMON_M_S**2, -(FAN_M_S**2))
        variance[:, Air.BLOWN] += dt[:, None] ** 2 * own_m2
    return mean, variance


def _usual(interval: Interval) -> Floats:
    """Return how usual it is to make the steps that were reported in each mode (N, MODES)."""
    rate_hz = interval.steps / interval.since_s
    walks = np.clip((rate_hz - STANDS_STEPS_S) / (WALKS_STEPS_S - STANDS_STEPS_S), 0.0, 1.0)
    usual = np.ones((len(rate_hz), MODES))
    usual[:, UNDER_WAY] *= np.exp(walks * math.log(STEPS_PENALTY))[:, None]
    usual[:, BEGINNINGS] *= np.where(interval.walked, LIFT_AFTER_WALK, 1.0)[:, None]
    return usual


def update(beliefs: Beliefs, interval: Interval) -> Update:
    """Add an interval; of nodes without news only the air is updated, by what the others say."""
    shape = nodes, airs, _ = beliefs.probability.shape
    duration_s = round(interval.duration_s, 3)
    measured = np.isfinite(interval.height_m)
    chain = np.tile(transition(duration_s, airs), (nodes, 1, 1))
    chain[~measured] = np.eye(airs * MODES)
    # Mixing: where each mode's filter begins.
    before, mean_before, variance_before = (b.reshape(nodes, airs * MODES) for b in beliefs)
    joint = before[:, :, None] * chain
    prior = joint.sum(axis=1)
    weight = joint / np.maximum(prior, 1e-300)[:, None, :]
    mean = np.einsum("nij,ni->nj", weight, mean_before)
    off = mean_before[:, :, None] - mean[:, None, :]
    variance = np.einsum("nij,nij->nj", weight, variance_before[:, :, None] + off * off)
    prior, mean, variance = prior.reshape(shape), mean.reshape(shape), variance.reshape(shape)
    news = measured[:, None, None]
    rise_m, rise_m2 = _rise(interval, airs)
    mean = np.where(news, mean + rise_m, mean)
    variance = np.where(news, variance + rise_m2, variance)
    usual = _usual(interval)[:, None]
    height_m, noise_m2 = interval.height_m[:, None, None], interval.variance_m2[:, None, None]
    off_m, total = height_m - mean, variance + noise_m2
    blown = None
    evidence = np.ones((nodes, airs))
    if airs == AIRS:
        blown = common_rises(off_m[:, Air.BLOWN], total[:, Air.BLOWN], interval.duration_s)
        own = np.where(news, usual * normal_density(np.nan_to_num(off_m), total), 1.0)
        share = prior / np.maximum(prior.sum(axis=2, keepdims=True), 1e-300)
        others = of_others((share * own).sum(axis=2), blown, share[:, Air.BLOWN] * usual[:, 0])
        evidence = others.evidence
        follows = measured[:, None] * FOLLOWS
        mean[:, Air.BLOWN] += follows * others.rise_m[:, None]
        variance[:, Air.BLOWN] += follows * others.rise_m2[:, None]
    # Every mode's filter is corrected.
    innovation, total = np.where(news, height_m - mean, 0.0), variance + noise_m2
    likelihood = np.maximum(usual * normal_density(innovation, total), 1e-200)
    likelihood = np.where(news, likelihood, 1.0) * evidence[:, :, None]
    gain = np.where(news, variance / total, 0.0)
    probability = prior * likelihood
    probability /= probability.sum(axis=(1, 2), keepdims=True)
    corrected = Beliefs(probability, mean + gain * innovation, variance * (1.0 - gain))
    return Update(corrected, likelihood.reshape(nodes, airs * MODES), chain, blown)


def smooth(updates: list[Update]) -> list[Floats]:
    """Return the probabilities (N, airs, MODES) of each interval, given all of them."""
    after = np.ones_like(updates[-1].likelihood)
    smoothed: list[Floats] = []
    for one in updates[::-1]:
        probability = one.beliefs.probability * after.reshape(one.beliefs.probability.shape)
        smoothed.append(probability / probability.sum(axis=(1, 2), keepdims=True))
        after = np.matmul(one.transition, (one.likelihood * after)[:, :, None])[..., 0]
        after /= after.max(axis=1, keepdims=True)
    return smoothed[::-1]


def episodes_of(probability: Floats) -> Floats:
    """Sum the probabilities (airs, MODES) to those of ``EPISODES`` (6,)."""
    summed: Floats = probability.sum(axis=0) @ _OF_EPISODE
    if len(probability) == AIRS:
        blown = probability[Air.BLOWN, Mode.LEVEL]
        summed[EPISODES.index(Episode.LEVEL)] -= blown
        summed[EPISODES.index(Episode.DISTURBED)] += blown
    return summed
