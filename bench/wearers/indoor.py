"""The magnetic field inside buildings: steel columns, reinforcement, furniture.

Every part is a field in air, free of curl and divergence: waves over reinforcement (as
`MagneticField`), columns that the earth magnetises into a pole at the floor and its opposite at
the ceiling, and dipoles for furniture, radiators and machines. docs/gait.md sets the heading's
deviation, norm and dip beside walk_handheld_waypoints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from relpos.simulation.world import FloatArray, MagneticField, World

_NEAREST_M = 0.7
"""Least distance of a path from the middle of a column."""


@dataclass(frozen=True, slots=True)
class IndoorField(MagneticField):
    """`MagneticField` with columns and furniture; one building per seed.

    Columns stand on a grid of ``column_spacing_m``, jittered by a fifth of it, each with a pole of
    median ``column_ut`` at 1 m; in every grid cell stands one dipole of median ``furniture_ut``
    at 1 m. Both spread log-normally by ``spread``, and buildings by ``building_spread``.
    """

    column_spacing_m: float = 6.0
    column_ut: float = 4.0
    furniture_ut: float = 2.0
    spread: float = 0.6
    building_spread: float = 0.35
    ceiling_m: float = 3.0

    def field_ut(self, position_m: FloatArray) -> FloatArray:
        """Field in world axes, microtesla, shape (n, 3), at ``position_m`` of shape (n, 3)."""
        out = MagneticField.field_ut(self, position_m)
        earth = MagneticField(self.strength_ut, self.inclination_rad, self.north_rad).field_ut(
            position_m[:1]
        )[0]
        rng = np.random.default_rng([self.seed, 0x1D0])
        scale = math.exp(rng.normal(0.0, self.building_spread))
        out = earth + scale * (out - earth)
        if not len(position_m):
            return np.asarray(out, dtype=np.float64)
        spacing = self.column_spacing_m
        # Heights are those over one floor: stairs lead to another that is built alike.
        place = position_m.copy()
        place[:, 2] = place[:, 2] % self.ceiling_m
        low = np.floor(position_m[:, :2].min(axis=0) / spacing).astype(int) - 2
        high = np.floor(position_m[:, :2].max(axis=0) / spacing).astype(int) + 2
        for i in range(int(low[0]), int(high[0]) + 1):
            for j in range(int(low[1]), int(high[1]) + 1):
                cell = np.random.default_rng([self.seed, i + 100_000, j + 100_000])
                corner = spacing * np.array([i, j])
                column = corner + spacing * (0.5 + 0.2 * cell.uniform(-1, 1, 2))
                # Steel in the northern earth field: the lower pole is a north-seeking one.
                pole = scale * self.column_ut * math.exp(cell.normal(0.0, self.spread))
                pole *= cell.choice((-1.0, 1.0), p=(0.25, 0.75))
                item = np.append(corner + spacing * cell.random(2), cell.uniform(0.2, 1.5))
                size = scale * self.furniture_ut * math.exp(cell.normal(0.0, self.spread))
                moment = cell.standard_normal(3)
                near = np.hypot(*(place[:, :2] - column).T) < 12.0
                if near.any():
                    out[near] += _pole(place[near], np.append(column, 0.0), pole)
                    out[near] += _pole(place[near], np.append(column, self.ceiling_m), -pole)
                near = np.hypot(*(place[:, :2] - item[:2]).T) < 6.0
                if near.any():
                    moment = size * moment / np.linalg.norm(moment)
                    out[near] += _dipole(place[near], item, moment)
        return np.asarray(out, dtype=np.float64)


def _pole(place: FloatArray, at: FloatArray, strength_ut: float) -> FloatArray:
    """Field of a magnetic pole: ``strength_ut`` at 1 m, falling with the square."""
    away = place - at
    distance = np.maximum(np.linalg.norm(away, axis=1), _NEAREST_M)
    return np.asarray(strength_ut * away / distance[:, None] ** 3, dtype=np.float64)


def _dipole(place: FloatArray, at: FloatArray, moment_ut: FloatArray) -> FloatArray:
    """Field of a dipole whose field on its axis at 1 m is twice ``moment_ut``."""
    away = place - at
    distance = np.maximum(np.linalg.norm(away, axis=1), _NEAREST_M)[:, None]
    unit = away / distance
    along = (unit @ moment_ut)[:, None]
    return np.asarray((3.0 * along * unit - moment_ut) / distance**3, dtype=np.float64)


INDOOR = World(
    magnetic=IndoorField(disturbance_ut=4.5, wavelengths_m=(3.0, 40.0), modes=24),
)
"""A building; its seed is the walker's."""
