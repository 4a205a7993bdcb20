"""The ranges of a run: residuals of each pair, and detection over distance."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import numpy.typing as npt

from relpos.evaluation.consistency import wilson_interval
from relpos.evaluation.finite import median
from relpos.fusion.models.detection import LENGTH, STEP_M, Detection, Round
from relpos.measurements import Measurement, Motion, Range
from relpos.tracks import Pair, PairTrack, Track, Tracks, interpolate

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a Gaussian over its median absolute deviation."""


@dataclass(frozen=True)
class PairRanges:
    """The ranges of one pair, lower id first: n good ones, and how many failed.

    ``estimated_m`` and ``true_m`` (n,) are the distances at the times of the ranges, from the
    estimate and the truth, NaN where there is none; with heights where both nodes' are known,
    because a range is slant.
    """

    pair: Pair
    time_s: Floats
    range_m: Floats
    estimated_m: Floats
    true_m: Floats
    failed: int

    @property
    def residual_m(self) -> Floats:
        """Range less estimated distance, (n,)."""
        return self.range_m - self.estimated_m

    @property
    def error_m(self) -> Floats:
        """Range less true distance, (n,)."""
        return self.range_m - self.true_m


def by_pair(ranges: Sequence[Range], estimate: Tracks, truth: Tracks) -> list[PairRanges]:
    """Sort ranges by pair and put the distances beside them, in the order of the ids."""
    kept: dict[Pair, list[Range]] = {}
    for one in ranges:
        kept.setdefault((min(one.node, one.peer), max(one.node, one.peer)), []).append(one)
    found = []
    for pair, rows in sorted(kept.items()):
        good = [r for r in rows if r.range_m > 0.0]
        time_s = np.array([r.time_s for r in good])
        found.append(
            PairRanges(
                pair,
                time_s,
                np.array([r.range_m for r in good]),
                distance_at(estimate, pair, time_s),
                distance_at(truth, pair, time_s),
                len(rows) - len(good),
            )
        )
    return found


def distance_at(tracks: Tracks, pair: Pair, at_s: Floats) -> Floats:
    """Distance of two nodes at some times, (m,) -> (m,); NaN where one is not known."""
    if pair[0] not in tracks or pair[1] not in tracks:
        return np.full(at_s.shape, np.nan)
    a, b = (_at(tracks[node], at_s) for node in pair)
    apart = a - b
    # Without both heights it is horizontal, which is what positions are.
    apart[:, 2] = np.where(np.isfinite(apart[:, 2]), apart[:, 2], 0.0)
    result: Floats = np.linalg.norm(apart, axis=1)
    return result


def _at(track: Track, at_s: Floats) -> Floats:
    return np.column_stack(
        [interpolate(track.time_s, v, at_s) for v in (track.x_m, track.y_m, track.z_m)]
    )


def spread(values: Floats) -> float:
    """Standard deviation from the median absolute deviation: outliers do not count."""
    return MAD_TO_SIGMA * median(np.abs(values - median(values)))


@dataclass(frozen=True)
class Heard:
    """Successful and failed ranging attempts by distance.

    ``distance_m`` and ``heard`` (n,) are attempts whose outcome counts
    (:mod:`relpos.fusion.models.detection` says which) and the distance at that time: the true one
    where
    ``true`` says so, else the estimated one. ``curve_m`` (K,) and ``curve`` (K,) are the
    probability learned from the estimated distances, as an estimator does it on line; ``edge_m``
    with ``edge_sigma_m`` is the distance of half the near value, NaN where no edge was seen.
    """

    distance_m: Floats
    heard: Bools
    true: bool
    curve_m: Floats
    curve: Floats
    edge_m: float
    edge_sigma_m: float


def heard(
    measurements: Sequence[Measurement],
    estimate: Tracks,
    truth: Tracks,
    pairs: Mapping[Pair, PairTrack],
) -> Heard | None:
    """Find the attempts of a run and learn the curve; None where no attempt can be placed."""
    detection = Detection()
    rounds = list(_rounds(measurements, detection))
    every = sorted({pair for one in rounds for pair in one.received + one.missed})
    at_s = np.array([one.time_s for one in rounds])
    estimated = {pair: distance_at(estimate, pair, at_s) for pair in every}
    true = {pair: distance_at(truth, pair, at_s) for pair in every}
    sigma = {pair: _sigma_at(pairs, pair, at_s) for pair in every}
    use_truth = any(np.isfinite(row).any() for row in true.values())
    distances: list[float] = []
    outcomes: list[bool] = []
    for k, one in enumerate(rounds):
        known = [
            (pair, sure) for pair, sure in zip(one.received, one.observable, strict=True)
            if np.isfinite(estimated[pair][k])
        ]  # fmt: skip
        placed = Round(
            one.time_s,
            tuple(pair for pair, _ in known),
            tuple(pair for pair in one.missed if np.isfinite(estimated[pair][k])),
            tuple(sure for _, sure in known),
        )
        attempted = placed.received + placed.missed
        detection.update(
            placed,
            np.array([estimated[pair][k] for pair in attempted]),
            np.array([sigma[pair][k] for pair in attempted]),
        )
        where = true if use_truth else estimated
        counted = [pair for pair, sure in zip(one.received, one.observable, strict=True) if sure]
        for pairs_of, outcome in ((counted, True), (one.missed, False)):
            for pair in pairs_of:
                if np.isfinite(where[pair][k]):
                    distances.append(float(where[pair][k]))
                    outcomes.append(outcome)
    if not distances:
        return None
    return Heard(
        np.array(distances),
        np.array(outcomes, dtype=bool),
        use_truth,
        np.arange(LENGTH, dtype=np.float64) * STEP_M,
        detection.curve,
        detection.range_m if detection.known else math.nan,
        detection.range_sigma_m if detection.known else math.nan,
    )


def _rounds(measurements: Sequence[Measurement], detection: Detection) -> Iterator[Round]:
    reported: dict[int, float] = {}

    def reported_s(node: int) -> float:
        return reported.get(node, -math.inf)

    for time_s, group in groupby(measurements, key=lambda m: m.time_s):
        at_once = list(group)
        for one in at_once:
            if isinstance(one, Motion):
                reported[one.node] = time_s
        ranges = [m for m in at_once if isinstance(m, Range) and m.range_m > 0.0]
        if ranges:
            yield from detection.rounds.add(time_s, ranges, reported_s)


def _sigma_at(pairs: Mapping[Pair, PairTrack], pair: Pair, at_s: Floats) -> Floats:
    track = pairs.get(pair) or pairs.get((pair[1], pair[0]))
    if track is None:
        return np.zeros(at_s.shape)
    return np.nan_to_num(interpolate(track.time_s, track.sigma_distance_m, at_s))


def shares(values: Heard, edges_m: Floats) -> tuple[Floats, Floats, Floats, npt.NDArray[np.int64]]:
    """Detected fraction in each bin (B,), its 95 % interval (Wilson) and the attempts there.

    The interval takes attempts as independent; those of one pair a second apart are not, so it is
    rather too narrow.
    """
    place = np.digitize(values.distance_m, edges_m) - 1
    inside = (place >= 0) & (place < edges_m.size - 1)
    tried = np.bincount(place[inside], minlength=edges_m.size - 1)
    found = np.bincount(place[inside & values.heard], minlength=edges_m.size - 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(tried > 0, found / tried, np.nan)
        return share, *wilson_interval(share, tried.astype(np.float64)), tried.astype(np.int64)
