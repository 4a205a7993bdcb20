"""The elements that activities are made of: a step, a stop, a change of direction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from wearers.wearer import REFERENCE_CADENCE_HZ, REFERENCE_STEP_M, Wearer

from .itinerary import Itinerary


@dataclass(frozen=True, slots=True)
class StepShape:
    """How the torso moves in a step, as of `STEP_FIELDS`."""

    surge: float = 0.1
    sway: float = 1.0
    trunk: float = 1.0
    shock: float = 1.0


class Planner:
    """Where and when the wearer is while an `Itinerary` is made, step by step."""

    def __init__(self, rng: np.random.Generator, wearer: Wearer) -> None:
        self.rng, self.wearer = rng, wearer
        self.time = self.phase = self.path = self.turned = self.ground = 0.0
        self.planned_path = 0.0
        self.wander = 0.0
        self.drift = 0.0
        self.walk_effect = math.exp(rng.normal(0.0, wearer.excursion_walk_sd))
        # Step length given cadence changes from walk to walk (4.6 % in walk_lowerback_20m).
        self.walk_ratio = wearer.walk_ratio_m_s * math.exp(rng.normal(0.0, 0.045))
        self.since_stand = 0
        self.out = Itinerary()

    def _knot(self) -> None:
        out = self.out
        out.knot_time_s.append(self.time)
        out.knot_phase.append(self.phase)
        out.knot_path_m.append(self.path)
        out.knot_turn_rad.append(self.turned)
        out.knot_ground_m.append(self.ground)

    def stay(self, seconds: float) -> None:
        """Take no step for ``seconds``."""
        self.time += seconds
        self.since_stand = 0
        self._knot()

    def step(
        self,
        length: float,
        duration: float,
        excursion: float,
        pace: float,
        *,
        turn: float = 0.0,
        climb: float = 0.0,
        shape: StepShape = StepShape(),
    ) -> None:
        """Step ``length`` metres in ``duration`` seconds; ``pace`` is the speed over 1.2 m/s."""
        self.time += duration
        self.path += length
        self.turned += turn
        self.ground += climb
        self.phase += 1.0
        self.since_stand += 1
        lift = min(max(excursion, 0.0), 0.1)
        self.out.steps.append(
            (lift, pace, shape.surge, shape.sway, shape.trunk, length, shape.shock)
        )
        self._knot()

    @property
    def foot(self) -> float:
        """Side of the next step: 1 and -1 by turns."""
        return 1.0 if int(self.phase) % 2 == 0 else -1.0

    def variation(self, speed: float) -> float:
        """Relative sd of a step's length and duration.

        2 % in brisk walking (Hausdorff 1996), growing as people slow down (Beauchet 2009);
        walk_lowerback_20m has 3 % at 1.2 m/s and 5.6 % at 0.87 in duration, asymmetry included.
        """
        slow = max(0.0, (1.2 - speed) / 0.9)
        return self.wearer.irregularity * (0.02 + 0.06 * slow * math.sqrt(slow))

    def excursion(self, length: float, cadence: float) -> float:
        """Vertical excursion of a forward step, with what changes from step to step."""
        w = self.wearer
        self.drift = 0.95 * self.drift + 0.025 * math.sqrt(1 - 0.95**2) * self.rng.standard_normal()
        size = (length / REFERENCE_STEP_M) ** w.excursion_by_length
        size *= (cadence / REFERENCE_CADENCE_HZ) ** w.excursion_by_cadence
        own = math.exp(self.drift + 0.06 * w.irregularity * self.rng.standard_normal())
        return float(w.excursion_m * size * self.walk_effect * own)

    def face(self, offset_rad: float) -> None:
        """Stand for a moment, then walk in another direction relative to the body."""
        if self.out.offset.final == offset_rad:
            return
        pause = float(self.rng.uniform(0.7, 1.2))
        self.out.offset.to(offset_rad, self.time + 0.3 * pause, 0.4 * pause)
        self.stay(pause)
