"""The wearer's step: leg length from the stature, step gain from a walk or from a learned scale.

A step's length is gain x 2 sqrt(2 l h - h^2) with leg length l and the torso's rise h (Zijlstra
and Hof 1997): proportional to the gain, so a walk of known length gives the gain by division. The
node's filter weighs the step against the inertial motion, hence not quite: a second walk tells how
far off the first one left it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from relpos.errors import DataError

LEG_OF_STATURE = 0.53
"""Leg length (hip joint to floor) over stature: Winter, Biomechanics and Motor Control of Human
Movement; 0.530 there."""
LEAST_GAIN_PERMILLE, MOST_GAIN_PERMILLE = 300, 3000
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


@dataclass(frozen=True)
class WalkFit:
    """Step gain from one walk, whose length is taken as exact."""

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
    return WalkFit(
        gain_permille, scaled_gain_permille(gain_permille, scale), steps, measured_m, true_m
    )
