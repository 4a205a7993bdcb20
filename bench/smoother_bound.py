"""The smoother against the bound of smoothing, seed by seed, noise levels unknown.

    python bench/smoother_bound.py --scenario paper-p1 [--seeds 50] [--first 200]

prints distance and aligned position RMSE as ratios to the scenario's bound, the worst seed, the
NEES of the distance with its interval, and the online estimator's distance RMSE (m).
"""

from __future__ import annotations

import argparse

import numpy as np

from relpos import fusion
from relpos.evaluation import bounds, consistency, metrics
from relpos.fusion.estimator import Estimator
from relpos.simulation.paper import SimulatedRun, simulate_paper


def score(run: SimulatedRun, estimator: Estimator) -> metrics.Metrics:
    """Run an estimator over a whole run."""
    estimates = [e for m in run.measurements for e in estimator.process(m)] + estimator.finish()
    return metrics.of_estimates(estimates, run.truth)


def main() -> None:
    """Print a line a seed, then the whole."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", default="paper-p1")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=200)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    overrides = dict(pair.split("=", 1) for pair in given.set)
    scores, online, least = [], [], []
    for seed in range(given.first, given.first + given.seeds):
        run = simulate_paper(given.scenario, seed, overrides)
        scores.append(score(run, fusion.make_smoother("bank", run.priors, {}, seed)))
        online.append(score(run, fusion.make("bank", run.priors, {}, seed)))
        least.append(bounds.of_simulated(given.scenario, seed, overrides).totals())
        bound = bounds.over_seeds(least)
        distance = np.array([s.relative_distance_rmse_m for s in scores])
        position = np.array([s.relative_position_rmse_m for s in scores])
        nees = consistency.of_distances(scores)
        print(
            f"{given.scenario} {seed}: {distance[-1]:.3f} m; {len(scores)} seeds: ratio "
            f"{distance.mean() / bound.smoothing_distance_m:.3f} / "
            f"{position.mean() / bound.smoothing_position_m:.3f}, median "
            f"{np.median(distance) / bound.smoothing_distance_m:.3f}, worst "
            f"{distance.max() / bound.smoothing_distance_m:.2f}, NEES {nees.mean:.2f} "
            f"({nees.low:.2f} to {nees.high:.2f} by chance), online "
            f"{np.mean([s.relative_distance_rmse_m for s in online]):.3f} m",
            flush=True,
        )


if __name__ == "__main__":
    main()
