"""``relpos convert``: recordings and estimates from one format to another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from relpos.cli import live
from relpos.errors import DataError
from relpos.exchange.formats import TRAITS, Format, Kind

FILES = [form for form, traits in TRAITS.items() if traits.one_file]


def convert(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="Run or estimate directory, recording (.mcap), trajectories (.tum, .gpx, "
            ".geojson) or a directory of them.",
        ),
    ],
    to: Annotated[Format, typer.Option("--to", help="The wanted format.")],
    out: Annotated[
        Path,
        typer.Option(
            metavar="PATH", help=f"Output: a file for {', '.join(FILES)}; else a directory."
        ),
    ],
    source_format: Annotated[
        Format | None,
        typer.Option("--from", help="Format of SOURCE, if its name does not show it."),
    ] = None,
    run: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="The recording that SOURCE belongs to: names, truth."),
    ] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Surveyed landmarks (CSV: id,x_m,y_m[,z_m]; or .geojson, .gpx): presses become "
            "truth.",
        ),
    ] = None,
    pins: live.Pins = None,
    start: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Time of second 0 of the run: 2026-05-04T09:30:00Z."),
    ] = None,
    kind: Annotated[
        Kind | None, typer.Option("--as", help="Kind of trajectories from another tool.")
    ] = None,
    node: Annotated[
        int | None,
        typer.Option(min=0, help="Node of the trajectory, if its name does not show it."),
    ] = None,
    located: Annotated[
        bool, typer.Option("--located", help="Leave out poses of nodes that are not located.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
) -> None:
    """Convert a recording or an estimate: MCAP, TUM (evo), GeoJSON, GPX, CSV, ROS 2, Rerun.

    With --landmarks, the landmark presses of the wearers and a table of surveyed positions become
    the truth of the run. docs/exchange.md describes the formats.
    """
    from relpos.cli import output
    from relpos.exchange import convert as formats
    from relpos.exchange.times import unix_of
    from relpos.geodesy import parse_pin

    placed = tuple(parse_pin(pin) for pin in pins or ())
    if TRAITS[to].on_map and not placed:
        raise typer.BadParameter(
            f"{to} needs geographic coordinates: give a known position ({live.PINS})",
            param_hint="--pin",
        )
    if out.resolve() == source.resolve():
        raise DataError(f"{out}: --out is SOURCE itself; name another path")
    hints = formats.Hints(
        format=source_format,
        run=run,
        kind=kind,
        node=node,
        start_unix_s=unix_of(start, "--start") if start else None,
        pins=placed,
    )
    content = formats.read(source, hints)
    if landmarks is not None:
        content = formats.with_landmarks(content, landmarks, placed)
    if located:
        content = formats.located_alone(content)
    files, remarks = formats.write(content, to, out, pins=placed, overwrite=overwrite)
    for words in (*content.remarks, *remarks):
        output.remark(words)
    for path in files:
        typer.echo(str(path))
