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
    from relpos.cli import output
    from relpos.evaluation import scoring
    from relpos.runs import read_estimates
    from relpos.sources import load

    recording = load(run)
    scoring.need_truth(recording)
    bound = scoring.bound_of(recording)
    score = scoring.evaluate(
        recording, read_estimates(estimate), bound=None if bound is None else bound.totals()
    )
    if json:
        output.print_json(score.as_json())
    else:
        output.print_evaluation(score)
