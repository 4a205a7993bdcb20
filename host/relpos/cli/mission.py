"""``relpos mission``: a mission that survives its sessions."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from relpos.cli import live, output
from relpos.cli.estimators import BANK, EstimatorName
from relpos.cli.fuse import Initial, Job, fuse_live, replay_run
from relpos.cli.keys import KeyFile, make_link, team_key

if TYPE_CHECKING:
    from relpos.cli.waiting import Choice
    from relpos.link.port import Link
    from relpos.live.inputs import Received
    from relpos.live.mission import Mission, Resumed
    from relpos.live.session import Outcome
    from relpos.recording.reader import Recording

DEMO_NODES = 6
DEMO_S = 1800.0
PATIENCE_S = 5.0
"""How long a mission waits for its page's port."""


def mission(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The mission's folder.")],
    source: Annotated[
        str | None,
        typer.Argument(
            help="Serial port or pyserial URL. (default: the one before, else chosen on the page)",
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="The mission's name.")] = None,
    initial: Annotated[
        Initial, typer.Option(help="Where the nodes start in the first session.")
    ] = Initial.UNKNOWN,
    estimator: EstimatorName = BANK,
    post: live.Post = None,
    view_listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address of the page; 127.0.0.1: here alone.")
    ] = "0.0.0.0",
    https: live.Https = False,
    open_browser: live.OpenBrowser = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="End after so many.")] = None,
    invite: Annotated[
        str | None,
        typer.Option(
            metavar="ROLE",
            help="Print an address for one more device: look, acknowledge or command.",
        ),
    ] = None,
    key_file: KeyFile = None,
) -> None:
    """Begin a mission, or go on with the one in FOLDER.

    Everything is in the folder: recordings, names, board, alarms and who has acknowledged them,
    the log, devices. After a crash, a power cut or Ctrl-C the same command goes on: with the same
    map, on the same address, and for the devices that were let in. The page's address lets in one
    device within five minutes; --invite prints another while the mission runs. Without a SOURCE
    the commander chooses one on the page (port, recording, run directory, demo), starts and ends.
    """
    from relpos.link.port import check_port
    from relpos.live.mission import ABOUT, Mission
    from relpos.view.access import DEFAULT_PORT, check_libraries, listen

    check_libraries()  # Before there is a folder.
    if invite is not None:
        _print_invitation(Mission.open(folder), invite, view_listen)
        return
    team_key(key_file)
    known = (folder / ABOUT).exists()
    found = Mission.open(folder, source if known else source or "", name)
    found.about.post = post or found.about.post
    with found.lock():
        if source:
            check_port(source)
        before = found.about.port
        # The page's server outlives a session that was killed, for a moment.
        patience_s = 0.0 if before is None else PATIENCE_S
        door, access = listen(view_listen, before or DEFAULT_PORT, patience_s)
        with door:
            if before not in (None, access.port):
                output.remark(f"the page was at port {before}: devices open its new address")
            # On the disk before anybody has the address.
            found.about.port, found.about.https = access.port, https
            found.save()
            options = live.Options(
                True, view_listen, https, open_browser, seconds, door=(door, access)
            )
            common = initial is Initial.COMMON
            if source:
                _run(found, options, estimator, key_file, common=common)
            else:
                _run_chosen(found, options, estimator, key_file, common=common)


def _run_chosen(
    found: Mission,
    options: live.Options,
    estimator: str,
    key_file: Path | None,
    *,
    common: bool,
) -> None:
    """Run sessions that are started and ended on the page, until Ctrl-C or the options' end.

    A mission with a source goes on at once, or as soon as its port is there.
    """
    from relpos.cli.waiting import Choice, choose
    from relpos.errors import RelposError, words_of

    source = found.about.source
    choice = Choice(source, found.about.name, common) if source else None

    Job("", estimator, {}, 0, found.path).prepare()
    end_s = math.inf if options.seconds is None else time.monotonic() + options.seconds
    trouble, awaited = "", ""
    while (left_s := end_s - time.monotonic()) > 0.0:
        if choice is None:
            choice = choose(found, options, trouble, left_s, awaited)
            options = replace(options, open_browser=False)
        if choice is None:
            return
        is_own = choice.source == found.about.source
        left_s = end_s - time.monotonic()
        options = replace(options, seconds=None if math.isinf(left_s) else max(left_s, 0.0))
        try:
            if is_own:
                outcome = _run(found, options, estimator, key_file, common=choice.common)
            else:
                outcome = _exercise(found, choice, options, estimator)
        except Exception as error:
            known = isinstance(error, RelposError | OSError)
            trouble = words_of(error) if known else f"the session has failed: {error!r}"
            output.remark(trouble)
            awaited = choice.source if is_own else ""
            choice = None
            continue
        choice, trouble, awaited = None, "", ""
        if not outcome.ended_on_page:
            return


def _exercise(found: Mission, choice: Choice, options: live.Options, estimator: str) -> Outcome:
    """Show a demo, a recording or a run; nothing of it enters the mission but its devices."""
    from relpos.cli import demo
    from relpos.cli.replay import play
    from relpos.cli.waiting import DEMO, device_event
    from relpos.emulator.team import TeamConfig
    from relpos.live.assembly import MissionPlan
    from relpos.live.mission import JOURNAL, Journal, Resumed
    from relpos.live.session import Outcome

    source = choice.source
    exercise = found.exercise(source)
    devices = [event for event in found.events() if event["kind"] == "device"]
    options = replace(
        options,
        debrief=False,
        mission=MissionPlan(exercise, Resumed(devices)),
    )
    if choice.is_recorded:
        with contextlib.closing(Journal(exercise.path / JOURNAL)) as journal:
            ended = play(Path(source), options, lambda body: journal.keep(device_event(body)))
        return Outcome(ended_on_page=ended)
    job = Job(source, estimator, {}, 0, exercise.path / "session-1")
    if source == DEMO:
        team = TeamConfig("paper", DEMO_NODES, DEMO_S, 0, str(demo.Board.NATIVE), ())
        return demo.fuse_emulated(team, job, options, as_json=False)
    return replay_run(job, None, options, as_json=False)


def _run(
    found: Mission,
    options: live.Options,
    estimator: str,
    key_file: Path | None,
    *,
    common: bool,
) -> Outcome:
    """Run one session of the mission."""
    from relpos.live.assembly import MissionPlan
    from relpos.live.clock import SessionClock
    from relpos.live.inputs import PortInput
    from relpos.runs import Description

    about, resumed = found.about, found.resume()
    if resumed.on_new_map:
        found.put_tracks_away(resumed)
    jumped = found.keep_time(resumed)
    if jumped is not None:
        output.remark(jumped)
    # A session that was killed before its first checkpoint begins once more as it was begun.
    common = (common and not resumed.priors) or (about.common and resumed.begins)
    about.sessions, about.ended_unix_s, about.common = about.sessions + 1, None, common
    job = Job(about.source, estimator, {}, 0, found.path / f"session-{about.sessions}")
    job.prepare(resumed.priors)
    link, seen = make_link(key_file)
    known = {} if seen is None else dict(seen.load())
    port = PortInput(
        about.source,
        link,
        seen,
        clock=SessionClock(about.started_unix_s),
        reopen=True,
        earlier=_earlier(found, resumed, link, known),
    )
    found.save()
    if resumed.events:
        output.remark(f"the mission {about.name} goes on: session {about.sessions}")
    options = replace(
        options, record=found.recording(about.sessions), mission=MissionPlan(found, resumed)
    )
    options.check()
    outcome = fuse_live(
        job,
        port,
        options,
        description=Description(name=about.name, source="received in a mission").with_post(
            about.post
        ),
        priors=resumed.priors,
        common=common,
        as_json=False,
    )
    about.ended_unix_s = time.time()
    found.save()
    output.remark(f"to see it once more: relpos replay {found.path}")
    return outcome


def _earlier(
    found: Mission, resumed: Resumed, link: Link, counters: dict[int, int]
) -> Iterator[Received]:
    """Yield what was recorded since the checkpoint, and a little before."""
    from relpos.errors import DataError
    from relpos.live.mission import WARM_UP_S, read_again
    from relpos.recording import open_recording

    if not resumed.on_new_map:
        # What is read again came before the counters that were stored.
        link.decoder.expect_from_start()
        chosen: list[Recording] = []
        for path in reversed(found.recordings()):
            try:
                recording = open_recording(path)
                first = next(recording.inputs(), None)
            except DataError:
                continue
            chosen.insert(0, recording)
            # A session that received nothing has nothing of the seconds before the checkpoint.
            if first is not None and first[0] <= resumed.arrived_s - WARM_UP_S:
                break
        inputs = chain.from_iterable(recording.inputs() for recording in chosen)
        yield from read_again(inputs, link.feed, resumed)
    link.decoder.expect_after(counters)


def _print_invitation(found: Mission, role: str, view_listen: str) -> None:
    from relpos.errors import RelposError
    from relpos.live.addresses import parse_listen
    from relpos.view import access as doors
    from relpos.view.devices import Role

    if role not in list(Role):
        raise RelposError(f"--invite {role}: none of {', '.join(Role)}")
    if found.about.port is None:
        raise RelposError(f"{found.path}: no session has run yet")
    host, _ = parse_listen(view_listen)
    door = doors.Access(found.about.port, doors.hosts_of(host), key=found.key)
    url = door.url("/phone" if role == Role.ACKNOWLEDGE else "/", role=Role(role))
    # This process has no certificate; the one that serves the page may.
    typer.echo(url.replace("http:", "https:", 1) if found.about.https else url)
    output.remark(doors.qr_terminal(url))
