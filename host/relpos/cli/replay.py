"""``relpos replay``: a recording, or a mission, on the live page with a time line."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from relpos.cli import live, output

if TYPE_CHECKING:
    from relpos.live.team_view import LogEntry
    from relpos.recording.moments import Moments


def replay(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="A recording (.mcap), or a mission's folder.")
    ],
    view_listen: live.ViewListen = None,
    open_browser: live.OpenBrowser = None,
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="FILE", help="Write the log there (.csv, .kml), and end."),
    ] = None,
    pins: live.Pins = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="End after so many.")] = None,
) -> None:
    """Play a recording on the page: pause, speed, any moment, the next alarm or landmark.

    Positions are those that the session had then. The smoothed tracks, by the whole recording, are
    computed meanwhile and drawn beside them once they are there.
    """
    from relpos import recording
    from relpos.cli.smoothing import Smoothing
    from relpos.errors import DataError
    from relpos.live.board import Board, BoardError
    from relpos.live.mission import Mission
    from relpos.live.team_view import Hello
    from relpos.recording.moments import Moments
    from relpos.recording.player import Player

    recording.check(None)
    entries: list[LogEntry] = []
    paths = [source]
    name = source.stem
    live_port = None
    board = Board()
    if source.is_dir():
        mission = Mission.open(source)
        paths, name = mission.recordings(), mission.about.name
        entries = [e["entry"] for e in mission.events() if e["kind"] == "log"]
        for event in mission.events():
            if event["kind"] in ("marker", "plan"):
                with contextlib.suppress(BoardError):
                    board.apply(event)
        live_port = mission.about.port if mission.is_running() else None
        if not paths:
            raise DataError(f"{source}: nothing is recorded yet")
    moments = Moments(paths)
    if log is not None:
        _write(log, moments, name, entries, pins or ())
        return
    hello = Hello(
        name, str(source), "as recorded", moments.started_unix_s, replay=True,
        recorded_unix_s=moments.started_unix_s, live_port=live_port,
    )  # fmt: skip
    options = live.Options(True, view_listen, open_browser=open_browser)
    page = live.open_page(options, hello, source if source.is_dir() else None)
    page.boarded(board.to_message())
    # A mission that goes on has no end yet to smooth from.
    smoothing = None if live_port else Smoothing(paths)
    try:
        Player(moments, [page], entries, smoothing).run(seconds)
    finally:
        if smoothing is not None:
            smoothing.close()
        page.close()
        moments.close()


def _write(
    path: Path, moments: Moments, name: str, known: list[LogEntry], pins: Sequence[str]
) -> None:
    """Write the log: KML by its suffix, else CSV."""
    from relpos.exchange.content import PLACED
    from relpos.geodesy import parse_pin, place
    from relpos.live.log_files import log_row, write_kml
    from relpos.recording.player import History
    from relpos.runs.appending import write_rows
    from relpos.runs.log import LOG_COLUMNS

    if known:
        entries = known
    else:
        history = History()
        history.read(moments, {}, ())
        entries = history.events

    def where(node: int, time_s: float | None) -> tuple[float, float] | None:
        found = moments.estimate_at(moments.from_s if time_s is None else time_s)
        at = [n for n in (found.nodes if found else ()) if n.node == node]
        return (at[0].x_m, at[0].y_m) if at and at[0].status in PLACED else None

    if path.suffix.lower() != ".kml":
        write_rows(path, LOG_COLUMNS, [log_row(entry) for entry in entries])
    elif not pins:
        write_kml(path, name, entries)
        output.remark("without --pin the log has times, and no places")
    else:
        placing = place([parse_pin(pin) for pin in pins], where)
        for words in placing.remarks:
            output.remark(words)

        def on_map(entry: LogEntry) -> tuple[float, float] | None:
            there = None if entry.node is None else where(entry.node, entry.time_s)
            if there is None:
                return None
            latitude, longitude = placing.frame.to_map([there[0]], [there[1]])
            return float(latitude[0]), float(longitude[0])

        write_kml(path, name, entries, on_map)
    output.remark(f"{len(entries)} lines written to {path}")
