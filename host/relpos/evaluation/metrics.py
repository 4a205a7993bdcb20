"""The metrics of the run format, exactly: how far an estimate of a team is from its truth.

Everything works on arrays and knows no files; :func:`of_estimates` makes them. With estimated
positions p_i(t), true ones q_i(t) and pairs i < j, the epochs are all whole seconds where both
exist; a track is interpolated linearly between rows at most ``MAX_GAP_S`` apart, its heading on
the circle (the short way round).

All figures are invariant to the frame of the estimate: distances, shapes after the best
rotation without reflection, and vectors in the body frame of the node that looks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from relpos.evaluation.finite import mean, mean_of_rows, root_mean
from relpos.evaluation.sides import share_on_wrong_side
from relpos.tracks import (
    Pair,
    Pairs,
    PairTrack,
    Tracks,
    align,
    estimated_pairs,
    estimated_tracks,
    interpolate,
    sample,
    true_tracks,
    whole_seconds,
)

if TYPE_CHECKING:
    from relpos.fusion.estimator import Estimate
    from relpos.measurements import Truth

Floats = npt.NDArray[np.float64]

MIN_NODES_FOR_SHAPE = 3
"""The aligned position error says nothing for two nodes, so epochs with fewer are left out."""


@dataclass(frozen=True)
class PairMetrics:
    """One pair i < j over all its epochs; NaN where a figure is undefined.

    ``distance_error_mean_m`` is estimated minus true; ``body_frame_rmse_m`` covers both
    directions.
    """

    epochs: int
    distance_rmse_m: float
    distance_error_mean_m: float
    distance_error_max_m: float
    body_frame_rmse_m: float
    nees_distance: float


@dataclass(frozen=True)
class Metrics:
    """The four figures of the run format, per pair and over time.

    ``time_s`` is (T,): the epochs at which at least one pair, or one node, could be scored. The
    ``*_over_time`` arrays are (T,) and hold the same root mean square (NEES: mean) at one epoch;
    the ``pair_*`` arrays are (T, P) in the order of ``pair_ids``. NaN means undefined there.
    ``nees_left_out`` counts the rows of the scored pairs whose sigma is 0: no NEES can be had of
    them.
    """

    relative_distance_rmse_m: float
    relative_position_rmse_m: float
    body_frame_rmse_m: float
    nees_distance: float
    pairs: dict[Pair, PairMetrics]
    time_s: Floats
    distance_rmse_over_time_m: Floats
    position_rmse_over_time_m: Floats
    body_frame_rmse_over_time_m: Floats
    nees_over_time: Floats
    pair_ids: tuple[Pair, ...]
    pair_distance_m: Floats
    pair_true_distance_m: Floats
    pair_nees: Floats
    nees_left_out: int = 0
    ok_over_3_sigma: float = math.nan
    ok_over_2_m: float = math.nan
    """Of the pair-seconds with status ok, the shares whose distance errs by more."""
    ok_wrong_side: float = math.nan
    """Of the triangles whose pairs are ok, the share that is told mirrored."""

    @property
    def epochs(self) -> int:
        """Epochs at which at least one pair could be scored."""
        return int(np.isfinite(self.distance_rmse_over_time_m).sum())


def aligned_squared_distances(estimate_m: Floats, truth_m: Floats) -> Floats:
    """Squared distances after the best rigid fit without reflection, (n, 2), (n, 2) -> (n,)."""
    moved = align(estimate_m, truth_m)(estimate_m)
    squared: Floats = ((moved - truth_m) ** 2).sum(axis=1)
    return squared


def of_estimates(estimates: Sequence[Estimate], truth: Sequence[Truth]) -> Metrics:
    """Score an estimator's estimates against a run's truth."""
    return evaluate(estimated_tracks(estimates), true_tracks(truth), estimated_pairs(estimates))


def evaluate(estimate: Tracks, truth: Tracks, pairs: Pairs | None = None) -> Metrics:
    """Score an estimate against the truth, as the run format says.

    ``pairs`` gives the estimated distance and its sigma for the NEES (``pairs.csv``), under
    (node, peer) in either order; without it the NEES is NaN. Nodes that only one side knows
    are left out. Never raises for missing data: an undefined figure is NaN.
    """
    nodes = sorted(set(estimate) & set(truth))
    at_s = whole_seconds([truth[n] for n in nodes])
    count = len(nodes)
    p, p_heading = sample([estimate[n] for n in nodes], at_s)
    q, q_heading = sample([truth[n] for n in nodes], at_s)
    known = np.isfinite(p.sum(axis=2)) & np.isfinite(q.sum(axis=2))

    pair_indices = [(i, j) for i in range(count) for j in range(i + 1, count)]
    pair_ids = tuple((nodes[i], nodes[j]) for i, j in pair_indices)
    shape = (at_s.size, len(pair_ids))
    estimated_m, true_m = np.full(shape, np.nan), np.full(shape, np.nan)
    nees = np.full(shape, np.nan)
    ok = np.full(shape, np.nan)
    body_squared = np.full((*shape, 2), np.nan)
    for k, (i, j) in enumerate(pair_indices):
        both = known[:, i] & known[:, j]
        true_distance_m = np.hypot(*(q[:, i] - q[:, j]).T)
        estimated_m[both, k] = np.hypot(*(p[:, i] - p[:, j]).T)[both]
        true_m[both, k] = true_distance_m[both]
        for direction, (a, b) in enumerate(((i, j), (j, i))):
            seen = _turn(p[:, b] - p[:, a], -p_heading[:, a])
            really = _turn(q[:, b] - q[:, a], -q_heading[:, a])
            body_squared[both, k, direction] = ((seen - really) ** 2).sum(axis=1)[both]
        track = _of_pair(pairs or {}, pair_ids[k])
        if track is not None:
            nees[:, k] = _pair_nees(track, at_s, true_distance_m)
            ok[:, k] = interpolate(track.time_s, track.ok, at_s)

    position_squared = np.full((at_s.size, count), np.nan)
    for epoch in np.flatnonzero(known.sum(axis=1) >= MIN_NODES_FOR_SHAPE):
        there = known[epoch]
        position_squared[epoch, there] = aligned_squared_distances(p[epoch, there], q[epoch, there])

    error_m = estimated_m - true_m
    relied_on = ok == 1.0
    between = np.zeros((at_s.size, count, count), dtype=np.bool_)
    for k, (i, j) in enumerate(pair_indices):
        between[:, i, j] = between[:, j, i] = relied_on[:, k] & np.isfinite(error_m[:, k])
    figures = np.concatenate((error_m, position_squared, nees), axis=1)
    scored = np.flatnonzero(np.isfinite(figures).any(axis=1))
    return Metrics(
        relative_distance_rmse_m=root_mean(error_m**2),
        relative_position_rmse_m=root_mean(position_squared),
        body_frame_rmse_m=root_mean(body_squared),
        nees_distance=mean(nees),
        pairs={
            pair: PairMetrics(
                epochs=int(np.isfinite(error_m[:, k]).sum()),
                distance_rmse_m=root_mean(error_m[:, k] ** 2),
                distance_error_mean_m=mean(error_m[:, k]),
                distance_error_max_m=_max_abs(error_m[:, k]),
                body_frame_rmse_m=root_mean(body_squared[:, k]),
                nees_distance=mean(nees[:, k]),
            )
            for k, pair in enumerate(pair_ids)
        },
        time_s=at_s[scored],
        distance_rmse_over_time_m=_root_mean_rows(error_m**2)[scored],
        position_rmse_over_time_m=_root_mean_rows(position_squared)[scored],
        body_frame_rmse_over_time_m=_root_mean_rows(
            np.hstack((body_squared[..., 0], body_squared[..., 1]))
        )[scored],
        nees_over_time=mean_of_rows(nees)[scored],
        pair_ids=pair_ids,
        pair_distance_m=estimated_m[scored],
        pair_true_distance_m=true_m[scored],
        pair_nees=nees[scored],
        ok_over_3_sigma=_share_above(nees[relied_on], 3.0**2),
        ok_over_2_m=_share_above(np.abs(error_m[relied_on]), 2.0),
        ok_wrong_side=share_on_wrong_side(
            p[..., 0] + 1j * p[..., 1], q[..., 0] + 1j * q[..., 1], between
        ),
        nees_left_out=sum(_certain_rows(_of_pair(pairs or {}, pair)) for pair in pair_ids),
    )


def over_seeds(figures: Sequence[float]) -> tuple[float, float]:
    """Mean of the runs' figures and its standard error (NaN for fewer than two runs)."""
    values = np.asarray(figures, dtype=np.float64)
    if values.size == 0:
        return math.nan, math.nan
    if values.size == 1:
        return float(values[0]), math.nan
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(values.size))


def _turn(vector_m: Floats, angle_rad: Floats) -> Floats:
    """Vectors (T, 2) rotated counter-clockwise by angles (T,)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y = vector_m[:, 0], vector_m[:, 1]
    return np.column_stack((c * x - s * y, s * x + c * y))


def _pair_nees(track: PairTrack, at_s: Floats, true_distance_m: Floats) -> Floats:
    # A sigma of zero claims certainty; the quotient would be infinite and say only that. Such
    # rows are counted in ``Metrics.nees_left_out``.
    good = track.sigma_distance_m > 0.0
    distance_m = interpolate(track.time_s[good], track.distance_m[good], at_s)
    sigma_m = interpolate(track.time_s[good], track.sigma_distance_m[good], at_s)
    result: Floats = ((distance_m - true_distance_m) / sigma_m) ** 2
    return result


def _of_pair(pairs: Pairs, pair: Pair) -> PairTrack | None:
    return pairs.get(pair) or pairs.get((pair[1], pair[0]))


def _certain_rows(track: PairTrack | None) -> int:
    return 0 if track is None else int((track.sigma_distance_m <= 0.0).sum())


def _share_above(values: Floats, limit: float) -> float:
    known = values[np.isfinite(values)]
    return float((known > limit).mean()) if known.size else math.nan


def _max_abs(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.abs(known).max()) if known.size else math.nan


def _root_mean_rows(squares: Floats) -> Floats:
    result: Floats = np.sqrt(mean_of_rows(squares))
    return result
