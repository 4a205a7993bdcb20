"""The vertical filter of a team: reported heights and motion in; heights, episodes, floors out.

It works in intervals of about a second, which end with epochs. What happened in one is decided
``LAG_S`` later, when smoothing knows how it went on: a flight of stairs is recognised after a few
steps, a fan's pressure after a metre. Until then a height is the last decided one and what has
probably been climbed since.

On stairs dead reckoning claims a level step's length, twice the true one. Who is on stairs is
expected to stay there, so that motion is shortened as it comes; what was claimed before a flight
was recognised is taken back along the reported direction.

Before anybody reports a height there is nothing here: the team is taken to be on one level.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Bools, Complexes, Floats, Indices
from relpos.fusion.estimator import Episode, Vertical
from relpos.fusion.models.odometry_faults import vagueness
from relpos.fusion.models.pressure import FAST_S
from relpos.fusion.timeline import Advance
from relpos.fusion.vertical import episodes
from relpos.fusion.vertical.air import common_rise
from relpos.fusion.vertical.episodes import Beliefs, Interval, Update
from relpos.fusion.vertical.floors import CERTAIN, LOWEST, SPACING_M, Floors, Over, most_probable
from relpos.fusion.vertical.heights import (
    FAST,
    SLOW,
    START_M,
    UNKNOWN_M,
    UNSEEN_M,
    UNSEEN_S,
    Heights,
    Z,
)
from relpos.fusion.vertical.modes import DOWN, FOLLOWS, PRESSURE, STAIRS, UP, Air, Mode
from relpos.fusion.vertical.stairs import true_shares
from relpos.fusion.vertical.track import HEIGHT_LATE_S, Moved, Track
from relpos.measurements import Height, Range

INTERVAL_S = 0.75
"""Shortest interval: of estimates ten times a second only some close one."""

LAG_S = 6.0
"""What happened so long ago is decided."""

LATE_S = 60.0
"""Who reports a first height so long after the first wearer joins late."""

LEAST_CORRECTION_M = 0.05
"""One outlier of the pressure claims 0.02 m on level ground."""

DOUBTED_CORRECTION = 0.3
"""Standard deviation of a correction, relative: ranges have taken some of the surplus back before.
Aligned 3D with the bank (m), calm, seeds 300 to 307: 0 1.05, 0.2 0.92, 0.3 0.85, 0.5 0.90."""

LEAST_CLIMB_M = 0.85
"""Less within ``LAG_S`` is told as level: gusts, a door of 10 Pa. With doors and heat (seeds 100 to
102) 0.45 m tells 8.0 false flights an hour, 0.7 m 4.5, 0.9 m 2.0, and finds 96 % of true ones."""

STANDS_STEPS = 0.3
"""Who makes fewer steps in an interval stands, and sees what the pressure does alone."""

DOUBTED = 0.6
"""What of a rise is the wearer's and what the pressure's is doubtful by this share (a standard
deviation) of what the pressure did to a node more or less than to the others. So is a rise that no
height shows yet."""
POSTURE_M = 0.4
"""Who is on a known floor may kneel, crawl or lie, no more."""

NEAR_M, VAGUE_M, SURE_M = 1.5, 1.0, 0.5
"""A range so short tells on which floor somebody of a vague height is, from one of a sure height
(standard deviations)."""

LOST_M = 2.5
"""Whose pressure differs from the others' by more than any door's or fan's is on another floor."""

SETTLES_S = 3.0
"""After so long on the level a node is where it stays."""


class Decided(NamedTuple):
    """What was decided of one node between two of its heights."""

    node: int
    begin_s: float
    end_s: float
    share: float
    """Of the displacements that is true."""
    z_m: float


@dataclass(slots=True)
class _Interval:
    """An interval of N nodes that is not decided yet."""

    begin_s: float
    end_s: float
    taken_s: Floats
    """Times of each node's heights before it and at its end (2, N)."""
    reported: Interval
    update: Update
    rise_m: Floats
    way_m: Floats
    moved: Complexes
    silent_s: Floats
    again: Bools
    """Whose height came after a while without."""
    made: Complexes
    """How the plane has been moved so far."""
    share: Floats = field(init=False)
    """Of the displacements that is true."""
    probability: Floats = field(init=False)
    """Of airs and modes (N, AIRS, MODES), smoothed."""
    happened: Happened = field(init=False)

    def smoothed(self, probability: Floats) -> None:
        """Take what happened from the probabilities of airs and modes."""
        self.probability = probability
        mode = probability.sum(axis=1)
        blown = probability[:, Air.BLOWN]
        pressed = mode[:, PRESSURE].sum(axis=1)
        assert self.update.blown is not None
        common_m = common_rise(self.update.blown, blown)
        felt = blown @ FOLLOWS
        climbed = felt - blown[:, Mode.LEVEL] - blown[:, Mode.JUMP]
        self.happened = Happened(
            1.0 - mode[:, Mode.LEVEL] - pressed,
            pressed + blown[:, Mode.LEVEL],
            felt * common_m,
            climbed * common_m,
        )


class Happened(NamedTuple):
    """What N nodes and the air probably did in an interval."""

    moving: Floats
    """Probability that the wearer rose or fell."""
    disturbed: Floats
    """That the pressure did alone."""
    common_m: Floats
    """How much the air let all heights rise."""
    pressed_m: Floats
    """How much of that is in the rises of those who moved."""

    @property
    def level(self) -> Floats:
        """Probability that neither changed."""
        return 1.0 - self.moving - self.disturbed


@dataclass(slots=True)
class VerticalFilter:
    """See the module's text. Feed :meth:`move` and :meth:`measure`; :meth:`close` epochs.

    ``posts`` lie at the start's height, in air of their own: they tell nothing of the others'.
    """

    posts: frozenset[int] = frozenset()
    heights: Heights = field(default_factory=Heights)
    floors: Floors = field(default_factory=Floors)
    first_s: float = math.inf
    """When the first height was reported."""
    _worn_s: float = math.inf
    """When a wearer's was."""
    decided: list[Decided] | None = None
    """Everything decided, where somebody wants it."""
    _row: dict[int, int] = field(default_factory=dict)
    _tracks: dict[int, Track] = field(default_factory=dict)
    _beliefs: Beliefs = field(default_factory=lambda: episodes.begin(np.empty(0), np.empty(0)))
    _open: list[_Interval] = field(default_factory=list)
    _closed_s: float = -math.inf
    _level_s: Floats = field(default_factory=lambda: np.empty(0))
    """How long each has been level since it last changed its height."""
    _level_steps: Floats = field(default_factory=lambda: np.empty(0))
    _base: Indices = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """The floor that each was known to be on last; heights are over it."""
    _over: Over = field(default_factory=lambda: Over(np.empty(0), np.empty(0)))
    """Where pressure alone says that they are."""
    _doubt_m: Floats = field(default_factory=lambda: np.empty(0))
    """Standard deviation, signed, of what each climbed since: a rise that is the wearer's for one
    and the pressure's for another is taken from the other. What cancels was no climb."""
    _walked: Bools = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    """In the last interval."""
    _settled: Bools = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    _own_zero: Bools = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    """Who joined late or was off: its heights count from where that was, not from the start."""

    @property
    def active(self) -> bool:
        """Whether anybody has reported a height."""
        return self.first_s < math.inf

    # -- measurements --------------------------------------------------------------------------

    def move(self, step: Advance) -> Advance:
        """Add a piece of motion; return it without what stairs probably add to it."""
        if not self.active:
            return step
        track, row = self._track(step.node), self._row.get(step.node)
        off = step.time_s - track.height_s > UNSEEN_S and vagueness(step) is not None
        if off and row is not None:
            # It was off, and goes on from its last height, wherever its wearer is now.
            self._own_zero[row] = True
            self.heights.doubt(row, UNSEEN_M * math.sqrt(step.duration_s))
        return track.move(step)

    def measure(self, measured: Height, time_s: float) -> bool:
        """Add a reported height, at its time in the order of steps; False from a stuck sensor."""
        node = measured.node
        if not self.active:
            self.first_s = self._closed_s = time_s
        if node in self.posts:
            return True
        track = self._track(node)
        unseen_s = track.report(measured.height_m, time_s, measured.sigma_m)
        if unseen_s > 0.0:
            self.heights.doubt(self._row[node], UNSEEN_M * math.sqrt(unseen_s))
        elif node not in self._row:
            # A post is often on long before.
            self._worn_s = min(self._worn_s, time_s)
            self._add(node, track, late=time_s > self._worn_s + LATE_S)
        return track.height_s == time_s

    def _track(self, node: int) -> Track:
        track = self._tracks.get(node)
        if track is None:
            track = self._tracks[node] = Track(episodes.SIGMA_HEIGHT_M)
        return track

    def _add(self, node: int, track: Track, *, late: bool) -> None:
        self._decide(math.inf)
        self._row[node] = len(self._row)
        track.take()
        self.heights.add(track.height_m, track.sigma_m, late=late)
        self.floors.add(late=late)
        first = episodes.begin(np.array([track.height_m]), np.array([track.sigma_m**2]))
        self._beliefs = Beliefs(
            *(np.concatenate(both) for both in zip(self._beliefs, first, strict=True))
        )
        self._level_s = np.append(self._level_s, 0.0)
        self._level_steps = np.append(self._level_steps, 0.0)
        self._walked = np.append(self._walked, False)
        # Otherwise heights are over a common ground, and it does not start where the others do.
        at_start = not late and abs(track.height_m) <= 1.0
        self._settled = np.append(self._settled, at_start)
        self._own_zero = np.append(self._own_zero, late)
        self._base = np.append(self._base, 0)
        self._doubt_m = np.append(self._doubt_m, 0.0)
        self._over = Over(
            np.append(self._over.mean_m, track.height_m),
            np.append(self._over.variance_m2, UNKNOWN_M**2),
        )

    def ranged(self, measured: Range) -> None:
        """Use a short range: the two are on one floor. Others teach no height on one floor."""
        if measured.range_m > NEAR_M:
            return
        for vague, sure in ((measured.node, measured.peer), (measured.peer, measured.node)):
            if vague not in self._row or (sure not in self._row and sure not in self.posts):
                continue
            a, variance = self._row[vague], self.heights.covariance[:, Z, Z]
            z_m, variance_m2 = 0.0, START_M**2
            if sure in self._row:
                b = self._row[sure]
                z_m, variance_m2 = self._height(b)[0], float(variance[b])
            if variance[a] > VAGUE_M**2 and variance_m2 < SURE_M**2:
                below_m = self.floors.height_of(int(self._base[a]), 0.0)[0]
                spread_m2 = (0.5 * measured.range_m) ** 2
                self.heights.observe(a, z_m - below_m, variance_m2 + spread_m2)
                self._settled[a] = False
                self._level_s[a] = 0.0

    # -- intervals -----------------------------------------------------------------------------

    def close(self, time_s: float) -> list[Advance]:
        """End an epoch; return what motion has to be corrected by, now."""
        if not self._row or time_s < self._closed_s + INTERVAL_S:
            return []
        self._observe(time_s)
        probabilities = episodes.smooth([one.update for one in self._open])
        for one, probability in zip(self._open, probabilities, strict=True):
            one.smoothed(probability)
        corrections = self._corrections(time_s)
        self._decide(time_s - LAG_S)
        return corrections

    def finish(self) -> None:
        """Decide what is still open."""
        self._decide(math.inf)

    def _observe(self, time_s: float) -> None:
        """Add the interval that ends now."""
        begin_s, self._closed_s = self._closed_s, time_s
        tracks = [self._tracks[node] for node in self._row]
        news = np.array([track.height_s > track.taken_s for track in tracks])
        height = np.array([track.height_m for track in tracks])
        taken_s = np.array([[t.taken_s for t in tracks], [t.height_s for t in tracks]])
        since_s = taken_s[1] - taken_s[0]
        moved = [t.take() if new else Moved() for t, new in zip(tracks, news, strict=True)]
        steps = np.array([one.steps for one in moved])
        variance = np.array([track.sigma_m**2 for track in tracks])
        again = news & (since_s > UNSEEN_S)
        if again.any():
            # How it came there nobody has seen.
            self._beliefs = episodes.begin_again(self._beliefs, again, height, variance)
        # What the air did while nobody reported nobody has seen, either.
        duration_s = time_s - begin_s if time_s - begin_s <= UNSEEN_S else 1.0
        reported = Interval(
            duration_s, np.where(again | ~news, 1.0, since_s), steps,
            np.where(news, height, np.nan), variance, self._walked,
        )  # fmt: skip
        before = self._height_means()
        update = episodes.update(self._beliefs, reported)
        self._beliefs = update.beliefs
        before_s = np.where(news, taken_s[1] - np.maximum(taken_s[0], begin_s), 0.0)
        unseen_s = time_s - np.maximum(taken_s[1], begin_s)
        absent = time_s - taken_s[1] > UNSEEN_S
        silent_s = np.where(absent, unseen_s, np.where(before_s > UNSEEN_S, before_s, 0.0))
        self._open.append(
            _Interval(
                begin_s, time_s, taken_s, reported, update, self._height_means() - before,
                np.array([one.way_m for one in moved]),
                np.array([one.displacement_m for one in moved]),
                silent_s, again, np.array([one.made_m for one in moved]),
            )
        )  # fmt: skip
        self._walked = np.where(news, steps > STANDS_STEPS, self._walked)

    def _height_means(self) -> Floats:
        mean: Floats = (self._beliefs.probability * self._beliefs.mean_m).sum(axis=(1, 2))
        return mean

    def _corrections(self, time_s: float) -> list[Advance]:
        """Take back what the open intervals claim too much of, as far as that is known."""
        shares, expected = true_shares(
            np.array([one.reported.steps for one in self._open]),
            np.array([one.way_m for one in self._open]),
            np.array([one.rise_m - one.happened.pressed_m for one in self._open]),
            *(
                np.array([one.probability[:, :, way].sum(axis=(1, 2)) for one in self._open])
                for way in (UP, DOWN)
            ),
        )
        total = sum(
            share * one.moved - one.made for share, one in zip(shares, self._open, strict=True)
        )
        worth = np.abs(total) >= LEAST_CORRECTION_M
        for share, one in zip(shares, self._open, strict=True):
            one.share = share
            one.made = np.where(worth, share * one.moved, one.made)
        corrections = []
        for node, row in self._row.items():
            track = self._tracks[node]
            track.expected = float(expected[row])
            if worth[row]:
                back = complex(total[row]) / track.heading
                sigma_m = DOUBTED_CORRECTION * np.abs([back.real, back.imag])
                corrections.append(
                    Advance(
                        time_s, node, 0.0, back.real, back.imag, 0.0,
                        sigma_x_m=float(sigma_m[0]), sigma_y_m=float(sigma_m[1]),
                    )
                )  # fmt: skip
        return corrections

    def _decide(self, until_s: float) -> None:
        """Decide what happened in the intervals that ended by then."""
        count = sum(one.end_s <= until_s for one in self._open)
        for one in self._open[:count]:
            self._apply(one)
        del self._open[:count]

    def _apply(self, one: _Interval) -> None:
        """Let what happened in an interval move the heights."""
        duration_s = one.end_s - one.begin_s
        heights = self.heights
        moving, disturbed, common_m, pressed_m = one.happened
        heights.advance(duration_s, one.rise_m, moving, disturbed, one.silent_s, pressed_m)
        heights.moved(moving**2 * 2.0 * one.reported.variance_m2)
        heights.correct(one.reported.height_m, one.reported.variance_m2)
        moves = (moving > 0.5) | one.again
        # Without heights nobody sees a wearer change floors: none is sure, or teaches its height.
        unseen = moves | (one.silent_s > 0.0)
        self._level_s = np.where(unseen, 0.0, self._level_s + duration_s)
        self._level_steps = np.where(moves, 0.0, self._level_steps + one.reported.steps)
        self._settled &= ~unseen
        walks = (moving > 0.5) | (one.reported.steps > STANDS_STEPS)
        pressed_m = pressed_m + disturbed * one.rise_m
        self._doubt_m *= np.where(self._settled, math.exp(-duration_s / FAST_S), 1.0)
        self._doubt_m += _doubted_m(moving, one.rise_m, pressed_m - walks * common_m)
        # Who walks while the pressure rises for others, but not here, may have climbed.
        self._settled &= (np.abs(self._doubt_m) < LEAST_CLIMB_M) | ~walks
        kept = np.where(self._settled & ~walks, POSTURE_M, math.inf)
        self._doubt_m = np.clip(self._doubt_m, -kept, kept)
        self._locate()
        if self.decided is not None:
            for node, row in self._row.items():
                begin_s, end_s = one.taken_s[:, row].tolist()
                if begin_s < end_s:
                    z_m, share = self._height(row)[0], float(one.share[row])
                    self.decided.append(Decided(node, begin_s, end_s, share, z_m))

    def _locate(self) -> None:
        """Find the floors of those who have changed their height."""
        heights, floors = self.heights, self.floors
        bias_m = heights.mean[:, FAST] + heights.mean[:, SLOW]
        slow_m2 = heights.covariance[:, SLOW, SLOW]
        tells = self._settled & ~self._own_zero & (slow_m2 < VAGUE_M**2)
        known = np.where(tells, bias_m, np.nan)
        pressed_m, shown = np.zeros(len(bias_m)), np.zeros(len(bias_m), dtype=np.bool_)
        biases_m = known.tolist()
        for row in range(len(bias_m)):
            others = [m for k, m in enumerate(biases_m) if k != row and math.isfinite(m)]
            # Some who were all misled by a fan do not outvote those who were not.
            shown[row] = len(others) > 0 and 2 * len(others) >= len(bias_m) - 1
            if shown[row]:
                pressed_m[row] = statistics.median(others)
        # Of the bias, and of a height that is no longer reported.
        over_m2 = slow_m2 + np.maximum(heights.covariance.sum(axis=(1, 2)), 0.0)
        over_m2 += UNKNOWN_M**2 * self._own_zero
        shown &= ~self._own_zero
        self._over = Over(heights.over_m - pressed_m, over_m2)
        lost = shown & (np.abs(bias_m - pressed_m) > LOST_M + np.sqrt(slow_m2))
        self._settled &= ~lost
        self._doubt_m = np.where(lost, SPACING_M, self._doubt_m)
        open_ = np.flatnonzero(~self._settled)
        if not open_.size:
            return
        floors.probability[open_] = floors.where(
            self._base[open_],
            heights.mean[open_, Z],
            heights.covariance[open_, Z, Z] + self._doubt_m[open_] ** 2,
            self._level_steps[open_],
            Over(*(v[open_] for v in self._over)),
        )
        for row in open_[self._level_s[open_] >= SETTLES_S].tolist():
            floor, probability = most_probable(floors.probability[row])
            if floor is None or probability < CERTAIN:
                continue
            base, doubt_m = int(self._base[row]), float(self._doubt_m[row])
            climbed_m, variance_m2 = heights.mean[row, Z], heights.covariance[row, Z, Z]
            floors.learn(base, floor, float(climbed_m), float(variance_m2), doubt_m)
            heights.doubt(row, doubt_m)
            between_m = floors.climbs(self._base[row])[0][floor - LOWEST]
            heights.rebase(row, float(between_m))
            heights.observe(row, 0.0, floors.scatter * WORN_M2)
            self._settled[row], self._base[row], self._doubt_m[row] = True, floor, 0.0

    def _height(self, row: int, more_m: float = 0.0) -> tuple[float, float]:
        """Return the height of one who has risen by more, without doubts, and its variance."""
        z_m, variance_m2 = self.floors.height_of(
            int(self._base[row]), float(self.heights.mean[row, Z]) + more_m
        )
        return z_m, variance_m2 + float(self.heights.covariance[row, Z, Z])

    # -- what is known -------------------------------------------------------------------------

    def of(self, node: int, time_s: float) -> Vertical:
        """Return what is known of a node."""
        row = self._row.get(node)
        if row is None:
            at_post = node in self.posts and self.active
            return AT_POST if at_post else self._unmeasured(time_s)
        climbed = risen_m = unseen_m2 = 0.0
        doubt_m = self._doubt_m[row]
        for one in self._open:
            moving = float(one.happened.moving[row])
            pressed_m = float(one.happened.pressed_m[row])
            rise = one.rise_m[row]
            risen_m += moving * rise - pressed_m
            climbed += one.probability[row, :, STAIRS].sum() * rise - pressed_m
            undecided_m = math.sqrt(max(moving * (1.0 - moving), 0.0)) * rise
            doubt_m += -undecided_m if moving > 0.5 else undecided_m
            unseen_m2 += UNSEEN_M**2 * one.silent_s[row]
        ahead_m = self._ahead_m(node, row, time_s)
        z_m, variance_m2 = self._height(row, risen_m + ahead_m)
        # On a known floor it is posture, which climbs do not show.
        doubted = 1.0 if self._settled[row] else self.floors.scatter
        variance_m2 += unseen_m2 + doubted * doubt_m**2 + (DOUBTED * ahead_m) ** 2
        # With the news of one more interval, where there is one.
        modes = self._open[-2:][0].probability if self._open else self._beliefs.probability
        told = episodes.episodes_of(modes[row])
        if abs(climbed) < LEAST_CLIMB_M:
            told[episodes.EPISODES.index(Episode.LEVEL)] += told[_CLIMBS].sum()
            told[_CLIMBS] = 0.0
        k = int(np.argmax(told))
        where, steps = self.floors.probability[row], self._level_steps[row]
        level = [float(one.happened.level[row]) for one in self._open]
        vague = unseen_m2 >= VAGUE_M**2
        stays = self._settled[row] and not vague and min(level, default=1.0) >= 0.5
        if not stays:
            for one, p in zip(self._open, level, strict=True):
                steps = steps * p + one.reported.steps[row]
            own_m2 = self.heights.covariance[row, Z, Z] + unseen_m2 + doubt_m**2
            climbed_m = self.heights.mean[row, Z] + risen_m
            over_m2 = self._over.variance_m2[row] + vague * unseen_m2
            over = Over(self._over.mean_m[row] + risen_m, over_m2)
            where = self.floors.where(self._base[row], climbed_m, own_m2, steps, over)
        floor, certain = most_probable(where)
        if stays:
            variance_m2 += float(where[:-1] @ (self.floors.mean_m - z_m) ** 2)
        else:
            walked = steps * (level or [1.0])[-1]
            z_m, variance_m2 = self.floors.drawn_to(z_m, variance_m2, where, walked)
        variance_m2 += self.floors.scale2 * z_m**2
        probability = None if floor is None else certain
        return Vertical(
            float(z_m), math.sqrt(variance_m2), episodes.EPISODES[k], float(told[k]), floor,
            probability,
        )  # fmt: skip

    def _ahead_m(self, node: int, row: int, time_s: float) -> float:
        """Return what a node rises until a time that no reported height shows yet."""
        if not self._open:
            return 0.0
        one = self._open[-1]
        late_s = min(time_s - self._tracks[node].height_s, INTERVAL_S * 2) + HEIGHT_LATE_S
        rise_m = one.happened.moving[row] * one.rise_m[row] - one.happened.pressed_m[row]
        return float(late_s * rise_m / one.reported.since_s[row])

    def _unmeasured(self, time_s: float) -> Vertical:
        """A node that never reported a height: it may have climbed since the start."""
        if not self.active:
            return Vertical()
        grown = START_M**2 + UNSEEN_M**2 * max(time_s - self._worn_s, 0.0)
        return Vertical(0.0, min(math.sqrt(grown), UNKNOWN_M))


def _doubted_m(moving: Floats, rise_m: Floats, pressed_m: Floats) -> Floats:
    """Return what was climbed more in an interval if modes err (N,): a standard deviation, signed.

    Of a rise that is said to be the pressure's as much may have been climbed; what is said to be
    climbed may have been the pressure's.
    """
    climbed = moving > 0.5
    undecided_m = np.sqrt(np.maximum(moving * (1.0 - moving), 0.0)) * rise_m
    undecided_m = np.where(climbed, -undecided_m, undecided_m)
    pressed_m = DOUBTED * pressed_m
    return np.where(np.abs(undecided_m) > np.abs(pressed_m), undecided_m, pressed_m)


AT_POST = Vertical(0.0, START_M, Episode.LEVEL, 1.0, 0, 1.0)
"""Where a node of the command post is."""

_CLIMBS = np.array([e in (Episode.UP, Episode.DOWN) for e in episodes.EPISODES])

WORN_M2 = 0.15**2
"""Variance of a node's height over its floor's."""
