"""What walks of known length say about a wearer's step scale, weighed against the stature.

One walk of 20 m knows the scale no better than the stature does: on `walk_lowerback_20m` (the 58
walks whose recording lost no samples, gain of the stature) people differ by 3 % and one person's
walks among themselves by 3 %, start, stop and the counted steps being half a metre of it. So the
walk is weighed, as a measurement against what is known beforehand; a single walk that is beyond
three sigma of both (a wrong length, a recording with holes) sets nothing. Two such walks that agree
are believed: then the wearer is unusual, not the walk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from relpos.errors import DataError

PEOPLE_SPREAD = 0.03
"""Between people, stature known: 0.028 over the seven people with odd numbers, 0.036 over the six
with even ones."""
STATURE_SPREAD = 0.037
"""More where the stature is not known: adults' spread of 5.5 % to the power of two thirds."""
WALK_SPREAD = 0.02
"""Of one person's walks on the same day, and in metres what starting and stopping add."""
WALK_SPREAD_M = 0.45
SIGMAS = 3.0


@dataclass(frozen=True)
class StepScale:
    """Factor on the steps' lengths, its relative sigma, and which of the walks were used."""

    scale: float
    sigma: float
    used: tuple[bool, ...]


def weigh_walks(
    measured_m: Sequence[float], true_m: Sequence[float], *, stature_known: bool = True
) -> StepScale:
    """Step scale from walks that the node measured as ``measured_m`` with the stature's gain.

    DataError where a length is not positive or there is no walk.
    """
    if not measured_m or len(measured_m) != len(true_m):
        raise DataError("a calibration takes walks with a measured and a true length each")
    for measured, true in zip(measured_m, true_m, strict=True):
        if not (math.isfinite(true) and true > 0.0 and math.isfinite(measured) and measured > 0.0):
            raise DataError(f"a calibration walk of {true:g} m that was measured as {measured:g} m")
    people = PEOPLE_SPREAD if stature_known else math.hypot(PEOPLE_SPREAD, STATURE_SPREAD)
    logs = [math.log(true / measured) for measured, true in zip(measured_m, true_m, strict=True)]
    spreads = [math.hypot(WALK_SPREAD, WALK_SPREAD_M / true) for true in true_m]
    plausible = [
        abs(log) <= SIGMAS * math.hypot(people, spread)
        for log, spread in zip(logs, spreads, strict=True)
    ]
    if not any(plausible) and len(logs) > 1:
        middle = fmean(logs)
        if all(abs(log - middle) <= SIGMAS * s for log, s in zip(logs, spreads, strict=True)):
            sigma = fmean(spreads) / math.sqrt(len(logs))
            return StepScale(math.exp(middle), sigma, (True,) * len(logs))
    kept = [(log, s) for log, s, use in zip(logs, spreads, plausible, strict=True) if use]
    information = people**-2 + sum(spread**-2 for _, spread in kept)
    mean = sum(log * spread**-2 for log, spread in kept) / information
    return StepScale(math.exp(mean), information**-0.5, tuple(plausible))
