"""Trajectories as arrays: of estimates and of truth, sampled, interpolated and aligned."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus
from relpos.measurements import Truth

Floats = npt.NDArray[np.float64]

MAX_GAP_S = 2.0
"""Rows further apart than this are not interpolated between (run format, "Metrics, exactly")."""

_TIME_SLACK_S = 1e-6
"""A row this near to a whole second is on it: files carry times rounded to 0.1 ms or so."""


def _floats(values: object) -> Floats:
    return np.asarray(values, dtype=np.float64)


@dataclass(frozen=True)
class Track:
    """Where one node was, or was believed to be: equally long arrays, NaN where not known.

    Rows may come in any order; of rows at the same time the last one counts. A row without a
    position (NaN) is no row. ``z_m`` is the height, where it is known.
    """

    time_s: Floats
    x_m: Floats
    y_m: Floats
    heading_rad: Floats = field(default_factory=lambda: np.empty(0))
    z_m: Floats = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        """Make float arrays of equal length of whatever sequences were given."""
        for name in ("time_s", "x_m", "y_m", "heading_rad", "z_m"):
            object.__setattr__(self, name, _floats(getattr(self, name)))
        for name in ("heading_rad", "z_m"):
            if getattr(self, name).size == 0:
                object.__setattr__(self, name, np.full(self.time_s.shape, np.nan))
        columns = (self.time_s, self.x_m, self.y_m, self.heading_rad, self.z_m)
        shapes = {a.shape for a in columns}
        if len(shapes) != 1 or self.time_s.ndim != 1:
            raise ValueError(f"a track needs arrays of one dimension and one length, not {shapes}")


@dataclass(frozen=True)
class PairTrack:
    """The estimated distance of one pair and its standard deviation over time, (n,) arrays.

    ``ok`` is 1 where the pair's status is ok, else 0; 1 throughout where not given.
    """

    time_s: Floats
    distance_m: Floats
    sigma_distance_m: Floats
    ok: Floats = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        """Make float arrays of equal length of whatever sequences were given."""
        for name in ("time_s", "distance_m", "sigma_distance_m", "ok"):
            object.__setattr__(self, name, _floats(getattr(self, name)))
        if self.ok.size == 0:
            object.__setattr__(self, "ok", np.ones(self.time_s.shape))
        columns = (self.time_s, self.distance_m, self.sigma_distance_m, self.ok)
        if len({a.shape for a in columns}) != 1:
            raise ValueError("a pair's track needs arrays of one length")


Tracks = Mapping[int, Track]
Pair = tuple[int, int]
Pairs = Mapping[Pair, PairTrack]


def interpolate(time_s: Floats, values: Floats, at_s: Floats, *, circular: bool = False) -> Floats:
    """Values of a sampled signal at other times, (n,), (n,), (m,) -> (m,).

    NaN outside the samples and inside gaps wider than ``MAX_GAP_S``; a sample that lies on a
    wanted time counts whatever is around it. ``circular`` interpolates angles the short way
    round.
    """
    good = np.isfinite(time_s) & np.isfinite(values)
    time_s, values = time_s[good], values[good]
    order = np.argsort(time_s, kind="stable")
    time_s, values = time_s[order], values[order]
    if time_s.size:
        last_of_equal = np.append(np.diff(time_s) > 0.0, True)
        time_s, values = time_s[last_of_equal], values[last_of_equal]
    result = np.full(at_s.shape, np.nan)
    if not time_s.size:
        return result

    after = np.searchsorted(time_s, at_s)
    before = np.clip(after - 1, 0, time_s.size - 1)
    after = np.clip(after, 0, time_s.size - 1)
    step_s = time_s[after] - time_s[before]
    inside = (step_s > 0.0) & (step_s <= MAX_GAP_S + _TIME_SLACK_S)
    inside &= (time_s[before] <= at_s) & (at_s <= time_s[after])
    change = values[after] - values[before]
    if circular:
        change = wrap_angle(change)
    share = np.divide(at_s - time_s[before], step_s, out=np.zeros_like(at_s), where=step_s > 0.0)
    result[inside] = (values[before] + share * change)[inside]
    for neighbour in (after, before):
        on_sample = np.abs(time_s[neighbour] - at_s) <= _TIME_SLACK_S
        result[on_sample] = values[neighbour][on_sample]
    return result


def wrap_angle(angle_rad: Floats) -> Floats:
    """Angles moved into [-pi, pi)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def whole_seconds(tracks: Iterable[Track]) -> Floats:
    """Every whole second at which one of the tracks may have a value, in order.

    What :func:`interpolate` knows lies at most a gap behind a row. Seconds further on are left out:
    a row of a week later would make half a million of them.
    """
    times = [t.time_s[np.isfinite(t.time_s)] for t in tracks]
    rows: Floats = np.unique(np.concatenate([np.empty(0), *times]))
    if not rows.size:
        return rows
    first = np.unique(np.ceil(rows - _TIME_SLACK_S))
    seconds: Floats = np.unique(first[:, None] + np.arange(math.floor(MAX_GAP_S) + 1.0))
    within: Floats = seconds[seconds <= rows[-1] + _TIME_SLACK_S]
    return within


@dataclass(frozen=True)
class Alignment:
    """The rigid motion of the plane, without reflection, that fits one set of points on another."""

    cosine: float
    sine: float
    from_m: Floats
    to_m: Floats

    @property
    def angle_rad(self) -> float:
        """By how much headings turn."""
        return math.atan2(self.sine, self.cosine)

    def __call__(self, points_m: Floats) -> Floats:
        """Move points, (n, 2) -> (n, 2)."""
        x, y = (points_m - self.from_m).T
        c, s = self.cosine, self.sine
        return np.column_stack((c * x - s * y, s * x + c * y)) + self.to_m


UNMOVED = Alignment(1.0, 0.0, np.zeros(2), np.zeros(2))
"""Everything stays."""


def align(estimate_m: Floats, truth_m: Floats) -> Alignment:
    """Fit an estimate on the truth, (n, 2), (n, 2), in the least-squares sense.

    Both sets are centred; in the plane the best angle is the argument of sum(conj(p) q), which
    can only be a rotation. Where every angle is as good, none is taken.
    """
    from_m, to_m = estimate_m.mean(axis=0), truth_m.mean(axis=0)
    p, q = estimate_m - from_m, truth_m - to_m
    cosine = float((p * q).sum())
    sine = float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum())
    norm = math.hypot(cosine, sine)
    if norm == 0.0:
        return Alignment(1.0, 0.0, from_m, to_m)
    return Alignment(cosine / norm, sine / norm, from_m, to_m)


def sample(tracks: Sequence[Track], at_s: Floats) -> tuple[Floats, Floats]:
    """Return positions (T, N, 2) and headings (T, N) of the tracks at the wanted times."""
    position_m = np.full((at_s.size, len(tracks), 2), np.nan)
    heading_rad = np.full((at_s.size, len(tracks)), np.nan)
    for n, track in enumerate(tracks):
        # A half-known position is no position: otherwise x and y could bridge different rows.
        there = np.isfinite(track.x_m) & np.isfinite(track.y_m)
        time_s = track.time_s[there]
        position_m[:, n, 0] = interpolate(time_s, track.x_m[there], at_s)
        position_m[:, n, 1] = interpolate(time_s, track.y_m[there], at_s)
        heading_rad[:, n] = interpolate(track.time_s, track.heading_rad, at_s, circular=True)
    return position_m, heading_rad


Row = tuple[float, float, float, float, float]


def estimated_tracks(
    estimates: Iterable[Estimate], nowhere: Container[NodeStatus] = ()
) -> dict[int, Track]:
    """Return the track of every node: NaN while its status is one of ``nowhere``.

    By default a guess is scored as one.
    """
    rows: dict[int, list[Row]] = defaultdict(list)
    for estimate in estimates:
        for node in estimate.nodes:
            pose = (node.x_m, node.y_m, node.heading_rad)
            if node.status in nowhere:
                pose = (np.nan, np.nan, np.nan)
            rows[node.node].append((estimate.time_s, *pose, _height(node)))
    return {node: Track(*np.array(rows[node]).T) for node in sorted(rows)}


def located_tracks(estimates: Iterable[Estimate]) -> dict[int, Track]:
    """Return the tracks for a picture: NaN while a node was ambiguous or not located.

    The mean of what is possible jumps between the possibilities; a line through it says nothing.
    """
    return estimated_tracks(estimates, (NodeStatus.AMBIGUOUS, NodeStatus.UNLOCATED))


def estimated_pairs(estimates: Iterable[Estimate]) -> dict[Pair, PairTrack]:
    """Return each pair's distance and sigma over time, under (node, peer) as it was reported."""
    rows: dict[Pair, list[tuple[float, float, float, bool]]] = defaultdict(list)
    for estimate in estimates:
        for pair, status in zip(estimate.pairs, estimate.pair_statuses(), strict=True):
            rows[pair.node, pair.peer].append(
                (
                    estimate.time_s,
                    pair.distance_m,
                    pair.sigma_distance_m,
                    status is NodeStatus.OK,
                )
            )
    return {pair: PairTrack(*np.array(rows[pair]).T) for pair in sorted(rows)}


def true_tracks(truth: Iterable[Truth]) -> dict[int, Track]:
    """Return the true track of every node; what was not recorded is NaN."""
    rows: dict[int, list[Row]] = defaultdict(list)
    for row in truth:
        heading_rad = np.nan if row.heading_rad is None else row.heading_rad
        z_m = np.nan if row.z_m is None else row.z_m
        rows[row.node].append((row.time_s, row.x_m, row.y_m, heading_rad, z_m))
    return {node: Track(*np.array(rows[node]).T) for node in sorted(rows)}


def _height(node: NodeEstimate) -> float:
    """Return the height over the start; NaN where it is 0 without any uncertainty."""
    return node.z_m if node.z_m or node.sigma_z_m else np.nan
