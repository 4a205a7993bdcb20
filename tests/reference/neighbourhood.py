"""The dense filter that :mod:`relpos.fusion.large_teams.sparse_filter` stands for, as its
equations read.

The state is node by node x, y, heading, drift, log scale: (N, 5), covariance (5N, 5N). All ranges
of an instant at once, about the predicted poses, to second order.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

NEAREST_M = 1e-3
"""As in the kernels: it keeps divisions finite."""


PER_NODE = 5

SCALE_WALK = 2e-5
"""Variance that the logarithm of a moving node's step scale gathers (1/s)."""


def wander(covariance: Floats, node: Indices, duration_s: Floats) -> None:
    """Let step scales walk at random, at the end of all displacements of an instant."""
    for i, moved_s in zip(node, duration_s, strict=True):
        covariance[PER_NODE * i + 4, PER_NODE * i + 4] += SCALE_WALK * moved_s


def advance(state: Floats, covariance: Floats, node: Indices, moved: Floats) -> None:
    """Move nodes by displacements, sigmas and durations (E, 7) in place, one after the other."""
    for i, (forward, left, turn, *sigmas, duration_s) in zip(node, moved, strict=True):
        sigma_x, sigma_y, sigma_turn = sigmas
        at = PER_NODE * int(i)
        here = slice(at, at + PER_NODE)
        covariance[at + 2, at + 2] += sigma_turn**2
        half_s = 0.5 * duration_s
        drift = np.array([1.0, -half_s])
        heading_variance = drift @ covariance[at + 2 : at + 4, at + 2 : at + 4] @ drift
        shrunk = math.exp(-0.5 * heading_variance)
        heading = state[i, 2] - half_s * state[i, 3]
        c, s = math.cos(heading), math.sin(heading)
        turn_by = np.array([[c, -s], [s, c]])
        step = math.exp(state[i, 4]) * turn_by @ np.array([forward, left])
        turned = covariance[at : at + 2, at + 2 : at + 4] @ drift / (heading_variance + 1e-12)
        so_far = max(step @ np.array([turned[1], -turned[0]]), 0.0) / (step @ step + 1e-12)
        f = np.eye(PER_NODE)
        f[:2, 2] = shrunk * np.array([-step[1], step[0]])
        f[:2, 3] = -half_s * f[:2, 2]
        f[:2, 4] = shrunk * step
        f[2, 3] = -duration_s
        covariance[here] = f @ covariance[here]
        covariance[:, here] = covariance[:, here] @ f.T
        own = turn_by @ np.diag([sigma_x**2, sigma_y**2]) @ turn_by.T
        own += (1.0 + 2.0 * so_far) * 0.5 * (1.0 - shrunk**2) ** 2 * np.outer(step, step)
        aside = np.array([-step[1], step[0]])
        swept = 0.5 * (1.0 - shrunk**4) - heading_variance * shrunk**2
        own += (1.0 + 2.0 * so_far) * max(swept, 0.0) * np.outer(aside, aside)
        covariance[at : at + 2, at : at + 2] += own
        state[i, :2] += shrunk * step
        state[i, 2] += turn - duration_s * state[i, 3]


def spread(state: Floats, covariance: Floats, node: Indices, peer: Indices) -> Floats:
    """Of pairs (E,) distance, variances along and across, bearing of the peer: (4, E)."""
    result = np.empty((4, len(node)))
    for e, (i, j) in enumerate(zip(node, peer, strict=True)):
        off = state[j, :2] - state[i, :2]
        distance = float(np.hypot(*off))
        u = off / distance
        h = np.zeros((2, covariance.shape[0]))
        h[:, PER_NODE * i : PER_NODE * i + 2] = -np.eye(2)
        h[:, PER_NODE * j : PER_NODE * j + 2] = np.eye(2)
        relative = h @ covariance @ h.T
        along = float(u @ relative @ u)
        result[:, e] = distance, along, np.trace(relative) - along, math.atan2(off[1], off[0])
    return result


def update(
    state: Floats,
    covariance: Floats,
    node: Indices,
    peer: Indices,
    measured: Floats,
    sigma_m: float,
    lift_m2: Floats | float = 0.0,
) -> None:
    """Work in ranges (E,) in place: the textbook's gain for all of them at once.

    ``lift_m2`` are the squares of the differences of height.
    """
    distance, along, across, bearing = spread(state, covariance, node, peer)
    tilted = along * lift_m2 / (distance**2 + lift_m2)
    middle = np.sqrt(distance**2 + lift_m2 + across + tilted + NEAREST_M**2)
    slope = distance / middle
    h = np.zeros((len(node), covariance.shape[0]))
    e = np.arange(len(node))
    for place, sign in ((node, -1.0), (peer, 1.0)):
        h[e, PER_NODE * place] += sign * slope * np.cos(bearing)
        h[e, PER_NODE * place + 1] += sign * slope * np.sin(bearing)
    noise = sigma_m**2 + 0.5 * (across**2 + tilted**2) / middle**2
    whitened = np.linalg.solve(h @ covariance @ h.T + np.diag(noise), np.eye(len(node)))
    gain = covariance @ h.T @ whitened
    moved = (gain @ (measured - middle)).reshape(state.shape)
    pull = (h.T @ whitened @ (measured - middle)).reshape(state.shape)
    state += moved
    covariance -= gain @ h @ covariance
    turn_ways(state, covariance, moved[:, 2], pull[:, :2])


def given_terms(joint: Floats, count: int) -> tuple[Floats, Floats]:
    """Return the covariance (5N, 5N) of states if T terms were known, and their derivative (5N, T).

    ``joint`` (5N + T, 5N + T) is the covariance of ``count`` nodes' states, then of the terms.
    """
    own, terms = slice(PER_NODE * count), slice(PER_NODE * count, None)
    carried = joint[own, terms] @ np.linalg.inv(joint[terms, terms])
    return joint[own, own] - carried @ joint[terms, own], carried


def update_with_terms(
    state: Floats,
    terms: Floats,
    joint: Floats,
    ends: tuple[Indices, Indices],
    measured: Floats,
    slopes: Floats,
    sigma_m: float,
) -> None:
    """Work in ranges (E,) that depend on T terms by slopes (E, T), too: states and terms at once.

    Ways are not turned, and a range's curvature is that of the states if the terms were known.
    """
    distance, _, across, bearing = spread(state, given_terms(joint, len(state))[0], *ends)
    middle = np.sqrt(distance**2 + across + NEAREST_M**2)
    slope, e = distance / middle, np.arange(len(measured))
    h = np.hstack([np.zeros((len(measured), state.size)), slopes])
    for place, sign in zip(ends, (-1.0, 1.0), strict=True):
        h[e, PER_NODE * place] += sign * slope * np.cos(bearing)
        h[e, PER_NODE * place + 1] += sign * slope * np.sin(bearing)
    noise = sigma_m**2 + 0.5 * (across / middle) ** 2
    gain = joint @ h.T @ np.linalg.inv(h @ joint @ h.T + np.diag(noise))
    moved = gain @ (measured - middle - slopes @ terms)
    state += moved[: state.size].reshape(state.shape)
    terms += moved[state.size :]
    joint -= gain @ h @ joint


def turn_ways(state: Floats, covariance: Floats, turn_rad: Floats, pull: Floats) -> None:
    """Turn what positions owe to step scales as headings were corrected (N,), in place.

    Scales move as if the gain of ``pull`` (N, 2) had been that of the way turned half.
    """
    for i, turn in enumerate(turn_rad):
        at = PER_NODE * i
        way = covariance[at : at + 2, at + 4] / covariance[at + 4, at + 4]
        f = np.eye(covariance.shape[0])
        f[at : at + 2, at + 4] = turn * np.array([-way[1], way[0]])
        before = covariance[at : at + 2, at + 4].copy()
        covariance[:] = f @ covariance @ f.T
        state[i, 4] += 0.5 * (covariance[at : at + 2, at + 4] - before) @ pull[i]
