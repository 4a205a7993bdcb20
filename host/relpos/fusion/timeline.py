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

With lazy propagation (``lazy``) only the nodes that a measurement concerns are advanced between
epochs: of twenty that range in turns, two in place of twenty at every range. The others' pieces
come when they are needed, at the latest at the next epoch; ``catch_up`` asks for them.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from math import cos, inf, isfinite, nextafter, sin, sqrt
from operator import attrgetter, itemgetter
from typing import NamedTuple

from relpos.errors import DataError
from relpos.measurements import (
    MEASUREMENTS,
    Height,
    Measurement,
    Motion,
    Range,
    Reading,
    nodes_of,
    out_of_bounds,
)


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
    steps: float | None = None
    """The piece's share of the steps."""


@dataclass(frozen=True, slots=True)
class Ranging:
    """All accepted ranges of one instant, after the advances up to it."""

    time_s: float
    ranges: tuple[Range, ...]


@dataclass(frozen=True, slots=True)
class Sensed:
    """A node's reading, after the advances up to its time."""

    time_s: float
    measurement: Reading

    @property
    def unused(self) -> str:
        """Name of the counter where an estimator has no use for it."""
        return f"{type(self.measurement).__name__.lower()}s_unused"


@dataclass(frozen=True, slots=True)
class Epoch:
    """A motion epoch: every node that reports has been advanced to ``time_s``."""

    time_s: float


Step = Advance | Ranging | Sensed | Epoch

REMEMBERED = 64
"""So many reports of a node are known again when they come twice."""

LATEST_BEGIN_S = 60.0
"""Times that begin later count from somewhere else than the start, as the time of day does."""


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
class _Track:
    """How far one node has reported, and how far it has been advanced."""

    reported_s: float
    reached_s: float
    has_reported: bool = False
    chords: deque[Motion] = field(default_factory=deque)
    """Reports that wait, from the node's reached time on."""
    left: tuple[Displacement, float] | None = None
    """What is left of the first one, and its share of it; None where that is all."""
    recent: deque[Motion] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    """The reports that came last."""

    def copy(self) -> _Track:
        return replace(self, chords=self.chords.copy(), recent=self.recent.copy())


def refusal(measurement: Measurement) -> str | None:
    """Say why no estimator can use a measurement, as a counter's name; None where it can.

    DataError where it is none, or a number is not finite: that is no failure of a sensor but of
    the source.
    """
    if type(measurement) not in MEASUREMENTS:
        kinds = ", ".join(kind.__name__ for kind in MEASUREMENTS)
        raise DataError(f"{measurement!r} is no measurement: one of {kinds}")
    try:
        for node in (measurement.node, getattr(measurement, "peer", 0)):
            if not 0 <= node == node // 1:
                raise DataError(f"{node} is no node id: {measurement}")
        name = out_of_bounds(measurement)
    except TypeError:
        raise DataError(f"a measurement has something else than a number: {measurement}") from None
    if name is not None:
        if not isfinite(getattr(measurement, name)):
            raise DataError(f"a measurement is not a finite number: {measurement}")
        return "beyond_bounds"
    if isinstance(measurement, Range):
        if measurement.range_m <= 0.0:
            return "ranges_failed"
        if measurement.node == measurement.peer:
            return "ranges_to_itself"
    return None


_range_order = attrgetter("node", "peer", "range_m")


def _sensed_order(measured: Reading) -> tuple[int, int, str]:
    # Any fixed order will do for what one node reads twice at one time.
    return measured.node, MEASUREMENTS.index(type(measured)), repr(measured)


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
    it); ``max_lag_s`` is how long a silent node is waited for; ``lazy`` see above.
    ``counters`` tells what was dropped or came late, by name; with ``keep_late`` ``late`` tells
    when.
    """

    nodes: Iterable[int] = ()
    start_s: float = 0.0
    reorder_s: float = 0.5
    max_lag_s: float = 5.0
    keep_late: bool = False
    lazy: bool = False
    counters: Counter[str] = field(default_factory=Counter)
    frontier_s: float = -inf
    """Everything up to here has been handed out; ``-inf`` before the first step."""
    late: list[Late] = field(default_factory=list)
    """What came behind the frontier, where ``keep_late``; its reader clears it."""
    _tracks: dict[int, _Track] = field(default_factory=dict)
    _arrived: list[tuple[float, int, Measurement]] = field(default_factory=list)
    """What is not sorted in yet, as it came."""
    _first_s: float = inf
    """The oldest of it."""
    _ordered: list[tuple[float, int, Measurement]] = field(default_factory=list)
    """What is, in order of time."""
    _pushed: int = 0
    _newest_s: float = -inf
    _ranged: set[tuple[int, int]] = field(default_factory=set)
    _reported: set[int] = field(default_factory=set)
    _epoch_s: float = -inf
    _slowest: _Track | None = None
    """Who was waited for last."""
    _sorted_nodes: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        for node in self.nodes:
            self._track(node)

    def reported_s(self, node: int) -> float:
        """Time of the node's newest motion; ``-inf`` where it never reported any."""
        track = self._tracks.get(node)
        return track.reported_s if track is not None and track.has_reported else -inf

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
            self._add(measurement)
        self._sort_in(inf if final else self._newest_s - self.reorder_s)
        released = self._release(final=final)
        return chain(released, self._end()) if final else released

    def take_in(self, measurement: Measurement) -> bool:
        """Take one usable measurement; tell whether ``push_all(())`` may have anything by it.

        Most measurements come within the time that everything is held back for.
        """
        before_s = self._newest_s
        self._add(measurement)
        until_s = self._newest_s - self.reorder_s
        if self._first_s <= until_s:
            self._sort_in(until_s)
        elif self._newest_s == before_s:
            return False
        return bool(self._ordered) and not self._waits_for(self._ordered[0][0])

    def _add(self, measurement: Measurement) -> None:
        tracks, time_s = self._tracks, measurement.time_s
        if self._pushed == 0 and time_s > self.start_s + LATEST_BEGIN_S:
            # Another clock's zero: what was before the first measurement is no chord of anybody.
            self.start_s = time_s
            for node in tracks:
                tracks[node] = _Track(time_s, time_s)
        if measurement.node not in tracks:
            self._track(measurement.node)
        if isinstance(measurement, Range) and measurement.peer not in tracks:
            self._track(measurement.peer)
        self._pushed += 1
        self._arrived.append((time_s, self._pushed, measurement))
        if time_s < self._first_s:
            self._first_s = time_s
        if time_s > self._newest_s:
            self._newest_s = time_s

    def snapshot(self) -> Timeline:
        """Give a copy that goes on by itself."""
        return replace(
            self,
            counters=self.counters.copy(),
            _tracks={node: track.copy() for node, track in self._tracks.items()},
            _sorted_nodes=self._sorted_nodes[:],
            _slowest=None,
            _arrived=self._arrived[:],
            _ordered=self._ordered[:],
            _ranged=self._ranged.copy(),
            _reported=self._reported.copy(),
            late=self.late[:],
        )

    def finish(self) -> list[Step]:
        """Work off everything that still waits; a last epoch closes the run."""
        return list(self.push_all((), final=True))

    def _end(self) -> Iterator[Step]:
        last = max((t.reported_s for t in self._tracks.values() if t.has_reported), default=-inf)
        last = max(last, self.frontier_s)
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
            insort(self._sorted_nodes, node)
        return track

    def _sort_in(self, until_s: float) -> None:
        """Give up waiting for anything older than ``until_s``."""
        arrived, ordered = self._arrived, self._ordered
        if self._first_s > until_s:
            return
        # What came in order costs a comparison each.
        arrived.sort()
        count = bisect_right(arrived, until_s, key=_time_of)
        for entry in arrived[:count]:
            time_s, _, measurement = entry
            if isinstance(measurement, Motion):
                track = self._tracks[measurement.node]
                # A frame may be repeated behind later ones, too.
                if time_s <= track.reported_s and measurement in track.recent:
                    self.counters["motions_duplicate"] += 1
                    continue
                self._take_motion(measurement)
            elif time_s <= self.frontier_s:
                if self.keep_late:
                    # Behind the frontier or at it: the rest of its instant was handed out.
                    self.late.append(Late(nextafter(time_s, -inf), time_s))
                if time_s < self.frontier_s:
                    name = "ranges" if isinstance(measurement, Range) else "sensed"
                    self.counters[f"{name}_late"] += 1
                    continue
            if ordered and entry < ordered[-1]:
                insort(ordered, entry)
            else:
                ordered.append(entry)
        del arrived[:count]
        self._first_s = arrived[0][0] if arrived else inf

    def _take_motion(self, motion: Motion) -> None:
        track = self._tracks[motion.node]
        track.recent.append(motion)
        chords = track.chords
        begin_s = chords[-1].time_s if chords else track.reached_s
        placed = True
        if begin_s < motion.time_s:
            chords.append(motion)
        else:
            # Its successor came first: before it, unless that was begun already.
            place = sum(waiting.time_s < motion.time_s for waiting in chords)
            begun = place == 0 and track.left is not None
            placed = bool(chords) and not begun and motion.time_s > track.reached_s
            chords.insert(place if placed else len(chords), motion)
            begin_s = chords[place - 1].time_s if placed and place else track.reached_s
            if not placed:
                begin_s = -inf
        if motion.time_s < self.frontier_s or not placed:
            self.counters["motions_late"] += 1
        if begin_s < self.frontier_s and self.keep_late:
            self.late.append(Late(begin_s, motion.time_s))
        if not track.has_reported:
            # A run may begin a little before zero: then nothing is known before the first motion.
            track.reached_s = min(track.reached_s, motion.time_s)
            track.reported_s = track.reached_s
            track.has_reported = True
        if motion.time_s > track.reported_s:
            track.reported_s = motion.time_s

    def _release(self, *, final: bool) -> Iterator[Step]:
        ordered = self._ordered
        while ordered:
            time_s = ordered[0][0]
            if not final and self._waits_for(time_s):
                return
            motions: set[int] = set()
            ranges: list[Range] = []
            sensed: list[Reading] = []
            if time_s > self.frontier_s:
                self._ranged.clear()
            count = 0
            for entry_s, _, measurement in ordered:
                if entry_s != time_s:
                    break
                count += 1
                if isinstance(measurement, Motion):
                    motions.add(measurement.node)
                elif isinstance(measurement, Range):
                    ranges.append(measurement)
                else:
                    sensed.append(measurement)
            del ordered[:count]
            if ranges:
                ranges = self._new(ranges)
            if sensed:
                sensed.sort(key=_sensed_order)
            closes = self._closes_epoch(time_s, motions)
            if ranges or sensed or closes:
                time_s = max(time_s, self.frontier_s)
                if closes or not self.lazy:
                    yield from self._advance_all(time_s)
                else:
                    self.frontier_s = time_s
                    concerned = nodes_of(ranges)
                    # A height says nothing of where anybody is.
                    concerned |= {m.node for m in sensed if not isinstance(m, Height)}
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
        sorted_s, lag_s = self._newest_s - self.reorder_s, self.max_lag_s
        slowest = self._slowest
        if (
            slowest is not None
            and slowest.reported_s < time_s
            and sorted_s - slowest.reported_s <= lag_s
        ):
            return True
        for track in self._tracks.values():
            if track.reported_s < time_s and sorted_s - track.reported_s <= lag_s:
                self._slowest = track
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

    def catch_up(self, nodes: Iterable[int], time_s: float) -> list[Advance]:
        """Advance some nodes to ``time_s``, at most as far as everything has been handed out."""
        steps: list[Advance] = []
        for node in sorted(nodes):
            track = self._tracks.get(node)
            if track is not None:
                _advance(track, node, min(time_s, self.frontier_s), steps)
        return steps

    def _advance_all(self, time_s: float) -> list[Advance]:
        self.frontier_s = max(self.frontier_s, time_s)
        steps: list[Advance] = []
        for node in self._sorted_nodes:
            _advance(self._tracks[node], node, time_s, steps)
        return steps


def _advance(track: _Track, node: int, until_s: float, steps: list[Advance]) -> None:
    """Hand out a node's pieces up to a time."""
    chords = track.chords
    while chords:
        chord = chords[0]
        end_s, reached_s = chord.time_s, track.reached_s
        piece, share = track.left or (Displacement(chord.dx_m, chord.dy_m, chord.dtheta_rad), 1.0)
        if end_s <= until_s:
            chords.popleft()
            track.left = None
            # A motion that comes after its successor has no time left of its own: only its
            # displacement counts.
            duration_s = max(end_s - reached_s, 0.0)
            track.reached_s = max(reached_s, end_s)
        elif until_s <= reached_s:
            return
        else:
            end_s, duration_s = until_s, until_s - reached_s
            cut = duration_s / (chord.time_s - reached_s)
            piece, rest = piece.split(cut)
            share, rest_share = cut * share, share - cut * share
            track.left = rest, rest_share
            track.reached_s = until_s
        part = sqrt(share)
        steps.append(
            Advance(
                end_s, node, duration_s, piece.dx_m, piece.dy_m, piece.dtheta_rad, share,
                _times(chord.sigma_x_m, part), _times(chord.sigma_y_m, part),
                _times(chord.sigma_theta_rad, part), _times(chord.sigma_x_alone_m, part),
                _times(chord.steps, share),
            )
        )  # fmt: skip


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


_time_of = itemgetter(0)
