"""Rigid motions of a whole team, which no range can measure: shift and turn in the world's frame.

With G (D, 3) the change of all poses by a small shift east, north and turn of the team,

    S = (G^T P^-1 G)^-1

is the largest covariance of such a motion that P contains: P - G S G^T is the covariance of what
ranges concern, and is still one. Bank and large teams keep S apart from P.
"""

from __future__ import annotations

import numpy as np

from relpos.fusion.arrays import Floats

RIGID = 3
"""Parameters of a rigid motion: east, north (m), turn (rad) about a point."""


def rigid_motion(x_m: Floats, y_m: Floats) -> Floats:
    """Return G (3 N, 3): how poses x, y, heading at (N,), (N,) change with a rigid motion."""
    g = np.zeros((len(x_m), 3, RIGID))
    g[:, [0, 1, 2], [0, 1, 2]] = 1.0
    g[:, 0, 2], g[:, 1, 2] = -y_m, x_m
    return g.reshape(-1, RIGID)


def about_origin(s: Floats, x_m: float, y_m: float) -> Floats:
    """Return the covariance of a rigid motion (3, 3) about a point as one about the origin."""
    move = np.array([[1.0, 0.0, y_m], [0.0, 1.0, -x_m], [0.0, 0.0, 1.0]])
    moved: Floats = move @ s @ move.T
    return moved
