"""The metrics of ISO/IEC 18305 against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relpos.evaluation import iso18305, summary
from relpos.evaluation.iso18305 import Frame, assess, magnitudes, percentile
from relpos.tracks import Track

SECONDS = np.arange(0.0, 5.0)
NOTHING = np.full(5, np.nan)


def straight(shift_m: tuple[float, float] = (0.0, 0.0), z_m: np.ndarray = NOTHING) -> Track:
    return Track(SECONDS, SECONDS + shift_m[0], 2.0 * SECONDS + shift_m[1], NOTHING, z_m)


def turned(track: Track, angle_rad: float, shift_m: tuple[float, float]) -> Track:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return Track(
        track.time_s,
        c * track.x_m - s * track.y_m + shift_m[0],
        s * track.x_m + c * track.y_m + shift_m[1],
        track.heading_rad + angle_rad,
        track.z_m,
    )


def test_magnitudes_are_those_worked_out_by_hand() -> None:
    # 1, 2, 3, 4: mean 2.5, mean square 30 / 4, variance 7.5 - 6.25; half of them are at most 2,
    # and only 4 is not exceeded by 95 %.
    found = magnitudes(np.array([4.0, 1.0, 3.0, 2.0, math.nan]))
    assert found.count == 4
    assert found.mean_m == pytest.approx(2.5)
    assert found.rms_m == pytest.approx(math.sqrt(7.5))
    assert found.variance_m2 == pytest.approx(1.25)
    assert found.rms_m**2 == pytest.approx(found.mean_m**2 + found.variance_m2)
    assert (found.e50_m, found.e95_m, found.max_m) == (2.0, 4.0, 4.0)


def test_a_percentile_is_an_error_that_occurred_and_holds_its_share() -> None:
    values = np.arange(1.0, 21.0)
    assert percentile(values, 0.95) == 19.0
    assert percentile(values, 0.5) == 10.0
    assert percentile(np.append(values, 21.0), 0.95) == 20.0


def test_error_vectors_give_mean_covariance_and_absolute_mean() -> None:
    # Errors (3, 4), (3, 4), (3, 4), (0, 0), (0, 0): lengths 5, 5, 5, 0, 0.
    truth = straight()
    off = np.array([1.0, 1.0, 1.0, 0.0, 0.0])
    estimate = Track(SECONDS, truth.x_m + 3.0 * off, truth.y_m + 4.0 * off)
    found = assess({7: estimate}, {7: truth}, common_frame=True).frames[Frame.AS_GIVEN]
    np.testing.assert_allclose(found.mean_error_m[:2], [1.8, 2.4])
    assert found.absolute_mean_m == pytest.approx(3.0)
    # Mean squares 27/5, 48/5, 36/5 less the products of the means.
    np.testing.assert_allclose(
        found.covariance_m2[:2, :2], [[5.4 - 3.24, 7.2 - 4.32], [7.2 - 4.32, 9.6 - 5.76]]
    )
    assert found.horizontal.mean_m == pytest.approx(3.0)
    assert found.horizontal.rms_m == pytest.approx(math.sqrt(15.0))
    assert (found.horizontal.e50_m, found.horizontal.e95_m) == (5.0, 5.0)
    assert found.vertical.count == found.spherical.count == 0
    assert np.isnan(found.covariance_m2[2]).all()


def test_vertical_and_spherical_errors_are_over_each_ones_own_start() -> None:
    truth = straight(z_m=np.array([1.3, 1.3, 4.3, 4.3, 4.3]))
    # 10 m too high throughout does not count; then 0, 0, 1, -2, 2 m of it are errors.
    estimate = straight((0.0, 2.0), 10.0 + truth.z_m + np.array([0.0, 0.0, 1.0, -2.0, 2.0]))
    found = assess({1: estimate}, {1: truth}, common_frame=True).frames[Frame.AS_GIVEN]
    assert found.vertical.mean_m == pytest.approx(1.0)
    assert found.vertical.rms_m == pytest.approx(math.sqrt(9.0 / 5.0))
    assert (found.vertical.e50_m, found.vertical.e95_m) == (pytest.approx(1.0), pytest.approx(2.0))
    assert found.mean_error_m[2] == pytest.approx(0.2)
    assert found.spherical.e95_m == pytest.approx(math.sqrt(8.0))
    assert found.spherical.rms_m == pytest.approx(math.sqrt(4.0 + 9.0 / 5.0))


def test_an_estimate_displaced_as_a_whole_has_no_error_after_one_alignment_of_the_run() -> None:
    truth = {1: straight(), 2: straight((3.0, 0.0)), 3: straight((0.0, -4.0))}
    estimate = {node: turned(track, 1.1, (50.0, -7.0)) for node, track in truth.items()}
    found = assess(estimate, truth, common_frame=False)
    assert Frame.AS_GIVEN not in found.frames
    assert found.headline is Frame.PER_RUN
    for frame in (Frame.PER_RUN, Frame.PER_EPOCH):
        assert found.frames[frame].horizontal.max_m == pytest.approx(0.0, abs=1e-9)


def test_an_estimate_that_keeps_turning_is_right_only_after_an_alignment_each_second() -> None:
    truth = {1: straight(), 2: straight((3.0, 0.0)), 3: straight((0.0, -4.0))}
    estimate = {}
    for node, track in truth.items():
        parts = [turned(track, 0.3 * k, (0.0, 0.0)) for k in range(5)]
        estimate[node] = Track(
            SECONDS,
            [p.x_m[k] for k, p in enumerate(parts)],
            [p.y_m[k] for k, p in enumerate(parts)],
        )
    found = assess(estimate, truth, common_frame=False)
    assert found.frames[Frame.PER_EPOCH].horizontal.max_m == pytest.approx(0.0, abs=1e-9)
    assert found.frames[Frame.PER_RUN].horizontal.rms_m > 1.0


def test_two_nodes_say_nothing_of_a_shape() -> None:
    truth = {1: straight(), 2: straight((3.0, 0.0))}
    assert Frame.PER_EPOCH not in assess(truth, truth, common_frame=True).frames


def test_a_mirrored_estimate_has_an_error() -> None:
    truth = {1: straight(), 2: straight((3.0, 0.0)), 3: straight((0.0, -4.0))}
    mirrored = {n: Track(t.time_s, t.x_m, -t.y_m) for n, t in truth.items()}
    found = assess(mirrored, truth, common_frame=False)
    assert found.frames[Frame.PER_EPOCH].horizontal.rms_m > 1.0


def test_landmark_presses_are_tested_at_their_own_times() -> None:
    presses = Track([10.37, 55.21, 80.9], [0.0, 10.0, 10.0], [0.0, 0.0, 10.0])
    walked = Track(np.arange(0.0, 100.0), np.interp(np.arange(100.0), presses.time_s, presses.x_m),
                   np.interp(np.arange(100.0), presses.time_s, presses.y_m))  # fmt: skip
    found = assess({3: walked}, {3: presses}, common_frame=True)
    assert found.frames[Frame.AS_GIVEN].horizontal.count == 3
    assert found.frames[Frame.AS_GIVEN].horizontal.max_m < 0.1
    assert found.coverage == 1.0


def test_relative_accuracy_is_of_the_vectors_between_two_nodes() -> None:
    truth = {1: straight(), 2: straight((3.0, 0.0))}
    # Both are 2 m off: together, then the second alone.
    together = {n: Track(t.time_s, t.x_m + 2.0, t.y_m) for n, t in truth.items()}
    found = assess(together, truth, common_frame=True)
    assert found.frames[Frame.AS_GIVEN].horizontal.mean_m == pytest.approx(2.0)
    assert found.relative.max_m == pytest.approx(0.0, abs=1e-12)
    found = assess({1: truth[1], 2: together[2]}, truth, common_frame=True)
    assert found.relative.mean_m == pytest.approx(2.0)
    assert found.nodes[2].horizontal.e95_m == pytest.approx(2.0)
    assert found.nodes[1].horizontal.e95_m == pytest.approx(0.0)


def test_coverage_counts_where_a_node_was_located() -> None:
    truth = {1: straight(), 2: straight((3.0, 0.0))}
    located = {1: truth[1], 2: Track(SECONDS, np.where(SECONDS < 1.5, np.nan, 4.0), SECONDS)}
    assert assess(truth, truth, common_frame=True, located=located).coverage == pytest.approx(0.8)


def test_nothing_in_common_is_nothing_known_and_valid_json() -> None:
    found = assess({1: straight()}, {2: straight()}, common_frame=True)
    assert not found.known
    assert found.coverage == 0.0
    document = summary.iso_as_json(found)
    assert document["headline"] is None
    assert document["frames"] == dict.fromkeys(iso18305.Frame)
