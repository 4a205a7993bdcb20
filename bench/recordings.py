"""An estimator on the real recordings, against dead reckoning from the true start.

    python bench/recordings.py [--estimator bank] [--seeds 4] [--set KEY=VALUE ...] [--smooth]
                               [--after 0] [--only known] [--biases]

For every run of two_robots_vio and four_robots_uwb: distance, aligned and body-frame RMSE (m,
mean over seeds) from known and from unknown starts, distance NEES, and when unknown starts were
resolved. ``--smooth`` adds the smoother. ``--after`` leaves the first seconds out of the score.
``--biases`` prints, from known starts, each pair's learned range bias beside the median residual
against the truth.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat

import numpy as np

from relpos import fusion, tracks
from relpos.evaluation import metrics, ranging
from relpos.evaluation.finite import median
from relpos.fusion import Estimate, NodeStatus
from relpos.runs import InitialPose, Run, load_run
from shared_data import DATA

RUNS = (
    "two_robots_vio/exp1_los",
    "two_robots_vio/exp3_los",
    "two_robots_vio/exp4_los",
    "two_robots_vio/exp1_unobservable",
    "four_robots_uwb/run1",
)


SMOOTHED = "smoothed "
"""Before an estimator's name: the smoother that begins from it."""


def fuse(
    name: str, estimator: str, initial: InitialPose, settings: Mapping[str, str], seed: int
) -> tuple[Run, list[Estimate]]:
    """Fuse one recording."""
    run = load_run(DATA / name)
    make = fusion.make_smoother if estimator.startswith(SMOOTHED) else fusion.make
    estimator = estimator.removeprefix(SMOOTHED)
    made = make(estimator, run.priors_for(initial), settings, seed, run.nodes)
    return run, [e for m in run.measurements for e in made.process(m)] + made.finish()


def true_biases(run: Run) -> dict[tuple[int, int], float]:
    """Give the median of each pair's ranges less the true distance, m."""
    ranges = ranging.by_pair(run.ranges, {}, tracks.true_tracks(run.truth))
    return {one.pair: median(one.error_m) for one in ranges}


def print_biases(seeds: int, settings: Mapping[str, str]) -> None:
    """Print the learned biases of every run at its end, seed by seed."""
    for name in RUNS:
        found: dict[tuple[int, int], list[str]] = {}
        for seed in range(seeds):
            run, estimates = fuse(name, "bank", InitialPose.FROM_TRUTH, settings, seed)
            for p in estimates[-1].parameters:
                if p.name == "range_bias_m" and p.peer is not None:
                    text = f"{p.value:.2f}+-{p.sigma:.2f}"
                    found.setdefault((p.node, p.peer), []).append(text)
        for pair, true_m in true_biases(run).items():
            print(f"{name:34}{pair[0]}-{pair[1]}{true_m:7.2f}  {' '.join(found.get(pair, []))}")


def score(
    name: str,
    estimator: str,
    initial: InitialPose,
    settings: Mapping[str, str],
    seed: int,
    after_s: float,
) -> tuple[float, float, float, float, float]:
    """Give distance, aligned, body-frame RMSE (m), distance NEES and the resolving time (s)."""
    run, estimates = fuse(name, estimator, initial, settings, seed)
    vague = [
        e.time_s
        for e in estimates
        if any(n.status in (NodeStatus.AMBIGUOUS, NodeStatus.UNLOCATED) for n in e.nodes)
    ]
    kept = [e for e in estimates if e.time_s >= after_s]
    m = metrics.of_estimates(kept, run.truth)
    return (
        m.relative_distance_rmse_m, m.relative_position_rmse_m, m.body_frame_rmse_m,
        m.nees_distance, max(vague, default=0.0),
    )  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--after", type=float, default=0.0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", default="", help="known or unknown starts alone")
    parser.add_argument("--estimator", default="bank")
    parser.add_argument("--smooth", action="store_true")
    parser.add_argument("--biases", action="store_true")
    given = parser.parse_args()
    settings = dict(item.split("=", 1) for item in given.set)
    if given.biases:
        print_biases(given.seeds, settings)
        return
    cases = [("dead reckoning", "deadreckoning", InitialPose.FROM_TRUTH, {}, 1)]
    for kind in ("", SMOOTHED) if given.smooth else ("",):
        made = kind + given.estimator
        cases += [
            (f"{kind}known start", made, InitialPose.FROM_TRUTH, settings, given.seeds),
            (f"{kind}unknown start", made, InitialPose.UNKNOWN, settings, given.seeds),
        ]
    print(f"{'':34}{'':23}{'dist':>6}{'align':>7}{'body':>7}{'NEES':>7}  resolved at s")
    with ProcessPoolExecutor(given.workers) as pool:
        for name in RUNS:
            for label, estimator, initial, chosen, seeds in cases:
                if given.only and given.only not in label.split():
                    continue
                results = np.array(
                    list(
                        pool.map(
                            score, repeat(name), repeat(estimator), repeat(initial),
                            repeat(chosen), range(seeds), repeat(given.after),
                        )
                    )
                )  # fmt: skip
                mean = results.mean(axis=0)
                when = " ".join(f"{t:.0f}" for t in sorted(results[:, 4])) if "un" in label else ""
                print(
                    f"{name:34}{label:23}{mean[0]:6.2f}{mean[1]:7.2f}{mean[2]:7.2f}{mean[3]:7.2f}"
                    f"  {when}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
