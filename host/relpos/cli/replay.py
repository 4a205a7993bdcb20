"""``relpos replay``: a recording, or a mission, on the live page with a time line."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from relpos.cli import live, output
from relpos.errors import DataError

if TYPE_CHECKING:
    from relpos.live.alarms import Mayday
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
    if log is not None:
        if log.suffix.lower() not in (".csv", ".kml"):
            raise DataError(f"--log {log}: neither .csv nor .kml")
        output.check_file(log)
        played = Played.open(source)
        from relpos.recording.moments import Moments  # it needs what `open` has looked for

        _write(log, played, Moments(played.paths), pins or ())
        return
    play(source, live.Options(True, view_listen, open_browser=open_browser, seconds=seconds))


@dataclass(frozen=True)
class Played:
    """A recording, or all those of a mission with what stands in its journal."""

    paths: list[Path]
    name: str
    entries: list[LogEntry]
    board: dict[str, Any]
    live_port: int | None = None
    calls: tuple[tuple[float, Mayday], ...] = ()

    @classmethod
    def open(cls, source: Path) -> Played:
        """Read what there is; DataError."""
        from relpos import recording
        from relpos.live.alarms import Mayday
        from relpos.live.board import Board, BoardError
        from relpos.live.mission import Mission

        recording.check(None)
        board = Board()
        if not source.is_dir():
            return cls([source], source.stem, [], board.to_message())
        mission = Mission.open(source)
        entries: list[LogEntry] = []
        calls: list[tuple[float, Mayday]] = []
        for event in mission.events():
            if event["kind"] == "log":
                entries.append(event["entry"])
            elif event["kind"] in ("marker", "plan"):
                with contextlib.suppress(BoardError):
                    board.apply(event)
            elif event["kind"] == "mayday" and {"node", "time_s"} <= event.keys():
                calls.append((event["time_s"], Mayday(event["node"], bool(event.get("on")))))
        paths = mission.recordings()
        if not paths:
            raise DataError(f"{source}: nothing is recorded yet")
        live_port = mission.about.port if mission.is_running() else None
        calls.sort(key=itemgetter(0))
        name, message = mission.about.name, board.to_message()
        return cls(paths, name, entries, message, live_port, tuple(calls))


def play(
    source: Path, options: live.Options, admit: Callable[[dict[str, Any]], None] | None = None
) -> bool:
    """Play it on the page until the options' end or Ctrl-C; return whether the page ended it.

    With ``admit``, of a mission, which keeps the devices that are let in meanwhile.
    """
    played = Played.open(source)
    from relpos.cli.smoothing import Smoothing  # these need what `open` has looked for
    from relpos.live.team_view import Hello
    from relpos.recording.moments import Moments
    from relpos.recording.player import Player

    moments = Moments(played.paths)
    # The mission whose page this is does not go on beside it.
    live_port = None if admit else played.live_port
    hello = Hello(
        played.name, str(source), "as recorded", moments.started_unix_s, replay=True,
        recorded_unix_s=moments.started_unix_s, live_port=live_port, mission=admit is not None,
    )  # fmt: skip
    page = live.open_page(options, hello, source if source.is_dir() else None)
    if options.mission is not None:
        for event in options.mission.resumed.events:
            page.admitted(event)
    page.boarded(played.board)
    # A mission that goes on has no end yet to smooth from.
    smoothing = None if live_port else Smoothing(played.paths)
    player = Player(moments, [page], played.entries, smoothing, admit, played.calls)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            player.run(options.seconds)
    finally:
        if smoothing is not None:
            smoothing.close()
        page.close()
        moments.close()
    return player.ended


def _write(path: Path, played: Played, moments: Moments, pins: Sequence[str]) -> None:
    """Write the log: KML by its suffix, else CSV."""
    from relpos.exchange.content import PLACED
    from relpos.geodesy import parse_pin, place
    from relpos.live.log_files import log_row, write_kml
    from relpos.recording.player import History
    from relpos.runs.appending import write_rows
    from relpos.runs.log import LOG_COLUMNS

    name, entries = played.name, played.entries
    if not entries:
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
