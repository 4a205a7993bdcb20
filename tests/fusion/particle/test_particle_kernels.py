"""The particle filter's kernels against their reference, with the same random numbers."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from reference import particle as reference
from relpos.fusion import vectormath
from relpos.fusion.compiled import compiled
from relpos.fusion.estimator_settings import ParticleSettings
from relpos.fusion.particle import kernels
from relpos.fusion.particle.particle_set import ParticleSet, flat_over_peak

ROWS, SIZE = 4, 301


@compiled
def _each(x: np.ndarray, result: np.ndarray) -> None:
    for i in range(x.shape[0]):
        result[0, i] = vectormath.exp(x[i])
        result[1, i] = vectormath.log(math.exp(x[i] / 8.0))
        result[2, i], result[3, i] = vectormath.cos_sin(x[i])
        result[4, i], result[5, i] = vectormath.cos_sin_turns(x[i])


def test_vector_functions_are_those_of_the_c_library() -> None:
    rng = np.random.default_rng(0)
    quarters = np.arange(-40, 41) * (math.pi / 4.0)
    x = np.concatenate([rng.uniform(-690.0, 690.0, 4000), rng.normal(size=500), quarters, [0.0]])
    result = np.empty((6, x.size))
    _each(x, result)
    assert result[0] == pytest.approx(np.exp(x), rel=1e-12)
    assert result[1] == pytest.approx(x / 8.0, rel=1e-12, abs=1e-15)
    assert result[2] == pytest.approx(np.cos(x), abs=1e-12)
    assert result[3] == pytest.approx(np.sin(x), abs=1e-12)
    whole = x - np.round(x)
    assert result[4] == pytest.approx(np.cos(2.0 * math.pi * whole), abs=1e-12)
    assert result[5] == pytest.approx(np.sin(2.0 * math.pi * whole), abs=1e-12)
    least = np.array([-701.0, -1e6, -math.inf])
    _each(least, result := np.empty((6, 3)))
    assert result[0].tolist() == [0.0, 0.0, 0.0]


def test_the_normals_are_standard_normal() -> None:
    bits = np.random.default_rng(1).bit_generator.random_raw(100_000)
    drawn = np.empty(2 * bits.size)
    kernels.normals(bits, drawn)
    assert drawn == pytest.approx(reference.normals(bits), abs=1e-9)
    # Standard errors: .0022 of the mean, .0032 of the variance, .011 of the fourth moment.
    assert abs(drawn.mean()) < 0.01
    assert drawn.var() == pytest.approx(1.0, abs=0.015)
    assert (drawn**4).mean() == pytest.approx(3.0, abs=0.06)
    assert abs(np.corrcoef(*np.split(drawn, 2))[0, 1]) < 0.015
    extremes = np.array([0, 2**64 - 1], dtype=np.uint64)
    kernels.normals(extremes, worst := np.empty(4))
    assert np.isfinite(worst).all()
    assert abs(worst).max() == pytest.approx(math.sqrt(-2.0 * math.log(2.0**-33)))


def particles(rng: np.random.Generator, size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    poses = rng.normal(0.0, 3.0, (3, ROWS, size))
    weights = rng.random((ROWS, size)) ** 4
    weights[:, 5:9] = 0.0
    return poses, weights / weights.sum(axis=1, keepdims=True)


def ranges(rng: np.random.Generator) -> kernels.NodeRanges:
    """Four ranges between rows 0, 1 and 3; row 2 has none."""
    first, second = np.array([0, 3, 1, 3]), np.array([1, 0, 3, 1])
    offset, peer, which = kernels.sort_by_node(first, second, ROWS)
    centres = rng.normal(0.0, 2.0, (2, ROWS))
    return kernels.NodeRanges(
        centres, offset, peer, rng.uniform(1.0, 6.0, 4)[which], rng.normal(size=4)[which]
    )


def test_every_range_is_listed_with_both_of_its_nodes() -> None:
    first, second = np.array([0, 3, 1, 3]), np.array([1, 0, 3, 1])
    offset, peer, which = kernels.sort_by_node(first, second, ROWS)
    listed = [
        sorted(zip(peer[a:b].tolist(), which[a:b].tolist(), strict=True))
        for a, b in pairwise(offset)
    ]
    assert listed == [[(1, 0), (3, 1)], [(0, 0), (3, 2), (3, 3)], [], [(0, 1), (1, 2), (1, 3)]]


@pytest.mark.parametrize("seed", range(3))
def test_prediction_and_moments_match_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses, weights = particles(rng)
    rows, mean = np.array([0, 2, 3]), rng.normal(size=(3, 3))
    sigma = np.array([[0.1, 0.0, 0.0], [0.2, 0.3, 0.4], [0.0, 0.0, 0.5]])
    noise = rng.normal(size=5 * SIZE)
    moved, expected = poses.copy(), poses.copy()
    kernels.predict(moved, rows, mean, sigma, noise)
    reference.predict(expected, rows, mean, sigma, noise)
    assert moved == pytest.approx(expected, abs=1e-11)
    assert np.array_equal(moved[:, 1], poses[:, 1])
    kernels.moments(moved, weights, figures := np.empty((ROWS, 7)))
    assert figures == pytest.approx(reference.moments(expected, weights), abs=1e-11)
    kernels.means(moved, weights, at := np.empty((2, ROWS)))
    assert at == pytest.approx(figures[:, :2].T, abs=1e-11)


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_correction_and_the_dual_step_match_the_reference(outliers: float) -> None:
    rng = np.random.default_rng(7)
    poses, weights = particles(rng)
    measured = ranges(rng)
    noise = ParticleSettings(sigma_r_m=0.7, outliers=outliers)
    floor = flat_over_peak(noise)
    kernels.correct(poses, weights, measured, noise.sigma_r_m, floor, new := np.empty_like(weights))
    expected = reference.correct(poses, weights, measured, noise)
    assert new == pytest.approx(expected, rel=1e-9, abs=1e-15)
    uniforms = rng.random((ROWS, 3 * kernels.DUAL_DRAWS + 1))
    ours, theirs = poses.copy(), poses.copy()
    kernels.dual_step(ours, weights, new, measured, noise.sigma_r_m, floor, 0.01, uniforms)
    reference.dual_step(theirs, weights, expected, measured, noise, 0.01, uniforms)
    assert ours == pytest.approx(theirs, abs=1e-9)
    assert new == pytest.approx(expected, rel=1e-8, abs=1e-15)
    assert (ours != poses).any(axis=0).sum(axis=1).tolist() == [3, 3, 0, 3]


def test_resampling_draws_what_the_reference_draws() -> None:
    rng = np.random.default_rng(8)
    poses, weights = particles(rng)
    rows, uniforms = np.array([1, 3]), rng.random((2, SIZE + 1))
    ours, theirs = (poses.copy(), weights.copy()), (poses.copy(), weights.copy())
    kernels.resample(*ours, rows, uniforms)
    reference.resample(*theirs, rows, uniforms)
    # Sums in another order may move an edge past a draw: never more than one in all of these.
    assert (ours[0] != theirs[0]).any(axis=0).sum() <= 1
    assert np.array_equal(ours[1], theirs[1])
    assert np.array_equal(ours[0][:, 0], poses[:, 0])


def densities(points: np.ndarray, at: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
    results = []
    for side in (0, kernels.CELLS):
        results.append(np.empty(points.shape[1]))
        kernels.log_density(*points, *at, weights, np.empty((side, side)), results[-1])
    return results


@pytest.mark.parametrize("size", [500, 5000])
def test_the_density_matches_the_reference_and_binning_changes_it_by_little(size: int) -> None:
    rng = np.random.default_rng(9)
    # Two lumps, one of them narrow, and stragglers beyond the grid.
    at = np.concatenate(
        [
            rng.normal(0.0, [[1.0], [0.4]], (2, size // 2)),
            rng.normal([[3.0], [1.0]], 0.2, (2, size // 2 - 5)),
            rng.uniform(60.0, 80.0, (2, 5)),
        ],
        axis=1,
    )
    weights = rng.random(size)
    weights /= weights.sum()
    points = np.concatenate(
        [at[:, ::7] + rng.normal(0.0, 0.3, at[:, ::7].shape), [[70.0], [70.0]]], 1
    )
    plain, binned = densities(points, at, weights)
    assert plain == pytest.approx(reference.log_density(points, at, weights), abs=1e-9)
    likely = plain > plain.max() - math.log(1e3)
    assert np.abs(binned - plain)[likely].max() < 0.05
    assert np.sqrt(np.mean((binned - plain)[likely] ** 2)) < 0.01


def test_points_far_from_everything_keep_their_order() -> None:
    rng = np.random.default_rng(10)
    at, weights = rng.normal(0.0, 0.1, (2, 4000)), np.full(4000, 1.0 / 4000)
    points = np.array([[1.0, 5.0, 20.0, 100.0], [0.0, 0.0, 0.0, 0.0]])
    for result in densities(points, at, weights):
        assert np.isfinite(result).all()
        assert (np.diff(result) < 0.0).all()


def test_the_same_generator_gives_the_same_particles() -> None:
    def run() -> ParticleSet:
        made = ParticleSet(ParticleSettings(50, 0.1), np.random.default_rng(3))
        for k in range(3):
            made.add(np.tile([[float(k)], [0.0], [0.0]], 50))
        for _ in range(5):
            made.predict(np.arange(3), np.full((3, 3), 0.3), np.full((3, 3), 0.1))
            made.update(np.array([0, 1]), np.array([1, 2]), np.ones(2), np.zeros(2))
        return made

    first, second = run(), run()
    assert np.array_equal(first.poses, second.poses)
    assert np.array_equal(first.weights, second.weights)
    assert first.weights.sum(axis=1) == pytest.approx(1.0)
