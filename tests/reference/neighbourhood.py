"""The dense filter that :mod:`relpos.fusion.large_teams.sparse_filter` stands for, as its
equations read.

The state is node by node x, y, heading: poses (N, 3), covariance (3N, 3N). All ranges of an
instant at once, about the predicted poses, to second order.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

NEAREST_M = 1e-3
"""As in the kernels: it keeps divisions finite."""


def advance(pose: Floats, covariance: Floats, node: Indices, moved: Floats) -> None:
    """Move nodes by displacements and sigmas (E, 6) in place, one after the other."""
    for i, (forward, left, turn, sigma_x, sigma_y, sigma_turn) in zip(node, moved, strict=True):
        at = 3 * int(i)
        here = slice(at, at + 3)
        covariance[at + 2, at + 2] += sigma_turn**2
        shrunk = math.exp(-0.5 * covariance[at + 2, at + 2])
        c, s = math.cos(pose[i, 2]), math.sin(pose[i, 2])
        turn_by = np.array([[c, -s], [s, c]])
        step = turn_by @ np.array([forward, left])
        f = np.eye(3)
        f[:2, 2] = shrunk * np.array([-step[1], step[0]])
        covariance[here] = f @ covariance[here]
        covariance[:, here] = covariance[:, here] @ f.T
        own = turn_by @ np.diag([sigma_x**2, sigma_y**2]) @ turn_by.T
        own += 0.5 * (1.0 - shrunk**2) ** 2 * np.outer(step, step)
        covariance[at : at + 2, at : at + 2] += own
        pose[i, :2] += shrunk * step
        pose[i, 2] += turn


def spread(pose: Floats, covariance: Floats, node: Indices, peer: Indices) -> Floats:
    """Of pairs (E,) distance, variances along and across, bearing of the peer: (4, E)."""
    result = np.empty((4, len(node)))
    for e, (i, j) in enumerate(zip(node, peer, strict=True)):
        off = pose[j, :2] - pose[i, :2]
        distance = float(np.hypot(*off))
        u = off / distance
        h = np.zeros((2, covariance.shape[0]))
        h[:, 3 * i : 3 * i + 2], h[:, 3 * j : 3 * j + 2] = -np.eye(2), np.eye(2)
        relative = h @ covariance @ h.T
        along = float(u @ relative @ u)
        result[:, e] = distance, along, np.trace(relative) - along, math.atan2(off[1], off[0])
    return result


def update(
    pose: Floats, covariance: Floats, node: Indices, peer: Indices, measured: Floats, sigma_m: float
) -> None:
    """Work in ranges (E,) in place: the textbook's gain for all of them at once."""
    distance, _, across, bearing = spread(pose, covariance, node, peer)
    middle = np.sqrt(distance**2 + across + NEAREST_M**2)
    slope = distance / middle
    h = np.zeros((len(node), covariance.shape[0]))
    e = np.arange(len(node))
    for place, sign in ((node, -1.0), (peer, 1.0)):
        h[e, 3 * place] += sign * slope * np.cos(bearing)
        h[e, 3 * place + 1] += sign * slope * np.sin(bearing)
    noise = sigma_m**2 + 0.5 * (across / middle) ** 2
    gain = np.linalg.solve(h @ covariance @ h.T + np.diag(noise), h @ covariance).T
    pose += (gain @ (measured - middle)).reshape(pose.shape)
    covariance -= gain @ h @ covariance
