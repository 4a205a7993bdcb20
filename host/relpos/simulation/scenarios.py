"""Every scenario of the fast simulation by its name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from relpos.errors import RelposError
from relpos.measurements import out_of_bounds
from relpos.simulation import building, missions, paper
from relpos.simulation.lab import simulate_lab

if TYPE_CHECKING:
    from relpos.runs import Run

LAB = "lab"

BOUNDED = (*paper.SCENARIOS, LAB)
"""Those whose Cramer-Rao bound can be computed (:mod:`relpos.evaluation.bounds`)."""

NAMES = (*BOUNDED, *missions.NAMES, *building.NAMES)


def simulate(
    scenario: str, seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> paper.SimulatedRun:
    """Measurements, priors and truth of one run; the same arguments give the same run."""
    if scenario not in NAMES:
        raise RelposError(f"unknown scenario '{scenario}': one of {', '.join(NAMES)}")
    if scenario == LAB:
        return simulate_lab(seed, overrides)
    if scenario in missions.NAMES:
        return missions.simulate_mission(scenario, seed, overrides)
    if scenario in building.NAMES:
        return building.simulate_building(scenario, seed, overrides)
    return paper.simulate_paper(scenario, seed, overrides)


def simulate_run(
    scenario: str, seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> Run:
    """Simulate a run as :func:`relpos.runs.load_run` would read it, with how it was made."""
    from relpos.runs import Description, Landmark, NodeInfo, Run, Simulated

    chosen = {key: str(value) for key, value in (overrides or {}).items()}
    simulated = simulate(scenario, seed, chosen)
    for row in simulated.measurements:
        if name := out_of_bounds(row):
            raise RelposError(
                f"{scenario}: {name} of {getattr(row, name):g} is more than relpos reads: "
                "smaller settings"
            )
    return Run(
        name=f"{scenario}-{seed}",
        description=Description(
            source=f"relpos simulate --scenario {scenario} --seed {seed}"
            + "".join(f" --set {key}={value}" for key, value in chosen.items()),
            # Everybody's heading at the start is given in the one frame of the rectangle.
            heading_known=any(math.isfinite(p.sigma_rad) for p in simulated.priors),
            priors=simulated.priors,
            nodes={node: NodeInfo(post=True) for node in simulated.posts},
            simulated=Simulated(scenario, seed, chosen),
            floors_m=simulated.floors_m,
        ),
        measurements=simulated.measurements,
        events=simulated.events,
        landmarks=tuple(Landmark(name, x, y) for name, (x, y) in simulated.landmarks.items()),
        truth=simulated.truth,
    )
