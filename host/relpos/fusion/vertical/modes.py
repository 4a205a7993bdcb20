"""What wearers and the air may do, and how often one follows the other: two Markov chains.

Each wearer has a mode. The air is one for all: one barometer cannot tell a fan from a flight of
stairs, a team's can, because a fan changes all heights alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from functools import lru_cache

import numpy as np

from relpos.fusion.arrays import Floats


class Mode(IntEnum):
    """Modes of the chain; a lift's first seconds are modes of their own, so that a ride lasts."""

    LEVEL = 0
    UP = 1
    DOWN = 2
    LIFT_UP_BEGINS = 3
    LIFT_UP = 4
    LIFT_DOWN_BEGINS = 5
    LIFT_DOWN = 6
    DISTURBED = 7
    JUMP = 8
    FALLING = 9
    UP_TWO = 10
    """Two steps at a time."""
    DOWN_TWO = 11


class Air(IntEnum):
    """What all nodes share."""

    CALM = 0
    TOGETHER = 1
    """Calm; a crew sets out for another floor."""
    BLOWN = 2
    """The pressure changes for all but those who are ``DISTURBED``: they are behind a door."""


MODES, AIRS = len(Mode), len(Air)
UP = (Mode.UP, Mode.UP_TWO)
DOWN = (Mode.DOWN, Mode.DOWN_TWO)
STAIRS = (*UP, *DOWN)
RISERS = (1.0, 2.0, -1.0, -2.0)
"""That a step goes up in each of them."""
LIFTS = (Mode.LIFT_UP_BEGINS, Mode.LIFT_UP, Mode.LIFT_DOWN_BEGINS, Mode.LIFT_DOWN)
BEGINNINGS = (Mode.LIFT_UP_BEGINS, Mode.LIFT_DOWN_BEGINS)
UNDER_WAY = (*LIFTS, Mode.FALLING)
"""The wearer rises or falls without a step."""
PRESSURE = (Mode.DISTURBED, Mode.JUMP)
"""The pressure changes at one node, the wearer's height does not."""

FOLLOWS = np.where(np.arange(MODES) == Mode.DISTURBED, 0.0, 1.0)
"""Whether a mode sees what the air does to all (MODES,)."""

_RATES_HZ: dict[tuple[int, int], float] = {
    (Mode.LEVEL, Mode.UP): 1 / 90,
    (Mode.LEVEL, Mode.DOWN): 1 / 90,
    (Mode.LEVEL, Mode.LIFT_UP_BEGINS): 1 / 400,
    (Mode.LEVEL, Mode.LIFT_DOWN_BEGINS): 1 / 400,
    (Mode.LEVEL, Mode.DISTURBED): 1 / 400,
    (Mode.LEVEL, Mode.JUMP): 1 / 400,
    (Mode.LEVEL, Mode.FALLING): 1 / 5000,
    (Mode.LEVEL, Mode.UP_TWO): 1 / 900,
    (Mode.LEVEL, Mode.DOWN_TWO): 1 / 900,
    (Mode.UP, Mode.LEVEL): 1 / 7,
    (Mode.UP, Mode.DOWN): 1 / 60,
    (Mode.UP, Mode.DISTURBED): 1 / 400,
    (Mode.UP, Mode.JUMP): 1 / 400,
    (Mode.UP, Mode.FALLING): 1 / 1000,
    (Mode.UP, Mode.UP_TWO): 1 / 100,
    (Mode.UP_TWO, Mode.LEVEL): 1 / 7,
    (Mode.UP_TWO, Mode.UP): 1 / 20,
    (Mode.DOWN_TWO, Mode.LEVEL): 1 / 7,
    (Mode.DOWN_TWO, Mode.DOWN): 1 / 20,
    (Mode.DOWN_TWO, Mode.FALLING): 1 / 500,
    (Mode.DOWN, Mode.LEVEL): 1 / 7,
    (Mode.DOWN, Mode.UP): 1 / 60,
    (Mode.DOWN, Mode.DISTURBED): 1 / 400,
    (Mode.DOWN, Mode.JUMP): 1 / 400,
    (Mode.DOWN, Mode.FALLING): 1 / 500,
    (Mode.DOWN, Mode.DOWN_TWO): 1 / 100,
    (Mode.LIFT_UP_BEGINS, Mode.LIFT_UP): 1.0,
    (Mode.LIFT_UP, Mode.LEVEL): 1 / 6,
    (Mode.LIFT_DOWN_BEGINS, Mode.LIFT_DOWN): 1.0,
    (Mode.LIFT_DOWN, Mode.LEVEL): 1 / 6,
    (Mode.DISTURBED, Mode.LEVEL): 1 / 6,
    (Mode.DISTURBED, Mode.UP): 1 / 100,
    (Mode.DISTURBED, Mode.DOWN): 1 / 100,
    (Mode.JUMP, Mode.LEVEL): 2.0,
    (Mode.JUMP, Mode.DISTURBED): 0.2,
    (Mode.FALLING, Mode.LEVEL): 1 / 1.5,
}
"""How often a mode turns into another (assumed: flights of 5 to 10 s, a landing of 1 to 3 s)."""

_TOGETHER_HZ = {**_RATES_HZ, (Mode.LEVEL, Mode.UP): 1 / 4, (Mode.LEVEL, Mode.DOWN): 1 / 4}
"""The same while a crew sets out: all do within some seconds."""

_AIR_RATES_HZ: dict[tuple[int, int], float] = {
    (Air.CALM, Air.TOGETHER): 1 / 120,
    (Air.CALM, Air.BLOWN): 1 / 400,
    (Air.TOGETHER, Air.CALM): 1 / 4,
    (Air.TOGETHER, Air.BLOWN): 1 / 400,
    (Air.BLOWN, Air.CALM): 1 / 6,
    (Air.BLOWN, Air.TOGETHER): 1 / 120,
}
"""How often the air turns into another (assumed: a fan reaches its pressure within 10 s)."""


def _chain(rates_hz: Mapping[tuple[int, int], float], count: int, dt_s: float) -> Floats:
    """Return the probabilities (count, count) from row to column over an interval."""
    rates = np.zeros((count, count))
    for (before, after), rate_hz in rates_hz.items():
        rates[before, after] = rate_hz
    leaves = rates.sum(axis=1)
    share = np.where(leaves > 0.0, (1.0 - np.exp(-leaves * dt_s)) / leaves, 0.0)
    matrix: Floats = rates * share[:, None]
    # After minutes nobody stays, and rounding would make it less than nothing.
    np.fill_diagonal(matrix, np.maximum(1.0 - matrix.sum(axis=1), 0.0))
    return matrix


@lru_cache(maxsize=64)
def transition(dt_s: float, airs: int) -> Floats:
    """Return the probabilities (airs * MODES, airs * MODES) over an interval."""
    usual = _chain(_RATES_HZ, MODES, dt_s)
    if airs == 1:
        return usual
    of_mode = np.stack([usual, _chain(_TOGETHER_HZ, MODES, dt_s), usual])
    of_air = _chain(_AIR_RATES_HZ, AIRS, dt_s)
    both: Floats = of_air[:, None, :, None] * of_mode.transpose(1, 0, 2)[None]
    return both.reshape(AIRS * MODES, AIRS * MODES)
