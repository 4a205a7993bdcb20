"""How the estimators do on missions that nobody planned, condition by condition.

    python bench/missions.py [--seeds 3] [--first 0] [--only TEXT] [--estimators bank,ekf]
                             [--set KEY=VALUE] [--workers N]

prints, for each condition of ``relpos.simulation.missions`` and each estimator: distance, aligned
and body-frame RMSE (m) and distance NEES, means over the seeds; of the pair-seconds with status
ok the shares whose distance errs by more than three sigmas and by more than 2 m (%); the worst
seed's distance RMSE; and the time of a run. ``ekf`` is a plain joint extended Kalman filter that
is told the true noise (``docs/examples/own_estimator.py``).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from relpos.evaluation import study
from relpos.evaluation.executors import executor
from relpos.simulation import missions

EKF = f"{Path(__file__).parents[1] / 'docs' / 'examples' / 'own_estimator.py'}:SmallEkf"
EKF_SETTINGS = {"range_m": 0.1, "step": 0.06, "turn_rad": 0.03, "gate": 5}


def case(condition: str, estimator: str, settings: dict[str, str]) -> study.Case:
    """Make one line of the table."""
    name, given = (EKF, EKF_SETTINGS) if estimator == "ekf" else (estimator, settings)
    label = f"{condition:18}{estimator:9}"
    return study.Case(label, f"{missions.PREFIX}-{condition}", {}, name, given)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", default="", help="conditions whose name has this text, or a,b")
    parser.add_argument("--estimators", default="bank,ekf")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--workers", type=int, default=None)
    given = parser.parse_args()
    settings = dict(pair.split("=", 1) for pair in given.set)
    cases = [
        case(condition, estimator, settings)
        for condition in missions.CONDITIONS
        if any(text in condition for text in given.only.split(","))
        for estimator in given.estimators.split(",")
    ]
    seeds = range(given.first, given.first + given.seeds)
    print(f"seeds {seeds[0]} to {seeds[-1]}; m, means; shares of the ok pair-seconds in %")
    print(
        f"{'':27}{'distance':>9}{'aligned':>9}{'body':>8}{'NEES':>8}{'>3 sig':>8}{'>2 m':>7}"
        f"{'worst':>8}{'s/run':>7}"
    )
    with executor(workers=given.workers) as pool:
        for one in cases:
            (made,) = study.run([one], seeds, pool)
            print(
                f"{one.label:27}{made.distance_m.mean:9.2f}{made.aligned_m.mean:9.2f}"
                f"{made.body_frame_m.mean:8.2f}{made.nees.mean:8.2f}"
                f"{100 * made.ok_over_3_sigma.mean:8.1f}{100 * made.ok_over_2_m.mean:7.1f}"
                f"{made.distance_m.worst:8.2f}{made.busy_s.mean:7.1f}"
                + "".join(f"  {reason}" for reason in made.failures[:1]),
                flush=True,
            )


if __name__ == "__main__":
    main()
