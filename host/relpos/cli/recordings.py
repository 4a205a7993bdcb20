"""``relpos recordings``: public recordings that the published figures rest on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from relpos.cli import output

app = typer.Typer(help="List and get the public recordings behind the published figures.")


@app.command("list")
def list_recordings(
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Print each set with its licence and source."""
    from relpos.recordings.catalog import SOURCES

    if json:
        output.print_json(
            {
                source.name: {
                    "holds": source.holds,
                    "licence": source.licence,
                    "address": source.address,
                    "converter": source.convert is not None,
                }
                for source in SOURCES
            }
        )
        return
    for source in SOURCES:
        can = "get" if source.convert is not None else "by hand"
        typer.echo(f"{source.name:30} {can:8} {source.licence:13} {source.holds}")
        typer.echo(f"{'':30} {source.address}")


@app.command("get")
def get(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A set of `recordings list`.")],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where to write; NAME by default.")
    ] = None,
    mirror: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="A copy of the source: its folder or zip file."),
    ] = None,
) -> None:
    """Download a set from its source, convert it to run directories and check it."""
    from relpos.recordings.download import get as fetch
    from relpos.recordings.download import source_of

    source = source_of(name)
    with output.working(f"getting {source.address if mirror is None else mirror}"):
        count = fetch(name, out or Path(name), mirror)
    output.remark(
        f"{count} runs written to {out or name}; licence: {source.licence}; "
        f"cite {source.repository}"
    )
