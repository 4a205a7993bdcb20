"""Whether an estimate is as uncertain as it says: NEES with its interval, coverage.

A normalised squared error is chi-square distributed where the estimate is honest, so its mean per
degree of freedom is 1 (Bar-Shalom, Li, Kirubarajan 2001, sect. 5.4). How far from 1 chance may
take it depends on how many independent errors there were. Errors one second apart, or of two
pairs that share a node, are not independent; what counts is the spread of the mean itself: a mean
m of squares whose own standard deviation is s is worth

    n = 2 (m / s)^2

independent squares, as for those the relative variance of the mean is 2 / n. Over several runs s
comes from the spread of the runs' means; within one from the integrated autocorrelation. The 95 %
interval is then that of chi-square with n degrees of freedom, over n.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from relpos.evaluation.finite import mean_of_rows
from relpos.evaluation.metrics import Metrics
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.tracks import Track, interpolate, whole_seconds, wrap_angle

Floats = npt.NDArray[np.float64]

ENOUGH_RUNS = 8
"""From so many runs on the spread of their means is known better than an autocorrelation."""


@dataclass(frozen=True, slots=True)
class Nees:
    """A mean normalised squared error per degree of freedom; 1 is honest, above overconfident.

    ``low`` and ``high`` bound where an honest estimator's figure lies in 95 of 100 cases,
    ``effective`` is how many independent squares the mean is worth, ``values`` how many went in.
    """

    mean: float
    low: float
    high: float
    effective: float
    values: int

    @property
    def honest(self) -> bool:
        """Whether chance alone explains the difference from 1."""
        return self.low <= self.mean <= self.high


def nees(runs: Sequence[Floats]) -> Nees:
    """Average normalised squares per degree of freedom over runs.

    Each run is (T,) or (T, P) over time, NaN where there is nothing; simultaneous squares are
    averaged first. All NaN gives NaN.
    """
    simultaneous = (run if run.ndim == 1 else mean_of_rows(run) for run in map(np.asarray, runs))
    series = [s[np.isfinite(s)] for s in simultaneous]
    series = [s for s in series if s.size]
    values = int(sum(np.isfinite(run).sum() for run in runs))
    if not series:
        return Nees(math.nan, math.nan, math.nan, 0.0, 0)
    means = np.array([s.mean() for s in series])
    mean = float(means.mean())
    if mean <= 0.0:
        return Nees(mean, math.nan, math.nan, float(values), values)
    if len(series) >= ENOUGH_RUNS:
        variance = float(means.var(ddof=1)) / len(series)
    else:
        variance = sum(_variance_of_mean(s) for s in series) / len(series) ** 2
    effective = float(np.clip(2.0 * mean**2 / max(variance, 1e-300), 1.0, max(values, 1)))
    low, high = chi_square_interval(effective)
    return Nees(mean, low, high, effective, values)


def chi_square_interval(freedom: float) -> tuple[float, float]:
    """Return the central 95 % interval of a mean of ``freedom`` independent squares."""
    from scipy.special import gammaincinv

    low, high = (2.0 * float(gammaincinv(0.5 * freedom, p)) for p in (0.025, 0.975))
    return low / freedom, high / freedom


def of_distances(metrics: Sequence[Metrics]) -> Nees:
    """NEES of the pairs' distances over runs: of each run its figure of the run format.

    There every square counts alike, so an epoch counts by its number of pairs.
    """
    runs = []
    for one in metrics:
        pairs = np.isfinite(one.pair_nees).sum(axis=1)
        weight = pairs * np.count_nonzero(pairs) / max(pairs.sum(), 1)
        runs.append(one.nees_distance + weight * (one.nees_over_time - one.nees_distance))
    return nees(runs)


def of_poses(estimates: Sequence[Estimate], truth: Mapping[int, Track]) -> tuple[Floats, Floats]:
    """Normalised squares of positions (per degree of freedom) and headings, each (T, N).

    At all whole seconds where a located node has an estimate and a truth. Absolute poses are
    compared: it makes sense only where both are in one frame, as with known starts.
    """
    nodes = sorted(truth)
    at_s = whole_seconds(truth.values())
    position, heading = np.full((2, at_s.size, len(nodes)), np.nan)
    for n, node in enumerate(nodes):
        rows = [
            (e.time_s, p.x_m, p.y_m, p.heading_rad, p.variance_x_m2, p.variance_y_m2,
             p.covariance_xy_m2, p.sigma_heading_rad)
            for e in estimates
            for p in e.nodes
            if p.node == node and p.status is not NodeStatus.UNLOCATED
        ]  # fmt: skip
        if not rows:
            continue
        time_s, x, y, angle, xx, yy, xy, sigma = np.array(rows).T
        q = truth[node]

        def both(of: Floats, *, circular: bool = False, at: Floats = time_s) -> Floats:
            return interpolate(at, of, at_s, circular=circular)

        dx = both(x) - interpolate(q.time_s, q.x_m, at_s)
        dy = both(y) - interpolate(q.time_s, q.y_m, at_s)
        a, b, c = both(xx), both(yy), both(xy)
        area = a * b - c * c
        good = area > 0.0
        squares = (b * dx * dx - 2.0 * c * dx * dy + a * dy * dy) / np.where(good, area, 1.0)
        position[:, n] = np.where(good, 0.5 * squares, np.nan)
        turn = wrap_angle(
            both(angle, circular=True) - interpolate(q.time_s, q.heading_rad, at_s, circular=True)
        )
        spread = both(sigma)
        known = spread > 0.0
        heading[:, n] = np.where(known, (turn / np.where(known, spread, 1.0)) ** 2, np.nan)
    return position, heading


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often a region contained the truth: fraction, 95 % interval, effective sample count."""

    share: float
    low: float
    high: float
    effective: float


def coverage(runs: Sequence[npt.NDArray[np.bool_]]) -> Coverage:
    """Average hits over runs, (T,) each; the interval is Wilson's at the effective number."""
    series = [np.asarray(run, dtype=np.float64) for run in runs if len(run)]
    if not series:
        return Coverage(math.nan, math.nan, math.nan, 0.0)
    total = sum(s.size for s in series)
    # Every epoch counts alike, and so does a run by its length.
    share = float(sum(s.sum() for s in series)) / total
    if len(series) >= ENOUGH_RUNS:
        weight = np.array([s.size / total for s in series])
        away = np.array([s.mean() - share for s in series])
        correction = len(series) / (len(series) - 1)
        variance = correction * float(np.sum((weight * away) ** 2))
    else:
        variance = sum((s.size / total) ** 2 * _variance_of_mean(s) for s in series)
    spread = share * (1.0 - share)
    effective = float(np.clip(spread / max(variance, 1e-300), 1.0, total)) if spread else 1.0
    if not spread:
        # All alike: nothing is seen of how long a hit lasts, so a run counts once.
        effective = float(len(series))
    low, high = wilson_interval(np.array(share), np.array(effective))
    return Coverage(share, max(float(low), 0.0), min(float(high), 1.0), effective)


def wilson_interval(share: Floats, count: Floats) -> tuple[Floats, Floats]:
    """Return Wilson's 95 % intervals (n,) of shares (n,) of so many independent cases (n,)."""
    z2 = 1.96**2
    middle = (share + 0.5 * z2 / count) / (1.0 + z2 / count)
    half = np.sqrt(z2 * (share * (1.0 - share) / count + 0.25 * z2 / count**2))
    half = half / (1.0 + z2 / count)
    return middle - half, middle + half


def _variance_of_mean(series: Floats) -> float:
    """Variance of a correlated series' mean: its variance times the correlation time over T.

    The autocorrelation is summed up to the first lag where two neighbours' sum is not positive
    (Geyer's initial positive sequence).
    """
    count = series.size
    away = series - series.mean()
    variance = float(np.mean(away**2))
    if count < 3 or variance <= 0.0:
        # A single value may be worth no more than one square: relative variance 2.
        return 2.0 * float(series.mean()) ** 2 if count < 3 else 0.0
    spectrum = np.abs(np.fft.rfft(away, 2 * count)) ** 2
    rho = np.fft.irfft(spectrum)[:count] / (count * variance)
    together = 1.0
    for lag in range(1, count - 1, 2):
        pair = float(rho[lag] + rho[lag + 1])
        if pair <= 0.0:
            break
        together += 2.0 * pair
    return variance * together / count
