"""Running time over the number of particles (paper, table I)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from relpos import fusion
from relpos.evaluation.figures.sheet import COLOURS, INK, MARKERS, Beside, Sheet, Work
from relpos.measurements import Motion, Range
from relpos.simulation.paper import SimulatedRun, simulate_paper

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

PAPER_S = {50: 0.006, 100: 0.012, 200: 0.026, 500: 0.05, 1000: 0.13}
"""Table I: seconds to integrate one measurement, Intel Core i5-4200M, 2.5 GHz."""

PARTICLES = (*PAPER_S, 5000, 50_000)


def instants(run: SimulatedRun) -> Iterator[tuple[list[Motion], list[Range]]]:
    """Return the run second by second: all motions, then the ranges."""
    for _, group in groupby(run.measurements, key=lambda m: m.time_s):
        at_once = list(group)
        yield (
            [m for m in at_once if isinstance(m, Motion)],
            [m for m in at_once if isinstance(m, Range)],
        )


def through_arrays(run: SimulatedRun, particles: int, alpha: float) -> list[float]:
    """Seconds of every epoch whose measurements come as arrays (``ParticleSet``)."""
    from relpos.fusion.estimator_settings import ParticleSettings
    from relpos.fusion.models.motion import MotionNoise
    from relpos.fusion.particle.particle_set import ParticleSet
    from relpos.fusion.timeline import Advance

    users = len(run.priors)
    particle_set = ParticleSet(ParticleSettings(particles, alpha), np.random.default_rng(0))
    for prior in run.priors:
        pose = np.array([prior.x_m, prior.y_m, prior.heading_rad])
        particle_set.add(np.repeat(pose[:, None], particles, axis=1))
    noise, rows, height = MotionNoise(), np.arange(users), np.zeros(users * users)
    spent, busy = [], 0.0
    for motions, ranges in instants(run):
        steps = [Advance(m.time_s, m.node, 1.0, m.dx_m, m.dy_m, m.dtheta_rad) for m in motions]
        mean = np.array([(a.dx_m, a.dy_m, a.dtheta_rad) for a in steps])
        sigma = np.array([noise.sigmas(a) for a in steps])
        first = np.array([r.node - 1 for r in ranges], dtype=np.int64)
        second = np.array([r.peer - 1 for r in ranges], dtype=np.int64)
        range_m = np.array([r.range_m for r in ranges])
        started = time.thread_time()
        particle_set.predict(rows, mean, sigma)
        if ranges:
            particle_set.update(first, second, range_m, height[: len(ranges)])
        busy += time.thread_time() - started
        if ranges:
            spent.append(busy)
            busy = 0.0
    return spent


def through_interface(run: SimulatedRun, estimator: str, **settings: float) -> list[float]:
    """Seconds of every epoch through ``process``, measurement by measurement."""
    made = fusion.make(estimator, run.priors, settings, 0)
    spent, busy, ranged = [], 0.0, False
    for measurement in run.measurements:
        if isinstance(measurement, Motion) and ranged:
            spent.append(busy)
            busy, ranged = 0.0, False
        ranged |= isinstance(measurement, Range)
        started = time.thread_time()
        made.process(measurement)
        busy += time.thread_time() - started
    return spent


def table(work: Work) -> Sheet:
    """Time per UWB epoch, measured in this process while nothing else of ours runs."""
    run = simulate_paper("paper", 0)
    short = simulate_paper("paper", 0, {"seconds": 120})
    through_interface(short, "particle", particles=10, alpha=0.1)  # the compiler's share
    rows, medians = [], {}
    for count in PARTICLES:
        of = short if count > 1000 else run
        arrays = np.array(through_arrays(of, count, 0.01))
        whole = np.array(through_interface(of, "particle", particles=count))
        medians[count] = float(np.median(arrays)), float(np.median(whole))
        rows.append(
            (count, medians[count][0], float(np.quantile(arrays, 0.1)), medians[count][1],
             float(np.quantile(whole, 0.1)), PAPER_S.get(count, ""))
        )  # fmt: skip

    def draw(canvas: Canvas) -> None:
        axes = canvas.add_subplot()
        for k, label in enumerate(("measurements as arrays", "through process(), with estimates")):
            axes.plot(PARTICLES, [1e3 * medians[c][k] for c in PARTICLES], color=COLOURS[k],
                      marker=MARKERS[k], label=label)  # fmt: skip
        axes.plot(list(PAPER_S), [1e3 * s for s in PAPER_S.values()], color=INK, marker="*",
                  markersize=10, linestyle=":", label="paper (i5-4200M)")  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="particles per user M",
                 ylabel="time per UWB epoch (ms)")  # fmt: skip
        axes.legend()

    return Sheet(
        "running-time",
        "Running time over the number of particles",
        "Median time of one UWB epoch of six users: two displacements each and about 5.3 ranges; "
        "one thread of this computer, which may be busy. The paper's is per measurement.",
        ("particles", "arrays_median_s", "arrays_tenth_s", "process_median_s", "process_tenth_s",
         "paper_s"),
        rows,
        draw,
        tuple(
            Beside(f"M {count}", f"{1e3 * seconds:g}", 1e3 * medians[count][1], unit="ms")
            for count, seconds in PAPER_S.items()
        ),
    )  # fmt: skip
