"""Many people in one hall whose radios reach only those near them, as arrays.

Everybody walks straight legs of random length and turns on the spot between them, as in the
paper's rectangle (:mod:`relpos.simulation.paper`), inside a square that is as large as it has to be
for everybody to have ``neighbours`` others within ``max_range_m`` on average. Noise is that of the
paper's scenario with sigma 0.1 m: relative errors of every step's length and of every turn, by
the same six levels. Made in arrays, so that a thousand users cost a second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from relpos.measurements import Measurement, Motion, Prior, Range, Truth
from relpos.simulation.paper import DISTANCE_NOISE, HEADING_PATTERN

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

MARGIN_M = 0.5
"""Least distance of a path from a wall."""


@dataclass(frozen=True, slots=True)
class CrowdSettings:
    """Motion and sensor errors of a crowd (metres, seconds, radians).

    ``turn_noise`` is the mean over the six levels of the relative error of a turn, ``neighbours``
    the mean number of others within ``max_range_m``; each of them is received with
    probability ``detection``.
    """

    nodes: int = 200
    seconds: float = 120.0
    neighbours: float = 8.0
    max_range_m: float = 15.0
    detection: float = 1.0
    sigma_range_m: float = 0.1
    speed_m_s: float = 0.5
    leg_min_m: float = 5.0
    leg_max_m: float = 20.0
    turn_noise: float = 0.18
    range_period_s: int = 2
    nlos_probability: float = 0.0


@dataclass(frozen=True, slots=True)
class Crowd:
    """A crowd's measurements and truth; motions once a second, T of them.

    ``poses`` (T + 1, N, 3) is the truth, ``motions`` (T, N, 3) forward, left, turn as measured.
    The ranges of all instants stand one after the other, those of instant k from ``first[k]`` to
    ``first[k + 1]``: ``node`` and ``peer`` (E,) count from 0, ``range_m`` (E,). ``sigmas``
    (T, N, 3) are the motions' standard deviations, for filters that use them: forward and
    left (the step's own along its direction), turn. They follow from the truth: a turn that was
    measured as next to nothing is not exact.
    """

    settings: CrowdSettings
    side_m: float
    poses: Floats
    motions: Floats
    first: Indices
    node: Indices
    peer: Indices
    range_m: Floats
    sigmas: Floats

    def priors(self) -> tuple[Prior, ...]:
        """Everybody's start, exactly; node ids count from 1."""
        return tuple(Prior(i + 1, *map(float, pose)) for i, pose in enumerate(self.poses[0]))

    def measurements(self) -> list[Measurement]:
        """All measurements in the order of time; motions before ranges of the same time."""
        result: list[Measurement] = []
        every = self.settings.range_period_s
        for t, moved in enumerate(self.motions.tolist(), 1):
            result += [Motion(float(t), i + 1, *row) for i, row in enumerate(moved)]
            if t % every:
                continue
            k = slice(self.first[t // every - 1], self.first[t // every])
            rows = zip(
                self.node[k].tolist(), self.peer[k].tolist(), self.range_m[k].tolist(), strict=True
            )
            result += [Range(float(t), i + 1, j + 1, r) for i, j, r in rows]
        return result

    def truth(self) -> tuple[Truth, ...]:
        """Everybody's pose at every second."""
        return tuple(
            Truth(float(t), i + 1, x, y, math.remainder(heading, 2.0 * math.pi))
            for t, row in enumerate(self.poses.tolist())
            for i, (x, y, heading) in enumerate(row)
        )


def side_of(nodes: int, neighbours: float, max_range_m: float) -> float:
    """Side of the square in which uniformly spread nodes have so many neighbours on average.

    The probability that two points of a unit square are within r <= 1 of each other is
    pi r^2 - 8 r^3 / 3 + r^4 / 2 (the walls cut the discs).
    """
    wanted = neighbours / (nodes - 1)
    low, high = 0.0, 1.0
    for _ in range(60):
        r = 0.5 * (low + high)
        if math.pi * r**2 - 8.0 * r**3 / 3.0 + r**4 / 2.0 < wanted:
            low = r
        else:
            high = r
    return max_range_m / high


def simulate_crowd(settings: CrowdSettings, seed: int = 0) -> Crowd:
    """Measurements and truth of one run; the same arguments give the same run."""
    path_rng, noise_rng, range_rng = (
        np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)
    )
    side = max(side_of(settings.nodes, settings.neighbours, settings.max_range_m), 4 * MARGIN_M)
    poses = _walk(settings, side, path_rng)
    levels = np.arange(settings.nodes) % len(DISTANCE_NOISE)
    pattern = np.array(HEADING_PATTERN)
    distance_noise = np.array(DISTANCE_NOISE)[levels]
    turn_noise = settings.turn_noise * (pattern / pattern.mean())[levels]
    turn = np.diff(poses[:, :, 2], axis=0)
    distance = np.linalg.norm(np.diff(poses[:, :, :2], axis=0), axis=2)
    spread = np.stack([distance * distance_noise, np.abs(turn) * turn_noise])
    distance *= 1.0 + distance_noise * noise_rng.standard_normal(distance.shape)
    turn *= 1.0 + turn_noise * noise_rng.standard_normal(turn.shape)
    motions = np.stack([distance * np.cos(turn), distance * np.sin(turn), turn], axis=2)
    sigmas = np.stack(
        [np.abs(np.cos(turn)) * spread[0], np.abs(np.sin(turn)) * spread[0], spread[1]], axis=2
    )

    first = [0]
    nodes: list[Indices] = []
    peers: list[Indices] = []
    ranges: list[Floats] = []
    for t in range(settings.range_period_s, len(poses), settings.range_period_s):
        i, j, d = _near(poses[t, :, :2], settings.max_range_m)
        received = range_rng.random(d.shape) < settings.detection
        i, j, d = i[received], j[received], d[received]
        late = range_rng.random(d.shape) < settings.nlos_probability
        d += settings.sigma_range_m * range_rng.standard_normal(d.shape)
        d += late * range_rng.uniform(2.0, 6.0, d.shape)
        nodes.append(i)
        peers.append(j)
        ranges.append(np.abs(d))
        first.append(first[-1] + len(d))
    none = np.empty(0, dtype=np.intp)
    return Crowd(
        settings, side, poses, motions, np.array(first), np.concatenate([none, *nodes]),
        np.concatenate([none, *peers]), np.concatenate([np.empty(0), *ranges]), sigmas,
    )  # fmt: skip


def _walk(settings: CrowdSettings, side_m: float, rng: np.random.Generator) -> Floats:
    """Poses (T + 1, N, 3), once a second: whole seconds straight on, a turn between two legs."""
    steps, count = int(settings.seconds), settings.nodes
    step_m = settings.speed_m_s
    low, high = MARGIN_M, side_m - MARGIN_M
    poses = np.empty((steps + 1, count, 3))
    poses[0, :, :2] = rng.uniform(low, high, (count, 2))
    poses[0, :, 2] = rng.uniform(-math.pi, math.pi, count)
    left = np.zeros(count)
    for t in range(steps):
        here, heading = poses[t, :, :2], poses[t, :, 2].copy()
        turning = left < step_m
        # Of some directions the first whose whole leg stays inside; else back to the middle.
        legs = rng.uniform(settings.leg_min_m, settings.leg_max_m, (8, count))
        turns = rng.uniform(-0.5 * math.pi, 0.5 * math.pi, (8, count))
        to = heading + turns
        ends = here[:, 0] + legs * np.cos(to), here[:, 1] + legs * np.sin(to)
        fits = np.all([(e > low) & (e < high) for e in ends], axis=0)
        pick, column = fits.argmax(axis=0), np.arange(count)
        back = np.arctan2(0.5 * side_m - here[:, 1], 0.5 * side_m - here[:, 0])
        back = (back - heading + math.pi) % (2.0 * math.pi) - math.pi
        good = fits.any(axis=0)
        heading += np.where(turning, np.where(good, turns[pick, column], back), 0.0)
        new_leg = np.where(good, legs[pick, column], settings.leg_min_m)
        left = np.where(turning, new_leg, left) - step_m
        poses[t + 1, :, 0] = here[:, 0] + step_m * np.cos(heading)
        poses[t + 1, :, 1] = here[:, 1] + step_m * np.sin(heading)
        poses[t + 1, :, 2] = heading
        np.clip(poses[t + 1, :, :2], 0.0, side_m, out=poses[t + 1, :, :2])
    return poses


def _near(position_m: Floats, reach_m: float) -> tuple[Indices, Indices, Floats]:
    """All i < j within reach of each other, with their distances."""
    off = position_m[:, None, :] - position_m
    squared = np.einsum("ijk,ijk->ij", off, off)
    i, j = np.nonzero(np.triu(squared < reach_m * reach_m, 1))
    return i, j, np.sqrt(squared[i, j])
