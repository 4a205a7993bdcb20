"""Every scenario of the fast simulation by its name."""

from __future__ import annotations

from collections.abc import Mapping

from relpos.errors import RelposError
from relpos.simulation import paper
from relpos.simulation.lab import simulate_lab

LAB = "lab"

NAMES = (*paper.SCENARIOS, LAB)


def simulate(
    scenario: str, seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> paper.SimulatedRun:
    """Measurements, priors and truth of one run; the same arguments give the same run."""
    if scenario not in NAMES:
        raise RelposError(f"unknown scenario '{scenario}': one of {', '.join(NAMES)}")
    if scenario == LAB:
        return simulate_lab(seed, overrides)
    return paper.simulate_paper(scenario, seed, overrides)
