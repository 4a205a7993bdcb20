"""The default estimator from outside: accuracy, honesty, and what it does with odd input."""

from __future__ import annotations

import numpy as np
import pytest

from relpos import fusion
from relpos.errors import RelposError
from relpos.evaluation import metrics, tracks
from relpos.fusion.estimator import Estimate
from relpos.simulation.paper import simulate_paper


def _run(scenario: str, seed: int, overrides: dict[str, float] | None = None) -> metrics.Metrics:
    run = simulate_paper(scenario, seed, overrides)
    estimator = fusion.make("bank", run.priors, {}, seed)
    estimates: list[Estimate] = []
    for measurement in run.measurements:
        estimates += estimator.process(measurement)
    estimates += estimator.finish()
    return metrics.evaluate(
        tracks.estimated_tracks(estimates),
        tracks.true_tracks(run.truth),
        tracks.estimated_pairs(estimates),
    )


@pytest.mark.parametrize(("scenario", "limit_m"), [("paper", 0.8), ("paper-p1", 0.21)])
def test_the_bank_is_near_the_bound_without_being_told_the_noise(
    scenario: str, limit_m: float
) -> None:
    figures = [_run(scenario, seed) for seed in (0, 1)]
    assert np.mean([f.relative_distance_rmse_m for f in figures]) < limit_m
    assert 0.5 < np.mean([f.nees_distance for f in figures]) < 1.6


def test_the_same_seed_gives_the_same_estimates() -> None:
    first, second = (_run("paper", 3, {"seconds": 60.0}) for _ in range(2))
    assert first.relative_distance_rmse_m == second.relative_distance_rmse_m


def test_a_run_without_motion_is_refused() -> None:
    with pytest.raises(RelposError, match="no motion"):
        fusion.make("bank").finish()
