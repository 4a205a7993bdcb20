"""The metrics of the run format, against brute force written from its sentences alone."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpos.evaluation.metrics import evaluate, over_seeds
from relpos.evaluation.sides import share_on_wrong_side
from relpos.tracks import PairTrack, Track, interpolate, whole_seconds

SEEDS = st.integers(0, 2**32 - 1)


def random_team(seed: int, nodes: int = 4, seconds: int = 12) -> dict[int, Track]:
    rng = np.random.default_rng(seed)
    times = np.arange(seconds + 1.0)
    return {
        node: Track(
            times,
            rng.uniform(-20, 20, times.size),
            rng.uniform(-20, 20, times.size),
            rng.uniform(-9, 9, times.size),
        )
        for node in range(1, nodes + 1)
    }


def moved(tracks: dict[int, Track], angle: float, x: float, y: float) -> dict[int, Track]:
    c, s = math.cos(angle), math.sin(angle)
    return {
        n: Track(
            t.time_s,
            c * t.x_m - s * t.y_m + x,
            s * t.x_m + c * t.y_m + y,
            t.heading_rad + angle,
        )
        for n, t in tracks.items()
    }


def best_fit_by_trying_angles(p: np.ndarray, q: np.ndarray) -> float:
    """Sum of squares after the best rotation, found by search, not by formula."""
    p, q = p - p.mean(axis=0), q - q.mean(axis=0)

    def cost(angle: float) -> float:
        c, s = math.cos(angle), math.sin(angle)
        return float(((p @ np.array([[c, s], [-s, c]]) - q) ** 2).sum())

    low, high = min(
        ((a - 0.02, a + 0.02) for a in np.arange(-math.pi, math.pi, 0.02)),
        key=lambda bounds: cost(sum(bounds) / 2),
    )
    for _ in range(80):
        left, right = low + (high - low) / 3, high - (high - low) / 3
        low, high = (low, right) if cost(left) < cost(right) else (left, high)
    return cost(low)


@given(SEEDS)
@settings(max_examples=15)
def test_all_figures_are_what_the_sentences_of_the_run_format_give(seed: int) -> None:
    truth, estimate = random_team(seed), random_team(seed + 1)
    rng = np.random.default_rng(seed)
    times = truth[1].time_s
    pairs = {
        (i, j): PairTrack(times, rng.uniform(0, 30, times.size), rng.uniform(0.1, 3, times.size))
        for i in truth
        for j in truth
        if i < j
    }

    metrics = evaluate(estimate, truth, pairs)

    distance, body, nees, shape = [], [], [], []
    for k in range(times.size):
        p = {n: np.array([t.x_m[k], t.y_m[k]]) for n, t in estimate.items()}
        q = {n: np.array([t.x_m[k], t.y_m[k]]) for n, t in truth.items()}
        for i in p:
            for j in p:
                if i < j:
                    true = math.dist(q[i], q[j])
                    distance.append((math.dist(p[i], p[j]) - true) ** 2)
                    nees.append(
                        ((pairs[i, j].distance_m[k] - true) / pairs[i, j].sigma_distance_m[k]) ** 2
                    )
                if i != j:
                    seen = complex(*(p[j] - p[i])) * np.exp(-1j * estimate[i].heading_rad[k])
                    really = complex(*(q[j] - q[i])) * np.exp(-1j * truth[i].heading_rad[k])
                    body.append(abs(seen - really) ** 2)
        total = best_fit_by_trying_angles(np.array(list(p.values())), np.array(list(q.values())))
        shape.append(total / len(p))

    assert metrics.relative_distance_rmse_m == pytest.approx(math.sqrt(np.mean(distance)))
    assert metrics.body_frame_rmse_m == pytest.approx(math.sqrt(np.mean(body)))
    assert metrics.nees_distance == pytest.approx(np.mean(nees))
    assert metrics.relative_position_rmse_m == pytest.approx(math.sqrt(np.mean(shape)), rel=1e-6)
    assert metrics.epochs == times.size


@given(SEEDS, st.floats(-10, 10), st.floats(-100, 100), st.floats(-100, 100))
@settings(max_examples=20)
def test_the_frame_of_the_estimate_changes_nothing(
    seed: int, angle: float, x: float, y: float
) -> None:
    truth, estimate = random_team(seed), random_team(seed + 1)
    before, after = evaluate(estimate, truth), evaluate(moved(estimate, angle, x, y), truth)
    assert after.relative_distance_rmse_m == pytest.approx(before.relative_distance_rmse_m)
    assert after.relative_position_rmse_m == pytest.approx(before.relative_position_rmse_m)
    assert after.body_frame_rmse_m == pytest.approx(before.body_frame_rmse_m)


def test_the_truth_in_another_frame_scores_zero() -> None:
    truth = random_team(5)
    metrics = evaluate(moved(truth, 2.0, 30.0, -7.0), truth)
    assert metrics.relative_distance_rmse_m == pytest.approx(0.0, abs=1e-12)
    assert metrics.relative_position_rmse_m == pytest.approx(0.0, abs=1e-12)
    assert metrics.body_frame_rmse_m == pytest.approx(0.0, abs=1e-12)


def test_a_mirror_image_keeps_its_distances_and_is_still_wrong() -> None:
    truth = random_team(6)
    mirrored = {n: Track(t.time_s, t.x_m, -t.y_m, -t.heading_rad) for n, t in truth.items()}
    metrics = evaluate(mirrored, truth)
    assert metrics.relative_distance_rmse_m == pytest.approx(0.0, abs=1e-12)
    assert metrics.relative_position_rmse_m > 1.0


def test_two_nodes_have_no_aligned_position_error() -> None:
    metrics = evaluate(random_team(1, nodes=2), random_team(2, nodes=2))
    assert math.isnan(metrics.relative_position_rmse_m)
    assert math.isfinite(metrics.relative_distance_rmse_m)


def still(times: list[float], x_m: float, y_m: float = 0.0) -> Track:
    return Track(times, [x_m] * len(times), [y_m] * len(times), [0.0] * len(times))


def test_rows_up_to_two_seconds_apart_are_interpolated_and_wider_gaps_are_not() -> None:
    truth = {1: still(list(range(11)), 0.0), 2: still(list(range(11)), 5.0)}
    rows = [0.5, 2.5, 4.6, 6.6, 8.0]
    estimate = {1: still(rows, 0.0), 2: still(rows, 6.0)}
    # Whole seconds inside [0.5, 2.5], [4.6, 6.6], [6.6, 8]; nothing inside the 2.1 s gap.
    assert evaluate(estimate, truth).time_s.tolist() == [1.0, 2.0, 5.0, 6.0, 7.0, 8.0]


def test_a_lone_row_on_a_whole_second_counts() -> None:
    truth = {1: still([10.0], 0.0), 2: still([10.0], 5.0)}
    estimate = {1: still([3.0, 10.0, 20.0], 0.0), 2: still([10.0], 6.0)}
    metrics = evaluate(estimate, truth)
    assert metrics.time_s.tolist() == [10.0]
    assert metrics.relative_distance_rmse_m == pytest.approx(1.0)


def test_positions_are_interpolated_linearly() -> None:
    truth = {1: still([0.0, 1.0, 2.0], 0.0), 2: still([0.0, 1.0, 2.0], 10.0)}
    estimate = {1: still([0.5, 1.5], 0.0), 2: Track([0.5, 1.5], [10.0, 14.0], [0.0, 0.0])}
    assert evaluate(estimate, truth).relative_distance_rmse_m == pytest.approx(2.0)


def test_headings_are_interpolated_the_short_way_round() -> None:
    times = [0.5, 1.5]
    truth = {1: Track([1.0], [0.0], [0.0], [math.pi]), 2: Track([1.0], [10.0], [0.0], [math.pi])}
    turning = [math.pi - 0.1, -math.pi + 0.1]
    estimate = {
        1: Track(times, [0.0, 0.0], [0.0, 0.0], turning),
        2: Track(times, [10.0, 10.0], [0.0, 0.0], turning),
    }
    assert evaluate(estimate, truth).body_frame_rmse_m == pytest.approx(0.0, abs=1e-9)


def test_rows_in_any_order_give_the_same_figures() -> None:
    truth, estimate = random_team(3), random_team(4)
    order = np.random.default_rng(0).permutation(truth[1].time_s.size)
    shuffled = {
        n: Track(t.time_s[order], t.x_m[order], t.y_m[order], t.heading_rad[order])
        for n, t in estimate.items()
    }
    assert evaluate(shuffled, truth).relative_distance_rmse_m == pytest.approx(
        evaluate(estimate, truth).relative_distance_rmse_m
    )


def test_an_unknown_true_heading_leaves_the_other_figures_alone() -> None:
    estimate = random_team(8)
    truth = {n: Track(t.time_s, t.x_m, t.y_m) for n, t in random_team(9).items()}
    metrics = evaluate(estimate, truth)
    assert math.isnan(metrics.body_frame_rmse_m)
    assert math.isfinite(metrics.relative_position_rmse_m)


def test_every_pair_counts_as_often_as_it_was_seen() -> None:
    seen_often, seen_once = list(range(10)), [0]
    truth = {
        1: still(seen_often, 0.0),
        2: still(seen_often, 4.0),
        3: still(seen_once, 0.0, 3.0),
    }
    estimate = {**truth, 2: still(seen_often, 5.0)}
    metrics = evaluate(estimate, truth)
    assert metrics.pairs[1, 2].epochs == 10
    assert metrics.pairs[1, 3].epochs == 1
    errors = [1.0] * 10 + [0.0] + [math.hypot(5, 3) - 5.0]
    assert metrics.relative_distance_rmse_m == pytest.approx(math.sqrt(np.mean(np.square(errors))))


def test_a_pair_reported_the_other_way_round_is_the_same_pair() -> None:
    truth = {1: still([0.0], 0.0), 2: still([0.0], 5.0)}
    pairs = {(2, 1): PairTrack([0.0], [6.0], [0.5])}
    assert evaluate(truth, truth, pairs).nees_distance == pytest.approx(4.0)


def test_rows_that_claim_certainty_are_left_out_of_the_nees_and_counted() -> None:
    truth = {1: still([0.0, 1.0, 9.0], 0.0), 2: still([0.0, 1.0, 9.0], 5.0)}
    pairs = {
        (2, 1): PairTrack([0.0, 1.0, 9.0], [5.5, 6.0, 6.0], [0.0, 0.5, math.nan]),
        (1, 7): PairTrack([0.0], [5.5], [0.0]),
    }
    metrics = evaluate(truth, truth, pairs)
    assert metrics.nees_distance == pytest.approx(4.0)
    assert metrics.nees_left_out == 1, "unknown is not certain, and node 7 has no truth"
    assert evaluate(truth, truth).nees_left_out == 0


def test_nothing_in_common_is_no_figure_and_no_exception() -> None:
    metrics = evaluate(random_team(1), {})
    assert math.isnan(metrics.relative_distance_rmse_m)
    assert metrics.epochs == 0


def test_seeds_give_a_mean_with_its_standard_error() -> None:
    mean, error = over_seeds([1.0, 2.0, 3.0])
    assert mean == pytest.approx(2.0)
    assert error == pytest.approx(1.0 / math.sqrt(3.0))


@pytest.mark.parametrize("seed", range(20))
def test_the_seconds_of_tracks_are_all_at_which_they_have_a_value_and_few_others(seed):
    rng = np.random.default_rng(seed)
    steps = rng.choice([0.02, 0.5, 1.0, 1.9, 2.0, 2.5, 7.0], (2, 60))
    tracks = [Track(t, t, t, t) for t in np.cumsum(steps, axis=1) - 3.0 * rng.random()]
    every = np.arange(-10.0, 500.0)
    known = [np.isfinite(interpolate(t.time_s, t.x_m, every)) for t in tracks]
    assert set(every[known[0] | known[1]]) <= set(whole_seconds(tracks))
    assert np.all(np.diff(whole_seconds(tracks)) >= 1.0)


def test_a_row_of_a_week_later_costs_neither_memory_nor_time():
    time_s = np.append(np.arange(30.0), 604_000.0)
    tracks = {n: Track(time_s, time_s, n + 0.0 * time_s, time_s) for n in range(20)}
    assert whole_seconds(tracks.values()).size == 33
    tracemalloc.start()
    assert evaluate(tracks, tracks).epochs == 31
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 10e6


def test_a_triangle_counts_as_mirrored_where_its_pairs_are_ok_and_it_is_no_line() -> None:
    truth = np.repeat(np.array([[0.0, 10.0, 5.0 + 4.0j, 80.0]]), 5, axis=0)
    told = truth.copy()
    told[1:4, 2] = 5.0 - 4.0j
    told[4, 2] = 5.0 - 0.5j
    ok = np.ones((5, 4, 4), dtype=bool)
    ok[3, 0, 2] = ok[3, 2, 0] = False
    # The first three are the triangle of each of them; the fourth has one with two of them.
    assert share_on_wrong_side(told, truth, ok) == pytest.approx((2 * 4 + 1) / (4 * 4 + 1))
    # A rotated team is none.
    assert share_on_wrong_side(1j * truth + 3.0, truth, ok) == 0.0
    assert math.isnan(share_on_wrong_side(told[:, :2], truth[:, :2], ok[:, :2, :2]))
