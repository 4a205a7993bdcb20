"""What dead reckoning and ranges have reported about the sought nodes since they became unknown.

A :class:`MeasurementLog` keeps a track for each node and the ranges, thinned so that the fits stay
cheap, and lays them out as the :class:`~relpos.fusion.initialisation.kernels.Problem` to be fitted.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats
from relpos.fusion.initial_poses import POSE
from relpos.fusion.initialisation.kernels import Priors, Problem, Ranges, Tracks
from relpos.fusion.timeline import Advance
from relpos.measurements import Range

RANGE_SIGMA_M = 0.25
"""The range's own error, the rest of the pair's bias, and a margin for errors that repeat from
range to range (evidence is the product of them all): of sensors that have just been met."""

_PATH_VARIANCE_M = 0.005
"""Position variance (m^2) per metre of path."""
_TURN_RATE_RAD, _TURN_FRACTION = 0.0175, 0.1
"""Heading error per root second, and per root of a turn's square."""

_CELL_RAD = 0.4
"""Where the data leave a direction open, a hypothesis stands for a cell of this size."""

_MEMORY_S = 240.0
"""So long data count."""

_MOST_KNOTS = 5
_KNOT_RAD = 0.09
"""A knot is set when the heading may have gone wrong by so much (5 degrees) since the last."""

_WIDEST_KNOT_RAD = 0.2
"""Two knots with more heading error than this between them are not merged."""

_MOST_RANGES = 260
_SAME_PLACE_M = 0.1
"""Ranges of two nodes that have moved less than this since their last one repeat it."""

_RELEASED_SIGMA_M = 0.3
"""At most so much of a released node's position error is counted in its past ranges."""

_FAULT_M = 0.3
"""How far a node may have gone while its odometry was faulty."""


class Knot(NamedTuple):
    """A place of the track where the heading may have changed unnoticed."""

    x_m: float
    y_m: float
    variance_rad2: float
    time: int
    """Index into the log's times."""


class KnotChange(NamedTuple):
    """A new knot of a node; ``merged`` is the index of the knot merged into the next, if any."""

    node: int
    knots: int
    """Number of the node's knots before the merge."""
    merged: int | None


@dataclass(slots=True)
class _Track:
    """A node's dead reckoning since it was added, in its own frame."""

    pose: Floats = field(default_factory=lambda: np.zeros(3))
    path_m: float = 0.0
    variance_since_knot: float = 0.0
    knots: list[Knot] = field(default_factory=list)
    samples: list[tuple[float, float, float, float]] = field(default_factory=list)
    """x, y, heading, path length at each of the log's times."""


@dataclass(slots=True)
class _PairRanges:
    """Ranges of one pair from one place; ``places`` (2, 2) of ends that are not sought."""

    time: int
    node: int
    peer: int
    places: Floats
    path_m: tuple[float, float]
    values: list[float]
    height2_m2: float
    extra_m2: float

    @property
    def range_m(self) -> float:
        """Median of the ranges from here."""
        return float(np.median(self.values))


class _Prior(NamedTuple):
    """What was known of a node's pose when it was added, at a time index."""

    time: int
    mean: Floats
    precision: Floats


@dataclass(slots=True)
class MeasurementLog:
    """Tracks and ranges of ``nodes``; ``changed`` is set by whatever a fit has to use."""

    counters: Counter[str]
    nodes: list[int] = field(default_factory=list)
    changed: bool = False
    _tracks: dict[int, _Track] = field(default_factory=dict)
    _priors: dict[int, _Prior] = field(default_factory=dict)
    _times: list[float] = field(default_factory=list)
    _ranges: list[_PairRanges] = field(default_factory=list)
    _newest: dict[tuple[int, int], _PairRanges] = field(default_factory=dict)

    # -- motion --------------------------------------------------------------------------------

    def add(self, node: int, time_s: float, mean: Floats, sigma: Floats) -> None:
        """Log ``node`` from now on; ``mean`` and ``sigma`` (inf: unknown) of its pose now."""
        time = self._time_index(time_s)
        self._tracks[node] = track = _Track()
        track.samples = [(0.0, 0.0, 0.0, 0.0)] * len(self._times)
        floor = (1e-3, 1e-3, 1e-4)
        precision = np.array(
            [0.0 if math.isinf(s) else max(s, f) ** -2 for s, f in zip(sigma, floor, strict=True)]
        )
        self._priors[node] = _Prior(time, mean.copy(), precision)
        self.nodes.append(node)
        self.changed = True

    def advance(self, step: Advance, *, faulty: bool = False) -> KnotChange | None:
        """Move a logged node; others are ignored.

        Of a ``faulty`` displacement only the turn counts; the path becomes as uncertain as
        ``_FAULT_M``.
        """
        track = self._tracks.get(step.node)
        if track is None:
            return None
        if faulty:
            track.path_m += _FAULT_M**2 / _PATH_VARIANCE_M
            step = step._replace(dx_m=0.0, dy_m=0.0)
        length_m = math.hypot(step.dx_m, step.dy_m)
        c, s = math.cos(track.pose[2]), math.sin(track.pose[2])
        track.pose[0] += c * step.dx_m - s * step.dy_m
        track.pose[1] += s * step.dx_m + c * step.dy_m
        track.pose[2] += step.dtheta_rad
        track.path_m += length_m
        if length_m == 0.0 and step.dtheta_rad == 0.0:
            return None
        fraction = max(step.fraction, 1e-9)
        variance = _TURN_RATE_RAD**2 * step.duration_s
        variance += (_TURN_FRACTION * step.dtheta_rad) ** 2 / fraction
        if step.sigma_theta_rad is not None:
            variance = max(variance, step.sigma_theta_rad**2)
        # A node that hardly moves does not lose its heading as one that walks does.
        variance *= min(
            1.0, (length_m + 0.3 * abs(step.dtheta_rad)) / (0.05 * step.duration_s + 1e-9)
        )
        track.variance_since_knot += variance
        if track.variance_since_knot <= _KNOT_RAD**2:
            return None
        x_m, y_m, _ = track.pose
        track.knots.append(Knot(x_m, y_m, track.variance_since_knot, len(self._times)))
        track.variance_since_knot = 0.0
        count = len(track.knots)
        merged = self._merge_knots(step.node, track.knots) if count > _MOST_KNOTS else None
        return KnotChange(step.node, count, merged)

    def _merge_knots(self, node: int, knots: list[Knot]) -> int:
        """Merge the two neighbours with the least error between them; return the older's index.

        Where even they are too different (two corners, say), the two oldest are merged, and the
        node's ranges from before them are dropped: with fewer knots than errors they would bend
        the hypotheses.
        """
        sums = [first.variance_rad2 + second.variance_rad2 for first, second in pairwise(knots)]
        k = int(np.argmin(sums))
        drop = sums[k] > _WIDEST_KNOT_RAD**2
        if drop:
            k = 0
        older, newer = knots[k : k + 2]
        both = older.variance_rad2 + newer.variance_rad2
        knots[k : k + 2] = [newer._replace(variance_rad2=both)]
        if drop:
            kept = [r for r in self._ranges if node not in (r.node, r.peer) or r.time >= newer.time]
            self.counters["start_ranges_forgotten"] += len(self._ranges) - len(kept)
            self._ranges = kept
        return k

    def pose(self, node: int) -> Floats:
        """Return the node's dead-reckoned pose (3,) in the frame of its track."""
        return self._tracks[node].pose

    def extent_m(self, node: int) -> float:
        """Return how far the node has been from where it was added."""
        track = self._tracks[node]
        far = [math.hypot(x, y) for x, y, _, _ in track.samples]
        return max([*far, float(np.hypot(*track.pose[:2]))])

    # -- ranges --------------------------------------------------------------------------------

    def update(
        self,
        time_s: float,
        ranges: Sequence[Range],
        located: Mapping[int, tuple[float, float, float]],
        heights: Mapping[int, float],
    ) -> None:
        """Log the ranges of an instant (:meth:`relpos.fusion.initial_poses.Initialiser.update`).

        Ranges between two located nodes, or to a node of which nothing is known, are ignored.
        """
        tracks = self._tracks
        useful = [
            r for r in ranges
            if (r.node in tracks or r.peer in tracks)
            and all(n in tracks or n in located for n in (r.node, r.peer))
        ]  # fmt: skip
        if not useful:
            return
        time = self._time_index(time_s)
        for r in useful:
            first, second = sorted((r.node, r.peer), key=lambda n: (n not in tracks, n))
            if second in tracks:
                first, second = sorted((first, second), key=self.nodes.index)
            places, paths, extra_m2 = np.zeros((2, 2)), [0.0, 0.0], 0.0
            for end, node in enumerate((first, second)):
                if node in tracks:
                    paths[end] = tracks[node].path_m
                else:
                    x, y, variance = located[node]
                    places[end] = x, y
                    extra_m2 += variance
            height_m = heights.get(first, 0.0) - heights.get(second, 0.0)
            self._log_range(
                _PairRanges(
                    time, first, second, places, (paths[0], paths[1]), [r.range_m],
                    height_m**2, extra_m2,
                )
            )  # fmt: skip
        old = sum(self._times[r.time] < time_s - _MEMORY_S for r in self._ranges)
        if old > 20:
            self._ranges = self._ranges[old:]
            self.counters["start_ranges_forgotten"] += old
            self._drop_unused_times()
        elif len(self._ranges) > _MOST_RANGES:
            self._thin_ranges()

    def _log_range(self, new: _PairRanges) -> None:
        """Keep a range, or add it to the pair's last ones if neither node has moved since."""
        last = self._newest.get((new.node, new.peer))
        if last is not None:
            moved_m = max(
                abs(new.path_m[end] - last.path_m[end])
                if node in self._tracks
                else float(np.hypot(*(new.places[end] - last.places[end])))
                for end, node in enumerate((new.node, new.peer))
            )
            if moved_m < _SAME_PLACE_M:
                last.values += new.values
                self.changed |= len(last.values) <= 4
                return
        self._newest[new.node, new.peer] = new
        self._ranges.append(new)
        self.changed = True

    def _time_index(self, time_s: float) -> int:
        """Return the index of this time; every track is sampled at a new one."""
        if not self._times or time_s > self._times[-1]:
            self._times.append(time_s)
            for track in self._tracks.values():
                x, y, heading = track.pose
                track.samples.append((float(x), float(y), float(heading), track.path_m))
        return len(self._times) - 1

    def _thin_ranges(self) -> None:
        """Drop every other of the older half, pair by pair; the older, the sparser."""
        half = self._ranges[len(self._ranges) // 2].time
        seen: Counter[tuple[int, int]] = Counter()
        kept = []
        for r in self._ranges:
            pair = (r.node, r.peer)
            seen[pair] += 1
            if r.time >= half or seen[pair] % 2 or self._newest.get(pair) is r:
                kept.append(r)
        self.counters["start_ranges_thinned"] += len(self._ranges) - len(kept)
        self._ranges = kept
        self._drop_unused_times()

    def _drop_unused_times(self) -> None:
        """Drop the times that nothing refers to any more."""
        ranges = {id(r): r for r in [*self._ranges, *self._newest.values()]}.values()
        used = sorted(
            {r.time for r in ranges}
            | {p.time for p in self._priors.values()}
            | {len(self._times) - 1}
        )
        index = {old: new for new, old in enumerate(used)}
        self._times = [self._times[t] for t in used]
        for track in self._tracks.values():
            track.samples = [track.samples[t] for t in used]
            track.knots = [k._replace(time=bisect_left(used, k.time)) for k in track.knots]
        for r in ranges:
            r.time = index[r.time]
        self._priors = {n: p._replace(time=index[p.time]) for n, p in self._priors.items()}

    # -- what the data tie together ------------------------------------------------------------

    def tied(self) -> frozenset[int]:
        """Return the nodes that ranges, or a prior, tie to a known place."""
        tied = {n for n in self.nodes if self._priors[n].precision[:2].any()}
        links = [(r.node, r.peer) for r in self._ranges]
        while True:
            more = {
                n
                for a, b in links
                for n, o in ((a, b), (b, a))
                if n in self._tracks and n not in tied and (o in tied or o not in self._tracks)
            }
            if not more:
                return frozenset(tied)
            tied |= more

    def remove(self, nodes: Sequence[int], best: Floats, variances_m2: Floats, turns: int) -> None:
        """Stop logging ``nodes``; in the ranges of others they become fixed places.

        ``best`` (N, 4 + ``turns``) holds the parameters of all logged nodes, ``variances_m2`` (N,)
        their position variances (the sum of both axes).
        """
        problem = self.problem(frozenset(self.nodes), turns, 0.0)
        row = {n: i for i, n in enumerate(self.nodes)}
        for r in self._ranges:
            for end, node in enumerate((r.node, r.peer)):
                if node not in nodes or node not in row:
                    continue
                i = row[node]
                r.places[end] = problem.tracks.place(best[i], i, r.time)
                # Most of a place's error is common to all places of a track, and to all tracks.
                path_m = self._tracks[node].path_m - r.path_m[end]
                r.extra_m2 += _PATH_VARIANCE_M * path_m
                r.extra_m2 += min(0.5 * float(variances_m2[i]), _RELEASED_SIGMA_M**2)
            if r.node in nodes and r.peer not in nodes:
                # The sought end comes first.
                r.node, r.peer = r.peer, r.node
                r.places = r.places[::-1].copy()
                r.path_m = (r.path_m[1], r.path_m[0])
        self.nodes = [n for n in self.nodes if n not in nodes]
        for node in nodes:
            del self._tracks[node], self._priors[node]
        self._newest = {}
        self._ranges = [r for r in self._ranges if {r.node, r.peer} & set(self.nodes)]
        self.changed = True

    # -- the problem to be fitted --------------------------------------------------------------

    def problem(self, active: frozenset[int], turns: int, range_sigma_m: float) -> Problem:
        """Lay out tracks, priors and ranges of the ``active`` nodes, ``turns`` turns a node."""
        nodes, length = len(self.nodes), len(self._times)
        tracks = Tracks(
            np.zeros((length, nodes, 3)), np.zeros((length, nodes), dtype=np.intp),
            np.zeros((turns + 1, nodes, 2)), np.ones((turns, nodes)),
        )  # fmt: skip
        priors = Priors(np.zeros(nodes, dtype=np.intp), np.zeros((nodes, 3)), np.zeros((nodes, 3)))
        paths_m = np.zeros((length, nodes))
        for i, node in enumerate(self.nodes):
            track = self._tracks[node]
            samples = np.array(track.samples)
            c, s = math.cos(track.pose[2]), math.sin(track.pose[2])
            off = samples[:, :2] - track.pose[:2]
            tracks.poses[:, i, 0] = c * off[:, 0] + s * off[:, 1]
            tracks.poses[:, i, 1] = c * off[:, 1] - s * off[:, 0]
            tracks.poses[:, i, 2] = samples[:, 2] - track.pose[2]
            paths_m[:, i] = track.path_m - samples[:, 3]
            for k, knot in enumerate(reversed(track.knots)):
                dx, dy = knot.x_m - track.pose[0], knot.y_m - track.pose[1]
                tracks.knots[k + 1, i] = c * dx + s * dy, c * dy - s * dx
                tracks.turn_variance[k, i] = knot.variance_rad2
                tracks.segments[: knot.time, i] += 1
            tracks.knots[len(track.knots) + 1 :, i] = tracks.knots[len(track.knots), i]
            priors.at[i], priors.mean[i], precision = self._priors[node]
            priors.precision[i] = precision if node in active else 1e-6
            if node in active and precision[0] > 0.0:
                # The error of the path since then is not in the track's parameters.
                grown = _PATH_VARIANCE_M * paths_m[priors.at[i], i]
                priors.precision[i, :2] = 1.0 / (1.0 / precision[:2] + grown)
        ranges = self._range_arrays(active, paths_m, range_sigma_m)
        # A cell is as long as an arc of the largest circle that the node is on stays straight.
        cell = np.full((nodes, POSE), _CELL_RAD)
        for i in range(nodes):
            own = ranges.range_m[(ranges.ends == i).any(axis=1)]
            cell[i, :2] *= max(1.0, float(own.max()) if own.size else 0.0)
        return Problem(tracks, priors, ranges, cell.ravel())

    def _range_arrays(
        self, active: frozenset[int], paths_m: Floats, range_sigma_m: float
    ) -> Ranges:
        row = {n: i for i, n in enumerate(self.nodes)}
        used = [
            r for r in self._ranges
            if all(n in active or n not in row for n in (r.node, r.peer))
        ]  # fmt: skip
        ends = np.array([(row.get(r.node, -1), row.get(r.peer, -1)) for r in used], dtype=np.intp)
        ends = ends.reshape(-1, 2)
        # The kernel fills one triangle: of two sought ends the first comes first.
        turned = (ends[:, 1] >= 0) & (ends[:, 0] > ends[:, 1])
        ends[turned] = ends[turned, ::-1]
        at = np.array([r.time for r in used], dtype=np.intp)
        range_m = np.array([r.range_m for r in used])
        count = np.array([len(r.values) for r in used], dtype=float)
        variance = range_sigma_m**2 / np.minimum(count, 2.0)
        variance += np.array([r.extra_m2 for r in used])
        for end in range(2):
            sought = ends[:, end] >= 0
            variance[sought] += _PATH_VARIANCE_M * paths_m[at[sought], ends[sought, end]]
        return Ranges(
            ends, at, range_m, variance, np.array([r.height2_m2 for r in used]),
            range_m < 1.5 * range_sigma_m,
            np.array([r.places for r in used]).reshape(-1, 2, 2),
        )  # fmt: skip
