"""Reference implementation of :mod:`relpos.fusion.particle.kernels` in NumPy.

Written from the equations in the shortest way; the kernels are compared with them on random
input and the same random numbers. Densities are always plain sums over all particles.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from relpos.fusion.estimator_settings import ParticleSettings
from relpos.fusion.particle.kernels import (
    DUAL_DRAWS,
    FAR_OUT,
    LEAST_MASS,
    MIN_BANDWIDTH_M,
    NodeRanges,
)
from relpos.fusion.particle.particle_set import flat_over_peak

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Integers = npt.NDArray[np.uint64]


def move(poses: Floats, displacement: Floats) -> None:
    """Eqs. (2) to (4): move poses (3, ...) in place by body-frame displacements (3, ...)."""
    c, s = np.cos(poses[2]), np.sin(poses[2])
    poses[0] += c * displacement[0] - s * displacement[1]
    poses[1] += s * displacement[0] + c * displacement[1]
    poses[2] += displacement[2]


def log_likelihood(
    measured_m: Floats, dx_m: Floats, dy_m: Floats, dz_m: Floats, noise: ParticleSettings
) -> Floats:
    """Eq. (6) as a logarithm, up to a constant; with outliers the mixture's."""
    predicted_m = np.sqrt(dx_m**2 + dy_m**2 + dz_m**2)
    exponent: Floats = -0.5 * ((measured_m - predicted_m) / noise.sigma_r_m) ** 2
    if noise.outliers <= 0.0:
        return exponent
    mixed: Floats = np.logaddexp(exponent, math.log(flat_over_peak(noise)))
    return mixed


def normals(random: Integers) -> Floats:
    """Box and Muller (1958) on the two 32-bit halves of every number."""
    radial = ((random >> np.uint64(32)) + 0.5) / 2.0**32
    turns = (random & np.uint64(0xFFFFFFFF)) / 2.0**32
    radius, angle = np.sqrt(-2.0 * np.log(radial)), 2.0 * math.pi * turns
    return np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])


def predict(poses: Floats, rows: Indices, mean: Floats, sigma: Floats, noise: Floats) -> None:
    """Move nodes ``rows`` (R,), each particle by its own noisy displacement."""
    count = poses.shape[2]
    left = iter(noise[: noise.size // count * count].reshape(-1, count))
    for row, displacement, spread in zip(rows, mean, sigma, strict=True):
        drawn = np.stack([s * next(left) if s > 0.0 else np.zeros(count) for s in spread])
        move(poses[:, row], displacement[:, None] + drawn)


def moments(poses: Floats, weights: Floats) -> Floats:
    """Give (K, 7): mean x, y, variance x, y, covariance, and means of cosine and sine."""
    mean = np.einsum("ckm,km->kc", poses[:2], weights)
    off = poses[:2] - mean.T[:, :, None]
    spread = np.einsum("akm,bkm,km->kab", off, off, weights)
    around = np.stack([np.cos(poses[2]), np.sin(poses[2])])
    direction = np.einsum("ckm,km->kc", around, weights)
    return np.column_stack([mean, spread[:, 0, 0], spread[:, 1, 1], spread[:, 0, 1], direction])


def correct(poses: Floats, weights: Floats, ranges: NodeRanges, noise: ParticleSettings) -> Floats:
    """Eq. (6) for all nodes: the product of the ranges' likelihoods, normalised."""
    centres, offset, peer, range_m, height_m = ranges
    result = weights.copy()
    for k in range(len(weights)):
        seen = slice(offset[k], offset[k + 1])
        if offset[k] == offset[k + 1]:
            continue
        at = centres[:, peer[seen]]
        dx, dy = poses[0, k][:, None] - at[0], poses[1, k][:, None] - at[1]
        total = log_likelihood(range_m[seen], dx, dy, height_m[seen], noise).sum(axis=1)
        total -= total[weights[k] > 0.0].max()
        result[k] = weights[k] * np.exp(np.minimum(total, 0.0))
        result[k] /= result[k].sum()
    return result


def log_density(points_m: Floats, positions_m: Floats, weights: Floats) -> Floats:
    """Log density (D,) of particles, positions (2, M) and weights (M,), at points (2, D)."""
    mean = positions_m @ weights
    variance = (positions_m - mean[:, None]) ** 2 @ weights
    shrink = float((weights**2).sum()) ** (1.0 / 6.0)
    width = np.maximum(np.sqrt(variance) * shrink, MIN_BANDWIDTH_M)
    off = (points_m[:, :, None] - positions_m[:, None, :]) / width[:, None, None]
    exponent = -0.5 * (off**2).sum(axis=0)
    total = np.exp(exponent) @ weights
    with np.errstate(divide="ignore"):
        result: Floats = np.where(total > 1e-300, np.log(total), exponent.max(axis=1) - FAR_OUT)
    return result - math.log(2.0 * math.pi * float(width.prod()))


def dual_step(
    poses: Floats,
    predicted: Floats,
    corrected: Floats,
    ranges: NodeRanges,
    noise: ParticleSettings,
    alpha: float,
    uniforms: Floats,
) -> None:
    """Eq. (7), in place: redraw a fraction alpha of the particles of every node that ranged."""
    centres, offset, peer, range_m, height_m = ranges
    count = poses.shape[2]
    fresh = (uniforms.shape[1] - 1) // DUAL_DRAWS
    for k in range(len(predicted)):
        first, seen = offset[k], offset[k + 1] - offset[k]
        if seen == 0:
            continue
        ring_of, radial, phase, angle, source_of = uniforms[k, :-1].reshape(DUAL_DRAWS, fresh)
        edge = first + (ring_of * seen).astype(np.int64)
        normal = np.sqrt(-2.0 * np.log1p(-radial)) * np.cos(2.0 * math.pi * phase)
        slant = range_m[edge] + noise.sigma_r_m * normal
        radius = np.sqrt(np.maximum(slant**2 - height_m[edge] ** 2, 0.0))
        radius = np.where(height_m[edge] == 0.0, slant, radius)
        ring = np.stack([np.cos(2.0 * math.pi * angle), np.sin(2.0 * math.pi * angle)])
        points = centres[:, peer[edge]] + radius * ring
        log_weight = log_density(points, poses[:2, k], predicted[k])
        for e in range(first, first + seen):
            dx, dy = points - centres[:, peer[e]][:, None]
            each = log_likelihood(range_m[e], dx, dy, height_m[e], noise)
            log_weight += np.where(edge == e, 0.0, each)
        weight = np.exp(log_weight - log_weight.max())
        edges = np.cumsum(predicted[k])
        source = np.searchsorted(edges, source_of * edges[-1], side="right")
        heading = poses[2, k, np.minimum(source, count - 1)]
        slot = ((uniforms[k, -1] + np.arange(fresh)) * (count / fresh)).astype(np.int64) % count
        corrected[k, slot] = 0.0
        rest = corrected[k].sum()
        corrected[k] *= (1.0 - alpha) / rest if rest > LEAST_MASS else 0.0
        corrected[k, slot] = alpha * weight / weight.sum()
        corrected[k] /= corrected[k].sum()
        poses[:, k, slot] = np.stack([points[0], points[1], heading])


def resample(poses: Floats, weights: Floats, rows: Indices, uniforms: Floats) -> None:
    """Multinomial resampling of nodes ``rows`` in place, from (R, M + 1) uniforms."""
    count = poses.shape[2]
    for r, k in enumerate(rows):
        spacing = -np.log1p(-uniforms[r])
        wanted = np.cumsum(spacing)[:-1] / spacing.sum() * weights[k].sum()
        source = np.searchsorted(np.cumsum(weights[k]), wanted, side="right")
        poses[:, k] = poses[:, k, np.minimum(source, count - 1)]
        weights[k] = 1.0 / count
