"""What an epoch of the bank costs: N 6, paper-p1, one thread, measurements handed over as arrays.

    python bench/bench_bank.py [--hypotheses 200 1] [--rounds 5]

An epoch is 2 s: two motions of each user and about 5.3 ranges. The core's figure is the median
over epochs of the least of several rounds over the same run (other work on the machine only adds);
the last line is the public measurement-by-measurement interface, estimates included.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from relpos import fusion
from relpos.fusion.bank_core import BankCore
from relpos.fusion.bank_settings import BankSettings
from relpos.measurements import Motion, Range
from relpos.simulation.paper import SimulatedRun, simulate_paper

Epoch = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def epochs_of(run: SimulatedRun) -> list[Epoch]:
    """Motion rows (M,), motions (M, 4), first and second rows (R,), ranges (R,) of each 2 s."""
    epochs = []
    for start in np.arange(0.0, run.measurements[-1].time_s, 2.0):
        inside = [m for m in run.measurements if start < m.time_s <= start + 2.0]
        motions = [m for m in inside if isinstance(m, Motion)]
        ranges = [m for m in inside if isinstance(m, Range)]
        epochs.append((
            np.array([m.node - 1 for m in motions], dtype=np.int64),
            np.array([(m.dx_m, m.dy_m, m.dtheta_rad, 1.0) for m in motions]),
            np.array([m.node - 1 for m in ranges], dtype=np.int64),
            np.array([m.peer - 1 for m in ranges], dtype=np.int64),
            np.array([m.range_m for m in ranges]),
        ))  # fmt: skip
    return epochs


def core_us(run: SimulatedRun, hypotheses: int) -> dict[str, np.ndarray]:
    """Microseconds of each epoch's parts, (E,) each."""
    core = BankCore(BankSettings(hypotheses=hypotheses, biased=0.0), 0)
    for prior in run.priors:
        core.add_node(prior.x_m, prior.y_m, prior.heading_rad, 0.0, 0.0)
    parts: dict[str, list[float]] = {"advance": [], "update": [], "settle": []}
    for rows, moved, first, second, measured in epochs_of(run):
        marks = [time.thread_time()]
        core.move(rows, moved)
        marks.append(time.thread_time())
        if len(first):
            core.update(first, second, measured, np.zeros(len(first)))
        marks.append(time.thread_time())
        core.settle()
        marks.append(time.thread_time())
        for name, spent in zip(parts, np.diff(marks), strict=True):
            parts[name].append(1e6 * spent)
    return {name: np.array(values) for name, values in parts.items()}


def main() -> None:
    """Print a line for each number of hypotheses."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hypotheses", type=int, nargs="+", default=[200, 1])
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    run = simulate_paper("paper-p1", 0, {"seconds": 300.0})
    for hypotheses in args.hypotheses:
        core_us(run, hypotheses)
        rounds = [core_us(run, hypotheses) for _ in range(args.rounds)]
        least = {name: np.min([r[name] for r in rounds], axis=0) for name in rounds[0]}
        total = np.sum(list(least.values()), axis=0)
        print(
            f"{hypotheses} hypotheses, states of 30: {np.median(total):.0f} us an epoch ("
            + ", ".join(f"{name} {np.median(values):.0f}" for name, values in least.items())
            + ")"
        )
        whole = []
        for _ in range(args.rounds):
            estimator = fusion.make("bank", run.priors, {"hypotheses": hypotheses}, 0)
            started = time.thread_time()
            for measurement in run.measurements:
                estimator.process(measurement)
            whole.append(1e6 * (time.thread_time() - started) / 150)
        print(f"  measurement by measurement, estimates included: {min(whole):.0f} us an epoch")


if __name__ == "__main__":
    main()
