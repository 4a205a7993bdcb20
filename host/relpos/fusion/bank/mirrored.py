"""Which located nodes the hypotheses leave open between the team and its mirror image.

Both have the same distances (flip ambiguity). Who has no heading relative to the others may be on
either side; and of three who walk in a line for a while nothing tells to which side they leave it,
if their headings are not known well enough.
:class:`~relpos.fusion.models.handedness.Handedness` remembers them.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping

import numpy as np

from relpos.fusion.arrays import Bools, Complexes, Floats, Indices
from relpos.fusion.bank import storage
from relpos.fusion.bank.hypothesis_set import HypothesisSet
from relpos.fusion.bank.storage import PER_NODE, StateIndex
from relpos.fusion.estimator import VAGUE_PAIR_M
from relpos.fusion.models.handedness import ASIDE_M, BETWEEN_M

VAGUE_RAD = math.radians(45.0)
"""A user whose heading relative to every peer's has a larger standard deviation is ambiguous."""

APART = 4.0
"""Two sides are apart by so many deviations within them at least; halves of a bell are by 2.6."""

LEAST_WEIGHT = 0.1
"""A side with less of the weight is left out. Share of the ``ok`` triangles that are on the wrong
side, ``mission-split-hard``, seeds 740 to 747, and of what is ``ok`` there, with three people
(``mission-base``), and in ``mission-line``: without this 1.1 %; 100, 99, 100 %, with 0.2 0.5 %; 97,
99, 99, with 0.1 0.3 %; 96, 99, 98, with 0.02 0.1 %; 93, 93, 90."""


def heading_sigmas(covariance: Floats, rows: Indices) -> Floats:
    """Return the standard deviation (N,) of each heading relative to the one it is best known to.

    ``covariance`` (D, D) is without the team's rotation.
    """
    place = PER_NODE * rows + StateIndex.HEADING
    own = covariance[np.ix_(place, place)]
    apart = own.diagonal()[:, None] + own.diagonal() - 2.0 * own
    np.fill_diagonal(apart, np.inf)
    sigmas: Floats = np.sqrt(np.maximum(apart.min(axis=1), 0.0))
    return sigmas


def open_sides(places_m: Complexes, weight: Floats, near: Bools) -> tuple[Bools, Bools]:
    """Tell who (N,) of hypotheses (K, N) may be on either side of the line through two others.

    And who is in such a line, where sides cannot be told apart.

    Looked at are the triangles of each and the two that are nearest to it, where their distances
    are known: ``near`` (N, N).
    """
    count = places_m.shape[1]
    sides, in_line = np.zeros((2, count), dtype=np.bool_)
    middle = weight @ places_m
    apart_m = np.abs(middle[:, None] - middle)
    three = np.argsort(apart_m, axis=1, kind="stable")[:, :3]
    corners, at = places_m[:, three], middle[three]
    area = ((corners[..., 1] - corners[..., 0]).conj() * (corners[..., 2] - corners[..., 0])).imag
    before = [2, 0, 1]
    longest_m = np.abs(at - at[:, before]).max(axis=1)
    height_m = area / np.maximum(longest_m, 1e-9)
    is_left = height_m > 0.0
    left, right = weight @ is_left, weight @ ~is_left
    on_left_m = weight @ np.maximum(height_m, 0.0) / np.maximum(left, 1e-9)
    on_right_m = weight @ np.minimum(height_m, 0.0) / np.maximum(right, 1e-9)
    between_m = on_left_m - on_right_m
    within_m2 = weight @ (height_m - np.where(is_left, on_left_m, on_right_m)) ** 2
    is_near = near[three, three[:, before]].all(axis=1)
    is_either = np.minimum(left, right) > LEAST_WEIGHT
    is_apart = between_m > np.maximum(BETWEEN_M, APART * np.sqrt(within_m2))
    is_low = np.abs(weight @ height_m) < ASIDE_M
    sides[three[is_near & is_either & is_apart].ravel()] = True
    in_line[three[is_near & (is_low | (is_either & ~is_apart))].ravel()] = True
    return sides, in_line


def mirror_image(x: Floats, p: Floats, nodes: int) -> tuple[Floats, Floats]:
    """Return means (K, D) and covariances (K, D, D) with the team reflected, which has N ``nodes``.

    The line of reflection is each hypothesis' own: through the middle of the team, along its
    greatest extent.
    """
    at = PER_NODE * np.arange(nodes)
    place_m = x[:, at + StateIndex.X] + 1j * x[:, at + StateIndex.Y]
    middle_m = place_m.mean(axis=1, keepdims=True)
    off_m = place_m - middle_m
    twice_rad = np.angle((off_m**2).sum(axis=1, keepdims=True))
    place_m = middle_m + np.exp(1j * twice_rad) * off_m.conj()
    image, change = x.copy(), np.zeros_like(p)
    image[:, at + StateIndex.X], image[:, at + StateIndex.Y] = place_m.real, place_m.imag
    image[:, at + StateIndex.HEADING] = twice_rad - x[:, at + StateIndex.HEADING]
    change[:] = np.eye(x.shape[1])
    change[:, at + StateIndex.X, at + StateIndex.X] = np.cos(twice_rad)
    change[:, at + StateIndex.Y, at + StateIndex.Y] = -np.cos(twice_rad)
    change[:, at + StateIndex.X, at + StateIndex.Y] = np.sin(twice_rad)
    change[:, at + StateIndex.Y, at + StateIndex.X] = np.sin(twice_rad)
    # A heading goes on to err with its drift as before.
    for entry in (StateIndex.HEADING, StateIndex.DRIFT):
        change[:, at + entry, at + entry] = -1.0
    return image, change @ p @ change.transpose(0, 2, 1)


def open_nodes(
    row: Mapping[int, int],
    these: HypothesisSet,
    covariance: Floats,
    sigma_m: Floats,
    standing: Container[int],
) -> tuple[set[int], dict[int, set[int]], dict[int, float]]:
    """Return who is open, and of each located node those whose distance to it is known.

    Then who is in a line with two others, and the deviation of its heading (rad).

    ``covariance`` (D, D) is without the team's rotation, ``sigma_m`` (P,) the deviations of the
    distances of every two nodes, in order. The heading of who is ``standing`` since it was found
    says nothing of its side, as an anchor has none.
    """
    nodes = sorted(row)
    if len(nodes) < 2:
        return set(), {node: set() for node in nodes}, {}
    rows = np.array([row[node] for node in nodes], dtype=np.int64)
    i, k = storage.every_pair(len(rows))
    near = np.zeros((len(rows), len(rows)), dtype=np.bool_)
    near[i, k] = near[k, i] = sigma_m < VAGUE_PAIR_M
    sigmas_rad = heading_sigmas(covariance, rows)
    is_open = (sigmas_rad > VAGUE_RAD) & [node not in standing for node in nodes]
    in_line = np.zeros_like(is_open)
    if len(nodes) > 2:
        weight = these.unperturbed_weights().reshape(-1)[: these.count]
        at = storage.POSE * rows
        east_m, north_m = (storage.of_each(these.arrays.x[:, at + e], these.count) for e in (0, 1))
        sides, in_line = open_sides(east_m + 1j * north_m, weight, near)
        is_open |= sides
    return (
        {n for n, o in zip(nodes, is_open.tolist(), strict=True) if o},
        {
            n: {m for m, known in zip(nodes, line, strict=True) if known}
            for n, line in zip(nodes, near.tolist(), strict=True)
        },
        {nodes[k]: float(sigmas_rad[k]) for k in np.flatnonzero(in_line)},
    )
