"""The page of a mission before a session: its commander chooses the source, and starts."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from relpos.cli import live, output
from relpos.errors import DeviceError, RelposError, words_of
from relpos.said import Said, refusal

if TYPE_CHECKING:
    from relpos.live.mission import Journal, Mission
    from relpos.live.requests import Request
    from relpos.view.web import WebView

DEMO = "demo"
FAILED = Said("page-broken", "the mission's page has failed")
SCHEMES = ("socket", "rfc2217")
"""Of pyserial's URLs; others (spy://) write files, which a page must not."""
LOOK_S = 0.05


@dataclass(frozen=True)
class Choice:
    """What a commander has chosen: ``source`` is a port, a recording, a run directory or DEMO."""

    source: str
    name: str
    common: bool

    @property
    def is_recorded(self) -> bool:
        """Whether it is a recording, or a mission, that can be played with a time line."""
        from relpos import sources
        from relpos.live.mission import ABOUT

        return sources.is_recording(self.source) or (Path(self.source) / ABOUT).is_file()

    @property
    def is_port(self) -> bool:
        """Whether a live team is behind it, whose session belongs to the mission."""
        from relpos import sources

        return self.source != DEMO and sources.is_port(self.source)

    @property
    def is_missing(self) -> bool:
        """Whether there is no such port."""
        from relpos.link.port import check_port

        try:
            check_port(self.source)
        except DeviceError:
            return True
        return False

    def check(self) -> None:
        """Raise RelposError where nothing can be opened there."""
        from relpos.link.port import check_port

        scheme, url, _ = self.source.partition("://")
        if url and scheme not in SCHEMES:
            raise RelposError(f"{self.source}: neither a path nor {'://, '.join(SCHEMES)}://")
        if self.is_port:
            check_port(self.source)
        elif not (self.source == DEMO or self.is_recorded or Path(self.source).is_dir()):
            raise RelposError(f"{self.source}: no such port, recording or run directory")


def choose(
    mission: Mission, options: live.Options, trouble: str, seconds: float, awaited: str = ""
) -> Choice | None:
    """Serve the page until a source is chosen; None after ``seconds``, and after Ctrl-C.

    ``trouble`` is why the session before has failed; the port ``awaited``, if it is missing, is
    chosen once it is there.
    """
    from relpos.live.assembly import MissionPlan
    from relpos.live.mission import JOURNAL, Journal, Resumed
    from relpos.live.team_view import Hello

    about = mission.about
    hello = Hello(about.name, "", "", time.time(), mission=True, waiting=True)
    options = replace(options, mission=MissionPlan(mission, Resumed()))
    page = live.open_page(options, hello)
    journal = Journal(mission.path / JOURNAL)
    for event in mission.events():
        if event["kind"] == "device":
            page.admitted(event)
        elif event["kind"] == "log":
            page.logged(event["entry"])
    end_s = time.monotonic() + seconds
    waited = Choice(awaited, about.name, common=False)
    is_missing = bool(awaited) and waited.is_missing
    with contextlib.suppress(KeyboardInterrupt), contextlib.closing(page):
        try:
            while time.monotonic() < end_s:
                for request in page.requests():
                    try:
                        choice = _answer(request, page, mission, journal, trouble)
                    except Exception as error:
                        output.remark(f"request failed: {error!r}; the mission goes on")
                        page.respond(request, refusal(FAILED), 500)
                        continue
                    if choice is not None:
                        return choice
                if is_missing and not waited.is_missing:
                    return waited
                time.sleep(LOOK_S)
        finally:
            journal.close()
    return None


def _answer(
    request: Request, page: WebView, mission: Mission, journal: Journal, trouble: str
) -> Choice | None:
    """Answer a request; return the choice that starts a session."""
    body: dict[str, Any] = request.body
    if request.kind == "device":
        event = device_event(body)
        journal.keep(event)
        page.admitted(event)
        page.respond(request, body)
    elif request.kind == "sources":
        page.respond(request, _sources(mission, trouble))
    elif request.kind == "start":
        choice = Choice(**body)
        try:
            choice.check()
        except (RelposError, OSError) as error:
            page.respond(request, refusal(words_of(error)), 400)
            return None
        mission.about.name = choice.name
        if choice.is_port:
            mission.about.source, mission.about.common = choice.source, choice.common
        mission.save()
        page.respond(request, {"done": True})
        return choice
    else:
        page.respond(request, refusal(Said("not-running", "no session runs yet")), 409)
    return None


def device_event(body: dict[str, Any]) -> dict[str, Any]:
    """Return the journal's event of a device that was let in or shut out without a session."""
    return {"kind": "device", **body, "time_s": 0.0, "unix_s": time.time()}


def _sources(mission: Mission, trouble: str) -> dict[str, Any]:
    """Return what can be chosen: the ports of this computer, and what it was before."""
    from relpos.doctor.computer import Computer

    ports = [
        {"source": port.device, "text": port.description}
        for port in sorted(Computer().ports(), key=lambda port: port.vid is None)
    ]
    about = mission.about
    return {"ports": ports, "before": about.source, "name": about.name, "trouble": trouble}
