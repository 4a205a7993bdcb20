"""Motions that are not fused yet, composed onto the estimate, against the same done by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus, Parameter, pairs_of
from relpos.live.nowcast import Nowcast
from relpos.measurements import Motion


def node_estimate(node=1, x_m=2.0, y_m=1.0, heading_rad=0.5):
    return NodeEstimate(node, x_m, y_m, heading_rad, 0.04, 0.09, 0.01, 0.1, NodeStatus.OK)


def estimate(time_s, *nodes):
    nodes = nodes or (node_estimate(),)
    return Estimate(time_s, nodes, pairs_of(nodes))


def motion(time_s, dx_m=1.0, dy_m=0.2, dtheta_rad=0.3, node=1, sigmas=(0.05, 0.04, 0.02)):
    return Motion(time_s, node, dx_m, dy_m, dtheta_rad, *sigmas)


def composed(pose, *moves):
    """The textbook: rotate into the heading of the beginning, then turn."""
    x, y, heading = pose
    for dx, dy, turn in moves:
        x += math.cos(heading) * dx - math.sin(heading) * dy
        y += math.sin(heading) * dx + math.cos(heading) * dy
        heading += turn
    return x, y, heading


def assert_pose(at, pose):
    assert (at.x_m, at.y_m) == pytest.approx(pose[:2])
    assert math.remainder(at.heading_rad - pose[2], math.tau) == pytest.approx(0.0, abs=1e-9)


def test_motions_since_the_estimate_are_composed_in_order():
    nowcast = Nowcast()
    nowcast.add_motion(motion(1.0), 1)
    nowcast.add_estimate(estimate(1.0), 1)
    nowcast.add_motion(motion(2.0, 0.7, -0.1, -0.9), 2)
    nowcast.add_motion(motion(3.0, 1.1, 0.3, 0.4), 3)
    expected = composed((2.0, 1.0, 0.5), (0.7, -0.1, -0.9), (1.1, 0.3, 0.4))
    assert_pose(nowcast.node(1), expected)
    assert nowcast.newest_s(1) == 3.0


def test_only_the_rest_of_a_chord_after_the_estimate_is_composed():
    nowcast = Nowcast()
    nowcast.add_motion(motion(1.0), 1)
    nowcast.add_motion(motion(2.0, 1.0, 0.0, 0.8), 2)
    nowcast.add_estimate(estimate(1.75), 2)
    # A quarter of the chord, seen from the heading that three quarters of the turn have led to.
    c, s = math.cos(0.6), math.sin(0.6)
    assert_pose(nowcast.node(1), composed((2.0, 1.0, 0.5), (c * 0.25, -s * 0.25, 0.2)))


def test_cutting_a_chord_anywhere_leads_to_the_same_end():
    for cut in (0.1, 0.5, 0.9):
        start = composed((2.0, 1.0, 0.5), (cut * 1.0, cut * 0.4, cut * 0.8))
        nowcast = Nowcast()
        nowcast.add_motion(motion(1.0), 1)
        nowcast.add_motion(motion(2.0, 1.0, 0.4, 0.8), 2)
        at = replace(node_estimate(), x_m=start[0], y_m=start[1], heading_rad=start[2])
        nowcast.add_estimate(estimate(1.0 + cut, at), 2)
        assert_pose(nowcast.node(1), composed((2.0, 1.0, 0.5), (1.0, 0.4, 0.8)))


def test_a_motion_that_the_fusion_had_not_got_yet_counts_whole():
    nowcast = Nowcast()
    nowcast.add_motion(motion(1.0), 1)
    nowcast.add_motion(motion(2.0, 0.7, 0.0, 0.0), 2)
    # An estimate at 1.9 s came out before the motion up to 2 s had been worked off.
    nowcast.add_estimate(estimate(1.9), 1)
    assert_pose(nowcast.node(1), composed((2.0, 1.0, 0.5), (0.7, 0.0, 0.0)))


def test_a_newer_estimate_takes_the_place_of_what_was_composed():
    nowcast = Nowcast()
    nowcast.add_motion(motion(1.0), 1)
    nowcast.add_estimate(estimate(1.0), 1)
    nowcast.add_motion(motion(2.0), 2)
    moved = node_estimate(x_m=-4.0, y_m=0.5, heading_rad=-1.0)
    nowcast.add_estimate(estimate(2.0, moved), 2)
    assert_pose(nowcast.node(1), (-4.0, 0.5, -1.0))


def test_steps_are_as_long_as_the_estimator_has_learned():
    nowcast = Nowcast()
    nowcast.add_motion(motion(1.0), 1)
    learned = Parameter(1.0, 1, None, "step_scale", 0.8, 0.02)
    nowcast.add_estimate(replace(estimate(1.0), parameters=(learned,)), 1)
    nowcast.add_motion(motion(2.0, 1.0, -0.5, 0.3), 2)
    assert_pose(nowcast.node(1), composed((2.0, 1.0, 0.5), (0.8, -0.4, 0.3)))


def test_the_covariance_grows_as_a_filters_prediction():
    nowcast = Nowcast()
    nowcast.add_estimate(estimate(1.0), 0)
    nowcast.add_motion(motion(2.0, 1.0, 0.2, 0.3, sigmas=(0.3, 0.2, 0.1)), 1)
    nowcast.add_motion(motion(3.0, 0.8, -0.5, 0.6, sigmas=(0.1, 0.25, 0.05)), 2)

    covariance = np.zeros((3, 3))
    covariance[:2, :2] = [[0.04, 0.01], [0.01, 0.09]]
    covariance[2, 2] = 0.1**2
    heading = 0.5
    moves = (((1.0, 0.2, 0.3), (0.3, 0.2, 0.1)), ((0.8, -0.5, 0.6), (0.1, 0.25, 0.05)))
    for (dx, dy, turn), sigmas in moves:
        c, s = math.cos(heading), math.sin(heading)
        f = np.eye(3)
        f[0, 2], f[1, 2] = -(s * dx + c * dy), c * dx - s * dy
        r = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        covariance = f @ covariance @ f.T + r @ np.diag(np.square(sigmas)) @ r.T
        heading += turn
    at = nowcast.node(1)
    assert at.variance_x_m2 == pytest.approx(covariance[0, 0])
    assert at.variance_y_m2 == pytest.approx(covariance[1, 1])
    assert at.covariance_xy_m2 == pytest.approx(covariance[0, 1])
    assert at.sigma_heading_rad**2 == pytest.approx(covariance[2, 2])


def test_a_report_without_deviations_uses_the_papers():
    nowcast = Nowcast()
    nowcast.add_estimate(estimate(1.0, node_estimate(heading_rad=0.0)), 0)
    nowcast.add_motion(Motion(2.0, 1, 2.0, 0.0, 0.0), 1)
    grown = nowcast.node(1).variance_x_m2 - 0.04
    assert grown == pytest.approx((0.2 * 2.0) ** 2)


def test_a_pair_keeps_what_the_estimator_knows_of_the_two_together():
    two = (node_estimate(1, 0.0, 0.0, 0.0), node_estimate(2, 3.0, 4.0, 0.0))
    fused = estimate(1.0, *two)
    known = replace(fused.pairs[0], sigma_distance_m=0.01, sigma_bearing_rad=0.002)
    nowcast = Nowcast()
    nowcast.add_estimate(fused, 0)
    same = nowcast.pair(known)
    assert (same.distance_m, same.bearing_rad) == pytest.approx((5.0, math.atan2(4.0, 3.0)))
    assert same.sigma_distance_m == pytest.approx(0.01)
    assert same.sigma_bearing_rad == pytest.approx(0.002)
    # Node 1 goes 3 m ahead: the other is then 4 m to the left.
    nowcast.add_motion(Motion(2.0, 1, 3.0, 0.0, 0.0, 0.3, 0.1, 0.0), 1)
    after = nowcast.pair(known)
    assert (after.distance_m, after.bearing_rad) == pytest.approx((4.0, math.pi / 2))
    # Across the way: its own deviation and what its heading (0.1 rad) makes of 3 m.
    assert after.sigma_distance_m == pytest.approx(math.sqrt(0.01**2 + 0.1**2 + 0.3**2))


def test_a_node_without_estimate_has_no_pose():
    nowcast = Nowcast()
    nowcast.add_motion(motion(1.0, node=7), 1)
    assert nowcast.node(7) is None
    assert nowcast.newest_s(7) == 1.0
    assert nowcast.newest_s(8) is None
