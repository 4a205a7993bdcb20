"""``relpos node radio``: an XBee module's settings, written to it or printed for X-CTU."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer

from relpos.cli import output


def _hexadecimal(text: str, low: int, high: int, option: str) -> int:
    try:
        value = int(text, 16)
    except ValueError:
        value = -1
    if not low <= value <= high:
        raise typer.BadParameter(f"'{text}': {low:X} to {high:X}", param_hint=option)
    return value


def radio(
    port: Annotated[
        str | None,
        typer.Argument(
            help="A module in a USB adapter. Without it the lines for X-CTU are printed.",
        ),
    ] = None,
    node: Annotated[
        int | None, typer.Option(min=1, max=254, help="The node whose module it is.")
    ] = None,
    coordinator: Annotated[
        bool, typer.Option("--coordinator", help="It is the coordinator's, on the laptop.")
    ] = False,
    pan: Annotated[str, typer.Option(metavar="HEX", help="Network; the same for all.")] = "3332",
    channel: Annotated[
        str, typer.Option(metavar="HEX", help="0B to 1A (XBee-PRO S1: 0C to 17).")
    ] = "0C",
) -> None:
    """Set up an XBee module, or print what to type.

    Finds the module whether it is new (9600 baud, transparent) or has been set before, writes
    everything, keeps it, and reads it back.
    """
    from relpos.link.port import open_port
    from relpos.nodes import radio as modules

    if coordinator == (node is not None):
        raise typer.BadParameter("one of the two", param_hint="--node N, --coordinator")
    wanted = modules.parameters(
        node or 0,
        _hexadecimal(pan, 0, 0xFFFF, "--pan"),
        _hexadecimal(channel, modules.CHANNELS[0], modules.CHANNELS[-1], "--channel"),
    )
    if port is None:
        for line, meaning in modules.command_lines(wanted):
            typer.echo(f"{line:10}  {meaning}")
        return
    with output.working("looking for the module"):
        written = modules.configure(partial(open_port, port), wanted)
    columns = ("", "before", "now", "meaning")
    title = "Coordinator" if coordinator else f"Module of node {node}"
    table = output.table(columns, columns, title=title)
    for one in written:
        p = one.parameter
        table.add_row(p.command, f"{one.before:X}", f"{p.value:X}", p.meaning)
    output.console().print(table)
    typer.echo("stored in the module and read back")
