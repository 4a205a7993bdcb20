"""The bound against its published values, a dense information matrix and an estimator's scatter."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import scipy

import relpos
from relpos.evaluation import bounds
from relpos.simulation import true_run
from relpos.simulation.paper import settings_of, simulate_paper
from relpos.simulation.true_run import TrueRun

Floats = npt.NDArray[np.float64]


def _scene(
    *,
    steps: int = 12,
    sigma_m: float = 0.1,
    off_grid: bool = False,
    constants: bool = False,
    start: float = 0.0,
    seed: int = 1,
) -> TrueRun:
    """Three people on curved ways, every pair ranging now and then."""
    rng = np.random.default_rng(seed)
    step = np.array([0.6, 0.0]) + 0.3 * rng.standard_normal((3, steps, 2))
    first = np.array([[0.0, 0.0], [5.0, 1.0], [2.0, 6.0]])
    position = np.concatenate((first[:, None], first[:, None] + np.cumsum(step, axis=1)), axis=1)
    pairs = np.array([(0, 1), (0, 2), (1, 2)])
    chosen = np.sort(rng.integers(1, steps + 1, 2 * steps)).astype(float)
    if off_grid:
        chosen -= rng.choice([0.0, 0.25, 0.6], chosen.size)
    return TrueRun(
        np.arange(steps + 1.0),
        position,
        np.full((3, steps), 0.1),
        0.05 * rng.uniform(0.5, 2.0, (3, steps)),
        np.where(rng.random((3, steps)) < 0.1, 0.3, 0.0),
        chosen,
        pairs[rng.integers(0, 3, chosen.size)],
        np.full(chosen.size, sigma_m**-2),
        start_m=np.full(3, start),
        start_rad=np.full(3, 0.5 * start),
        drift_rad_s=np.array([0.01, 0.0, 0.02]) * constants,
        log_scale=np.array([0.0, 0.1, 0.1]) * constants,
    )


def _paper_scene(name: str, seed: int, overrides: dict[str, float | str]) -> TrueRun:
    return true_run.of_paper(settings_of(name, overrides), simulate_paper(name, seed, overrides))


class _Dense:
    """The same problem as one function of independent errors: no recursion, no derivatives.

    A vector of unit errors says how the true way differs from the reported one.
    """

    def __init__(self, scene: TrueRun) -> None:
        self.scene = scene
        self.chord = np.diff(scene.position_m, axis=1)
        count, steps = scene.along.shape
        self.shape = (count, steps)
        self.size = count * (5 + 4 * steps)

    def positions(self, errors: Floats) -> Floats:
        """Walk every node, (N, T, 2): turn, then walk."""
        scene = self.scene
        count, steps = self.shape
        own = errors.reshape(count, 5 + 4 * steps)
        result = np.empty(scene.position_m.shape)
        for node in range(count):
            sx, sy, sh, drift, scale = own[node, :5] * (
                scene.start_m[node],
                scene.start_m[node],
                scene.start_rad[node],
                scene.drift_rad_s[node],
                scene.log_scale[node],
            )
            noise = own[node, 5:].reshape(steps, 4)
            place = scene.position_m[node, 0] + (sx, sy)
            result[node, 0] = place
            turned = sh
            for k in range(steps):
                turned += scene.turn_rad[node, k] * noise[k, 0]
                turned += drift * (scene.time_s[k + 1] - scene.time_s[k])
                c, s = math.cos(turned), math.sin(turned)
                chord = np.array([[c, -s], [s, c]]) @ self.chord[node, k]
                chord = chord * math.exp(scale) * (1.0 + scene.along[node, k] * noise[k, 1])
                place = place + chord + scene.sigma_m[node, k] * noise[k, 2:]
                result[node, k + 1] = place
        return result

    def distances(self, errors: Floats) -> Floats:
        """All the ranges without noise, (M,)."""
        scene, position = self.scene, self.positions(errors)
        result = []
        for time_s, (i, j) in zip(scene.range_time_s, scene.range_nodes, strict=True):
            at = [
                [np.interp(time_s, scene.time_s, position[n, :, axis]) for axis in (0, 1)]
                for n in (i, j)
            ]
            result.append(math.dist(*at))
        return np.array(result)

    def jacobian(self, function: str) -> Floats:
        """Central differences about the truth; a column an error."""
        step = 1e-5
        columns = []
        for k in range(self.size):
            shift = np.zeros(self.size)
            shift[k] = step
            call = getattr(self, function)
            columns.append((call(shift) - call(-shift)).ravel() / (2.0 * step))
        return np.array(columns).T

    def covariances(self, until_s: Floats) -> Floats:
        """Covariance of the positions at each time from the ranges up to ``until_s`` of it."""
        scene = self.scene
        by_range, by_position = self.jacobian("distances"), self.jacobian("positions")
        count, steps = self.shape
        by_position = by_position.reshape(count, steps + 1, 2, self.size)
        result = []
        for k in range(1, steps + 1):
            received = scene.range_time_s <= until_s[k]
            one = by_range[received]
            weight = scene.range_information[received, None]
            information = np.eye(self.size) + one.T @ (weight * one)
            wanted = by_position[:, k].reshape(2 * count, self.size)
            result.append(wanted @ np.linalg.solve(information, wanted.T))
        return np.array(result)


@pytest.mark.parametrize(
    ("off_grid", "constants", "start"),
    [(False, False, 0.0), (True, False, 0.4), (False, True, 0.4), (True, True, 0.0)],
)
def test_the_recursion_is_the_inverse_of_the_whole_information(
    off_grid: bool, constants: bool, start: float
) -> None:
    scene = _scene(off_grid=off_grid, constants=constants, start=start)
    bound = bounds.of_true_run(scene)
    dense = _Dense(scene)
    for until_s, pair_m, position_m in (
        (scene.time_s + 1e-9, bound.filtering_pair_m, bound.filtering_position_m),
        (np.full(13, np.inf), bound.smoothing_pair_m, bound.smoothing_position_m),
    ):
        covariance = dense.covariances(until_s)
        for k in range(12):
            at = scene.position_m[:, k + 1]
            expected = []
            for i, j in ((0, 1), (0, 2), (1, 2)):
                along = np.zeros(6)
                unit = (at[i] - at[j]) / np.linalg.norm(at[i] - at[j])
                along[2 * i : 2 * i + 2], along[2 * j : 2 * j + 2] = unit, -unit
                expected.append(math.sqrt(along @ covariance[k] @ along))
            assert pair_m[k] == pytest.approx(expected, rel=1e-5, abs=1e-9)
            assert position_m[k] == pytest.approx(_aligned(covariance[k], at), rel=1e-4, abs=1e-9)


def _aligned(covariance: Floats, at: Floats) -> float:
    """What is left of the covariance beside the three rigid motions, by an explicit basis."""
    centred = at - at.mean(axis=0)
    rigid = np.stack(
        [
            np.tile([1.0, 0.0], 3),
            np.tile([0.0, 1.0], 3),
            np.stack((-centred[:, 1], centred[:, 0]), axis=1).ravel(),
        ]
    ).T
    basis = np.linalg.qr(rigid)[0]
    rest = np.eye(6) - basis @ basis.T
    return math.sqrt(np.trace(rest @ covariance @ rest) / 3)


def test_the_best_estimator_scatters_as_the_bound_says() -> None:
    """Smoothing, small noise: where the problem is nearly linear the bound is reached."""
    scene = _scene(steps=8, sigma_m=0.03, constants=True, start=0.05)
    scene = replace(scene, along=0.3 * scene.along, turn_rad=0.3 * scene.turn_rad)
    scene = replace(scene, sigma_m=0.2 * scene.sigma_m)
    dense = _Dense(scene)
    rng = np.random.default_rng(5)
    slope = dense.jacobian("distances")
    by_position = dense.jacobian("positions").reshape(3, 9, 2, -1)
    first, second = np.triu_indices(3, 1)
    squares = []
    for _ in range(150):
        truth = rng.standard_normal(dense.size)
        ranges = dense.distances(truth) + 0.03 * rng.standard_normal(scene.range_time_s.size)

        def residuals(errors: Floats, ranges: Floats = ranges) -> Floats:
            predicted = dense.distances(np.zeros(dense.size)) + slope @ errors
            return np.concatenate((errors, (predicted - ranges) / 0.03))

        found = scipy.optimize.least_squares(
            residuals, np.zeros(dense.size), lambda _: np.vstack((np.eye(dense.size), slope / 0.03))
        ).x
        at = dense.positions(np.zeros(dense.size)) + by_position @ found
        really = dense.positions(truth)
        error = np.linalg.norm(at[first] - at[second], axis=-1) - np.linalg.norm(
            really[first] - really[second], axis=-1
        )
        squares.append(np.mean(error[:, 1:] ** 2))
    scatter = math.sqrt(np.mean(squares))
    # 150 runs: the standard error of the root mean square is below 4 %.
    assert scatter == pytest.approx(
        bounds.of_true_run(scene).totals().smoothing_distance_m, rel=0.1
    )


def test_more_ranges_never_raise_the_bound() -> None:
    scene = _paper_scene("paper-h2", 3, {"seconds": 120})
    fewer = {
        name: getattr(scene, name)[::2]
        for name in ("range_time_s", "range_nodes", "range_information")
    }
    everything, half = bounds.of_true_run(scene), bounds.of_true_run(replace(scene, **fewer))
    slack = 1e-9
    assert (half.filtering_pair_m >= everything.filtering_pair_m - slack).all()
    assert (half.smoothing_pair_m >= everything.smoothing_pair_m - slack).all()
    assert (everything.smoothing_pair_m <= everything.filtering_pair_m + slack).all()
    assert half.totals().filtering_distance_m > 1.1 * everything.totals().filtering_distance_m


def test_the_last_epoch_is_smoothed_by_nothing() -> None:
    bound = bounds.of_true_run(_scene(off_grid=True))
    assert bound.smoothing_pair_m[-1] == pytest.approx(bound.filtering_pair_m[-1])


@pytest.mark.parametrize(
    ("scenario", "filtering", "smoothing"),
    [
        ("paper", (0.686, 0.629), (0.322, 0.281)),
        pytest.param("paper-p1", (0.184, 0.164), (0.082, 0.070), marks=pytest.mark.soak),
        ("paper-h", (0.907, 0.919), (0.53, 0.50)),
        ("paper-h2", (1.29, 1.30), None),
    ],
)
def test_the_bound_has_the_known_values(
    scenario: str, filtering: tuple[float, float], smoothing: tuple[float, float] | None
) -> None:
    """Against an independent implementation's figures over 16 other seeds; distance, aligned."""
    total = bounds.over_seeds(bounds.of_simulated(scenario, seed).totals() for seed in range(6))
    assert (total.filtering_distance_m, total.filtering_position_m) == pytest.approx(
        filtering, rel=0.05
    )
    if smoothing is not None:
        assert (total.smoothing_distance_m, total.smoothing_position_m) == pytest.approx(
            smoothing, rel=0.05
        )


def test_a_person_waiting_at_a_known_place_has_no_error() -> None:
    """Six people start at one corner; the last leaves it after 80 s."""
    bound = bounds.of_simulated("paper", 0, {"seconds": 100})
    last_two = list(zip(*np.triu_indices(6, 1), strict=True)).index((4, 5))
    waiting = bound.time_s <= 64.0
    assert (bound.filtering_pair_m[waiting, last_two] == 0.0).all()
    assert (bound.filtering_pair_m[~waiting, last_two] > 0.0).all()
    assert np.isfinite(bound.filtering_position_m).all()


def test_an_unknown_start_is_found_and_the_frame_does_not_matter() -> None:
    scene = _paper_scene(
        "paper-p1", 0, {"spacing_s": 0.0, "nodes": 3, "seconds": 200, "start": "unknown"}
    )
    away = scene.position_m + np.array([[[0.0, 0.0]], [[4.0, 1.0]], [[1.0, 5.0]]])
    unknown = replace(scene, position_m=away)
    turned = replace(unknown, **_reordered(unknown, [2, 0, 1]))
    one, other = bounds.of_true_run(unknown), bounds.of_true_run(turned)
    assert one.filtering_position_m[0] > 100.0
    assert one.filtering_position_m[-1] < 1.0
    assert one.filtering_position_m[100:] == pytest.approx(
        other.filtering_position_m[100:], rel=1e-3
    )
    known = bounds.of_true_run(replace(unknown, start_m=np.zeros(3), start_rad=np.zeros(3)))
    assert (known.filtering_position_m <= one.filtering_position_m + 1e-6).all()


def test_ranges_tell_two_who_stand_at_one_place_how_near_they_are() -> None:
    """Six people start at one corner, believed metres apart; two leave it within ten seconds."""
    bound = bounds.of_simulated("paper-p1", 20000, {"start_shift_m": 4, "seconds": 20})
    assert bound.filtering_distance_m[0] == pytest.approx(4.0, abs=0.01)
    assert bound.filtering_distance_m[9] < 0.2
    assert (bound.filtering_pair_m[9:] < 0.5).all()


def _reordered(scene: TrueRun, order: list[int]) -> dict[str, npt.NDArray[np.generic]]:
    place = np.argsort(order)
    fields = (
        "position_m", "along", "turn_rad", "sigma_m", "start_m", "start_rad", "walked_m",
        "drifting_s",
    )  # fmt: skip
    return {name: getattr(scene, name)[order] for name in fields} | {
        "range_nodes": place[scene.range_nodes]
    }


def test_ranges_that_are_sometimes_too_long_carry_less_information() -> None:
    clean = bounds.of_simulated("paper-p1", 0, {"seconds": 120}).totals()
    late = bounds.of_simulated("paper-p1", 0, {"seconds": 120, "nlos_probability": 0.2}).totals()
    # A fifth of the ranges carries next to no information, and can be distinguished.
    assert late.filtering_distance_m == pytest.approx(
        clean.filtering_distance_m / math.sqrt(0.8), rel=0.08
    )
    assert late.filtering_distance_m > clean.filtering_distance_m


def test_ranges_that_are_too_long_by_one_length_tell_as_much_as_others() -> None:
    same = {"nlos_probability": 0.3, "nlos_min_m": 2, "nlos_max_m": 2, "sigma_range_m": 0.1}
    assert true_run._range_information(settings_of("paper", same)) == pytest.approx(100.0, rel=1e-3)


def test_ranges_without_noise_need_no_gigabytes_of_points() -> None:
    exact = settings_of("paper", {"sigma_range_m": 0, "nlos_probability": 0.5})
    assert 1e7 < true_run._range_information(exact) < 1e12


def test_ranges_of_the_laboratory_may_have_no_noise() -> None:
    bound = bounds.of_simulated("lab", 0, {"sigma_range_m": 0, "seconds": 60})
    usual = bounds.of_simulated("lab", 0, {"seconds": 60})
    assert 0.0 < bound.totals().filtering_distance_m < usual.totals().filtering_distance_m


@pytest.mark.parametrize(("nodes", "has_one"), [(50, True), (51, False)])
def test_a_crowd_has_no_bound_beside_its_score(nodes: int, has_one: bool) -> None:
    run = relpos.simulate("paper", nodes=nodes, seconds=3)
    assert (relpos.bound(run) is not None) == has_one


def test_hidden_parameters_raise_the_bound() -> None:
    """Scale and drift raise the bound, and are themselves known the better the later."""
    plain = bounds.of_simulated("paper-p1", 2, {"seconds": 200})
    hidden = {"seconds": 200, "scale_error": 0.1, "heading_drift_deg_s": 0.1}
    bound = bounds.of_simulated("paper-p1", 2, hidden)
    assert (bound.filtering_pair_m >= plain.filtering_pair_m - 1e-9).all()
    assert bound.totals().filtering_distance_m > 1.02 * plain.totals().filtering_distance_m
    drift, scale = bound.filtering_constants.T
    assert (drift < math.radians(0.1)).all()
    assert (scale < 0.06).all()


def test_a_kidnapped_user_is_lost_until_it_is_seen_again() -> None:
    options = {"seconds": 200, "kidnap_m": 5.0, "kidnap_s": 150.0}
    run = simulate_paper("paper-p1", 1, options)
    who = (run.hidden.kidnapped_node or 0) - 1
    bound = bounds.of_simulated("paper-p1", 1, options)
    plain = bounds.of_simulated("paper-p1", 1, {"seconds": 200})
    first, second = np.triu_indices(6, 1)
    others = (first != who) & (second != who)
    before = bound.time_s < 150.0
    assert bound.filtering_pair_m[before] == pytest.approx(plain.filtering_pair_m[before])
    at = int(np.flatnonzero(bound.time_s == 150.0)[0])
    assert bound.filtering_pair_m[at, ~others].max() > 0.2
    assert bound.filtering_pair_m[at, others].max() < bound.filtering_pair_m[at, ~others].max()
