"""Time of the particle filter per UWB epoch on the paper's scenario, N 6, in microseconds.

    python bench/bench_particle.py [--particles 50 100 200 500 1000 5000 50000]

An epoch is what lies between two instants of ranging: two displacements a user and about 5.3
ranges. "arrays" hands them to `Clouds` as arrays, "interface" goes measurement by measurement
through `process`, with an estimate a second. Medians over a run of 600 s, one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from itertools import groupby

import numpy as np
import numpy.typing as npt

from relpos import fusion
from relpos.fusion.motion_model import MotionNoise
from relpos.fusion.particle import Clouds
from relpos.fusion.ranging_model import RangeNoise
from relpos.fusion.timeline import Advance
from relpos.measurements import Measurement, Motion, Range
from relpos.simulation.paper import SimulatedRun, simulate_paper

Floats = npt.NDArray[np.float64]


def instants(run: SimulatedRun) -> Iterator[tuple[list[Motion], list[Range]]]:
    """The run second by second: everybody's motions, and the ranges after them."""
    for _, group in groupby(run.measurements, key=lambda m: m.time_s):
        at_once = list(group)
        yield (
            [m for m in at_once if isinstance(m, Motion)],
            [m for m in at_once if isinstance(m, Range)],
        )


def through_arrays(run: SimulatedRun, particles: int, alpha: float) -> float:
    """Median time of an epoch whose measurements come as arrays."""
    users = len(run.priors)
    clouds = Clouds(particles, alpha, RangeNoise(), np.random.default_rng(0))
    for prior in run.priors:
        pose = np.array([prior.x_m, prior.y_m, prior.heading_rad])
        clouds.add(np.repeat(pose[:, None], particles, axis=1))
    noise, rows, height = MotionNoise(), np.arange(users), np.zeros(users * users)
    spent, busy = [], 0.0
    for motions, ranges in instants(run):
        steps = [Advance(m.time_s, m.node, 1.0, m.dx_m, m.dy_m, m.dtheta_rad) for m in motions]
        mean = np.array([(a.dx_m, a.dy_m, a.dtheta_rad) for a in steps])
        sigma = np.array([noise.sigmas(a) for a in steps])
        first = np.array([r.node - 1 for r in ranges], dtype=np.int64)
        second = np.array([r.peer - 1 for r in ranges], dtype=np.int64)
        range_m = np.array([r.range_m for r in ranges])
        started = time.perf_counter()
        clouds.advance(rows, mean, sigma)
        if ranges:
            clouds.range(first, second, range_m, height[: len(ranges)])
        busy += time.perf_counter() - started
        if ranges:
            spent.append(busy)
            busy = 0.0
    return 1e6 * float(np.median(spent))


def through_interface(run: SimulatedRun, particles: int, alpha: float) -> float:
    """Median time of an epoch through ``process``."""
    made = fusion.make("particle", run.priors, {"alpha": alpha, "particles": particles}, 0)
    spent, busy, ranged = [], 0.0, False
    for measurement in run.measurements:
        if isinstance(measurement, Motion) and ranged:
            spent.append(busy)
            busy, ranged = 0.0, False
        ranged |= isinstance(measurement, Range)
        busy += _seconds(made, measurement)
    return 1e6 * float(np.median(spent))


def _seconds(made: fusion.Estimator, measurement: Measurement) -> float:
    started = time.perf_counter()
    made.process(measurement)
    return time.perf_counter() - started


def main() -> None:
    """Print a line for every number of particles and share of dual ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--particles", type=int, nargs="+", default=[50, 100, 200, 500, 1000, 5000, 50_000]
    )
    given = parser.parse_args()
    run = simulate_paper("paper", 0)
    through_arrays(run, 50, 0.1)  # the compiler's share
    print(f"{'us an epoch':>12}{'alpha .01':>24}{'alpha 0':>24}")
    print(f"{'M':>12}{'arrays':>12}{'interface':>12}{'arrays':>12}{'interface':>12}")
    for particles in given.particles:
        cells = [
            how(run, particles, alpha)
            for alpha in (0.01, 0.0)
            for how in (through_arrays, through_interface)
        ]
        print(f"{particles:12}" + "".join(f"{cell:12.0f}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
