"""``relpos evaluate``: score an estimate against a run's truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def evaluate(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run directory or FILE.mcap with truth.")
    ],
    estimate: Annotated[
        Path, typer.Option("--estimate", metavar="DIR", help="Where estimate.csv lies.")
    ],
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Print the metrics of an estimate: for the team, per pair and over time."""
    from relpos import api
    from relpos.cli import output

    score = api.evaluate(estimate, api.load(run))
    if json:
        output.print_json(score.as_json())
    else:
        output.print_evaluation(score)
