"""What each of the bank's hypotheses models: the data choose by weight among them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.resampling import systematic

PAIR_BIASES = 6
"""Up to so many users each pair has a bias of its own in the state: 15 of them double its size.
Of more, each user has its antenna's delay."""

SHADOW_SD_M, LATENESS_SD_S = 0.05, 0.1
"""Prior standard deviations of what a body adds to a range, and of how late ranges are dated. Far
larger ones are learned, too (``mission-late-1``: 0.99 m without, 0.16 so). 0.3 of each, and of
clocks, learns them sooner (0.13 m), but takes the biases of pairs that are not calibrated for
shadows: eight seeds of three walkers have 0.10 m with these, 0.20 with 0.3, 0.07 without any."""

STOREY_M2 = 9.0
"""Prior deviation of the square of a pair's difference of height: that of one storey."""

RETURN_SHARE = 0.002
"""Of the hypotheses without constants, this share gets them back at each resampling: none may be
left when they begin to matter. ``mission-split-hard`` 611: 2.49 m without, 1.63 with; more than
that costs where there are none (``paper-h``: 0.83 with it, 0.90 with ten times as much)."""

USUAL_NOISE_SHARE = 0.06
"""Of the hypotheses with low heading noise, this share returns to the usual noise at each
resampling. People who walk straight on seem to have little; when they turn, some hypotheses have
to be left that expect it (``paper``, seeds 9100 to 9109: 0.77 m, without it 0.82 with a worst of
1.34)."""

FIRST_SHARES = 0.4, 0.4
"""Of the hypotheses with biases, so many begin with constant ones, and with heights; the others'
pass. Three people with constant biases (``team`` in tests/fusion/models/test_ranging.py, seeds 4 to
43): 0.148 m without any that pass, 0.159 with equal thirds, 0.129 so."""

LEAST_SHARE, LEAST_WEIGHT = 0.1, 0.002
"""Share of the hypotheses that each kind of range errors keeps at resampling, and its least weight.

Noise alone has less to explain in the first half minute, when its variance is unknown, and what
died out then was missing when it mattered: teams in an office (``bench/recorded_teams.py``, seeds
0 to 7) had NEES 1.53, 3.4 % over three sigmas, 0.72 m; 1.29, 2.3 %, 0.68 m with this and biases
that pass; ``paper-p1``, 52000 to 52007: 0.185 m both, 0.20 with ten times the least weight."""

DECIDED_AFTER_S, UNDECIDED_WEIGHT = 60.0, 0.05
"""So soon after the first ranges nothing is decided where starts are uncertain: there are no fewer
hypotheses, and this is the least weight of each kind of range errors.

Uncertain starts take what bodies and walls add to ranges: noise alone had 99 % of the weight after
ten seconds, and the right kind 85 % after thirty (docs/notebook/missions.md)."""


class RangeErrors(IntEnum):
    """What a hypothesis takes the errors of ranges for, all but the first beside noise."""

    NOISE = 0
    CONSTANT = 1
    """A bias of each pair, and what all ranges have in common."""
    HEIGHT = 2
    """As constant, but of each pair the square of its difference of height in place of the bias.

    Of more than ``PAIR_BIASES`` users, each one's height in place of the antenna's delay. Where
    nobody's height is known; a range's square is linear in that of a pair.
    ``mission-floors-no-heights``, seeds 640 to 642: 0.30 m, NEES 3.2 without, 0.13 m, 0.9 so;
    ``paper``, 23010 to 23019: 0.794 +- 0.029 m, 0.798 +- 0.022.
    """
    PASSING = 3
    """As constant, but a pair's bias passes as its users walk: walls come and go."""


@dataclass(slots=True)
class Models:
    """What each of K hypotheses models."""

    constants: Floats
    """1 where step scale and heading drift are modelled (K,), else 0."""
    range_errors: Indices
    """Of :class:`RangeErrors` (K,)."""
    low_heading_noise: Floats
    """1 where headings are those of wheels or a camera (K,), else 0."""

    @staticmethod
    def draw(settings: BankSettings, count: int, rng: np.random.Generator) -> Models:
        """Draw what each of ``count`` hypotheses models."""

        def share_of_all(many: int) -> Floats:
            return (rng.permutation(count) < many).astype(np.float64)

        constants = share_of_all(round(settings.constants * count))
        biased = round(settings.biased * count)
        edges = np.cumsum(FIRST_SHARES) * biased
        kinds = 1 + np.searchsorted(edges, np.arange(biased), side="right")
        range_errors = np.zeros(count, dtype=np.int64)
        range_errors[count - biased :] = kinds
        return Models(constants, range_errors, share_of_all(int(settings.steady * count)))

    def has(self, kind: RangeErrors) -> Floats:
        """1 where range errors are of this kind (K,), else 0."""
        return np.equal(self.range_errors, kind).astype(np.float64)

    @property
    def has_biases(self) -> Floats:
        """1 where ranges have biases (K,), else 0."""
        return 1.0 - self.has(RangeErrors.NOISE)

    def share_of_kinds(self, weight: Floats) -> Floats:
        """Return the sum of the weights (K,) of each of :class:`RangeErrors`."""
        return np.bincount(self.range_errors, weight, len(RangeErrors)).astype(np.float64)

    def select(self, chosen: Indices) -> Models:
        """Return those of the hypotheses ``chosen`` (M,)."""
        return Models(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def resample(
        self,
        weight: Floats,
        kinds: list[RangeErrors],
        count: int,
        rng: np.random.Generator,
        least_weight: float,
    ) -> tuple[Indices, Indices, Floats]:
        """Draw ``count`` hypotheses by weight (K,), so many at least of each of ``kinds``.

        ``least_weight`` is the least that each kind counts for. Returns which, of what kind they
        are to be, and their log weights, (M,) each. A kind that no hypothesis is of is drawn of
        all. Those that model the same come side by side: kernels skip what a whole block lacks.
        """
        share = np.maximum(self.share_of_kinds(weight)[kinds], least_weight)
        share /= share.sum()
        wanted = LEAST_SHARE + (1.0 - LEAST_SHARE * len(kinds)) * share
        edges = np.round(count * np.cumsum(wanted)).astype(np.int64)
        numbers = np.diff(edges, prepend=0)
        parts = []
        for kind, number in zip(kinds, numbers.tolist(), strict=True):
            own = weight * self.has(kind)
            part = systematic(own if own.any() else weight, number, rng)
            parts.append(part[np.argsort(self.constants[part], kind="stable")])
        logs = np.log(share / np.maximum(numbers, 1))
        of = np.repeat(np.array(kinds, dtype=np.int64), numbers)
        return np.concatenate(parts), of, np.repeat(logs, numbers)

    def merge(self, weight: Floats, count: int) -> Models:
        """Return what ``count`` hypotheses model that stand for all, whose weights are (K,).

        That is what most of them model. What most do not has no variance left to learn with: it
        has to be given back later.
        """
        # Between the two, where that is open: a nearly linear mixture leaves it so for long.
        low_noise = np.full(count, float(weight @ self.low_heading_noise))
        constants = np.full(count, float(weight @ self.constants > 0.5))
        kind = np.full(count, self.share_of_kinds(weight).argmax())
        return Models(constants, kind, low_noise)
