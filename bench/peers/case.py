"""The measurements that all contenders get, as arrays, and how they are scored."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from relpos.evaluation.metrics import aligned_squared_distances
from relpos.measurements import Measurement, Motion, Prior, Range
from relpos.simulation.paper import DISTANCE_NOISE, HEADING_PATTERN, settings_of, simulate_paper

sys.path.insert(0, str(Path(__file__).parents[1]))
from crowd import CrowdSettings, simulate_crowd

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

FLOOR_M, FLOOR_RAD = 1e-3, 1e-3
"""A user who waits has no noise at all; solvers that invert covariances need some. Same for all."""


@dataclass(frozen=True)
class Instant:
    """The ranges of one time: rows of nodes (E,), metres."""

    node: Indices
    peer: Indices
    range_m: Floats


@dataclass(frozen=True)
class Case:
    """T motions a second apart, ranges after every second one; noise as all filters know it.

    ``motions``, ``sigmas`` (T, N, 3): forward, left, turn and their standard deviations (along the
    path it is the step's, across it nothing but the floor); ``ranges[t]`` after motion t or None;
    ``truth`` (T + 1, N, 3).
    """

    name: str
    motions: Floats
    sigmas: Floats
    ranges: tuple[Instant | None, ...]
    truth: Floats
    sigma_range_m: float
    measurements: tuple[Measurement, ...]
    priors: tuple[Prior, ...]

    @property
    def nodes(self) -> int:
        """N."""
        return int(self.motions.shape[1])

    @property
    def epochs(self) -> int:
        """How many instants have ranges."""
        return sum(r is not None for r in self.ranges)

    def instants(self) -> Iterator[tuple[Floats, Floats, Instant | None]]:
        """Motion, its sigmas, and the ranges after it."""
        return zip(self.motions, self.sigmas, self.ranges, strict=True)


def _sigmas(truth: Floats, distance_noise: Floats, turn_noise: Floats) -> Floats:
    """Noise follows the true step and turn: one measured as next to nothing is not exact."""
    way = np.linalg.norm(np.diff(truth[..., :2], axis=0), axis=-1)
    turn = np.abs((np.diff(truth[..., 2], axis=0) + math.pi) % (2.0 * math.pi) - math.pi)
    forward = np.hypot(way * distance_noise, FLOOR_M)
    return np.stack(
        [forward, np.full_like(way, FLOOR_M), np.hypot(turn * turn_noise, FLOOR_RAD)], axis=-1
    )


def paper_case(scenario: str, seed: int, seconds: int) -> Case:
    """Six users of the paper's simulation (``paper``: sigma 1 m, ``paper-p1``: 0.1 m)."""
    settings = settings_of(scenario, {"seconds": seconds})
    run = simulate_paper(scenario, seed, {"seconds": seconds})
    count = settings.nodes
    motions = np.zeros((seconds, count, 3))
    ranges_at: dict[int, list[Range]] = {}
    for m in run.measurements:
        if isinstance(m, Motion):
            motions[round(m.time_s) - 1, m.node - 1] = m.dx_m, m.dy_m, m.dtheta_rad
        elif isinstance(m, Range):
            ranges_at.setdefault(round(m.time_s) - 1, []).append(m)
    truth = np.zeros((seconds + 1, count, 3))
    for row in run.truth:
        truth[round(row.time_s), row.node - 1] = row.x_m, row.y_m, row.heading_rad or 0.0
    pattern = np.array(HEADING_PATTERN)
    return Case(
        scenario,
        motions,
        _sigmas(truth, np.array(DISTANCE_NOISE), settings.turn_noise * pattern / pattern.mean()),
        tuple(_instant(ranges_at.get(t)) for t in range(seconds)),
        truth,
        settings.sigma_range_m,
        run.measurements,
        run.priors,
    )


def _instant(ranges: list[Range] | None) -> Instant | None:
    if not ranges:
        return None
    return Instant(
        np.array([r.node - 1 for r in ranges]),
        np.array([r.peer - 1 for r in ranges]),
        np.array([r.range_m for r in ranges]),
    )


def crowd_case(nodes: int, seed: int, seconds: int) -> Case:
    """Any number of users, eight neighbours each, noise as in ``paper-p1``."""
    settings = CrowdSettings(nodes=nodes, seconds=seconds, neighbours=min(8.0, 0.9 * (nodes - 1)))
    crowd = simulate_crowd(settings, seed)
    ranges: list[Instant | None] = [None] * seconds
    for k in range(len(crowd.first) - 1):
        at = slice(crowd.first[k], crowd.first[k + 1])
        if at.stop > at.start:
            ranges[2 * k + 1] = Instant(crowd.node[at], crowd.peer[at], crowd.range_m[at])
    return Case(
        f"crowd-{nodes}",
        crowd.motions,
        np.stack(
            [
                np.hypot(np.hypot(crowd.sigmas[..., 0], crowd.sigmas[..., 1]), FLOOR_M),
                np.full(crowd.sigmas.shape[:2], FLOOR_M),
                np.hypot(crowd.sigmas[..., 2], FLOOR_RAD),
            ],
            axis=-1,
        ),
        tuple(ranges),
        crowd.poses,
        settings.sigma_range_m,
        tuple(crowd.measurements()),
        crowd.priors(),
    )


class Filter(Protocol):
    """What a contender that works on line has to offer; a fresh one for every run."""

    def predict(self, motion: Floats, sigma: Floats) -> None:
        """Move everybody: (N, 3), (N, 3)."""

    def update(self, ranges: Instant) -> None:
        """Work in the ranges of one instant."""

    def positions(self) -> Floats:
        """Estimated positions (N, 2)."""


@dataclass(frozen=True)
class Score:
    """One contender on one case."""

    distance_m: float
    aligned_m: float
    epoch_us: float


def score(case: Case, estimated: Floats, epoch_us: float) -> Score:
    """Distance RMSE over all pairs and aligned RMSE of positions (T, N, 2), run format's."""
    one, two = np.triu_indices(case.nodes, 1)
    distance, aligned = 0.0, 0.0
    for at, truth in zip(estimated, case.truth[1:], strict=True):
        there = np.hypot(*(at[one] - at[two]).T)
        really = np.hypot(*(truth[one, :2] - truth[two, :2]).T)
        distance += float(np.mean((there - really) ** 2))
        aligned += float(np.mean(aligned_squared_distances(at, truth[:, :2])))
    steps = len(estimated)
    return Score(math.sqrt(distance / steps), math.sqrt(aligned / steps), epoch_us)


def run_filter(case: Case, make: Callable[[Case, int], Filter], seed: int) -> Score:
    """Play a case; the time is the median epoch's: two predictions and the ranges."""
    contender = make(case, seed)
    estimated = np.empty((len(case.motions), case.nodes, 2))
    spent, times = 0.0, []
    for t, (motion, sigma, ranges) in enumerate(case.instants()):
        begin = time.process_time()
        contender.predict(motion, sigma)
        if ranges is not None:
            contender.update(ranges)
        spent += time.process_time() - begin
        if ranges is not None:
            times.append(spent)
            spent = 0.0
        estimated[t] = contender.positions()
    return score(case, estimated, 1e6 * float(np.median(times)))
