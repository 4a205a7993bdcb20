"""``relpos replay``: a recording, or a mission, on the live page with a time line."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from relpos.cli import live, output

if TYPE_CHECKING:
    from relpos.live.team_view import LogEntry


def replay(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="A recording (.mcap), or a mission's folder.")
    ],
    view_listen: live.ViewListen = None,
    open_browser: live.OpenBrowser = None,
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="FILE.csv", help="Write a mission's log there, and end."),
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="End after so many.")] = None,
) -> None:
    """Play a recording on the page: pause, speed, any moment, the next alarm or landmark.

    Positions are those that the session had then; nothing is computed anew.
    """
    from relpos import recording
    from relpos.errors import DataError
    from relpos.live.mission import Mission
    from relpos.live.team_view import Hello, LogEntry
    from relpos.recording.moments import Moments
    from relpos.recording.player import Player

    recording.check(None)
    entries: list[LogEntry] = []
    paths = [source]
    name = source.stem
    if source.is_dir():
        mission = Mission.open(source)
        paths, name = mission.recordings(), mission.about.name
        entries = [LogEntry(**e["entry"]) for e in mission.events() if e["kind"] == "log"]
        if not paths:
            raise DataError(f"{source}: nothing is recorded yet")
    if log is not None:
        _write(log, entries)
        output.remark(f"{len(entries)} lines written to {log}")
        return
    moments = Moments(paths)
    hello = Hello(
        name, str(source), "as recorded", moments.started_unix_s, replay=True,
        recorded_unix_s=moments.started_unix_s,
    )  # fmt: skip
    options = live.Options(True, view_listen, open_browser=open_browser)
    page = live.open_page(options, hello)
    try:
        Player(moments, [page], entries).run(seconds)
    finally:
        page.close()
        moments.close()


def _write(path: Path, entries: list[LogEntry]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("time_s", "unix_s", "kind", "node", "by", "text"))
        for e in entries:
            rows.writerow(
                (f"{e.time_s:.2f}", f"{e.unix_s:.2f}", e.kind, e.node or "", e.by, e.text)
            )
