"""Options and sinks that the commands with a live session share."""

from __future__ import annotations

import os
import re
import socket
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from relpos.cli import output
from relpos.cli.keys import make_link
from relpos.live.addresses import parse_listen

if TYPE_CHECKING:
    from relpos.live.assembly import MakeSink, MissionPlan, SessionPlan
    from relpos.live.inputs import Input
    from relpos.live.session import Outcome
    from relpos.live.sinks import Sink
    from relpos.live.team_view import Hello
    from relpos.recording.about import About
    from relpos.recording.recorder import Recorder
    from relpos.recording.viewer import FoxgloveServer
    from relpos.view.access import Access
    from relpos.view.web import WebView

View = Annotated[bool, typer.Option("--view", help="Serve the live page, for browsers.")]
ViewListen = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help="Address of the page: 0.0.0.0 for phones and others. (default: this computer)",
    ),
]
Https = Annotated[
    bool,
    typer.Option(
        "--https", help="Serve with a new certificate, so that phones can share their compass."
    ),
]
OpenBrowser = Annotated[
    bool | None,
    typer.Option("--open/--no-open", help="Open the page here. (default: on a desktop)"),
]

Terminal = Annotated[
    bool, typer.Option("--terminal", help="Show table and map in this terminal, also over ssh.")
]
Me = Annotated[
    int | None,
    typer.Option(metavar="NODE", help="Node from which --terminal measures. (default: the first)"),
]
Cot = Annotated[
    str | None,
    typer.Option(
        metavar="URL",
        help="Send the team as Cursor-on-Target, to ATAK, WinTAK or a server: "
        "udp://239.2.3.1:6969, tcp://HOST:PORT or tls://HOST:PORT; needs --pin.",
    ),
]
PINS = "LAT,LON[,BEARING[,ALTITUDE]][@POINT]"
PIN_HELP = (
    "A known position: latitude, longitude, the compass bearing of world x, the altitude of z = 0 "
    "over WGS84. POINT is the point there: X,Y or NODE or NODE:TIME (default 0,0). Two or more "
    "pins give the bearing."
)
Pins = Annotated[list[str] | None, typer.Option("--pin", metavar=PINS, help=PIN_HELP)]

Post = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="NODE",
        help="The command post's node: nobody wears it; its pressure is the weather.",
    ),
]
Record = Annotated[
    Path | None,
    typer.Option(metavar="FILE.mcap", help="Record all received data, for replay and Foxglove."),
]
Foxglove = Annotated[
    str | None,
    typer.Option(
        metavar="[HOST:PORT]",
        help="Serve the session to Foxglove's viewer. (default: 127.0.0.1:8765)",
    ),
]
FOXGLOVE_AT = "127.0.0.1:8765"
"""The viewer's own default; this computer alone, because its protocol has no password."""
STAGES = {"finishing": "fusing the rest (Ctrl-C: drop it)"}
ADDRESS = re.compile(r"[\w.\-\[\]:]*:\d+|\d+")


def with_default_address(arguments: Sequence[str]) -> list[str]:
    """Return the command line with an address behind each --foxglove that has none."""
    full: list[str] = []
    for k, word in enumerate(arguments):
        full.append(word)
        if word == "--foxglove" and not ADDRESS.fullmatch((*arguments, "")[k + 1]):
            full.append(FOXGLOVE_AT)
    return full


@dataclass(frozen=True)
class Options:
    """Options of the command line for showing and storing a session.

    ``sinks`` make further sinks. With any of them, or the page, the session outlives its port,
    which is opened again when it is back.
    """

    view: bool = False
    view_listen: str | None = None
    https: bool = False
    open_browser: bool | None = None
    seconds: float | None = None
    speed: float = 1.0
    sinks: Sequence[MakeSink] = ()
    screen: bool = False
    """The terminal is drawn upon: nothing else may be printed until the session is over."""
    record: Path | None = None
    foxglove: str | None = None
    debrief: bool = True
    """Whether a session on a port that was shown ends with its page."""
    mission: MissionPlan | None = None
    """Its key signs its devices' tokens."""
    door: tuple[socket.socket, Access] | None = None
    """Where all pages of a mission are served, one after the other."""

    @property
    def shown(self) -> bool:
        """Whether the session is shown or recorded while it runs."""
        return self.watched or self.record is not None

    @property
    def pace(self) -> float:
        """Speed at which a recording is played; 0, as fast as possible, where nothing shows it."""
        return self.speed if self.watched else 0.0

    @property
    def watched(self) -> bool:
        """Whether the session is shown while it runs; its last view stays then."""
        return self.view or bool(self.sinks) or self.foxglove is not None

    def check(self) -> None:
        """Raise RelposError, before minutes of preparing, where an option cannot work."""
        if self.view and self.door is None:
            from relpos.view.access import check_libraries, listen

            check_libraries()
            listen(self.view_listen)[0].close()
        if self.foxglove is not None:
            parse_listen(self.foxglove, "--foxglove")
        if self.record is not None or self.foxglove is not None:
            from relpos import recording

            recording.check(self.record)
        if self.record is not None:
            output.check_file(self.record)
            if not self.record.name.lower().endswith(recording.SUFFIX):
                output.remark(f"{self.record}: an MCAP recording, whatever its name says")


def open_port(port: str, key_file: Path | None, *, teach: bool, reopen: bool) -> Input:
    """Return the team behind a serial port, under the team's key."""
    from relpos.live.inputs import PortInput

    link, seen = make_link(key_file)
    return PortInput(port, link, seen, teach=teach, reopen=reopen)


def run(source: Input, plan: SessionPlan, options: Options) -> Outcome:
    """Run a session with everything that shows or records it; see :func:`live.run_session`."""
    from relpos.live.assembly import run_session

    made: list[Recorder | FoxgloveServer] = []
    page: list[MakeSink] = [lambda hello: open_page(options, hello)] if options.view else []
    sinks = [*page, *options.sinks, *_recorders(options, source, plan, made)]
    later: list[str] = []
    try:
        if options.screen:
            return run_session(source, plan, sinks, remark=later.append)
        with output.progress(STAGES) as progress:
            return run_session(source, plan, sinks, remark=output.remark, progress=progress)
    finally:
        # The page is closed when a recording reports what it could not write at its end.
        troubles = [words for sink in made if (words := sink.trouble()) is not None]
        for words in dict.fromkeys([*later, *troubles]):
            output.remark(words)


def _recorders(
    options: Options, source: Input, plan: SessionPlan, made: list[Recorder | FoxgloveServer]
) -> list[MakeSink]:
    """Return what makes the recorder and Foxglove's server; these are added to ``made``."""
    from relpos import recording

    def record(hello: Hello) -> Sink:
        assert options.record is not None
        made.append(recording.make_recorder(options.record, _about(source, plan, hello)))
        return made[-1]

    def serve(hello: Hello) -> Sink:
        server = recording.serve_foxglove(options.foxglove or "", _about(source, plan, hello))
        output.remark(f"Foxglove: open connection {server.address}")
        made.append(server)
        return server

    wanted = ((record, options.record), (serve, options.foxglove))
    return [make for make, where in wanted if where is not None]


def _about(source: Input, plan: SessionPlan, hello: Hello) -> About:
    """Return all that a replay needs beside the received bytes, except for the key."""
    from relpos.files import displayable
    from relpos.recording.about import About
    from relpos.runs import InitialPose

    link = source.link
    return About(
        round(hello.started_unix_s * 1e9),
        source=displayable(source.name),
        estimator=plan.estimator,
        settings=plan.settings,
        seed=plan.seed,
        initial="common" if plan.common else None,
        own_key=link is not None and not link.keyless,
        newest_counters={} if link is None else link.counters_before,
        resumed=plan.mission is not None and plan.mission.folder.about.sessions > 1,
        # The name of a port is not that of the recording.
        description=replace(
            plan.description,
            name=None if source.is_now else plan.description.name,
            priors=tuple(plan.priors),
            initial_pose=InitialPose.UNKNOWN,
        ),
    )


def terminal_sink(me: int | None) -> MakeSink:
    """Return a maker of the view that draws table and map on stdout."""

    def make(hello: Hello) -> Sink:
        from relpos.view.terminal import TerminalView

        return TerminalView(me, title=f"relpos {hello.source}")

    return make


def cot_sink(url: str, pins: Sequence[str], *, replayed: bool) -> MakeSink:
    """Return a maker of the sender to TAK; DataError at once where URL or pins cannot work."""
    from relpos.extras import require
    from relpos.geodesy import parse_pin
    from relpos.live.cot import CotSender, PinnedFrame, check_url

    check_url(url)
    require("exchange")
    placed = [parse_pin(pin) for pin in pins]
    for words in PinnedFrame(placed).remarks:
        output.remark(words)

    def make(hello: Hello) -> Sink:
        return CotSender(url, placed, exercise=hello.emulated or replayed)

    return make


def open_page(options: Options, hello: Hello, folder: Path | None = None) -> WebView:
    """Serve the page, print its address, and open it on a desktop.

    ``folder`` is that of a mission that is played once more.
    """
    from relpos.view import access as doors
    from relpos.view.devices import Role
    from relpos.view.web import WebView

    if options.door is None:
        listener, access = doors.listen(options.view_listen)
    else:
        listener, access = options.door[0].dup(), options.door[1]
    if options.mission is not None:
        mission = options.mission.folder
        access, folder = replace(access, key=mission.key), folder or mission.path
    access = replace(access, folder=folder)
    if options.https:
        access = replace(access, certificate=doors.make_certificate(access.hosts))
    page = WebView(listener, access, hello)
    output.remark(f"the team's page: {access.url()}")
    if access.reachable:
        if options.mission is None:
            output.remark(f"the wearers' page, for their phones: {access.url('/phone')}")
        output.remark(doors.qr_terminal(access.url("/phone", role=Role.ACKNOWLEDGE)))
    else:
        output.remark("for phones and other computers: --view-listen 0.0.0.0")
    open_browser(options, access.url())
    return page


def open_browser(options: Options, url: str) -> None:
    """Open an address where that is wanted, and visible."""
    wanted = options.open_browser
    if wanted or (wanted is None and _has_desktop()):
        import webbrowser

        webbrowser.open(url)


def _has_desktop() -> bool:
    """Whether a browser window would be visible to the user."""
    if os.environ.get("SSH_CONNECTION"):
        return False
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
