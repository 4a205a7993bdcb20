"""``relpos node set`` and ``relpos node reboot``: a node's settings, read back and shown."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Annotated

import typer

from relpos.errors import DeviceError

if TYPE_CHECKING:
    from relpos.link.session import Session
    from relpos.nodes.settings import Change

Port = Annotated[str, typer.Argument(metavar="PORT", help="The coordinator's port.")]
Node = Annotated[
    int | None,
    typer.Option(min=1, max=254, help="Which node. (default: the only one that is heard)"),
]


def set_node(
    port: Port,
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME VALUE]...",
            help="What to set; without any, what is set is shown. Names: report-period, "
            "ranging-period, status-period (s), leg-length, stature (m), step-gain, team-size, "
            "step-reports (off, on), led (off, on, health).",
        ),
    ] = None,
    node: Node = None,
) -> None:
    """Show or change a node's settings, without reflashing it.

    `relpos node set PORT --node 3 stature 1.78 led off`
    """
    from relpos.link.live import open_port
    from relpos.link.session import open_session
    from relpos.nodes.settings import SETTINGS, parse_changes

    try:
        changes = parse_changes(words or [])
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="NAME VALUE") from None
    with closing(open_port(port)) as device:
        session = open_session(device, node)
        if not changes:
            rows = []
            for setting in SETTINGS:
                value = setting.shown(session.setting(setting.code))
                rows.append((setting.name, value, setting.meaning))
            _print(f"Node {session.node}", ("setting", "value", "meaning"), rows)
            return
        _apply(session, changes)


def _apply(session: Session, changes: Sequence[Change]) -> None:
    rows = []
    for change in changes:
        setting = change.setting
        before = session.setting(setting.code)
        session.demand(setting.code, change.raw)
        # Read anew: not what the node was told, what it has.
        after = session.setting(setting.code)
        if after != change.raw:
            raise DeviceError(
                f"node {session.node}: {setting.name} is {setting.shown(after)} instead of "
                f"{setting.shown(change.raw)}"
            )
        rows.append((setting.name, setting.shown(before), setting.shown(after)))
    _print(f"Node {session.node}", ("setting", "before", "now"), rows)


def reboot(
    port: Port,
    node: Node = None,
) -> None:
    """Restart a node, and wait until it is heard again."""
    from relpos.link.live import open_port
    from relpos.link.session import open_session

    with closing(open_port(port)) as device:
        session = open_session(device, node)
        started_s = time.monotonic()
        boot = session.restart()
        typer.echo(
            f"node {session.node} has restarted in {time.monotonic() - started_s:.1f} s "
            f"(start {boot})"
        )


def _print(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title)
    for column in columns:
        table.add_column(column)
    for row in rows:
        table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 120).print(table)
