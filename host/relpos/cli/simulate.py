"""``relpos simulate``: write a simulated run directory with its truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from relpos.cli import output


def simulate(
    scenario: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="paper, paper-p1, paper-a, paper-h, paper-h2, lab or mission-CONDITION.",
        ),
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
    from relpos import api

    run = api.simulate(scenario, seed, **chosen)
    api.save(run, out)
    output.remark(
        f"{len(run.motions)} motions and {len(run.ranges)} ranges of {len(run.node_ids)} nodes "
        f"written to {out}"
    )
