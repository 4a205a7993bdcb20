"""On which floor everybody is; the floors' heights are learned from where people stay.

Floor 0 is where the team started. A node changes its floor through stairs or lifts alone, may be
between floors, and is never forced onto one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

LOWEST, HIGHEST = -8, 40
"""Floors that are considered."""

SPACING_M, SIGMA_SPACING_M, SIGMA_STOREY_M = 3.5, 0.4, 0.3
"""Storey height: the building's, and how far each is from it; together 3.5 +- 0.5 m."""

GROUND_M = 0.05
WORN_M = 0.2
"""People on one floor are at heights that differ by so much: how a node is worn, posture."""

BETWEEN, BETWEEN_STEPS = 0.3, 4.0
"""Prior weight of being between floors, relative to a floor's; a landing is soon walked over, so
that it halves with so many level steps."""
LEAST_BETWEEN = 0.01
"""Mezzanines, and floors at heights of their own."""

CERTAIN = 0.95
"""From this probability on a node's floor teaches the floor's height, and the node's."""


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

    def add(self, *, late: bool) -> None:
        """Add a node on floor 0, or anywhere."""
        floors = len(self.mean_m)
        first = np.zeros(floors + 1)
        first[-LOWEST] = 1.0
        if late:
            first[:] = 1.0 / (floors + 1)
        self.probability = np.vstack([self.probability, first])

    def where(self, z_m: Floats, variance_m2: Floats, steps: Floats) -> Floats:
        """Return where nodes that have moved are (..., F + 1), by heights and level steps (...)."""
        z_m, variance_m2, steps = (np.asarray(v)[..., None] for v in (z_m, variance_m2, steps))
        total = variance_m2 + np.diag(self.covariance) + WORN_M**2
        density = np.exp(-0.5 * (z_m - self.mean_m) ** 2 / total) / np.sqrt(2.0 * np.pi * total)
        landing = np.maximum(BETWEEN * 0.5 ** (steps / BETWEEN_STEPS), LEAST_BETWEEN)
        weight = np.concatenate([density, landing / SPACING_M], axis=-1)
        probability: Floats = weight / weight.sum(axis=-1, keepdims=True)
        return probability

    def height_of(self, floor: int) -> tuple[float, float]:
        """Return a floor's height (m) and its variance (m^2)."""
        k = floor - LOWEST
        return float(self.mean_m[k]), float(self.covariance[k, k])

    def learn(self, floor: int, z_m: float, variance_m2: float) -> None:
        """Learn that somebody on a floor is at a height."""
        k = floor - LOWEST
        gain = self.covariance[:, k].copy()
        total = gain[k] + variance_m2 + WORN_M**2
        self.mean_m += gain * ((z_m - self.mean_m[k]) / total)
        self.covariance -= np.outer(gain, gain) / total


def most_probable(probability: Floats) -> tuple[int | None, float]:
    """Return the most probable floor and its probability; None for between floors."""
    k = int(np.argmax(probability))
    return (None if k == len(probability) - 1 else k + LOWEST), float(probability[k])
