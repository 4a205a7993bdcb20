"""``relpos node list`` and ``relpos node monitor``: the nodes' own reports."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from relpos.cli import output
from relpos.cli.keys import KeyFile
from relpos.cli.node_dialogue import Cable, Port, link_of, open_device
from relpos.errors import DeviceError

if TYPE_CHECKING:
    from rich.table import Table

    from relpos.nodes.monitor import TeamMonitor

PLAIN_TABLE_EVERY_S = 5.0
REFRESH_S = 0.5
HEALTH = "health"
_COLOURS = {"green": "green", "yellow": "yellow", "red": "bold red"}


def list_nodes(
    port: Port,
    seconds: Annotated[
        float, typer.Option(min=1.0, help="How long to listen; a status comes every ten seconds.")
    ] = 12.0,
    key_file: KeyFile = None,
    cable: Cable = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """List the nodes that are heard: id, firmware, uptime, last restart, supply, link, boots."""
    with output.working(f"listening for {seconds:g} s"):
        now_s, monitor = deque(_watch(port, seconds, key_file, cable), maxlen=1)[0]
    rows = monitor.rows(now_s)
    if json:
        output.print_json(
            {"port": port, "listened_s": seconds, "team_key": key_file is not None, "nodes": rows}
        )
        return
    if not rows:
        # The link has reported frames under another key.
        why = " under this key" if monitor.foreign_frames else ""
        raise DeviceError(
            f"{port}: no node is heard{why}: are they switched on, and is this the coordinator's "
            "port?"
        )
    if monitor.foreign_frames:
        output.remark(f"not all are shown: {_foreign(monitor)}")
    output.console().print(_list_table(rows))


def monitor(
    port: Port,
    seconds: Annotated[
        float | None, typer.Option(min=1.0, help="End after so long. (default: Ctrl-C ends)")
    ] = None,
    key_file: KeyFile = None,
    cable: Cable = False,
) -> None:
    """Watch the nodes: a live table with everyone's health.

    Green: all well. Yellow: works with less than it should have. Red: silent, or of no use. The
    last column says why; docs/nodes.md has the limits.
    """
    from rich.console import Console
    from rich.live import Live

    console = Console(width=None if sys.stdout.isatty() else 140)
    if not console.is_terminal:
        _print_now_and_then(console, port, seconds, key_file, cable)
        return
    with Live(_monitor_table([], ""), console=console, auto_refresh=False) as live:
        shown_s = 0.0
        try:
            for now_s, monitor in _watch(port, seconds, key_file, cable):
                if time.monotonic() - shown_s > REFRESH_S:
                    shown_s = time.monotonic()
                    live.update(
                        _monitor_table(monitor.rows(now_s), _foreign(monitor)), refresh=True
                    )
        except KeyboardInterrupt:
            return


def _print_now_and_then(
    console: Any, port: str, seconds: float | None, key_file: Path | None, cable: bool
) -> None:
    printed_s = time.monotonic()
    table = _monitor_table([], "")
    try:
        for now_s, monitor in _watch(port, seconds, key_file, cable):
            table = _monitor_table(monitor.rows(now_s), _foreign(monitor))
            if time.monotonic() - printed_s >= PLAIN_TABLE_EVERY_S:
                printed_s = time.monotonic()
                console.print(table)
    except KeyboardInterrupt:
        return
    console.print(table)


def _watch(
    port: str, seconds: float | None, key_file: Path | None, cable: bool
) -> Iterator[tuple[float, TeamMonitor]]:
    """The team as it is seen, with the present time on the monitor's clock; until the time is over.

    Beacons are sent meanwhile, so that what is seen is how the team works with a host.
    """
    from relpos.link.authentication import KEYLESS
    from relpos.link.beacon import HostBeacons
    from relpos.link.port import observe, send
    from relpos.nodes.monitor import TeamMonitor

    monitor = TeamMonitor()
    remarks_shown = 0
    started_s = time.monotonic()

    def clock() -> float:
        return time.monotonic() - started_s

    with link_of(key_file) as link, closing(open_device(port, cable)) as device:
        if link.keyless:
            output.remark(KEYLESS)
        beacons = HostBeacons(link)
        for batch in observe(device, link, clock):
            elapsed_s = clock()
            if not cable:  # which would reach one node alone
                send(device, beacons.due(elapsed_s))
            now_s = elapsed_s if link.virtual_s is None else link.virtual_s
            monitor.update(now_s, link.decoder, batch)
            while remarks_shown < len(link.decoder.remarks):
                output.remark(link.decoder.remarks[remarks_shown])
                remarks_shown += 1
            yield now_s, monitor
            if seconds is not None and elapsed_s > seconds:
                return


def _foreign(monitor: TeamMonitor) -> str:
    """Return a note on frames under another key; empty where there are none."""
    if not monitor.foreign_frames:
        return ""
    return f"{monitor.foreign_frames} frames came under another key (give the team's: --key-file)"


def _list_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    columns = ("node", "firmware", "up", "started by", "boots", "supply", "RSSI", "lost", HEALTH)
    table = output.table(columns, (HEALTH, "started by"))
    for row in rows:
        table.add_row(
            str(row["node"]),
            _text(row["firmware"]),
            _duration(row["uptime_s"]),
            _text(row["reset_cause"]).replace("_", " "),
            str(row["boots"]),
            _volts(row["battery_v"]),
            _dbm(row["rssi_dbm"]),
            _percent(row["loss"]),
            _coloured(row),
        )
    return table


def _monitor_table(rows: Sequence[Mapping[str, Any]], foreign: str) -> Table:
    title = None if rows else "no node is heard yet"
    columns = ("node", "supply", "RSSI", "lost", "seen", "frames", "ranging", "neighbours", HEALTH)
    table = output.table(columns, (HEALTH,), title=title, caption=foreign or None)
    for row in rows:
        ranging = _percent(row["ranging"])
        if row["exchanges"]:
            ranging += f" of {row['exchanges']}"
        neighbours = _text(row["neighbours"], 0)
        if row["team"]:
            neighbours += f" of {row['team'] - 1:.0f}"
        table.add_row(
            str(row["node"]),
            _volts(row["battery_v"]),
            _dbm(row["rssi_dbm"]),
            _percent(row["loss"]),
            f"{row['seen_s']:.1f} s",
            str(row["received"]),
            ranging,
            neighbours,
            _coloured(row),
        )
    return table


def _coloured(row: Mapping[str, Any]) -> str:
    words = row["health"]
    if row["reasons"]:
        words += ": " + ", ".join(row["reasons"])
    return f"[{_COLOURS[row['health']]}]{words}[/]"


def _text(value: Any, digits: int | None = None) -> str:
    if value is None:
        return "-"
    return str(value) if digits is None else f"{value:.{digits}f}"


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    hours, minutes = divmod(int(seconds) // 60, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {int(seconds) % 60:02d} s"


def _volts(value: float | None) -> str:
    return f"{value:.2f} V" if value else "-"


def _dbm(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} dBm"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"
