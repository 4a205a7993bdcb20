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

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from relpos.fusion.models.ranging import RangeNoise
from relpos.fusion.particle import kernels

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(slots=True)
class ParticleSet:
    """Particles of K nodes, which are numbered in the order in which they were added.

    ``size`` is M, ``poses`` (3, K, M) are x, y (m) and heading (rad), ``weights`` (K, M); every
    row of weights sums to one.
    """

    size: int
    alpha: float
    noise: RangeNoise
    rng: np.random.Generator
    poses: Floats = field(init=False)
    weights: Floats = field(init=False)
    resampled: int = 0
    """How often a node was resampled."""
    _random: Floats = field(default_factory=lambda: np.empty(0))
    _corrected: Floats = field(default_factory=lambda: np.empty((0, 0)))

    def __post_init__(self) -> None:
        self.poses = np.empty((3, 0, self.size))
        self.weights = np.empty((0, self.size))

    def add(self, poses: Floats) -> int:
        """Add a node with equally likely poses (3, M); return its row."""
        self.poses = np.concatenate([self.poses, poses[:, None, :]], axis=1)
        self.weights = np.concatenate([self.weights, np.full((1, self.size), 1.0 / self.size)])
        self._corrected = np.empty_like(self.weights)
        return len(self.weights) - 1

    def predict(self, rows: Indices, mean: Floats, sigma: Floats) -> None:
        """Move nodes ``rows`` (R,), all different, by body-frame displacements.

        ``mean`` and ``sigma`` (R, 3) are forward, left (m) and turn (rad) and their standard
        deviations.
        """
        some = max(PARTICLES_AT_ONCE // self.size, 1)
        for k in range(0, len(rows), some):
            spread = sigma[k : k + some]
            normals = self.size * max(int(np.count_nonzero(spread)), 1)
            bits = self.rng.bit_generator.random_raw((normals + 1) // 2)
            noise = self._buffer(2 * len(bits))
            kernels.normals(bits, noise)
            kernels.predict(self.poses, rows[k : k + some], mean[k : k + some], spread, noise)

    def update(self, first: Indices, second: Indices, range_m: Floats, height_m: Floats) -> None:
        """Correct by all ranges (R,) of one instant, then resample where it is needed.

        ``first`` and ``second`` are rows, ``height_m`` the height difference of the two nodes.
        """
        rows = len(self.weights)
        noise, corrected = self.noise, self._corrected
        offset, peer, which = kernels.sort_by_node(first, second, rows)
        ranges = kernels.NodeRanges(self.means(), offset, peer, range_m[which], height_m[which])
        floor = noise.flat_over_peak
        kernels.correct(self.poses, self.weights, ranges, noise.sigma_r_m, floor, corrected)
        if self.alpha > 0.0:
            dual = max(1, round(self.alpha * self.size))
            uniforms = self._uniforms(rows, kernels.DUAL_DRAWS * dual + 1)
            kernels.dual_step(
                self.poses, self.weights, corrected, ranges, noise.sigma_r_m, floor, self.alpha,
                uniforms,
            )  # fmt: skip
        self.weights, self._corrected = corrected, self.weights
        effective_sizes = 1.0 / np.einsum("km,km->k", corrected, corrected)
        low = np.flatnonzero(effective_sizes < 0.5 * self.size)
        if low.size:
            kernels.resample(self.poses, self.weights, low, self._uniforms(low.size, self.size + 1))
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
