"""Who is heard over which distance, learned as it goes: what silence says of two positions.

A range that was attempted and did not come is a measurement too: the two are probably far apart.
How far depends on radio, bodies and walls, so the curve P(heard | distance) is learned by the
team itself. The family is a logistic edge,

    P(d) = eps + (1 - 2 eps) p0 / (1 + exp((d - R) / (w R))),

with everything known of (p0, R, w) kept as a posterior on a grid; hypotheses are weighed with
its mean curve. So an edge that was never seen says next to nothing, and one that was seen
clearly says much. Evidence fades slowly (``MEMORY``): surroundings change.

Silence is told with care, because it has other causes than distance:

* a pair counts as tried only where one of the two took part in another range of the same round
  and the other is alive (it ranged, or moved of late), and only once the pair was heard at all:
  of pairs that nobody ever ranges silence says nothing;
* a node that nobody hears may have lost its UWB: each node's probability of that is carried
  along (a two-state hidden Markov chain), and silence counts by so much less;
* what blocks a pair now blocks it a second later: the correlation of consecutive surprises is
  measured, and the weight of each is reduced to what independent ones would have
  ((1 - rho) / (1 + rho), the effective number of a first-order autoregressive sequence).

A *round* is one instant where ranges of several initiators share it (simulations, synchronised
systems); where nodes range in turns it lasts until somebody ranges the same peer again, which
covers the schedule whatever it is.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from typing import Protocol

import numpy as np
import numpy.typing as npt

from relpos.measurements import Range

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Pair = tuple[int, int]

STEP_M = 0.5
"""Spacing of the tabulated curve."""

LENGTH = 201
"""Entries of the curve: 0 to 100 m; farther is as far as that."""

FLOOR = 0.002
"""Least probability of either outcome: reflections are heard far out, antennas have nulls."""

MEMORY = 20_000.0
"""Attempts after which evidence has faded to 1/e: half an hour of six people."""

ALIVE_S = 2.5
"""A node whose newest motion is not older is alive: two reports in a row may be lost."""

FAILS = 0.002
"""Probability that a node's UWB falls silent in a round; an hour has 1,800 rounds, and a wrong
alarm costs only a little of the information."""

TRUSTED_M = 1.0
"""Attempts teach the less, the less their distance is known: weight 1 / (1 + (sigma / this)^2).
Both outcomes must be given with the distance predicted before the round, or the heard ones,
which are better known afterwards, would be over-counted."""

SHAPE = 0.03
"""Relative error of the edge because no real edge is quite of this family (hard ones at 10 and
15 m, seen with distances uncertain by 0.1 to 0.4 m, were placed 1 to 7 % too near)."""

_NEAR = np.array([0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.96, 0.995])
_EDGE_M = np.geomspace(2.0, 80.0, 90)
_SOFTNESS = np.array([0.005, 0.03, 0.08, 0.2, 0.5])
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
    log_silent: npt.NDArray[np.float32]
    log_heard: npt.NDArray[np.float32]
    """(LENGTH, F): attempts lie at some distances only, whose rows are then one after another."""
    edge_m: Floats


@cache
def _family() -> _Family:
    """Make all curves, when first needed; all teams of this process share them."""
    distance = np.arange(LENGTH) * STEP_M
    near, edge, soft = (
        grid.reshape(-1, 1) for grid in np.meshgrid(_NEAR, _EDGE_M, _SOFTNESS, indexing="ij")
    )
    exponent = (distance - edge) / (soft * edge)
    curves = near / (1.0 + np.exp(np.clip(exponent, -60.0, 60.0)))
    curves = FLOOR + (1.0 - 2.0 * FLOOR) * curves
    single = np.float32
    return _Family(
        curves.astype(single),
        np.ascontiguousarray(np.log1p(-curves).T.astype(single)),
        np.ascontiguousarray(np.log(curves).T.astype(single)),
        edge.ravel(),
    )


@dataclass(frozen=True, slots=True)
class Round:
    """Who was heard in one round of ranging, and who was tried in vain (pairs, lower id first).

    ``witnessed`` tells of each heard pair whether its silence would have counted as tried: only
    those may teach, or the curve would be learned from chosen successes.
    """

    time_s: float
    heard: tuple[Pair, ...]
    silent: tuple[Pair, ...]
    witnessed: tuple[bool, ...]


@dataclass(slots=True)
class Rounds:
    """Divides ranges into rounds and tells which pairs of each were tried in vain.

    ``heard_ever`` holds the pairs that are known to range each other.
    """

    heard_ever: set[Pair] = field(default_factory=set)
    _turns: float | None = None
    """Running share of instants in which one node alone initiated: near 1 where in turns."""
    _open: set[Pair] = field(default_factory=set)
    _directed: set[Pair] = field(default_factory=set)

    def take(
        self, time_s: float, ranges: Sequence[Range], reported_s: Callable[[int], float]
    ) -> list[Round]:
        """Give the rounds that end with these ranges of one instant: none, one or two.

        ``reported_s`` tells the time of a node's newest motion, -inf where there was none.
        """
        rounds = []
        directed = {(r.node, r.peer) for r in ranges}
        in_turns = float(len({r.node for r in ranges}) == 1)
        turns = in_turns if self._turns is None else self._turns
        self._turns = turns + 0.1 * (in_turns - turns)
        if self._open and (self._turns < 0.5 or not directed.isdisjoint(self._directed)):
            rounds.append(self._close(time_s, reported_s))
        self._directed |= directed
        self._open |= {pair if pair[0] < pair[1] else pair[::-1] for pair in directed}
        if self._turns < 0.5:
            rounds.append(self._close(time_s, reported_s))
        return rounds

    def _close(self, time_s: float, reported_s: Callable[[int], float]) -> Round:
        heard = self._open
        self.heard_ever |= heard
        busy = Counter(chain.from_iterable(heard))
        silent = []
        for pair in self.heard_ever - heard:
            there = (pair[0] in busy) + (pair[1] in busy)
            if there == 1:
                other = pair[1] if pair[0] in busy else pair[0]
                there += reported_s(other) >= time_s - ALIVE_S
            if there == 2:
                silent.append(pair)
        silent.sort()
        self._open, self._directed = set(), set()
        ordered = tuple(sorted(heard))
        witnessed = tuple([busy[a] > 1 or busy[b] > 1 for a, b in ordered])
        return Round(time_s, ordered, tuple(silent), witnessed)


class Teach(Protocol):
    """Learn from one round, in place, and tell what its silences are worth.

    Pairs (U,) of slots ``first`` and ``second``, the ``heard`` ones first, with their predicted
    distances and standard deviations (m) and whether the heard ones were ``witnessed`` (1 or 0).
    ``working`` (S,), ``surprise`` (S, S), ``counts`` (2, LENGTH) and ``sums`` (together, apart,
    seen) are of :class:`Detection`. Returns (U - heard,): the probability that both nodes' UWB
    worked.
    """

    def __call__(
        self, first: Indices, second: Indices, heard: int, witnessed: Floats, distance_m: Floats,
        sigma_m: Floats, curve: Floats, working: Floats, surprise: Floats, counts: Floats,
        sums: Floats,
    ) -> Floats:  # fmt: skip
        """Learn; see the class's text."""


def teach(
    first: Indices, second: Indices, heard: int, witnessed: Floats, distance_m: Floats,
    sigma_m: Floats, curve: Floats, working: Floats, surprise: Floats, counts: Floats,
    sums: Floats,
) -> Floats:  # fmt: skip
    """See :class:`Teach`; the bank uses a compiled twin (``bank_kernels.teach``)."""
    chance = expected(curve, distance_m, sigma_m)
    # Each node's probability that its UWB works, from whether anybody hears it.
    busy = {int(slot) for slot in (*first[:heard], *second[:heard])}
    unheard: dict[int, float] = {}
    for a, b, p in zip(first[heard:], second[heard:], chance[heard:], strict=True):
        for slot in (int(a), int(b)):
            if slot not in busy:
                unheard[slot] = unheard.get(slot, 1.0) * (1.0 - float(p))
    working[list(busy)] = 1.0
    for slot, silence in unheard.items():
        up = working[slot] * (1.0 - FAILS)
        working[slot] = up * silence / (up * silence + 1.0 - up)
    tried: Floats = working[first[heard:]] * working[second[heard:]]
    weight = 1.0 / (1.0 + (sigma_m / TRUSTED_M) ** 2)
    weight[:heard] *= witnessed
    weight[heard:] *= tried
    # Each pair's surprise beside its last one.
    now = (np.arange(len(first)) < heard) - chance
    before = surprise[first, second]
    again = ~np.isnan(before)
    w, then, since = weight[again], before[again], now[again]
    sums[0] += float((w * then * since).sum())
    sums[1] += float((w * 0.5 * (then**2 + since**2)).sum())
    surprise[first, second] = now
    # Attempts are spread over the two nearest entries of three places each.
    place = np.clip((distance_m + _OFFSETS * sigma_m) / STEP_M, 0.0, LENGTH - 1.001)
    index = place.astype(np.intp)
    beyond = place - index
    share = _SHARES * weight
    for outcome, some in ((1, slice(None, heard)), (0, slice(heard, None))):
        np.add.at(counts[outcome], index[:, some], (share * (1.0 - beyond))[:, some])
        np.add.at(counts[outcome], index[:, some] + 1, (share * beyond)[:, some])
    sums[2] += float(weight.sum())
    return tried


@dataclass(slots=True)
class Detection:
    """The learned curve of one team.

    ``curve`` (LENGTH,) is P(heard | distance) at multiples of ``STEP_M`` for a pair that was
    tried; ``weight`` (0 to 1) is what one silence counts, see the module's text. ``range_m`` and
    ``range_sigma_m`` are the distance of half the near value.
    """

    rounds: Rounds = field(default_factory=Rounds)
    teach: Teach = teach
    curve: Floats = field(init=False)
    range_m: float = field(init=False)
    range_sigma_m: float = field(init=False)
    _counts: Floats = field(default_factory=lambda: np.zeros((2, LENGTH)))
    """Attempts by outcome (silent, heard) and distance."""
    _sums: Floats = field(default_factory=lambda: np.array([0.0, 25.0, 0.0]))
    """Of products of consecutive surprises, of their mean squares, and of attempts."""
    _refit_at: float = 0.0
    _slot: dict[int, int] = field(default_factory=dict)
    """Where in the arrays below a node is."""
    _working: Floats = field(default_factory=lambda: np.ones(0))
    """Probability that each node's UWB works (S,)."""
    _surprise: Floats = field(default_factory=lambda: np.empty((0, 0)))
    """Last outcome less its probability, of each pair (S, S); NaN before the first."""

    def __post_init__(self) -> None:
        self._refit()

    @property
    def weight(self) -> float:
        """How many independent silences one is worth."""
        together, apart, _ = self._sums.tolist()
        rho = min(max(together / apart, 0.0), 0.9)
        return float((1.0 - rho) / (1.0 + rho))

    @property
    def known(self) -> bool:
        """Whether an edge has been seen at all, so that ``range_m`` means something."""
        return self.range_sigma_m < 0.3 * self.range_m

    def probability(self, distance_m: Floats, sigma_m: Floats | float = 0.0) -> Floats:
        """P(heard) over distances (K,), averaged over their error."""
        return expected(self.curve, distance_m, sigma_m)

    def learn(
        self,
        of: Round,
        heard_m: Floats,
        heard_sigma_m: Floats,
        silent_m: Floats,
        silent_sigma_m: Floats,
    ) -> Floats:
        """Learn from one round and tell what its silences are worth.

        Distances and their standard deviations as predicted before the round, in the order of
        ``of.heard`` and ``of.silent``. Returns (len(of.silent),): the probability that both
        nodes' UWB worked.
        """
        return self.learn_all(
            of, np.concatenate([heard_m, silent_m]), np.concatenate([heard_sigma_m, silent_sigma_m])
        )

    def learn_all(self, of: Round, distance_m: Floats, sigma_m: Floats) -> Floats:
        """As ``learn``, of the heard and the silent pairs in one array each."""
        pairs = of.heard + of.silent
        if not pairs:
            return np.empty(0)
        slot = self._slot
        try:
            slots = np.array([(slot[a], slot[b]) for a, b in pairs], dtype=np.int64)
        except KeyError:
            self._add(pairs)
            return self.learn_all(of, distance_m, sigma_m)
        first, second = np.ascontiguousarray(slots.T)
        tried = self.teach(
            first, second, len(of.heard), np.array(of.witnessed, dtype=np.float64), distance_m,
            sigma_m, self.curve, self._working, self._surprise, self._counts, self._sums,
        )  # fmt: skip
        if self._sums[2] >= self._refit_at:
            self._refit()
        return tried

    def _add(self, pairs: Sequence[Pair]) -> None:
        """Make room for nodes that were not met before."""
        for node in sorted({node for pair in pairs for node in pair} - self._slot.keys()):
            self._slot[node] = len(self._slot)
        more = len(self._slot) - len(self._working)
        self._working = np.pad(self._working, (0, more), constant_values=1.0)
        self._surprise = np.pad(self._surprise, (0, more), constant_values=np.nan)

    def _refit(self) -> None:
        family = _family()
        if self._sums[2] > MEMORY:
            self._counts *= MEMORY / self._sums[2]
            self._sums[2] = MEMORY
        counts = self._counts.astype(np.float32)
        log_posterior = np.zeros(len(family.curves), dtype=np.float32)
        for outcome, logs in enumerate((family.log_silent, family.log_heard)):
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
        spread = float(posterior @ (edge_m - self.range_m) ** 2)
        self.range_sigma_m = math.sqrt(spread + (SHAPE * self.range_m) ** 2 + STEP_M**2 / 12.0)
        # Later evidence changes little: the cost of refitting stays a small share of the whole.
        seen = float(self._sums[2])
        self._refit_at = min(seen * 1.15, seen + 1000.0) + 10.0


def expected(curve: Floats, distance_m: Floats, sigma_m: Floats | float = 0.0) -> Floats:
    """Average ``curve`` over Gaussian distances (K,)."""
    place = distance_m + _OFFSETS * sigma_m
    mean: Floats = (_SHARES * np.interp(place, _GRID_M, curve)).sum(axis=0)
    return mean


_GRID_M = np.arange(LENGTH) * STEP_M
