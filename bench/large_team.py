"""The filter for large teams beside the dense joint filter: error, honesty, time.

    python bench/large_team.py [--nodes 200] [--seeds 8] [--seconds 120] [--no-dense] [--first 0]

A crowd with eight neighbours each (`crowd.py`), both filters with known noise.
The dense one works range by range, to second order, over all 3 N states, compiled. Distance RMSE
and NEES of pairs in reach (ranged at that instant) and of all pairs; processor time of an epoch
(two motions, some 4 N ranges) as the median and mean over the epochs.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from crowd import Crowd, CrowdSettings, simulate_crowd
from relpos.evaluation.metrics import aligned_squared_distances
from relpos.fusion.compiled import compiled
from relpos.fusion.large_teams.kernels import RangeModel, Ranges
from relpos.fusion.large_teams.sparse_filter import NeighbourhoodFilter

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

ALL_PAIRS = 20_000
"""Of more pairs than this so many are drawn."""


class Filter(Protocol):
    """What is compared."""

    def predict(self, moved: Floats) -> None:
        """Move everybody: displacements and sigmas (N, 6)."""

    def update(self, node: Indices, peer: Indices, measured: Floats) -> None:
        """Work in the ranges of one instant."""

    def pose(self) -> Floats:
        """Poses (N, 3)."""

    def variance(self, node: Indices, peer: Indices) -> Floats:
        """Variances of the pairs' distances."""


class Strips:
    """The filter that is judged."""

    def __init__(self, crowd: Crowd) -> None:
        count = crowd.settings.nodes
        self.filter = NeighbourhoodFilter(
            1.05 * crowd.settings.max_range_m, RangeModel(crowd.settings.sigma_range_m)
        )
        self.filter.add(crowd.poses[0].copy(), np.zeros((count, 3, 3)))
        self.everybody = np.arange(count)

    def predict(self, moved: Floats) -> None:
        """Move everybody."""
        self.filter.predict(self.everybody, np.pad(moved, ((0, 0), (0, 1))))

    def update(self, node: Indices, peer: Indices, measured: Floats) -> None:
        """Work in the ranges."""
        count, terms = len(node), len(self.filter.terms)
        level, same, no_outliers, no_slopes = (
            np.zeros(count),
            np.ones(count),
            np.zeros((count, 3)),
            np.zeros((count, terms)),
        )
        self.filter.update(Ranges(node, peer, measured, level, same, level, no_outliers, no_slopes))

    def pose(self) -> Floats:
        """Poses."""
        return self.filter.pose

    def variance(self, node: Indices, peer: Indices) -> Floats:
        """Far pairs by the chain."""
        return along(self.filter._dense().reshape(len(self.everybody), 5, -1, 5),
                     self.filter.pose, node, peer)  # fmt: skip


class Dense:
    """The reference: covariance (3, N, 3, N), range by range."""

    def __init__(self, crowd: Crowd) -> None:
        self.count = crowd.settings.nodes
        self.x = crowd.poses[0].T.copy()
        self.p = np.zeros((3 * self.count, 3 * self.count))
        self.variance_m2 = crowd.settings.sigma_range_m**2

    def predict(self, moved: Floats) -> None:
        """Move everybody."""
        dense_predict(self.x, self.p, moved)

    def update(self, node: Indices, peer: Indices, measured: Floats) -> None:
        """Work in the ranges, one after another."""
        dense_update(self.x, self.p, node, peer, measured, self.variance_m2)

    def pose(self) -> Floats:
        """Poses."""
        return self.x.T

    def variance(self, node: Indices, peer: Indices) -> Floats:
        """As it stands."""
        whole = self.p.reshape(3, self.count, 3, self.count).transpose(1, 0, 3, 2)
        return along(whole, self.x.T, node, peer)


def along(whole: Floats, pose: Floats, node: Indices, peer: Indices) -> Floats:
    """Variance of pairs' distances from a covariance (N, 3, N, 3)."""
    off = pose[peer, :2] - pose[node, :2]
    u = off / np.hypot(off[:, 0], off[:, 1])[:, None]
    total = np.zeros(node.size)
    for a, b, sign in ((node, node, 1), (peer, peer, 1), (node, peer, -1), (peer, node, -1)):
        for p in range(2):
            for q in range(2):
                total += sign * u[:, p] * u[:, q] * whole[a, p, b, q]
    return total


@compiled
def dense_predict(x: Floats, p: Floats, moved: Floats) -> None:
    """First order, turn's noise before the displacement; x (3, N), P in x, y, heading of all."""
    n = x.shape[1]
    east, north = np.empty(n), np.empty(n)
    for i in range(n):
        p[2 * n + i, 2 * n + i] += moved[i, 5] ** 2
        c, s = math.cos(x[2, i]), math.sin(x[2, i])
        east[i] = c * moved[i, 0] - s * moved[i, 1]
        north[i] = s * moved[i, 0] + c * moved[i, 1]
    for i in range(n):
        for k in range(3 * n):
            p[i, k] -= north[i] * p[2 * n + i, k]
            p[n + i, k] += east[i] * p[2 * n + i, k]
    for k in range(3 * n):
        for i in range(n):
            p[k, i] -= north[i] * p[k, 2 * n + i]
            p[k, n + i] += east[i] * p[k, 2 * n + i]
    for i in range(n):
        c, s = math.cos(x[2, i]), math.sin(x[2, i])
        f, g = moved[i, 3] ** 2, moved[i, 4] ** 2
        p[i, i] += c * c * f + s * s * g
        p[n + i, n + i] += s * s * f + c * c * g
        p[i, n + i] += c * s * (f - g)
        p[n + i, i] += c * s * (f - g)
        x[0, i] += east[i]
        x[1, i] += north[i]
        x[2, i] += moved[i, 2]


@compiled
def dense_update(
    x: Floats, p: Floats, node: Indices, peer: Indices, measured: Floats, variance_m2: float
) -> None:
    """Second-order update by each range in turn."""
    n = x.shape[1]
    g = np.empty(3 * n)
    for e in range(len(node)):
        i, j = node[e], peer[e]
        dx, dy = x[0, j] - x[0, i], x[1, j] - x[1, i]
        d = math.sqrt(dx * dx + dy * dy) + 1e-9
        ux, uy = dx / d, dy / d
        for k in range(3 * n):
            g[k] = ux * (p[j, k] - p[i, k]) + uy * (p[n + j, k] - p[n + i, k])
        forth = ux * (g[j] - g[i]) + uy * (g[n + j] - g[n + i])
        both = p[i, i] + p[j, j] - 2.0 * p[i, j]
        both += p[n + i, n + i] + p[n + j, n + j] - 2.0 * p[n + i, n + j]
        across = max(both - forth, 0.0)
        s = forth + variance_m2 + 0.5 * (across / d) ** 2
        step = (measured[e] - d - 0.5 * across / d) / s
        for k in range(n):
            x[0, k] += step * g[k]
            x[1, k] += step * g[n + k]
            x[2, k] += step * g[2 * n + k]
        for k in range(3 * n):
            f = g[k] / s
            for q in range(3 * n):
                p[k, q] -= f * g[q]


@dataclass
class Tally:
    """What one run gathers."""

    near: list[float] = field(default_factory=list)
    every: list[float] = field(default_factory=list)
    aligned: list[float] = field(default_factory=list)
    nees_near: list[float] = field(default_factory=list)
    nees_every: list[float] = field(default_factory=list)
    epoch_ms: list[float] = field(default_factory=list)


def play(crowd: Crowd, made: Filter) -> Tally:
    """One run."""
    count = crowd.settings.nodes
    one, two = np.triu_indices(count, 1)
    if one.size > ALL_PAIRS:
        some = np.random.default_rng(0).choice(one.size, ALL_PAIRS, replace=False)
        one, two = one[some], two[some]
    tally, spent, every = Tally(), 0.0, crowd.settings.range_period_s
    for t, motion in enumerate(crowd.motions, 1):
        moved = np.concatenate([motion, crowd.sigmas[t - 1]], axis=1)
        begin = time.process_time()
        made.predict(moved)
        spent += time.process_time() - begin
        if t % every:
            continue
        at = slice(crowd.first[t // every - 1], crowd.first[t // every])
        node, peer, measured = crowd.node[at], crowd.peer[at], crowd.range_m[at]
        begin = time.process_time()
        made.update(node, peer, measured)
        tally.epoch_ms.append(1e3 * (spent + time.process_time() - begin))
        spent = 0.0
        pose, truth = made.pose(), crowd.poses[t]
        for a, b, error, nees in (
            (node, peer, tally.near, tally.nees_near),
            (one, two, tally.every, tally.nees_every),
        ):
            there = np.hypot(*(pose[a, :2] - pose[b, :2]).T)
            square = (there - np.hypot(*(truth[a, :2] - truth[b, :2]).T)) ** 2
            error.append(float(square.mean()))
            nees.append(float((square / made.variance(a, b)).mean()))
        tally.aligned.append(float(aligned_squared_distances(pose[:, :2], truth[:, :2]).mean()))
    return tally


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--nodes", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=int, default=120)
    parser.add_argument("--detection", type=float, default=1.0)
    parser.add_argument("--no-dense", action="store_true")
    given = parser.parse_args()
    makers: dict[str, Callable[[Crowd], Filter]] = {"strips": Strips}
    if not given.no_dense:
        makers["dense"] = Dense
    settings = CrowdSettings(
        nodes=given.nodes, seconds=given.seconds, detection=given.detection,
        neighbours=8.0 / given.detection,
    )  # fmt: skip
    print(f"N {given.nodes}, {given.seeds} runs of {given.seconds} s")
    print("seed filter  near m  all m   aligned m  NEES near  all    ms median  mean  us a range")
    totals: dict[str, list[list[float]]] = {name: [] for name in makers}
    for seed in range(given.first, given.first + given.seeds):
        crowd = simulate_crowd(settings, seed)
        ranges = len(crowd.range_m) / (len(crowd.first) - 1)
        for name, make in makers.items():
            tally = play(crowd, make(crowd))
            root = [math.sqrt(np.mean(v)) for v in (tally.near, tally.every, tally.aligned)]
            row = [*root, float(np.mean(tally.nees_near)), float(np.mean(tally.nees_every)),
                   float(np.median(tally.epoch_ms)), float(np.mean(tally.epoch_ms[1:])),
                   1e3 * float(np.median(tally.epoch_ms)) / ranges]  # fmt: skip
            totals[name].append(row)
            print_row(f"{seed:4}", name, row)
    for name, rows in totals.items():
        print_row("mean", name, list(np.mean(rows, axis=0)))


def print_row(label: str, name: str, row: list[float]) -> None:
    """One line."""
    print(
        f"{label} {name:7} {row[0]:6.4f}  {row[1]:6.4f}  {row[2]:6.4f}     "
        f"{row[3]:5.2f}      {row[4]:5.2f}  {row[5]:8.2f}   {row[6]:6.2f}  {row[7]:6.2f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
