"""The wearer's step: leg length from stature, step gain from walks or from a learned scale.

A step's length is gain x (l^2 h)^(1/3) with leg length l and the torso's rise h
(docs/deadreckoning.md): proportional to the gain, so a walk of known length gives the gain by
division. Its weight follows from what is known before: people differ by 10 %, a walk repeats the
better the longer it is, and now and then one is faulty: `posterior_scale`. Scales that an estimator
learns from ranges have the same prior in the estimator and are taken as they are.
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
POPULATION_GAIN_PERMILLE = 2140
"""A new node's gain: from the people of docs/walkers.md."""
PERSON_SPREAD = 0.10
"""Relative standard deviation of gains between people and sensor positions: .05 healthy, .14 after
a stroke or over eighty (docs/walkers.md)."""
WALK_SPREAD = 0.03
"""Relative error that a walk repeats in all its steps."""
STEP_SPREAD = 0.25
"""What single steps add, over the root of their number: .09 in walks of seven steps, .045 in 35."""
FAULTY_SCALE = 0.025
"""Times the root of the steps: change at which a walk is as likely faulty (samples lost, started or
stopped elsewhere) as the person is unusual."""
MIN_GAIN_PERMILLE, MAX_GAIN_PERMILLE = 300, 5000
"""Limits of the firmware."""
MIN_STEPS = 8
"""Fewer steps are dominated by starting and stopping."""
MAX_CHANGE = 1.6
"""People's gains differ by 10 %; a larger factor comes from another distance."""


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


def posterior_scale(scales: Sequence[float], steps: Sequence[int]) -> float:
    """Return the factor on the population's gain after walks with ``scales`` and ``steps`` (n,).

    Normal prior of `PERSON_SPREAD` over the logarithm; the median of the walks with the variance of
    their mean; and a heavy tail: the variance of one walk grows with the fourth power of its
    scale's logarithm, and this part falls with the square of the number of walks. DataError where
    a scale or a number of steps is not positive.
    """
    if not scales or not all(math.isfinite(s) and s > 0.0 for s in scales) or min(steps) < 1:
        raise DataError("a step scale is not a positive number")
    count, total = len(scales), sum(steps)
    log_scale = statistics.median(math.log(s) for s in scales)
    variance = WALK_SPREAD**2 / count + STEP_SPREAD**2 / total
    variance *= 1.0 + (log_scale / FAULTY_SCALE) ** 4 * (count / total) ** 2 / count**2
    return math.exp(PERSON_SPREAD**2 / (PERSON_SPREAD**2 + variance) * log_scale)


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
    gain = scaled_gain_permille(POPULATION_GAIN_PERMILLE, posterior_scale([asked], [steps]))
    return WalkFit(gain_permille, gain, steps, measured_m, true_m)
