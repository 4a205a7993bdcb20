"""How the estimators do in the emulated building, condition by condition.

    python bench/building.py [--seeds 20] [--first 0] [--only calm,fan] [--estimators bank]
                             [--set KEY=VALUE] [--workers N]

prints, for each condition of ``relpos.simulation.building`` and each estimator, means over the
seeds (definitions: ``relpos.evaluation.vertical``): height RMSE between two and VE95 (m); how often
the nearest floor and the stated one are right off stairs, and a wrong one is claimed with p > .9
(%); way on flights, estimated over true; flights found (%) and false ones an hour and wearer;
aligned RMSE in 3D (m); NEES of the height; the worst seed's aligned RMSE in 3D; and the time of a
run. A figure that an estimator states nothing for is "-". ``smoother`` begins from the bank;
``vertical`` is the vertical filter alone, without the plane.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Sequence

import numpy as np

from relpos import fusion
from relpos.evaluation import study, vertical
from relpos.evaluation.executors import executor
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus
from relpos.fusion.post import Referring
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Timeline
from relpos.fusion.vertical.filter import VerticalFilter
from relpos.measurements import Height
from relpos.simulation import building
from relpos.tracks import true_tracks

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


def line(
    label: str, found: Sequence[vertical.Vertical], run_s: float, reasons: Sequence[str] = ()
) -> str:
    """Return one line of the table."""
    cells = []
    for _, name, factor, decimals in COLUMNS:
        values = np.array([getattr(one, name) for one in found], dtype=float)
        values = factor * values[np.isfinite(values)]
        cells.append(f"{values.mean():8.{decimals}f}" if values.size else f"{'-':>8}")
    worst = max((one.aligned_3d_rmse_m for one in found), default=math.nan)
    cells.append(f"{'-':>8}" if math.isnan(worst) else f"{worst:8.2f}")
    told = "".join(f"  {reason}" for reason in reasons[:1])
    return f"{label:24}{''.join(cells)}{run_s:7.1f}{told}"


def heights_alone(condition: str, seed: int, seconds: float) -> vertical.Vertical:
    """Score the vertical filter by itself: everybody is at the origin of the plane."""
    run = building.simulate_building(f"{building.PREFIX}-{condition}", seed, {"seconds": seconds})
    nodes = sorted({prior.node for prior in run.priors})
    reference = Referring(fusion.make("deadreckoning", []), frozenset(run.posts))
    timeline, heights = Timeline(nodes), VerticalFilter(posts=reference.posts)
    estimates = []
    for slot in timeline.push_all(map(reference.refer, run.measurements), final=True):
        match slot:
            case Advance():
                heights.move(slot)
            case Sensed(measurement=Height() as measured):
                heights.measure(measured, slot.time_s)
            case Ranging():
                for measured_range in slot.ranges:
                    heights.ranged(measured_range)
            case Epoch():
                heights.close(slot.time_s)
                estimates.append(
                    Estimate(
                        slot.time_s,
                        tuple(
                            NodeEstimate(
                                node=node, x_m=0.0, y_m=0.0, heading_rad=0.0,
                                sigma_heading_rad=0.1, variance_x_m2=0.01, variance_y_m2=0.01,
                                covariance_xy_m2=0.0, status=NodeStatus.OK,
                                **heights.of(node, slot.time_s)._asdict(),
                            )
                            for node in nodes
                        ),
                        (),
                    )
                )  # fmt: skip
    found = vertical.score(estimates, true_tracks(run.truth), run.floors_m, run.events)
    assert found is not None
    return dataclasses.replace(found, stairs_way=math.nan, aligned_3d_rmse_m=math.nan)


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
                label = f"{condition:14}{estimator}"
                if estimator == "vertical":
                    begun_s = time.process_time()
                    found = [heights_alone(condition, seed, given.seconds) for seed in seeds]
                    run_s = (time.process_time() - begun_s) / len(seeds)
                    print(line(label, found, run_s), flush=True)
                    continue
                case = study.Case(
                    label,
                    f"{building.PREFIX}-{condition}",
                    {"seconds": given.seconds},
                    "bank" if estimator == "smoother" else estimator,
                    settings if estimator == "bank" else {},
                    smooth=estimator == "smoother",
                )
                (outcome,) = study.run([case], seeds, pool)
                found = [one.vertical for one in outcome.scores if one.vertical is not None]
                print(line(label, found, outcome.busy_s.mean, outcome.failures), flush=True)


if __name__ == "__main__":
    main()
