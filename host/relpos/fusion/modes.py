"""What weighted hypotheses say of a team: modes with probabilities, rings, regions.

Hypotheses about a team (weights, poses, position covariances) become at most
``MAX_ALTERNATIVES`` modes: hypotheses that put all nodes at about the same places are one. A
node that is spread round a whole circle is given as a ring.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relpos.fusion.arrays import Bools, Floats, Indices
from relpos.fusion.estimator import (
    ANY_ANGLE_RAD,
    MAX_ALTERNATIVES,
    Alternative,
    Shape,
    ellipse_axes,
)

ONE_PLACE_M = 0.7
"""Hypotheses that differ by less are one mode; the first tried, then wider ones."""

RING_SECTORS = 8
RING_FULLEST = 0.4
RING_WIDTH = 0.35
"""A circle: no sector of eight empty, none with more than this fraction, the width at most this
fraction of the radius."""


@dataclass(frozen=True, slots=True)
class Belief:
    """What a mixture says of one node: the best mode's pose, the mixture's spread about it.

    ``mode_weight`` is the probability that the node is within ``ONE_PLACE_M`` (or two standard
    deviations) of where the best mode has it; ``mode_sigma_m`` the mode's own spread.
    """

    x_m: float
    y_m: float
    heading_rad: float
    covariance_m2: Floats
    sigma_heading_rad: float
    mode_weight: float
    mode_sigma_m: float


def alternatives_of(
    time_s: float, nodes: Sequence[int], weights: Floats, poses: Floats, covariances: Floats
) -> tuple[Alternative, ...]:
    """Give weights (K,), poses (K, N, 3), position covariances (K, N, 2, 2) as alternatives.

    The most probable comes first; probabilities sum to one.
    """
    ringed = [
        _circle(weights, poses[:, n, :2], covariances[:, n]) is not None for n in range(len(nodes))
    ]
    compact = np.flatnonzero(~np.array(ringed, dtype=bool))
    group = _groups(weights, poses[:, compact, :2], covariances[:, compact])
    probability = np.bincount(group, weights=weights)
    rows = []
    for rank, g in enumerate(np.argsort(-probability, kind="stable")):
        of = group == g
        share = weights[of] / probability[g]
        for n, node in enumerate(nodes):
            places, covariance = poses[of, n, :2], covariances[of, n]
            heading = float(
                np.angle((share * np.exp(1j * poses[of, n, 2])).sum())
            )  # A mean that weighs every direction the same has none: any will do.
            circle = _circle(share, places, covariance) if ringed[n] else None
            shape = Shape.ELLIPSE
            if circle is not None:
                x, y, major, minor = circle
                angle, shape = 0.0, Shape.RING
            else:
                mean, spread = _moments(share, places, covariance)
                x, y = mean
                major, minor, angle = ellipse_axes(spread[0, 0], spread[1, 1], spread[0, 1])
            rows.append(
                Alternative(
                    time_s, rank, float(probability[g]), node, float(x), float(y), heading,
                    float(major), float(minor), float(angle), shape,
                )
            )  # fmt: skip
    return tuple(rows)


def best_mode(weights: Floats, poses: Floats, covariances: Floats) -> int:
    """Name the hypothesis about which the most weight lies: (K,), (K, N, 3), (K, N, 2, 2).

    All nodes' best places are taken from one mode; each node's own likeliest place could
    belong to different ones, and together they would be none.
    """
    leaders = np.argsort(-weights, kind="stable")[:32]
    near = np.ones((len(leaders), len(weights)), dtype=bool)
    for n in range(poses.shape[1]):
        near &= _near(poses[:, n, :2], covariances[:, n], leaders)
    return int(leaders[int(np.argmax(near @ weights))])


def _near(places: Floats, covariances: Floats, of: Indices) -> Bools:
    """Tell which places (K, 2) are one with those of hypotheses ``of`` (L,): (L, K)."""
    off = places[of, None, :] - places[None, :, :]
    reach2 = np.maximum(ONE_PLACE_M**2, 2.0 * np.trace(covariances, axis1=1, axis2=2))
    near: Bools = (off * off).sum(axis=2) < reach2
    return near


def belief_of(
    weights: Floats, poses: Floats, covariances: Floats, best: int | None = None
) -> Belief:
    """Say where one node is: weights (K,), poses (K, 3), covariances (K, 3, 3).

    The place is that of hypothesis ``best`` and those that are one with it; without it, of the
    place with the most weight.
    """
    places = poses[:, :2]
    if best is None:
        best = best_mode(weights, poses[:, None], covariances[:, None, :2, :2])
    here = _near(places, covariances[:, :2, :2], np.array([best]))[0]
    weight = float(weights[here].sum())
    own = weights[here] / weights[here].sum()
    mean, spread = _moments(own, places[here], covariances[here, :2, :2])
    total = np.einsum("k,kab->ab", weights, covariances[:, :2, :2])
    all_off = places - mean
    total += np.einsum("k,ka,kb->ab", weights, all_off, all_off)
    heading, _ = _heading(own, poses[here, 2], covariances[here, 2, 2])
    _, sigma = _heading(weights, poses[:, 2], covariances[:, 2, 2])
    return Belief(
        float(mean[0]), float(mean[1]), heading, total, sigma, weight,
        ellipse_axes(spread[0, 0], spread[1, 1], spread[0, 1])[0],
    )  # fmt: skip


def relative_poses(
    poses: Floats, covariances: Floats, first: int, second: int
) -> tuple[Floats, Floats]:
    """Give the pose (K, 3) of node ``second`` in the body frame of ``first``, and (K, 3, 3).

    poses (K, N, 3), covariances (K, 3 N, 3 N).
    """
    heading = poses[:, first, 2]
    c, s = np.cos(heading), np.sin(heading)
    off = poses[:, second] - poses[:, first]
    seen = np.column_stack(
        (c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0], off[:, 2])
    )
    slope = np.zeros((len(poses), 3, 6))
    slope[:, 0, 3], slope[:, 0, 4], slope[:, 1, 3], slope[:, 1, 4] = c, s, -s, c
    slope[:, :2, :2] = -slope[:, :2, 3:5]
    slope[:, 0, 2], slope[:, 1, 2] = seen[:, 1], -seen[:, 0]
    slope[:, 2, 5], slope[:, 2, 2] = 1.0, -1.0
    both = np.r_[3 * first : 3 * first + 3, 3 * second : 3 * second + 3]
    own = covariances[:, both][:, :, both]
    return seen, np.einsum("kab,kbc,kdc->kad", slope, own, slope)


def _heading(weights: Floats, heading: Floats, variance: Floats) -> tuple[float, float]:
    """Circular mean and standard deviation (at most that of a uniform direction)."""
    # E exp(i theta) of normals; wide ones count less.
    together = (weights * np.exp(1j * heading - 0.5 * variance)).sum()
    length = min(abs(together), 1.0)
    sigma = math.sqrt(-2.0 * math.log(length)) if length > 1e-3 else math.inf
    return float(np.angle(together)), min(sigma, ANY_ANGLE_RAD)


def _moments(weights: Floats, places: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    mean = weights @ places
    off = places - mean
    spread = np.einsum("k,kab->ab", weights, covariances)
    spread += np.einsum("k,ka,kb->ab", weights, off, off)
    return mean, spread


def _circle(
    weights: Floats, places: Floats, covariances: Floats
) -> tuple[float, float, float, float] | None:
    """Centre, radius and width of the circle that the places lie on; None where they do not.

    Algebraic fit (Kasa 1976): |p|^2 = 2 c . p + (r^2 - |c|^2), linear in c and the rest.
    """
    if weights.size < RING_SECTORS:
        return None
    middle = weights @ places
    off = places - middle
    root = np.sqrt(weights)
    design = np.column_stack((2.0 * off, np.ones(weights.size))) * root[:, None]
    squares = (off * off).sum(axis=1)
    solution, _, rank, _ = np.linalg.lstsq(design, squares * root, rcond=1e-9)
    if rank < 3:
        return None
    centre = solution[:2]
    radius2 = solution[2] + centre @ centre
    if radius2 <= 0.0:
        return None
    radius = math.sqrt(radius2)
    from_centre = off - centre
    distance = np.hypot(from_centre[:, 0], from_centre[:, 1])
    unit = from_centre / np.maximum(distance, 1e-9)[:, None]
    radial = np.einsum("ka,kab,kb->k", unit, covariances, unit)
    # A tangent leaves its circle outwards by half the square over the radius: not width.
    width = math.sqrt(float(weights @ ((distance - radius) ** 2 + radial)))
    if width > RING_WIDTH * radius:
        return None
    sector = (np.arctan2(from_centre[:, 1], from_centre[:, 0]) / math.tau * RING_SECTORS) % (
        RING_SECTORS
    )
    share = np.bincount(sector.astype(np.intp) % RING_SECTORS, weights, RING_SECTORS)
    if share.max() > RING_FULLEST or share.min() <= 0.2 / RING_SECTORS:
        return None
    return float(middle[0] + centre[0]), float(middle[1] + centre[1]), radius, width


def _groups(weights: Floats, places: Floats, covariances: Floats) -> Indices:
    """Number hypotheses (K,) by mode: places (K, N, 2), covariances (K, N, 2, 2)."""
    count = weights.size
    if places.shape[1] == 0 or count == 1:
        return np.zeros(count, dtype=np.intp)
    reach2 = np.maximum(ONE_PLACE_M**2, covariances[:, :, 0, 0] + covariances[:, :, 1, 1])
    order = np.argsort(-weights, kind="stable")
    widen = 1.0
    while True:
        group = np.full(count, -1, dtype=np.intp)
        leaders: list[int] = []
        for k in order:
            if group[k] >= 0:
                continue
            if len(leaders) == MAX_ALTERNATIVES:
                break
            off = places - places[k]
            near = ((off * off).sum(axis=2) < widen * reach2[k]).all(axis=1)
            group[near & (group < 0)] = len(leaders)
            leaders.append(int(k))
        left = group < 0
        if float(weights[left].sum()) < 0.02:
            break
        widen *= 2.0
    if left.any():
        off = places[left, None] - places[None, leaders]
        group[left] = (off * off).sum(axis=(2, 3)).argmin(axis=1)
    return group
