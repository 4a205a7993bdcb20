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
(:mod:`relpos.fusion.rewind` goes back for it instead.)

What shares one instant is handed out in the order of the nodes, however it arrived.

A ``sparing`` timeline advances between epochs only those whom a measurement concerns: of twenty
who range in turns, two in place of twenty at every range. The others' pieces come when they are
needed, at the latest at the next epoch; ``catch_up`` asks for them.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from math import cos, inf, isfinite, nextafter, sin, sqrt
from typing import NamedTuple

from relpos.errors import DataError
from relpos.measurements import Heading, Height, Measurement, Motion, Range


class Advance(NamedTuple):
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

    def copy(self) -> _Track:
        chords = deque(_Chord(c.end_s, c.left, c.share, c.report) for c in self.chords)
        return _Track(self.reported_s, self.reached_s, self.heard, chords)


def refusal(measurement: Measurement) -> str | None:
    """Say why no estimator can use a measurement, as a counter's name; None where it can.

    DataError where a number is not finite: that is no failure of a sensor but of the source.
    """
    # A sum is finite where everything in it is, but for what overflows: that is no measurement.
    if isinstance(measurement, Motion):
        total = measurement.dx_m + measurement.dy_m + measurement.dtheta_rad
    elif isinstance(measurement, Range):
        total = measurement.range_m
    elif isinstance(measurement, Height):
        total = measurement.height_m
    else:
        total = measurement.heading_rad
    if not isfinite(measurement.time_s + total):
        raise DataError(f"a measurement is not a finite number: {measurement}")
    if isinstance(measurement, Range):
        if measurement.range_m <= 0.0:
            return "ranges_failed"
        if measurement.node == measurement.peer:
            return "ranges_to_itself"
    return None


def _range_order(measured: Range) -> tuple[int, int, float]:
    return measured.node, measured.peer, measured.range_m


def _sensed_order(measured: Height | Heading) -> tuple[int, bool, float]:
    if isinstance(measured, Height):
        return measured.node, False, measured.height_m
    return measured.node, True, measured.heading_rad


@dataclass(frozen=True, slots=True)
class Late:
    """Something at ``time_s`` behind the frontier; it should have been known at ``since_s``.

    A displacement belongs to its whole chord; ``since_s`` is -inf where its begin is unknown.
    """

    since_s: float
    time_s: float


@dataclass(slots=True)
class Timeline:
    """See the module's text: ``push`` measurements, work off the steps it returns, ``finish``.

    ``nodes`` are those known beforehand (they are waited for from the start); ``start_s`` is the
    time from which a node's first motion counts; ``reorder_s`` is how long everything is held
    back for what is still under way (in measurement time, so that a recording pays nothing for
    it); ``max_lag_s`` is how long a silent node is waited for; ``sparing`` see above.
    ``counters`` tells what was dropped or came late, by name; with ``keep_late`` ``take_late``
    tells when.
    """

    nodes: Iterable[int] = ()
    start_s: float = 0.0
    reorder_s: float = 0.5
    max_lag_s: float = 5.0
    keep_late: bool = False
    sparing: bool = False
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
    _late: list[Late] = field(default_factory=list)

    def __post_init__(self) -> None:
        for node in self.nodes:
            self._track(node)

    def reported_s(self, node: int) -> float:
        """Time of the node's newest motion; ``-inf`` where it never reported any."""
        track = self._tracks.get(node)
        return track.reported_s if track is not None and track.heard else -inf

    @property
    def frontier_s(self) -> float:
        """Everything up to here has been handed out; ``-inf`` before the first step."""
        return self._frontier_s

    @property
    def newest_s(self) -> float:
        """Time of the newest measurement."""
        return self._newest_s

    def push(self, measurement: Measurement) -> list[Step]:
        """Take one measurement; return what has become certain, in order."""
        reason = refusal(measurement)
        if reason is not None:
            self.counters[reason] += 1
            return []
        return list(self.push_all((measurement,)))

    def push_all(
        self, measurements: Iterable[Measurement], *, final: bool = False
    ) -> Iterator[Step]:
        """Take usable measurements at once (see ``refusal``), then hand out what is certain.

        With ``final`` that is everything. The steps are made as they are asked for; after each
        :class:`Epoch`, and at the end, the timeline may be copied with ``snapshot``.
        """
        for measurement in measurements:
            self._track(measurement.node)
            if isinstance(measurement, Range):
                self._track(measurement.peer)
            self._pushed += 1
            heapq.heappush(self._arrived, (measurement.time_s, self._pushed, measurement))
            self._newest_s = max(self._newest_s, measurement.time_s)
        self._sort_in(inf if final else self._newest_s - self.reorder_s)
        return (
            chain(self._release(final=True), self._end()) if final else self._release(final=False)
        )

    def take_late(self) -> list[Late]:
        """Give, once, what came behind the frontier since it was last asked for.

        Kept only where ``keep_late``.
        """
        late, self._late = self._late, []
        return late

    def snapshot(self) -> Timeline:
        """Give a copy that goes on by itself."""
        return replace(
            self,
            counters=self.counters.copy(),
            _tracks={node: track.copy() for node, track in self._tracks.items()},
            _arrived=self._arrived[:],
            _ordered=self._ordered[:],
            _ranged=self._ranged.copy(),
            _reported=self._reported.copy(),
            _late=self._late[:],
        )

    def finish(self) -> list[Step]:
        """Work off everything that still waits; a last epoch closes the run."""
        return list(self.push_all((), final=True))

    def _end(self) -> Iterator[Step]:
        last = max((t.reported_s for t in self._tracks.values() if t.heard), default=-inf)
        last = max(last, self._frontier_s)
        # A displacement that came late may still lie behind the frontier.
        rest = list(self._advance_all(last))
        yield from rest
        if self._epoch_s > -inf and (rest or last > self._epoch_s):
            self._epoch_s = last
            yield Epoch(last)

    def _track(self, node: int) -> _Track:
        track = self._tracks.get(node)
        if track is None:
            track = self._tracks[node] = _Track(self.start_s, self.start_s)
        return track

    def _sort_in(self, until_s: float) -> None:
        """Give up waiting for anything older than ``until_s``."""
        while self._arrived and self._arrived[0][0] <= until_s:
            entry = heapq.heappop(self._arrived)
            time_s, _, measurement = entry
            if isinstance(measurement, Motion):
                self._take_motion(measurement)
            elif time_s <= self._frontier_s and self.keep_late:
                # Behind the frontier or at it: the rest of its instant was handed out.
                self._late.append(Late(nextafter(time_s, -inf), time_s))
            if not isinstance(measurement, Motion) and time_s < self._frontier_s:
                name = "ranges" if isinstance(measurement, Range) else "sensed"
                self.counters[f"{name}_late"] += 1
                continue
            heapq.heappush(self._ordered, entry)

    def _take_motion(self, motion: Motion) -> None:
        track = self._track(motion.node)
        chord = _Chord(
            motion.time_s, Displacement(motion.dx_m, motion.dy_m, motion.dtheta_rad), 1.0, motion
        )
        chords = track.chords
        begin_s = chords[-1].end_s if chords else track.reached_s
        if begin_s < chord.end_s:
            placed = True
            chords.append(chord)
        else:
            # Its successor came first: before it, unless that was begun already.
            place = sum(waiting.end_s < chord.end_s for waiting in chords)
            placed = bool(chords) and chords[place].share == 1.0 and motion.time_s > track.reached_s
            chords.insert(place if placed else len(chords), chord)
            begin_s = chords[place - 1].end_s if placed and place else track.reached_s
            if not placed:
                begin_s = -inf
        if motion.time_s < self._frontier_s or not placed:
            self.counters["motions_late"] += 1
        if begin_s < self._frontier_s and self.keep_late:
            self._late.append(Late(begin_s, motion.time_s))
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
                        ranges.append(measurement)
                    case _:
                        sensed.append(measurement)
            ranges = self._new(ranges)
            sensed.sort(key=_sensed_order)
            closes = self._closes_epoch(time_s, motions)
            if ranges or sensed or closes:
                time_s = max(time_s, self._frontier_s)
                if closes or not self.sparing:
                    yield from self._advance_all(time_s)
                else:
                    self._frontier_s = time_s
                    concerned = {n for r in ranges for n in (r.node, r.peer)}
                    # A height says nothing of where anybody is.
                    concerned |= {m.node for m in sensed if isinstance(m, Heading)}
                    yield from self.catch_up(concerned, time_s)
            for one in sensed:
                yield Sensed(time_s, one)
            if ranges:
                yield Ranging(time_s, tuple(ranges))
            if closes:
                self._epoch_s = time_s
                yield Epoch(time_s)

    def _new(self, ranges: list[Range]) -> list[Range]:
        """Sort ranges of one instant; leave out what repeats one."""
        ranges.sort(key=_range_order)
        kept = []
        for measured in ranges:
            key = (measured.node, measured.peer)
            if key in self._ranged:
                self.counters["ranges_duplicate"] += 1
            else:
                self._ranged.add(key)
                kept.append(measured)
        return kept

    def _waits_for(self, time_s: float) -> bool:
        # Nothing newer than this has been sorted in, of the node waited for neither.
        sorted_s = self._newest_s - self.reorder_s
        for track in self._tracks.values():
            if track.reported_s < time_s and sorted_s - track.reported_s <= self.max_lag_s:
                return True
        return False

    def _closes_epoch(self, time_s: float, motions: set[int]) -> bool:
        """Whether a round of reports is complete: somebody of this round reports again."""
        if not motions:
            return False
        if time_s > self._epoch_s and (not self._reported or self._reported & motions):
            self._reported = motions
            return True
        self._reported |= motions
        return False

    def catch_up(self, nodes: Iterable[int], time_s: float) -> Iterator[Advance]:
        """Advance some nodes to ``time_s``, at most as far as everything has been handed out."""
        for node in sorted(nodes):
            track = self._tracks.get(node)
            if track is not None:
                yield from _advance(track, node, min(time_s, self._frontier_s))

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
    moved = time_s, node, duration_s, piece.dx_m, piece.dy_m, piece.dtheta_rad, share
    sigmas = (
        report.sigma_x_m, report.sigma_y_m, report.sigma_theta_rad, report.sigma_x_alone_m,
    )  # fmt: skip
    if sigmas == _UNTOLD:
        return Advance(*moved)
    part = sqrt(share)
    return Advance(*moved, *(None if sigma is None else sigma * part for sigma in sigmas))


_UNTOLD = (None, None, None, None)
