"""What a UWB range says about two positions: the paper's eqs. (5) and (6).

    p(z_ij | x_i, x_j) = N(z_ij; |x_i - x_j|, sigma_r^2)

Only positive measurements are considered (paper sect. IV-C).

Heights make the distance slant: where the nodes' heights differ by h, the predicted range is
sqrt(|x_i - x_j|^2 + h^2).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np

from relpos.fusion.arrays import Bools, Floats, Indices


class CommonIndex(IntEnum):
    """What all ranges of a team have in common, in the order of its entries in a state.

    ``BIAS`` (m) lengthens every range, ``SHADOW`` (m) those that pass through a body, ``LATENESS``
    (s) is by how much ranges are dated late, ``GROWTH`` (m) by how much they grow with distance
    (:func:`growth_slope`).
    """

    BIAS = 0
    SHADOW = 1
    LATENESS = 2
    GROWTH = 3


class Mounting(Protocol):
    """How a node is worn, as ``run.toml`` tells it; None where it does not."""

    @property
    def height_m(self) -> float | None:
        """Height of the tag over the floor where it starts."""

    @property
    def antenna_offset_m(self) -> tuple[float, float] | None:
        """The antenna's place (forward, left) of the point whose motion is reported."""

    @property
    def post(self) -> bool:
        """Whether nobody wears it: it lies still at the command post."""


def tag_height_m(mountings: Mapping[int, Mounting], node: int) -> float:
    """Return the height of a node's tag over the floor where it starts; 0 where none is told."""
    worn = mountings.get(node)
    return (worn.height_m if worn else None) or 0.0


def antenna_m(mountings: Mapping[int, Mounting], node: int) -> tuple[float, float]:
    """Return a node's antenna, forward and left of what moves; in its place where none is told."""
    worn = mountings.get(node)
    return (worn.antenna_offset_m if worn else None) or (0.0, 0.0)


def slant_height(dz_m: Floats, variance_m2: Floats) -> Floats:
    """Return the root mean square of a difference of heights: what makes a range slant."""
    return np.sqrt(dz_m * dz_m + variance_m2)


SIGMA_SLAB_M = 0.3
"""A slab of 0.2 m of concrete makes a range longer by 0.26 to 0.39 m (ITU-R P.2040), an opening not
at all. Building, calm, seeds 300 to 303, without and with it: aligned 3D 0.93 and 0.87 m, distances
of ok pairs beyond three sigmas 2.8 and 1.8 %. A mean of 0.3 m taken off was no better (0.87, 2.1),
and wrong in an atrium."""


def slab_variance(floors: Sequence[tuple[int | None, int | None]]) -> Floats:
    """Return how much less certain ranges between floors are (m^2)."""
    slabs = np.array([0.0 if a is None or b is None else abs(a - b) for a, b in floors])
    return (SIGMA_SLAB_M * slabs) ** 2


def deviations_within(covariance: Floats, entries: Indices) -> Floats:
    """Return deviations (M,) of entries relative to the mean of them all, by a covariance (D, D).

    Of clocks and antennas ranges say how they differ, and no more.
    """
    own = np.eye(len(entries)) - 1.0 / max(len(entries), 1)
    spread = (own @ covariance[np.ix_(entries, entries)] @ own).diagonal()
    return np.sqrt(np.maximum(spread, 0.0))


DELAY_SHARE = 0.5
"""Standard deviation of a tag's antenna delay, relative to that of a pair's part of the bias: both
tags make it. 21 people, 0.3 ranges a second, 45 s, seed 21, no delays: 0.130 m so, 0.132 with 1;
one tag that is off by 0.3 m is found alike."""

CLOCK_SD_S = 0.07
"""Prior standard deviation of each clock's offset. Far larger ones are learned, too. A large team
with 0.03 finds one that is a second off too late (docs/notebook/large-teams.md)."""

GROWTH_SD_M, GROWTH_LEAST_M, GROWTH_USUAL_M = 0.1, 1.0, 5.0
"""A chip's range error depends on the signal's strength, so that ranges grow with the logarithm of
the distance: by about as much as this standard deviation, in metres, for each factor e, and by
nothing at the usual distance. Medians outdoors (``uwb_errors_outdoor``): -0.03 m at 2 m, 0.02 at 4,
0.07 at 8, 0.15 at 16, 0.27 at 32; in seven rooms 0.05 to 0.15 a factor e; recordings of robots 0.1
and -0.05 to -0.2 m. Nearer than the least distance nothing was measured."""

RANGE_SCALE_SD = 0.008
"""Standard deviation of the share of a distance by which ranges may be too long or too short.

Walls every few metres add so much a metre. Steps of unknown length hide it, so that it is not
estimated: distances are reported with it where ranges' biases pass, or are not known pair by pair
(a considered parameter, Schmidt 1966; docs/notebook/missions.md)."""


def growth_slope(distance_m: float) -> float:
    """Return a range's slope in the growth; ``fusion/bank/range_update.py`` has it of lanes."""
    return math.log(max(distance_m, GROWTH_LEAST_M) / GROWTH_USUAL_M)


DECORRELATION_M = 0.45
"""Path length of both nodes together over which a range's error changes. Most of it is multipath,
which belongs to the place and not to the moment: in the recordings of robots, consecutive errors
of one pair correlate by 0.5 at 0.3 m and 0.2 to 0.4 at 0.35 m of common path, by 0.9 and more at
a standstill. At half a second's walking it is next to nothing."""

STILL = 0.9
"""Correlation of two ranges without motion in between: a tenth of the variance is independent."""

PASSING_SHARE, PASSING_M = 1.0, 6.0
"""Variance of a pair's bias that passes, in variances of a range, and the path of both over which
it does: what walls add belongs to the rooms that two people are in. Offices, seeds 0 to 3, NEES
1.61 without any; 1.21 with 1 and 6 m, 1.23 with 3 and 3 m, 1.24 with 3 and 6 m, 1.31 with 3 and
1.5 m."""

TURN_M = 0.2
"""A radian of turning counts as so much path: antenna and body turn along."""

OUTLIERS_SHORT = 0.1
"""Share of the outliers that are too short: a weak first path is detected late, hardly ever early.
P1 with a start shifted by 4 m, seeds 23000 to 23007: .34 m with .02 and .1, .49 with .5."""

OUTLIERS_LAST_S = 30.0
"""What makes a pair's range too long, a wall or a body, may be there for so long."""

GO_ON, GO_ON_RANGES = 0.6, 3.0
"""Prior probability that a pair's outlier is followed by another, worth so many outliers. It is
0.83 at the end of ``mission-nlos``, 0.34 in ``paper`` and ``lab``, where outliers come singly. A
fixed 0.95 gives 0.36 m in ``mission-nlos`` (0.65 without any), but costs 8 % in ``paper``; learned,
it is 0.45 m, and nothing there."""

Vector = tuple[float, float]


def shadow_slope(sight: Vector, heading_rad: float, peer_heading_rad: float) -> float:
    """Return a range's slope in the body's shadow: how far each end is behind the other's wearer.

    ``sight`` is the direction from the node to the peer. The bank's kernels have the same equation
    (``fusion/bank/range_update.py``).
    """
    ahead = sight[0] * math.cos(heading_rad) + sight[1] * math.sin(heading_rad)
    peer_ahead = sight[0] * math.cos(peer_heading_rad) + sight[1] * math.sin(peer_heading_rad)
    return max(-ahead, 0.0) + max(peer_ahead, 0.0)


def common_slopes(
    sight: Vector,
    distance_m: float,
    headings_rad: Sequence[float],
    velocities_m_s: Sequence[Vector],
) -> tuple[float, ...]:
    """Return a range's slopes in what ranges have in common, in the order of ``CommonIndex``.

    Then the peer's velocity along the sight, by which clocks are multiplied. ``sight`` is the
    direction from the node to the peer; the others are the node's and the peer's.
    """
    ends = zip(headings_rad, velocities_m_s, strict=True)
    own, other = (_along(sight, heading, velocity) for heading, velocity in ends)
    return 1.0, shadow_slope(sight, *headings_rad), own - other, growth_slope(distance_m), other


def _along(sight: Vector, heading_rad: float, velocity_m_s: Vector) -> float:
    """Return along ``sight`` the velocity (m/s) of a node, given forward and left."""
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    forward, left = velocity_m_s
    ahead, aside = sight[0] * c + sight[1] * s, sight[1] * c - sight[0] * s
    return ahead * forward + aside * left


ALIKE, AGAIN_M = 0.7, 0.3
"""Of the outliers that go on, this share is as far off as the last one, and how alike they are
(standard deviation). Taken as independent, ten ranges past a wall cost a hypothesis ten times what
one does, and the wrong one that explains them as its place wins (``mission-nlos``, seeds 640 to
643: .43 m, NEES 2.4, 3.7 % of the ok pair-seconds beyond three sigmas; so .30 m, .97, 1.5 %)."""


@dataclass(slots=True)
class OutlierPersistence:
    """How probable an outlier is after the pair's last range, and how far off it is then.

    A two-state Markov chain a pair. Where outliers come singly, one says little of the next; where
    a wall stands in between, nearly all that follow are outliers, too, and as far off. Which it is,
    is learned.
    """

    _last: dict[tuple[int, int], tuple[float, float, float]] = field(default_factory=dict)
    """Pair, the lower node first -> time (s), outlier probability and excess (m) of its last range,
    if that is an outlier."""
    _outliers: float = GO_ON_RANGES
    _followed: float = GO_ON * GO_ON_RANGES

    def _before(self, time_s: float, pair: tuple[int, int]) -> tuple[float, float]:
        """Return the probability that what made the pair's last range an outlier is there still.

        And by how much it is too long.
        """
        last_s, outlier, excess_m = self._last.get((min(pair), max(pair)), (-math.inf, 0.0, 0.0))
        return outlier * math.exp((last_s - time_s) / OUTLIERS_LAST_S), excess_m

    def expected(self, time_s: float, pairs: Iterable[tuple[int, int]]) -> Floats:
        """Return (R, 3): the probability that each is an outlier because the last one was.

        Then the part of it that is as far off as that, and how far that is (m).
        """
        go_on = self._followed / self._outliers
        rows = []
        for pair in pairs:
            before, excess_m = self._before(time_s, pair)
            share = go_on * before
            rows.append((share, ALIKE * share if excess_m > 0.0 else 0.0, excess_m))
        return np.array(rows)

    def learn(
        self, time_s: float, pairs: Iterable[tuple[int, int]], inlier: Floats, excess_m: Floats
    ) -> None:
        """Learn from ranges' inlier probabilities, and excess if they are none (R,)."""
        for pair, good, over_m in zip(pairs, inlier.tolist(), excess_m.tolist(), strict=True):
            # Only what was clearly an outlier says how outliers go on.
            before = self._before(time_s, pair)[0] ** 2
            self._outliers += before
            self._followed += before * (1.0 - good)
            self._last[min(pair), max(pair)] = time_s, 1.0 - good, over_m


class Repeats(NamedTuple):
    """What ranges (R,) repeat of the errors of their pairs' last ones."""

    sample_count: Floats
    """How many independent ranges each counts, within (0, 1].

    With a correlation rho of consecutive errors that is (1 - rho) / (1 + rho), the effective sample
    count of a first-order autoregressive sequence: a hundred ranges between two nodes that stand
    say little more than one.
    """
    kept: Floats
    """What share is left of a bias that passes as users walk, within [0, 1]."""


MOVED_M, ALIKE_ATTEMPTS = 0.3, 40
"""Path of two within which attempts to range are at one place, and how many count there.

What blocks them, or not, stays as the two do. At the least weight that is learned for attempts
(correlation 0.9) twenty count as one. Twice as many, so that no usual pause matters: with none that
counts at rest H2 had 1.42 m for 1.34 (ten seeds), and with 20 and 40 an hour of rest is alike."""

LASTING_FROM, LASTING_COST = 0.02, 30.0
"""Share of the innovations' variance that errors have which last and are not modelled, above which
ranges count less, and by how much: 1 / (1 + cost * excess).

For large teams: without heights on two floors the share is 0.08 to 0.5, elsewhere at most 0.02 (24
people). Chosen on seeds 11 and 12, NEES there with costs of 20, 40 and 80: 1.3, 0.9 and 0.6; seeds
30 to 32 with and without it: ``docs/notebook/large-teams.md``. The bank learns heights instead."""

LASTING_MEAN, LASTING_RANGES, LASTING_MOST = 20.0, 1000.0, 3.0
"""A pair's mean is over so many ranges, the team's share over so many, and innovations count up to
so many standard deviations."""


@dataclass(slots=True)
class RangeCorrelation:
    """What ranges repeat: by the pair's path since its last one, and as far as errors last.

    Where heights are not modelled (large teams), what lasts, such as the slant between floors,
    shows in innovations: the product of a range's with the mean of its pair's earlier ones is the
    variance of what lasts, in the mean over the team.
    """

    _path_m: dict[int, float] = field(default_factory=dict)
    _last_m: dict[tuple[int, int], float] = field(default_factory=dict)
    _attempts: dict[tuple[int, int], tuple[float, int]] = field(default_factory=dict)
    """Pair -> its path when it moved last, and its attempts since."""
    _mean: dict[tuple[int, int], float] = field(default_factory=dict)
    _product: float = 0.0
    _square: float = LASTING_RANGES

    def move(self, node: int, length_m: float, dtheta_rad: float) -> None:
        """Add a displacement to a node's path."""
        length_m += TURN_M * abs(dtheta_rad)
        self._path_m[node] = self._path_m.get(node, 0.0) + length_m

    def repeats(self, pairs: Iterable[tuple[int, int]]) -> Repeats:
        """Add the ranges of one instant; return what they repeat."""
        paths = []
        for node, peer in pairs:
            key = (node, peer) if node < peer else (peer, node)
            now = self._path_m.get(node, 0.0) + self._path_m.get(peer, 0.0)
            paths.append(now - self._last_m.get(key, -math.inf))
            self._last_m[key] = now
        path_m = np.array(paths)
        lasting = max(self._product / self._square - LASTING_FROM, 0.0)
        rho = STILL * np.exp(-path_m / DECORRELATION_M)
        count = np.minimum((1.0 - rho) / (1.0 + rho), 1.0 / (1.0 + LASTING_COST * lasting))
        return Repeats(count, np.exp(-path_m / PASSING_M))

    def tells(self, pairs: Iterable[tuple[int, int]]) -> Bools:
        """Return of which pairs an attempt to range is not one more at the same place."""
        told = []
        for pair in pairs:
            now = self._path_m.get(pair[0], 0.0) + self._path_m.get(pair[1], 0.0)
            since_m, attempts = self._attempts.get(pair, (now, 0))
            if now >= since_m + MOVED_M:
                since_m, attempts = now, 0
            self._attempts[pair] = since_m, attempts + 1
            told.append(attempts < ALIKE_ATTEMPTS)
        return np.array(told, dtype=np.bool_)

    def learn(self, pairs: Iterable[tuple[int, int]], innovation: Floats, inlier: Floats) -> None:
        """Learn from innovations over their deviations, and inlier probabilities (R,)."""
        fade = 1.0 - 1.0 / LASTING_RANGES
        for pair, off, good in zip(pairs, innovation.tolist(), inlier.tolist(), strict=True):
            if good < 0.5:
                continue
            key, now = (min(pair), max(pair)), max(-LASTING_MOST, min(off, LASTING_MOST))
            mean = self._mean.get(key, 0.0)
            self._product = fade * self._product + mean * now
            self._square = fade * self._square + now**2
            self._mean[key] = mean + (now - mean) / LASTING_MEAN
