"""What is not told: how noisy each wearer's dead reckoning and the ranges are.

Noise has to be generic and is learned on line. A wearer's variances are three bases times three
levels: along the way (m^2 per metre), of turns (rad^2 per radian turned) and white in heading
(rad^2 per second of moving). :class:`Levels` learns them, and the range sigma, from the
innovations; every hypothesis carries a draw of what is known of them.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from relpos.fusion import vectormath
from relpos.fusion.bank import lanes
from relpos.fusion.bank.joint import BENT, EVIDENCE, MEAN, SHARES, TRUST, VARIANCE
from relpos.fusion.bank.lanes import LANES, fill, load
from relpos.fusion.compiled import compiled
from relpos.fusion.models.motion_variances import COMPONENTS

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

PRIOR = np.array([0.0, 0.0, -1.0])
TEAM_SD = np.array([0.6, 1.2, 1.5])
OWN_SD = np.array([0.9, 0.9, 0.9])
"""Prior of log variances: mean, and standard deviations of what is common to the team and of
what is each wearer's own."""

STEADIER = np.array([0.0, 5.0, 3.0])
"""By how much lower the log levels of a steady team are: wheels or a camera keep the heading to
one degree in a turn of a radian and 0.4 degrees in a root second, a twelfth and a quarter of what
is expected of people. It is a kind of team, which some hypotheses model and the data select."""

RANGE_SIGMA_M = 0.3
RANGE_SD = 1.2
"""Prior of the range sigma, and the standard deviation of its log variance."""

SPREAD_MOST = 0.7
"""Hypotheses' log levels are drawn at most so far apart."""

LOWEST, HIGHEST = -8.0, 6.0
"""Log levels are kept within these (counted): a fiftieth to twenty times the base."""

RANDOM_WALK = 1e-4
"""Variance by which a log level may change in an epoch: a third of an sd in an hour."""

OUTLYING = 1e-3
"""Likelihood of an innovation that fits nothing, relative to one that fits exactly."""

LEAST_SHARE = 0.1
"""Innovations teach only where the levels explain at least this share of their variance."""

CURVED = 0.1
"""Innovations whose variance is by this share due to the range's curvature count half.

The Gaussian across the line of sight stands for an arc whose distance is known better: with the
true levels, nu^2/S averages 0.93, 0.82, 0.72 and 0.54 in paper-h where that share is 1, 7, 15 and
30 %. So it is left out of S, and where it is large nothing is learned."""

POINTS, REACH = 15, 3.5
"""The posterior along one direction is integrated at so many points over so many deviations."""

_GRID = np.zeros((2, LANES))
_GRID.reshape(-1)[:POINTS] = np.linspace(-REACH, REACH, POINTS)
_BELL = np.exp(-0.5 * _GRID**2)
_BELL.reshape(-1)[POINTS:] = 0.0

REST_VARIANCE = 25.0
"""What no level explains of S (unknown constants, starts, jumps) is known this badly (log)."""


class Levels:
    """What is known of all log levels together: a Gaussian, learned from innovations.

    The levels theta of N users and the log range variance, ``mean`` (3 N + 1,) with
    ``covariance``, the range variance last. A range's innovation nu is Gaussian with the
    mixture's variance S, whose sensitivities r = dlog S / dtheta ``joint.update`` carries along.
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
        for level in range(COMPONENTS):
            at = old + level
            mean[at] = PRIOR[level]
            share = TEAM_SD[level] ** 2 / (TEAM_SD[level] ** 2 + OWN_SD[level] ** 2)
            others = np.arange(level, old, COMPONENTS)
            if others.size:
                # The new one is like the others' common part: a regression on their mean.
                weight = share / (1.0 - share + share * others.size)
                row = weight * covariance[others].sum(axis=0)
                mean[at] += weight * float((mean[others] - PRIOR[level]).sum())
                rest = TEAM_SD[level] ** 2 * (1.0 - weight * others.size) + OWN_SD[level] ** 2
                covariance[at] += row
                covariance[:, at] += row
                covariance[at, at] = weight * float(row[others].sum()) + rest
            else:
                covariance[at, at] = TEAM_SD[level] ** 2 + OWN_SD[level] ** 2
        self.mean, self.covariance = mean, covariance
        self.nodes += 1


@compiled
def learn(
    mean: Floats,
    covariance: Floats,
    first: Indices,
    second: Indices,
    measured: Floats,
    stats: Floats,
    log_weight: Floats,
    quiet: Floats,
    worth: Floats,
) -> int:
    """Learn log levels (L,) and their covariance from ranges (R,), in place; see ``Levels``.

    ``stats`` (R, STATS, K) are of ``joint.update`` (further columns are ignored), ``log_weight``
    (K,) from before it; hypotheses with ``quiet`` (K,) 0 do not count. ``worth`` (R,) is how many
    independent ranges each is worth. Returns how many levels had to be clamped.
    """
    count = log_weight.shape[0]
    size = mean.shape[0]
    # Loops in place of expressions of arrays, which take the compiler seconds.
    weight = np.empty(count)
    most, whole = -np.inf, 0.0
    for k in range(count):
        most = max(most, log_weight[k])
    for k in range(count):
        weight[k] = vectormath.exp(log_weight[k] - most) * quiet[k]
        whole += weight[k]
    if whole <= 0.0:
        return 0
    for k in range(count):
        weight[k] /= whole
    slope = np.empty(7)
    place = np.empty(7, dtype=np.int64)
    gain = np.empty(size)
    for q in range(size):
        covariance[q, q] += RANDOM_WALK
    for n in range(measured.shape[0]):
        means, variances, bents = stats[n, MEAN], stats[n, VARIANCE], stats[n, BENT]
        evidence, trusts = stats[n, EVIDENCE], stats[n, TRUST]
        middle = 0.0
        for k in range(count):
            middle += weight[k] * means[k]
        variance = 0.0
        bent = 0.0
        trust = 0.0
        total = 0.0
        peak = -np.inf
        for k in range(count):
            off = means[k] - middle
            variance += weight[k] * (variances[k] - bents[k] + off * off)
            bent += weight[k] * bents[k]
        for q in range(7):
            slope[q] = 0.0
            share = stats[n, SHARES + q]
            for k in range(count):
                slope[q] += weight[k] * share[k]
        for k in range(count):
            if weight[k] > 0.0:
                peak = max(peak, evidence[k])
        for k in range(count):
            weight[k] *= vectormath.exp(min(evidence[k] - peak, 0.0))
            total += weight[k]
        if total <= 0.0:
            return 0
        for k in range(count):
            weight[k] /= total
            trust += weight[k] * trusts[k]
        # S is homogeneous in all variances, so its sensitivities cannot sum to more than it is;
        # they may, where knowledge leaked from users that ``sens`` does not follow.
        explained = 0.0
        for q in range(6):
            explained += slope[q]
        if explained > variance - slope[6]:
            for q in range(6):
                slope[q] *= (variance - slope[6]) / explained
            explained = variance - slope[6]
        innovation = measured[n] - middle
        for q in range(3):
            place[q] = COMPONENTS * first[n] + q
            place[3 + q] = COMPONENTS * second[n] + q
        place[6] = size - 1
        own = (explained + slope[6]) / variance
        if own < LEAST_SHARE:
            continue
        rest = max(1.0 - own, 0.0)
        power = worth[n] * trust / (1.0 + 0.5 * REST_VARIANCE * rest * rest)
        power /= 1.0 + (bent / (CURVED * variance)) ** 2
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
        square = innovation * innovation / variance
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
        # Of a unit variance in z; an update that would widen it leaves it (multimodal posterior).
        after = min(lanes.total(second_moment) / all_mass - moved * moved, 1.0)
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
