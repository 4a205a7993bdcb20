"""Assembles a live session: files, sinks, composer and fusion; and runs it to its end."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from relpos.fusion.post import posts_of
from relpos.link.authentication import KEYLESS
from relpos.live.composer import Composer
from relpos.live.files import FileSink
from relpos.live.fusion_thread import FusionThread, MakeEstimator
from relpos.live.inputs import Input
from relpos.live.mission import JOURNAL, Journal, Mission, MissionFiles, Resumed
from relpos.live.session import LiveSession, Outcome
from relpos.live.sinks import Sink
from relpos.live.team_view import Hello, Level
from relpos.measurements import Prior
from relpos.runs import Description

_M_MMAP_THRESHOLD = -3
"""Of glibc's ``mallopt``: blocks from that size on are mapped, and returned when they are freed."""

MakeSink = Callable[[Hello], Sink]
"""Makes a sink once the name, source and start of the session are known."""


@dataclass(frozen=True)
class MissionPlan:
    """A mission that the session belongs to, and what its sessions so far have left behind."""

    folder: Mission
    resumed: Resumed


@dataclass(frozen=True)
class SessionPlan:
    """How a session is fused, and where its files go.

    ``make_estimator`` makes the estimator of the ``priors``, or, with ``common``, of one common
    start of all nodes. ``estimator``, ``settings`` and ``seed`` describe it for the page and for
    recordings. The session ends after ``seconds``; with ``lasts`` it goes on after the end of its
    input.
    """

    name: str
    out: Path
    description: Description
    make_estimator: MakeEstimator
    estimator: str
    settings: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    priors: Sequence[Prior] = ()
    common: bool = False
    emulated: bool = False
    seconds: float | None = None
    lasts: bool = False
    mission: MissionPlan | None = None


def run_session(
    source: Input,
    plan: SessionPlan,
    make_sinks: Sequence[MakeSink] = (),
    *,
    remark: Callable[[str], None] = lambda _: None,
    progress: Callable[[str, int, int | None], None] = lambda stage, done, total: None,
) -> Outcome:
    """Run a session until it ends; its files are in ``plan.out``. Ctrl-C ends it without error.

    A failure is in the outcome, and the files hold what came before. ``remark`` gets every message
    for the user, ``progress`` a stage ("received", "finishing") and a count.
    """
    _return_what_is_freed()
    started_unix_s = time.time() - source.now_s()
    hello = Hello(
        plan.name,
        source.name,
        plan.estimator,
        started_unix_s,
        plan.emulated,
        replay=not source.is_now,
        recorded_unix_s=source.recorded_unix_s,
        mission=plan.mission is not None,
    )
    fusion = FusionThread(
        plan.make_estimator, plan.priors, common=plan.common, restarts=plan.mission is not None
    )
    # A mission goes on from its checkpoint.
    common = plan.common and plan.mission is None
    priors = None if plan.common or plan.mission is not None else plan.priors
    files = FileSink(plan.out, plan.description, priors, common=common, keep_received=source.is_now)
    sinks: list[Sink] = [files, *(make(hello) for make in make_sinks)]
    kept = plan.mission
    journal = None if kept is None else Journal(kept.folder.path / JOURNAL)
    session = LiveSession(
        source,
        fusion,
        Composer(plan.description.names, posts_of(plan.description.nodes)),
        sinks,
        seconds=plan.seconds,
        lasts=plan.lasts,
        remark=remark,
    )
    if kept is not None and journal is not None:
        session.keep(journal, kept.resumed)
        session.add_sink(MissionFiles(kept.folder, journal, kept.resumed.since_s))
        if kept.resumed.on_new_map:
            session.begin_map()
        for sink in sinks:
            sink.resumed(kept.resumed.tracks)
    link = source.link
    if source.is_now and not plan.emulated and link is not None and link.keyless:
        remark(KEYLESS)
        session.post("no-key", Level.INFO, KEYLESS)
    for count, _ in enumerate(session.run()):
        progress("received", count, None)
    progress("finishing", 0, 0)
    try:
        return session.finish()
    except KeyboardInterrupt:
        return session.finish(abandon=True)


def _return_what_is_freed() -> None:
    """Keep no freed block of a megabyte or more for later.

    By itself glibc learns to keep what was freed once; the estimator's arrays of many sizes leave
    gaps then: for twenty nodes 60 MB of 280.
    """
    with suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL("libc.so.6").mallopt(_M_MMAP_THRESHOLD, 1 << 20)
