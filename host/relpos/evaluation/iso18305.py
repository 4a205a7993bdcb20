"""The accuracy metrics of ISO/IEC 18305:2016, the standard for testing localization and tracking.

Of its clause 8, in our words. An error vector e = (e_x, e_y, e_z) is estimate minus truth at one
test point; here a test point is one node at one whole second where both are known (and at the
time of a truth row that stands alone, as a landmark press does). Its horizontal magnitude h is the
length of (e_x, e_y), its vertical one v that of e_z, its spherical one s that of e:

* means of the error vector and of the magnitudes (8.4), covariance of the vector (8.5), variances
  of the magnitudes (8.6), root mean squares (8.7), the length of the mean error vector (8.8);
* CE95 and CEP (8.9), VE95 and VEP (8.10), SE95 and SEP (8.11): the least radius round the truth
  (for v: half height) that holds 95 % and 50 % of the errors. They are order statistics of the
  magnitudes that occurred, the smallest that at least this share does not exceed; no distribution
  is assumed and nothing is interpolated. CEP, VEP and SEP are called CE50, VE50 and SE50 here;
* coverage (8.12), relative accuracy (8.13) and latency (8.14).

Variances and covariances divide by the number of errors, so that RMS^2 = mean^2 + variance.
Floor detection (8.2) is in :mod:`relpos.evaluation.vertical`; zone detection (8.3) needs a map.

**Frames.** The standard expects positions in the building's frame. A relative estimate has none of
its own, so errors can be stated in three ways, and every figure says in which:

* ``AS_GIVEN``: nothing is moved. Only where the run states the starts, in the truth's frame.
* ``PER_RUN``: one rigid motion of the plane, SE(2) without reflection, for the whole run and all
  nodes, that fits all errors best in the least-squares sense. What a map pinned once would show.
* ``PER_EPOCH``: one such motion at every second, over the nodes known then (three or more): what
  of the error is the team's shape alone.

Heights are taken over each node's own height at its first test point, in the estimate and in the
truth, in every frame: pressure observes nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from relpos.evaluation import finite
from relpos.evaluation.metrics import MIN_NODES_FOR_SHAPE
from relpos.tracks import MAX_GAP_S, Track, Tracks, align, interpolate, whole_seconds

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


class Frame(StrEnum):
    """Alignment of the estimate with the truth, before errors are computed."""

    AS_GIVEN = "as_given"
    PER_RUN = "per_run"
    PER_EPOCH = "per_epoch"


@dataclass(frozen=True)
class Errors:
    """Error vectors at n test points: ``time_s`` and ``node`` (n,), ``error_m`` (n, 3).

    The third component is NaN where a height is not known.
    """

    time_s: Floats
    node: Integers
    error_m: Floats

    def of(self, node: int) -> Errors:
        """Those of one node."""
        own = self.node == node
        return Errors(self.time_s[own], self.node[own], self.error_m[own])


@dataclass(frozen=True, slots=True)
class Magnitudes:
    """One kind of error's magnitudes; all NaN, and ``count`` 0, where there are none."""

    count: int
    mean_m: float
    rms_m: float
    variance_m2: float
    e50_m: float
    e95_m: float
    max_m: float


@dataclass(frozen=True)
class Accuracy:
    """Everything of clauses 8.4 to 8.11 in one frame.

    ``mean_error_m`` (3,) and ``covariance_m2`` (3, 3) hold NaN in z where no height is known.
    ``absolute_mean_m`` is the length of the mean error vector, horizontal where there is no z.
    """

    frame: Frame
    mean_error_m: Floats
    absolute_mean_m: float
    covariance_m2: Floats
    horizontal: Magnitudes
    vertical: Magnitudes
    spherical: Magnitudes


@dataclass(frozen=True, slots=True)
class Latency:
    """Delay of an estimate after its own time (s).

    ``wait_*`` is what the estimator waits for later measurements, in the run's own time; what it
    computes comes on top, ``computing_s`` for one measurement on average.
    """

    wait_median_s: float
    wait_p95_s: float
    wait_max_s: float
    computing_s: float


@dataclass(frozen=True)
class Assessment:
    """One run by the standard's metrics.

    ``frames`` holds what can be stated, ``nodes`` each node's in the ``headline`` frame;
    ``relative`` are the magnitudes of the errors of the vectors between two nodes, over all
    pairs, in that frame, and ``coverage`` the share of the truth's test points at which the
    node was located.
    """

    headline: Frame | None
    frames: Mapping[Frame, Accuracy]
    nodes: Mapping[int, Accuracy]
    relative: Magnitudes
    coverage: float
    latency: Latency | None = None
    errors: Mapping[Frame, Errors] = field(default_factory=dict, repr=False)

    @property
    def known(self) -> bool:
        """Whether there was any test point at all."""
        return bool(self.frames)


def assess(
    estimate: Tracks,
    truth: Tracks,
    *,
    common_frame: bool,
    located: Tracks | None = None,
    latency: Latency | None = None,
) -> Assessment:
    """Assess an estimate: ``common_frame`` says that its coordinates are the truth's.

    ``located`` are the tracks with NaN where a node was not located, for the coverage; without
    them every estimated position counts. Never raises for missing data.
    """
    points = _points(estimate, truth)
    errors: dict[Frame, Errors] = {}
    if points.time_s.size:
        if common_frame:
            errors[Frame.AS_GIVEN] = points.errors()
        if _spread(points):
            errors[Frame.PER_RUN] = points.moved(np.zeros(points.time_s.size)).errors()
        per_epoch = points.moved(points.time_s, MIN_NODES_FOR_SHAPE)
        if per_epoch.time_s.size:
            errors[Frame.PER_EPOCH] = per_epoch.errors()
    frames = {frame: accuracy(frame, one) for frame, one in errors.items()}
    headline = next(iter(frames), None)
    nodes: dict[int, Accuracy] = {}
    relative = magnitudes(np.empty(0))
    if headline is not None:
        own = errors[headline]
        nodes = {n: accuracy(headline, own.of(n)) for n in sorted(set(own.node.tolist()))}
        relative = magnitudes(_relative(own))
    return Assessment(
        headline,
        frames,
        nodes,
        relative,
        _coverage(estimate if located is None else located, truth),
        latency,
        errors,
    )


def accuracy(frame: Frame, errors: Errors) -> Accuracy:
    """Sum up error vectors (n, 3)."""
    vectors = errors.error_m
    mean = np.array([finite.mean(vectors[:, k]) for k in range(3)])
    there = mean[np.isfinite(mean)]
    return Accuracy(
        frame,
        mean,
        float(np.linalg.norm(there)) if there.size else math.nan,
        _covariance(vectors),
        magnitudes(np.hypot(vectors[:, 0], vectors[:, 1])),
        magnitudes(np.abs(vectors[:, 2])),
        magnitudes(np.linalg.norm(vectors, axis=1)),
    )


def magnitudes(values_m: Floats) -> Magnitudes:
    """Sum up error magnitudes (n,); NaN ones do not count."""
    values_m = values_m[np.isfinite(values_m)]
    if not values_m.size:
        return Magnitudes(0, *(6 * (math.nan,)))
    return Magnitudes(
        int(values_m.size),
        float(values_m.mean()),
        math.sqrt(float(np.mean(values_m**2))),
        float(values_m.var()),
        percentile(values_m, 0.50),
        percentile(values_m, 0.95),
        float(values_m.max()),
    )


def percentile(values_m: Floats, share: float) -> float:
    """Return the smallest of the values (n,) that at least ``share`` of them do not exceed."""
    return float(np.quantile(values_m, share, method="inverted_cdf"))


@dataclass(frozen=True)
class _Points:
    """Estimated and true positions (n, 3) at the test points."""

    time_s: Floats
    node: Integers
    estimate_m: Floats
    truth_m: Floats

    def errors(self) -> Errors:
        return Errors(self.time_s, self.node, self.estimate_m - self.truth_m)

    def moved(self, group: Floats, least: int = 2) -> _Points:
        """Fit the plane of each group (n,) onto its truth; groups of fewer points are left out."""
        estimate_m, kept = self.estimate_m.copy(), np.zeros(group.size, dtype=bool)
        order = np.argsort(group, kind="stable")
        _, first = np.unique(group[order], return_index=True)
        for rows in np.split(order, first[1:]):
            if rows.size < least:
                continue
            kept[rows] = True
            moving = align(self.estimate_m[rows, :2], self.truth_m[rows, :2])
            estimate_m[rows, :2] = moving(self.estimate_m[rows, :2])
        return _Points(self.time_s[kept], self.node[kept], estimate_m[kept], self.truth_m[kept])


def _points(estimate: Tracks, truth: Tracks) -> _Points:
    blocks = []
    for node in sorted(set(estimate) & set(truth)):
        at_s = tested_at(truth[node])
        p, q = _positions(estimate[node], at_s), _positions(truth[node], at_s)
        there = np.isfinite(p[:, :2]).all(axis=1) & np.isfinite(q[:, :2]).all(axis=1)
        p, q, at_s = p[there], q[there], at_s[there]
        heights = np.flatnonzero(np.isfinite(p[:, 2] + q[:, 2]))
        # Heights are over each one's own start, here as in the recordings.
        start = heights[0] if heights.size else None
        p[:, 2] -= math.nan if start is None else p[start, 2]
        q[:, 2] -= math.nan if start is None else q[start, 2]
        blocks.append((at_s, np.full(at_s.size, node), p, q))
    if not blocks:
        empty = np.empty((0, 3))
        return _Points(np.empty(0), np.empty(0, dtype=np.int64), empty, empty)
    return _Points(*(np.concatenate(column) for column in zip(*blocks, strict=True)))


def tested_at(truth: Track) -> Floats:
    """Return when one node is tested: its whole seconds, and rows with no other within reach."""
    there = np.isfinite(truth.x_m) & np.isfinite(truth.y_m) & np.isfinite(truth.time_s)
    rows = np.unique(truth.time_s[there])
    apart = np.diff(rows, prepend=-math.inf, append=math.inf) > MAX_GAP_S
    alone = rows[apart[:-1] & apart[1:]]
    return np.unique(np.concatenate((whole_seconds([truth]), alone)))


def _positions(track: Track, at_s: Floats) -> Floats:
    there = np.isfinite(track.x_m) & np.isfinite(track.y_m)
    time_s = track.time_s[there]
    return np.column_stack(
        [interpolate(time_s, v[there], at_s) for v in (track.x_m, track.y_m, track.z_m)]
    )


def _spread(points: _Points) -> bool:
    """Whether the truth is more than one place: a single one fits anything."""
    return bool(np.ptp(points.truth_m[:, :2], axis=0).max() > 0.0)


def _relative(errors: Errors) -> Floats:
    """Magnitudes of the errors of the vectors between two nodes at one time, all pairs, (m,)."""
    found = []
    order = np.argsort(errors.time_s, kind="stable")
    _, first = np.unique(errors.time_s[order], return_index=True)
    for rows in np.split(order, first[1:]):
        a, b = np.triu_indices(rows.size, 1)
        between = errors.error_m[rows[b], :2] - errors.error_m[rows[a], :2]
        found.append(np.hypot(*between.T))
    return np.concatenate(found) if found else np.empty(0)


def _coverage(located: Tracks, truth: Tracks) -> float:
    tested = covered = 0
    for node, track in truth.items():
        at_s = tested_at(track)
        known = np.isfinite(_positions(track, at_s)[:, 0])
        tested += int(known.sum())
        if node in located:
            covered += int((np.isfinite(_positions(located[node], at_s)[:, 0]) & known).sum())
    return covered / tested if tested else math.nan


def _covariance(vectors: Floats) -> Floats:
    """Covariance (3, 3) of error vectors (n, 3); NaN in z where no height is known."""
    result = np.full((3, 3), np.nan)
    flat = vectors[:, :2][np.isfinite(vectors[:, :2]).all(axis=1)]
    if flat.size:
        result[:2, :2] = np.cov(flat.T, bias=True)
    solid = vectors[np.isfinite(vectors).all(axis=1)]
    if solid.size:
        whole = np.cov(solid.T, bias=True)
        result[2, :], result[:, 2] = whole[2, :], whole[:, 2]
    return result
