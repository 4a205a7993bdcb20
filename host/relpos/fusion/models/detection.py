"""Which attempts to range succeed, by distance: the detection curve, learned as the team ranges.

A range that was attempted and did not come is a measurement too (negative information): the two
are probably far apart. How far depends on radio, bodies and walls, so P(received | distance) is
learned from the team itself. The family is a logistic edge,

    P(d) = eps + (1 - 2 eps) p0 / (1 + exp((d - R) / (w R))),

with the posterior of (p0, R, w) on a grid; hypotheses are weighed with its mean curve. An edge
that was never seen says next to nothing, one that was seen clearly says much. Evidence fades
slowly (``MEMORY``), because surroundings change.

A missed attempt has other causes than distance, so it counts with care:

* a slab attenuates, and what is above or below the other says nothing of the plane: pairs that
  may be a storey apart count neither as received nor as missed (``on_one_floor``);
* a pair counts as attempted only where one of the two took part in another range of the same
  round and the other is alive (it ranged, or moved of late), and only once a range of the pair was
  received at all: pairs that never range each other tell nothing;
* the UWB of a node that nobody receives may have failed: a two-state hidden Markov chain carries
  each node's probability of that, and its missed attempts count by so much less;
* of two who range nobody else no miss is ever seen, and no curve learned: their ranges, however
  many, say nothing of how near they are;
* what blocks a pair now blocks it a second later: the correlation rho of consecutive surprises is
  measured, and each attempt counts (1 - rho) / (1 + rho) independent ones, the effective sample
  count of a first-order autoregressive sequence.

A *round* is one instant where ranges of several initiators share it (simulations, synchronised
systems); where nodes range in turns it lasts until a node ranges the same peer again, which
covers the schedule whatever it is.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import chain, compress
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from relpos.fusion.arrays import Bools, Floats, Indices
from relpos.fusion.compiled import compiled, inlined
from relpos.measurements import Range

Pair = tuple[int, int]

STEP_M = 0.5
"""Spacing of the tabulated curve."""

LENGTH = 201
"""Entries of the curve: 0 to 100 m; farther is as far as that."""

# -- rounds of ranging -----------------------------------------------------------------------------

ALIVE_S = 2.5
"""A node whose newest motion is not older is alive: two reports in a row may be lost."""

ONE_FLOOR_M = 1.75
"""Half a storey: whose heights differ by less, and surely so, are on one floor."""


def on_one_floor(dz_m: Floats, variance_m2: Floats) -> Bools:
    """Return which pairs are on one floor, by their differences of height and those's variances."""
    return np.abs(dz_m) + np.sqrt(variance_m2) < ONE_FLOOR_M


@dataclass(frozen=True, slots=True)
class Round:
    """The attempts of one round of ranging: received ones and missed ones (pairs, lower id first).

    ``observable`` tells of each received pair whether a miss would have counted as attempted:
    the curve is learned from those alone, or it would be learned from chosen successes.
    """

    time_s: float
    received: tuple[Pair, ...]
    missed: tuple[Pair, ...]
    observable: tuple[bool, ...]


@dataclass(slots=True)
class Rounds:
    """Divides ranges into rounds and finds the missed attempts of each.

    ``ever_received`` holds the pairs that are known to range each other.
    """

    ever_received: set[Pair] = field(default_factory=set)
    _turns: float | None = None
    """Running share of instants in which one node alone initiated: near 1 where in turns."""
    _open: set[Pair] = field(default_factory=set)
    _directed: set[Pair] = field(default_factory=set)

    def add(
        self,
        time_s: float,
        ranges: Sequence[Range],
        reported_s: Callable[[int], float],
        level: Callable[[Sequence[Pair]], Bools] | None = None,
    ) -> list[Round]:
        """Return the rounds that end with these ranges of one instant: none, one or two.

        ``reported_s`` returns the time of a node's newest motion, -inf where there was none;
        ``level`` which pairs are on one floor: all, where nobody's height is known.
        """
        rounds = []
        directed = {(r.node, r.peer) for r in ranges}
        in_turns = float(len({r.node for r in ranges}) == 1)
        turns = in_turns if self._turns is None else self._turns
        self._turns = turns + 0.1 * (in_turns - turns)
        if self._open and (self._turns < 0.5 or not directed.isdisjoint(self._directed)):
            rounds.append(self._close(time_s, reported_s, level))
        self._directed |= directed
        self._open |= {pair if pair[0] < pair[1] else pair[::-1] for pair in directed}
        if self._turns < 0.5:
            rounds.append(self._close(time_s, reported_s, level))
        return rounds

    def _close(
        self,
        time_s: float,
        reported_s: Callable[[int], float],
        level: Callable[[Sequence[Pair]], Bools] | None,
    ) -> Round:
        received = self._open
        self.ever_received |= received
        busy = Counter(chain.from_iterable(received))
        missed = []
        for pair in self.ever_received - received:
            there = (pair[0] in busy) + (pair[1] in busy)
            if there == 1:
                other = pair[1] if pair[0] in busy else pair[0]
                there += reported_s(other) >= time_s - ALIVE_S
            if there == 2:
                missed.append(pair)
        missed.sort()
        self._open, self._directed = set(), set()
        ends = Counter(chain.from_iterable(self.ever_received))
        ordered = sorted(pair for pair in received if ends[pair[0]] + ends[pair[1]] > 2)
        if level is not None:
            ordered = list(compress(ordered, level(ordered)))
            missed = list(compress(missed, level(missed)))
        observable = tuple([busy[a] > 1 or busy[b] > 1 for a, b in ordered])
        return Round(time_s, tuple(ordered), tuple(missed), observable)


# -- the statistics of attempts --------------------------------------------------------------------

FAILS = 0.002
"""Probability that a node's UWB falls silent in a round; an hour has 1,800 rounds, and a wrong
alarm costs only a little of the information."""

TRUSTED_M = 1.0
"""An attempt's weight is 1 / (1 + (sigma / this)^2): it teaches the less, the less its distance is
known. Received and missed ones need the distance predicted before the round, or the received
ones, which are better known afterwards, would be over-counted."""


class Attempts(NamedTuple):
    """U attempts of one round as arrays, the received ones first.

    ``first`` and ``second`` (U,) are the nodes' slots, ``observable`` (received,) is 1 or 0,
    ``distance_m`` and ``sigma_m`` (U,) the predicted distances and their standard deviations.
    """

    first: Indices
    second: Indices
    received: int
    observable: Floats
    distance_m: Floats
    sigma_m: Floats


class Statistics(NamedTuple):
    """What has been seen so far, of S nodes."""

    working: Floats
    """(S,) probability that each node's UWB works."""
    surprise: Floats
    """(S, S) last outcome less its probability, of each pair; NaN before the first."""
    counts: Floats
    """(2, LENGTH) attempts by outcome (missed, received) and distance."""
    sums: Floats
    """(3,): products of consecutive surprises, their mean squares, and attempts."""


@inlined
def _place(distance_m: float, sigma_m: float, q: int) -> float:
    """Place in the curve of one of three points over the distance's error (Gauss-Hermite)."""
    place = (distance_m + (q - 1) * math.sqrt(3.0) * sigma_m) / STEP_M
    # A place of NaN is 0, too: an index that is made of it has to lie within the arrays.
    return min(place, LENGTH - 1.0) if place > 0.0 else 0.0


@compiled
def add_attempts(attempts: Attempts, curve: Floats, statistics: Statistics) -> Floats:
    """Add one round to the statistics, in place.

    ``curve`` (LENGTH,) is P(received | distance) as learned so far. Returns (U - received,): the
    probability that each missed attempt was made, which is that both nodes' UWB worked.
    """
    first, second, received, observable, distance_m, sigma_m = attempts
    working, surprise, counts, sums = statistics
    several, slots = first.shape[0], working.shape[0]
    chance, attempted = np.empty(several), np.empty(several - received)
    busy = np.zeros(slots, dtype=np.bool_)
    silence = np.full(slots, -1.0)
    for u in range(several):
        chance[u] = 0.0
        for q in range(3):
            place = _place(distance_m[u], sigma_m[u], q)
            index = min(int(place), LENGTH - 2)
            here = curve[index] + (place - index) * (curve[index + 1] - curve[index])
            chance[u] += here * (4.0 if q == 1 else 1.0) / 6.0
        if u < received:
            busy[first[u]] = busy[second[u]] = True
            continue
        for slot in (first[u], second[u]):
            if not busy[slot]:
                silence[slot] = abs(silence[slot]) * (1.0 - chance[u])
    for slot in range(slots):
        if busy[slot]:
            working[slot] = 1.0
        elif silence[slot] >= 0.0:
            up = working[slot] * (1.0 - FAILS)
            working[slot] = up * silence[slot] / (up * silence[slot] + 1.0 - up)
    for u in range(several):
        a, b = first[u], second[u]
        weight = 1.0 / (1.0 + (sigma_m[u] / TRUSTED_M) ** 2)
        now = -chance[u]
        outcome = 0
        if u < received:
            weight *= observable[u]
            now += 1.0
            outcome = 1
        else:
            attempted[u - received] = working[a] * working[b]
            weight *= attempted[u - received]
        before = surprise[a, b]
        if not math.isnan(before):
            sums[0] += weight * before * now
            sums[1] += weight * 0.5 * (before * before + now * now)
        surprise[a, b] = now
        for q in range(3):
            place = _place(distance_m[u], sigma_m[u], q)
            index = min(int(place), LENGTH - 2)
            share = weight * (4.0 if q == 1 else 1.0) / 6.0
            counts[outcome, index] += share * (1.0 - (place - index))
            counts[outcome, index + 1] += share * (place - index)
        sums[2] += weight
    return attempted


# -- the curve -------------------------------------------------------------------------------------

FLOOR = 0.002
"""Least probability of either outcome: reflections are received far out, antennas have nulls."""

MEMORY = 20_000.0
"""Attempts after which evidence has faded to 1/e: half an hour of six people."""

SHAPE = 0.03
"""Relative error of the edge because no real edge is quite of this family (hard ones at 10 and
15 m, seen with distances uncertain by 0.1 to 0.4 m, were placed 1 to 7 % too near)."""

_NEAR = np.array([0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.96, 0.995])
_EDGE_M = np.geomspace(2.0, 80.0, 90)
_SOFTNESS = np.array([0.005, 0.03, 0.08, 0.2, 0.5])

FADES_SOFTLY, FADES_WITHIN_M = 0.2, 25.0
"""Curves so soft, whose half is nearer, are those of walls. Of mixed missions with walls people
have 9 to 25 m. In the open a curve is as soft for the first minutes, but its half is far out: with
all of the softest ``mission-base`` has a NEES of .64 in place of .81, ``floors`` .47 of .73. With
the softest alone, .5, 32 people in an office are told walls by turns (seeds 3100 and 3101, NEES
4.5; so .99): what they lose lies between the two."""

WALLS_SCALE_SD = 0.03
"""Standard deviation of the share of a distance by which ranges are too long where detection fades
with distance, as through walls (as ``RANGE_SCALE_SD`` in :mod:`relpos.fusion.models.ranging`).

What walls add a metre, step scales and growth take for their own (docs/notebook/missions.md)."""

GRID_M = np.arange(LENGTH) * STEP_M
_OFFSETS = math.sqrt(3.0) * np.array([[-1.0], [0.0], [1.0]])
_SHARES = np.array([[1.0], [4.0], [1.0]]) / 6.0
"""Three-point Gauss-Hermite rule: offsets in standard deviations, and their shares."""

LONG_SHOT = 28.0
"""Curves whose log posterior is so far below the best one's do not count: 1e-12 each."""


@dataclass(frozen=True, slots=True)
class _Family:
    """All curves, F = P0 * R * W of them."""

    curves: npt.NDArray[np.float32]
    """(F, LENGTH)."""
    log_missed: npt.NDArray[np.float32]
    log_received: npt.NDArray[np.float32]
    """(LENGTH, F): attempts lie at some distances only, whose rows are then one after another."""
    edge_m: Floats
    fades: Bools
    """(F,) those of walls (``FADES_SOFTLY``, ``FADES_WITHIN_M``)."""
    fades_at_first: float
    """How probable these are while all curves are alike, summed as a posterior is."""


@cache
def _family() -> _Family:
    """Make all curves, when first needed; all teams of this process share them."""
    near, edge, soft = (
        grid.reshape(-1, 1) for grid in np.meshgrid(_NEAR, _EDGE_M, _SOFTNESS, indexing="ij")
    )
    exponent = (GRID_M - edge) / (soft * edge)
    curves = near / (1.0 + np.exp(np.clip(exponent, -60.0, 60.0)))
    curves = FLOOR + (1.0 - 2.0 * FLOOR) * curves
    single = np.float32
    fades = (soft.ravel() >= FADES_SOFTLY) & (edge.ravel() < FADES_WITHIN_M)
    return _Family(
        curves.astype(single),
        np.ascontiguousarray(np.log1p(-curves).T.astype(single)),
        np.ascontiguousarray(np.log(curves).T.astype(single)),
        edge.ravel(),
        fades,
        float(np.full(len(fades), 1.0 / len(fades)) @ fades),
    )


@dataclass(slots=True)
class Detection:
    """The learned curve of one team.

    ``curve`` (LENGTH,) is P(received | distance) at multiples of ``STEP_M`` for a pair that was
    attempted. ``range_m`` and ``range_sigma_m`` are the distance of half the near value.
    ``obstructed`` (0 to 1) is by how much more probable than at first it is that detection fades
    with distance, as through walls, and has no edge.
    """

    rounds: Rounds = field(default_factory=Rounds)
    curve: Floats = field(init=False)
    range_m: float = field(init=False)
    range_sigma_m: float = field(init=False)
    obstructed: float = field(init=False)
    _statistics: Statistics = field(
        default_factory=lambda: Statistics(
            np.ones(0), np.empty((0, 0)), np.zeros((2, LENGTH)), np.array([0.0, 25.0, 0.0])
        )
    )
    _refit_at: float = 0.0
    _slot: dict[int, int] = field(default_factory=dict)
    """Where in the statistics a node is."""

    def __post_init__(self) -> None:
        self._refit()

    @property
    def weight(self) -> float:
        """How many independent attempts one counts (0 to 1)."""
        together, apart, _ = self._statistics.sums.tolist()
        rho = min(max(together / apart, 0.0), 0.9)
        return float((1.0 - rho) / (1.0 + rho))

    @property
    def known(self) -> bool:
        """Whether an edge has been seen at all, so that ``range_m`` means something."""
        return self.range_sigma_m < 0.3 * self.range_m

    @property
    def range_scale_sd(self) -> float:
        """The deviation of what walls add to ranges, in proportion to distance."""
        return WALLS_SCALE_SD * math.sqrt(self.obstructed)

    def probability(self, distance_m: Floats, sigma_m: Floats | float = 0.0) -> Floats:
        """P(received) over distances (K,), averaged over their Gaussian errors."""
        place = distance_m + _OFFSETS * sigma_m
        mean: Floats = (_SHARES * np.interp(place, GRID_M, self.curve)).sum(axis=0)
        return mean

    def update(self, of: Round, distance_m: Floats, sigma_m: Floats) -> Floats:
        """Learn from one round; return (missed,), how surely each missed attempt was made.

        ``distance_m`` and ``sigma_m`` are predicted before the round, of ``of.received`` and then
        of ``of.missed``.
        """
        pairs = of.received + of.missed
        if not pairs:
            return np.empty(0)
        slot = self._slot
        try:
            slots = np.array([(slot[a], slot[b]) for a, b in pairs], dtype=np.int64)
        except KeyError:
            self._add(pairs)
            return self.update(of, distance_m, sigma_m)
        first, second = np.ascontiguousarray(slots.T)
        observable = np.array(of.observable, dtype=np.float64)
        attempts = Attempts(first, second, len(of.received), observable, distance_m, sigma_m)
        attempted = add_attempts(attempts, self.curve, self._statistics)
        if self._statistics.sums[2] >= self._refit_at:
            self._refit()
        return attempted

    def _add(self, pairs: Sequence[Pair]) -> None:
        """Make room for nodes that were not met before."""
        for node in sorted({node for pair in pairs for node in pair} - self._slot.keys()):
            self._slot[node] = len(self._slot)
        old = self._statistics
        more = len(self._slot) - len(old.working)
        self._statistics = old._replace(
            working=np.pad(old.working, (0, more), constant_values=1.0),
            surprise=np.pad(old.surprise, (0, more), constant_values=np.nan),
        )

    def _refit(self) -> None:
        family, (_, _, seen, sums) = _family(), self._statistics
        if sums[2] > MEMORY:
            seen *= MEMORY / sums[2]
            sums[2] = MEMORY
        counts = seen.astype(np.float32)
        log_posterior = np.zeros(len(family.curves), dtype=np.float32)
        for outcome, logs in enumerate((family.log_missed, family.log_received)):
            there = np.flatnonzero(counts[outcome])
            if there.size:
                some = slice(int(there[0]), int(there[-1]) + 1)
                log_posterior += counts[outcome, some] @ logs[some]
        log_posterior -= log_posterior.max()
        likely = np.flatnonzero(log_posterior > -LONG_SHOT)
        posterior = np.exp(log_posterior[likely].astype(np.float64))
        posterior /= posterior.sum()
        self.curve = (posterior.astype(np.float32) @ family.curves[likely]).astype(np.float64)
        edge_m = family.edge_m[likely]
        self.range_m = float(posterior @ edge_m)
        fades, at_first = float(posterior @ family.fades[likely]), family.fades_at_first
        self.obstructed = max(fades - at_first, 0.0) / (1.0 - at_first)
        spread = float(posterior @ (edge_m - self.range_m) ** 2)
        self.range_sigma_m = math.sqrt(spread + (SHAPE * self.range_m) ** 2 + STEP_M**2 / 12.0)
        # Later evidence changes little: the cost of refitting stays a small share of the whole.
        attempts = float(sums[2])
        self._refit_at = min(attempts * 1.15, attempts + 1000.0) + 10.0
