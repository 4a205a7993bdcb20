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
from dataclasses import dataclass, field, fields, replace

import numpy as np
import numpy.typing as npt

from relpos.measurements import Range

Floats = npt.NDArray[np.float64]
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

_FAMILY: list[npt.NDArray[np.float32]] = []


def _family() -> list[npt.NDArray[np.float32]]:
    """All curves, (P0 * R * W, LENGTH), and the logarithms of heard and of silent.

    Made when first needed, then shared by all teams of this process.
    """
    if not _FAMILY:
        distance = np.arange(LENGTH) * STEP_M
        near, edge, soft = np.meshgrid(_NEAR, _EDGE_M, _SOFTNESS, indexing="ij")
        exponent = (distance - edge.reshape(-1, 1)) / (soft * edge).reshape(-1, 1)
        curves = near.reshape(-1, 1) / (1.0 + np.exp(np.clip(exponent, -60.0, 60.0)))
        curves = FLOOR + (1.0 - 2.0 * FLOOR) * curves
        _FAMILY.extend(x.astype(np.float32) for x in (curves, np.log(curves), np.log1p(-curves)))
    return _FAMILY


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
    _partners: dict[int, set[int]] = field(default_factory=dict)
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
        if self._open and (directed & self._directed or self._turns < 0.5):
            rounds.append(self._close(time_s, reported_s))
        self._directed |= directed
        self._open |= {(min(r.node, r.peer), max(r.node, r.peer)) for r in ranges}
        if self._turns < 0.5:
            rounds.append(self._close(time_s, reported_s))
        return rounds

    def _close(self, time_s: float, reported_s: Callable[[int], float]) -> Round:
        heard = self._open
        for node, peer in heard - self.heard_ever:
            self._partners.setdefault(node, set()).add(peer)
            self._partners.setdefault(peer, set()).add(node)
        self.heard_ever |= heard
        busy = Counter(node for pair in heard for node in pair)
        alive: dict[int, bool] = {}
        silent = set()
        for node in busy:
            for peer in self._partners.get(node, ()):
                pair = (node, peer) if node < peer else (peer, node)
                if pair in heard or pair in silent:
                    continue
                if peer not in alive:
                    alive[peer] = peer in busy or reported_s(peer) >= time_s - ALIVE_S
                if alive[peer]:
                    silent.add(pair)
        self._open, self._directed = set(), set()
        ordered = tuple(sorted(heard))
        witnessed = tuple(busy[a] > 1 or busy[b] > 1 for a, b in ordered)
        return Round(time_s, ordered, tuple(sorted(silent)), witnessed)


@dataclass(slots=True)
class Detection:
    """The learned curve of one team.

    ``curve`` (LENGTH,) is P(heard | distance) at multiples of ``STEP_M`` for a pair that was
    tried; ``weight`` (0 to 1) is what one silence counts, see the module's text. ``range_m`` and
    ``range_sigma_m`` are the distance of half the near value.
    """

    rounds: Rounds = field(default_factory=Rounds)
    curve: Floats = field(init=False)
    range_m: float = field(init=False)
    range_sigma_m: float = field(init=False)
    _counts: Floats = field(default_factory=lambda: np.zeros((2, LENGTH)))
    """Attempts by outcome (silent, heard) and distance."""
    _seen: float = 0.0
    _refit_at: float = 0.0
    _working: dict[int, float] = field(default_factory=dict)
    _surprise: dict[Pair, float] = field(default_factory=dict)
    _together: float = 0.0
    _apart: float = 25.0

    def __post_init__(self) -> None:
        self._refit()

    @property
    def weight(self) -> float:
        """How many independent silences one is worth."""
        rho = min(max(self._together / self._apart, 0.0), 0.9)
        return (1.0 - rho) / (1.0 + rho)

    @property
    def known(self) -> bool:
        """Whether an edge has been seen at all, so that ``range_m`` means something."""
        return self.range_sigma_m < 0.3 * self.range_m

    def snapshot(self) -> Detection:
        """Give a copy that later learning leaves alone."""
        rounds = replace(
            self.rounds,
            heard_ever=self.rounds.heard_ever.copy(),
            _partners={node: peers.copy() for node, peers in self.rounds._partners.items()},
            _open=self.rounds._open.copy(),
            _directed=self.rounds._directed.copy(),
        )
        # A refit makes a new curve and leaves the old one alone.
        copy = object.__new__(Detection)
        for one in fields(self):
            setattr(copy, one.name, getattr(self, one.name))
        copy.rounds, copy._counts = rounds, self._counts.copy()
        copy._working, copy._surprise = self._working.copy(), self._surprise.copy()
        return copy

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
        heard = len(of.heard)
        distance_m = np.concatenate([heard_m, silent_m])
        sigma_m = np.concatenate([heard_sigma_m, silent_sigma_m])
        if not distance_m.size:
            return np.empty(0)
        chance = self.probability(distance_m, sigma_m)
        tried = self._work(of, chance[heard:])
        weight = 1.0 / (1.0 + (sigma_m / TRUSTED_M) ** 2)
        weight[:heard] *= of.witnessed
        weight[heard:] *= tried
        self._correlate(of, chance, weight)
        self._deposit(distance_m, sigma_m, weight, heard)
        self._seen += float(weight.sum())
        if self._seen >= self._refit_at:
            self._refit()
        return tried

    def _work(self, of: Round, silent_p: Floats) -> Floats:
        """Each node's probability that its UWB works, from whether anybody hears it."""
        working = self._working
        busy = {node for pair in of.heard for node in pair}
        unheard: dict[int, float] = {}
        for (a, b), p in zip(of.silent, silent_p, strict=True):
            for node in (a, b):
                if node not in busy:
                    unheard[node] = unheard.get(node, 1.0) * (1.0 - float(p))
        for node in busy:
            working[node] = 1.0
        for node, chance in unheard.items():
            up = working.get(node, 1.0) * (1.0 - FAILS)
            working[node] = up * chance / (up * chance + 1.0 - up)
        return np.array([working.get(a, 1.0) * working.get(b, 1.0) for a, b in of.silent])

    def _correlate(self, of: Round, chance: Floats, weight: Floats) -> None:
        """Compare each pair's surprise with its last one."""
        surprise = self._surprise
        outcome = np.zeros(len(chance))
        outcome[: len(of.heard)] = 1.0
        surprises = (outcome - chance).tolist()
        for pair, now, w in zip(of.heard + of.silent, surprises, weight.tolist(), strict=True):
            before = surprise.get(pair)
            if before is not None:
                self._together += w * before * now
                self._apart += w * 0.5 * (before * before + now * now)
            surprise[pair] = now

    def _deposit(self, distance_m: Floats, sigma_m: Floats, weight: Floats, heard: int) -> None:
        """Spread attempts over the two nearest entries of three places each."""
        place = np.clip((distance_m + _OFFSETS * sigma_m) / STEP_M, 0.0, LENGTH - 1.001)
        index = place.astype(np.intp)
        beyond = place - index
        share = _SHARES * weight
        index[:, :heard] += LENGTH
        flat = np.concatenate([index.ravel(), index.ravel() + 1])
        parts = np.concatenate([(share * (1.0 - beyond)).ravel(), (share * beyond).ravel()])
        self._counts += np.bincount(flat, parts, 2 * LENGTH).reshape(2, LENGTH)

    def _refit(self) -> None:
        curves, log_heard, log_silent = _family()
        if self._seen > MEMORY:
            self._counts *= MEMORY / self._seen
            self._seen = MEMORY
        counts = self._counts.astype(np.float32)
        log_posterior = (log_silent @ counts[0] + log_heard @ counts[1]).astype(np.float64)
        posterior = np.exp(log_posterior - log_posterior.max())
        posterior /= posterior.sum()
        self.curve = (posterior.astype(np.float32) @ curves).astype(np.float64)
        by_edge = posterior.reshape(len(_NEAR), len(_EDGE_M), -1).sum(axis=(0, 2))
        self.range_m = float(by_edge @ _EDGE_M)
        spread = float(by_edge @ (_EDGE_M - self.range_m) ** 2)
        self.range_sigma_m = math.sqrt(spread + (SHAPE * self.range_m) ** 2 + STEP_M**2 / 12.0)
        # Later evidence changes little: the cost of refitting stays a small share of the whole.
        self._refit_at = min(self._seen * 1.15, self._seen + 1000.0) + 10.0


def expected(curve: Floats, distance_m: Floats, sigma_m: Floats | float = 0.0) -> Floats:
    """Average ``curve`` over Gaussian distances (K,)."""
    place = distance_m + _OFFSETS * sigma_m
    mean: Floats = (_SHARES * np.interp(place, _GRID_M, curve)).sum(axis=0)
    return mean


_GRID_M = np.arange(LENGTH) * STEP_M
