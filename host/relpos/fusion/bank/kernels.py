"""Kernels of what the bank does beside moving and ranging its hypotheses.

Weights, levels of noise and what the innovations of an instant say of the sensors: little work on
many small arrays, most of which would be Python's. Twins: :mod:`reference.bank`.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from relpos.fusion.bank import hypothesis_count as hypotheses
from relpos.fusion.bank import lanes
from relpos.fusion.bank import variance_components as noise
from relpos.fusion.bank.joint import MEAN, PER_NODE, STATS, TRUST, VARIANCE, update
from relpos.fusion.bank.lanes import LANES, fill, load, store
from relpos.fusion.compiled import compiled, inlined
from relpos.fusion.estimator import ANY_ANGLE_RAD
from relpos.fusion.models.motion_variances import (
    ALONG,
    ALONG_M2_M,
    COMPONENTS,
    WHITE,
    base_variances,
)
from relpos.fusion.models.odometry_faults import CusumDetector, update_cusum

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_POSE = 3

CROSS = 0.04
"""Variance across the way relative to along it: steps err in length, turns err apart from that."""

LEAST_TURN_RAD, TURN_STANDS_OUT = 0.05, 3.5
"""A change of heading is a turn beyond both: so much, and so many deviations of white noise."""
MISJUDGED, MISJUDGED_RAD = 0.1, 1.0
"""Share of hypotheses that misjudge a turn, and by how much. In P1 one right angle in some hundred
is reported as less than 20 degrees, and cost 0.5 m for a minute: seeds 1000 to 1009 0.206 m
without, 0.214 with a share of 0.05, 0.195 with 0.1 (worst 0.27, 0.38, 0.24); seeds 500 to 515,
where it does not happen, 0.192 and 0.195."""

STRAIGHT_S = 10.0
"""After going straight for so long. Without it, robots that turn every second (exp3, exp4 of
`two_robots_vio`) lost 0.08 and 0.10 m of 0.15."""

DOUBTERS = 20.0
"""Log likelihood that is taken from those who doubt where they do not count."""

DOUBTED = 1e-3
"""Weight of those who have just jumped in what was expected of a range: to them any is usual."""


BELIEVED = 0.7
"""Of ranges and silences, this share of the log evidence weighs the hypotheses. All of it is right
where the noise is known; noise that was learned is wrong for all ranges of a user alike, and they
then agree on a wrong mode (paper-h, seeds 5000 to 5011: 0.97 m and NEES 1.9 with all, 0.75 m and
1.0 with this; paper-h2, 7000 to 7031: 1.59 m and worst 4.8, 1.50 m and worst 2.6)."""


OUTLIERS_EXPECTED = 3.0
"""How far outliers are expected to be off beforehand is worth so many of them."""

SURPRISE, SURPRISE_OF_OUTLIERS = 0.15, 2.2
"""A user surprises from this share of odd ranges on, or so many times the share of outliers: where
those are common, it takes more of them to doubt a user."""


@compiled
def within(first: Indices, second: Indices, nodes: int) -> bool:
    """Tell whether all rows are those of users: kernels look at no bounds."""
    least, most = 0, 0
    for r in range(first.shape[0]):
        least = min(least, first[r], second[r])
        most = max(most, first[r], second[r])
    return least >= 0 and most < nodes


@compiled
def expect_outliers(counts: Floats, outlier: Floats) -> float:
    """Say what share of the ranges are outliers, as far as is known; it and variance go in.

    ``counts`` are as in ``digest``; ``outlier`` (5,) is what ``joint.update`` takes, then the
    variance (m^2) that is expected beforehand.
    """
    prior = outlier[4]
    learned = (counts[2] + OUTLIERS_EXPECTED * prior) / (counts[0] + OUTLIERS_EXPECTED)
    outlier[0] = min(max(counts[0] / (counts[0] + counts[1]), 0.005), 0.5)
    outlier[1] = min(max(learned, prior / 9.0), 9.0 * prior)
    return float(outlier[0])


@compiled
def surprises(surprise: Floats, counts: Floats, outlier: Floats) -> bool:
    """Tell whether any user's share of odd ranges ``surprise`` (N,) is out of the usual."""
    usual = max(SURPRISE, SURPRISE_OF_OUTLIERS * expect_outliers(counts, outlier))
    most = 0.0
    for much in surprise:
        most = max(most, much)
    return most > usual


@compiled
def normalise(log_weight: Floats, count: int, weight: Floats) -> float:
    """Give weights (B, LANES) that sum to 1 over the first ``count``, and 0 beyond them.

    The log weights are shifted so that their greatest is 0. Returns the effective size.
    """
    logs, weights = log_weight.reshape(-1), weight.reshape(-1)
    most = -np.inf
    for k in range(count):
        most = max(most, logs[k])
    for k in range(logs.shape[0]):
        logs[k] -= most
    for b in range(weight.shape[0]):
        store(weight, b, lanes.exp(load(log_weight, b)))
    for k in range(count, weights.shape[0]):
        weights[k] = 0.0
    total, squares = 0.0, 0.0
    for k in range(count):
        total += weights[k]
    for k in range(count):
        weights[k] /= total
        squares += weights[k] * weights[k]
    return 1.0 / squares


@compiled
def undoubted_weights(log_weight: Floats, doubtful: Floats, weight: Floats) -> None:
    """As ``normalise``, with next to nothing for those who doubt (``doubtful`` (K,) above 0)."""
    count = doubtful.shape[0]
    logs = log_weight.copy()
    flat = logs.reshape(-1)
    for k in range(count):
        if doubtful[k] > 0.0:
            flat[k] -= DOUBTERS
    normalise(logs, count, weight)


@compiled
def is_decided(
    log_weight: Floats, doubtful: Floats, has_constants: Floats, has_bias: Floats, weight: Floats
) -> bool:
    """Tell whether no few hypotheses count and all model the same; brings weights up to date."""
    count = doubtful.shape[0]
    if normalise(log_weight, count, weight) < hypotheses.EVEN * count:
        return False
    flat = weight.reshape(-1)
    doubting, constants, biased = 0.0, 0.0, 0.0
    for k in range(count):
        doubting += flat[k] if doubtful[k] > 0.0 else 0.0
        constants += flat[k] * has_constants[k]
        biased += flat[k] * has_bias[k]
    least = max(min(constants, 1.0 - constants), min(biased, 1.0 - biased))
    return doubting <= hypotheses.DOUBTED and least <= hypotheses.UNDECIDED


@compiled
def is_even(
    p: Floats, weight: Floats, covariance: Floats, of: Indices, places: int, drawn: float
) -> bool:
    """Tell whether the hypotheses, by ``weight`` (B, LANES), are one cloud.

    That is where the variances between them, the rest of the mixture's ``covariance`` (D, D), are
    what ``drawn``, the drawn over the kept share of the noise, accounts for.
    """
    for i in range(places):
        sums = fill(0.0)
        for b in range(p.shape[0]):
            at = b * p.shape[1] + (i * (i + 1)) // 2 + i
            sums = sums + load(weight, b) * load(p, at)
        within = lanes.total(sums)
        between = covariance[of[i], of[i]] - within
        if between > hypotheses.APART * drawn * within + 1e-6:
            return False
    return True


@compiled
def step_bend(
    x: Floats, p: Floats, log_weight: Floats, doubtful: Floats, has_constants: Floats,
    has_bias: Floats, levels: Floats, nodes: int, weight: Floats, undoubted: Floats,
) -> float:  # fmt: skip
    """Give the bend of everybody's next metre (``hypothesis_count``); inf where open.

    That is where few hypotheses count, or they model different things. ``weight`` and
    ``undoubted`` (B, LANES) receive the weights, and those of who does not doubt.
    """
    undoubted_weights(log_weight, doubtful, undoubted)
    if not is_decided(log_weight, doubtful, has_constants, has_bias, weight):
        return np.inf
    heading = heading_variances(x, p, undoubted, nodes)
    worst = 0.0
    for n in range(nodes):
        metre = math.sqrt(ALONG_M2_M) * math.exp(0.5 * levels[COMPONENTS * n + ALONG])
        worst = max(worst, 0.5 * heading[n] / metre)
    return worst


@compiled
def spread_levels(
    draw: Floats, steady: Floats, mean: Floats, covariance: Floats, spread: float, level: Floats,
    sigma2: Floats,
) -> None:  # fmt: skip
    """Give every hypothesis its draw ``draw`` (B, L, LANES) of what is known of log levels (L,).

    Where ``steady`` (B, LANES) is 1 they are lower by ``noise.STEADIER``. ``level``
    (B, N, 3, LANES) and ``sigma2`` (B, LANES) receive them.
    """
    blocks, several = draw.shape[0], draw.shape[1]
    for c in range(several):
        sd = min(spread * math.sqrt(covariance[c, c]), noise.SPREAD_MOST)
        lower = noise.STEADIER[c % COMPONENTS] if c < several - 1 else 0.0
        for b in range(blocks):
            drawn = sd * load(draw, b * several + c) - lower * load(steady, b)
            value = lanes.exp(mean[c] + drawn)
            if c == several - 1:
                store(sigma2, b, value)
            else:
                store(level, b * (several - 1) + c, value)


@compiled
def prepare_motion(
    rows: Indices,
    moves: Floats,
    told: Floats,
    level: Floats,
    count: int,
    since_turn_s: Floats,
    motion: Floats,
    misjudged: Floats,
) -> bool:
    """Write what ``joint.advance`` takes of displacements (M, 4) into ``motion`` (M, 7).

    ``told`` (M, 3), or (0, 3) where no report brings any, are the pieces' own standard deviations.
    ``misjudged`` (M,) receives the share of hypotheses that are to misjudge a turn, -1 where there
    is none; returns whether there are any.

    A turn's noise grows with the turn, of which only the report is known: one of a right
    angle that was reported as next to nothing would pass for exact. Only what sticks out of
    the wearer's white heading noise is a turn, and only reports that bring no sigma need it;
    who turns all the time is judged by the next turn, and is left alone.
    """
    anybody = False
    base = base_variances(moves, told)
    for m in range(rows.shape[0]):
        for part in range(4):
            motion[m, part] = moves[m, part]
        for part in range(COMPONENTS):
            motion[m, 4 + part] = base[m, part]
        # Who reports nothing at all stands: no time passes for the heading.
        if motion[m, 0] == 0.0 and motion[m, 1] == 0.0 and motion[m, 2] == 0.0:
            motion[m, 3] = 0.0
        row = rows[m]
        misjudged[m] = -1.0
        if count < 2:
            continue
        mean = 0.0
        if motion[m, 2] != 0.0:
            for k in range(count):
                mean += level[k // LANES, row, WHITE, k % LANES]
        white = motion[m, 6] * mean / count
        turn = motion[m, 2] ** 2 > LEAST_TURN_RAD**2 + TURN_STANDS_OUT**2 * white
        if turn and (told.shape[0] == 0 or math.isnan(told[m, 2])):
            misjudged[m] = MISJUDGED * min(since_turn_s[row] / STRAIGHT_S, 1.0) ** 2
            since_turn_s[row] = 0.0
            anybody = True
        else:
            since_turn_s[row] += motion[m, 3]
    return anybody


@inlined
def digest(
    stats: Floats,
    before: Floats,
    log_weight: Floats,
    doubtful: Floats,
    first: Indices,
    second: Indices,
    measured: Floats,
    worth: Floats,
    levels: Floats,
    covariance: Floats,
    outlier_counts: Floats,
    surprise: Floats,
    sums: Floats,
    base: Floats,
    outlier_share: float,
    wary: bool,
    good: Floats,
) -> tuple[int, int]:
    """Learn from the innovations of an instant's ranges (R,) what they say of the sensors.

    ``stats`` (R, STATS, >= K) are of ``joint.update``, ``before`` (K,) the log weights from
    before it. ``good`` (R,) receives each range's probability to be no outlier. ``outlier_counts``
    are of outliers, of others, and the sum of the outliers' squares (m^2). Returns the row that
    has slipped, or -1, and how many levels had to be clamped.
    """
    count, ranges = before.shape[0], first.shape[0]
    prior = np.empty(count)
    most, total = -np.inf, 0.0
    for k in range(count):
        most = max(most, before[k])
    for k in range(count):
        prior[k] = math.exp(before[k] - most) * (DOUBTED if doubtful[k] > 0.0 else 1.0)
        total += prior[k]
    for k in range(count):
        prior[k] /= total
    square, excess = np.empty(ranges), np.empty(ranges)
    for r in range(ranges):
        mean, variance = stats[r, MEAN], stats[r, VARIANCE]
        middle = 0.0
        for k in range(count):
            middle += prior[k] * mean[k]
        spread = 0.0
        for k in range(count):
            off = mean[k] - middle
            spread += prior[k] * (variance[k] + off * off)
        off = measured[r] - middle
        square[r] = off * off / spread
        excess[r] = max(off * off - spread, 0.0)
    detector = CusumDetector(sums, base)
    slipped = update_cusum(detector, first, second, square, worth, outlier_share, wary)
    weight = np.empty_like(log_weight)
    normalise(log_weight, count, weight)
    weights = weight.reshape(-1)
    for r in range(ranges):
        trust = stats[r, TRUST]
        good[r] = 0.0
        for k in range(count):
            good[r] += weights[k] * trust[k]
    quiet = np.empty(count)
    for k in range(count):
        quiet[k] = 1.0 if doubtful[k] <= 0.0 else 0.0
        doubtful[k] -= 1.0
    clamped = noise.learn(levels, covariance, first, second, measured, stats, before, quiet, worth)
    fade = 0.998**ranges
    outlier_counts[0] *= fade
    outlier_counts[1] *= fade
    for r in range(ranges):
        outlier_counts[0] += 1.0 - good[r]
        outlier_counts[1] += good[r]
        outlier_counts[2] += (1.0 - good[r]) * excess[r]
        for row in (first[r], second[r]):
            surprise[row] += 0.2 * (1.0 - good[r] - surprise[row])
    return slipped, clamped


@compiled
def heading_variances(x: Floats, p: Floats, weight: Floats, nodes: int) -> Floats:
    """Give the variances (N,) of headings in the mixture, by ``weight`` (B, LANES)."""
    blocks, size = x.shape[0], x.shape[1]
    turn = 2.0 * math.pi
    given = np.empty(nodes)
    for n in range(nodes):
        h = 3 * n + 2
        own = (h * (h + 1)) // 2 + h
        about = x[0, h, 0]
        middle = fill(0.0)
        for b in range(blocks):
            off = load(x, b * size + h) - about
            off = off - turn * lanes.floor(off * (1.0 / turn) + 0.5)
            middle = middle + load(weight, b) * off
        mean = lanes.total(middle)
        spread = fill(0.0)
        for b in range(blocks):
            off = load(x, b * size + h) - about
            off = off - turn * lanes.floor(off * (1.0 / turn) + 0.5) - mean
            spread = spread + load(weight, b) * (load(p, b * p.shape[1] + own) + off * off)
        given[n] = lanes.total(spread)
    return given


@compiled
def temper(log_weight: Floats, before: Floats) -> None:
    """Let what the log weights (B, LANES) have gained since ``before`` (K,) count ``BELIEVED``."""
    weights = log_weight.reshape(-1)
    for k in range(before.shape[0]):
        weights[k] = before[k] + BELIEVED * (weights[k] - before[k])


@compiled
def take_ranges(
    x: Floats, p: Floats, log_weight: Floats, sigma2: Floats, sens: Floats, first: Indices,
    second: Indices, bias: Indices, measured: Floats, dz: Floats, outlier: Floats, worth: Floats,
    dz_variance: Floats, arms: Floats, doubtful: Floats, levels: Floats, covariance: Floats,
    outlier_counts: Floats, surprise: Floats, sums: Floats, base: Floats, wary: bool, draw: Floats,
    steady: Floats, spread: float, level: Floats, good: Floats,
) -> tuple[int, int]:  # fmt: skip
    """Do all that an instant's ranges ask for: ``joint.update``, ``digest``, ``spread_levels``."""
    count, ranges = doubtful.shape[0], first.shape[0]
    lines = lanes.working_lines(ranges * STATS * x.shape[0])
    before = log_weight.reshape(-1)[:count].copy()
    expect_outliers(outlier_counts, outlier)
    update(
        x, p, log_weight, sigma2, sens, first, second, bias, measured, dz, outlier, worth,
        dz_variance, arms, lines,
    )  # fmt: skip
    slipped, clamped = digest(
        lines.reshape(ranges, STATS, -1), before, log_weight, doubtful, first, second, measured,
        worth, levels, covariance, outlier_counts, surprise, sums, base, outlier[0], wary, good,
    )  # fmt: skip
    temper(log_weight, before)
    spread_levels(draw, steady, levels, covariance, spread, level, sigma2)
    return slipped, clamped


@compiled
def pairs(mean: Floats, covariance: Floats, rows: Indices) -> Floats:
    """Give (P, 4) of every two of the users ``rows`` (N,), by the mixture's moments (D,), (D, D).

    Distance and its standard deviation (m), bearing and its (rad), to first order; of two on one
    spot no direction is along the line of sight, and any bearing is as likely.
    """
    several = rows.shape[0]
    told = np.empty((several * (several - 1) // 2, 4))
    n = 0
    for a in range(several):
        i = PER_NODE * rows[a]
        for b in range(a + 1, several):
            j = PER_NODE * rows[b]
            east, north = mean[j] - mean[i], mean[j + 1] - mean[i + 1]
            xx = covariance[i, i] + covariance[j, j] - 2.0 * covariance[i, j]
            yy = covariance[i + 1, i + 1] + covariance[j + 1, j + 1]
            yy -= 2.0 * covariance[i + 1, j + 1]
            xy = covariance[i, i + 1] + covariance[j, j + 1]
            xy -= covariance[i, j + 1] + covariance[i + 1, j]
            square = east * east + north * north
            along, sideways = 0.5 * (xx + yy), ANY_ANGLE_RAD
            if square > 0.0:
                along = east * east * xx + 2.0 * east * north * xy + north * north * yy
                along /= square
                sideways = min(math.sqrt(max(xx + yy - along, 0.0) / square), ANY_ANGLE_RAD)
            told[n, 0], told[n, 1] = math.sqrt(square), math.sqrt(max(along, 0.0))
            told[n, 2], told[n, 3] = math.atan2(north, east), sideways
            n += 1
    return told
