"""An emulated building: storeys, stairwells with flights and landings, a lift, slabs.

The storeys lie above each other, ``STOREY_M`` apart unless told otherwise; the start's floor is 0.
Two stairwells stand at the west and the east wall, a lift in the middle of the north wall. Slabs
attenuate and delay ranges; a stairwell is open from top to bottom.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Places = npt.NDArray[np.int64]

STOREY_M = 3.5
SIZE_M = (30.0, 15.0)
"""Of every storey, along x and y."""

TAG_M = 1.3
"""Height of the tag over the feet of a standing wearer."""

SLAB_EXCESS_M = (0.26, 0.39)
"""A range through a slab of 0.2 m of concrete is too long by so much (from ITU-R P.2040)."""

LIFT_DB = 20.0
"""A lift's car is of steel (assumed)."""

LANDING_M = 1.2
"""From the door to the first step, and depth of a landing."""
HALF_M = 0.65
"""From the middle of a stairwell to the middle of a flight."""
SPIRAL_M = 0.8
"""Radius of the line on which a spiral stair is walked."""


class StairKind(IntEnum):
    """How a storey's height is climbed; the values of the setting ``stairs``."""

    DOG_LEG = 0
    """Two flights with a landing and a turn in between."""
    STRAIGHT = 1
    SPIRAL = 2


class Place(IntEnum):
    """Where somebody is; :data:`STAIRWELLS` are two."""

    STOREY = 0
    WEST = 1
    EAST = 2
    LIFT = 3
    OUTSIDE = 4


STAIRWELLS = (Place.WEST, Place.EAST)


@dataclass(frozen=True, slots=True)
class Leg:
    """A part of the way up one storey: points (n, 2) on the plan, and the rise over its length."""

    points_m: Floats
    rise_m: float = 0.0
    risers: int = 0

    @property
    def is_flight(self) -> bool:
        """Whether it has steps."""
        return self.risers > 0

    def reverse(self) -> Leg:
        """Return the same part walked down."""
        return Leg(self.points_m[::-1], -self.rise_m, self.risers)


@dataclass(frozen=True, slots=True)
class Stairwell:
    """One stairwell: its door at a wall, the direction out of the storey (-1: west, 1: east)."""

    place: Place
    outwards: float
    kind: StairKind = StairKind.DOG_LEG
    riser_m: float = 0.175
    tread_m: float = 0.28

    @property
    def door_m(self) -> Floats:
        """Where it is left and entered."""
        return np.array([SIZE_M[0] if self.outwards > 0.0 else 0.0, 0.5 * SIZE_M[1]])

    def up(self, storey_m: float) -> list[Leg]:
        """Return the way from one storey's door to the door of the storey above."""
        risers = max(2, round(storey_m / self.riser_m))
        foot = LANDING_M
        if self.kind is StairKind.SPIRAL:
            turn = risers * self.tread_m / SPIRAL_M
            angle = np.linspace(math.pi, math.pi + turn, 8 * risers)
            circle = np.column_stack([np.cos(angle), np.sin(angle)]) * SPIRAL_M
            legs = [
                Leg(self._at(circle + np.array([foot + SPIRAL_M, 0.0])), storey_m, risers),
            ]
        elif self.kind is StairKind.STRAIGHT:
            top = foot + risers * self.tread_m
            legs = [
                Leg(self._at([(foot, -HALF_M), (top, -HALF_M)]), storey_m, risers),
                Leg(self._at([(top + 0.6, -HALF_M), (top + 0.6, HALF_M), (0.6, HALF_M)])),
            ]
        else:
            half = risers // 2
            rise_m, top = storey_m * half / risers, foot + half * self.tread_m
            end = top - (risers - half) * self.tread_m
            legs = [
                Leg(self._at([(foot, -HALF_M), (top, -HALF_M)]), rise_m, half),
                Leg(self._at([(top + 0.6, -HALF_M), (top + 0.6, HALF_M)])),
                Leg(self._at([(top, HALF_M), (end, HALF_M)]), storey_m - rise_m, risers - half),
                Leg(self._at([(0.6, HALF_M)])),
            ]
        return legs

    def down(self, storey_m: float) -> list[Leg]:
        """Return the way to the door of the storey below."""
        return [leg.reverse() for leg in reversed(self.up(storey_m))]

    def _at(self, local: object) -> Floats:
        """Points (n, 2), out of the door and to the left of that, on the plan."""
        points = np.asarray(local, dtype=np.float64)
        return self.door_m + self.outwards * points


@dataclass(frozen=True, slots=True)
class Building:
    """Storeys, from the lowest on, over the start's floor; stairwells; what a slab takes."""

    floors_m: tuple[float, ...]
    stairwells: tuple[Stairwell, ...]
    slab_db: float = 14.0

    @property
    def start(self) -> int:
        """Place of the start's floor in ``floors_m``."""
        return self.floors_m.index(0.0)

    @property
    def lift_door_m(self) -> Floats:
        """Where the lift is entered; its car is behind."""
        return np.array([0.5 * SIZE_M[0], SIZE_M[1] - 0.5])

    def slabs(self, first_m: Floats, second_m: Floats) -> Floats:
        """How many slabs lie between the tags of two people whose feet are so high (n,): (n,)."""
        levels = np.array(self.floors_m)
        counts = [np.searchsorted(levels, feet_m + TAG_M) for feet_m in (first_m, second_m)]
        return np.asarray(np.abs(counts[0] - counts[1]), dtype=np.float64)

    def slabs_between(self, first_m: Floats, second_m: Floats) -> float:
        """How many slabs lie between tags at two places (3,); a stairwell is open."""
        if all(abs(first_m[k] - second_m[k]) < 2.0 * HALF_M for k in (0, 1)):
            return 0.0
        feet_m = (np.array([m[2] - TAG_M]) for m in (first_m, second_m))
        return float(self.slabs(*feet_m)[0])

    def between(
        self, feet_m: tuple[Floats, Floats], places: tuple[Places, Places]
    ) -> tuple[Floats, Floats]:
        """Decibels (n,) and slabs (n,) between two people."""
        slabs = self.slabs(*feet_m)
        first, second = places
        together = (first == second) & np.isin(first, STAIRWELLS)
        slabs = np.where(together, 0.0, slabs)
        steel = LIFT_DB * ((first == Place.LIFT) ^ (second == Place.LIFT))
        return self.slab_db * slabs + steel, slabs


def along(points_m: Floats, count: int) -> Iterator[tuple[float, float, float]]:
    """Yield ``count`` poses (x, y, direction) evenly along points (n, 2), the last at the end."""
    pieces = np.hypot(*np.diff(points_m, axis=0).T)
    arc = np.concatenate([[0.0], np.cumsum(pieces)])
    x, y = (np.interp(np.linspace(0.0, arc[-1], count + 1), arc, c) for c in points_m.T)
    for k in range(count):
        yield x[k + 1], y[k + 1], math.atan2(y[k + 1] - y[k], x[k + 1] - x[k])
