"""A node turned in the hands instead of worn on the chest: what a calibration asks for.

Lying still, on each of its six sides, turned in all directions, and at last held upright as it is
worn and turned about the vertical in steps of 45 degrees, where a heading can be checked.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from relpos.simulation.walker import RATE_HZ, StepTruth, WalkerTruth, make_person
from relpos.simulation.world import GRAVITY_M_S2, FloatArray, World

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

TURNTABLE = "turntable"
LYING_S = 12.0
SIDE_TURN_S, SIDE_HOLD_S = 1.5, 4.0
TUMBLE_S = 110.0
TUMBLE_TURN_S = (1.2, 2.2)
"""One movement of the hands, from rest to rest; half a turn in that time peaks at 5 rad/s."""
HAND_M_S2 = 0.4
"""RMS acceleration of the hands while they turn something, an axis; 0.5 to 4 Hz."""
UPRIGHT_TURN_S, UPRIGHT_HOLD_S = 2.0, 8.0
UPRIGHT_STEP_RAD = math.pi / 4
HEIGHT_M = 1.0

SIDES = (
    (0.0, 0.0, 0.0),
    (math.pi, 0.0, 0.0),
    (math.pi / 2, 0.0, 0.0),
    (-math.pi / 2, 0.0, 0.0),
    (0.0, math.pi / 2, 0.0),
    (0.0, -math.pi / 2, 0.0),
)
"""Rotation vectors that lay each side of the sensor down once."""
WORN = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
"""Sensor axes (x up, y left, z backward) into a world whose x is ahead."""


def _script(seconds: float, rng: np.random.Generator) -> list[tuple[float, float, Rotation, bool]]:
    """(duration of the turn, of the rest behind it, attitude then, in the hands?) in order."""
    from scipy.spatial.transform import Rotation

    tilt = Rotation.from_rotvec(0.03 * rng.standard_normal(3))
    moves = [(0.0, LYING_S, tilt, False)]

    def lay_on_each_side() -> None:
        for side in SIDES[1:]:
            slant = Rotation.from_rotvec(0.03 * rng.standard_normal(3))
            moves.append((SIDE_TURN_S, SIDE_HOLD_S, Rotation.from_rotvec(side) * slant, False))

    lay_on_each_side()
    spent_s = 0.0
    while spent_s < TUMBLE_S:
        turn_s = float(rng.uniform(*TUMBLE_TURN_S))
        moves.append((turn_s, 0.1, Rotation.random(random_state=rng), True))
        spent_s += turn_s + 0.1
    # Once more, for a program that was not listening yet at the first time.
    moves.append((SIDE_TURN_S, LYING_S, tilt, False))
    lay_on_each_side()
    heading = 0.0
    spent_s += SIDE_TURN_S + 2 * (LYING_S + (len(SIDES) - 1) * (SIDE_TURN_S + SIDE_HOLD_S))
    while spent_s < seconds:
        attitude = Rotation.from_rotvec([0.0, 0.0, heading]) * Rotation.from_matrix(WORN)
        moves.append((UPRIGHT_TURN_S, UPRIGHT_HOLD_S, attitude, False))
        spent_s += UPRIGHT_TURN_S + UPRIGHT_HOLD_S
        heading += UPRIGHT_STEP_RAD
    return moves


def turn_by_hand(node: int, seconds: float, seed: int, world: World) -> WalkerTruth:
    """Truth of a node that is calibrated by hand; the same arguments give the same arrays.

    Every turn is about an axis fixed in the sensor with quintic timing, so that attitude and rate
    agree exactly. The node is not carried anywhere: its position stays, but for the hands'
    trembling, which is in the specific force alone (some millimetres).
    """
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng([seed, node, 0x7AB])
    person = make_person(rng, (1.0, 1.0), 0.0)
    n = math.ceil(seconds * RATE_HZ) + 1
    time_s = np.arange(n) / RATE_HZ
    attitude = np.empty((n, 3, 3))
    rate = np.zeros((n, 3))
    hands = np.zeros(n)
    begin_s = 0.0
    here = Rotation.identity()
    first = True
    for turn_s, rest_s, target, by_hand in _script(seconds, rng):
        if first:
            here, first = target, False
        rotation = (here.inv() * target).as_rotvec()
        end_s = begin_s + turn_s + rest_s
        rows = slice(math.ceil(begin_s * RATE_HZ), min(math.ceil(end_s * RATE_HZ), n))
        if rows.start < rows.stop:
            u = np.clip((time_s[rows] - begin_s) / max(turn_s, 1e-9), 0.0, 1.0)
            fraction = u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
            speed = 30.0 * (u * (1.0 - u)) ** 2 / max(turn_s, 1e-9)
            attitude[rows] = (here * Rotation.from_rotvec(np.outer(fraction, rotation))).as_matrix()
            rate[rows] = np.outer(speed, rotation)
            hands[rows] = np.where(u < 1.0, speed * turn_s / 1.875, 0.0) if by_hand else 0.0
        here, begin_s = target, end_s
    trembling = HAND_M_S2 * hands[:, None] * _band(rng, n)
    force = trembling + np.array([0.0, 0.0, GRAVITY_M_S2])
    position = np.tile([world.size_m[0] / 2, world.size_m[1] / 2, HEIGHT_M], (n, 1))
    field = world.magnetic.field_ut(position)
    # Ahead is opposite to the sensor's z; where that stands upright the heading says nothing.
    heading = np.unwrap(np.arctan2(-attitude[:, 1, 2], -attitude[:, 0, 2]))
    return WalkerTruth(
        node=node,
        person=person,
        time_s=time_s,
        position_m=position,
        velocity_m_s=np.zeros((n, 3)),
        heading_rad=heading,
        attitude=attitude,
        specific_force_m_s2=np.einsum("nji,nj->ni", attitude, force),
        angular_rate_rad_s=rate,
        magnetic_field_ut=np.einsum("nji,nj->ni", attitude, field),
        pressure_pa=world.pressure_pa(position[:, 2]),
        steps=StepTruth(np.zeros(0), np.zeros(0)),
        walk_start_s=seconds,
    )


def _band(rng: np.random.Generator, n: int) -> FloatArray:
    """Noise (n, 3) between 0.5 and 4 Hz of RMS 1."""
    spectrum = np.fft.rfft(rng.standard_normal((n, 3)), axis=0)
    frequency = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    spectrum[(frequency < 0.5) | (frequency > 4.0)] = 0.0
    noise = np.fft.irfft(spectrum, n, axis=0)
    scale = float(noise.std())
    return np.asarray(noise / scale if scale > 0.0 else noise, dtype=np.float64)
