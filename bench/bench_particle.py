"""Time of the particle filter per UWB epoch on the paper's scenario, in microseconds.

    python bench/bench_particle.py [--particles 500]

"correction" is weighing, dual step and resampling of all users; "whole" divides the run's time
through the public interface, motions and estimates included, by its UWB epochs.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from unittest.mock import patch

from relpos import fusion
from relpos.fusion.particle import ParticleFilter, Sight
from relpos.measurements import Range
from relpos.simulation.paper import simulate_paper


def _timed(spent: list[float]) -> Callable[[ParticleFilter, Sight], None]:
    plain = ParticleFilter._correct

    def correct(self: ParticleFilter, sight: Sight) -> None:
        started = time.perf_counter()
        plain(self, sight)
        spent.append(time.perf_counter() - started)

    return correct


def main() -> None:
    """Print the two figures with and without the dual step."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--particles", type=int, default=500)
    given = parser.parse_args()
    run = simulate_paper("paper", 0)
    epochs = len({m.time_s for m in run.measurements if isinstance(m, Range)})
    for alpha in (0.01, 0.0):
        made = fusion.make(
            "particle", run.priors, {"alpha": alpha, "particles": given.particles}, 0
        )
        spent: list[float] = []
        with patch.object(ParticleFilter, "_correct", _timed(spent)):
            started = time.perf_counter()
            for measurement in run.measurements:
                made.process(measurement)
            made.finish()
            whole = time.perf_counter() - started
        spent.sort()
        print(
            f"N 6, M {given.particles}, alpha {alpha:g}: correction median "
            f"{1e6 * spent[len(spent) // 2]:.0f} us, mean {1e6 * sum(spent) / len(spent):.0f} us; "
            f"whole {1e6 * whole / epochs:.0f} us an epoch"
        )


if __name__ == "__main__":
    main()
