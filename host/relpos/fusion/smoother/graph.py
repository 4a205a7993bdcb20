"""A whole run as one problem in arrays: the chords of every node and the ranges between them.

The knots are the motion epochs and the start of the run; every node has a pose at every knot. A
range between two knots sees each node where its chord was at that time: on the reported path,
moved along with the poses at both ends.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from relpos.errors import RelposError
from relpos.fusion.arrays import Bools, Floats, Indices
from relpos.fusion.models.detection import Round, Rounds, on_one_floor
from relpos.fusion.models.motion import known_sigmas, unseen_variance
from relpos.fusion.models.ranging import Mounting, antenna_m, tag_height_m
from relpos.fusion.smoother.as_learned import Rises
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Timeline
from relpos.measurements import Height, Measurement, Prior

STILL_M = 0.02
"""A chord shorter than this is a standing node's noise: no path, no direction."""

GAP = 2.5
"""A report that lasts so many times the node's usual one covers a gap."""

SCALE_PART_S, MOST_SCALE_PARTS = 120.0, 10
"""A node has one step scale for so long (s), or for longer, so that a run has at most so many."""

PARTS = 8
"""Figures of an open chord."""

UNKNOWN_M = 1e3
UNKNOWN_RAD = 10.0
"""Standard deviations of an unknown start: far above what a run tells, and no trouble for the
digits."""


class Chords(NamedTuple):
    """The reported displacements between consecutive knots, (K - 1, N) each."""

    duration_s: Floats
    """(K - 1,)"""
    length_m: Floats
    direction_rad: Floats
    """In the heading frame of the chord's beginning."""
    turn_rad: Floats
    turn_share: Floats
    """(N,) share of its turn that a node's chord follows: 1 where it turns first, then walks."""
    scale_at: Indices
    """(K - 1,) where the chords' step scales begin among the constants, one of each node."""


class Ranges(NamedTuple):
    """M distances between nodes, measured or attempted."""

    chord: Indices
    """(M,) the chords in which they lie."""
    pair: Indices
    """(M, 2) rows of nodes."""
    fraction: Floats
    """(M,) how far into the chord in time."""
    offset_m: Floats
    """(M, 4) path less straight chord (x, y of the first node, then of the second), in the heading
    frame of the chord's beginning."""
    antenna_m: Floats
    """(N, 2) forward, left."""
    dz_m: Floats
    """(M,) difference of heights."""
    pair_index: Indices
    """(M,) index of the pair's bias; -1 for a distance without biases."""


@dataclass(frozen=True)
class Attempts:
    """Q attempts to range, one round after another; in a round the received come first."""

    rounds: tuple[Round, ...]
    first: Indices
    """(rounds + 1,) where each round begins."""
    ranges: Ranges
    missed: Bools


@dataclass(frozen=True)
class Graph:
    """K knots, N nodes, M ranges; metres, radians, seconds."""

    node_ids: tuple[int, ...]
    time_s: Floats
    """(K,)"""
    chords: Chords
    usual_length_m: Floats
    """(K - 1, N) mean over the walked chords around each."""
    walks: Bools
    """(K - 1, N) whether a chord is longer than ``STILL_M``."""
    sigma_m: Floats
    sigma_rad: Floats
    """(K - 1, N) reported standard deviations of chords, 0 where none are."""
    unseen_m2: Floats
    """(K - 1, N) variance of each coordinate of what a node may have walked beside its path, where
    one report covers several of the usual ones, the sum of a gap, or none came any more."""
    reports: Floats
    """(K - 1, N) in how many reports' parts a chord lies, in equal parts: 1 for a whole report, 2
    for two halves. The noise of consecutive chords is correlated where reports are parted."""
    has_report: Bools
    """(K - 1, N)"""
    ranges: Ranges
    range_m: Floats
    """(M,) as measured."""
    pairs: Indices
    """(P, 2) rows of the pairs that ``ranges.pair_index`` counts."""
    attempts: Attempts
    prior: Floats
    prior_weight: Floats
    """(N, 3) pose at knot 0 and 1 / its variances."""
    height_m: Floats
    """(K, N) height of every node over its own start, 0 where none is measured."""

    def independent_constants(self) -> Floats:
        """Return the matrix (G, G) that makes independent quantities of the constants.

        Scales walk at random from one part of the run to the next; in their place are their steps,
        by the square root of a part's time (s). All others are independent as they are.
        """
        nodes, first = len(self.node_ids), int(self.chords.scale_at[0])
        count = int(self.chords.scale_at[-1]) + nodes
        parts = (count - first) // nodes
        result = np.eye(count) - np.eye(count, k=-nodes)
        result[: first + nodes] = np.eye(first + nodes, count)
        result[first + nodes :] /= math.sqrt((self.time_s[-1] - self.time_s[0]) / parts)
        return result

    def dead_reckoned(self, start: Floats) -> Floats:
        """Compose the reported chords from poses (N, 3): (K, N, 3), headings unwrapped."""
        knots, nodes = self.time_s.size, len(self.node_ids)
        poses = np.empty((knots, nodes, 3))
        poses[0] = start
        _, length_m, direction_rad, turn_rad, _, _ = self.chords
        poses[1:, :, 2] = start[:, 2] + np.cumsum(turn_rad, axis=0)
        angle = poses[:-1, :, 2] + direction_rad
        poses[1:, :, 0] = start[:, 0] + np.cumsum(length_m * np.cos(angle), axis=0)
        poses[1:, :, 1] = start[:, 1] + np.cumsum(length_m * np.sin(angle), axis=0)
        return poses


class _Entry(NamedTuple):
    """One range or attempt; ``places_m`` is where both nodes were in their chords."""

    chord: int
    time_s: float
    node: int
    peer: int
    range_m: float
    dz_m: float
    places_m: tuple[float, ...]


@dataclass
class _Builder:
    """Runs the steps of a timeline into lists."""

    mountings: Mapping[int, Mounting]
    rises: Rises
    partial: dict[int, list[float]] = field(default_factory=dict)
    """Of the open chord: x, y, turn in the frame of its beginning, variances of both, the
    longest duration (s) of a report in it, the sum of the shares of reports, and that of their
    squares."""
    height_now: dict[int, float] = field(default_factory=dict)
    chords: list[dict[int, list[float]]] = field(default_factory=list)
    heights_at: list[dict[int, float]] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    ranges: list[_Entry] = field(default_factory=list)
    rounds: Rounds = field(default_factory=Rounds)
    attempts: list[tuple[Round, list[_Entry]]] = field(default_factory=list)
    seen: set[int] = field(default_factory=set)
    unused: Counter[str] = field(default_factory=Counter)

    def add(self, step: object, reported_s: Callable[[int], float]) -> None:
        match step:
            case Advance():
                self.seen.add(step.node)
                part = self.partial.setdefault(step.node, [0.0] * PARTS)
                c, s = math.cos(part[2]), math.sin(part[2])
                part[0] += c * step.dx_m - s * step.dy_m
                part[1] += s * step.dx_m + c * step.dy_m
                part[2] += step.dtheta_rad
                along_m, _, turn_rad = known_sigmas(step)
                part[3] += along_m**2
                part[4] += turn_rad**2
                part[5] = max(part[5], step.duration_s / max(step.fraction, 1e-9))
                part[6] += step.fraction
                part[7] += step.fraction**2
            case Ranging():
                for one in step.ranges:
                    self.seen |= {one.node, one.peer}
                    self.ranges.append(self._entry(step.time_s, one.node, one.peer, one.range_m))
                for done in self.rounds.add(
                    step.time_s, step.ranges, reported_s, self._on_one_floor
                ):
                    entries = [
                        self._entry(step.time_s, node, peer, 0.0)
                        for node, peer in done.received + done.missed
                    ]
                    self.attempts.append((done, entries))
            case Sensed(measurement=Height() as height):
                self.height_now[height.node] = height.height_m
            case Sensed():
                self.unused[step.unused] += 1
            case Epoch():
                self.times.append(step.time_s)
                self.chords.append(self.partial)
                self.heights_at.append(dict(self.height_now))
                self.partial = {}

    def _entry(self, time_s: float, node: int, peer: int, range_m: float) -> _Entry:
        places: list[float] = []
        for one in (node, peer):
            places += self.partial.get(one, [0.0, 0.0])[:2]
        reported_m = self._height(node) - self._height(peer)
        dz_m = math.hypot(reported_m, self.rises.rise_m(node, peer, time_s))
        return _Entry(len(self.times), time_s, node, peer, range_m, dz_m, tuple(places))

    def _on_one_floor(self, pairs: Sequence[tuple[int, int]]) -> Bools:
        dz_m = np.array([self._height(a) - self._height(b) for a, b in pairs])
        return on_one_floor(dz_m, np.zeros(dz_m.size))

    def _height(self, node: int) -> float:
        return tag_height_m(self.mountings, node) + self.height_now.get(node, 0.0)


def build_graph(
    measurements: Iterable[Measurement],
    priors: Sequence[Prior] = (),
    mountings: Mapping[int, Mounting] | None = None,
    rises: Rises | None = None,
) -> tuple[Graph, Counter[str]]:
    """Put a run's measurements in order, and count what smoothing does not use.

    ``rises`` are differences of height beside what is measured.
    Raises RelposError where there is no motion at all.
    """
    timeline = Timeline([p.node for p in priors], max_lag_s=math.inf)
    builder = _Builder(mountings or {}, rises or Rises({}))
    for measurement in measurements:
        for step in timeline.push(measurement):
            builder.add(step, timeline.reported_s)
    for step in timeline.finish():
        builder.add(step, timeline.reported_s)
    if not builder.times:
        raise RelposError("no motion was received: nothing can be smoothed")
    return _finished(builder, priors, timeline.start_s), builder.unused


def _finished(builder: _Builder, priors: Sequence[Prior], start_s: float) -> Graph:
    names = tuple(sorted(builder.seen | {p.node for p in priors}))
    row = {node: k for k, node in enumerate(names)}
    first_s = min([start_s, *(entry.time_s for entry in builder.ranges)])
    if builder.times[0] <= first_s:
        first_s = builder.times[0] - 1.0
    time_s = np.array([first_s, *builder.times])
    slots = time_s.size - 1
    chord = np.zeros((slots, len(names), PARTS))
    has_report = np.zeros((slots, len(names)), dtype=bool)
    height = np.zeros((time_s.size, len(names)))
    for k in range(slots):
        for node, values in builder.chords[k].items():
            chord[k, row[node]] = values
            has_report[k, row[node]] = True
        for node, value in builder.heights_at[k].items():
            height[k + 1, row[node]] = value
    kept = [entry for entry in builder.ranges if entry.chord < slots]
    builder.unused["ranges_after_the_last_motion"] += len(builder.ranges) - len(kept)

    length = np.hypot(chord[..., 0], chord[..., 1])
    direction = np.where(length > 0.0, np.arctan2(chord[..., 1], chord[..., 0]), 0.0)
    turn = chord[..., 2].copy()
    walks = length > STILL_M
    antenna = np.array([antenna_m(builder.mountings, node) for node in names], dtype=np.float64)
    ranges = _placed(kept, row, time_s, chord, antenna)
    ordered = np.sort(ranges.pair, axis=1)
    pairs, pair_index = (
        np.unique(ordered, axis=0, return_inverse=True) if kept else (ordered, ranges.chord)
    )
    prior, weight = _prior(priors, row)
    return Graph(
        names,
        time_s,
        Chords(
            np.diff(time_s),
            length,
            direction,
            turn,
            _turn_share(length, direction, turn),
            len(names) + 2 + len(pairs) + len(names) * _scale_parts(time_s),
        ),
        _usual_length(length, walks),
        walks,
        np.sqrt(chord[..., 3]),
        np.sqrt(chord[..., 4]),
        _unseen(np.diff(time_s), chord[..., 5], has_report),
        chord[..., 6] / np.where(has_report, chord[..., 7], 1.0) + ~has_report,
        has_report,
        ranges._replace(pair_index=np.asarray(pair_index, dtype=np.int64).ravel()),
        np.array([entry.range_m for entry in kept]),
        pairs,
        _attempts(builder, row, time_s, chord, antenna),
        prior,
        weight,
        height,
    )


def _scale_parts(time_s: Floats) -> Indices:
    """Return in which part of the run, 0 and up, every chord lies."""
    whole_s = time_s[-1] - time_s[0]
    parts = min(math.ceil(whole_s / SCALE_PART_S), MOST_SCALE_PARTS)
    part: Indices = ((time_s[:-1] - time_s[0]) * (parts / whole_s)).astype(np.int64)
    return part


def _attempts(
    builder: _Builder, row: Mapping[int, int], time_s: Floats, chord: Floats, antenna_m: Floats
) -> Attempts:
    inside = [
        one for one in builder.attempts if all(entry.chord < time_s.size - 1 for entry in one[1])
    ]
    entries = [entry for _, every in inside for entry in every]
    return Attempts(
        tuple(done for done, _ in inside),
        np.cumsum([0, *(len(every) for _, every in inside)]),
        _placed(entries, row, time_s, chord, antenna_m),
        np.array(
            [k >= len(done.received) for done, every in inside for k in range(len(every))],
            dtype=bool,
        ),
    )


def _placed(
    entries: Sequence[_Entry],
    row: Mapping[int, int],
    time_s: Floats,
    chord: Floats,
    antenna_m: Floats,
) -> Ranges:
    """Lay out ranges or attempts in arrays, without biases."""
    slot = np.array([entry.chord for entry in entries], dtype=np.int64)
    at_s = np.array([entry.time_s for entry in entries])
    pair = np.array([(row[e.node], row[e.peer]) for e in entries], dtype=np.int64).reshape(-1, 2)
    fraction = np.clip((at_s - time_s[slot]) / (time_s[slot + 1] - time_s[slot]), 0.0, 1.0)
    places = np.array([entry.places_m for entry in entries]).reshape(-1, 4)
    ends = np.concatenate((chord[slot, pair[:, 0], :2], chord[slot, pair[:, 1], :2]), axis=1)
    offset = places - fraction[:, None] * ends
    dz_m = np.array([entry.dz_m for entry in entries])
    return Ranges(slot, pair, fraction, offset, antenna_m, dz_m, np.full(slot.size, -1))


def _unseen(duration_s: Floats, report_s: Floats, has_report: Bools) -> Floats:
    """Return ``Graph.unseen_m2`` for the longest report of each chord, (K - 1, N)."""
    usual_s = np.array(
        [np.median(own[has]) if has.any() else math.inf
         for own, has in zip(report_s.T, has_report.T, strict=True)]
    )  # fmt: skip
    walked_m2 = 0.5 * np.array([unseen_variance(s) for s in duration_s])
    ended = has_report.any(axis=0) & ~np.logical_or.accumulate(has_report[::-1], axis=0)[::-1]
    return np.where((report_s > GAP * usual_s) | ended, walked_m2[:, None], 0.0)


def _usual_length(length_m: Floats, walks: Bools) -> Floats:
    """Mean length of the walked chords around each, (K - 1, N); as reported for a standing one.

    A chord that happened to be reported too short is not more certain than its neighbours.
    """
    half = 3
    kernel = np.ones(2 * half + 1)
    total = np.empty_like(length_m)
    for i in range(length_m.shape[1]):
        count = np.convolve(walks[:, i].astype(float), kernel, mode="full")[half:-half]
        summed = np.convolve(length_m[:, i] * walks[:, i], kernel, mode="full")[half:-half]
        total[:, i] = summed / np.maximum(count, 1.0)
    return np.where(walks, total, length_m)


def _prior(priors: Sequence[Prior], row: Mapping[int, int]) -> tuple[Floats, Floats]:
    pose, weight = np.zeros((len(row), 3)), np.empty((len(row), 3))
    weight[:] = (UNKNOWN_M**-2, UNKNOWN_M**-2, UNKNOWN_RAD**-2)
    for prior in priors:
        k = row[prior.node]
        pose[k] = (prior.x_m, prior.y_m, prior.heading_rad)
        # No start is exact to the millimetre, and zeros would spoil the digits.
        sigma = np.clip([prior.sigma_m] * 2 + [prior.sigma_rad], 1e-3, UNKNOWN_M)
        sigma[2] = min(sigma[2], UNKNOWN_RAD)
        weight[k] = sigma**-2
    return pose, weight


def _turn_share(length_m: Floats, direction_rad: Floats, turn_rad: Floats) -> Floats:
    """Share of its turn that a node's chord follows, (N,), from the reports themselves.

    A chord that is walked after the turn points along the whole turn, one that turns evenly
    along half of it. The slope of direction over turn, weighted by length; what turns little
    counts as even. Only forward motion is used.
    """
    forwards = (np.abs(direction_rad) < 1.8) & (length_m > STILL_M)
    weight = length_m * forwards
    even = 1e-3
    up = np.sum(weight * direction_rad * turn_rad, axis=0) + 0.5 * even
    down = np.sum(weight * turn_rad**2, axis=0) + even
    share: Floats = np.clip(up / down, 0.0, 1.0)
    return share
