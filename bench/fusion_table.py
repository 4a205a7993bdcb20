"""What the fusion has to show: every scenario, every estimator, beside the bound.

    python bench/fusion_table.py [--seeds 50] [--first 0] [--estimator bank] [--only TEXT]
                                 [--workers N] [--cluster ADDRESS]

prints, for each row, distance and aligned RMSE (m, mean over the seeds and standard error), their
ratios to the filtering bound, the worst seed's ratio, the distance NEES and the time of a run,
and whether the row's target is met. Ratios are the mean over the bound's RMS in the same
scenario; "worst" is the largest run's over the same bound.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass

from relpos.evaluation import bounds, study
from relpos.evaluation.executors import executor


@dataclass(frozen=True)
class Row:
    """One scenario and what is asked of the default estimator in it.

    ``ratio`` and ``worst`` are the most that the mean's and the worst seed's ratio to the bound
    may be, of distance and aligned both; ``distance_m`` the most that the mean distance RMSE may
    be; ``converged`` the least share of seeds that have found an unknown start at 120 s.
    """

    label: str
    scenario: str
    overrides: Mapping[str, str | float]
    ratio: float | None = None
    worst: float | None = None
    distance_m: float | None = None
    converged: float | None = None


CONVERGED_M, CONVERGED_S = 0.5, 120.0


def converged_share(outcome: study.Outcome) -> float:
    """Share of the seeds whose aligned error is under 0.5 m at 120 s."""
    there = [
        bool((s.aligned_over_time_m[s.time_s == CONVERGED_S] < CONVERGED_M).any())
        for s in outcome.scores
    ]
    return sum(there) / len(there)


def _hidden(drift: float) -> dict[str, str | float]:
    return {"scale_error": 0.1, "heading_drift_deg_s": drift}


ROWS = (
    Row("P", "paper", {}, ratio=1.10),
    Row("P1", "paper-p1", {}, ratio=1.10),
    Row("H", "paper-h", {}, ratio=1.0, worst=1.4),
    Row("H2", "paper-h2", {}, ratio=1.0, worst=1.4),
    Row("P1, 20 % NLOS", "paper-p1", {"nlos_probability": 0.2}, distance_m=0.40),
    Row("P1, kidnapped 5 m", "paper-p1", {"kidnap_m": 5}, distance_m=0.25),
    Row("P1, start shifted 4 m", "paper-p1", {"start_shift_m": 4}, distance_m=0.60),
    Row("P1, one user's noise x 3", "paper-p1", {"noisy_factor": 3}, distance_m=0.55),
    Row("P1, start unknown", "paper-p1", {"start": "unknown"}, converged=0.95),
    Row("P1, scale 10 %, .1 deg/s", "paper-p1", _hidden(0.1), distance_m=0.20),
    Row("P1, scale 10 %, .5 deg/s", "paper-p1", _hidden(0.5), distance_m=0.20),
    Row("H, scale 10 %, .1 deg/s", "paper-h", _hidden(0.1), distance_m=1.15),
    Row("H, scale 10 %, .5 deg/s", "paper-h", _hidden(0.5), distance_m=1.4),
    Row("lab", "lab", {}, distance_m=1.0),
)

NEES = (0.8, 1.3)


def verdict(row: Row, outcome: study.Outcome, bound: bounds.Totals) -> str:
    """Say which targets of the row are missed; "meets" where none is."""
    missed = []
    for name, figure, least in (
        ("distance", outcome.distance_m, bound.filtering_distance_m),
        ("aligned", outcome.aligned_m, bound.filtering_position_m),
    ):
        if row.ratio is not None and not figure.mean <= row.ratio * least:
            missed.append(f"{name} > {row.ratio:g} x")
        if row.worst is not None and not figure.worst <= row.worst * least:
            missed.append(f"worst {name} > {row.worst:g} x")
    if row.distance_m is not None and not outcome.distance_m.mean <= row.distance_m:
        missed.append(f"distance > {row.distance_m:g} m")
    if row.converged is not None and not converged_share(outcome) >= row.converged:
        missed.append(
            f"only {converged_share(outcome):.0%} under {CONVERGED_M:g} m at {CONVERGED_S:g} s"
        )
    if not NEES[0] <= outcome.nees.mean <= NEES[1]:
        missed.append(f"NEES not {NEES[0]:g} to {NEES[1]:g}")
    if outcome.failures:
        missed.append(f"{len(outcome.failures)} runs failed: {outcome.failures[0]}")
    return "; ".join(missed) or "meets"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--estimator", default="bank")
    parser.add_argument("--only", default="", help="rows whose name has this text")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seconds", type=float, default=None, help="length of every run")
    parser.add_argument("--workers", type=int, default=None)
    parser.add_argument("--cluster", default=None, metavar="ADDRESS")
    given = parser.parse_args()
    settings = dict(pair.split("=", 1) for pair in given.set)
    seeds = range(given.first, given.first + given.seeds)
    print(
        f"{given.estimator}, seeds {seeds[0]} to {seeds[-1]}; m, mean +- "
        "standard error; ratios to the filtering bound, of distance / aligned"
    )
    print(
        f"{'':26}{'distance':>15}{'aligned':>15}{'bound':>13}{'ratio':>13}{'worst':>13}"
        f"{'NEES':>6}{'s/run':>7}"
    )
    with executor(given.cluster, given.workers) as pool:
        for row in ROWS:
            if given.only not in row.label:
                continue
            overrides = dict(row.overrides)
            if given.seconds is not None:
                overrides["seconds"] = given.seconds
                if "kidnap_m" in overrides:
                    overrides["kidnap_s"] = min(300.0, 0.5 * given.seconds)
            case = study.Case(row.label, row.scenario, overrides, given.estimator, settings)
            [outcome] = study.run([case], seeds, pool)
            [bound] = study.bounds_of([case], seeds, pool)
            distance, aligned = outcome.distance_m, outcome.aligned_m
            least = bound.filtering_distance_m, bound.filtering_position_m
            print(
                f"{row.label:26}{distance.mean:8.3f} +-{distance.error:5.3f}"
                f"{aligned.mean:8.3f} +-{aligned.error:5.3f}"
                f"{least[0]:7.3f}/{least[1]:5.3f}"
                f"{distance.mean / least[0]:7.2f}/{aligned.mean / least[1]:5.2f}"
                f"{distance.worst / least[0]:7.2f}/{aligned.worst / least[1]:5.2f}"
                f"{outcome.nees.mean:6.3g}{outcome.busy_s.mean:7.2f}  "
                f"{verdict(row, outcome, bound)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
