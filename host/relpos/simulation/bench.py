"""Nodes that lie on a bench, in a row, a known distance apart: for the antennas' calibration."""

from __future__ import annotations

import math

import numpy as np

from relpos.simulation.walker import RATE_HZ, StepTruth, WalkerTruth, make_person
from relpos.simulation.world import GRAVITY_M_S2, World

BENCH = "bench"
SPACING_M = 5.0
HEIGHT_M = 1.0


def lie_still(node: int, place: int, seconds: float, seed: int, world: World) -> WalkerTruth:
    """Truth of a node that lies at ``place`` of the row, on its back; nothing moves."""
    n = math.ceil(seconds * RATE_HZ) + 1
    position = np.tile([SPACING_M * place, 0.0, HEIGHT_M], (n, 1))
    return WalkerTruth(
        node=node,
        person=make_person(np.random.default_rng([seed, node, 0xBE7]), (1.0, 1.0), 0.0),
        time_s=np.arange(n) / RATE_HZ,
        position_m=position,
        velocity_m_s=np.zeros((n, 3)),
        heading_rad=np.zeros(n),
        attitude=np.tile(np.eye(3), (n, 1, 1)),
        specific_force_m_s2=np.tile([0.0, 0.0, GRAVITY_M_S2], (n, 1)),
        angular_rate_rad_s=np.zeros((n, 3)),
        magnetic_field_ut=world.magnetic.field_ut(position),
        pressure_pa=world.pressure_pa(position[:, 2]),
        steps=StepTruth(np.zeros(0), np.zeros(0)),
        walk_start_s=seconds,
    )
