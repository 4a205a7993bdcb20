"""Whether the bank keeps up with a live team: an emulated one, fused measurement by measurement.

    python bench/real_time.py [--nodes 20] [--seconds 120] [--seeds 1] [--unknown]

Prints processor seconds per second of data, the longest single call of ``process`` (processor
time of the thread: a live page waits for it), and how often the estimator went back for what
came late.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from relpos import fusion
from relpos.emulator.serving import record_team
from relpos.emulator.team import TeamConfig


def main() -> None:
    """Print a line for each seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--nodes", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--unknown", action="store_true", help="give no starts")
    args = parser.parse_args()
    fusion.warm_up("bank")
    for seed in range(args.seeds):
        run = record_team(
            TeamConfig(
                board="native", nodes=args.nodes, seconds=args.seconds, scenario="paper", seed=seed
            )
        )
        bank = fusion.make("bank", () if args.unknown else run.priors, {}, seed, run.nodes)
        calls = []
        for measurement in run.measurements:
            begun = time.thread_time()
            bank.process(measurement)
            calls.append(1e3 * (time.thread_time() - begun))
        print(
            f"{args.nodes} nodes, seed {seed}: {sum(calls) / 1e3 / args.seconds:.3f} s a second, "
            f"longest call {max(calls):.0f} ms, 99 % under {np.quantile(calls, 0.99):.1f} ms, "
            f"{bank.counters().get('rewinds', 0)} rewinds"
        )


if __name__ == "__main__":
    main()
