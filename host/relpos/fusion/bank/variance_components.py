"""Variance components: how noisy each wearer's dead reckoning and the ranges are.

A wearer's variances are three base variances (:mod:`relpos.fusion.models.motion_variances`) times
three components. :class:`VarianceComponents` is what is known of them, and of the range variance;
:func:`learn` updates it from innovations. Every hypothesis carries a draw of it (:func:`spread`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from relpos.fusion import vectormath
from relpos.fusion.arrays import Floats
from relpos.fusion.bank import lanes
from relpos.fusion.bank.lanes import LANES, fill, load, store
from relpos.fusion.bank.range_update import (
    CURVATURE,
    EVIDENCE,
    INLIER,
    MEAN,
    SHARES,
    VARIANCE,
    Ranges,
)
from relpos.fusion.bank.storage import Hypotheses
from relpos.fusion.compiled import compiled, inner
from relpos.fusion.models.motion_variances import COMPONENTS

PRIOR = np.array([0.0, 0.0, -1.0])
TEAM_SD = np.array([0.6, 1.2, 1.5])
OWN_SD = np.array([0.9, 0.9, 0.9])
"""Prior of log variances: mean, and standard deviations of what is common to the team and of
what is each wearer's own."""

LOWER = np.array([0.0, 5.0, 3.0])
"""By how much lower the log components of a team with low heading noise are: wheels or a camera
keep the heading to one degree in a turn of a radian and 0.4 degrees in a root second, a twelfth
and a quarter of what is expected of people. Some hypotheses model such a team."""

RANGE_SIGMA_M = 0.3
RANGE_SD = 1.2
"""Prior of the range sigma, and the standard deviation of its log variance."""

SPREAD_MOST = 0.7
"""Greatest standard deviation of the hypotheses' draws of a log component."""

LOWEST, HIGHEST = -8.0, 6.0
"""Log components are kept within these (counted): a fiftieth to twenty times the base."""

RANDOM_WALK = 1e-4
"""Variance by which a log component may change in an epoch: a third of an sd in an hour."""

OUTLYING = 1e-3
"""Likelihood of an innovation that fits nothing, relative to one that fits exactly."""

LEAST_SHARE = 0.1
"""Innovations teach only where the components explain at least this share of their variance."""

CURVED = 0.1
"""Innovations whose variance is by this share due to the range's curvature count half.

The Gaussian across the line of sight stands for an arc whose distance is known better: with the
true components, nu^2/S averages 0.93, 0.82, 0.72 and 0.54 in paper-h where that share is 1, 7, 15
and 30 %. So it is left out of S, and where it is large nothing is learned."""

POINTS, REACH = 15, 3.5
"""The posterior along one direction is integrated at so many points over so many deviations."""

_GRID = np.zeros((2, LANES))
_GRID.reshape(-1)[:POINTS] = np.linspace(-REACH, REACH, POINTS)
_BELL = np.exp(-0.5 * _GRID**2)
_BELL.reshape(-1)[POINTS:] = 0.0

REST_VARIANCE = 25.0
"""What no component explains of S (unknown constants, starts, jumps) is known this badly (log)."""


class VarianceComponents:
    """What is known of all variance components together: a Gaussian of their logarithms.

    The log components theta of N users and the log range variance, ``mean`` (3 N + 1,) with
    ``covariance``, the range variance last. A range's innovation nu is Gaussian with the
    mixture's variance S, whose sensitivities r = dlog S / dtheta the range update carries along.
    Only r . theta is touched by it: the posterior of this one number is integrated and the rest
    follows by regression (assumed density filtering). An expansion to first order
    (E[nu^2/S - 1] = r . (theta_true - theta), with variance 2) is overconfident after a few
    small innovations and then stays where it is.
    """

    def __init__(self) -> None:
        self.nodes = 0
        self.mean: Floats = np.array([2.0 * math.log(RANGE_SIGMA_M)])
        self.covariance: Floats = np.array([[RANGE_SD**2]])

    def add_node(self) -> None:
        """Add a user: correlated with the others by what is common to the team."""
        old = COMPONENTS * self.nodes
        keep = np.r_[0:old, old + COMPONENTS]
        covariance = np.zeros((old + COMPONENTS + 1, old + COMPONENTS + 1))
        mean = np.empty(old + COMPONENTS + 1)
        covariance[np.ix_(keep, keep)] = self.covariance
        mean[keep] = self.mean
        for component in range(COMPONENTS):
            at = old + component
            mean[at] = PRIOR[component]
            share = TEAM_SD[component] ** 2 / (TEAM_SD[component] ** 2 + OWN_SD[component] ** 2)
            others = np.arange(component, old, COMPONENTS)
            # The new one is like the others' common part: a regression on their mean.
            weight = share / (1.0 - share + share * others.size)
            row = weight * covariance[others].sum(axis=0)
            mean[at] += weight * float((mean[others] - PRIOR[component]).sum())
            rest = TEAM_SD[component] ** 2 * (1.0 - weight * others.size) + OWN_SD[component] ** 2
            covariance[at] += row
            covariance[:, at] += row
            covariance[at, at] = weight * float(row[others].sum()) + rest
        self.mean, self.covariance = mean, covariance
        self.nodes += 1


class Draws(NamedTuple):
    """The hypotheses' draws of the log components."""

    normals: Floats
    """Standard normals (B, L, LANES)."""
    low_heading_noise: Floats
    """(B, LANES): 1 where the team's headings are those of wheels or a camera (``LOWER``)."""
    spread: float
    """Standard deviation of the draws, in units of the posterior's."""


@compiled
def spread(draws: Draws, mean: Floats, covariance: Floats, hypotheses: Hypotheses) -> None:
    """Write every hypothesis' draw of the log components (L,), (L, L) into ``hypotheses``."""
    draw, low_noise = draws.normals, draws.low_heading_noise
    blocks, several = draw.shape[0], draw.shape[1]
    for c in range(several):
        sd = min(draws.spread * math.sqrt(covariance[c, c]), SPREAD_MOST)
        lower = LOWER[c % COMPONENTS] if c < several - 1 else 0.0
        for b in range(blocks):
            drawn = sd * load(draw, b * several + c) - lower * load(low_noise, b)
            value = lanes.exp(mean[c] + drawn)
            if c == several - 1:
                store(hypotheses.range_variance, b, value)
            else:
                store(hypotheses.component, b * (several - 1) + c, value)


class _Innovation(NamedTuple):
    """One range's innovation under the mixture."""

    value: float
    variance: float
    """S without the part that is due to curvature (m^2)."""
    curvature: float
    inlier: float
    """Probability of being no outlier."""


@inner
def _prior_weights(log_weight: Floats, counts: Floats) -> tuple[Floats, float]:
    """Return normalised weights (K,) of the hypotheses that count, and their sum before."""
    count = log_weight.shape[0]
    # Loops in place of expressions of arrays, which take the compiler seconds.
    weight = np.empty(count)
    most, whole = -np.inf, 0.0
    for k in range(count):
        most = max(most, log_weight[k])
    for k in range(count):
        weight[k] = vectormath.exp(log_weight[k] - most) * counts[k]
        whole += weight[k]
    if whole > 0.0:
        for k in range(count):
            weight[k] /= whole
    return weight, whole


@inner
def _innovation(
    range_m: float, stats: Floats, weight: Floats, begun: Floats, slope: Floats
) -> _Innovation:
    """Return a range's innovation; update ``weight`` (K,) with its evidence.

    ``slope`` (2, 7) receives dS / dtheta by these weights, and by ``begun`` (K,), those before the
    instant. An ``inlier`` of -1 says that no hypothesis counts.
    """
    count = weight.shape[0]
    means, variances, curvatures = stats[MEAN], stats[VARIANCE], stats[CURVATURE]
    evidence, inliers = stats[EVIDENCE], stats[INLIER]
    middle = 0.0
    for k in range(count):
        middle += weight[k] * means[k]
    variance, curvature, inlier, total, peak = 0.0, 0.0, 0.0, 0.0, -np.inf
    for k in range(count):
        off = means[k] - middle
        variance += weight[k] * (variances[k] - curvatures[k] + off * off)
        curvature += weight[k] * curvatures[k]
    for q in range(7):
        slope[0, q], slope[1, q] = 0.0, 0.0
        share = stats[SHARES + q]
        for k in range(count):
            slope[0, q] += weight[k] * share[k]
            slope[1, q] += begun[k] * share[k]
    for k in range(count):
        if weight[k] > 0.0:
            peak = max(peak, evidence[k])
    for k in range(count):
        weight[k] *= vectormath.exp(min(evidence[k] - peak, 0.0))
        total += weight[k]
    if total <= 0.0:
        return _Innovation(0.0, variance, curvature, -1.0)
    for k in range(count):
        weight[k] /= total
        inlier += weight[k] * inliers[k]
    return _Innovation(range_m - middle, variance, curvature, inlier)


@inner
def _integrate(square: float, own: float, sd: float, power: float) -> tuple[float, float]:
    """Return mean and variance of the common shift's posterior, its prior a standard normal.

    ``square`` is nu^2/S, ``own`` the components' share of S, ``sd`` the shift's prior deviation.
    """
    rest = max(1.0 - own, 0.0)
    mass, shift, second_moment = fill(0.0), fill(0.0), fill(0.0)
    for part in range(_GRID.shape[0]):
        z = load(_GRID, part)
        ratio = rest + own * lanes.exp(z * sd)
        likelihood = lanes.exp(-0.5 * square / ratio) / lanes.sqrt(ratio)
        density = load(_BELL, part) * lanes.exp(power * lanes.log(likelihood + OUTLYING))
        mass = mass + density
        shift = shift + density * z
        second_moment = second_moment + density * z * z
    all_mass = lanes.total(mass)
    moved = lanes.total(shift) / all_mass
    # An update that would widen the posterior leaves its variance (multimodal posterior).
    return moved, min(lanes.total(second_moment) / all_mass - moved * moved, 1.0)


@compiled
def learn(
    mean: Floats, covariance: Floats, ranges: Ranges, stats: Floats, log_weight: Floats,
    counts: Floats,
) -> int:  # fmt: skip
    """Learn log components (L,) and their covariance from ranges (R,), in place.

    ``stats`` (R, STATS, K) are those of the update (further columns are ignored), ``log_weight``
    (K,) from before it; hypotheses with ``counts`` (K,) 0 do not count. Returns how many
    components were clamped.
    """
    size = mean.shape[0]
    weight, whole = _prior_weights(log_weight, counts)
    if whole <= 0.0:
        return 0
    slopes, gain, place = np.empty((2, 7)), np.empty(size), np.empty(7, dtype=np.int64)
    begun, known = weight.copy(), mean.copy()
    for q in range(size):
        covariance[q, q] += RANDOM_WALK
    for n in range(ranges.range_m.shape[0]):
        innovation = _innovation(ranges.range_m[n], stats[n], weight, begun, slopes)
        if innovation.inlier < 0.0:
            return 0
        for q in range(3):
            place[q] = COMPONENTS * ranges.first[n] + q
            place[3 + q] = COMPONENTS * ranges.second[n] + q
        place[6] = size - 1
        # S is homogeneous in all variances, so its sensitivities cannot sum to more than it is;
        # they may, where knowledge leaked from users that the sensitivities do not follow.
        slope, explained, most = slopes[1], 0.0, innovation.variance - slopes[0, 6]
        for q in range(6):
            explained += slopes[0, q]
        kept = min(most / explained, 1.0) if explained > 0.0 else 1.0
        # The instant's other ranges have taught since: what the components explain has changed
        # with their mean, and with that alone (the weights moved to draws that say the same).
        variance, own = most - kept * explained, 0.0
        for q in range(7):
            slope[q] *= math.exp(mean[place[q]] - known[place[q]]) * (kept if q < 6 else 1.0)
            own += slope[q]
        variance += own
        own /= variance
        if own < LEAST_SHARE:
            continue
        rest = max(1.0 - own, 0.0)
        power = ranges.sample_count[n] * innovation.inlier
        power /= 1.0 + 0.5 * REST_VARIANCE * rest * rest
        power /= 1.0 + (innovation.curvature / (CURVED * variance)) ** 2
        # theta moves along C r; t is its common shift, S(t) = S ((1 - own) + own exp t).
        before = 0.0
        for o in range(size):
            gain[o] = 0.0
        for q in range(7):
            slope[q] /= variance
            row = place[q]
            for o in range(size):
                gain[o] += slope[q] * covariance[row, o]
        for q in range(7):
            before += slope[q] * gain[place[q]]
        sd = math.sqrt(before) / own
        square = innovation.value * innovation.value / variance
        moved, after = _integrate(square, own, sd, power)
        scale = moved * sd * own / before
        shrink = (1.0 - after) / before
        for o in range(size):
            mean[o] += gain[o] * scale
            own_shrink = shrink * gain[o]
            for q in range(size):
                covariance[o, q] -= own_shrink * gain[q]
    clamped = 0
    for o in range(size):
        bounded = min(max(mean[o], LOWEST), HIGHEST)
        clamped += bounded != mean[o]
        mean[o] = bounded
    return clamped
