"""Time of the particle filter per UWB epoch on the paper's scenario, N 6, in microseconds.

    python bench/bench_particle.py [--particles 50 100 200 500 1000 5000 50000]

An epoch is what lies between two instants of ranging: two displacements a user and about 5.3
ranges. "arrays" hands them to `ParticleSet` as arrays, "interface" goes measurement by measurement
through `process`, with an estimate a second. Processor time, median and tenth percentile (a busy
computer's caches are disturbed) over a run of 600 s, one thread.
"""

from __future__ import annotations

import argparse

import numpy as np

from relpos.evaluation.figures.running_time import through_arrays, through_interface
from relpos.simulation.paper import simulate_paper


def main() -> None:
    """Print a line for every number of particles and share of dual ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--particles", type=int, nargs="+", default=[50, 100, 200, 500, 1000, 5000, 50_000]
    )
    given = parser.parse_args()
    run = simulate_paper("paper", 0)
    through_arrays(run, 50, 0.1)  # the compiler's share
    print(f"{'us an epoch':>12}{'alpha .01':>30}{'alpha 0':>30}")
    print(f"{'M':>12}{'arrays':>15}{'interface':>15}{'arrays':>15}{'interface':>15}")
    for particles in given.particles:
        cells = []
        for alpha in (0.01, 0.0):
            cells.append(through_arrays(run, particles, alpha))
            cells.append(through_interface(run, "particle", particles=particles, alpha=alpha))
        print(
            f"{particles:12}"
            + "".join(f"{1e6 * np.median(c):8.0f} {1e6 * np.quantile(c, 0.1):6.0f}" for c in cells),
            flush=True,
        )


if __name__ == "__main__":
    main()
