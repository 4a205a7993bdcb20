"""What makes ranges err beside noise, as entries of every hypothesis' state, and how they begin.

What all ranges have in common is there from the beginning. Each pair's bias is added when the two
are first ranged; of more than ``PAIR_BIASES`` users, each user's antenna delay is in its place. In
hypotheses of the kind ``RangeErrors.HEIGHT`` these entries hold heights: of a pair the square of
its difference, of a user its height.
"""

from __future__ import annotations

import math
import weakref
from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank import lanes, storage
from relpos.fusion.bank.hypothesis_arrays import HypothesisArrays
from relpos.fusion.bank.hypothesis_models import (
    LATENESS_SD_S,
    PAIR_BIASES,
    SHADOW_SD_M,
    STOREY_M2,
    RangeErrors,
)
from relpos.fusion.models.ranging import (
    CLOCK_SD_S,
    DELAY_SHARE,
    GROWTH_SD_M,
    CommonIndex,
    deviations_within,
)

HEIGHT_DRAWN_M, HEIGHT_SD_M = 2.0, 2.0
"""A user's unknown height begins at one that is drawn with the first deviation, and has the second.

Where all are alike no range tells which way one is off, so that they are drawn. 8 and 14 people in
``floors-no-heights``, 150 s, seeds 4010 to 4013: .39 and .34 m without heights; .12 and .10 to .11
with 1, 1; 2, 1; 2, 2; .13 with 3, 1 (docs/notebook/missions.md)."""

CLIMB_M2_S = 0.05**2
"""Variance by which a user's unknown height grows: people take stairs.

A third of 8 and 12 people go up one storey, 240 s, seeds 4030 to 4033: .19 and .22 m without; .15
and .13 so; .14 and .11 with 0.1 m, by which 8 who stay on their storeys have .14 m in place of .12.
Squares of pairs do not grow: two robots (``exp4_los``) would be .24 m off in place of .17."""

VARIED, VARIED_AFTER, VARIED_RANGES = 0.05, 8, 200
"""Standard deviation of a pair's distance over its mean from which on it tells heights, after so
many ranges, over at most so many.

A crowd that keeps together may as well be a steep one (docs/notebook/missions.md)."""


class Learned(NamedTuple):
    """What of ranges' errors is known, by the hypotheses of the kind that most weight has."""

    heights: bool
    """Whether that is unknown heights."""
    pairs: dict[tuple[int, int], tuple[float, float]]
    """Pair of rows -> mean and variance of its bias (m, m^2), or of the square of its difference of
    height (m^2, m^4)."""
    delays: dict[int, tuple[float, float]]
    """Row -> its antenna delay relative to the mean of all, since what they share is a bias, and
    the deviation of that (m)."""


class RangeBiases:
    """The entries of a set of hypotheses that make ranges err."""

    def __init__(self, hypotheses: HypothesisArrays) -> None:
        """Begin with what all ranges have in common."""
        self.belong_to(hypotheses)
        self.pairs: dict[tuple[int, int], int] = {}
        """Pair of rows, the lower first -> entry of its bias in the state."""
        self.users: dict[int, int] = {}
        """Row -> entry of its antenna delay, by which each of its ranges is too long, or height."""
        self.heights_known = False
        self._climbed_s: float | None = None
        self._ranges: dict[tuple[int, int], tuple[int, float, float]] = {}
        """Pair of rows -> how many ranges, their mean (m) and variance (m^2)."""

    def belong_to(self, hypotheses: HypothesisArrays) -> None:
        """Refer to the set, which refers to this: its copies, as large as it, go at once so."""
        self._set = weakref.ref(hypotheses)

    @property
    def _hypotheses(self) -> HypothesisArrays:
        these = self._set()
        assert these is not None
        return these

    def move_back(self, by: int) -> None:
        """Note that all entries are stored so many later."""
        self.pairs = {pair: place + by for pair, place in self.pairs.items()}
        self.users = {user: place + by for user, place in self.users.items()}

    def kinds(self) -> list[RangeErrors]:
        """Return those that are to have hypotheses; what began with biases cannot lose them."""
        models = self._hypotheses.models
        if self._hypotheses.settings.biased == 0.0:
            return [RangeErrors.NOISE]
        kinds = [] if models.has_biases.all() else [RangeErrors.NOISE]
        kinds.append(RangeErrors.CONSTANT)
        if self.pairs:
            kinds.append(RangeErrors.PASSING)
        if (self.pairs or self._varied()) and not self.heights_known:
            kinds.append(RangeErrors.HEIGHT)
        return kinds

    def watch(self, first: Indices, second: Indices, range_m: Floats) -> None:
        """Note the ranges (R,) of users, whose heights they tell where distances change."""
        if self._hypotheses.nodes <= PAIR_BIASES or self.heights_known:
            return
        ranges = zip(first.tolist(), second.tolist(), range_m.tolist(), strict=True)
        for a, b, measured_m in ranges:
            pair = (a, b) if a < b else (b, a)
            count, mean, variance = self._ranges.get(pair, (0, 0.0, 0.0))
            count = min(count + 1, VARIED_RANGES)
            off = measured_m - mean
            mean += off / count
            variance += (off * (measured_m - mean) - variance) / count
            self._ranges[pair] = count, mean, variance

    def _varied(self) -> bool:
        """Whether distances of half of the pairs have changed, or it is too soon to tell."""
        noise_m2 = 2.0 * math.exp(float(self._hypotheses.components.mean[-1]))
        varied = [
            count < VARIED_AFTER or v > (VARIED * mean) ** 2 + noise_m2
            for count, mean, v in self._ranges.values()
        ]
        return 2 * sum(varied) > len(varied)

    # -- beginning -----------------------------------------------------------------------------

    def turn_into(self, kind: Indices) -> None:
        """Let hypotheses (K,) have other range errors than they have; their biases begin anew."""
        models = self._hypotheses.models
        before = models.range_errors
        changed, noise = kind != before, before == RangeErrors.NOISE
        models.range_errors = kind
        if changed.any():
            self.begin_common(np.flatnonzero(changed & noise))
            self._begin_own(np.flatnonzero(changed & ~noise))

    def know_heights(self) -> None:
        """Have no hypothesis any more in which heights are unknown: they are reported."""
        models = self._hypotheses.models
        which = np.flatnonzero(models.has(RangeErrors.HEIGHT))
        self.heights_known = True
        models.range_errors[which] = RangeErrors.CONSTANT
        if which.size:
            self._begin_own(which)

    def begin_common(self, which: Indices) -> None:
        """Let those of ``which`` (M,) that have biases model what ranges have in common."""
        these = self._hypotheses
        priors = {
            these.common_entry(CommonIndex.BIAS): these.settings.bias_m,
            these.common_entry(CommonIndex.SHADOW): SHADOW_SD_M,
            these.common_entry(CommonIndex.LATENESS): LATENESS_SD_S,
            these.common_entry(CommonIndex.GROWTH): GROWTH_SD_M,
        }
        priors |= {these.clock_entry(row): CLOCK_SD_S for row in range(these.nodes)}
        block, lane = these.at(which)
        p, has = these.arrays.p, these.models.has_biases[which]
        for entry, sigma in priors.items():
            p[block, storage.triangle_place(entry, entry), lane] = has * sigma**2
        self._begin_own(which)

    def _begin_own(self, which: Indices) -> None:
        """Let what pairs and users have of their own begin anew in hypotheses ``which`` (M,)."""
        self._begin_pairs(which)
        if self.users:
            self._begin_users(which, list(self.users.values()))
        self._hypotheses.lay_out_models()

    def _begin_pairs(self, which: Indices) -> None:
        """Let what pairs have begin anew: the bias of a pair is the common one and its own part."""
        these = self._hypotheses
        block, lane = (at[:, None] for at in these.at(which))
        x, p = these.arrays.x, these.arrays.p
        inherits = 1.0 - these.models.has(RangeErrors.HEIGHT)[which, None]
        common = these.common_entry(CommonIndex.BIAS)
        own = np.array(list(self.pairs.values()), dtype=np.int64)
        others = np.arange(x.shape[1])
        # Of each entry, the one that it begins as.
        before = np.where(np.isin(others, own), common, others)
        shared = inherits * p[block, storage.triangle_place(common, before), lane]
        x[block, own, lane] = inherits * x[block, common, lane]
        for entry in own:
            p[block, storage.triangle_place(entry, others), lane] = shared
        p[block, storage.triangle_place(own, own), lane] += self._own_variance(which)[:, None]

    def _begin_users(self, which: Indices, entries: list[int]) -> None:
        """Let antenna delays begin anew, or heights, which are drawn."""
        these = self._hypotheses
        heights = these.models.has(RangeErrors.HEIGHT)[which, None]
        block, lane = (at[:, None] for at in these.at(which))
        drawn = HEIGHT_DRAWN_M * these.rng.standard_normal((len(which), len(entries)))
        these.arrays.x[block, entries, lane] = heights * drawn
        own = (DELAY_SHARE * these.settings.pair_bias_m) ** 2
        variance = these.models.has_biases[which, None] * (own + heights * (HEIGHT_SD_M**2 - own))
        spread = variance[:, :, None] * np.eye(len(entries))
        these.decorrelate(np.array(entries), spread, which)

    def _own_variance(self, which: Indices | slice = slice(None)) -> Floats:
        """Return the prior variance of what a pair has of its own (M,), m^2 or m^4."""
        models = self._hypotheses.models
        heights = models.has(RangeErrors.HEIGHT)[which]
        own = self._hypotheses.settings.pair_bias_m**2
        return models.has_biases[which] * (own + heights * (STOREY_M2**2 - own))

    # -- entries of ranges ---------------------------------------------------------------------

    def entries(self, first: Indices, second: Indices) -> Indices:
        """Entries of the state (R, 3) that hold the biases of ranges; new ones are added.

        A pair's bias is the common one plus its own part, so a new pair begins with what is known
        of the common one. Where there are too many pairs, it is the common one and both users'
        antenna delays; -1 where there is none of these.
        """
        these = self._hypotheses
        entries = np.full((len(first), 3), -1, dtype=np.int64)
        if not these.models.has_biases.any():
            return entries
        common = these.common_entry(CommonIndex.BIAS)
        for r, (a, b) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
            pair = (a, b) if a < b else (b, a)
            if pair not in self.pairs and these.nodes <= PAIR_BIASES:
                inherits = 1.0 - these.arrays.has_heights
                self.pairs[pair] = self._add(inherits, self._own_variance())
            if pair in self.pairs:
                entries[r, 0] = self.pairs[pair]
                continue
            for user in (a, b):
                if user not in self.users:
                    none = np.zeros_like(these.arrays.has_heights)
                    self.users[user] = self._add(none, np.zeros(these.count))
                    self._begin_users(np.arange(these.count), [self.users[user]])
            entries[r] = common, self.users[a], self.users[b]
        return entries

    def _add(self, inherits: Floats, variance: Floats) -> int:
        """Add an entry for a bias, and return it: the common one where it ``inherits``, and more.

        ``inherits`` (B, LANES) is 1 or 0; ``variance`` (K,) is that of its own part, mean 0.
        """
        these = self._hypotheses
        x0, p0 = these.arrays.x, these.arrays.p
        size, old = int(x0.shape[1]), p0.shape[1]
        common = these.common_entry(CommonIndex.BIAS)
        x = lanes.empty_lines(len(x0), size + 1)
        p = lanes.empty_lines(len(x0), old + size + 1)
        x[:, :size], x[:, size] = x0, inherits * x0[:, common]
        p[:, :old] = p0
        shared = p0[:, storage.triangle_place(common, np.arange(size))]
        p[:, old:-1] = inherits[:, None] * shared
        p[:, -1] = inherits * shared[:, common] + storage.lay_out(variance)
        these.arrays = these.arrays._replace(x=x, p=p)
        return size

    # -- reading -------------------------------------------------------------------------------

    def learned(self) -> Learned:
        """Return what is known of pairs and of users."""
        these = self._hypotheses
        weight, has_heights = these.weights(), these.models.has(RangeErrors.HEIGHT)
        heights = bool(weight @ has_heights > 0.5)
        weight = weight * (has_heights == heights)
        weight /= weight.sum()
        pairs = self._of_pairs(weight)
        if not self.users:
            return Learned(heights, pairs, {})
        users, entries = np.array(list(self.users)), np.array(list(self.users.values()))
        means, spreads = these.entries_of(entries)
        if heights:
            return Learned(heights, pairs | _squares_apart(users, weight, means, spreads), {})
        mean = weight @ means
        off = means - mean
        covariance = np.einsum("k,kij->ij", weight, spreads) + (off.T * weight) @ off
        sigmas = deviations_within(covariance, np.arange(len(users))).tolist()
        known = zip((mean - mean.mean()).tolist(), sigmas, strict=True)
        return Learned(heights, pairs, dict(zip(self.users, known, strict=True)))

    def _of_pairs(self, weight: Floats) -> dict[tuple[int, int], tuple[float, float]]:
        if not self.pairs:
            return {}
        means, spreads = self._hypotheses.entries_of(np.array(list(self.pairs.values())))
        mean = weight @ means
        variance = weight @ (spreads.diagonal(axis1=1, axis2=2) + (means - mean) ** 2)
        known = zip(mean.tolist(), variance.tolist(), strict=True)
        return dict(zip(self.pairs, known, strict=True))

    # -- unknown heights -----------------------------------------------------------------------

    def climb(self, time_s: float) -> None:
        """Make users' unknown heights less certain: people may have climbed since the last time."""
        passed_s = 0.0 if self._climbed_s is None else max(time_s - self._climbed_s, 0.0)
        self._climbed_s = time_s
        arrays, own = self._hypotheses.arrays, np.array(list(self.users.values()), dtype=np.int64)
        grown = CLIMB_M2_S * passed_s * arrays.has_heights
        if grown.any():
            arrays.p[:, storage.triangle_place(own, own)] += grown[:, None]

    def mirror_heights(self) -> None:
        """Put the same users on top in all hypotheses: no range tells up from down."""
        these, own = self._hypotheses, np.array(list(self.users.values()), dtype=np.int64)
        heights = storage.of_each(these.arrays.x[:, own], these.count)
        off = heights - heights.mean(axis=1, keepdims=True)
        has_heights = these.models.has(RangeErrors.HEIGHT)
        likeliest = (these.weights() * has_heights).argmax()
        which = np.flatnonzero(has_heights * (off @ off[likeliest]) < 0.0)
        others = np.setdiff1d(np.arange(these.arrays.x.shape[1]), own)
        block, lane = these.at(which)
        these.arrays.x[block[:, None], own, lane[:, None]] *= -1.0
        block, lane = block[:, None, None], lane[:, None, None]
        these.arrays.p[block, storage.triangle_place(own[:, None], others), lane] *= -1.0


def _squares_apart(
    users: Indices, weight: Floats, means: Floats, spreads: Floats
) -> dict[tuple[int, int], tuple[float, float]]:
    """Return the squares of the differences of heights of every two users, and their variances.

    ``weight`` (K,), ``means`` (K, N) and ``spreads`` (K, N, N) are those of the heights.
    """
    i, j = storage.every_pair(len(users))
    apart2 = (means[:, i] - means[:, j]) ** 2
    own = spreads.diagonal(axis1=1, axis2=2)
    variance = np.maximum(own[:, i] + own[:, j] - 2.0 * spreads[:, i, j], 0.0)
    square = apart2 + variance
    mean = weight @ square
    within = 4.0 * apart2 * variance + 2.0 * variance**2
    spread = weight @ (within + (square - mean) ** 2)
    pairs = np.sort(np.stack([users[i], users[j]], axis=1), axis=1).tolist()
    known = zip(mean.tolist(), spread.tolist(), strict=True)
    return {(a, b): both for (a, b), both in zip(pairs, known, strict=True)}
