"""Puts the asynchronous reports of many nodes into one exact order in time.

Every node reports its displacement with its own phase: a motion at ``t`` covers the chord from
the node's previous motion to ``t``. A range at a time in between concerns the middle of a chord.
The timeline holds each chord back until its end is known, cuts it where something else happens
(uniform translation and turn within a chord) and hands out steps such that

* when a :class:`Ranging` at ``t`` appears, every node that is still reporting has been advanced
  exactly to ``t``;
* the pieces of a chord compose to exactly the reported displacement, whatever cut them.

Waiting is bounded: a node that does not report for ``max_lag_s`` is no longer waited for, and
its displacement is handed out whole when it comes after all. What arrives too late to be put in
its place is counted and, where it is not a displacement, dropped; a displacement is never lost.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from math import cos, inf, isfinite, sin, sqrt

from relpos.errors import DataError
from relpos.measurements import Heading, Height, Measurement, Motion, Range


@dataclass(frozen=True, slots=True)
class Advance:
    """A node's displacement over ``duration_s`` up to ``time_s``.

    ``dx_m``, ``dy_m`` are in the node's heading frame at the beginning of this piece;
    ``fraction`` is the piece's share of the reported chord, so that a noise that is proportional
    to the chord can be split without changing its sum. ``sigma_*`` are the report's own standard
    deviations, already scaled to this piece (independent pieces add up to the report's).
    """

    time_s: float
    node: int
    duration_s: float
    dx_m: float
    dy_m: float
    dtheta_rad: float
    fraction: float = 1.0
    sigma_x_m: float | None = None
    sigma_y_m: float | None = None
    sigma_theta_rad: float | None = None
    sigma_x_alone_m: float | None = None


@dataclass(frozen=True, slots=True)
class Ranging:
    """All accepted ranges of one instant, after the advances up to it."""

    time_s: float
    ranges: tuple[Range, ...]


@dataclass(frozen=True, slots=True)
class Sensed:
    """A height or a heading, after the advances up to its time."""

    time_s: float
    measurement: Height | Heading


@dataclass(frozen=True, slots=True)
class Epoch:
    """A motion epoch: every node that reports has been advanced to ``time_s``."""

    time_s: float


Step = Advance | Ranging | Sensed | Epoch


@dataclass(frozen=True, slots=True)
class Displacement:
    """A displacement in the heading frame of its own beginning."""

    dx_m: float
    dy_m: float
    dtheta_rad: float

    def split(self, fraction: float) -> tuple[Displacement, Displacement]:
        """Cut after ``fraction`` of the chord; the parts compose to the whole exactly."""
        turned = fraction * self.dtheta_rad
        c, s = cos(turned), sin(turned)
        rest_x, rest_y = (1.0 - fraction) * self.dx_m, (1.0 - fraction) * self.dy_m
        return (
            Displacement(fraction * self.dx_m, fraction * self.dy_m, turned),
            Displacement(
                c * rest_x + s * rest_y, c * rest_y - s * rest_x, self.dtheta_rad - turned
            ),
        )


@dataclass(slots=True)
class _Chord:
    """What is left of one report: from the node's reached time to ``end_s``."""

    end_s: float
    left: Displacement
    share: float
    report: Motion


@dataclass(slots=True)
class _Track:
    """How far one node has reported, and how far it has been advanced."""

    reported_s: float
    reached_s: float
    heard: bool = False
    chords: deque[_Chord] = field(default_factory=deque)


@dataclass(slots=True)
class Timeline:
    """See the module's text: ``push`` measurements, work off the steps it returns, ``finish``.

    ``nodes`` are those known beforehand (they are waited for from the start); ``start_s`` is the
    time from which a node's first motion counts; ``reorder_s`` is how long everything is held
    back for what is still under way (in measurement time, so that a recording pays nothing for
    it); ``max_lag_s`` is how long a silent node is waited for. ``counters`` tells what was
    dropped or came late, by name.
    """

    nodes: Iterable[int] = ()
    start_s: float = 0.0
    reorder_s: float = 0.5
    max_lag_s: float = 5.0
    counters: Counter[str] = field(default_factory=Counter)
    _tracks: dict[int, _Track] = field(default_factory=dict)
    _arrived: list[tuple[float, int, Measurement]] = field(default_factory=list)
    _ordered: list[tuple[float, int, Measurement]] = field(default_factory=list)
    _pushed: int = 0
    _newest_s: float = -inf
    _frontier_s: float = -inf
    _ranged: set[tuple[int, int]] = field(default_factory=set)
    _reported: set[int] = field(default_factory=set)
    _epoch_s: float = -inf

    def __post_init__(self) -> None:
        for node in self.nodes:
            self._track(node)

    def reported_s(self, node: int) -> float:
        """Time of the node's newest motion; ``-inf`` where it never reported any."""
        track = self._tracks.get(node)
        return track.reported_s if track is not None and track.heard else -inf

    def push(self, measurement: Measurement) -> list[Step]:
        """Take one measurement; return what has become certain, in order."""
        if not self._usable(measurement):
            return []
        self._pushed += 1
        heapq.heappush(self._arrived, (measurement.time_s, self._pushed, measurement))
        self._newest_s = max(self._newest_s, measurement.time_s)
        self._sort_in(self._newest_s - self.reorder_s)
        return list(self._release(final=False))

    def finish(self) -> list[Step]:
        """Work off everything that still waits; a last epoch closes the run."""
        self._sort_in(inf)
        steps = list(self._release(final=True))
        last = max((t.reported_s for t in self._tracks.values() if t.heard), default=-inf)
        last = max(last, self._frontier_s)
        # A displacement that came late may still lie behind the frontier.
        rest = list(self._advance_all(last))
        steps += rest
        if self._epoch_s > -inf and (rest or last > self._epoch_s):
            steps.append(Epoch(last))
            self._epoch_s = last
        return steps

    def _track(self, node: int) -> _Track:
        track = self._tracks.get(node)
        if track is None:
            track = self._tracks[node] = _Track(self.start_s, self.start_s)
        return track

    def _usable(self, measurement: Measurement) -> bool:
        """Refuse what no estimator can use: failures and repetitions are counted, not fatal."""
        numbers: tuple[float, ...]
        match measurement:
            case Motion():
                numbers = (measurement.dx_m, measurement.dy_m, measurement.dtheta_rad)
            case Range():
                numbers = (measurement.range_m,)
            case Height():
                numbers = (measurement.height_m,)
            case Heading():
                numbers = (measurement.heading_rad,)
        if not isfinite(measurement.time_s) or not all(map(isfinite, numbers)):
            raise DataError(f"a measurement is not a finite number: {measurement}")
        if isinstance(measurement, Range):
            if measurement.range_m <= 0.0:
                self.counters["ranges_failed"] += 1
                return False
            if measurement.node == measurement.peer:
                self.counters["ranges_to_itself"] += 1
                return False
            self._track(measurement.peer)
        self._track(measurement.node)
        return True

    def _sort_in(self, until_s: float) -> None:
        """Give up waiting for anything older than ``until_s``."""
        while self._arrived and self._arrived[0][0] <= until_s:
            entry = heapq.heappop(self._arrived)
            time_s, _, measurement = entry
            if isinstance(measurement, Motion):
                self._take_motion(measurement)
            elif time_s < self._frontier_s:
                name = "ranges" if isinstance(measurement, Range) else "sensed"
                self.counters[f"{name}_late"] += 1
                continue
            heapq.heappush(self._ordered, entry)

    def _take_motion(self, motion: Motion) -> None:
        track = self._track(motion.node)
        chord = _Chord(
            motion.time_s, Displacement(motion.dx_m, motion.dy_m, motion.dtheta_rad), 1.0, motion
        )
        track.chords.append(chord)
        if motion.time_s < self._frontier_s or (track.heard and motion.time_s <= track.reported_s):
            self.counters["motions_late"] += 1
        if not track.heard:
            # A run may begin a little before zero: then nothing is known before the first motion.
            track.reached_s = min(track.reached_s, motion.time_s)
            track.reported_s = track.reached_s
            track.heard = True
        track.reported_s = max(track.reported_s, motion.time_s)

    def _release(self, *, final: bool) -> Iterator[Step]:
        while self._ordered:
            time_s = self._ordered[0][0]
            if not final and self._waits_for(time_s):
                return
            motions: set[int] = set()
            ranges: list[Range] = []
            sensed: list[Height | Heading] = []
            if time_s > self._frontier_s:
                self._ranged.clear()
            while self._ordered and self._ordered[0][0] == time_s:
                measurement = heapq.heappop(self._ordered)[2]
                match measurement:
                    case Motion():
                        motions.add(measurement.node)
                    case Range():
                        key = (measurement.node, measurement.peer)
                        if key in self._ranged:
                            self.counters["ranges_duplicate"] += 1
                        else:
                            self._ranged.add(key)
                            ranges.append(measurement)
                    case _:
                        sensed.append(measurement)
            closes = self._closes_epoch(time_s, motions)
            if ranges or sensed or closes:
                time_s = max(time_s, self._frontier_s)
                yield from self._advance_all(time_s)
            for one in sensed:
                yield Sensed(time_s, one)
            if ranges:
                yield Ranging(time_s, tuple(ranges))
            if closes:
                self._epoch_s = time_s
                yield Epoch(time_s)

    def _waits_for(self, time_s: float) -> bool:
        return any(
            track.reported_s < time_s and self._newest_s - track.reported_s <= self.max_lag_s
            for track in self._tracks.values()
        )

    def _closes_epoch(self, time_s: float, motions: set[int]) -> bool:
        """Whether a round of reports is complete: somebody of this round reports again."""
        if not motions:
            return False
        if time_s > self._epoch_s and (not self._reported or self._reported & motions):
            self._reported = motions
            return True
        self._reported |= motions
        return False

    def _advance_all(self, time_s: float) -> Iterator[Advance]:
        self._frontier_s = max(self._frontier_s, time_s)
        for node in sorted(self._tracks):
            yield from _advance(self._tracks[node], node, time_s)


def _advance(track: _Track, node: int, until_s: float) -> Iterator[Advance]:
    while track.chords:
        chord = track.chords[0]
        length_s = chord.end_s - track.reached_s
        if chord.end_s <= until_s:
            track.chords.popleft()
            piece, share = chord.left, chord.share
            # A motion that comes after its successor has no time left of its own: only its
            # displacement counts.
            duration_s, track.reached_s = max(length_s, 0.0), max(track.reached_s, chord.end_s)
        elif until_s <= track.reached_s:
            return
        else:
            duration_s = until_s - track.reached_s
            cut = duration_s / length_s
            piece, chord.left = chord.left.split(cut)
            share = cut * chord.share
            chord.share -= share
            track.reached_s = until_s
        yield _piece(
            until_s if chord.end_s > until_s else chord.end_s,
            node,
            duration_s,
            piece,
            share,
            chord.report,
        )


def _piece(
    time_s: float, node: int, duration_s: float, piece: Displacement, share: float, report: Motion
) -> Advance:
    def part(sigma: float | None) -> float | None:
        return None if sigma is None else sigma * sqrt(share)

    return Advance(
        time_s,
        node,
        duration_s,
        piece.dx_m,
        piece.dy_m,
        piece.dtheta_rad,
        share,
        part(report.sigma_x_m),
        part(report.sigma_y_m),
        part(report.sigma_theta_rad),
        part(report.sigma_x_alone_m),
    )
