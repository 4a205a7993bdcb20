"""The wearer's step: leg length from the stature, step gain from walks or from a learned scale.

A step's length is gain x (l^2 h)^(1/3) with leg length l and the torso's rise h
(docs/deadreckoning.md): proportional to the gain, so a walk of known length gives the gain by
division. How far that is believed is a matter of what is known already: people differ by 7 %, one
walk repeats to 5 %, and now and then a walk is not what was told (samples lost on the way, another
distance): `believed_scale`.
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
"""What nodes begin with: the people with odd numbers of walk_lowerback_20m."""
PERSON_SPREAD = 0.07
"""Relative standard deviation of people's gains about it, and of where the sensor is worn."""
WALK_SPREAD = 0.05
"""What one walk of 20 m is off by in the same person (walk_lowerback_20m: 3.4 % where no sample
was lost)."""
DOUBTED_SCALE = 0.10
"""A single walk that asks for more than this is as likely a wrong walk as an unusual person."""
LEAST_GAIN_PERMILLE, MOST_GAIN_PERMILLE = 300, 5000
"""What the firmware takes."""
LEAST_STEPS = 8
"""Fewer steps say more of starting and stopping than of walking."""
MOST_CHANGE = 1.6
"""People's gains differ by 10 %; what asks for more than this was not the walk that was told."""
STEP_SPREAD = 0.08
"""Random part of a step's length, relative (docs/deadreckoning.md); what it leaves of a walk's
length falls with the root of the steps."""


def leg_length_m(stature_m: float) -> float:
    """Leg length of a wearer who knows only their stature. DataError where it is no adult's."""
    if not 1.0 <= stature_m <= 2.4:
        raise DataError(f"a stature of {stature_m:g} m: give it in metres, for example 1.78")
    return LEG_OF_STATURE * stature_m


def scaled_gain_permille(gain_permille: int, step_scale: float) -> int:
    """Gain after every step was found to be ``step_scale`` times as long as the node said.

    DataError where the scale is no number or the gain would leave what the node takes.
    """
    if not (math.isfinite(step_scale) and step_scale > 0.0):
        raise DataError(f"a step scale of {step_scale:g} is not a positive number")
    gain = round(gain_permille * step_scale)
    if not LEAST_GAIN_PERMILLE <= gain <= MOST_GAIN_PERMILLE:
        raise DataError(
            f"a step scale of {step_scale:.3f} would make the step gain {gain / 1000:.3f}, a node "
            f"takes {LEAST_GAIN_PERMILLE / 1000:g} to {MOST_GAIN_PERMILLE / 1000:g}"
        )
    return gain


def believed_scale(scales: Sequence[float]) -> float:
    """What to multiply the population's gain with after walks that asked for ``scales`` (n,).

    Normal prior of `PERSON_SPREAD` over the logarithm, the walks' median with `WALK_SPREAD` over
    root n, and a tail: the variance of one walk grows with the fourth power of what it asks for.
    Walks that agree share the doubt: it falls with the square of their number. DataError where a
    scale is not positive. On every ordered pair of walks of one person in walk_lowerback_20m, a
    fifth of which lost samples, the walk judged errs by 4.4 % (mean absolute), by 6.2 % where the
    scale is simply taken, by 4.9 % without calibration.
    """
    if not scales or not all(math.isfinite(s) and s > 0.0 for s in scales):
        raise DataError("a step scale is not a positive number")
    count = len(scales)
    asked = statistics.median(math.log(s) for s in scales)
    doubt = 1.0 + (asked / DOUBTED_SCALE) ** 4 / count**2
    weight = PERSON_SPREAD**2 / (PERSON_SPREAD**2 + WALK_SPREAD**2 * doubt / count)
    return math.exp(weight * asked)


@dataclass(frozen=True)
class WalkFit:
    """Step gain from one walk, believed as far as `believed_scale` says."""

    gain_before_permille: int
    gain_permille: int
    steps: int
    measured_m: float
    true_m: float

    @property
    def scale(self) -> float:
        """How much longer the walk was than the node said."""
        return self.true_m / self.measured_m

    @property
    def sigma(self) -> float:
        """Relative standard deviation of the scale, from the steps' own randomness."""
        return STEP_SPREAD / math.sqrt(self.steps)


def fit_walk(gain_permille: int, steps: int, measured_m: float, true_m: float) -> WalkFit:
    """Step gain from a walk of ``true_m`` that the node took for ``measured_m`` in ``steps``.

    DataError where the walk is too short, or where the two lengths cannot be of the same walk.
    """
    if not (math.isfinite(true_m) and true_m > 0.0):
        raise DataError(f"a calibration walk of {true_m:g} m")
    if steps < LEAST_STEPS or not measured_m > 0.0:
        raise DataError(
            f"the node counted {steps} steps and {max(measured_m, 0.0):.1f} m: walk at least "
            f"{LEAST_STEPS} steps, 20 m or more, at your usual pace"
        )
    scale = true_m / measured_m
    if not 1.0 / MOST_CHANGE <= scale <= MOST_CHANGE:
        raise DataError(
            f"the node measured {measured_m:.1f} m where {true_m:g} m were walked: too far apart "
            "for one walk; walk the distance once, straight, and stop at its end"
        )
    # People scatter about the population's gain, whatever the node was set to before.
    asked = scale * gain_permille / POPULATION_GAIN_PERMILLE
    gain = scaled_gain_permille(POPULATION_GAIN_PERMILLE, believed_scale([asked]))
    return WalkFit(gain_permille, gain, steps, measured_m, true_m)
