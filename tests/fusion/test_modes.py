"""Modes, rings and regions of weighted hypotheses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relpos.evaluation.regions import Region
from relpos.fusion.estimator import MAX_ALTERNATIVES, Alternative, Shape
from relpos.fusion.modes import alternatives_of, belief_of, relative_poses

TWO_PI = 2.0 * math.pi


def alternative(
    probability: float, x: float, y: float, major: float, minor: float, angle: float = 0.0,
    shape: Shape = Shape.ELLIPSE,
) -> Alternative:  # fmt: skip
    return Alternative(0.0, 0, probability, 2, x, y, 0.0, major, minor, angle, shape)


def spread(count: int, nodes: int, sigma_m: float) -> np.ndarray:
    return np.broadcast_to(sigma_m**2 * np.eye(2), (count, nodes, 2, 2)).copy()


def test_the_region_of_an_ellipse_has_the_area_of_the_chi_square_ellipse() -> None:
    region = Region.of([alternative(1.0, 3.0, -2.0, 2.0, 0.5, 0.7)])
    # P(chi2_2 < c) = 1 - exp(-c/2): c = 4.605 for 90 %.
    assert region.area_m2 == pytest.approx(math.pi * 4.605 * 2.0 * 0.5, rel=0.05)


def test_the_region_of_a_ring_is_a_band_round_it() -> None:
    region = Region.of([alternative(1.0, 1.0, 1.0, 6.0, 0.3, shape=Shape.RING)])
    # 1.645 sigma to either side of a thin ring hold 90 %.
    assert region.area_m2 == pytest.approx(TWO_PI * 6.0 * 2.0 * 1.645 * 0.3, rel=0.05)
    assert region.contains(1.0, 7.1)
    assert not region.contains(1.0, 1.0)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_region_holds_the_stated_fraction_of_positions(share: float) -> None:
    rows = [
        alternative(0.3, 0.0, 0.0, 2.0, 0.5, 0.4),
        alternative(0.2, 8.0, 0.0, 0.5, 0.5),
        alternative(0.5, 0.0, 0.0, 5.0, 0.4, shape=Shape.RING),
    ]
    region = Region.of(rows, share)
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(2000):
        a = rows[rng.choice(3, p=[0.3, 0.2, 0.5])]
        u, v = rng.standard_normal(2)
        if a.shape is Shape.RING:
            radius, turn = a.sigma_major_m + a.sigma_minor_m * u, TWO_PI * rng.random()
            place = (radius * math.cos(turn), radius * math.sin(turn))
        else:
            c, s = math.cos(a.sigma_angle_rad), math.sin(a.sigma_angle_rad)
            along, across = a.sigma_major_m * u, a.sigma_minor_m * v
            place = (a.x_m + c * along - s * across, a.y_m + s * along + c * across)
        inside += region.contains(*place)
    assert inside / 2000 == pytest.approx(share, abs=0.035)


def test_hypotheses_all_round_a_node_are_one_mode_with_a_ring() -> None:
    turn = TWO_PI * np.arange(40) / 40
    poses = np.zeros((40, 2, 3))
    poses[:, 1, 0], poses[:, 1, 1] = 5.0 * np.cos(turn), 5.0 * np.sin(turn)
    rows = alternatives_of(7.0, (1, 2), np.full(40, 1 / 40), poses, spread(40, 2, 0.2))
    assert [r.node for r in rows] == [1, 2]
    first, second = rows
    assert first.shape is Shape.ELLIPSE
    assert second.shape is Shape.RING
    assert second.probability == pytest.approx(1.0)
    assert second.sigma_major_m == pytest.approx(5.0, abs=0.05)
    assert second.sigma_minor_m == pytest.approx(0.2, abs=0.05)
    assert math.hypot(second.x_m, second.y_m) < 0.05


def test_half_a_circle_is_no_ring() -> None:
    turn = math.pi * np.arange(40) / 40
    poses = np.zeros((40, 1, 3))
    poses[:, 0, 0], poses[:, 0, 1] = 5.0 * np.cos(turn), 5.0 * np.sin(turn)
    rows = alternatives_of(0.0, (2,), np.full(40, 1 / 40), poses, spread(40, 1, 0.2))
    assert all(r.shape is Shape.ELLIPSE for r in rows)


def test_a_mirror_image_is_a_second_mode_with_its_probability() -> None:
    poses = np.zeros((3, 2, 3))
    poses[:, 0] = ((4.0, 3.0, 0.0), (4.1, 3.1, 0.0), (4.0, -3.0, 0.0))
    poses[:, 1] = ((8.0, 1.0, 0.0), (8.0, 1.1, 0.0), (8.0, -1.0, 0.0))
    weights = np.array([0.4, 0.3, 0.3])
    rows = alternatives_of(0.0, (2, 3), weights, poses, spread(3, 2, 0.1))
    assert {(r.alternative, round(r.probability, 6)) for r in rows} == {(0, 0.7), (1, 0.3)}
    assert next(r.y_m for r in rows if r.alternative == 1 and r.node == 2) == pytest.approx(-3.0)


def test_never_more_modes_than_may_be_listed_and_their_probabilities_sum_to_one() -> None:
    rng = np.random.default_rng(1)
    poses = np.zeros((90, 2, 3))
    poses[:, :, :2] = rng.uniform(-30.0, 30.0, (90, 2, 2))
    weights = rng.random(90)
    weights /= weights.sum()
    rows = alternatives_of(0.0, (2, 3), weights, poses, spread(90, 2, 0.3))
    by_rank = {r.alternative: r.probability for r in rows}
    assert len(by_rank) <= MAX_ALTERNATIVES
    assert sum(by_rank.values()) == pytest.approx(1.0)
    assert list(by_rank.values()) == sorted(by_rank.values(), reverse=True)


def test_a_belief_names_the_likeliest_place_and_how_much_speaks_for_it() -> None:
    poses = np.array([[2.0, 0.0, 0.1], [2.1, 0.1, 0.1], [-2.0, 0.0, 0.1]])
    covariances = np.broadcast_to(0.01 * np.eye(3), (3, 3, 3))
    belief = belief_of(np.array([0.3, 0.3, 0.4]), poses, covariances)
    assert belief.x_m == pytest.approx(2.05)
    assert belief.mode_weight == pytest.approx(0.6)
    # The other place is 4 m away with weight 0.4: the spread about the best one says so.
    assert belief.covariance_m2[0, 0] == pytest.approx(0.4 * 4.05**2, rel=0.02)


def test_a_heading_of_which_nothing_is_known_has_the_spread_of_any_direction() -> None:
    poses = np.zeros((24, 3))
    poses[:, 2] = TWO_PI * np.arange(24) / 24
    belief = belief_of(np.full(24, 1 / 24), poses, np.tile(0.01 * np.eye(3), (24, 1, 1)))
    assert belief.sigma_heading_rad == pytest.approx(math.pi / math.sqrt(3.0))


def test_the_covariance_of_a_pose_seen_from_another_is_that_of_many_draws() -> None:
    rng = np.random.default_rng(5)
    root = 0.02 * rng.standard_normal((6, 6))
    poses = np.array([[[1.0, 2.0, 0.6], [5.0, -1.0, -2.0]]])
    seen, covariance = relative_poses(poses, (root @ root.T)[None], 0, 1)
    drawn = poses.reshape(1, 6) + rng.standard_normal((200_000, 6)) @ root.T
    off = (drawn[:, 3] + 1j * drawn[:, 4]) - (drawn[:, 0] + 1j * drawn[:, 1])
    body = off * np.exp(-1j * drawn[:, 2])
    sample = np.column_stack((body.real, body.imag, drawn[:, 5] - drawn[:, 2]))
    assert seen[0] == pytest.approx(sample.mean(axis=0), abs=0.01)
    assert covariance[0] == pytest.approx(np.cov(sample.T), abs=2e-4)
