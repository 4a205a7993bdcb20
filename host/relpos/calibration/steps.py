"""The wearer's step: leg length from stature, step gain from walks or from a learned scale.

A step's length is gain x (l^2 h)^(1/3) with leg length l and the torso's rise h
(docs/deadreckoning.md): proportional to the gain, so a walk of known length gives the gain by
division. Its weight follows from prior knowledge: people differ by 7 %, one walk repeats to 5 %,
and now and then a walk is faulty (lost samples, another distance): `posterior_scale`.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from relpos.errors import DataError

LEG_OF_STATURE = 0.53
"""Leg length (hip joint to floor) over stature: Winter, Biomechanics and Motor Control of Human
Movement; 0.530 there."""
POPULATION_GAIN_PERMILLE = 2130
"""A new node's gain: from the people with odd numbers in walk_lowerback_20m."""
PERSON_SPREAD = 0.07
"""Relative standard deviation of gains between people and sensor positions."""
WALK_SPREAD = 0.05
"""Relative error of one walk of 20 m in the same person (walk_lowerback_20m: 3.4 % where no sample
was lost)."""
OUTLIER_SCALE = 0.10
"""Relative change at which a single walk is as likely faulty as the person is unusual."""
MIN_GAIN_PERMILLE, MAX_GAIN_PERMILLE = 300, 5000
"""Limits of the firmware."""
MIN_STEPS = 8
"""Fewer steps are dominated by starting and stopping."""
MAX_CHANGE = 1.6
"""People's gains differ by 10 %; a larger factor comes from another distance."""
STEP_SPREAD = 0.08
"""Random part of a step's length, relative (docs/deadreckoning.md); its
effect on a walk's length falls with the root of the steps."""


def leg_length_m(stature_m: float) -> float:
    """Return the leg length for a stature; DataError where it is not an adult's."""
    if not 1.0 <= stature_m <= 2.4:
        raise DataError(f"a stature of {stature_m:g} m: give it in metres, for example 1.78")
    return LEG_OF_STATURE * stature_m


def scaled_gain_permille(gain_permille: int, step_scale: float) -> int:
    """Return the gain for steps ``step_scale`` times as long as the node reported.

    DataError where the scale is not a positive number or the gain is outside the node's limits.
    """
    if not (math.isfinite(step_scale) and step_scale > 0.0):
        raise DataError(f"a step scale of {step_scale:g} is not a positive number")
    gain = round(gain_permille * step_scale)
    if not MIN_GAIN_PERMILLE <= gain <= MAX_GAIN_PERMILLE:
        raise DataError(
            f"a step scale of {step_scale:.3f} would make the step gain {gain / 1000:.3f}, the "
            f"limits are {MIN_GAIN_PERMILLE / 1000:g} to {MAX_GAIN_PERMILLE / 1000:g}"
        )
    return gain


def posterior_scale(scales: Sequence[float]) -> float:
    """Return the factor on the population's gain after walks with ``scales`` (n,).

    Normal prior of `PERSON_SPREAD` over the logarithm, the walks' median with `WALK_SPREAD` over
    root n, and a heavy tail: the variance of one walk grows with the fourth power of its scale's
    logarithm, and this part falls with the square of the number of walks. DataError where a
    scale is not positive. On every ordered pair of walks of one person in walk_lowerback_20m, a
    fifth of which lost samples, the mean absolute error of the other walk is 4.4 %, against 6.2 %
    with the plain scale and 4.9 % without calibration.
    """
    if not scales or not all(math.isfinite(s) and s > 0.0 for s in scales):
        raise DataError("a step scale is not a positive number")
    count = len(scales)
    log_scale = statistics.median(math.log(s) for s in scales)
    tail = 1.0 + (log_scale / OUTLIER_SCALE) ** 4 / count**2
    weight = PERSON_SPREAD**2 / (PERSON_SPREAD**2 + WALK_SPREAD**2 * tail / count)
    return math.exp(weight * log_scale)


@dataclass(frozen=True)
class WalkFit:
    """Step gain from one walk, weighted by `posterior_scale`."""

    gain_before_permille: int
    gain_permille: int
    steps: int
    measured_m: float
    true_m: float

    @property
    def scale(self) -> float:
        """True over reported length of the walk."""
        return self.true_m / self.measured_m

    @property
    def sigma(self) -> float:
        """Relative standard deviation of the scale from the random part of step lengths."""
        return STEP_SPREAD / math.sqrt(self.steps)


def fit_walk(gain_permille: int, steps: int, measured_m: float, true_m: float) -> WalkFit:
    """Return the step gain from a walk of ``true_m`` that the node measured as ``measured_m``.

    DataError where the walk is too short, or where the two lengths are too far apart.
    """
    if not (math.isfinite(true_m) and true_m > 0.0):
        raise DataError(f"a calibration walk of {true_m:g} m")
    if steps < MIN_STEPS or not measured_m > 0.0:
        raise DataError(
            f"the node counted {steps} steps and {max(measured_m, 0.0):.1f} m: walk at least "
            f"{MIN_STEPS} steps, 20 m or more, at your usual pace"
        )
    scale = true_m / measured_m
    if not 1.0 / MAX_CHANGE <= scale <= MAX_CHANGE:
        raise DataError(
            f"the node measured {measured_m:.1f} m where {true_m:g} m were walked: too far apart "
            "for one walk: walk the distance once, straight, and stop at its end"
        )
    # The prior is the population's gain, not the node's present one.
    asked = scale * gain_permille / POPULATION_GAIN_PERMILLE
    gain = scaled_gain_permille(POPULATION_GAIN_PERMILLE, posterior_scale([asked]))
    return WalkFit(gain_permille, gain, steps, measured_m, true_m)
