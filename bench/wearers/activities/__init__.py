"""What a wearer does, one activity after another, decided step by step before the torso moves.

A script is a sequence of `Activity`; `SCRIPTS` draws whole scripts by name. `make_itinerary` turns
a script into an `Itinerary`: steps, turns, climbs and changes of posture over time; `motion.move`
makes the torso's motion of it. Activities on the feet are in ``walking.py``, others in
``postures.py``; both call the `Planner`, which knows where and when the wearer is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from wearers.wearer import Wearer

from . import postures, walking
from .activity import ACTIVITIES, FORWARD, Activity
from .itinerary import HIP_OF_STATURE, STEP_FIELDS, Itinerary
from .planner import Planner
from .scripts import SCRIPTS

__all__ = [
    "ACTIVITIES",
    "HIP_OF_STATURE",
    "SCRIPTS",
    "STEP_FIELDS",
    "Activity",
    "Itinerary",
    "make_itinerary",
]

_PLANS: Mapping[str, Callable[[Planner, Activity, bool], None]] = {
    "walk": walking.walk,
    "carry": walking.carry,
    "shuffle": walking.shuffle,
    "turn": walking.turn,
    "side": walking.side,
    "backward": walking.backward,
    "stairs_up": walking.stairs,
    "stairs_down": walking.stairs,
    "stand": postures.stand,
    "bend": postures.bend,
    "crawl": postures.crawl,
    "fall": postures.fall,
    "remount": postures.remount,
}


def make_itinerary(
    rng: np.random.Generator, wearer: Wearer, script: Sequence[Activity]
) -> Itinerary:
    """Decide every step of ``script`` for ``wearer``."""
    planner = Planner(rng, wearer)
    for activity, following in zip(script, [*script[1:], Activity("stand")], strict=True):
        begin = planner.time
        slips_on = following.kind == "remount" and following.distance_m > 0
        last = following.kind not in FORWARD and not slips_on
        if activity.kind in FORWARD:
            planner.face(0.0)
        _PLANS[activity.kind](planner, activity, last)
        if planner.time > begin:
            planner.out.intervals.append((begin, planner.time, activity.kind))
    return planner.out
