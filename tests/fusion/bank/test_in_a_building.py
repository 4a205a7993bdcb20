"""A team that climbs stairs: silence through slabs, and the way on flights."""

from __future__ import annotations

import numpy as np
import pytest

from relpos import fusion
from relpos.evaluation import vertical
from relpos.simulation.building import simulate_building
from relpos.tracks import true_tracks


@pytest.fixture(scope="module")
def scores() -> list[vertical.Vertical]:
    found = []
    for seed in (43, 45):
        run = simulate_building("building", seed, {"seconds": 600.0})
        estimator = fusion.make("bank", run.priors, {}, seed=seed)
        estimates = [e for m in run.measurements for e in estimator.process(m)]
        estimates += estimator.finish()
        score = vertical.score(estimates, true_tracks(run.truth), run.floors_m, run.events)
        assert score is not None
        found.append(score)
    return found


def test_a_team_on_several_floors_is_located_to_a_metre(scores: list[vertical.Vertical]) -> None:
    """Silence between floors, taken for distance, makes it 3.6 m."""
    assert np.mean([one.aligned_3d_rmse_m for one in scores]) < 1.2


def test_the_way_on_flights_is_the_true_one(scores: list[vertical.Vertical]) -> None:
    assert 0.85 < np.mean([one.stairs_way for one in scores]) < 1.15
