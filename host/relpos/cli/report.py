"""``relpos report``: one page of a run, for people, and its numbers, for scripts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from relpos import extras
from relpos.cli import output
from relpos.cli.estimators import BANK, EstimatorName


def report(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run directory or recording, with truth or not.")
    ],
    estimate: Annotated[
        Path | None,
        typer.Option("--estimate", metavar="DIR", help="Where estimate.csv lies. (default: fuse)"),
    ] = None,
    estimator: EstimatorName = BANK,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A setting of the estimator."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the estimator's randomness.")] = 0,
    smooth: Annotated[bool, typer.Option("--smooth", help="Smooth over the whole run.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="The page. (default: out/NAME/report.html)"),
    ] = None,
    figures: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Also write every figure to this directory: NAME.svg and NAME.png."
        ),
    ] = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print the numbers as JSON; a page only with --out.")
    ] = False,
) -> None:
    """Write one page of a run: tracks, errors, consistency, ranging, health, and the numbers.

    The estimate is read from --estimate, or made now. The page is one self-contained file; it
    holds all numbers, the metrics of ISO/IEC 18305 among them, also as JSON.
    """
    from relpos import api
    from relpos.evaluation import report as reports
    from relpos.evaluation.result import read_result

    if not json or out is not None or figures is not None:
        extras.require("report")
    recording = api.load(run)
    where = out or (None if json else Path("out") / recording.name / "report.html")
    if where is not None:
        output.check_file(where)
    if figures is not None:
        output.check_folder(figures)
    if estimate is not None:
        result = read_result(estimate)
    else:
        chosen = output.parse_settings(settings or [])
        with output.progress(output.STAGES) as progress:
            result = api.fuse(
                recording, estimator, seed=seed, settings=chosen, smooth=smooth, progress=progress
            )
    with output.working("drawing"):
        words = [] if estimate is None else [f"relpos report {run} --estimate {estimate}"]
        content = reports.gather(recording, result, words=words)
        if where is not None:
            reports.write(content, where, figures)
        elif figures is not None:
            reports.write_figures(content, figures)
    if json:
        output.print_json(content.as_json())
    if where is not None:
        output.remark(f"written to {where}" + (f", figures to {figures}" if figures else ""))
