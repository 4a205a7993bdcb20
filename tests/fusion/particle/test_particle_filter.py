"""The paper's filter, part by part, against independent computations."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relpos import fusion
from relpos.errors import RelposError
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.fusion.estimator_settings import ParticleSettings
from relpos.fusion.models.motion import MotionNoise
from relpos.fusion.particle import kernels
from relpos.fusion.particle.particle_set import ParticleSet, flat_over_peak
from relpos.fusion.timeline import Advance
from relpos.measurements import Measurement, Motion, Prior, Range
from relpos.simulation.paper import simulate_paper


def ranges_of(edges: list[tuple[int, float, float, float]], rows: int) -> kernels.NodeRanges:
    """Ranges (row of the node, x and y of the peer, range), each with a peer of its own."""
    ordered = sorted(range(len(edges)), key=lambda e: edges[e][0])
    offset = np.searchsorted([edges[e][0] for e in ordered], np.arange(rows + 1))
    centres = np.array([(e[1], e[2]) for e in edges]).T
    return kernels.NodeRanges(
        np.ascontiguousarray(centres), offset, np.array(ordered),
        np.array([edges[e][3] for e in ordered]), np.zeros(len(edges)),
    )  # fmt: skip


def corrected(
    ranges: kernels.NodeRanges, poses: np.ndarray, weights: np.ndarray, noise: ParticleSettings
) -> np.ndarray:
    result = np.empty_like(weights)
    kernels.correct(poses, weights, ranges, noise.sigma_r_m, flat_over_peak(noise), result)
    return result


def multinomial(weights: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """As many draws as there are weights, read off poses that name their particle."""
    rows, size = weights.shape
    poses = np.zeros((3, rows, size))
    poses[0] = np.arange(size)
    kernels.resample(poses, weights.copy(), np.arange(rows), rng.random((rows, size + 1)))
    return poses[0].astype(int)


def particles(rng: np.random.Generator, rows: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    poses = rng.normal(size=(3, rows, size))
    weights = rng.random((rows, size))
    return poses, weights / weights.sum(axis=1, keepdims=True)


def test_weights_are_the_product_of_the_ranges_gaussian_densities() -> None:
    rng = np.random.default_rng(1)
    poses, weights = particles(rng, 3, 20)
    edges = [(2, 4.0, 1.0, 3.5), (0, -2.0, 2.0, 1.0), (2, 0.0, 5.0, 6.0), (0, 3.0, 3.0, 4.2)]
    new = corrected(ranges_of(edges, 3), poses, weights, ParticleSettings(sigma_r_m=0.8))
    for user in (0, 2):
        direct = [
            weights[user, k]
            * math.prod(
                math.exp(-((z - math.dist((x, y), poses[:2, user, k])) ** 2) / (2 * 0.8**2))
                / (math.sqrt(2 * math.pi) * 0.8)
                for looker, x, y, z in edges
                if looker == user
            )
            for k in range(20)
        ]
        assert new[user] == pytest.approx(np.array(direct) / sum(direct), rel=1e-9)
    assert np.array_equal(new[1], weights[1])


def test_ranges_no_particle_can_explain_leave_finite_weights() -> None:
    rng = np.random.default_rng(2)
    poses, weights = particles(rng, 1, 30)
    new = corrected(
        ranges_of([(0, 0.0, 0.0, 1e4)], 1), poses, weights, ParticleSettings(sigma_r_m=0.01)
    )
    assert new.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("rest", [0.0, 1e-320, 1e-300])
def test_weights_stay_weights_where_the_dual_step_replaces_all_that_had_any(rest: float) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        team = ParticleSet(ParticleSettings(4, 0.5, 0.1), rng)
        for _ in range(2):
            team.add(np.zeros((3, 4)))
        team.weights[:] = rest
        team.weights[:, 0] = 1.0
        row = np.zeros(1, dtype=np.int64)
        team.update(row, row + 1, np.array([200.0]), np.zeros(1))
        assert team.weights.sum(axis=1) == pytest.approx(1.0)


def test_particles_that_coincide_leave_a_variance() -> None:
    made = fusion.make("particle", [Prior(1, 0, 0, 0, 0.0, 0.0), Prior(2, 4, 0, 0, 0.0, 0.0)])
    rows = [Motion(1.0 + k, n, 0.0, 0.0, 0.0) for k in range(3) for n in (1, 2)]
    estimates = [e for row in rows for e in made.process(row)]
    for node in (node for estimate in estimates for node in estimate.nodes):
        assert (node.variance_x_m2, node.variance_y_m2) == (1e-6, 1e-6)
    assert estimates


def test_an_outlier_share_bounds_what_one_range_can_do() -> None:
    poses = np.zeros((3, 1, 2))
    poses[0, 0] = (1.0, 9.0)
    weights = np.array([[0.99, 0.01]])
    ranges = ranges_of([(0, 0.0, 0.0, 9.0)], 1)
    gaussian = corrected(ranges, poses, weights, ParticleSettings(sigma_r_m=0.3))
    robust = corrected(ranges, poses, weights, ParticleSettings(sigma_r_m=0.3, outliers=0.5))
    assert gaussian[0, 0] < 1e-9 < 0.5 < robust[0, 0]


def test_resampling_is_unbiased() -> None:
    rng = np.random.default_rng(3)
    weights = np.array([[0.5, 0.3, 0.15, 0.05, 0.0], [0.0, 0.2, 0.2, 0.2, 0.4]])
    times = np.zeros((2, 5))
    repeats = 4000
    for _ in range(repeats):
        index = multinomial(weights, 5, rng)
        for row in (0, 1):
            times[row] += np.bincount(index[row], minlength=5)
    frequency = times / (5 * repeats)
    # Standard error at most sqrt(.25 / 20000) = .0035.
    assert frequency == pytest.approx(weights, abs=0.012)
    assert not frequency[weights == 0.0].any()


def dual_step(
    rng: np.random.Generator, poses: np.ndarray, predicted: np.ndarray, corrected: np.ndarray,
    ranges: kernels.NodeRanges, sigma_m: float, alpha: float,
) -> None:  # fmt: skip
    rows, size = predicted.shape
    uniforms = rng.random((rows, kernels.DUAL_DRAWS * round(alpha * size) + 1))
    kernels.dual_step(poses, predicted, corrected, ranges, sigma_m, 0.0, alpha, uniforms)


def test_the_dual_particles_mass_is_alpha_and_they_lie_on_the_ring() -> None:
    rng = np.random.default_rng(4)
    for alpha in (0.01, 0.1, 0.5):
        poses = np.zeros((3, 2, 1000))
        poses[:2] = rng.normal(0.0, 2.0, (2, 2, 1000))
        predicted = np.full((2, 1000), 1e-3)
        before = poses.copy()
        corrected = predicted.copy()
        ranges = ranges_of([(0, 30.0, 0.0, 29.0), (1, 0.0, 40.0, 41.0)], 2)
        dual_step(rng, poses, predicted, corrected, ranges, 0.1, alpha)
        fresh = (poses != before).any(axis=0)
        assert fresh.sum(axis=1).tolist() == [round(alpha * 1000)] * 2
        assert corrected.sum(axis=1) == pytest.approx(1.0)
        assert (corrected * fresh).sum(axis=1) == pytest.approx(alpha)
        ring = np.hypot(poses[0, 0, fresh[0]] - 30.0, poses[1, 0, fresh[0]])
        assert ring == pytest.approx(29.0, abs=0.6)


def test_the_ring_of_somebody_a_floor_above_is_as_wide_as_the_slant_range_leaves() -> None:
    rng = np.random.default_rng(4)
    poses = rng.normal(0.0, 2.0, (3, 1, 1000))
    predicted = np.full((1, 1000), 1e-3)
    ranges = ranges_of([(0, 3.0, 0.0, 5.0)], 1)._replace(height_m=np.array([-4.0]))
    before = poses.copy()
    dual_step(rng, poses, predicted, predicted.copy(), ranges, 0.01, 0.1)
    fresh = (poses != before).any(axis=0)[0]
    ring_m = np.hypot(poses[0, 0, fresh] - 3.0, poses[1, 0, fresh])
    assert ring_m == pytest.approx(3.0, abs=0.1)


def test_dual_particles_weigh_by_predicted_density_and_the_other_ranges() -> None:
    rng = np.random.default_rng(5)
    # On the ring of 10 m about the origin the particles are at (10, 0) and the second range says
    # (0, 10): neither alone, only their product decides.
    size = 2000
    poses = np.zeros((3, 1, size))
    poses[:2, 0] = np.array([[10.0], [0.0]]) + rng.normal(0.0, 1.0, (2, size))
    predicted = np.full((1, size), 1.0 / size)
    ranges = ranges_of([(0, 0.0, 0.0, 10.0), (0, 14.0, 0.0, 4.0)], 1)
    before, corrected = poses.copy(), predicted.copy()
    dual_step(rng, poses, predicted, corrected, ranges, 0.5, 0.1)
    fresh = (poses != before).any(axis=0)[0]
    points, weight = poses[:2, 0, fresh], corrected[0, fresh]
    density = np.exp(log_density(points, before[:2, 0], predicted[0], BINNED))
    to_first = np.exp(-0.5 * ((10.0 - np.hypot(*points)) / 0.5) ** 2)
    to_second = np.exp(-0.5 * ((4.0 - np.hypot(points[0] - 14.0, points[1])) / 0.5) ** 2)
    # A point was drawn on either ring; its weight must follow the other one's likelihood.
    by_first, by_second = density * to_second, density * to_first
    total = weight / weight.max()
    matches = [
        any(
            abs(total[k] / total[weight.argmax()] - c[k] / d[weight.argmax()]) < 1e-6
            for c in (by_first, by_second)
            for d in (by_first, by_second)
        )
        for k in range(len(weight))
    ]
    assert all(matches)


PLAIN, BINNED = 0, kernels.CELLS


def log_density(
    points: np.ndarray, positions: np.ndarray, weights: np.ndarray, cells: int
) -> np.ndarray:
    result = np.empty(points.shape[1])
    kernels.log_density(*points, *positions, weights, np.empty((cells, cells)), result)
    return result


@pytest.mark.parametrize("cells", [PLAIN, BINNED])
def test_the_density_integrates_to_one(cells: int) -> None:
    rng = np.random.default_rng(6)
    poses, weights = particles(rng, 1, 200)
    axis = np.linspace(-7.0, 7.0, 141)
    grid = np.stack(np.meshgrid(axis, axis)).reshape(2, -1)
    total = np.exp(log_density(grid, poses[:2, 0], weights[0], cells)).sum() * 0.1**2
    assert total == pytest.approx(1.0, abs=0.01)


def test_the_motion_noise_is_relative_and_independent_of_how_a_report_is_divided() -> None:
    noise = MotionNoise(0.2, 0.1)
    whole = noise.sigmas(Advance(1.0, 1, 1.0, 3.0, 2.0, 0.5))
    assert whole == pytest.approx((0.6, 0.4, 0.05))
    pieces = [
        noise.sigmas(Advance(1.0, 1, f, 3.0 * f, 2.0 * f, 0.5 * f, fraction=f)) for f in (0.3, 0.7)
    ]
    assert np.hypot(*pieces) == pytest.approx(whole)


def test_a_standing_node_gets_noise_from_a_floor_alone() -> None:
    still = Advance(4.0, 1, 4.0, 0.0, 0.0, 0.0)
    assert MotionNoise().sigmas(still) == (0.0, 0.0, 0.0)
    assert MotionNoise(0.2, 0.1, 0.02, 0.01).sigmas(still) == pytest.approx((0.04, 0.04, 0.02))


def fuse(
    measurements: tuple[Measurement, ...] | list[Measurement],
    priors: tuple[Prior, ...] = (),
    seed: int = 0,
    name: str = "particle",
    **settings: float,
) -> list[Estimate]:
    estimator = fusion.make(name, priors, settings, seed)
    return [e for m in measurements for e in estimator.process(m)] + estimator.finish()


def test_the_order_of_ranges_does_not_matter() -> None:
    rng = np.random.default_rng(8)
    poses, weights = particles(rng, 3, 50)
    edges = [(0, 1.0, 2.0, 2.0), (1, 0.0, 0.0, 1.5), (2, 3.0, 1.0, 2.5), (0, 0.0, 0.0, 1.0)]
    forward = corrected(ranges_of(edges, 3), poses, weights, ParticleSettings(sigma_r_m=1.0))
    backward = corrected(ranges_of(edges[::-1], 3), poses, weights, ParticleSettings(sigma_r_m=1.0))
    assert forward == pytest.approx(backward, rel=1e-12)


def test_the_same_seed_gives_the_same_estimates_and_another_seed_others() -> None:
    run = simulate_paper("paper", 1, {"seconds": 60})
    first = fuse(run.measurements, run.priors, 3)
    assert first == fuse(run.measurements, run.priors, 3)
    assert first != fuse(run.measurements, run.priors, 4)


def test_every_pair_and_node_is_reported_at_every_motion_epoch() -> None:
    run = simulate_paper("paper", 1, {"seconds": 30})
    estimates = fuse(run.measurements, run.priors)
    assert [e.time_s for e in estimates] == [float(k) for k in range(1, 31)]
    for e in estimates:
        assert [n.node for n in e.nodes] == [1, 2, 3, 4, 5, 6]
        assert [(p.node, p.peer) for p in e.pairs] == [
            (i, j) for i in range(1, 7) for j in range(i + 1, 7)
        ]


def test_a_run_without_a_usable_range_is_one_clear_error_for_the_particle_filter() -> None:
    motions: list[Measurement] = [
        Motion(float(k), n, 1.0, 0.0, 0.0) for k in (1, 2, 3) for n in (1, 2)
    ]
    zero: list[Measurement] = [*motions, Range(3.0, 1, 2, 0.0)]
    priors = (Prior(1, 0.0, 0.0, 0.0), Prior(2, 5.0, 0.0, 0.0))
    for measurements in (motions, zero):
        with pytest.raises(RelposError, match="no usable range"):
            fuse(measurements, priors)
        last = fuse(measurements, priors, name="deadreckoning")[-1]
        assert last.pairs[0].distance_m == pytest.approx(5.0)


def test_dead_reckoning_says_that_unknown_starts_give_no_relative_position() -> None:
    motions: list[Measurement] = [
        Motion(float(k), n, 1.0, 0.0, 0.0) for k in (1, 2, 3) for n in (1, 2)
    ]
    with pytest.raises(RelposError, match="unknown starts"):
        fuse(motions, name="deadreckoning")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"partickles": "5"}, "no setting 'partickles'"),
        ({"particles": "many"}, "not a number"),
        ({"particles": "12.5"}, "not a whole number"),
        ({"alpha": "1.5"}, "not within"),
        ({"sigma_r_m": "nan"}, "not within"),
    ],
)
def test_a_wrong_setting_is_named(settings: dict[str, str], words: str) -> None:
    with pytest.raises(RelposError, match=words):
        fusion.make("particle", (), settings)


def test_the_documented_defaults_are_the_papers() -> None:
    defaults = {info.key: info.default for info in fusion.settings_of("particle")}
    wanted = {"particles": 500, "alpha": 0.01, "sigma_r_m": 2.0, "sigma_d": 0.2, "sigma_theta": 0.1}
    assert wanted.items() <= defaults.items()
    assert defaults["floor_d_m"] == defaults["floor_theta_rad"] == defaults["outliers"] == 0.0


def walkers(seconds: int, *, second_moves: bool) -> tuple[list[Measurement], list[complex]]:
    """Two nodes, one circling; the second, 8 m off and headed 2 rad away, goes or stands."""
    a, b, heading_a, heading_b = 0j, complex(6.0, 5.0), 0.0, 2.0
    measurements: list[Measurement] = []
    seen = []
    for k in range(1, seconds + 1):
        turn_a, step_b = 0.15, (0.5 if second_moves else 0.0)
        turn_b = -0.4 * math.cos(k / 9.0) if second_moves else 0.0
        a += 0.8 * complex(math.cos(heading_a), math.sin(heading_a))
        heading_a += turn_a
        b += step_b * complex(math.cos(heading_b), math.sin(heading_b))
        heading_b += turn_b
        measurements += [Motion(float(k), 1, 0.8, 0.0, turn_a),
                         Motion(float(k), 2, step_b, 0.0, turn_b),
                         Range(float(k), 1, 2, abs(a - b))]  # fmt: skip
        seen.append(b)
    return measurements, seen


def test_an_unknown_initial_pose_is_ambiguous_first_and_then_found() -> None:
    measurements, truth = walkers(60, second_moves=True)
    found = 0
    for seed in range(3):
        estimates = fuse(measurements, seed=seed)
        status = [e.nodes[1].status for e in estimates]
        assert status[0] is NodeStatus.AMBIGUOUS
        last = estimates[-1].nodes[1]
        found += last.status is NodeStatus.OK and abs(complex(last.x_m, last.y_m) - truth[-1]) < 1.5
    assert found == 3


def test_without_priors_a_node_that_moves_is_the_frame_and_one_that_stands_has_no_heading() -> None:
    measurements, truth = walkers(40, second_moves=False)
    estimates = fuse(measurements)
    assert estimates[0].nodes[1].status is NodeStatus.AMBIGUOUS
    first, second = estimates[-1].nodes
    assert first.status is NodeStatus.OK
    assert abs(complex(second.x_m, second.y_m) - truth[-1]) < 1.0
    assert second.sigma_heading_rad > 1.0


def test_a_node_without_news_is_stale_after_three_epochs_and_lost_after_ten() -> None:
    measurements: list[Measurement] = []
    for k in range(1, 31):
        measurements.append(Motion(float(k), 1, 0.5, 0.0, 0.0))
        if k <= 5:
            measurements += [Motion(float(k), 2, 0.5, 0.0, 0.0), Range(float(k), 1, 2, 3.0)]
    priors = (Prior(1, 0.0, 0.0, 0.0), Prior(2, 0.0, 3.0, 0.0))
    status = {e.time_s: e.nodes[1].status for e in fuse(measurements, priors)}
    assert [status[t] for t in (5.0, 7.0, 8.0, 14.0, 15.0, 30.0)] == [
        NodeStatus.OK, NodeStatus.OK, NodeStatus.STALE, NodeStatus.STALE,
        NodeStatus.LOST, NodeStatus.LOST,
    ]  # fmt: skip


def test_a_node_that_joins_late_is_found_by_its_ranges_to_the_team() -> None:
    run = simulate_paper("paper-p1", 2, {"seconds": 100, "detection": 1, "max_range_m": 0})
    measurements = [
        m
        for m in run.measurements
        if m.time_s > 60.0 or 4 not in (m.node, m.peer if isinstance(m, Range) else m.node)
    ]
    priors = tuple(p for p in run.priors if p.node != 4)
    estimates = fuse(measurements, priors)
    assert [n.node for n in estimates[30].nodes] == [1, 2, 3, 5, 6]
    last = {n.node: n for n in estimates[-1].nodes}
    truth = {t.node: t for t in run.truth if t.time_s == 100.0}
    assert last[4].status is NodeStatus.OK
    assert math.hypot(last[4].x_m - truth[4].x_m, last[4].y_m - truth[4].y_m) < 3.0
