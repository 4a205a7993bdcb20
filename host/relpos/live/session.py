"""A live session: from a serial port or a recording to the estimator, the view and the sinks.

Two threads. The *receive thread*, which iterates over :meth:`LiveSession.run`, reads the input,
decodes it, updates alarms, composes views and calls the sinks; it never waits for the fusion. The
*fusion thread* (:mod:`relpos.live.fusion_thread`) processes the observations. Servers run in
processes of their own.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

from relpos.fusion.clocks import time_offsets
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.live.alarms import CLEARED, LOST_S, RAISED, KnownAlert
from relpos.live.board import BOARD_EVENTS, Board, BoardError
from relpos.live.clock import SessionClock
from relpos.live.composer import Composer
from relpos.live.fusion_thread import FusionThread
from relpos.live.inputs import Input, Received
from relpos.live.mission import Journal, Resumed
from relpos.live.notices import NoticeBoard
from relpos.live.requests import (
    AT_LANDMARK,
    RECORDED,
    Request,
    RequestHandler,
    RequestSource,
)
from relpos.live.sinks import Sink
from relpos.live.team_view import Alert, Level, LogEntry
from relpos.measurements import Event, Heading, Observation
from relpos.said import Said, joined, refusal, said_of

VIEW_S = 0.05
"""At most twenty views a second: smooth for a walking person, and a twentieth of a second old."""
IDLE_VIEW_S = 0.5
"""Silence is shown, too: how long a node was not received, how long its wearer has not moved."""
WAIT_S = 0.05
BEHIND_S = 5.0
"""Delay of the fusion from which a notice says so; it always waits two or three seconds."""
ASLEEP_S = 5.0
"""The receive thread runs twenty times a second; a longer gap was sleep, or another program."""
FAILED = Said("session-failed", "the session has failed")
NEW_MAP = Said(
    "new-map",
    "the checkpoint is damaged: the map begins anew, without the tracks before; markers may lie "
    "wrong, a plan has to be aligned again",
)
EVENTS = ("acknowledge", "shelve", "name", "device")
"""Requests that change what a mission keeps."""
LOGGED = ("acknowledge", "shelve", "name")
SWITCH_S = 0.001
"""Python's thread switch interval: a packet does not wait for the fusion."""


@dataclass
class Outcome:
    """The result of a session."""

    estimates: int = 0
    last: Estimate | None = None
    received: int = 0
    failure: Exception | None = None
    ended_on_page: bool = False
    counters: dict[str, float] = field(default_factory=dict)


class LiveSession:
    """One session over ``source``; see the module's text.

    ``sinks`` are fed; those that are also a ``RequestSource`` are asked for requests. The session
    ends after ``seconds`` of the ``pace`` clock, at the end of a recording, or when the fusion
    fails. With ``lasts`` only :meth:`stop` and ``seconds`` end it: receiving, and showing the last
    view, go on. ``remark`` gets every message for the user, once each. ``pace`` is the clock of
    views and ``seconds``.
    """

    def __init__(
        self,
        source: Input,
        fusion: FusionThread,
        composer: Composer,
        sinks: Sequence[Sink] = (),
        *,
        seconds: float | None = None,
        lasts: bool = False,
        remark: Callable[[str], None] = lambda _: None,
        pace: Callable[[], float] = time.monotonic,
    ) -> None:
        self.outcome = Outcome()
        self._source = source
        self._fusion = fusion
        self._composer = composer
        self._sinks = list(sinks)
        self._failed_sinks: list[Sink] = []
        self._failed: Counter[str] = Counter()
        self._request_sources = [sink for sink in sinks if isinstance(sink, RequestSource)]
        self._seconds = seconds
        self._lasts = lasts
        self._remark = remark
        self._pace = pace
        self._handler = RequestHandler(lambda unix_s: source.now_s() - (time.time() - unix_s))
        self._notices = NoticeBoard(source.now_s)
        self._stopped = threading.Event()
        self._clock = SessionClock()
        self._arrived_s: float | None = None
        self._viewed_s = -math.inf
        self._changed = False
        """Whether the view has changed since it was last shown."""
        self._watched_s: float | None = None
        self._connected = True
        # Without a sink that shows it, no view is composed.
        self._shows = any(type(s).updated is not Sink.updated for s in self._sinks)
        self._finishing = False
        self._ending = False
        """A user of the page has ended it; who asked is answered first."""
        self._journal: Journal | None = None
        self._unconfirmed: deque[tuple[int, RequestSource, Request, dict[str, Any], int]] = deque()
        """Answers that wait until the disk holds what they confirm."""
        self._alerts: dict[int, KnownAlert] = {}
        self._board = Board()
        self._journal_open = False
        """Whether an event is of now: those of a session before were logged then."""
        self._again_s = -math.inf
        """Up to then estimates are those of a session before."""

    def keep(self, journal: Journal, resumed: Resumed) -> None:
        """Write what is confirmed to a mission's journal, and go on from what stands there."""
        for event in resumed.events:
            if event["kind"] == "log":
                self._feed(lambda sink, e=event: sink.logged(e["entry"]))  # type: ignore[misc]
                continue
            with self._surviving("event"):
                self._apply(event)
        for node, heard_s in resumed.heard_s.items():
            self._composer.remember(node, heard_s, resumed.since_s, self._alerts.get(node))
        for event in resumed.events:
            if event["kind"] == "shelve":
                with self._surviving("event"):
                    self._apply(event)
        self._again_s = resumed.since_s
        self._journal = journal

    def begin_map(self) -> None:
        """Tell that the map begins anew; a plan that was aligned fits it no more."""
        if self._board.plan is not None and self._board.plan.points:
            self._happen({"kind": "plan", "action": "align", "points": []})
        self.post("new-map", Level.WARNING, NEW_MAP)

    def add_sink(self, sink: Sink) -> None:
        """Feed one more sink from now on."""
        self._sinks.append(sink)

    def stop(self) -> None:
        """End the session soon; from any thread or signal handler."""
        self._stopped.set()

    # -- the receive thread -----------------------------------------------------------------------

    def run(self) -> Iterator[Observation]:
        """Yield every observation as it comes, until the session ends; then call :meth:`finish`.

        Ctrl-C ends it. A port that vanishes and is not opened again ends it with a failure in the
        outcome.
        """
        started_s = self._pace()
        before_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        try:
            with _stopped_by_interrupt(self.stop):
                while not self._stopped.is_set():
                    received = self._source.read(self._wait_s())
                    if received is not None:
                        self._add(received)
                        yield from received.observations
                    with self._surviving("update"):
                        self._update()
                    if self._seconds is not None and self._pace() - started_s > self._seconds:
                        return
                    if self._ending and not self._unconfirmed:
                        return
                    if not self._lasts and (self._source.over() or self._fusion.failure):
                        return
        except Exception as error:
            self.outcome.failure = error
        finally:
            sys.setswitchinterval(before_s)

    def finish(self, abandon: bool = False) -> Outcome:
        """Wait for the fusion to process the rest, close everything, and return the outcome.

        A KeyboardInterrupt leaves it; call again with ``abandon`` to drop the rest.
        """
        if abandon:
            self._fusion.abandon()
        elif not self._finishing:
            self._fusion.finish()
        while not self._fusion.join(WAIT_S):
            self._collect_estimates()
            self._show_if_due()
        self._collect_estimates()
        if self._shows:
            self._show()
        self.outcome.failure = self.outcome.failure or self._fusion.failure
        for close in (self._source.close, *(sink.close for sink in self._sinks)):
            try:
                close()
            except Exception as error:
                self.outcome.failure = self.outcome.failure or error
        for sink in self._failed_sinks:
            # Its failure was told; what it still holds may go to disk all the same.
            with suppress(Exception):
                sink.close()
        self.outcome.counters = {
            **self._source.counters(),
            **self._fusion.counters(),
            **self._handler.counts,
            **self._failed,
        }
        return self.outcome

    def _wait_s(self) -> float:
        """How long to wait for bytes: until a changed view is due."""
        if not self._changed:
            return WAIT_S
        return min(max(self._viewed_s + VIEW_S - self._pace(), 0.0), WAIT_S)

    def _add(self, received: Received) -> None:
        now_s = self._source.now_s()
        self._arrived_s = self._clock()
        self.outcome.received += len(received.observations)
        if received.again:
            # What was between the sessions is no sleep.
            self._watched_s = None
        elif received.data:
            self._feed(lambda sink: sink.received(received.arrival_s, received.data))
        link = self._source.link
        decoder = link.decoder if link else None
        with self._surviving("view"):
            self._composer.add_observations(now_s, received.observations, decoder)
        if received.observations:
            self._submit(received.arrival_s, received.observations)
        self._changed = True

    @contextmanager
    def _surviving(self, what: str) -> Iterator[None]:
        """Tell and count what is raised within: receiving, fusing and recording go on."""
        try:
            yield
        except Exception as error:
            self._failed[f"{what}s_failed"] += 1
            text = Said(
                "failed",
                "{what} failed: {error}; the session goes on",
                what=what,
                error=repr(error),
            )
            self.post(what, Level.ALARM, text)
            self._notices.expire(what)

    def _submit(self, arrival_s: float, observations: Sequence[Observation]) -> None:
        self._fusion.submit(observations)
        self._feed(lambda sink: sink.observed(arrival_s, observations))

    def _feed(self, call: Callable[[Sink], None]) -> None:
        """Call every sink; drop one that raises, with a notice."""
        for sink in list(self._sinks):
            try:
                call(sink)
            except Exception as error:
                self._sinks.remove(sink)
                self._failed_sinks.append(sink)
                self.post(f"sink-{id(sink)}", Level.ALARM, None)
                name = type(sink).__name__
                text = Said(
                    "sink-failed",
                    "{name} has failed and ended: {error}",
                    name=name,
                    error=repr(error),
                )
                self.post(f"failed-{name}", Level.ALARM, text)

    def _update(self) -> None:
        """Do everything that is due at any time, whether anything was received or not."""
        now_s = self._source.now_s()
        self._collect_estimates()
        self._handle_requests()
        self._confirm()
        for text in self._source.remarks():
            self._remark(text)
            self._notices.post_remark(text)
            self.log("note", text)
            self._changed = True
        for node in self._source.called_out():
            if node in self._board.called_out:
                self._happen({"kind": "evacuate", "action": "lit", "node": node})
        self._watch(now_s)
        self._show_if_due()

    def _collect_estimates(self) -> None:
        for fused in self._fusion.poll():
            self.outcome.estimates += 1
            self.outcome.last = fused.estimate
            with self._surviving("view"):
                self._composer.add_estimate(fused.estimate, fused.processed)
            if fused.estimate.time_s > self._again_s:
                self._feed(lambda sink, e=fused.estimate: sink.estimated(e))  # type: ignore[misc]
            with self._surviving("update"):
                self._source.learn(fused.estimate)
            offsets = time_offsets(fused.estimate)
            # The estimator takes it into account: there is nothing to do.
            self.post("time-offsets", Level.INFO, joined(offsets) if offsets else None)
            self._changed = True

    # -- alarms and notices -----------------------------------------------------------------------

    def _watch(self, now_s: float) -> None:
        """Update alarms and notices to ``now_s``."""
        gone = self._source.trouble()
        connected = gone is None and not self._source.over()
        slept_s = 0.0 if self._watched_s is None else now_s - self._watched_s
        self._watched_s = now_s
        # The clock of an emulated team jumps between its packets without any sleep.
        virtual = self._source.link is not None and self._source.link.virtual_s is not None
        if slept_s > ASLEEP_S and not virtual and self._source.is_now:
            text = Said(
                "asleep",
                "this computer slept for {seconds:.0f} s, or was too busy to receive",
                seconds=slept_s,
            )
            self.post("asleep", Level.WARNING, text)
            self._notices.expire("asleep")
        self._composer.alarms.tick(now_s, listening=connected and self._connected)
        self._log_alarms()
        self._connected = connected
        self.post(
            "port",
            Level.ALARM,
            gone and Said("port", "{trouble}; trying again each second", trouble=gone),
        )
        if self._source.over() and not self._finishing:
            self._finishing = True
            self._fusion.finish()
            text = Said("over", "end of the recording: this is the last picture")
            self.post("over", Level.INFO, text)
        self._watch_fusion()
        silent = not self._composer.monitor.nodes and gone is None
        text = Said("nobody", "no node is heard yet: are the nodes switched on?")
        self.post("nobody", Level.INFO, text if silent else None)
        self._feed(lambda sink: self.post(f"sink-{id(sink)}", Level.ALARM, sink.trouble()))
        self._notices.drop_expired(now_s)

    def _watch_fusion(self) -> None:
        failure = self._fusion.failure
        if failure is not None:
            text = Said(
                "fusion-failed",
                "the fusion has failed: {failure}; receiving goes on",
                failure=str(failure),
            )
            self.post("fusion", Level.ALARM, text)
            return
        while self._fusion.restarted:
            error = self._fusion.restarted.pop()
            text = Said(
                "fusion-restarted",
                "the fusion has failed ({failure}) and was started again",
                failure=repr(error),
            )
            self.post("fusion-restarted", Level.ALARM, text)
            self._notices.expire("fusion-restarted")
        newest_s, first_s, behind_s = self._composer.newest_s, self._composer.first_s, 0.0
        if newest_s is not None and first_s is not None:
            behind_s = newest_s - max(self._fusion.newest_s, first_s)
        text = Said(
            "behind",
            "the fusion is {seconds:.0f} s behind: positions follow each wearer's own motion "
            "meanwhile",
            seconds=behind_s,
        )
        self.post("fusion", Level.WARNING, text if behind_s > BEHIND_S else None)

    def post(self, name: str, level: Level, text: str | None) -> None:
        """Set the notice ``name``, or clear it where ``text`` is None."""
        if self._notices.post(name, level, text):
            self._changed = True
            if text is not None:
                self.log("note" if level is Level.INFO else str(level), text)
                # Where nothing is shown, the terminal is all that tells it.
                if level is not Level.INFO:
                    self._remark(text)

    # -- the log ----------------------------------------------------------------------------------

    def log(self, kind: str, text: str, node: int | None = None, by: str = "") -> None:
        """Write a line of the log to every sink."""
        entry = LogEntry(
            self._source.now_s(), time.time(), kind, str(text), node, by, said_of(text)
        )
        self._feed(lambda sink: sink.logged(entry))

    def _log_alarms(self) -> None:
        changes, self._composer.alarms.changes = self._composer.alarms.changes, []
        for node, before, after in changes:
            self._happen({"kind": "alert", "node": node, "alert": after})
            name = self._composer.name(node)
            if after is not None:
                self.log("alarm", RAISED[after].filled(name=name), node)
            elif before is not None:
                self.log("cleared", CLEARED[before].filled(name=name), node)

    # -- views ------------------------------------------------------------------------------------

    def _show_if_due(self) -> None:
        if not self._shows:
            self._changed = False
        elif self._pace() - self._viewed_s >= (VIEW_S if self._changed else IDLE_VIEW_S):
            self._show()

    def _show(self) -> None:
        self._changed = False
        self._viewed_s = self._pace()
        with self._surviving("view"):
            unix_s, arrived_s = time.time(), self._arrived_s
            # By a clock that nobody sets: else one that is set back makes silence look like news.
            arrived_unix_s = None if arrived_s is None else unix_s - (self._clock() - arrived_s)
            view = self._composer.view(
                self._source.now_s(), unix_s, arrived_unix_s, self._notices.all()
            )
            self._feed(lambda sink: sink.updated(view))

    # -- requests ---------------------------------------------------------------------------------

    def _handle_requests(self) -> None:
        for source in self._request_sources:
            with self._surviving("request"):
                for request in source.requests():
                    reply: tuple[dict[str, object], int] = refusal(FAILED), 500
                    with self._surviving("request"):
                        reply = self._reply(request)
                    number = 0 if self._journal is None else self._journal.newest
                    self._unconfirmed.append((number, source, request, *reply))
                    self._changed = True

    def _confirm(self) -> None:
        """Answer what the disk holds by now: nothing that was confirmed is ever lost."""
        while self._unconfirmed:
            number, source, request, reply, status = self._unconfirmed[0]
            if self._journal is not None and not self._journal.is_safe(number):
                return
            self._unconfirmed.popleft()
            source.respond(request, reply, status)

    def _reply(self, request: Request) -> tuple[dict[str, object], int]:
        body = request.body
        if request.kind in EVENTS:
            node, by = body.get("node"), body.get("by", "")
            done = self._happen({**body, "kind": request.kind})
            if done and request.kind in LOGGED:
                self.log(request.kind, self._words(request.kind, body), node, by)
            return {"acknowledged": done} if request.kind == "acknowledge" else body, 200
        if request.kind in BOARD_EVENTS:
            return self._change_board(request.kind, body)
        if request.kind == "end":
            by = str(body.get("by", ""))
            self.post("ended", Level.WARNING, Said("ended", "the session was ended by {by}", by=by))
            self._ending = self.outcome.ended_on_page = True
            return {"done": True}, 200
        if request.kind in ("sources", "start"):
            return refusal(Said("running", "a session runs already: end it first")), 409
        if request.kind not in ("presses", "headings"):
            return refusal(f"this session takes no request of the kind {request.kind}"), 409
        if not self._source.is_now:
            return refusal(RECORDED), 409
        handle = self._handler.presses if request.kind == "presses" else self._handler.headings
        reply, new = handle(request)
        # A node that nobody hears would become a person of the team.
        heard = self._composer.monitor.nodes
        unheard = [o for o in new if isinstance(o, Heading) and o.node not in heard]
        self._handler.counts["headings_of_unheard_nodes"] += len(unheard)
        new = [o for o in new if o not in unheard]
        if new:
            self._composer.add_reported(new)
            self._submit(self._source.now_s(), new)
        if request.kind == "presses" and new:
            self._happen({"kind": "presses", "ids": reply["accepted"]})
            for press in new:
                if isinstance(press, Event):
                    name = self._composer.name(press.node)
                    text = AT_LANDMARK.filled(name=name, landmark=press.value)
                    self.log("landmark", text, press.node)
        return reply, 200

    def _change_board(self, kind: str, body: dict[str, Any]) -> tuple[dict[str, object], int]:
        everybody = sorted(self._composer.monitor.nodes.keys() - self._composer.posts)
        said = {name: body[name] for name in BOARD_EVENTS[kind] if name in body}
        body = {"nodes": everybody, **said, "by": body.get("by", "")}
        if kind == "marker" and "x_m" not in body and body.get("action") == "set":
            # "Here", of a wearer's phone; their node may be silent although the phone is not.
            at = self._composer.person(body.get("node", 0), self._source.now_s())
            silent = at.seen_s is None or at.seen_s > LOST_S
            if silent or at.status not in (NodeStatus.OK, NodeStatus.STALE):
                return refusal(Said("where", "where you are is not known yet")), 409
            body |= {"x_m": at.x_m, "y_m": at.y_m}
        called = set(self._board.mayday)
        try:
            self._happen({**body, "kind": kind})
        except BoardError as error:
            return refusal(error.args[0]), 400
        if self._board.mayday.keys() - called:
            # Who else is in trouble is asked at once.
            start = {"action": "start", "emergency": True, "within_s": 300.0}
            nodes = sorted({*everybody, body["node"]})
            self._happen({"kind": "rollcall", "by": body["by"], "nodes": nodes, **start})
        return {"done": True}, 200

    def _words(self, kind: str, body: dict[str, Any]) -> str:
        if kind == "name":
            return Said("named", "node {node} is {name}", node=str(body["node"]), name=body["name"])
        name = self._composer.name(body["node"])
        if kind == "shelve":
            return Said(
                "shelved",
                "alarms of {name} for {seconds:.0f} s",
                name=name,
                seconds=body["seconds"],
            )
        return Said("acknowledged", "alarm of {name}", name=name)

    # -- events: what the journal holds -----------------------------------------------------------

    def _happen(self, event: dict[str, Any]) -> bool:
        """Apply an event, and write it to the journal where there is one."""
        event = {**event, "time_s": self._source.now_s(), "unix_s": time.time()}
        self._journal_open = True
        done = self._apply(event)
        if done and self._journal is not None:
            self._journal.add(event)
        return done

    def _apply(self, event: dict[str, Any]) -> bool:
        """Apply an event of now, or of a session before; return whether it changed anything."""
        node = event.get("node", 0)
        match event["kind"]:
            case "name":
                self._handler.names[node] = self._composer.names[node] = event["name"]
                self._feed(lambda sink: sink.named(dict(self._handler.names)))
            case "alert" if event["alert"] is None:
                self._alerts.pop(node, None)
            case "alert":
                self._alerts[node] = KnownAlert(Alert(event["alert"]), event["time_s"])
            case "acknowledge":
                if node in self._alerts:
                    self._alerts[node].seen, self._alerts[node].by = True, event.get("by", "")
                return self._composer.alarms.acknowledge(node, event.get("by", ""))
            case "shelve":
                left_s = event["seconds"] - (self._source.now_s() - event["time_s"])
                return self._composer.alarms.shelve(node, left_s)
            case kind if kind in BOARD_EVENTS:
                words = self._board.apply(event)
                alarms = self._composer.alarms
                alarms.waiting, alarms.mayday = self._board.waiting, set(self._board.mayday)
                self._source.call_out(self._board.called_out)
                self._feed(lambda sink: sink.boarded(self._board.to_message()))
                if words and self._journal_open:
                    whom = f"{self._composer.name(node)}: " if node else ""
                    self.log(kind, words.filled(whom=whom), node or None, event.get("by", ""))
            case "presses":
                self._handler.accept(event["ids"])
            case "device":
                self._feed(lambda sink: sink.admitted(event))
        return True


@contextmanager
def _stopped_by_interrupt(stop: Callable[[], None]) -> Iterator[None]:
    """Let Ctrl-C stop between two packets, not within one; only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda *_: stop())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
