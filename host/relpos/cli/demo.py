"""``relpos demo``: an emulated team through a serial port into the fusion, shown."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from relpos.cli import fuse, output


class Board(StrEnum):
    """What runs the firmware: this computer, or a simulated board."""

    NATIVE = "native"
    UNO = "uno"
    MEGA = "mega"


def demo(
    board: Annotated[Board, typer.Option(help="What runs the firmware.")] = Board.NATIVE,
    nodes: Annotated[int, typer.Option(min=2, max=20, help="How many people.")] = 6,
    seconds: Annotated[float, typer.Option(min=10.0, help="How long they walk.")] = 300.0,
    scenario: Annotated[str, typer.Option(metavar="NAME", help="Where they walk.")] = "paper",
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same walk.")] = 0,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where the report goes.")] = Path(
        "out/demo"
    ),
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Run the production firmware of an emulated team and show who was where."""
    from relpos.emulator.team import record_team
    from relpos.runs import save_run

    with output.working(f"emulating {nodes} nodes for {seconds:g} s"):
        run = record_team(
            board=str(board), nodes=nodes, seconds=seconds, scenario=scenario, seed=seed
        )
    save_run(run, out / "run")
    job = fuse.Job(str(out / "run"), fuse.EstimatorName.PARTICLE, {}, seed, out)
    fuse.fuse_recording(job, run, run.priors, as_json=json, report=True)
