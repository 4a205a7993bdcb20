"""``relpos node``: the nodes as devices, through the coordinator or on a cable."""

from __future__ import annotations

import typer

from relpos.cli import (
    node_calibrate,
    node_check,
    node_flash,
    node_radio,
    node_set,
    node_watch,
)

app = typer.Typer(
    no_args_is_help=True, help="Look after the nodes: list, watch, set up, calibrate, restart."
)
app.command("list")(node_watch.list_nodes)
app.command("monitor")(node_watch.monitor)
app.command("set")(node_set.set_node)
app.command("reboot")(node_set.reboot)
app.command("check")(node_check.check)
app.command("flash")(node_flash.flash)
app.command("radio")(node_radio.radio)
app.add_typer(node_calibrate.app, name="calibrate")
