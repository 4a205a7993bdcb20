"""On which floor everybody is; the floors' heights are learned from climbs between them.

Floor 0 is where the team started. A node changes its floor through stairs or lifts alone, may be
between floors, and is never forced onto one. Heights here are in barometers' metres, which warm air
and the stack effect make longer or shorter for all alike. Climbs cannot tell that from other
storeys: so a height over the start may be less sure than the floor.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.normal import normal_density

LOWEST, HIGHEST = -8, 40
"""Floors that are considered."""

SPACING_M, SIGMA_SPACING_M, SIGMA_STOREY_M = 3.5, 0.4, 0.3
"""Storey height: the building's, and how far each is from it; together 3.5 +- 0.5 m."""

SIGMA_SCALE = 0.02
"""Of the barometers' metre: 6 K."""
SHARED, SHARED_CLIMBS = 0.45, 5
"""This share of a climb's doubt (a standard deviation) is the same for all, as far as climbs
scatter: a stack effect, a fire.
The first so many climbs weigh no more than what is taken for granted."""

GROUND_M = 0.05
WORN_M = 0.2
"""People on one floor are at heights that differ by so much: how a node is worn, posture."""

BETWEEN, BETWEEN_STEPS = 0.3, 4.0
"""Prior weight of being between floors, relative to a floor's; a landing is soon walked over, so
that it halves with so many level steps."""
LEAST_BETWEEN = 0.01
"""Mezzanines, and floors at heights of their own."""

HIDDEN, HIDDEN_M = 0.05, 1.2
"""In so many climbs the pressure did something that was not told from climbing: a door of 10 Pa, a
fan; a standard deviation."""

PRESSED_M = 1.1
"""What the pressure does to one node and not to the others passes: the height over the start that
it shows is that of the floor but for a door, a hot room, the stack effect; a standard deviation."""

CERTAIN = 0.9
"""From this probability on a node's floor teaches the floor's height, and the node's."""


class Over(NamedTuple):
    """Heights over the start that pressure alone shows, less what it does to others; variances."""

    mean_m: Floats
    variance_m2: Floats


def _first_covariance() -> Floats:
    floor = np.arange(LOWEST, HIGHEST + 1, dtype=np.float64)
    same = np.sign(floor)[:, None] == np.sign(floor)
    nearer = np.minimum(np.abs(floor)[:, None], np.abs(floor))
    apart = SIGMA_SPACING_M**2 * np.outer(floor, floor) + SIGMA_STOREY_M**2 * nearer * same
    covariance: Floats = apart + GROUND_M**2
    return covariance


@dataclass(slots=True)
class Floors:
    """Heights of all floors (F,), their covariance (F, F), and where N nodes are."""

    mean_m: Floats = field(
        default_factory=lambda: SPACING_M * np.arange(LOWEST, HIGHEST + 1, dtype=np.float64)
    )
    covariance: Floats = field(default_factory=_first_covariance)
    probability: Floats = field(default_factory=lambda: np.empty((0, HIGHEST - LOWEST + 2)))
    """(N, F + 1); the last is between floors."""
    scale2: float = SIGMA_SCALE**2
    """Variance of the barometers' metre."""
    scatter: float = 1.0
    """Variance of climbs, less the floors', over the said one: by the end 0.2 in calm air, 0.6 in
    heat."""
    _climbs: int = SHARED_CLIMBS

    def add(self, *, late: bool) -> None:
        """Add a node on floor 0, or anywhere."""
        floors = len(self.mean_m)
        first = np.zeros(floors + 1)
        first[-LOWEST] = 1.0
        if late:
            first[:] = 1.0 / (floors + 1)
        self.probability = np.vstack([self.probability, first])

    def climbs(self, base: Indices) -> tuple[Floats, Floats]:
        """Return what climbs from floors (...,) to all floors measure (..., F), mean, variance."""
        k, j = base[..., None] - LOWEST, np.arange(len(self.mean_m))
        p = self.covariance
        return self.mean_m[j] - self.mean_m[k], p[j, j] + p[k, k] - 2.0 * p[j, k]

    def where(
        self, base: Indices, climbed_m: Floats, variance_m2: Floats, steps: Floats, over: Over
    ) -> Floats:
        """Return where nodes are (..., F + 1) that climbed from floors, then made level steps."""
        climbed_m, variance_m2, steps = (
            np.asarray(v)[..., None] for v in (climbed_m, variance_m2, steps)
        )
        mean_m, floors_m2 = self.climbs(base)
        total = variance_m2 + floors_m2 + WORN_M**2
        off_m = climbed_m - mean_m
        density = (1.0 - HIDDEN) * normal_density(off_m, total)
        density += HIDDEN * normal_density(off_m, total + HIDDEN_M**2)
        start_m, start_m2 = self.climbs(np.zeros_like(base))
        over_m, over_m2 = (np.asarray(v)[..., None] for v in over)
        total = start_m2 + over_m2 + PRESSED_M**2
        log_likelihood = -0.5 * (over_m - start_m) ** 2 / total
        density *= np.exp(log_likelihood - log_likelihood.max(axis=-1, keepdims=True))
        landing = np.maximum(BETWEEN * 0.5 ** (steps / BETWEEN_STEPS), LEAST_BETWEEN)
        weight = np.concatenate([density, landing / SPACING_M], axis=-1)
        probability: Floats = weight / weight.sum(axis=-1, keepdims=True)
        return probability

    def height_of(self, base: int, climbed_m: float) -> tuple[float, float]:
        """Return the height (m) of somebody who climbed from a floor, and its variance (m^2)."""
        k = base - LOWEST
        return float(self.mean_m[k]) + climbed_m, float(self.covariance[k, k])

    def drawn_to(
        self, z_m: float, variance_m2: float, probability: Floats, steps: float
    ) -> tuple[float, float]:
        """Return height and variance of one who is on floors so probably (F + 1).

        Who walks on the level is on one, or at a height of its own.
        """
        walks = 1.0 - 0.5 ** (steps / BETWEEN_STEPS)
        floors = walks * probability[:-1]
        own = 1.0 - float(floors.sum())
        mean_m = float(floors @ self.mean_m) + own * z_m
        own_m2 = np.diag(self.covariance) + self.scatter * WORN_M**2
        spread = floors @ ((self.mean_m - mean_m) ** 2 + own_m2)
        return mean_m, float(spread) + own * (variance_m2 + (z_m - mean_m) ** 2)

    def learn(
        self, base: int, floor: int, climbed_m: float, variance_m2: float, doubt_m: float
    ) -> None:
        """Learn from a climb between two floors, of a variance and a doubt (a deviation)."""
        if floor == base:
            return
        k, j = base - LOWEST, floor - LOWEST
        gain = self.covariance[:, j] - self.covariance[:, k]
        off_m = climbed_m - self.mean_m[j] + self.mean_m[k]
        said_m2 = variance_m2 + doubt_m**2 + WORN_M**2
        floors_m2, noise_m2 = gain[j] - gain[k], self.scatter * said_m2
        total = floors_m2 + noise_m2
        self.mean_m += gain * (off_m / total)
        self.covariance -= np.outer(gain, gain) / total
        self._climbs += 1
        share = noise_m2 / total
        found_m2 = (share * off_m) ** 2 + share * floors_m2
        self.scatter += (found_m2 / said_m2 - self.scatter) / self._climbs
        shared = SHARED * self.scatter * doubt_m / (SPACING_M * (floor - base))
        shared2 = SIGMA_SCALE**2 + shared**2
        self.scale2 += (shared2 - self.scale2) / self._climbs


def most_probable(probability: Floats) -> tuple[int | None, float]:
    """Return the most probable floor and its probability; None for between floors."""
    k = int(np.argmax(probability))
    return (None if k == len(probability) - 1 else k + LOWEST), float(probability[k])
