"""The paper's particle filter with the dual step (sect. IV), vectorised over users and particles.

Every user has its own M weighted pose particles. One range epoch does, for all users at once:

1. *Prediction*: displacements since then, body frame, each particle with its own noise
   (:mod:`relpos.fusion.models.motion`).
2. *Correction*: the weight of particle k of user i is multiplied by the likelihood of every range
   to a neighbour j, taken at j's **mean before this correction** (Jacobi: all users look at the
   same old picture, so their order does not matter); :mod:`relpos.fusion.models.ranging`.
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
    ANY_ANGLE_RAD,
    Estimate,
    NodeEstimate,
    NodeStatus,
    Presence,
    pairs_of,
    refuse_unmoved,
    refuse_unranged,
)
from relpos.fusion.models.motion import MotionNoise, predict
from relpos.fusion.models.ranging import RangeNoise
from relpos.fusion.particle import kernels
from relpos.fusion.particle.settings import ParticleSettings
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Step, Timeline
from relpos.measurements import Height, Measurement, Prior, Range

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_TWO_PI = 2.0 * math.pi


_AT_ONCE = 8192
"""Particles that are moved in one go."""


def effective_size(weights: Floats) -> Floats:
    """Give 1 / sum w^2 of each row of weights (K, M) that sum to one."""
    size: Floats = 1.0 / np.einsum("km,km->k", weights, weights)
    return size


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


@dataclass(slots=True)
class Clouds:
    """Beliefs of K located users as particles: the filter itself, on arrays.

    ``poses`` (3, K, M) are x, y (m) and heading (rad), ``weights`` (K, M); every row sums to one.
    Users are told apart by their row. ``advance`` and ``range`` are all there is to an epoch.
    """

    size: int
    alpha: float
    noise: RangeNoise
    rng: np.random.Generator
    poses: Floats = field(init=False)
    weights: Floats = field(init=False)
    resampled: int = 0
    _dice: Floats = field(default_factory=lambda: np.empty(0))
    _corrected: Floats = field(default_factory=lambda: np.empty((0, 0)))

    def __post_init__(self) -> None:
        self.poses = np.empty((3, 0, self.size))
        self.weights = np.empty((0, self.size))

    def add(self, poses: Floats) -> int:
        """Take in one more user, (3, M) equally likely poses; return its row."""
        self.poses = np.concatenate([self.poses, poses[:, None, :]], axis=1)
        self.weights = np.concatenate([self.weights, np.full((1, self.size), 1.0 / self.size)])
        self._corrected = np.empty_like(self.weights)
        return len(self.weights) - 1

    def advance(self, rows: Indices, mean: Floats, sigma: Floats) -> None:
        """Move users ``rows`` (R,) by displacements ``mean`` (R, 3), body frame, with ``sigma``.

        Each row once: a user's second displacement is a second call.
        """
        # A few rows at a time: their dice are still in the cache when they are used.
        some = max(_AT_ONCE // self.size, 1)
        for k in range(0, len(rows), some):
            spread = sigma[k : k + some]
            wanted = self.size * max(int(np.count_nonzero(spread)), 1)
            bits = self.rng.bit_generator.random_raw((wanted + 1) // 2)
            noise = self._buffer(2 * len(bits))
            kernels.normals(bits, noise)
            kernels.advance(self.poses, rows[k : k + some], mean[k : k + some], spread, noise)

    def range(
        self,
        first: Indices,
        second: Indices,
        range_m: Floats,
        height_m: Floats,
        others_m: Floats | None = None,
    ) -> int:
        """Correct by all ranges of one instant; return how many looks there were.

        ``first`` and ``second`` (R,) are the two nodes' rows; K + c stands for a place that is
        seen and does not look, the columns of ``others_m`` (2, C). ``height_m`` (R,) are the
        differences of height.
        """
        rows = len(self.weights)
        # Means before the correction: all users look at the same old picture.
        centres = np.empty((2, rows + (0 if others_m is None else others_m.shape[1])))
        kernels.means(self.poses, self.weights, centres)
        if others_m is not None:
            centres[:, rows:] = others_m
        offset, other, which = kernels.directed(first, second, rows)
        edges = offset, other, range_m[which], height_m[which]
        noise, corrected = self.noise, self._corrected
        floor = noise.flat_over_peak
        kernels.correct(
            self.poses, self.weights, centres, *edges, noise.sigma_r_m, floor, corrected
        )
        if self.alpha > 0.0:
            fresh = max(1, round(self.alpha * self.size))
            dice = self._draw(rows * (kernels.DUAL_DRAWS * fresh + 1)).reshape(rows, -1)
            kernels.dual_step(
                self.poses, self.weights, corrected, centres, *edges, noise.sigma_r_m, floor,
                self.alpha, dice,
            )  # fmt: skip
        self.weights, self._corrected = corrected, self.weights
        sizes = np.empty(rows)
        kernels.effective_sizes(corrected, sizes)
        low = np.flatnonzero(sizes < 0.5 * self.size)
        if low.size:
            dice = self._draw(low.size * (self.size + 1)).reshape(low.size, -1)
            kernels.resample(self.poses, self.weights, low, dice)
            self.resampled += int(low.size)
        return len(other)

    def _draw(self, count: int) -> Floats:
        """Uniforms in [0, 1) in a buffer that is kept: fresh memory costs more than the dice."""
        return self.rng.random(out=self._buffer(count))

    def _buffer(self, count: int) -> Floats:
        if self._dice.size < count:
            self._dice = np.empty(count)
        return self._dice[:count]


def weigh(
    poses: Floats,
    weights: Floats,
    at_m: Floats,
    range_m: Floats,
    height_m: Floats,
    noise: RangeNoise,
) -> Floats:
    """Weigh one user's particles (3, 1, M), (1, M) by ranges (E,) to places (2, E): eq. (6)."""
    # In another order they would be of another type, for which it would be compiled once more.
    poses, weights, at_m = (np.ascontiguousarray(of) for of in (poses, weights, at_m))
    result = np.empty_like(weights)
    count = len(range_m)
    kernels.correct(
        poses, weights, at_m, np.array([0, count]), np.arange(count), range_m, height_m,
        noise.sigma_r_m, noise.flat_over_peak, result,
    )  # fmt: skip
    return result


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
    _row: dict[int, int] = field(default_factory=dict)
    _clouds: Clouds = field(init=False)
    _starts: dict[int, _Start] = field(default_factory=dict)
    _known: dict[int, Presence] = field(default_factory=dict)
    _pending: dict[int, list[Advance]] = field(default_factory=dict)
    _own: Counter[str] = field(default_factory=Counter)
    _motion_noise: MotionNoise = field(init=False)
    _start_motion_noise: MotionNoise = field(init=False)
    _start_range_noise: RangeNoise = field(init=False)
    _moved: bool = False
    _ranges_used: int = 0
    _epoch_s: float = -math.inf

    def __post_init__(self) -> None:
        s = self.settings
        self._rng = np.random.default_rng(self.seed)
        self._motion_noise = MotionNoise(s.sigma_d, s.sigma_theta, s.floor_d_m, s.floor_theta_rad)
        self._start_motion_noise = MotionNoise(
            s.start_sigma_d,
            s.start_sigma_theta,
            max(s.floor_d_m, s.start_floor_d_m),
            max(s.floor_theta_rad, s.start_floor_theta_rad),
        )
        self._start_range_noise = RangeNoise(s.start_sigma_r_m, s.start_outliers)
        self._clouds = Clouds(s.particles, s.alpha, RangeNoise(s.sigma_r_m, s.outliers), self._rng)
        self._timeline = Timeline(
            [p.node for p in self.priors], reorder_s=s.reorder_s, max_lag_s=s.max_lag_s
        )
        for prior in sorted(self.priors, key=lambda p: p.node):
            if prior.node in self._known:
                raise RelposError(f"node {prior.node} has two initial poses")
            self._known[prior.node] = Presence()
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
        refuse_unmoved(self._moved)
        refuse_unranged(self._ranges_used, self._timeline.counters)
        return estimates

    def counters(self) -> Mapping[str, int]:
        """Count everything dropped, late, reset or resampled."""
        own = self._own + Counter(resampled=self._clouds.resampled)
        return dict(self._timeline.counters + own)

    # -- bookkeeping ---------------------------------------------------------------------------

    def _meet(self, measurement: Measurement) -> None:
        nodes = [measurement.node]
        if isinstance(measurement, Range):
            nodes.append(measurement.peer)
        for node in nodes:
            if node not in self._known:
                self._known[node] = Presence()
                self._starts[node] = self._blank(heading_known=False)

    def _blank(self, *, heading_known: bool) -> _Start:
        return _Start(np.zeros((3, 1, 1)), np.ones((1, 1)), heading_known)

    def _add_row(self, node: int, poses: Floats) -> None:
        self._row[node] = self._clouds.add(poses)

    def _work_off(self, steps: Iterable[Step]) -> list[Estimate]:
        estimates = []
        for step in steps:
            match step:
                case Advance():
                    self._moved = True
                    known = self._known[step.node]
                    known.received(step.time_s)
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
        # The k-th displacement of every node at once.
        for turn in range(max((len(steps) for _, steps in located), default=0)):
            now = [(row, steps[turn]) for row, steps in located if len(steps) > turn]
            self._clouds.advance(
                np.array([row for row, _ in now]),
                np.array([(a.dx_m, a.dy_m, a.dtheta_rad) for _, a in now]),
                np.array([self._motion_noise.sigmas(a) for _, a in now]),
            )

    # -- ranges --------------------------------------------------------------------------------

    def _range(self, step: Ranging) -> None:
        for measured in step.ranges:
            for node in (measured.node, measured.peer):
                known = self._known[node]
                known.received(step.time_s)
        if not self._row:
            self._found_frame(step.ranges)
        column, placed_m = self._row, None
        if self._starts:
            # Positions before this correction, of everybody.
            column, means = self._references()
            self._range_starts(step.ranges, column, means)
            placed_m = means[:, len(self._row) :]
        used = [
            (column[m.node], column[m.peer], m.range_m,
             self._known[m.node].height_m - self._known[m.peer].height_m)
            for m in step.ranges
            if m.node in column and m.peer in column
            and (m.node in self._row or m.peer in self._row)
        ]  # fmt: skip
        if used:
            first, second, range_m, height_m = zip(*used, strict=True)
            self._ranges_used += self._clouds.range(
                np.array(first),
                np.array(second),
                np.array(range_m),
                np.array(height_m),
                placed_m,
            )

    def _references(self) -> tuple[dict[int, int], Floats]:
        """Positions that ranges may refer to: node -> column of the means (2, C)."""
        clouds, column = self._clouds, dict(self._row)
        placed = [(node, start) for node, start in self._starts.items() if start.placed]
        means = np.empty((2, len(column) + len(placed)))
        kernels.means(clouds.poses, clouds.weights, means)
        for node, start in placed:
            means[:, len(column)] = start.poses[:2, 0] @ start.weights[0]
            column[node] = len(column)
        return column, means

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
                self._weigh_start(start, at, measured_m, height)

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

    def _weigh_start(self, start: _Start, at_m: Floats, range_m: Floats, height_m: Floats) -> None:
        start.weights = weigh(
            start.poses, start.weights, at_m, range_m, height_m, self._start_range_noise
        )
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
            known.close_epoch(self._epoch_s)
        self._epoch_s = time_s
        located = np.empty((len(self._row), 7))
        kernels.moments(self._clouds.poses, self._clouds.weights, located)
        figures = located.tolist()
        nodes = []
        for node in sorted(self._known):
            status = self._status(node)
            cloud = self._starts.get(node)
            if cloud is None:
                x_m, y_m, xx, yy, xy, c, s = figures[self._row[node]]
                heading, sigma_heading = math.atan2(s, c), _spread_rad(math.hypot(c, s))
            else:
                x_m, y_m, xx, yy, xy, heading, sigma_heading = self._moments_of(cloud)
            if status is NodeStatus.UNLOCATED:
                xx, yy, xy, sigma_heading = math.inf, math.inf, math.inf, ANY_ANGLE_RAD
            known = self._known[node]
            nodes.append(
                NodeEstimate(
                    node, x_m, y_m, heading, xx, yy, xy, sigma_heading, status,
                    known.height_m, known.sigma_height_m,
                )
            )  # fmt: skip
        return Estimate(time_s, tuple(nodes), pairs_of(nodes))

    def _moments_of(self, start: _Start) -> tuple[float, float, float, float, float, float, float]:
        poses, weights = start.poses[:, 0], start.weights[0]
        about = _mode(poses, weights, self._rng) if start.drawn else None
        mean, covariance, heading, sigma_heading = _moments(poses, weights, about)
        return (
            float(mean[0]), float(mean[1]),
            float(covariance[0, 0]), float(covariance[1, 1]), float(covariance[0, 1]),
            heading, sigma_heading,
        )  # fmt: skip

    def _status(self, node: int) -> NodeStatus:
        start = self._starts.get(node)
        if start is not None and not start.drawn:
            return NodeStatus.UNLOCATED
        status = self._known[node].status
        if status is NodeStatus.OK and start is not None and not start.placed:
            return NodeStatus.AMBIGUOUS
        return status


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
    return centre, covariance, heading, _spread_rad(resultant)


def _spread_rad(resultant: float) -> float:
    """Circular standard deviation from the mean of the cosines about the mean heading."""
    return min(math.sqrt(2.0 * max(1.0 - resultant, 0.0)), ANY_ANGLE_RAD)
