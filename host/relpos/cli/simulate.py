"""``relpos simulate``: write a simulated run directory with its truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from relpos.cli import output


def simulate(
    dirs: Annotated[list[str] | None, typer.Argument(hidden=True)] = None,
    *,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="paper, paper-p1, paper-a, paper-h, paper-h2, lab, mission-CONDITION, building "
            "or building-CONDITION.",
        ),
    ] = None,
    recordings: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DIR...",
            help="Instead: a team of real walkers, a recording (or a quoted pattern) a wearer.",
        ),
    ] = None,
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

    if (scenario is None) == (recordings is None):
        raise typer.BadParameter("give either --scenario NAME or --recordings DIR DIR...")
    output.keep_recording(out, "simulate", "simulated")
    output.check_folder(out)
    if recordings is not None:
        from relpos.emulator.recorded_team import record_team

        with output.working("running the firmware over the recordings"):
            run = record_team([*recordings, *(dirs or ())], seed, chosen)
    elif dirs:
        raise typer.BadParameter(f"{dirs[0]}: directories go with --recordings")
    else:
        run = api.simulate(str(scenario), seed, **chosen)
    api.save(run, out)
    output.remark(
        f"{len(run.motions)} motions and {len(run.ranges)} ranges of {len(run.node_ids)} nodes "
        f"written to {out}"
    )
