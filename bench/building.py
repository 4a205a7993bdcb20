"""How the estimators do in the emulated building, condition by condition.

    python bench/building.py [--seeds 20] [--first 0] [--only calm,fan] [--estimators bank]
                             [--set KEY=VALUE] [--workers N]

prints, for each condition of ``relpos.simulation.building`` and each estimator, means over the
seeds (definitions: ``relpos.evaluation.vertical``): height RMSE between two and VE95 (m); how often
the nearest floor and the stated one are right off stairs, and a wrong one is claimed with p > .9
(%); way on flights, estimated over true; flights found (%) and false ones an hour and wearer;
aligned RMSE in 3D (m); NEES of the height; the worst seed's aligned RMSE in 3D; and the time of a
run. A figure that an estimator states nothing for is "-". ``smoother`` begins from the bank.
"""

from __future__ import annotations

import argparse
import math

import numpy as np

from relpos.evaluation import study
from relpos.evaluation.executors import executor
from relpos.simulation import building

COLUMNS = (
    ("between", "relative_rmse_m", 1.0, 2),
    ("VE95", "ve95_m", 1.0, 2),
    ("nearest", "floor_by_height", 100.0, 1),
    ("stated", "floor_right", 100.0, 1),
    ("wrong", "wrong_claimed", 100.0, 2),
    ("way", "stairs_way", 1.0, 2),
    ("found", "flights_found", 100.0, 1),
    ("false", "false_flights_h", 1.0, 1),
    ("rides", "rides_found", 100.0, 1),
    ("fall", "fall_error_m", 1.0, 2),
    ("3D", "aligned_3d_rmse_m", 1.0, 2),
    ("NEES", "nees", 1.0, 2),
)
"""Heading, figure, factor, decimals."""


def line(outcome: study.Outcome) -> str:
    """Return one line of the table."""
    found = [score.vertical for score in outcome.scores if score.vertical is not None]
    cells = []
    for _, name, factor, decimals in COLUMNS:
        values = np.array([getattr(one, name) for one in found], dtype=float)
        values = factor * values[np.isfinite(values)]
        cells.append(f"{values.mean():8.{decimals}f}" if values.size else f"{'-':>8}")
    worst = max((one.aligned_3d_rmse_m for one in found), default=math.nan)
    reasons = "".join(f"  {reason}" for reason in outcome.failures[:1])
    return f"{outcome.case.label:24}{''.join(cells)}{worst:8.2f}{outcome.busy_s.mean:7.1f}{reasons}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", default="", help="conditions, separated by commas")
    parser.add_argument("--estimators", default="bank")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument("--workers", type=int, default=None)
    given = parser.parse_args()
    wanted = [name for name in given.only.split(",") if name] or list(building.CONDITIONS)
    settings = dict(pair.split("=", 1) for pair in given.set)
    seeds = range(given.first, given.first + given.seeds)
    print(f"seeds {seeds[0]} to {seeds[-1]}; m, %, means; definitions: evaluation/vertical.py")
    headings = "".join(f"{heading:>8}" for heading, *_ in COLUMNS)
    print(f"{'':24}{headings}{'worst':>8}{'s/run':>7}")
    with executor(workers=given.workers) as pool:
        for condition in wanted:
            for estimator in given.estimators.split(","):
                case = study.Case(
                    f"{condition:14}{estimator}",
                    f"{building.PREFIX}-{condition}",
                    {"seconds": given.seconds},
                    "bank" if estimator == "smoother" else estimator,
                    settings if estimator == "bank" else {},
                    smooth=estimator == "smoother",
                )
                (outcome,) = study.run([case], seeds, pool)
                print(line(outcome), flush=True)


if __name__ == "__main__":
    main()
