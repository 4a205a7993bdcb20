"""What an estimate says of its pairs."""

from __future__ import annotations

import pytest

import relpos
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus, PairEstimate


def status_of(distance_m: float, sigma_m: float, *, missing: bool = False) -> NodeStatus:
    """Return the status of two nodes that are told 5 m apart."""
    one, other = (
        NodeEstimate(node, x_m, y_m, 0.0, 0.01, 0.01, 0.0, 0.1, NodeStatus.OK)
        for node, x_m, y_m in ((1, 1.0, 2.0), (2, 4.0, 6.0))
    )
    pair = PairEstimate(1, 2, distance_m, sigma_m, 0.9, 0.05)
    (status,) = Estimate(1.0, (one,) if missing else (one, other), (pair,)).pair_statuses()
    return status


def test_a_pair_whose_places_are_as_far_apart_as_its_distance_says_is_ok() -> None:
    assert status_of(5.1, 0.2) is NodeStatus.OK


def test_a_pair_whose_distance_is_uncertain_is_ambiguous() -> None:
    assert status_of(5.0, 0.7) is NodeStatus.AMBIGUOUS


def test_a_pair_whose_places_contradict_its_distance_is_ambiguous() -> None:
    assert status_of(5.7, 0.05) is NodeStatus.AMBIGUOUS
    # Neither alone is enough.
    assert status_of(5.5, 0.5) is NodeStatus.AMBIGUOUS


def test_a_pair_with_a_node_of_which_nothing_is_told_is_unlocated() -> None:
    assert status_of(5.0, 0.1, missing=True) is NodeStatus.UNLOCATED


@pytest.mark.parametrize("seed", [101, pytest.param(102, marks=pytest.mark.soak)])
def test_pairs_of_a_team_that_is_hardly_connected_are_ok_only_where_places_are_right(
    seed: int,
) -> None:
    # Places turn about each other on long arcs, whose means lie inside them.
    run = relpos.simulate("mission-base", seed, seconds=400, area_m=120, max_range_m=25)
    metrics = relpos.evaluate(relpos.fuse(run), run, bound=False).metrics
    assert metrics.ok_over_2_m < 0.002
    assert metrics.ok_over_3_sigma < 0.015
