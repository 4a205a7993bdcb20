"""A walk without reports: its velocity by the positions that ranges give."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relpos.fusion.models.motion import WALK_S, unseen_variance
from relpos.fusion.models.unseen_walk import AXIS_M2_S2, UnseenWalk

STEP_S, SIGMA_M = 0.3, 0.1


def test_a_filter_that_knows_positions_alone_follows_a_walk_by_the_velocity_beside_it() -> None:
    """Positions are measured; errors of both are as large as the covariances say."""
    rng = np.random.default_rng(3)
    kept = math.exp(-STEP_S / WALK_S)
    errors: list[tuple[float, float]] = []
    for _ in range(60):
        velocity, place = math.sqrt(0.1) * rng.normal(size=2), np.zeros(2)
        walk, own, spread = UnseenWalk(0.0, np.zeros(2)), np.zeros(2), 1e-6 * np.eye(2)
        for k in range(60):
            fresh = kept * velocity
            fresh += math.sqrt(AXIS_M2_S2 * (1.0 - kept**2)) * rng.normal(size=2)
            place, velocity = place + 0.5 * STEP_S * (velocity + fresh), fresh
            way_m, grown = walk.walk(STEP_S)
            own, before = own + way_m, spread + grown
            gain = before @ np.linalg.inv(before + SIGMA_M**2 * np.eye(2))
            moved_m = gain @ (place + SIGMA_M * rng.normal(size=2) - own)
            own, spread = own + moved_m, before - gain @ before
            walk.correct(moved_m, before, spread)
            if k > 10:
                off, slow = own - place, walk.velocity_m_s - velocity
                errors.append(
                    (
                        off @ np.linalg.solve(spread, off),
                        slow @ np.linalg.solve(walk._variance, slow),
                    )
                )
    assert np.mean(errors, axis=0) / 2.0 == pytest.approx([1.0, 1.0], abs=0.15)


def test_a_walk_that_nobody_ranges_is_as_uncertain_as_a_walk_of_any_velocity() -> None:
    walk, total_m2 = UnseenWalk(0.0, np.array([1.0, 0.0])), 0.0
    way_m = np.zeros(2)
    for _ in range(200):
        gone_m, grown = walk.walk(0.5)
        way_m, total_m2 = way_m + gone_m, total_m2 + float(grown.trace())
    assert way_m == pytest.approx([WALK_S, 0.0], abs=1e-6)
    assert total_m2 == pytest.approx(unseen_variance(100.0), rel=0.03)


def test_a_position_that_something_else_made_certain_leaves_a_velocity_with_a_variance() -> None:
    walk = UnseenWalk(0.0, np.zeros(2))
    for _ in range(20):
        walk.walk(1.0)
        walk.correct(np.array([0.3, 0.0]), 1e-3 * np.eye(2), 1e-5 * np.eye(2))
        assert (np.linalg.eigvalsh(walk._variance) > 0.0).all()
        assert np.hypot(*walk.velocity_m_s) < 30.0


def test_who_walks_faces_the_way_and_who_stands_may_have_turned() -> None:
    walk = UnseenWalk(0.0, np.array([0.0, 1.0]))
    heading, sigma = walk.facing(20.0, 0.0, 0.1)
    assert heading == pytest.approx(math.pi / 2)
    assert sigma < 0.5
    assert walk.facing(0.1, 0.3, 0.1)[0] == 0.3
    heading, sigma = UnseenWalk(0.0, np.zeros(2)).facing(20.0, 0.3, 0.1)
    assert heading == 0.3
    assert sigma > math.radians(45.0)
