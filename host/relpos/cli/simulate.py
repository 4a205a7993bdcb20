"""``relpos simulate``: write a simulated run directory with its truth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from relpos.cli import output


def simulate(
    scenario: Annotated[
        str,
        typer.Option(metavar="NAME", help="paper, paper-p1, paper-a, paper-h, paper-h2 or lab."),
    ],
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same run.")],
    out: Annotated[Path, typer.Option(metavar="RUN", help="The run directory to write.")],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting of the scenario."),
    ] = None,
) -> None:
    """Simulate a team and write its measurements, priors and truth as a run directory."""
    chosen = output.parse_settings(settings or [])
    from relpos.runs import Description, Landmark, Run, Simulated, save_run
    from relpos.simulation import scenarios

    simulated = scenarios.simulate(scenario, seed, chosen)
    description = Description(
        source=f"relpos simulate --scenario {scenario} --seed {seed}"
        + "".join(f" --set {key}={value}" for key, value in chosen.items()),
        # Everybody's heading at the start is given in the one frame of the rectangle.
        heading_known=any(math.isfinite(p.sigma_rad) for p in simulated.priors),
        priors=simulated.priors,
        simulated=Simulated(scenario, seed, chosen),
    )
    run = Run(
        name=f"{scenario}-{seed}",
        description=description,
        measurements=simulated.measurements,
        events=simulated.events,
        landmarks=tuple(Landmark(name, x, y) for name, (x, y) in simulated.landmarks.items()),
        truth=simulated.truth,
    )
    save_run(run, out)
    output.remark(
        f"{len(run.motions)} motions and {len(run.ranges)} ranges of {len(run.node_ids)} nodes "
        f"written to {out}"
    )
