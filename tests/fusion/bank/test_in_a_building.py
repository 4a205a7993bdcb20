"""A team that climbs stairs: silence through slabs, and the way on flights."""

from __future__ import annotations

import pytest

from relpos import fusion
from relpos.evaluation import vertical
from relpos.simulation.building import simulate_building
from relpos.tracks import true_tracks


@pytest.fixture(scope="module")
def score() -> vertical.Vertical:
    run = simulate_building("building", 43, {"seconds": 450.0})
    estimator = fusion.make("bank", run.priors, {"hypotheses": 50}, seed=43)
    estimates = [e for m in run.measurements for e in estimator.process(m)]
    estimates += estimator.finish()
    score = vertical.score(estimates, true_tracks(run.truth), run.floors_m, run.events)
    assert score is not None
    return score


def test_a_team_on_several_floors_is_located_to_a_metre(score: vertical.Vertical) -> None:
    """Silence between floors, taken for distance, makes it 5 m."""
    assert score.aligned_3d_rmse_m < 1.2


def test_the_way_on_flights_is_the_true_one(score: vertical.Vertical) -> None:
    """Uncorrected, it is 1.9 to 2.1 times as long."""
    assert 0.8 < score.stairs_way < 1.2
