"""Regions of ambiguous nodes, held against the truth."""

import math

import numpy as np
import pytest

from relpos.evaluation import regions
from relpos.fusion.estimator import Alternative, Estimate, NodeEstimate, NodeStatus, Shape
from relpos.measurements import Range
from relpos.tracks import Track

SECONDS = np.arange(400.0)


def still(x_m, y_m, heading_rad=0.0):
    ones = np.ones(SECONDS.size)
    return Track(SECONDS, x_m * ones, y_m * ones, heading_rad * ones)


def located(node):
    return NodeEstimate(node, 0.0, 0.0, 0.0, 0.01, 0.01, 0.0, 0.1, NodeStatus.OK)


def ambiguous(node):
    return NodeEstimate(node, 0.0, 0.0, 0.0, 9.0, 9.0, 0.0, 1.0, NodeStatus.AMBIGUOUS)


def estimates(alternatives_at):
    return [
        Estimate(t, (located(1), ambiguous(2)), (), tuple(alternatives_at(t))) for t in SECONDS[1:]
    ]


def ellipse(time_s, rank, probability, x_m, y_m, sigma_m):
    return Alternative(time_s, rank, probability, 2, x_m, y_m, 0.0, sigma_m, sigma_m, 0.0)


RANGES = [Range(1.0, 1, 2, 10.0)]


def test_a_region_of_drawn_places_holds_the_truth_in_nine_of_ten():
    rng = np.random.default_rng(4)
    truth = {1: still(0.0, 0.0), 2: still(6.0, 3.0)}

    def drawn(t):
        side = 1.0 if rng.random() < 0.7 else -1.0
        # The estimate is mirrored with its stated probability.
        off = rng.standard_normal(2)
        yield ellipse(t, 0, 0.7, 6.0 + off[0], side * (3.0 + off[1]), 1.0)
        yield ellipse(t, 1, 0.3, 6.0 + off[0], -side * (3.0 + off[1]), 1.0)

    summary = regions.summarise(estimates(drawn), truth, RANGES, starts_known=True)
    assert summary is not None
    assert summary.looks == 399
    assert summary.coverage.low < 0.9 < summary.coverage.high
    assert summary.blind_m2 == pytest.approx(0.9 * math.pi * 100.0)
    # Two Gaussians that do not touch: each up to the density where 0.9 of both is inside.
    assert summary.area_m2 < 2.0 * 2.0 * math.pi * math.log(10.0) * 1.05


def test_the_frame_is_the_first_located_nodes_pose_without_priors():
    truth = {1: still(5.0, 5.0, math.pi / 2), 2: still(5.0, 8.0)}
    ahead = estimates(lambda t: [ellipse(t, 0, 1.0, 3.0, 0.0, 0.2)])
    behind = estimates(lambda t: [ellipse(t, 0, 1.0, -3.0, 0.0, 0.2)])
    for estimate, share in ((ahead, 1.0), (behind, 0.0)):
        summary = regions.summarise(estimate, truth, RANGES, starts_known=False)
        assert summary is not None
        assert summary.coverage.share == share


def test_a_truth_is_not_guessed_between_rows_far_apart():
    """Two presses 400 s apart: nobody knows where the wearer was in between."""
    presses = Track(np.array([1.0, 399.0]), np.array([6.0, -6.0]), np.zeros(2))
    estimate = estimates(lambda t: [ellipse(t, 0, 1.0, 6.0, 0.0, 0.2)])
    summary = regions.summarise(estimate, {2: presses}, RANGES, starts_known=True)
    assert summary is not None
    assert (summary.looks, summary.coverage.share) == (2, 0.5)


def test_the_order_of_the_rows_of_truth_does_not_matter():
    x_m, order = np.linspace(0.0, 40.0, SECONDS.size), np.random.default_rng(1).permutation(400)
    rows = Track(SECONDS[order], x_m[order], np.zeros(400))
    estimate = estimates(lambda t: [ellipse(t, 0, 1.0, 0.1003 * t, 0.0, 0.2)])
    summary = regions.summarise(estimate, {2: rows}, RANGES, starts_known=True)
    assert summary is not None
    assert (summary.looks, summary.coverage.share) == (399, 1.0)


def test_without_the_true_start_of_the_frames_node_nothing_is_said_of_regions():
    """Neither another node nor a later pose says where the frame lies in the truth."""
    begun = located(1)
    later = NodeEstimate(3, 4.0, 0.0, 0.0, 0.01, 0.01, 0.0, 0.1, NodeStatus.OK)
    estimate = [
        Estimate(t, (begun, ambiguous(2), later) if t > 1.0 else (begun, ambiguous(2)), (),
                 (ellipse(t, 0, 1.0, 1.0, 3.0, 0.2),))
        for t in SECONDS[1:]
    ]  # fmt: skip
    others = {2: still(5.0, 8.0), 3: still(9.0, 5.0)}
    assert regions.summarise(estimate, others, RANGES, starts_known=False) is None
    late = Track(SECONDS[200:], 0.1 * SECONDS[200:], np.zeros(200), np.zeros(200))
    with_late = {**others, 1: late}
    assert regions.summarise(estimate, with_late, RANGES, starts_known=False) is None


def test_a_rings_region_is_its_circumference_times_its_width():
    truth = {1: still(0.0, 0.0), 2: still(0.0, -5.0)}
    ring = estimates(
        lambda t: [Alternative(t, 0, 1.0, 2, 0.0, 0.0, 0.0, 5.0, 0.1, 0.0, Shape.RING)]
    )
    summary = regions.summarise(ring[:3], truth, RANGES, starts_known=True)
    assert summary is not None
    assert summary.rings == 1.0
    assert summary.coverage.share == 1.0
    assert summary.area_m2 == pytest.approx(2.0 * math.pi * 5.0 * 2.0 * 1.645 * 0.1, rel=0.05)


def test_an_unambiguous_estimate_has_no_summary():
    estimate = [Estimate(t, (located(1), located(2)), ()) for t in SECONDS]
    truth = {1: still(0.0, 0.0), 2: still(0.0, -5.0)}
    assert regions.summarise(estimate, truth, RANGES, starts_known=True) is None
