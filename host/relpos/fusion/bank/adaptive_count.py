"""The adaptive number of hypotheses: growing, shrinking, and the ceiling of both."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.bank import hypothesis_count, storage
from relpos.fusion.bank.hypothesis_models import DECIDED_AFTER_S, RangeErrors
from relpos.fusion.bank.hypothesis_set import HypothesisSet
from relpos.fusion.bank.mixture import PERTURBED_LOSS
from relpos.fusion.bank.storage import PER_NODE, POSE, StateIndex
from relpos.fusion.models.motion_variances import ALONG, ALONG_M2_M, COMPONENTS
from relpos.fusion.resampling import systematic


class AdaptiveCount:
    """Resizes a :class:`HypothesisSet` by how nonlinear and how ambiguous it is.

    The criteria are those of :mod:`relpos.fusion.bank.hypothesis_count`.
    """

    def __init__(self, hypotheses: HypothesisSet, counters: Counter[str]) -> None:
        """Begin with the usual number of hypotheses."""
        self._hypotheses = hypotheses
        self._counters = counters
        self.ceiling = hypotheses.settings.hypotheses
        """Ordinarily at most so many: more than usual while strongly nonlinear."""
        self.unambiguous = 0
        """For so many instants of ranges the mixture has been so."""
        self._first_s = math.inf
        """When the first ranges came."""

    def resize(self, time_s: float, *, ambiguous: bool, since_fault: int) -> None:
        """Shrink where the mixture has been unambiguous for a while; grow where it is not."""
        these = self._hypotheses
        if these.settings.hypotheses == 1 or not these.nodes:
            return
        self._first_s = min(self._first_s, time_s)
        age_s = time_s - self._first_s
        these.undecided = these.starts_uncertain and age_s < DECIDED_AFTER_S
        most = these.count >= these.settings.hypotheses
        if most and since_fault % hypothesis_count.CHECKED_AFTER == 0:
            self._adapt_ceiling()
        if ambiguous:
            self.unambiguous = 0
            self.grow()
            return
        unperturbed = these.unperturbed_weights()
        mean, covariance = these.moments(unperturbed, poses_alone=True)
        index = hypothesis_count.nonlinearity_index(
            mean, covariance, self._sigma_range_m(), self._sigma_metre_m()
        )
        if index > hypothesis_count.NONLINEAR:
            self.unambiguous = 0
            self.grow()
        elif (
            these.undecided
            or index > hypothesis_count.LINEAR
            or not self._is_even(covariance, unperturbed)
        ):
            self.unambiguous = 0
        else:
            self.unambiguous += 1
            fewer = [n for n in hypothesis_count.STEPS if n < these.count]
            if fewer and self.unambiguous >= hypothesis_count.HELD:
                self.unambiguous = 0
                self._shrink(fewer[0], unperturbed)

    def _adapt_ceiling(self) -> None:
        """Have more than the usual number of hypotheses while strongly nonlinear."""
        these = self._hypotheses
        usual = these.settings.hypotheses
        mean, covariance = these.moments(these.unperturbed_weights(), poses_alone=True)
        # How short the next metre is, is in the motion's moments: arcs alone count here.
        straight = np.full(these.nodes, np.inf)
        index = hypothesis_count.nonlinearity_index(
            mean, covariance, self._sigma_range_m(), straight
        )
        if index < hypothesis_count.LESS_NONLINEAR:
            self.ceiling = usual
        elif index > hypothesis_count.STRONGLY_NONLINEAR and self.ceiling == usual:
            self.ceiling = hypothesis_count.most(usual, int(these.arrays.x.shape[1]))
            if these.count < self.ceiling:
                these.resample(these.weights(), self.ceiling)

    def _sigma_range_m(self) -> float:
        return math.exp(0.5 * float(self._hypotheses.components.mean[-1]))

    def _sigma_metre_m(self) -> Floats:
        """How noisy the length of a metre is that each user walks (N,)."""
        sigmas: Floats = np.exp(0.5 * self._hypotheses.components.mean[ALONG:-1:COMPONENTS])
        return math.sqrt(ALONG_M2_M) * sigmas

    def _is_decided(self) -> bool:
        """Whether the range variance is known, and most hypotheses count and model the same."""
        these = self._hypotheses
        weight, effective = these.normalise()
        weights = weight.reshape(-1)[: these.count]
        models = these.models
        shares = [weights @ models.constants, *models.share_of_kinds(weights)]
        least = max(min(share, 1.0 - share) for share in shares)
        return (
            float(these.components.covariance[-1, -1]) <= hypothesis_count.KNOWN**2
            and effective >= hypothesis_count.EVEN * these.count
            and float(weights @ (these.perturbed > 0.0)) <= hypothesis_count.PERTURBED_MOST
            and least <= hypothesis_count.UNDECIDED
        )

    def _is_even(self, covariance: Floats, unperturbed: Floats) -> bool:
        """Whether not few hypotheses count and they lie together.

        That is where the variances between them, the rest of the mixture's ``covariance`` (D, D),
        are what the drawn share of the noise accounts for.
        """
        these = self._hypotheses
        if these.count == 1:
            return True
        drawn = these.sampled_share / (1.0 - these.sampled_share)
        places = np.arange(POSE * these.nodes)
        poses = storage.order(these.nodes, these.arrays.x.shape[1])[: len(places)]
        own = these.arrays.p[:, storage.triangle_place(places, places)]
        inside = np.einsum("bl,bil->i", unperturbed, own)
        between = covariance[poses, poses] - inside
        most = hypothesis_count.APART * drawn * inside + 1e-6
        return self._is_decided() and bool((between <= most).all())

    def grow(self) -> None:
        """Have as many hypotheses as may be: fewer are copied, and their headings drawn."""
        these = self._hypotheses
        s = these.settings
        if these.count >= s.hypotheses:
            return
        full = hypothesis_count.sampled_share(s.sampled, s.hypotheses, s.hypotheses)
        share = full - these.sampled_share
        these.resample(these.weights(), s.hypotheses)
        these.redraw()
        x, p = these.dense()
        these.store(*hypothesis_count.parted(x, p, self._headings(), share, these.rng))
        self._counters["hypotheses_grown"] += 1

    def _headings(self) -> Indices:
        nodes = np.arange(self._hypotheses.nodes, dtype=np.int64)
        return PER_NODE * nodes + StateIndex.HEADING

    def _shrink(self, count: int, unperturbed: Floats) -> None:
        """Go on with fewer hypotheses; the mixture's moments are unchanged."""
        these = self._hypotheses
        s = these.settings
        has_heights = these.models.has(RangeErrors.HEIGHT)
        heights = float(unperturbed.reshape(-1)[: these.count] @ has_heights) > 0.5
        # What a pair's entry is has to be the same in all.
        left_out = (these.perturbed > 0.0) | (has_heights != heights)
        if heights and these.biases.users:
            these.biases.mirror_heights()
        these.log_weight[:] -= np.where(left_out, PERTURBED_LOSS, 0.0)
        mean, covariance = these.moments()
        before, weight = these.sampled_share, these.weights()
        chosen = systematic(weight, count, these.rng)
        after = hypothesis_count.sampled_share(s.sampled, count, s.hypotheses)
        kept, means = after / before if before else 0.0, these.dense()[0]
        thinned, p = hypothesis_count.thinned(
            means, mean, covariance, chosen, self._headings(), kept
        )
        these.replace_by(chosen, weight, thinned, p)
        self._counters["hypotheses_shrunk"] += 1
