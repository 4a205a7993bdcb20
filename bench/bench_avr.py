"""Simulated boards against real time: one Uno, one Mega, and six Unos on all cores.

    python bench/bench_avr.py

Each runs the whole firmware in normal service, chip models included. Needs `make firmware`.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

from avr.service import Service
from relpos.emulator.avr import BOARDS, read_firmware
from relpos.emulator.avr.elf import default_build_folder, find_firmware
from relpos.errors import RelposError

SECONDS = 30.0


def simulate(board: str, seed: int) -> float:
    """CPU-bound run of one board; returns the seconds it took."""
    firmware = read_firmware(find_firmware(board, default_build_folder()))
    with Service(BOARDS[board], firmware, SECONDS, seed) as service:
        begin = time.perf_counter()
        service.run(round(SECONDS * 1e6))
        return time.perf_counter() - begin


def main() -> int:
    """Print one line a case."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    try:
        for board in BOARDS:
            print(f"one {board}: {SECONDS / simulate(board, 1):.1f} times real time")
        for name, pool in (("threads", ThreadPoolExecutor), ("processes", ProcessPoolExecutor)):
            with pool(6) as workers:
                begin = time.perf_counter()
                list(workers.map(simulate, ["uno"] * 6, range(6)))
                took = time.perf_counter() - begin
            print(f"six unos in {name}: {SECONDS / took:.1f} times real time, set-up included")
    except RelposError as error:
        print(f"bench_avr: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
