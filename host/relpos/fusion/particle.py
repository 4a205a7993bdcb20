"""The paper's particle filter with the dual step (sect. IV), vectorised over users and particles.

Every user has its own M weighted pose particles. One range epoch does, for all users at once:

1. *Prediction*: displacements since then, body frame, each particle with its own noise
   (:mod:`relpos.fusion.motion_model`).
2. *Correction*: the weight of particle k of user i is multiplied by the likelihood of every range
   to a neighbour j, taken at j's **mean before this correction** (Jacobi: all users look at the
   same old picture, so their order does not matter); :mod:`relpos.fusion.ranging_model`.
3. *Dual step*: a share ``alpha`` of the particles is redrawn on the ring of a random neighbour,
   with a heading from the user's belief. Their weight is the density of the predicted belief
   there (KDE) times the likelihood of the user's *other* ranges, normalised among themselves to
   a total mass ``alpha``; all others get 1 - alpha. (With strict importance weights the step
   would have no effect: where it is needed, the predicted density is next to nothing.)
4. *Resampling*, multinomial, of users whose effective sample size is below M/2.

Two choices the paper leaves open were made by its own figures (100 seeds each, see
``docs/fusion.md``): systematic resampling and a heading drawn together with the position from
the KDE's kernels are both better than what the paper and the prototype report.

Beyond the paper: a node whose start is unknown is held apart as a large cloud (``_Start``) until
ranges and motion have told where it is. The first node that ranges defines the frame.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.fusion.estimator import (
    LOST_EPOCHS,
    STALE_EPOCHS,
    Estimate,
    NodeEstimate,
    NodeStatus,
    pairs_of,
)
from relpos.fusion.motion_model import MotionNoise, predict
from relpos.fusion.ranging_model import RangeNoise, log_likelihood, predicted_range
from relpos.fusion.settings import setting
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Step, Timeline
from relpos.measurements import Height, Measurement, Prior, Range

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

_TWO_PI = 2.0 * math.pi
_MIN_BANDWIDTH_M = 1e-3
"""A belief of identical particles has no spread; its density is then one of a millimetre."""

_FAR_OUT = math.log(1e4)
"""Where all kernels underflow, the nearest counts as one particle of very many."""


@dataclass(frozen=True, slots=True)
class ParticleSettings:
    """What ``--set`` may change; the defaults are the paper's."""

    particles: int = setting(500, "particles per node (M)", 10, 1_000_000)
    alpha: float = setting(0.01, "share of dual particles; 0 switches the dual step off", 0.0, 0.9)
    sigma_r_m: float = setting(2.0, "standard deviation of a range", 1e-3, 100.0)
    sigma_d: float = setting(0.2, "relative standard deviation of a displacement", 0.0, 10.0)
    sigma_theta: float = setting(0.1, "relative standard deviation of a turn", 0.0, 10.0)
    floor_d_m: float = setting(0.0, "least displacement noise, m/sqrt(s)", 0.0, 10.0)
    floor_theta_rad: float = setting(0.0, "least heading noise, rad/sqrt(s)", 0.0, 10.0)
    outliers: float = setting(0.0, "share of ranges that tell nothing", 0.0, 0.9)
    start_particles: int = setting(
        20_000, "particles of a node whose start is unknown", 100, 10_000_000
    )
    start_sigma_r_m: float = setting(
        0.5, "standard deviation of a range while a start is unknown", 1e-3, 100.0
    )
    start_outliers: float = setting(0.05, "outlier share while a start is unknown", 0.0, 0.9)
    start_sigma_d: float = setting(
        0.2, "relative displacement noise while a start is unknown", 0.0, 10.0
    )
    start_sigma_theta: float = setting(
        0.1, "relative turn noise while a start is unknown", 0.0, 10.0
    )
    start_floor_d_m: float = setting(
        0.02, "least displacement noise while a start is unknown, m/sqrt(s)", 0.0, 10.0
    )
    start_floor_theta_rad: float = setting(
        0.0175, "least heading noise while a start is unknown, rad/sqrt(s)", 0.0, 10.0
    )
    resolved_m: float = setting(
        0.7, "a start counts as found when its spread is less, m", 1e-3, 100.0
    )
    resolved_rad: float = setting(
        0.5, "a start counts as found when its heading's spread is less, rad", 1e-3, 3.0
    )
    resolved_epochs: int = setting(5, "for so many epochs in a row", 1, 1000)
    max_lag_s: float = setting(5.0, "how long a silent node is waited for", 0.0, 60.0)
    reorder_s: float = setting(0.5, "how long measurements may be out of order", 0.0, 60.0)


def effective_size(weights: Floats) -> Floats:
    """Give 1 / sum w^2 of each row of weights (K, M) that sum to one."""
    size: Floats = 1.0 / np.einsum("km,km->k", weights, weights)
    return size


def multinomial(weights: Floats, count: int, rng: np.random.Generator) -> Indices:
    """Draw ``count`` indices from each row of weights (K, M), independently; sorted by row."""
    edges = np.cumsum(weights, axis=1)
    drawn = rng.random((weights.shape[0], count))
    drawn.sort(axis=1)
    drawn *= edges[:, -1:]
    index = np.empty(drawn.shape, dtype=np.intp)
    for row, (edge, wanted) in enumerate(zip(edges, drawn, strict=True)):
        index[row] = np.searchsorted(edge, wanted, side="right")
    np.minimum(index, weights.shape[1] - 1, out=index)
    return index


def systematic(weights: Floats, count: int, rng: np.random.Generator) -> Indices:
    """Draw ``count`` indices from each row of weights (K, M) with the least variance.

    Index m comes floor or ceil of count * w_m times.
    """
    rows = weights.shape[0]
    edges = np.cumsum(weights, axis=1)
    comb = (np.arange(count) + rng.random((rows, 1))) / count * edges[:, -1:]
    index = np.empty(comb.shape, dtype=np.intp)
    for row, (edge, wanted) in enumerate(zip(edges, comb, strict=True)):
        index[row] = np.searchsorted(edge, wanted, side="right")
    np.minimum(index, weights.shape[1] - 1, out=index)
    return index


def weighted_means(poses: Floats, weights: Floats) -> Floats:
    """Positions' means, (2, K), of particles (3, K, M) with weights (K, M)."""
    means: Floats = np.einsum("ckm,km->ck", poses[:2], weights)
    return means


@dataclass(frozen=True, slots=True)
class Sight:
    """Ranges of one instant as directed edges, sorted by the row that looks.

    ``looks`` (E,) is the row, ``at_m`` (2, E) the neighbour's position, ``height_m`` (E,) the
    difference of height, ``measured_m`` (E,) the range; ``rows`` (U,) are the rows that look at
    all, ``first`` and ``count`` (U,) their edges.
    """

    looks: Indices
    at_m: Floats
    height_m: Floats
    measured_m: Floats
    rows: Indices
    first: Indices
    count: Indices

    @staticmethod
    def of(looks: Indices, at_m: Floats, height_m: Floats, measured_m: Floats) -> Sight:
        """Sort edges by the row that looks."""
        order = np.argsort(looks, kind="stable")
        looks = looks[order]
        rows, first, count = np.unique(looks, return_index=True, return_counts=True)
        return Sight(looks, at_m[:, order], height_m[order], measured_m[order], rows, first, count)


def correct(poses: Floats, weights: Floats, sight: Sight, noise: RangeNoise) -> Floats:
    """Weigh by eq. (6): new weights (U, M) of ``sight.rows``, each row summing to one."""
    particles = poses[:2, sight.looks]
    distance = predicted_range(
        particles[0] - sight.at_m[0][:, None],
        particles[1] - sight.at_m[1][:, None],
        sight.height_m[:, None],
    )
    each = log_likelihood(sight.measured_m[:, None], distance, noise)
    total = np.add.reduceat(each, sight.first, axis=0)
    # Only particles that still have weight may set the scale, or all of them could underflow.
    prior = weights[sight.rows]
    total -= np.where(prior > 0.0, total, -np.inf).max(axis=1, keepdims=True)
    np.exp(total, out=total)
    total *= prior
    total /= total.sum(axis=1, keepdims=True)
    return total


def log_density(points_m: Floats, poses: Floats, weights: Floats) -> Floats:
    """Give the log density, (U, D), of beliefs (3, U, M), weights (U, M) at points (2, U, D).

    A Gaussian kernel with Silverman's bandwidth for two dimensions, per axis, from the
    effective sample size.
    """
    at = poses[:2].transpose(1, 0, 2)
    points = points_m.transpose(1, 2, 0)
    mean = np.einsum("um,uam->ua", weights, at)
    off = at - mean[:, :, None]
    variance = np.einsum("um,uam->ua", weights, off * off)
    shrink = effective_size(weights) ** (-1.0 / 6.0)
    width = np.maximum(np.sqrt(variance) * shrink[:, None], _MIN_BANDWIDTH_M)
    off /= width[:, :, None]
    seen = (points - mean[:, None, :]) / width[:, None, :]
    # -|p - q|^2 / 2 by way of p.q: one matrix product instead of four passes over (U, D, M).
    exponent: Floats = seen @ off
    exponent -= 0.5 * np.einsum("uam,uam->um", off, off)[:, None, :]
    exponent -= 0.5 * np.einsum("uda,uda->ud", seen, seen)[:, :, None]
    # A point very far out has density zero in every kernel: its nearest one keeps it comparable.
    peak = np.minimum(exponent.max(axis=2), 0.0)
    np.exp(exponent, out=exponent)
    total: Floats = np.einsum("udm,um->ud", exponent, weights)
    with np.errstate(divide="ignore"):
        result: Floats = np.where(total > 0.0, np.log(total), peak - _FAR_OUT)
    result -= np.log(_TWO_PI * width.prod(axis=1))[:, None]
    return result


def dual_step(
    poses: Floats,
    predicted: Floats,
    corrected: Floats,
    sight: Sight,
    noise: RangeNoise,
    alpha: float,
    rng: np.random.Generator,
) -> None:
    """Redraw a share alpha of the particles from the ranges, in place (eq. (7)).

    ``poses`` (3, U, M) are the particles of ``sight.rows``, ``predicted`` and ``corrected``
    (U, M) their weights before and after the ranges; ``corrected`` becomes the mixture's.
    """
    users, size = corrected.shape
    count = max(1, round(alpha * size))
    # On whose ring? Any of the user's neighbours, the same chance each.
    edge = sight.first[:, None] + (rng.random((users, count)) * sight.count[:, None]).astype(
        np.intp
    )
    radius = sight.measured_m[edge] + noise.sigma_r_m * rng.standard_normal((users, count))
    angle = _TWO_PI * rng.random((users, count))
    points = sight.at_m[:, edge] + radius * np.stack([np.cos(angle), np.sin(angle)])

    log_weight = log_density(points, poses, predicted)
    # Every edge of every user against that user's points; a point's own ring is left out.
    owner = np.repeat(np.arange(users), sight.count)
    distance = predicted_range(
        points[0, owner] - sight.at_m[0][:, None],
        points[1, owner] - sight.at_m[1][:, None],
        sight.height_m[:, None],
    )
    each = log_likelihood(sight.measured_m[:, None], distance, noise)
    each[edge[owner] == np.arange(len(owner))[:, None]] = 0.0
    log_weight += np.add.reduceat(each, sight.first, axis=0)
    peak = log_weight.max(axis=1, keepdims=True)
    weight = np.exp(log_weight - np.where(np.isfinite(peak), peak, 0.0))
    total = weight.sum(axis=1, keepdims=True)
    weight = np.where(total > 0.0, weight / np.where(total > 0.0, total, 1.0), 1.0 / count)

    heading = np.take_along_axis(poses[2], multinomial(predicted, count, rng), axis=1)
    rng.permuted(heading, axis=1, out=heading)
    # An evenly spaced comb with a random start: every particle is as likely to be replaced.
    slot = ((rng.random((users, 1)) + np.arange(count)) * (size / count)).astype(np.intp) % size
    np.put_along_axis(corrected, slot, 0.0, axis=1)
    rest = corrected.sum(axis=1, keepdims=True)
    corrected *= np.where(rest > 0.0, (1.0 - alpha) / np.where(rest > 0.0, rest, 1.0), 0.0)
    np.put_along_axis(corrected, slot, alpha * weight, axis=1)
    corrected /= corrected.sum(axis=1, keepdims=True)
    for axis, values in enumerate((points[0], points[1], heading)):
        np.put_along_axis(poses[axis], slot, values, axis=1)


@dataclass(slots=True)
class _Start:
    """A node that is not located yet: nothing known, or a cloud of poses (3, 1, M)."""

    poses: Floats
    weights: Floats
    heading_known: bool
    drawn: bool = False
    small_epochs: int = 0
    settled_epochs: int = 0
    placed: bool = False
    """Its position is known, if not its heading: others may refer to it."""


@dataclass(slots=True)
class _Known:
    """What is kept of a node beside its particles."""

    height_m: float = 0.0
    sigma_height_m: float = 0.0
    news_s: float = -math.inf
    silent_epochs: int = 0


@dataclass(slots=True)
class ParticleFilter:
    """The paper's filter as an :class:`~relpos.fusion.estimator.Estimator`.

    Nodes with a prior start there; a prior whose ``sigma_m`` is infinite gives the heading alone.
    Without any prior the frame is the start pose of the first node that ranges.
    """

    priors: Sequence[Prior] = ()
    settings: ParticleSettings = field(default_factory=ParticleSettings)
    seed: int = 0
    _timeline: Timeline = field(init=False)
    _rng: np.random.Generator = field(init=False)
    _nodes: list[int] = field(default_factory=list)
    _row: dict[int, int] = field(default_factory=dict)
    _poses: Floats = field(init=False)
    _weights: Floats = field(init=False)
    _starts: dict[int, _Start] = field(default_factory=dict)
    _known: dict[int, _Known] = field(default_factory=dict)
    _pending: dict[int, list[Advance]] = field(default_factory=dict)
    _own: Counter[str] = field(default_factory=Counter)
    _motion_noise: MotionNoise = field(init=False)
    _range_noise: RangeNoise = field(init=False)
    _start_motion_noise: MotionNoise = field(init=False)
    _start_range_noise: RangeNoise = field(init=False)
    _moved: bool = False
    _ranges_used: int = 0
    _epoch_s: float = -math.inf

    def __post_init__(self) -> None:
        s = self.settings
        self._rng = np.random.default_rng(self.seed)
        self._motion_noise = MotionNoise(s.sigma_d, s.sigma_theta, s.floor_d_m, s.floor_theta_rad)
        self._range_noise = RangeNoise(s.sigma_r_m, s.outliers)
        self._start_motion_noise = MotionNoise(
            s.start_sigma_d,
            s.start_sigma_theta,
            max(s.floor_d_m, s.start_floor_d_m),
            max(s.floor_theta_rad, s.start_floor_theta_rad),
        )
        self._start_range_noise = RangeNoise(s.start_sigma_r_m, s.start_outliers)
        self._poses = np.empty((3, 0, s.particles))
        self._weights = np.empty((0, s.particles))
        self._timeline = Timeline(
            [p.node for p in self.priors], reorder_s=s.reorder_s, max_lag_s=s.max_lag_s
        )
        for prior in sorted(self.priors, key=lambda p: p.node):
            if prior.node in self._known:
                raise RelposError(f"node {prior.node} has two initial poses")
            self._known[prior.node] = _Known()
            if math.isfinite(prior.sigma_m) and math.isfinite(prior.sigma_rad):
                pose = np.array([prior.x_m, prior.y_m, prior.heading_rad])[:, None]
                sigma = np.array([prior.sigma_m, prior.sigma_m, prior.sigma_rad])[:, None]
                drawn = pose + sigma * self._rng.standard_normal((3, s.particles))
                self._add_row(prior.node, drawn)
            else:
                start = self._blank(heading_known=math.isfinite(prior.sigma_rad))
                start.poses[:] = np.array([0.0, 0.0, prior.heading_rad])[:, None, None]
                self._starts[prior.node] = start

    # -- the estimator's interface -------------------------------------------------------------

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Take one measurement; return the estimates it completes."""
        self._meet(measurement)
        return self._work_off(self._timeline.push(measurement))

    def finish(self) -> list[Estimate]:
        """Work off what waits; RelposError where the run cannot give relative positions."""
        estimates = self._work_off(self._timeline.finish())
        if not self._moved:
            raise RelposError("no motion was received: nothing can be estimated")
        if not self._ranges_used:
            failed = self._timeline.counters["ranges_failed"]
            raise RelposError(
                f"no usable range ({failed} failed ones): relative positions cannot be fused; "
                "from known starts --estimator deadreckoning still works"
            )
        return estimates

    def counters(self) -> Mapping[str, int]:
        """Count everything dropped, late, reset or resampled."""
        return dict(self._timeline.counters + self._own)

    # -- bookkeeping ---------------------------------------------------------------------------

    def _meet(self, measurement: Measurement) -> None:
        nodes = [measurement.node]
        if isinstance(measurement, Range):
            nodes.append(measurement.peer)
        for node in nodes:
            if node not in self._known:
                self._known[node] = _Known()
                self._starts[node] = self._blank(heading_known=False)

    def _blank(self, *, heading_known: bool) -> _Start:
        return _Start(np.zeros((3, 1, 1)), np.ones((1, 1)), heading_known)

    def _add_row(self, node: int, poses: Floats) -> None:
        count = self.settings.particles
        self._row[node] = len(self._nodes)
        self._nodes.append(node)
        self._poses = np.concatenate([self._poses, poses[:, None, :]], axis=1)
        self._weights = np.concatenate([self._weights, np.full((1, count), 1.0 / count)])

    def _work_off(self, steps: Iterable[Step]) -> list[Estimate]:
        estimates = []
        for step in steps:
            match step:
                case Advance():
                    self._moved = True
                    known = self._known[step.node]
                    known.news_s = max(known.news_s, step.time_s)
                    self._pending.setdefault(step.node, []).append(step)
                case Ranging():
                    self._predict()
                    self._range(step)
                case Sensed():
                    self._sense(step)
                case Epoch():
                    self._predict()
                    estimates.append(self._estimate(step.time_s))
        return estimates

    def _sense(self, step: Sensed) -> None:
        if isinstance(step.measurement, Height):
            known = self._known[step.measurement.node]
            known.height_m = step.measurement.height_m
            known.sigma_height_m = step.measurement.sigma_m or 0.0
        else:
            self._own["headings_unused"] += 1

    # -- prediction ----------------------------------------------------------------------------

    def _predict(self) -> None:
        """Work off the displacements since the last time: the k-th of every node at once."""
        located = []
        for node, steps in self._pending.items():
            start = self._starts.get(node)
            if start is None:
                located.append((self._row[node], steps))
                continue
            noise = self._start_motion_noise if start.drawn else _NOISELESS
            for step in steps:
                predict(start.poses, [step], noise, self._rng)
        self._pending = {}
        located.sort(key=lambda pair: pair[0])
        turn = 0
        while located:
            rows = [row for row, _ in located]
            steps = [steps[turn] for _, steps in located]
            if len(rows) == len(self._nodes):
                predict(self._poses, steps, self._motion_noise, self._rng)
            else:
                some = self._poses[:, rows]
                predict(some, steps, self._motion_noise, self._rng)
                self._poses[:, rows] = some
            turn += 1
            located = [(row, steps) for row, steps in located if len(steps) > turn]

    # -- ranges --------------------------------------------------------------------------------

    def _range(self, step: Ranging) -> None:
        for measured in step.ranges:
            for node in (measured.node, measured.peer):
                known = self._known[node]
                known.news_s = max(known.news_s, step.time_s)
        if not self._nodes:
            self._found_frame(step.ranges)
        column, means = self._references()
        self._range_starts(step.ranges, column, means)
        looks, seen, height, measured_m = [], [], [], []
        for measured in step.ranges:
            dz = self._known[measured.node].height_m - self._known[measured.peer].height_m
            for node, peer in ((measured.node, measured.peer), (measured.peer, measured.node)):
                if node in self._row and peer in column:
                    looks.append(self._row[node])
                    seen.append(column[peer])
                    height.append(dz)
                    measured_m.append(measured.range_m)
        self._ranges_used += len(looks)
        if looks:
            self._correct(
                Sight.of(np.array(looks), means[:, seen], np.array(height), np.array(measured_m))
            )

    def _references(self) -> tuple[dict[int, int], Floats]:
        """Positions that ranges may refer to: node -> column of the means (2, C)."""
        column = dict(self._row)
        means = [weighted_means(self._poses, self._weights)]
        for node, start in self._starts.items():
            if start.placed:
                column[node] = len(column)
                means.append(weighted_means(start.poses, start.weights))
        return column, np.concatenate(means, axis=1)

    def _correct(self, sight: Sight) -> None:
        s = self.settings
        corrected = correct(self._poses, self._weights, sight, self._range_noise)
        if s.alpha > 0.0:
            poses = self._poses[:, sight.rows]
            dual_step(
                poses, self._weights[sight.rows], corrected, sight, self._range_noise, s.alpha,
                self._rng,
            )  # fmt: skip
            self._poses[:, sight.rows] = poses
        self._weights[sight.rows] = corrected
        low = np.flatnonzero(effective_size(corrected) < 0.5 * s.particles)
        if low.size:
            rows = sight.rows[low]
            index = multinomial(corrected[low], s.particles, self._rng)
            self._poses[:, rows] = np.take_along_axis(self._poses[:, rows], index[None], axis=2)
            self._weights[rows] = 1.0 / s.particles
            self._own["resampled"] += int(low.size)

    # -- unknown starts ------------------------------------------------------------------------

    def _found_frame(self, ranges: Sequence[Range]) -> None:
        """Make the best connected node of this instant (the lowest of equals) the frame."""
        degree: Counter[int] = Counter()
        for measured in ranges:
            degree.update((measured.node, measured.peer))
        node = min(degree, key=lambda n: (-degree[n], n))
        pose = self._starts.pop(node).poses[:, 0, :1]
        self._add_row(node, np.repeat(pose, self.settings.particles, axis=1))

    def _range_starts(
        self, ranges: Sequence[Range], column: Mapping[int, int], means: Floats
    ) -> None:
        """Weigh the clouds of unlocated nodes by their ranges to located ones."""
        edges: dict[int, list[tuple[int, Range]]] = {}
        for measured in ranges:
            for node, peer in ((measured.node, measured.peer), (measured.peer, measured.node)):
                if node in self._starts and peer in column:
                    edges.setdefault(node, []).append((peer, measured))
            if measured.node not in column and measured.peer not in column:
                self._own["ranges_between_unlocated"] += 1
        for node, seen in edges.items():
            self._ranges_used += len(seen)
            start = self._starts[node]
            at = means[:, [column[peer] for peer, _ in seen]]
            measured_m = np.array([measured.range_m for _, measured in seen])
            height = np.array(
                [self._known[node].height_m - self._known[peer].height_m for peer, _ in seen]
            )
            if not start.drawn:
                self._draw_start(start, at, measured_m)
                at, measured_m, height = at[:, 1:], measured_m[1:], height[1:]
            if measured_m.size:
                self._weigh_start(start, Sight.of(
                    np.zeros(measured_m.size, dtype=np.intp), at, height, measured_m
                ))  # fmt: skip

    def _draw_start(self, start: _Start, at: Floats, measured_m: Floats) -> None:
        """Spread a cloud over the ring of the first range, with any heading."""
        count = self.settings.start_particles
        radius = measured_m[0] + self.settings.start_sigma_r_m * self._rng.standard_normal(count)
        angle = _TWO_PI * self._rng.random(count)
        heading = (
            np.full(count, start.poses[2, 0, 0])
            if start.heading_known
            else _TWO_PI * self._rng.random(count)
        )
        start.poses = np.stack(
            [at[0, 0] + radius * np.cos(angle), at[1, 0] + radius * np.sin(angle), heading]
        )[:, None, :]
        start.weights = np.full((1, count), 1.0 / count)
        start.drawn = True
        self._own["starts_drawn"] += 1

    def _weigh_start(self, start: _Start, sight: Sight) -> None:
        start.weights = correct(start.poses, start.weights, sight, self._start_range_noise)
        if effective_size(start.weights)[0] < 0.5 * start.weights.shape[1]:
            index = systematic(start.weights, start.weights.shape[1], self._rng)[0]
            start.poses = start.poses[:, :, index]
            start.weights = np.full_like(start.weights, 1.0 / start.weights.shape[1])
            self._own["starts_resampled"] += 1

    def _settle(self, node: int, start: _Start) -> None:
        """Let a node join the located ones once its cloud has been small for long enough.

        One that stands still shows its position but not its heading: it stays a cloud, so that
        its heading is found when it moves, and others may refer to it meanwhile.
        """
        s = self.settings
        if not start.drawn:
            return
        _, covariance, _, sigma_heading = _moments(start.poses[:, 0], start.weights[0])
        spread = math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))
        start.small_epochs = start.small_epochs + 1 if spread < s.resolved_m else 0
        settled = spread < s.resolved_m and sigma_heading < s.resolved_rad
        start.settled_epochs = start.settled_epochs + 1 if settled else 0
        start.placed = start.small_epochs >= s.resolved_epochs
        if start.settled_epochs >= s.resolved_epochs:
            index = systematic(start.weights, s.particles, self._rng)[0]
            del self._starts[node]
            self._add_row(node, start.poses[:, 0, index])
            self._own["starts_resolved"] += 1

    # -- estimates -----------------------------------------------------------------------------

    def _estimate(self, time_s: float) -> Estimate:
        for node, start in list(self._starts.items()):
            self._settle(node, start)
        for known in self._known.values():
            known.silent_epochs = 0 if known.news_s > self._epoch_s else known.silent_epochs + 1
        self._epoch_s = time_s
        nodes = []
        for node in sorted(self._known):
            status = self._status(node)
            cloud = self._starts.get(node)
            if cloud is None:
                row = self._row[node]
                poses, weights = self._poses[:, row], self._weights[row]
            else:
                poses, weights = cloud.poses[:, 0], cloud.weights[0]
            about = None if cloud is None or not cloud.drawn else _mode(poses, weights, self._rng)
            mean, covariance, heading, sigma_heading = _moments(poses, weights, about)
            if status is NodeStatus.UNLOCATED:
                covariance = np.full((2, 2), math.inf)
                sigma_heading = math.pi / math.sqrt(3.0)
            known = self._known[node]
            nodes.append(
                NodeEstimate(
                    node, float(mean[0]), float(mean[1]), heading,
                    float(covariance[0, 0]), float(covariance[1, 1]), float(covariance[0, 1]),
                    sigma_heading, status, known.height_m, known.sigma_height_m,
                )
            )  # fmt: skip
        return Estimate(time_s, tuple(nodes), pairs_of(nodes))

    def _status(self, node: int) -> NodeStatus:
        start = self._starts.get(node)
        if start is not None and not start.drawn:
            return NodeStatus.UNLOCATED
        silent = self._known[node].silent_epochs
        if silent >= LOST_EPOCHS:
            return NodeStatus.LOST
        if silent >= STALE_EPOCHS:
            return NodeStatus.STALE
        return NodeStatus.OK if start is None or start.placed else NodeStatus.AMBIGUOUS


_NOISELESS = MotionNoise(0.0, 0.0)


def _mode(poses: Floats, weights: Floats, rng: np.random.Generator) -> Floats:
    """Give the most likely place (2,) of a cloud (3, M): the candidate with most mass near it."""
    some = systematic(weights[None], min(_MODE_SAMPLES, weights.size), rng)[0]
    x, y, heading = poses[0, some], poses[1, some], poses[2, some]
    near = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 < _MODE_RADIUS_M**2
    near &= np.cos(heading[:, None] - heading) > math.cos(_MODE_RADIUS_RAD)
    best = int(near.sum(axis=1).argmax())
    chosen: Floats = np.array([x[near[best]].mean(), y[near[best]].mean(),
                               _circular_mean(heading[near[best]])])  # fmt: skip
    return chosen


_MODE_SAMPLES = 400
_MODE_RADIUS_M = 1.0
_MODE_RADIUS_RAD = 0.7
"""A mode is what one would call one place and one heading; coarse on purpose."""


def _circular_mean(heading: Floats) -> float:
    return math.atan2(float(np.sin(heading).mean()), float(np.cos(heading).mean()))


def _moments(
    poses: Floats, weights: Floats, about: Floats | None = None
) -> tuple[Floats, Floats, float, float]:
    """Mean (2,), covariance (2, 2), heading and its standard deviation of particles (3, M).

    The second moments are about the pose ``about`` where one is given, else about the mean.
    """
    c = float(weights @ np.cos(poses[2]))
    s = float(weights @ np.sin(poses[2]))
    if about is None:
        centre, heading = poses[:2] @ weights, math.atan2(s, c)
    else:
        centre, heading = about[:2], float(about[2])
    off = poses[:2] - centre[:, None]
    covariance = (off * weights) @ off.T
    resultant = c * math.cos(heading) + s * math.sin(heading)
    spread = math.sqrt(2.0 * max(1.0 - resultant, 0.0))
    return centre, covariance, heading, min(spread, math.pi / math.sqrt(3.0))
