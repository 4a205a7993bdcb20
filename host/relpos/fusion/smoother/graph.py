"""A whole run as one problem in arrays: the chords of every node and the ranges between them.

The knots are the motion epochs and the start of the run; every node has a pose at every knot. A
range between two knots sees each node where its chord was at that time: the reported way, bent
by what is known of the poses at both ends.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.fusion.models.detection import Round, Rounds
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Timeline
from relpos.measurements import Heading, Height, Measurement, Prior

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

STILL_M = 0.02
"""A chord shorter than this is a standing node's noise: no way, no direction."""

UNKNOWN_M = 1e3
UNKNOWN_RAD = 10.0
"""No knowledge of a start: far above what a run tells, and no trouble for the digits."""


@dataclass(frozen=True)
class Tries:
    """Attempts to range, one round after another: Q attempts in ``rounds``.

    ``slot``, ``share``, ``bend``, ``pair``, ``rise_m`` as of ranges. ``first`` (rounds + 1,) is
    where each round begins; in a round the heard come first, then the silent.
    """

    rounds: tuple[Round, ...]
    first: Integers
    slot: Integers
    share: Floats
    bend: Floats
    pair: Integers
    rise_m: Floats
    silent: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Graph:
    """K knots, N nodes, M ranges; metres, radians, seconds.

    ``node_ids`` (N,). ``time_s`` (K,). Chords (K - 1, N): ``length_m`` and ``direction_rad`` of
    the reported way in the heading frame of its beginning, ``turn_rad``; ``reported_m`` and
    ``reported_rad`` are the standard deviations that the reports bring, 0 where they bring none.
    ``news`` (K - 1, N) tells whether anything was reported. ``follow`` (N,) is the share of a
    turn that its chord follows.

    Ranges (M,): ``slot`` is the chord, ``share`` how far into it in time, ``bend`` (M, 4) where
    the reported way was then beside the straight one (first, second node; in the frame of the
    chord's beginning), ``pair`` (M, 2) rows of nodes, ``pair_index`` into ``pairs`` (P, 2),
    ``rise_m`` the difference of heights. ``antenna_m`` (N, 2): forward, left.

    ``start`` (N, 3) is the prior pose at knot 0, ``start_weight`` its 1 / variances.
    ``compass`` holds (knot, row, heading, 1 / variance) of absolute headings.
    """

    node_ids: tuple[int, ...]
    time_s: Floats
    length_m: Floats
    direction_rad: Floats
    turn_rad: Floats
    reported_m: Floats
    reported_rad: Floats
    news: npt.NDArray[np.bool_]
    follow: Floats
    slot: Integers
    share: Floats
    bend: Floats
    pair: Integers
    pair_index: Integers
    pairs: Integers
    rise_m: Floats
    range_m: Floats
    antenna_m: Floats
    start: Floats
    start_weight: Floats
    tries: Tries
    """Who tried to range whom, and whether in vain."""
    height_m: Floats
    """(K, N) height of every node over its own start, 0 where none is told."""

    @property
    def duration_s(self) -> Floats:
        """Duration of each chord, (K - 1,)."""
        return np.diff(self.time_s)

    def dead_reckoned(self, start: Floats) -> Floats:
        """Compose the reported chords from poses (N, 3): (K, N, 3), headings unwrapped."""
        knots, nodes = self.time_s.size, len(self.node_ids)
        poses = np.empty((knots, nodes, 3))
        poses[0] = start
        poses[1:, :, 2] = start[:, 2] + np.cumsum(self.turn_rad, axis=0)
        angle = poses[:-1, :, 2] + self.direction_rad
        poses[1:, :, 0] = start[:, 0] + np.cumsum(self.length_m * np.cos(angle), axis=0)
        poses[1:, :, 1] = start[:, 1] + np.cumsum(self.length_m * np.sin(angle), axis=0)
        return poses


_Entry = tuple[int, float, int, int, float, float, tuple[float, ...]]
"""Slot, time, node, peer, range, rise, and where both were in their chords."""


@dataclass
class _Builder:
    """Runs the steps of a timeline into lists."""

    heights: dict[int, float]
    partial: dict[int, list[float]] = field(default_factory=dict)
    """Of the open chord: x, y, turn in the frame of its beginning, and variances of both."""
    height_now: dict[int, float] = field(default_factory=dict)
    chords: list[dict[int, list[float]]] = field(default_factory=list)
    heights_at: list[dict[int, float]] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    ranges: list[_Entry] = field(default_factory=list)
    rounds: Rounds = field(default_factory=Rounds)
    tried: list[
        tuple[Round, list[tuple[int, float, int, int, float, float, tuple[float, ...]]]]
    ] = field(default_factory=list)
    seen: set[int] = field(default_factory=set)
    unused_headings: int = 0

    def take(self, step: object, reported_s: Callable[[int], float]) -> None:
        match step:
            case Advance():
                self.seen.add(step.node)
                part = self.partial.setdefault(step.node, [0.0] * 5)
                c, s = math.cos(part[2]), math.sin(part[2])
                part[0] += c * step.dx_m - s * step.dy_m
                part[1] += s * step.dx_m + c * step.dy_m
                part[2] += step.dtheta_rad
                alone = step.sigma_x_m if step.sigma_x_alone_m is None else step.sigma_x_alone_m
                part[3] += (alone or 0.0) ** 2
                part[4] += (step.sigma_theta_rad or 0.0) ** 2
            case Ranging():
                for one in step.ranges:
                    self.seen |= {one.node, one.peer}
                    self.ranges.append(self._entry(step.time_s, one.node, one.peer, one.range_m))
                for done in self.rounds.add(step.time_s, step.ranges, reported_s):
                    entries = [
                        self._entry(step.time_s, node, peer, 0.0)
                        for node, peer in done.received + done.missed
                    ]
                    self.tried.append((done, entries))
            case Sensed(measurement=Height() as height):
                self.height_now[height.node] = height.height_m
            case Sensed(measurement=Heading()):
                self.unused_headings += 1
            case Epoch():
                self.times.append(step.time_s)
                self.chords.append(self.partial)
                self.heights_at.append(dict(self.height_now))
                self.partial = {}

    def _entry(self, time_s: float, node: int, peer: int, range_m: float) -> _Entry:
        places: list[float] = []
        for one in (node, peer):
            places += self.partial.get(one, [0.0, 0.0])[:2]
        rise = self._height(node) - self._height(peer)
        return len(self.times), time_s, node, peer, range_m, rise, tuple(places)

    def _height(self, node: int) -> float:
        return self.heights.get(node, 0.0) + self.height_now.get(node, 0.0)


def build_graph(
    measurements: Iterable[Measurement],
    priors: Sequence[Prior] = (),
    heights_m: Mapping[int, float] | None = None,
    antennas_m: Mapping[int, tuple[float, float]] | None = None,
    *,
    reorder_s: float = 0.5,
    max_lag_s: float = 5.0,
) -> tuple[Graph, Counter[str]]:
    """Put a run's measurements in order, and count what was dropped.

    ``heights_m`` are the tags' known heights, ``antennas_m`` their places on the body. Raises
    RelposError where there is no motion at all.
    """
    timeline = Timeline([p.node for p in priors], reorder_s=reorder_s, max_lag_s=max_lag_s)
    builder = _Builder(dict(heights_m or {}))
    for measurement in measurements:
        for step in timeline.push(measurement):
            builder.take(step, timeline.reported_s)
    for step in timeline.finish():
        builder.take(step, timeline.reported_s)
    counters = Counter(timeline.counters)
    if builder.unused_headings:
        counters["headings_unused"] += builder.unused_headings
    if not builder.times:
        raise RelposError("no motion was received: nothing can be smoothed")
    return _finished(builder, priors, antennas_m or {}, counters), counters


def _finished(
    builder: _Builder,
    priors: Sequence[Prior],
    antennas_m: Mapping[int, tuple[float, float]],
    counters: Counter[str],
) -> Graph:
    names = tuple(sorted(builder.seen | {p.node for p in priors}))
    row = {node: k for k, node in enumerate(names)}
    first_s = min([0.0, *(entry[1] for entry in builder.ranges)])
    if builder.times[0] <= first_s:
        first_s = builder.times[0] - 1.0
    time_s = np.array([first_s, *builder.times])
    slots = time_s.size - 1
    chord = np.zeros((slots, len(names), 5))
    news = np.zeros((slots, len(names)), dtype=bool)
    height = np.zeros((time_s.size, len(names)))
    for k in range(slots):
        for node, values in builder.chords[k].items():
            chord[k, row[node]] = values
            news[k, row[node]] = True
        for node, value in builder.heights_at[k].items():
            height[k + 1, row[node]] = value
    kept = [entry for entry in builder.ranges if entry[0] < slots]
    counters["ranges_after_the_last_motion"] += len(builder.ranges) - len(kept)

    slot, share, bend, pair, rise = _placed(kept, row, time_s, chord)
    tried = [one for one in builder.tried if all(entry[0] < slots for entry in one[1])]
    attempts = [entry for _, entries in tried for entry in entries]
    tries = Tries(
        tuple(done for done, _ in tried),
        np.cumsum([0, *(len(entries) for _, entries in tried)]),
        *_placed(attempts, row, time_s, chord),
        np.array(
            [k >= len(done.received) for done, entries in tried for k in range(len(entries))],
            dtype=bool,
        ),
    )
    ordered = np.sort(pair, axis=1)
    pairs, pair_index = (
        np.unique(ordered, axis=0, return_inverse=True) if len(kept) else (ordered, slot)
    )
    length = np.hypot(chord[..., 0], chord[..., 1])
    direction = np.where(length > 0.0, np.arctan2(chord[..., 1], chord[..., 0]), 0.0)
    start, weight = _start(priors, row)
    antenna = np.zeros((len(names), 2))
    for node, place in antennas_m.items():
        if node in row:
            antenna[row[node]] = place
    return Graph(
        names,
        time_s,
        length,
        direction,
        chord[..., 2].copy(),
        np.sqrt(chord[..., 3]),
        np.sqrt(chord[..., 4]),
        news,
        _follow(length, direction, chord[..., 2]),
        slot,
        share,
        bend,
        pair,
        np.asarray(pair_index, dtype=np.int64).ravel(),
        pairs,
        rise,
        np.array([entry[4] for entry in kept]),
        antenna,
        start,
        weight,
        tries,
        height,
    )


def _placed(
    entries: Sequence[_Entry],
    row: Mapping[int, int],
    time_s: Floats,
    chord: Floats,
) -> tuple[Integers, Floats, Floats, Integers, Floats]:
    """Give slot, share, bend, pair and rise of ranges or attempts."""
    slot = np.array([entry[0] for entry in entries], dtype=np.int64)
    at_s = np.array([entry[1] for entry in entries])
    pair = np.array([(row[e[2]], row[e[3]]) for e in entries], dtype=np.int64).reshape(-1, 2)
    share = np.clip((at_s - time_s[slot]) / (time_s[slot + 1] - time_s[slot]), 0.0, 1.0)
    places = np.array([entry[6] for entry in entries]).reshape(-1, 4)
    ends = np.concatenate((chord[slot, pair[:, 0], :2], chord[slot, pair[:, 1], :2]), axis=1)
    bend = places - share[:, None] * ends
    return slot, share, bend, pair, np.array([entry[5] for entry in entries])


def _start(priors: Sequence[Prior], row: Mapping[int, int]) -> tuple[Floats, Floats]:
    start, weight = np.zeros((len(row), 3)), np.empty((len(row), 3))
    weight[:] = (UNKNOWN_M**-2, UNKNOWN_M**-2, UNKNOWN_RAD**-2)
    for prior in priors:
        k = row[prior.node]
        start[k] = (prior.x_m, prior.y_m, prior.heading_rad)
        # Nobody stands on a point to the millimetre, and exact zeros would spoil the digits.
        sigma = np.clip([prior.sigma_m] * 2 + [prior.sigma_rad], 1e-3, UNKNOWN_M)
        sigma[2] = min(sigma[2], UNKNOWN_RAD)
        weight[k] = sigma**-2
    return start, weight


def _follow(length_m: Floats, direction_rad: Floats, turn_rad: Floats) -> Floats:
    """Which share of its turn a node's chord follows, from the reports themselves, (N,).

    A chord that is walked after the turn points along the whole turn, one that turns evenly
    along half of it. The slope of direction over turn, weighted by length; what turns little
    counts as even. Forwards is presumed: sideways and backwards ways say nothing.
    """
    forwards = (np.abs(direction_rad) < 1.8) & (length_m > STILL_M)
    weight = length_m * forwards
    even = 1e-3
    up = np.sum(weight * direction_rad * turn_rad, axis=0) + 0.5 * even
    down = np.sum(weight * turn_rad**2, axis=0) + even
    share: Floats = np.clip(up / down, 0.0, 1.0)
    return share
