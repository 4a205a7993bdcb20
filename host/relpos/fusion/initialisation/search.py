"""The search for unknown starts: pictures of the team, fitted on all that has been said.

A :class:`Search` keeps what dead reckoning and ranges have said since a start became unknown, and
after every epoch fits many *pictures* of the team on all of it (:mod:`starts_kernels`). A picture
is one set of present poses with the covariance that the data leave; along what they leave open
(the rotation about the first node before it moves, the heading of somebody who stands) it ends at
the size of a cell, and many pictures stand side by side. A picture's weight is the evidence of
its neighbourhood (Laplace): exp(-cost / 2) times the volume of its covariance.

Every round, the pictures go on from where they were, those that have met are merged, and new ones
are tried: all nodes, or one node, placed afresh on the rings of the others. So a mode that the
data open later is found later, and a mirror image is only dropped because its evidence is gone.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from relpos.fusion.initial_poses import HEADING_RESOLVED_RAD, POSE, PoseMixture
from relpos.fusion.initialisation.kernels import FIXED, fit
from relpos.fusion.modes import believe, seen_from
from relpos.fusion.timeline import Advance
from relpos.measurements import Range

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

_TWO_PI = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """What the search takes for granted of sensors that it has just met.

    ``sigma_range_m`` holds the range's own error, what is left of the pair's bias, and a margin
    for errors that repeat themselves from range to range (evidence is the product of them all).
    ``path_variance_m`` is the variance of the way per metre of it, ``turn_share`` the heading
    error per root of a turn's square, ``turn_rate_rad`` per root second.
    """

    sigma_range_m: float = 0.25
    bias_m: float = 0.3
    scale: float = 0.2
    path_variance_m: float = 0.005
    turn_rate_rad: float = 0.0175
    turn_share: float = 0.1
    pictures: int = 96
    fresh: int = 12
    cap_rad: float = 0.4
    memory_s: float = 240.0


_MOST_KNOTS = 5
_KNOT_RAD = 0.09
"""A knot is set when the heading may have gone wrong by so much (5 degrees) since the last."""

_FIT = 0.4
SIGMA_RANGE_M = (0.18, 2.0)

_WIDEST_KNOT_RAD = 0.2
"""Two knots with more heading error than this between them do not become one."""

_MOST_EVENTS = 260
_STOOD_M = 0.1
"""Ranges of two nodes that have moved less than this since their last one say it again."""


SETTLED_M = 0.7
SETTLED_RAD = 0.2
"""A place as seen from another node is settled when its standard deviation is below the greater
of these two (the second times the distance): joint filters are then near enough to linear."""

STOOD_M = 0.5
"""A node that has not been farther from its start has no heading to be known."""

RELEASED_M = 0.3

ODD_M = 0.3
"""How far a node may have gone while its odometry said something out of its habit."""


@dataclass(slots=True)
class _Track:
    """A node's dead reckoning since the search met it, in its own frame."""

    pose: Floats = field(default_factory=lambda: np.zeros(3))
    path_m: float = 0.0
    turn_variance: float = 0.0
    since_knot: float = 0.0
    knots: list[tuple[float, float, float, float]] = field(default_factory=list)
    """x, y, heading variance, time of each knot; the newest last."""
    samples: list[tuple[float, float, float, float]] = field(default_factory=list)
    """x, y, heading, path at each time of the search's clock."""
    solved: Floats = field(default_factory=lambda: np.zeros(3))
    """The pose at the last fit."""


@dataclass(slots=True)
class _Event:
    """Ranges of one pair from one place: their median and how many there were."""

    time: int
    node: int
    peer: int
    places: Floats
    path_m: tuple[float, float]
    values: list[float]
    height_m2: float
    extra_m2: float

    @property
    def range_m(self) -> float:
        """Median of the ranges from here."""
        return float(np.median(self.values))


@dataclass(slots=True)
class Search:
    """Feed it ``advance`` and ``ranging``, then ``solve`` at an epoch and read ``mixture``.

    ``located`` nodes are not sought: a range to one brings its place and the variance of that.
    """

    settings: SearchSettings = field(default_factory=SearchSettings)
    seed: int = 0
    counters: Counter[str] = field(default_factory=Counter)
    nodes: list[int] = field(default_factory=list)
    frame: int | None = None
    """The node whose start is the frame, while nobody else is located."""
    _rng: np.random.Generator = field(init=False)
    _tracks: dict[int, _Track] = field(default_factory=dict)
    _priors: dict[int, tuple[int, Floats, Floats]] = field(default_factory=dict)
    _times: list[float] = field(default_factory=list)
    _events: list[_Event] = field(default_factory=list)
    _newest: dict[tuple[int, int], _Event] = field(default_factory=dict)
    _step_m: float = _STOOD_M
    _pictures: Floats = field(init=False)
    _knot_columns: int = 0
    _weights: Floats = field(init=False)
    _covariances: Floats = field(init=False)
    _active: frozenset[int] = frozenset()
    _new: list[int] = field(default_factory=list)
    _news: bool = False
    sigma_m: float = field(init=False)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._pictures = np.zeros((0, 1))
        self._weights = np.zeros(0)
        self._covariances = np.zeros((0, 0, 0))
        self.sigma_m = self.settings.sigma_range_m

    # -- what is told --------------------------------------------------------------------------

    def add(
        self, node: int, time_s: float, mean: Sequence[float] | Floats = (0.0, 0.0, 0.0),
        sigma: Sequence[float] | Floats = (math.inf, math.inf, math.inf),
    ) -> None:  # fmt: skip
        """Seek ``node`` from now on; ``mean`` and ``sigma`` (inf: unknown) of its pose now."""
        time = self._tick(time_s)
        self._tracks[node] = track = _Track()
        track.samples = [(0.0, 0.0, 0.0, 0.0)] * len(self._times)
        floor = (1e-3, 1e-3, 1e-4)
        precision = np.array(
            [0.0 if math.isinf(s) else max(s, f) ** -2 for s, f in zip(sigma, floor, strict=True)]
        )
        self._priors[node] = (time, np.array(mean, dtype=float), precision)
        self.nodes.append(node)
        if self._pictures.shape[0]:
            block = np.zeros((self._pictures.shape[0], FIXED + self._knot_columns))
            bias = self._pictures[:, -1:]
            self._pictures = np.concatenate([self._pictures[:, :-1], block, bias], axis=1)
        self._news = True

    def advance(self, step: Advance, *, odd: bool = False) -> None:
        """Move a sought node's dead reckoning; others are ignored.

        An ``odd`` displacement, out of the node's habit, is a fault of the odometry: only its
        turn counts, and the way becomes as uncertain as ``ODD_M``.
        """
        track = self._tracks.get(step.node)
        if track is None:
            return
        if odd:
            track.path_m += ODD_M**2 / self.settings.path_variance_m
            step = step._replace(dx_m=0.0, dy_m=0.0)
        length = math.hypot(step.dx_m, step.dy_m)
        c, s = math.cos(track.pose[2]), math.sin(track.pose[2])
        track.pose[0] += c * step.dx_m - s * step.dy_m
        track.pose[1] += s * step.dx_m + c * step.dy_m
        track.pose[2] += step.dtheta_rad
        track.path_m += length
        if length > 0.0 or step.dtheta_rad != 0.0:
            share = max(step.fraction, 1e-9)
            variance = self.settings.turn_rate_rad**2 * step.duration_s
            variance += (self.settings.turn_share * step.dtheta_rad) ** 2 / share
            if step.sigma_theta_rad is not None:
                variance = max(variance, step.sigma_theta_rad**2)
            # A node that hardly moves does not lose its heading as one that walks does.
            variance *= min(
                1.0, (length + 0.3 * abs(step.dtheta_rad)) / (0.05 * step.duration_s + 1e-9)
            )
            track.since_knot += variance
            if track.since_knot > _KNOT_RAD**2:
                self._set_knot(step.node, track)

    def _set_knot(self, node: int, track: _Track) -> None:
        track.knots.append(
            (track.pose[0], track.pose[1], track.since_knot, float(len(self._times)))
        )
        track.since_knot = 0.0
        column = self.nodes.index(node)
        if len(track.knots) > self._knot_columns:
            self._widen()
        if self._pictures.shape[0]:
            each = FIXED + self._knot_columns
            turns = self._pictures[:, column * each + FIXED : (column + 1) * each]
            turns[:, 1:] = turns[:, :-1].copy()
            turns[:, 0] = 0.0
        if len(track.knots) > _MOST_KNOTS:
            self._thin_knots(node, track)

    def _widen(self) -> None:
        """Give every node one more turn."""
        old = FIXED + self._knot_columns
        self._knot_columns += 1
        count, nodes = self._pictures.shape[0], len(self.nodes)
        if count:
            wide = np.zeros((count, nodes * (old + 1) + 1))
            wide[:, :-1].reshape(count, nodes, old + 1)[:, :, :old] = self._pictures[
                :, :-1
            ].reshape(count, nodes, old)
            wide[:, -1] = self._pictures[:, -1]
            self._pictures = wide

    def _thin_knots(self, node: int, track: _Track) -> None:
        """Put two knots into one: the neighbours with the least error between them.

        Where even they are too different (two corners, say), it is the two oldest, and the node's
        ranges from before them are forgotten: with fewer knots than errors they would bend the
        picture.
        """
        knots = track.knots
        sums = [first[2] + second[2] for first, second in pairwise(knots)]
        k = int(np.argmin(sums))
        forget = sums[k] > _WIDEST_KNOT_RAD**2
        if forget:
            k = 0
        older, newer = knots[k : k + 2]
        knots[k : k + 2] = [(newer[0], newer[1], older[2] + newer[2], newer[3])]
        if self._pictures.shape[0]:
            each = FIXED + self._knot_columns
            column = self.nodes.index(node)
            turns = self._pictures[:, column * each + FIXED : (column + 1) * each]
            last = len(knots)
            # Columns count back from the newest; the two are at last - k - 1 and last - k.
            turns[:, last - k - 1] += turns[:, last - k]
            turns[:, last - k : last] = turns[:, last - k + 1 : last + 1].copy()
            turns[:, last] = 0.0
        if forget:
            kept = [
                e for e in self._events if node not in (e.node, e.peer) or e.time >= int(newer[3])
            ]
            self.counters["start_ranges_forgotten"] += len(self._events) - len(kept)
            self._events = kept

    def ranging(
        self,
        time_s: float,
        ranges: Sequence[Range],
        located: Mapping[int, tuple[float, float, float]],
        heights: Mapping[int, float] | None = None,
    ) -> None:
        """Take the ranges of an instant, after the advances up to it.

        ``located``: node -> x, y (m), variance (m^2) of those who are not sought; ranges between
        two of them, or to somebody of whom nothing is known, are left alone.
        """
        useful = [
            r for r in ranges
            if (r.node in self._tracks or r.peer in self._tracks)
            and all(n in self._tracks or n in located for n in (r.node, r.peer))
        ]  # fmt: skip
        if not useful:
            return
        time = self._tick(time_s)
        high = heights or {}
        for r in useful:
            first, second = sorted((r.node, r.peer), key=lambda n: (n not in self._tracks, n))
            if second in self._tracks:
                first, second = sorted((first, second), key=self.nodes.index)
            places, paths, extra = np.zeros((2, 2)), [0.0, 0.0], 0.0
            for end, node in enumerate((first, second)):
                if node in self._tracks:
                    paths[end] = self._tracks[node].path_m
                else:
                    x, y, variance = located[node]
                    places[end] = x, y
                    extra += variance
            last = self._newest.get((first, second))
            if last is not None:
                moved = max(
                    abs(paths[end] - last.path_m[end])
                    if node in self._tracks
                    else float(np.hypot(*(places[end] - last.places[end])))
                    for end, node in enumerate((first, second))
                )
                if moved < _STOOD_M:
                    last.values.append(r.range_m)
                    self._news |= len(last.values) <= 4
                    continue
                if moved < self._step_m:
                    continue
            event = _Event(
                time, first, second, places, (paths[0], paths[1]), [r.range_m],
                (high.get(first, 0.0) - high.get(second, 0.0)) ** 2, extra,
            )  # fmt: skip
            self._newest[first, second] = event
            self._events.append(event)
            self._news = True
        old = sum(self._times[e.time] < time_s - self.settings.memory_s for e in self._events)
        if old > 20:
            self._events = self._events[old:]
            self.counters["start_ranges_forgotten"] += old
            self._compact()
        elif len(self._events) > _MOST_EVENTS:
            self._thin_events()

    def _tick(self, time_s: float) -> int:
        """Index of this time on the search's clock; every track is sampled."""
        if not self._times or time_s > self._times[-1]:
            self._times.append(time_s)
            for track in self._tracks.values():
                x, y, heading = track.pose
                track.samples.append((float(x), float(y), float(heading), track.path_m))
        return len(self._times) - 1

    def _thin_events(self) -> None:
        """Drop every other of the older half, pair by pair; the older, the sparser."""
        half = self._events[len(self._events) // 2].time
        seen: Counter[tuple[int, int]] = Counter()
        kept = []
        for event in self._events:
            pair = (event.node, event.peer)
            seen[pair] += 1
            if event.time >= half or seen[pair] % 2 or self._newest.get(pair) is event:
                kept.append(event)
        self.counters["start_ranges_thinned"] += len(self._events) - len(kept)
        self._events = kept
        self._compact()

    def _compact(self) -> None:
        """Forget the times that nothing refers to any more."""
        referred = {e.time for e in self._events} | {p[0] for p in self._priors.values()}
        referred |= {e.time for e in self._newest.values()} | {len(self._times) - 1}
        used = sorted(referred)
        index = {old: new for new, old in enumerate(used)}
        self._times = [self._times[t] for t in used]
        for track in self._tracks.values():
            track.samples = [track.samples[t] for t in used]
            track.knots = [
                (x, y, variance, float(bisect_left(used, time)))
                for x, y, variance, time in track.knots
            ]
        for event in {id(e): e for e in [*self._events, *self._newest.values()]}.values():
            event.time = index[event.time]
        self._priors = {n: (index[t], m, p) for n, (t, m, p) in self._priors.items()}

    # -- what is concluded ---------------------------------------------------------------------

    @property
    def mixture(self) -> PoseMixture:
        """The pictures as they were at the last ``solve``, the most probable first."""
        each = FIXED + self._knot_columns
        count = self._pictures.shape[0]
        blocks = self._pictures[:, :-1].reshape(count, len(self.nodes), each)
        scales = np.exp(blocks[0, :, 3]) if count else np.ones(len(self.nodes))
        return PoseMixture(
            tuple(self.nodes), self._weights, blocks[:, :, :POSE].copy(), self._covariances, scales
        )

    @property
    def active(self) -> frozenset[int]:
        """Nodes that ranges, or a prior, tie to the others."""
        return self._active

    def solve(self) -> None:
        """Bring all pictures up to now."""
        self._move_pictures()
        if not self._news and self._pictures.shape[0]:
            return
        self._news = False
        self._tie()
        if not self._active:
            return
        data = self._arrays()
        settings = self.settings
        begin = self._pictures.shape[0] == 0
        if begin:
            # A wide net once; later rounds only mend it.
            self._pictures = self._place_all(2 * settings.pictures, data)
            self._fit(12, data)
            self._merge(settings.pictures)
        elif self._new:
            self._place_new(data)
            self._fit(12, data)
            self._merge(settings.pictures)
        else:
            self._fit(3, data)
        old = self._pictures
        few = len(self.nodes) <= 3
        fresh = self._propose(settings.fresh * (3 if few else 1), data)
        if fresh.shape[0]:
            self._pictures = fresh
            self._fit(8, data)
            costs, volume, cov = self._costs, self._volume, self._covariances
            self._pictures = old
            self._fit(0, data)
            self._pictures = np.concatenate([self._pictures, fresh])
            self._costs = np.concatenate([self._costs, costs])
            self._volume = np.concatenate([self._volume, volume])
            self._covariances = np.concatenate([self._covariances, cov])
        self._merge(settings.pictures)
        self._learn_sigma(len(data.measured))

    def _learn_sigma(self, count: int) -> None:
        """Let the ranges' error follow what the best picture leaves unexplained, slowly.

        Twice the error that is seen counts (a cost of ``_FIT`` a range): evidence is a product
        over ranges whose errors repeat themselves, and a mode is soon believed too much.
        """
        seen = (float(self._costs[0]) + _FIT * 20.0) / (count + 20.0)
        low, high = SIGMA_RANGE_M
        self.sigma_m *= min(max(seen / _FIT, 0.3), 4.0) ** 0.05
        self.sigma_m = min(max(self.sigma_m, low), high)

    _costs: Floats = field(default_factory=lambda: np.zeros(0))
    _volume: Floats = field(default_factory=lambda: np.zeros(0))

    def resolve(self, least: float) -> list[int]:
        """Name the nodes whose relative place the pictures agree on, with weight ``least``.

        Agreed on is the pose as seen from ``frame``'s node, where there is one, so that what is
        open of the common frame does not count; and the heading, unless the node has stood so
        far: then there is nothing to know it from.
        """
        if not self._weights.size:
            return []
        mixture, found = self.mixture, []
        for i, node in enumerate(self.nodes):
            if node not in self._active or node == self.frame:
                continue
            if self.frame is None:
                own = slice(POSE * i, POSE * (i + 1))
                poses, covariances = mixture.poses[:, i], mixture.covariances[:, own, own]
                reach = 0.0
            else:
                first = self.nodes.index(self.frame)
                poses, covariances = seen_from(mixture.poses, mixture.covariances, first, i)
                reach = float(np.median(np.hypot(*poses[:, :2].T)))
            belief = believe(mixture.weights, poses, covariances)
            if belief.share < least or belief.sigma_here_m > max(SETTLED_M, SETTLED_RAD * reach):
                continue
            if belief.sigma_heading_rad > HEADING_RESOLVED_RAD and self.extent_m(node) > STOOD_M:
                continue
            found.append(node)
        return found

    def extent_m(self, node: int) -> float:
        """How far the node has been from where it was met."""
        samples = self._tracks[node].samples
        far = [math.hypot(x, y) for x, y, _, _ in samples]
        return max([*far, float(np.hypot(*self._tracks[node].pose[:2]))])

    def release(self, nodes: Sequence[int]) -> PoseMixture:
        """Hand over the poses of ``nodes``, which are sought no more; the rest is kept.

        Pictures that do not agree with the best one on these nodes are dropped. In what was
        measured the nodes stay as places, along the best picture.
        """
        leaving = [self.nodes.index(n) for n in nodes]
        columns = (np.array(leaving)[:, None] * POSE + np.arange(POSE)).ravel()
        each = FIXED + self._knot_columns
        poses = self.mixture.poses
        off = poses[:, leaving] - poses[0, leaving]
        off[:, :, 2] = 0.0
        spread = self._covariances[0][np.ix_(columns, columns)]
        flat = off.reshape(len(poses), -1)
        agree = (flat * np.linalg.solve(spread, flat.T).T).sum(axis=1) < 9.0 + 2.0 * flat.shape[1]
        agree |= (off[:, :, :2] ** 2).sum(axis=2).max(axis=1) < 0.5
        given = PoseMixture(
            tuple(nodes),
            self._weights[agree] / self._weights[agree].sum(),
            poses[agree][:, leaving],
            self._covariances[agree][:, columns][:, :, columns],
            np.exp(self._pictures[0, :-1].reshape(-1, each)[leaving, 3]),
        )
        self._fix_places(set(nodes))
        staying = [i for i in range(len(self.nodes)) if i not in leaving]
        kept = (np.array(staying, dtype=np.intp)[:, None] * POSE + np.arange(POSE)).ravel()
        blocks = self._pictures[agree, :-1].reshape(-1, len(self.nodes), each)[:, staying]
        bias = self._pictures[agree, -1:]
        self._pictures = np.concatenate([blocks.reshape(len(blocks), -1), bias], axis=1)
        self._covariances = self._covariances[agree][:, kept][:, :, kept]
        self._weights = self._weights[agree] / self._weights[agree].sum()
        self.nodes = [self.nodes[i] for i in staying]
        for node in nodes:
            del self._tracks[node], self._priors[node]
        if self.frame in nodes:
            self.frame = None
        self._active -= set(nodes)
        self._newest = {}
        self._events = [e for e in self._events if {e.node, e.peer} & set(self.nodes)]
        self._news = True
        return given

    def _fix_places(self, leaving: set[int]) -> None:
        """Write the best picture's places of ``leaving`` into the events that they are part of."""
        data = self._arrays()
        each = FIXED + self._knot_columns
        where = {n: i for i, n in enumerate(self.nodes)}
        for event in self._events:
            ends = [event.node, event.peer]
            for end, node in enumerate(ends):
                if node not in leaving or node not in where:
                    continue
                i = where[node]
                block = self._pictures[0, i * each : (i + 1) * each]
                event.places[end] = _place_at(block, data, i, event.time)
                path = self._tracks[node].path_m - event.path_m[end]
                own = self._covariances[0][i * POSE : i * POSE + 2, i * POSE : i * POSE + 2]
                # Most of a place's error is common to all places of a track, and to all tracks.
                event.extra_m2 += self.settings.path_variance_m * path
                event.extra_m2 += min(0.5 * float(np.trace(own)), RELEASED_M**2)
            if event.node in leaving and event.peer not in leaving:
                # The sought end comes first.
                event.node, event.peer = event.peer, event.node
                event.places = event.places[::-1].copy()
                event.path_m = (event.path_m[1], event.path_m[0])

    def _tie(self) -> None:
        """Find who hangs together with what is known."""
        tied = {n for n in self.nodes if self._priors[n][2][:2].any()}
        links = [(e.node, e.peer) for e in self._events]
        while True:
            more = {
                n
                for a, b in links
                for n, o in ((a, b), (b, a))
                if n in self._tracks and n not in tied and (o in tied or o not in self._tracks)
            }
            if not more:
                break
            tied |= more
        if tied != self._active:
            self._new = sorted(tied - self._active) if self._pictures.shape[0] else []
            self._active = frozenset(tied)

    def _move_pictures(self) -> None:
        each = FIXED + self._knot_columns
        for i, node in enumerate(self.nodes):
            track = self._tracks[node]
            c, s = math.cos(track.solved[2]), math.sin(track.solved[2])
            off = track.pose - track.solved
            dx, dy = c * off[0] + s * off[1], c * off[1] - s * off[0]
            track.solved = track.pose.copy()
            if self._pictures.shape[0]:
                pose = self._pictures[:, i * each : (i + 1) * each]
                stretch = np.exp(pose[:, 3])
                cosine, sine = np.cos(pose[:, 2]) * stretch, np.sin(pose[:, 2]) * stretch
                pose[:, 0] += cosine * dx - sine * dy
                pose[:, 1] += sine * dx + cosine * dy
                pose[:, 2] += off[2]

    def _arrays(self) -> _Data:
        nodes, settings = len(self.nodes), self.settings
        columns = self._knot_columns
        length = len(self._times)
        tracks = np.zeros((length, nodes, 3))
        segments = np.zeros((length, nodes), dtype=np.intp)
        knots = np.zeros((columns + 1, nodes, 2))
        turn_variance = np.ones((columns, nodes))
        prior_at = np.zeros(nodes, dtype=np.intp)
        prior = np.zeros((2, nodes, 3))
        paths = np.zeros((length, nodes))
        for i, node in enumerate(self.nodes):
            track = self._tracks[node]
            samples = np.array(track.samples)
            c, s = math.cos(track.pose[2]), math.sin(track.pose[2])
            off = samples[:, :2] - track.pose[:2]
            tracks[:, i, 0] = c * off[:, 0] + s * off[:, 1]
            tracks[:, i, 1] = c * off[:, 1] - s * off[:, 0]
            tracks[:, i, 2] = samples[:, 2] - track.pose[2]
            paths[:, i] = track.path_m - samples[:, 3]
            for k, (x, y, variance, time) in enumerate(reversed(track.knots)):
                dx, dy = x - track.pose[0], y - track.pose[1]
                knots[k + 1, i] = c * dx + s * dy, c * dy - s * dx
                turn_variance[k, i] = variance
                segments[: int(time), i] += 1
            knots[len(track.knots) + 1 :, i] = knots[len(track.knots), i]
            prior_at[i], mean, precision = self._priors[node]
            prior[0, i], prior[1, i] = mean, precision
            if prior[1, i, 0] > 0.0:
                # What the way has added since is not in the track's parameters.
                grown = settings.path_variance_m * paths[prior_at[i], i]
                prior[1, i, :2] = 1.0 / (1.0 / prior[1, i, :2] + grown)
            if node not in self._active:
                prior[1, i] = 1e-6
        row = {n: i for i, n in enumerate(self.nodes)}
        events = [
            e for e in self._events
            if all(n in self._active or n not in row for n in (e.node, e.peer))
        ]  # fmt: skip
        ends = np.array([(row.get(e.node, -1), row.get(e.peer, -1)) for e in events], dtype=np.intp)
        ends = ends.reshape(-1, 2)
        # The kernel fills one triangle: of two sought ends the first comes first.
        turned = (ends[:, 1] >= 0) & (ends[:, 0] > ends[:, 1])
        ends[turned] = ends[turned, ::-1]
        at = np.array([e.time for e in events], dtype=np.intp)
        measured = np.zeros((len(events), 4))
        measured[:, 0] = [e.range_m for e in events]
        count = np.array([len(e.values) for e in events], dtype=float)
        measured[:, 1] = self.sigma_m**2 / np.minimum(count, 2.0)
        measured[:, 1] += [e.extra_m2 for e in events]
        for end in range(2):
            sought = ends[:, end] >= 0
            measured[sought, 1] += settings.path_variance_m * paths[at[sought], ends[sought, end]]
        measured[:, 2] = [e.height_m2 for e in events]
        measured[:, 3] = measured[:, 0] < 1.5 * self.sigma_m
        places = np.array([e.places for e in events]).reshape(-1, 2, 2)
        # A cell is as long as an arc of the largest circle that the node is on stays straight.
        cap = np.full((nodes, POSE), settings.cap_rad)
        for i in range(nodes):
            mine = measured[(ends == i).any(axis=1), 0]
            cap[i, :2] *= max(1.0, float(mine.max()) if mine.size else 0.0)
        return _Data(
            tracks, segments, knots, turn_variance, prior_at, prior,
            np.full(nodes, settings.scale**2), settings.bias_m**2, ends, at, measured, places,
            cap.ravel(),
        )  # fmt: skip

    def _fit(self, iterations: int, data: _Data) -> None:
        count, dofs = self._pictures.shape[0], POSE * len(self.nodes)
        self._costs, self._volume = np.zeros(count), np.zeros(count)
        self._covariances = np.zeros((count, dofs, dofs))
        fit(
            self._pictures, iterations, data.cap, data.tracks, data.segments, data.knots,
            data.turn_variance, data.prior_at, data.prior, data.scale_variance,
            data.bias_variance, data.ends, data.at, data.measured, data.places,
            self._costs, self._volume, self._covariances,
        )  # fmt: skip

    def _merge(self, most: int) -> None:
        """Keep one of those that have met, and forget what has no evidence left."""
        score = -0.5 * self._costs + self._volume
        order = np.argsort(-score)
        order = order[score[order] > score[order[0]] - 18.0]
        dofs = self._covariances.shape[1]
        each = FIXED + self._knot_columns
        nodes = len(self.nodes)
        poses = self._pictures[:, :-1].reshape(-1, nodes, each)[:, :, :POSE]
        kept: list[int] = []
        while order.size and len(kept) < most:
            best = order[0]
            kept.append(best)
            off = poses[order] - poses[best]
            off[:, :, 2] -= _TWO_PI * np.round(off[:, :, 2] / _TWO_PI)
            flat = off.reshape(order.size, dofs)
            solved = np.linalg.solve(self._covariances[best], flat.T).T
            order = order[(flat * solved).sum(axis=1) > 1.0 + 0.25 * dofs]
        index = np.array(kept, dtype=np.intp)
        self._pictures = self._pictures[index]
        self._covariances = self._covariances[index]
        self._costs, self._volume = self._costs[index], self._volume[index]
        weights = np.exp(score[index] - score[index[0]])
        self._weights = weights / weights.sum()

    # -- where to look -------------------------------------------------------------------------

    def _place_all(self, count: int, data: _Data) -> Floats:
        """Pictures with every node placed on the rings of those placed before it."""
        each = FIXED + self._knot_columns
        pictures = np.zeros((count, len(self.nodes) * each + 1))
        placed: set[int] = set()
        for i, node in enumerate(self.nodes):
            if node in self._active and data.prior[1, i, :2].any():
                self._draw_prior(pictures, i, data)
                placed.add(i)
        waiting = [i for i, n in enumerate(self.nodes) if n in self._active and i not in placed]
        self._rng.shuffle(waiting)
        while waiting:
            for i in waiting:
                if self._place(pictures, i, placed, data):
                    placed.add(i)
                    waiting.remove(i)
                    break
            else:
                break
        return pictures

    def _place_new(self, data: _Data) -> None:
        """Place nodes that have just been tied to the others into the pictures there are."""
        count = 2 * self.settings.pictures
        usable = self._weights.size == self._pictures.shape[0]
        share = self._weights if usable else None
        chosen = self._rng.choice(self._pictures.shape[0], size=count, p=share)
        self._pictures = self._pictures[chosen]
        waiting = [self.nodes.index(n) for n in self._new]
        placed = {self.nodes.index(n) for n in self._active} - set(waiting)
        self._new = []
        while waiting:
            for i in waiting:
                if data.prior[1, i, :2].any():
                    self._draw_prior(self._pictures, i, data)
                elif not self._place(self._pictures, i, placed, data):
                    continue
                placed.add(i)
                waiting.remove(i)
                break
            else:
                break

    def _propose(self, count: int, data: _Data) -> Floats:
        """Try pictures as they are but for one node, and some wholly new ones."""
        movable = [
            i
            for i, n in enumerate(self.nodes)
            if n in self._active and not data.prior[1, i, ::2].all()
        ]
        if not movable or count == 0:
            return self._pictures[:0]
        base = self._pictures[
            self._rng.choice(self._pictures.shape[0], size=count, p=self._weights)
            if self._weights.size == self._pictures.shape[0]
            else self._rng.integers(self._pictures.shape[0], size=count)
        ].copy()
        if len(movable) == 1 and not self._free_to_turn(data):
            self._place(base, movable[0], set(range(len(self.nodes))) - {movable[0]}, data)
            return base
        whole = count // 3
        parts = [self._place_all(whole, data)] if whole else []
        rest = base[whole:]
        if self._free_to_turn(data):
            half = len(rest) // 2
            parts.append(self._turned(rest[:half]))
            rest = rest[half:]
        for k, i in enumerate(self._rng.permutation(movable)[:3]):
            part = rest[k::3].copy()
            others = {j for j, n in enumerate(self.nodes) if n in self._active and j != i}
            if part.shape[0] and self._place(part, int(i), others, data):
                parts.append(part)
        return np.concatenate(parts) if parts else self._pictures[:0]

    def _free_to_turn(self, data: _Data) -> bool:
        """Whether nothing but chance may have told the directions: no heading, nobody located."""
        if (data.ends < 0).any():
            return False
        told = data.prior[1, :, 2] > 1.0
        return all(self.extent_m(self.nodes[i]) < STOOD_M for i in np.flatnonzero(told))

    def _turned(self, pictures: Floats) -> Floats:
        """Turn whole pictures about the frame's node, or the middle of what is known of places."""
        known = [i for i, n in enumerate(self.nodes) if self._priors[n][2][:2].any()]
        pivot = np.mean([self._priors[self.nodes[i]][1][:2] for i in known], axis=0)
        turned = pictures.copy()
        blocks = turned[:, :-1].reshape(len(turned), len(self.nodes), -1)
        angle = _TWO_PI * self._rng.random(len(turned))
        moved = [i for i, n in enumerate(self.nodes) if n != self.frame]
        place = blocks[:, moved, 0] + 1j * blocks[:, moved, 1] - complex(*pivot)
        place = complex(*pivot) + place * np.exp(1j * angle)[:, None]
        blocks[:, moved, 0], blocks[:, moved, 1] = place.real, place.imag
        blocks[:, moved, 2] += angle[:, None]
        return turned

    def _draw_prior(self, pictures: Floats, i: int, data: _Data) -> None:
        each = FIXED + self._knot_columns
        count = pictures.shape[0]
        pose = pictures[:, i * each : i * each + POSE]
        mean, precision = data.prior[0, i], data.prior[1, i]
        heading = _TWO_PI * self._rng.random(count)
        if precision[2] > 0.0:
            heading = mean[2] + self._rng.standard_normal(count) / math.sqrt(precision[2])
        then = data.tracks[data.prior_at[i], i]
        heading -= then[2]
        x = mean[0] + self._rng.standard_normal(count) / math.sqrt(precision[0])
        y = mean[1] + self._rng.standard_normal(count) / math.sqrt(precision[1])
        c, s = np.cos(heading), np.sin(heading)
        pose[:, 0] = x - (c * then[0] - s * then[1])
        pose[:, 1] = y - (s * then[0] + c * then[1])
        pose[:, 2] = heading

    def _place(self, pictures: Floats, i: int, placed: set[int], data: _Data) -> bool:
        """Place node i of every picture on a ring of a placed one, in place; False if none is."""
        first, second = data.ends[:, 0], data.ends[:, 1]
        anchors = np.array(sorted(placed | {-1}), dtype=np.intp)
        mine = np.flatnonzero(
            ((first == i) & np.isin(second, anchors)) | ((second == i) & np.isin(first, anchors))
        )
        if mine.size == 0:
            return False
        if mine.size > 16:
            mine = mine[np.linspace(0, mine.size - 1, 16).astype(np.intp)]
        count, choices, each = pictures.shape[0], 24, FIXED + self._knot_columns
        end = np.where(first[mine] == i, 1, 0)
        other = data.ends[mine, end]
        then = data.at[mine]
        anchor = np.empty((count, mine.size, 2))
        for e in range(mine.size):
            j = other[e]
            if j < 0:
                anchor[:, e] = data.places[mine[e], end[e]]
            else:
                pose = pictures[:, j * each : j * each + POSE]
                seen = data.tracks[then[e], j]
                c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
                anchor[:, e, 0] = pose[:, 0] + c * seen[0] - s * seen[1]
                anchor[:, e, 1] = pose[:, 1] + s * seen[0] + c * seen[1]
        measured = data.measured[mine]
        x_shape = (count, choices)
        chosen = self._rng.integers(mine.size, size=x_shape)
        bearing = _TWO_PI * self._rng.random((count, choices))
        heading = _TWO_PI * self._rng.random((count, choices))
        prior = data.prior[1, i]
        if prior[2] > 0.0:
            heading = data.prior[0, i, 2] - data.tracks[data.prior_at[i], i, 2]
            heading = heading + self._rng.standard_normal((count, choices)) / math.sqrt(prior[2])
        own = data.tracks[then, i]
        c, s = np.cos(heading), np.sin(heading)
        rows = np.arange(count)[:, None]
        if prior[0] > 0.0:
            x = data.prior[0, i, 0] + self._rng.standard_normal(x_shape) / math.sqrt(prior[0])
            y = data.prior[0, i, 1] + self._rng.standard_normal(x_shape) / math.sqrt(prior[1])
            then_x, then_y = data.tracks[data.prior_at[i], i, :2]
        else:
            radius = measured[chosen, 0]
            x = anchor[rows, chosen, 0] + radius * np.cos(bearing)
            y = anchor[rows, chosen, 1] + radius * np.sin(bearing)
            then_x, then_y = own[chosen, 0], own[chosen, 1]
        x -= c * then_x - s * then_y
        y -= s * then_x + c * then_y
        px = x[:, :, None] + c[:, :, None] * own[:, 0] - s[:, :, None] * own[:, 1]
        py = y[:, :, None] + s[:, :, None] * own[:, 0] + c[:, :, None] * own[:, 1]
        distance = np.sqrt(
            (px - anchor[:, None, :, 0]) ** 2 + (py - anchor[:, None, :, 1]) ** 2 + measured[:, 2]
        )
        # Wide: a place is to be near, the fit does the rest.
        scaled = (measured[:, 0] - distance) / (0.5 + np.sqrt(measured[:, 1]))
        score = -np.log1p(0.5 * scaled * scaled).sum(axis=2)
        best = (score + self._rng.gumbel(size=score.shape)).argmax(axis=1)
        pick = np.arange(count)
        pictures[:, i * each : (i + 1) * each] = 0.0
        pictures[:, i * each] = x[pick, best]
        pictures[:, i * each + 1] = y[pick, best]
        pictures[:, i * each + 2] = heading[pick, best]
        return True


def _place_at(block: Floats, data: _Data, i: int, time: int) -> Floats:
    """Give the place (2,) of node i at a time index, by one picture's block of parameters."""
    stretch, angle = math.exp(block[3]), float(block[2])
    place = block[:2].copy()
    segment = int(data.segments[time, i])
    ends = [*data.knots[: segment + 1, i], data.tracks[time, i, :2]]
    for k in range(segment + 1):
        dx, dy = ends[k + 1] - ends[k]
        c, s = stretch * math.cos(angle), stretch * math.sin(angle)
        place += (c * dx - s * dy, s * dx + c * dy)
        if k < segment:
            angle += float(block[FIXED + k])
    return place


@dataclass(frozen=True, slots=True)
class _Data:
    """The arguments of :func:`starts_kernels.fit` that all pictures share."""

    tracks: Floats
    segments: Indices
    knots: Floats
    turn_variance: Floats
    prior_at: Indices
    prior: Floats
    scale_variance: Floats
    bias_variance: float
    ends: Indices
    at: Indices
    measured: Floats
    places: Floats
    cap: Floats
