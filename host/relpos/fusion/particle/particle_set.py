"""The paper's particle filter with the dual step (sect. IV), over all nodes at once.

Every node has M weighted particles of its own. An epoch has four steps:

1. *Prediction*: displacements since the last epoch, body frame, each particle with its own noise
   (:mod:`relpos.fusion.models.motion`).
2. *Correction*: the weight of particle k of node i is multiplied by the likelihood of every range
   to a neighbour j, taken at j's **mean before this correction**, so that the order of the nodes
   does not matter (:mod:`relpos.fusion.models.ranging`).
3. *Dual step*: a fraction ``alpha`` of the particles is redrawn on the ring of a random neighbour,
   with a heading drawn from the node's predicted particles. The weight of a dual particle is the
   density of the predicted particles there (kernel density estimate) times the likelihood of the
   node's *other* ranges, normalised among the dual particles to a total of ``alpha``; the others
   get 1 - alpha. (With strict importance weights the step would have no effect: where it is
   needed, the predicted density is next to zero.)
4. *Resampling*, multinomial, of nodes whose effective sample size is below M/2.

The paper leaves resampling and heading open. Systematic resampling with a heading from the
density's kernels has a smaller error (``docs/fusion.md``), but does not reproduce the paper's
figures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.estimator_settings import ParticleSettings
from relpos.fusion.particle import kernels

OUTLIER_SPAN_M = 30.0
"""An outlier's density is flat over so much, so that one wrong range cannot outvote all others."""


def flat_over_peak(settings: ParticleSettings) -> float:
    """Return the density of outliers over the peak of all other ranges'; 0 without outliers."""
    inliers = 1.0 - settings.outliers
    peak = inliers / (math.sqrt(2.0 * math.pi) * settings.sigma_r_m)
    return settings.outliers / OUTLIER_SPAN_M / peak


@dataclass(slots=True)
class ParticleSet:
    """Particles of K nodes, which are numbered in the order in which they were added.

    M is ``settings.particles``, ``poses`` (3, K, M) are x, y (m) and heading (rad), ``weights``
    (K, M); every row of weights sums to one.
    """

    settings: ParticleSettings
    rng: np.random.Generator
    poses: Floats = field(init=False)
    weights: Floats = field(init=False)
    resampled: int = 0
    """How often a node was resampled."""
    _random: Floats = field(default_factory=lambda: np.empty(0))
    _corrected: Floats = field(default_factory=lambda: np.empty((0, 0)))

    def __post_init__(self) -> None:
        self.poses = np.empty((3, 0, self.settings.particles))
        self.weights = np.empty((0, self.settings.particles))

    def add(self, poses: Floats) -> int:
        """Add a node with equally likely poses (3, M); return its row."""
        self.poses = np.concatenate([self.poses, poses[:, None, :]], axis=1)
        size = self.settings.particles
        self.weights = np.concatenate([self.weights, np.full((1, size), 1.0 / size)])
        self._corrected = np.empty_like(self.weights)
        return len(self.weights) - 1

    def predict(self, rows: Indices, mean: Floats, sigma: Floats) -> None:
        """Move nodes ``rows`` (R,), all different, by body-frame displacements.

        ``mean`` and ``sigma`` (R, 3) are forward, left (m) and turn (rad) and their standard
        deviations.
        """
        size = self.settings.particles
        some = max(PARTICLES_AT_ONCE // size, 1)
        for k in range(0, len(rows), some):
            spread = sigma[k : k + some]
            normals = size * max(int(np.count_nonzero(spread)), 1)
            bits = self.rng.bit_generator.random_raw((normals + 1) // 2)
            noise = self._buffer(2 * len(bits))
            kernels.normals(bits, noise)
            kernels.predict(self.poses, rows[k : k + some], mean[k : k + some], spread, noise)

    def update(self, first: Indices, second: Indices, range_m: Floats, height_m: Floats) -> None:
        """Correct by all ranges (R,) of one instant, then resample where it is needed.

        ``first`` and ``second`` are rows, ``height_m`` the height difference of the two nodes.
        """
        s, rows, corrected = self.settings, len(self.weights), self._corrected
        offset, peer, which = kernels.sort_by_node(first, second, rows)
        ranges = kernels.NodeRanges(self.means(), offset, peer, range_m[which], height_m[which])
        floor = flat_over_peak(s)
        kernels.correct(self.poses, self.weights, ranges, s.sigma_r_m, floor, corrected)
        if s.alpha > 0.0:
            dual = max(1, round(s.alpha * s.particles))
            uniforms = self._uniforms(rows, kernels.DUAL_DRAWS * dual + 1)
            kernels.dual_step(
                self.poses, self.weights, corrected, ranges, s.sigma_r_m, floor, s.alpha, uniforms
            )
        self.weights, self._corrected = corrected, self.weights
        effective_sizes = 1.0 / np.einsum("km,km->k", corrected, corrected)
        low = np.flatnonzero(effective_sizes < 0.5 * s.particles)
        if low.size:
            uniforms = self._uniforms(low.size, s.particles + 1)
            kernels.resample(self.poses, self.weights, low, uniforms)
            self.resampled += int(low.size)

    def means(self) -> Floats:
        """Return the mean positions (2, K) in metres."""
        result = np.empty((2, len(self.weights)))
        kernels.means(self.poses, self.weights, result)
        return result

    def moments(self) -> Floats:
        """Return (K, 7): mean x, y, variance x, y, covariance, mean cosine and sine of heading."""
        result = np.empty((len(self.weights), 7))
        kernels.moments(self.poses, self.weights, result)
        return result

    def _uniforms(self, rows: int, columns: int) -> Floats:
        """Draw uniforms in [0, 1) into the kept buffer: allocating costs more than drawing."""
        return self.rng.random(out=self._buffer(rows * columns)).reshape(rows, columns)

    def _buffer(self, count: int) -> Floats:
        if self._random.size < count:
            self._random = np.empty(count)
        return self._random[:count]


PARTICLES_AT_ONCE = 8192
"""Particles moved by one call of the kernel: their noise is still in the processor's cache."""
