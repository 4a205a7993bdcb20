"""``relpos figures``: the paper's figures and tables, computed anew over many seeds."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from relpos import extras
from relpos.cli import output

NAMES = (
    "tracks-simulation, range-noise, over-time-simulation, particles, wrong-start, running-time, "
    "tracks-lab, over-time-lab, detection"
)


def figures(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to write them.")],
    figure: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help=f"One of {NAMES}; all without it. May be repeated."),
    ] = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Draw an estimator of your own too: MODULE:CLASS, FILE.py:CLASS, or a name that a "
            "package registers. May be repeated.",
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(min=2, help="Runs behind every point.")] = 24,
    first: Annotated[int, typer.Option(min=0, help="The first seed.")] = 0,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; all cores without it.")
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="A Dask scheduler, e.g. tcp://host:8786."),
    ] = None,
) -> None:
    """Draw every figure of the paper's evaluation as SVG, PNG and CSV, and one page of them all."""
    from relpos.evaluation.executors import executor
    from relpos.evaluation.figures import FIGURES, Work, page, save
    from relpos.fusion import plugins

    extras.require("report")
    for name in estimator or []:
        if not plugins.is_plugin(name):
            raise typer.BadParameter(
                f"'{name}' is not MODULE:CLASS; those of relpos are drawn anyway",
                param_hint="--estimator",
            )
        # An estimator that cannot be found is an error before anything is computed.
        plugins.factory(name)
    wanted = list(dict.fromkeys(figure or FIGURES))
    for name in wanted:
        if name not in FIGURES:
            raise typer.BadParameter(f"'{name}' is none of {NAMES}", param_hint="--figure")
    out.mkdir(parents=True, exist_ok=True)
    sheets, pictures = [], []
    started = time.monotonic()
    with executor(cluster, workers) as pool:
        work = Work(range(first, first + seeds), pool, own=tuple(estimator or ()))
        for name in wanted:
            with output.progress() as show:
                work.on_done = partial(show, name)
                sheet = FIGURES[name](work)
            svg, _, _ = save(sheet, out)
            sheets.append(sheet)
            pictures.append(svg)
            output.remark(f"{svg}  ({time.monotonic() - started:.0f} s)")
    again = "".join(f" --figure {name}" for name in figure or [])
    again += "".join(f" --estimator {name}" for name in estimator or [])
    where = out / "index.html"
    page.write(
        sheets,
        pictures,
        where,
        f"relpos figures{again} --seeds {seeds} --first {first}: means over {seeds} seeds "
        "with 95 % confidence intervals. The bound is the posterior Cramer-Rao bound of "
        "filtering, computed at the true path with the true noise levels.",
    )
    output.remark(f"all figures: {where}")
