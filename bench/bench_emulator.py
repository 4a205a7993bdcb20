"""How much faster than real time an emulated team runs, radio and ranging included.

    python bench/bench_emulator.py [--board native] [--nodes 6] [--seconds 120] [--profile]

The setting-up of the walk (a second for ten minutes of six walkers) is shown apart.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time

from relpos.emulator.native import build
from relpos.emulator.node import BoardKind
from relpos.emulator.team import EmulatedTeam


def measure(board: str, nodes: int, seconds: float, scenario: str, seed: int) -> str:
    """Run one team to its end; one line of figures."""
    if board == BoardKind.NATIVE:
        build()  # compiling is no part of it
    start_s = time.perf_counter()
    with EmulatedTeam(scenario, nodes, seconds, seed, board) as team:
        ready_s = time.perf_counter()
        byte_count = sum(len(data) for _, data in team.stream())
        done_s = time.perf_counter()
        transactions = sum(node.bus.transactions for node in team.nodes.values())
        uwb = team.uwb.counts
        return (
            f"{nodes} x {board}, {seconds:g} s of {scenario}: "
            f"{seconds / (done_s - ready_s):.1f} x real time "
            f"({done_s - ready_s:.2f} s, and {ready_s - start_s:.2f} s for the walk); "
            f"{transactions / nodes / seconds:.0f} I2C transactions a node and second, "
            f"{byte_count} bytes at the coordinator, "
            f"{uwb['ranges']} ranges of {uwb['attempts']} attempts "
            f"({uwb['collisions']} collided, {uwb['undetected']} undetected)"
        )


def main() -> None:
    """Read the arguments, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--board", choices=[str(kind) for kind in BoardKind], default="native")
    parser.add_argument("--nodes", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--profile", action="store_true")
    given = parser.parse_args()
    arguments = (given.board, given.nodes, given.seconds, given.scenario, given.seed)
    if not given.profile:
        print(measure(*arguments))
        return
    profile = cProfile.Profile()
    print(profile.runcall(measure, *arguments))
    pstats.Stats(profile).sort_stats("tottime").print_stats(30)


if __name__ == "__main__":
    main()
