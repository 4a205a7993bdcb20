"""How much faster than real time an emulated team runs, radio and ranging included.

    python bench/bench_emulator.py [--board native|uno|mega] [--nodes 6] [--seconds 120] [--profile]

Without --board: six native boards, then six Unos executed instruction by instruction whose bytes
go through a serial port into the particle filter, on two cores. The setting-up of the walk (a
second for ten minutes of six walkers) is shown apart.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import subprocess
import sys
import time

from relpos import fusion
from relpos.emulator.avr.library import SimulatorError
from relpos.emulator.native import build
from relpos.emulator.node import BoardKind
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.errors import DeviceError
from relpos.link.port import Link, observe, open_port
from relpos.measurements import Measurement


def measure(board: str, nodes: int, seconds: float, scenario: str, seed: int) -> str:
    """Run one team to its end; one line of figures."""
    if board == BoardKind.NATIVE:
        build()  # compiling is no part of it
    start_s = time.perf_counter()
    with EmulatedTeam(TeamConfig(scenario, nodes, seconds, seed, board)) as team:
        ready_s, ready_cpu_s = time.perf_counter(), time.process_time()
        byte_count = sum(len(data) for _, data in team.stream())
        done_s, done_cpu_s = time.perf_counter(), time.process_time()
        transactions = sum(node.bus.transactions for node in team.nodes.values())
        uwb = team.uwb.counts
        return (
            f"{nodes} x {board}, {seconds:g} s of {scenario}: "
            f"{seconds / (done_s - ready_s):.1f} x real time "
            f"({done_s - ready_s:.2f} s, and {ready_s - start_s:.2f} s for the walk), "
            f"{seconds / (done_cpu_s - ready_cpu_s):.1f} x on a core of its own; "
            f"{transactions / nodes / seconds:.0f} I2C transactions a node and second, "
            f"{byte_count} bytes at the coordinator, "
            f"{uwb['ranges']} ranges of {uwb['attempts']} attempts "
            f"({uwb['collisions']} collided, {uwb['undetected']} undetected)"
        )


def measure_chain(board: str, nodes: int, seconds: float, scenario: str, seed: int) -> str:
    """`relpos emulate` in a process of its own, link and particle filter in this one."""
    with EmulatedTeam(TeamConfig(scenario, nodes, seconds, seed)) as team:  # knows where they begin
        estimator = fusion.make("particle", team.priors(), {}, seed)
    arguments = f"--nodes {nodes} --board {board} --scenario {scenario} --seconds {seconds:g}"
    command = [sys.executable, "-m", "relpos.cli.main", "emulate", *arguments.split()]
    command += ["--speed", "0", "--seed", str(seed)]
    emulator = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert emulator.stdout is not None
    link = Link()
    estimates = 0
    try:
        with open_port(emulator.stdout.readline().strip()) as port:
            start_s = time.perf_counter()
            for batch in observe(port, link):
                for observation in batch:
                    if isinstance(observation, Measurement):
                        estimates += len(estimator.process(observation))
    except DeviceError:
        pass  # the walk has ended, and the port with it
    finally:
        emulator.terminate()
        emulator.wait()
    taken_s = time.perf_counter() - start_s
    reached_s = link.virtual_s or 0.0
    return (
        f"{nodes} x {board} into the particle filter, {reached_s:.0f} s of {scenario}: "
        f"{reached_s / taken_s:.2f} x real time ({taken_s:.1f} s; {estimates} estimates)"
    )


def main() -> None:
    """Read the arguments, measure, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--board", choices=[str(kind) for kind in BoardKind])
    parser.add_argument("--nodes", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--profile", action="store_true")
    given = parser.parse_args()
    rest = (given.nodes, given.seconds, given.scenario, given.seed)
    if given.board is None:
        print(measure("native", *rest))
        try:
            print(measure_chain("uno", *rest))
        except SimulatorError as error:
            print(f"six Unos: {error}")
        return
    arguments = (given.board, *rest)
    if not given.profile:
        print(measure(*arguments))
        return
    profile = cProfile.Profile()
    print(profile.runcall(measure, *arguments))
    pstats.Stats(profile).sort_stats("tottime").print_stats(30)


if __name__ == "__main__":
    main()
