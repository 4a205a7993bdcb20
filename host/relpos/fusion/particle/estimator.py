"""The particle filter as an estimator: measurements in, estimates out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.estimator import (
    ANY_ANGLE_RAD,
    Estimate,
    NodeEstimate,
    Presence,
    Vertical,
    pairs_of,
    refuse_unmoved,
    refuse_unranged,
)
from relpos.fusion.estimator_settings import ParticleSettings
from relpos.fusion.initial_poses import POSE, Initialiser, PoseMixture, by_node, sought_node
from relpos.fusion.models.motion import MotionNoise
from relpos.fusion.particle.kernels import MIN_BANDWIDTH_M
from relpos.fusion.particle.particle_set import ParticleSet
from relpos.fusion.resampling import systematic
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Step, Timeline
from relpos.measurements import Height, Measurement, Prior, Range, nodes_of


@dataclass(slots=True)
class ParticleFilter:
    """The paper's filter as an :class:`~relpos.fusion.estimator.Estimator`.

    Nodes with a full prior start there. ``initialiser`` seeks all others, which join once they
    have been found; without any prior it also chooses the frame.
    """

    priors: Sequence[Prior]
    initialiser: Initialiser
    settings: ParticleSettings = field(default_factory=ParticleSettings)
    seed: int = 0
    _timeline: Timeline = field(init=False)
    _rng: np.random.Generator = field(init=False)
    _particles: ParticleSet = field(init=False)
    _row: dict[int, int] = field(default_factory=dict)
    _known: dict[int, Presence] = field(default_factory=dict)
    _pending: dict[int, list[Advance]] = field(default_factory=dict)
    _own: Counter[str] = field(default_factory=Counter)
    _motion_noise: MotionNoise = field(init=False)
    _moved: bool = False
    _ranges_used: int = 0
    _epoch_s: float = -math.inf

    def __post_init__(self) -> None:
        s = self.settings
        self._rng = np.random.default_rng(self.seed)
        self._motion_noise = MotionNoise(s.sigma_d, s.sigma_theta, s.floor_d_m, s.floor_theta_rad)
        self._particles = ParticleSet(s, self._rng)
        self._timeline = Timeline(
            [p.node for p in self.priors], reorder_s=s.reorder_s, max_lag_s=s.max_lag_s
        )
        for prior in by_node(self.priors):
            self._known[prior.node] = Presence()
            if prior.is_known:
                pose = np.array([prior.x_m, prior.y_m, prior.heading_rad])[:, None]
                sigma = np.array([prior.sigma_m, prior.sigma_m, prior.sigma_rad])[:, None]
                drawn = pose + sigma * self._rng.standard_normal((3, s.particles))
                self._row[prior.node] = self._particles.add(drawn)
            else:
                self.initialiser.add(prior.node, prior)

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Take one measurement; return the estimates it completes."""
        steps = self._timeline.push(measurement)
        self._meet(measurement.node)
        if isinstance(measurement, Range):
            self._meet(measurement.peer)
        return self._work_off(steps)

    def finish(self) -> list[Estimate]:
        """Process what waits; RelposError if the run cannot give relative positions."""
        estimates = self._work_off(self._timeline.finish())
        refuse_unmoved(self._moved)
        refuse_unranged(self._ranges_used, self._timeline.counters)
        return estimates

    def counters(self) -> Mapping[str, int]:
        """Count everything dropped, late, resampled or found."""
        own = self._own + Counter(resampled=self._particles.resampled)
        return dict(self._timeline.counters + own + self.initialiser.counters)

    def _meet(self, node: int) -> None:
        if node not in self._known:
            self._known[node] = Presence()

    def _work_off(self, steps: Iterable[Step]) -> list[Estimate]:
        estimates = []
        for step in steps:
            match step:
                case Advance():
                    self._moved = True
                    self._known[step.node].received(step.time_s)
                    if step.node in self._row:
                        self._pending.setdefault(step.node, []).append(step)
                    else:
                        self._seek(step.node)
                        self.initialiser.advance(step)
                case Ranging():
                    self._predict()
                    self._update(step)
                case Sensed(measurement=Height() as height):
                    vertical = Vertical(height.height_m, height.sigma_m or 0.0)
                    self._known[height.node].vertical = vertical
                case Sensed():
                    self._own[step.unused] += 1
                case Epoch():
                    self._predict()
                    self._add_found(self.initialiser.find(step.time_s))
                    estimates.append(self._estimate(step.time_s))
        return estimates

    def _predict(self) -> None:
        """Apply the displacements since the last call: the k-th of every node at once."""
        pending = [(self._row[node], steps) for node, steps in self._pending.items()]
        self._pending = {}
        for k in range(max((len(steps) for _, steps in pending), default=0)):
            now = [(row, steps[k]) for row, steps in pending if len(steps) > k]
            self._particles.predict(
                np.array([row for row, _ in now]),
                np.array([(a.dx_m, a.dy_m, a.dtheta_rad) for _, a in now]),
                np.array([self._motion_noise.sigmas(a) for _, a in now]),
            )

    def _update(self, step: Ranging) -> None:
        nodes = sorted(nodes_of(step.ranges))
        for node in nodes:
            self._known[node].received(step.time_s)
            self._seek(node)
        z_m = {node: known.vertical.z_m for node, known in self._known.items()}
        if any(node in self.initialiser for node in nodes):
            # The search may end without a result; the ranges are usable all the same.
            self._ranges_used += len(step.ranges)
            self.initialiser.update(step.time_s, step.ranges, self._positions(), z_m)
        located = [r for r in step.ranges if r.node in self._row and r.peer in self._row]
        if located:
            self._ranges_used += len(located)
            self._particles.update(
                np.array([self._row[r.node] for r in located]),
                np.array([self._row[r.peer] for r in located]),
                np.array([r.range_m for r in located]),
                np.array([z_m[r.node] - z_m[r.peer] for r in located]),
            )

    # -- initial poses -------------------------------------------------------------------------

    def _seek(self, node: int) -> None:
        """Hand a node to the initialiser if its initial pose is unknown."""
        if node not in self._row and node not in self.initialiser:
            self.initialiser.add(node)

    def _positions(self) -> dict[int, tuple[float, float, float]]:
        """Return x, y (m) and variance (m^2) of the located nodes."""
        moments = self._particles.moments().tolist()
        return {
            node: (moments[row][0], moments[row][1], 0.5 * (moments[row][2] + moments[row][3]))
            for node, row in self._row.items()
        }

    def _add_found(self, mixture: PoseMixture | None) -> None:
        """Draw the particles of nodes that the initialiser has found."""
        if mixture is None:
            return
        count = self.settings.particles
        chosen = systematic(mixture.weights, count, self._rng)
        # Not Cholesky's factor: the pose of the frame's node is exact, its covariance zero.
        variances, axes = np.linalg.eigh(mixture.covariances)
        roots = axes * np.sqrt(np.maximum(variances, 0.0))[:, None, :]
        normals = self._rng.standard_normal((count, roots.shape[1]))
        deviations = np.einsum("mab,mb->ma", roots[chosen], normals)
        poses = mixture.poses[chosen] + deviations.reshape(count, -1, POSE)
        for n, node in enumerate(mixture.nodes):
            self._row[node] = self._particles.add(poses[:, n].T)

    # -- estimates -----------------------------------------------------------------------------

    def _estimate(self, time_s: float) -> Estimate:
        for known in self._known.values():
            known.close_epoch(self._epoch_s)
        self._epoch_s = time_s
        moments = self._particles.moments().tolist()
        nodes = []
        for node, known in sorted(self._known.items()):
            if node not in self._row:
                nodes.append(sought_node(self.initialiser, node, known))
                continue
            x_m, y_m, xx, yy, xy, c, s = moments[self._row[node]]
            # Particles that coincide say where somebody is, not that it is known exactly.
            xx, yy = max(xx, MIN_BANDWIDTH_M**2), max(yy, MIN_BANDWIDTH_M**2)
            nodes.append(
                NodeEstimate(
                    node, x_m, y_m, math.atan2(s, c), xx, yy, xy, _spread_rad(math.hypot(c, s)),
                    known.status, *known.vertical,
                )
            )  # fmt: skip
        return Estimate(time_s, tuple(nodes), pairs_of(nodes))


def _spread_rad(resultant: float) -> float:
    """Circular standard deviation of headings whose mean vector has this length."""
    return min(math.sqrt(2.0 * max(1.0 - resultant, 0.0)), ANY_ANGLE_RAD)
