"""What the innovations of an instant's ranges say of the sensors.

An innovation is judged under the whole mixture before the update: it is an outlier or not, a user
surprises or not (then more hypotheses are perturbed), an odometry fault raises an alarm, and the
variance components are learned. Reference implementation: :mod:`reference.bank`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.bank import mixture
from relpos.fusion.bank import variance_components as components
from relpos.fusion.bank.range_update import INLIER, MEAN, VARIANCE, RangeModel, Ranges
from relpos.fusion.bank.storage import Hypotheses
from relpos.fusion.bank.variance_components import Draws
from relpos.fusion.compiled import compiled, inner
from relpos.fusion.models.odometry_faults import CusumDetector, update_cusum

PERTURBED_WEIGHT = 1e-3
"""Weight of perturbed hypotheses in what was expected of a range: to them any is usual."""

EVIDENCE_SHARE = 0.7
"""Of ranges and silences, this share of the log evidence weighs the hypotheses. All of it is right
where the noise is known; noise that was learned is wrong for all ranges of a user alike, and they
then agree on a wrong mode. Seeds from 51000, all and this: P .82 and .79 m, worse in 12 runs of 12,
H worst 1.89 and 1.02, ``mission-walls`` 1.08 and .98; P1 and recordings alike."""

OUTLIERS_EXPECTED = 3.0
"""The prior variance of outliers counts as so many of them."""

ODD_SHARE, ODD_SHARE_OF_OUTLIERS = 0.15, 2.2
"""A user surprises from this share of odd ranges on, or so many times the share of outliers: where
those are common, it takes more of them to perturb a user."""


class Sensors(NamedTuple):
    """What is known of the sensors, all of it learned in place from innovations."""

    mean: Floats
    """Logarithms of the variance components (L,)."""
    covariance: Floats
    """Theirs (L, L)."""
    model: RangeModel
    outlier_counts: Floats
    """(3,): outliers, others, and the sum of the outliers' squares (m^2)."""
    surprise: Floats
    """Running share of odd ranges of each user (N,)."""
    cusum: CusumDetector


def expect_outliers(counts: Floats, outlier: Floats) -> float:
    """Return the expected share of outliers; it and their variance are written to ``outlier``.

    ``counts`` are :attr:`Sensors.outlier_counts`, ``outlier`` (4,) is ``RangeModel.outlier``.
    """
    outliers, others, squares = counts.tolist()
    prior = float(outlier[3])
    share: float = min(max(outliers / (outliers + others), 0.005), 0.5)
    learned = (squares + OUTLIERS_EXPECTED * prior) / (outliers + OUTLIERS_EXPECTED)
    outlier[0], outlier[1] = share, min(max(learned, prior / 9.0), 9.0 * prior)
    return share


@inner
def _innovations(
    ranges: Ranges, stats: Floats, before: Floats, perturbed: Floats
) -> tuple[Floats, Floats]:
    """Return nu^2/S and max(nu^2 - S, 0) (m^2) of each range, of the mixture before it."""
    count, several = before.shape[0], ranges.first.shape[0]
    prior = np.empty(count)
    most, total = -np.inf, 0.0
    for k in range(count):
        most = max(most, before[k])
    for k in range(count):
        prior[k] = math.exp(before[k] - most) * (PERTURBED_WEIGHT if perturbed[k] > 0.0 else 1.0)
        total += prior[k]
    for k in range(count):
        prior[k] /= total
    square, excess = np.empty(several), np.empty(several)
    for r in range(several):
        mean, variance = stats[r, MEAN], stats[r, VARIANCE]
        middle = 0.0
        for k in range(count):
            middle += prior[k] * mean[k]
        spread = 0.0
        for k in range(count):
            off = mean[k] - middle
            spread += prior[k] * (variance[k] + off * off)
        off = ranges.range_m[r] - middle
        square[r] = off * off / spread
        excess[r] = max(off * off - spread, 0.0)
    return square, excess


@compiled
def temper(log_weight: Floats, before: Floats) -> None:
    """Scale the evidence since ``before`` (K,) in the log weights by ``EVIDENCE_SHARE``."""
    weights = log_weight.reshape(-1)
    for k in range(before.shape[0]):
        weights[k] = before[k] + EVIDENCE_SHARE * (weights[k] - before[k])


@compiled
def learn(
    hypotheses: Hypotheses, ranges: Ranges, sensors: Sensors, draws: Draws, perturbed: Floats,
    stats: Floats, before: Floats, wary: bool,
) -> tuple[tuple[Floats, Floats], int, int]:  # fmt: skip
    """Learn from the innovations of an instant's ranges (R,) what they say of the sensors.

    ``stats`` (R, STATS, >= K) are of the update, ``before`` (K,) the log weights before it. Then
    the evidence is tempered, and the variance components are drawn again. ``perturbed`` (K,)
    counts down the updates for which a hypothesis teaches nothing; ``wary`` lowers the threshold
    of the fault detector. Returns each range's inlier probability and its excess if it is none
    (R,), the row with an odometry fault or -1, and how many variance components were clamped.
    """
    log_weight = hypotheses.log_weight
    count, several = before.shape[0], ranges.first.shape[0]
    first, second = ranges.first, ranges.second
    square, excess = _innovations(ranges, stats, before, perturbed)
    share = sensors.model.outlier[0]
    fault = update_cusum(sensors.cusum, first, second, square, ranges.sample_count, share, wary)
    weight = np.empty_like(log_weight)
    mixture.normalise(log_weight, count, weight)
    weights = weight.reshape(-1)
    inlier, off_m = np.empty(several), np.empty(several)
    for r in range(several):
        each, expected_m = stats[r, INLIER], stats[r, MEAN]
        inlier[r], off_m[r], outlying = 0.0, 0.0, 1e-300
        for k in range(count):
            inlier[r] += weights[k] * each[k]
            outlying += weights[k] * (1.0 - each[k])
            off_m[r] += weights[k] * (1.0 - each[k]) * (ranges.range_m[r] - expected_m[k])
        off_m[r] /= outlying
    counts = np.empty(count)
    for k in range(count):
        counts[k] = 1.0 if perturbed[k] <= 0.0 else 0.0
        perturbed[k] -= 1.0
    clamped = components.learn(sensors.mean, sensors.covariance, ranges, stats, before, counts)
    fade = 0.998**several
    outliers, surprise = sensors.outlier_counts, sensors.surprise
    outliers[0] *= fade
    outliers[1] *= fade
    for r in range(several):
        outliers[0] += 1.0 - inlier[r]
        outliers[1] += inlier[r]
        outliers[2] += (1.0 - inlier[r]) * excess[r]
        for row in (first[r], second[r]):
            surprise[row] += 0.2 * (1.0 - inlier[r] - surprise[row])
    temper(log_weight, before)
    components.spread(draws, sensors.mean, sensors.covariance, hypotheses)
    return (inlier, off_m), fault, clamped
