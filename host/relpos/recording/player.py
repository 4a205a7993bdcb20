"""Plays a recording to sinks as it was: play, pause, speed, any moment, events before and after.

Positions are the recorded estimates; alarms, silence and the events on the time line come from one
reading of the whole recording, in a thread, while the page is open already.
"""

from __future__ import annotations

import heapq
import math
import sys
import threading
import time
from array import array
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Any

from relpos.fusion.estimator import NodeStatus
from relpos.fusion.post import posts_of
from relpos.live.alarms import RAISED, Alarms, Mayday
from relpos.live.composer import STALE_S, ghosts_of
from relpos.live.requests import AT_LANDMARK, RECORDED, Request, RequestSource
from relpos.live.sinks import Sink
from relpos.live.team_view import (
    STILL_ALARM_S,
    STILL_WARNING_S,
    Alert,
    LogEntry,
    MeasuredRange,
    Person,
    TeamView,
    name_of,
)
from relpos.live.tracks import Tracks
from relpos.measurements import Event, Height, Motion, Range, Status
from relpos.recording.moments import BACK_S, Moments
from relpos.runs.landmarks import PRESS
from relpos.said import Said, refusal, said_of

SHOW_S = 0.2
TICK_S = 0.2
"""How exactly alarms of a recording are dated."""
SWITCH_S = 0.001
"""Python's thread switch interval, as in a live session."""
SPEEDS = (0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
TICK_KINDS = ("alarm", "landmark", "rollcall", "mayday", "evacuate", "note", "warning")


class History:
    """What one reading of the recording finds: who was heard when, alerts, events."""

    def __init__(self) -> None:
        self.heard_s: dict[int, array[float]] = {}
        self.alerts: dict[int, list[tuple[float, Alert | None]]] = {}
        self.events: list[LogEntry] = []
        self.complete = False

    def heard(self, node: int, time_s: float) -> float | None:
        """Return when a node was heard last, at that time; unknown before all is read."""
        times = self.heard_s.get(node, array("d")) if self.complete else array("d")
        place = bisect_right(times, time_s)
        return times[place - 1] if place else None

    def alert(self, node: int, time_s: float) -> tuple[float, Alert | None]:
        """Return the alert that a wearer had, and since when; none before all is read."""
        changes = self.alerts.get(node, []) if self.complete else []
        place = bisect_right(changes, time_s, key=lambda change: change[0])
        return changes[place - 1] if place else (0.0, None)

    def read(
        self,
        moments: Moments,
        names: dict[int, str],
        known: Sequence[LogEntry],
        posts: frozenset[int] = frozenset(),
        calls: Sequence[tuple[float, Mayday]] = (),
    ) -> None:
        """Read everything once; ``known`` is a mission's log, else the alerts make one.

        ``calls`` are the MAYDAYs of a mission, with the time of each.
        """
        alarms, log = Alarms(), list(known)
        alarms.posts = posts

        def name(node: int) -> str:
            return name_of(node, names, posts)

        def note(time_s: float, kind: str, words: Said, node: int) -> None:
            unix_s = moments.started_unix_s + time_s
            log.append(LogEntry(time_s, unix_s, kind, str(words), node, said=said_of(words)))

        kinds = (Motion, Height, Event, Status)
        ticked_s = -math.inf
        rows = moments.rows(moments.from_s, moments.to_s, *kinds)
        for time_s, row in heapq.merge(rows, calls, key=itemgetter(0)):
            if isinstance(row, Event):
                # Of a simulated run: what is true (episodes, foot contacts) is no news.
                if row.event == PRESS and not known:
                    words = AT_LANDMARK.filled(name=name(row.node), landmark=row.value)
                    note(time_s, "landmark", words, row.node)
                continue
            if isinstance(row, Mayday):
                (alarms.mayday.add if row.on else alarms.mayday.discard)(row.node)
            else:
                self.heard_s.setdefault(row.node, array("d")).append(time_s)
                alarms.mark_heard(row.node)
            if isinstance(row, Motion):
                alarms.add_motion(row)
            elif isinstance(row, Height):
                alarms.add_height(row)
            if time_s < ticked_s + TICK_S and not isinstance(row, Mayday):
                continue
            ticked_s = time_s
            alarms.tick(time_s, listening=True)
            for node, _, after in alarms.changes:
                self.alerts.setdefault(node, []).append((time_s, after))
                if after is not None and not known:
                    note(time_s, "alarm", RAISED[after].filled(name=name(node)), node)
            alarms.changes.clear()
        self.events = sorted(log, key=lambda entry: entry.time_s)
        self.complete = True


class Player:
    """Shows a recording to ``sinks``, and does what their users ask (kind ``replay``).

    ``smoothed`` returns the smoothed tracks once they are computed, None before. ``admit`` keeps a
    device that a mission's page lets in or shuts out. ``calls`` are a mission's MAYDAYs. Afterwards
    ``ended`` is whether somebody on the page has ended it.
    """

    def __init__(
        self,
        moments: Moments,
        sinks: Sequence[Sink],
        log: Iterable[LogEntry] = (),
        smoothed: Callable[[], Tracks | None] | None = None,
        admit: Callable[[dict[str, Any]], None] | None = None,
        calls: Sequence[tuple[float, Mayday]] = (),
    ) -> None:
        self.ended = False
        self._admit = admit
        self.moments = moments
        self._sinks = sinks
        self.names = moments.description.names
        self.posts = posts_of(moments.description.nodes)
        self.history = History()
        self.at_s = moments.from_s
        self.playing = True
        self.speed = 1.0
        self._seq = 0
        self._told = False
        self._smoothed = smoothed
        self._reader = threading.Thread(
            target=self._read, args=(list(log), calls), name="history", daemon=True
        )
        self._reader.start()

    def _read(self, log: list[LogEntry], calls: Sequence[tuple[float, Mayday]]) -> None:
        # The thread has files of its own: two positions in one would meet.
        self.history.read(self.moments.again(), self.names, log, self.posts, calls)

    def wait(self) -> None:
        """Wait until the whole recording is read."""
        self._reader.join()

    def run(self, seconds: float | None = None) -> None:
        """Play until ``seconds`` are over, the page ends it, or Ctrl-C."""
        # A seek does not wait for the thread that reads the recording.
        sys.setswitchinterval(SWITCH_S)
        began_s = before_s = time.monotonic()
        shown_s = 0.0
        self.tell()
        while not self.ended and (seconds is None or before_s - began_s < seconds):
            now_s = time.monotonic()
            if self.playing:
                self.at_s = min(self.at_s + (now_s - before_s) * self.speed, self.moments.to_s)
                if self.at_s >= self.moments.to_s:
                    self.playing = False
                    self.tell()
            before_s = now_s
            asked = self._handle()
            if self.history.complete and not self._told:
                self._told = True
                for sink in self._sinks:
                    for entry in self.history.events:
                        sink.logged(entry)
                self.tell()
            # Smoothing begins once the recording is read, which comes first.
            wanted = self._smoothed if self.history.complete else None
            tracks = wanted() if wanted else None
            if tracks is not None:
                self._smoothed = None
                for sink in self._sinks:
                    sink.smoothed(tracks)
                self.tell()
            if asked or now_s - shown_s >= SHOW_S:
                shown_s = now_s
                view = self.view(self.at_s)
                for sink in self._sinks:
                    sink.updated(view)
            time.sleep(0.02)

    def tell(self) -> None:
        """Tell the pages where the recording is, and its events."""
        ticks = [
            [e.time_s, e.kind, e.text, e.said] for e in self.history.events if e.kind in TICK_KINDS
        ]
        message = {
            "type": "timeline", "from_s": self.moments.from_s, "to_s": self.moments.to_s,
            "playing": self.playing, "speed": self.speed, "ticks": ticks,
            "reading": not self.history.complete, "smoothing": self._smoothed is not None,
        }  # fmt: skip
        for sink in self._sinks:
            sink.timed(message)

    def _handle(self) -> bool:
        asked = False
        for source in self._sinks:
            if not isinstance(source, RequestSource):
                continue
            for request in source.requests():
                asked = True
                reply, status = self._reply(request)
                source.respond(request, reply, status)
        if asked:
            self.tell()
        return asked

    def _reply(self, request: Request) -> tuple[dict[str, Any], int]:
        body = request.body
        if request.kind == "device" and self._admit is not None:
            self._admit(body)
            for sink in self._sinks:
                sink.admitted(body)
            return body, 200
        if request.kind == "end":
            self.ended = True
            return {"done": True}, 200
        if request.kind != "replay":
            return refusal(RECORDED), 409
        if "at_s" in body:
            self.at_s = min(max(float(body["at_s"]), self.moments.from_s), self.moments.to_s)
        if "speed" in body:
            self.speed = min(max(float(body["speed"]), SPEEDS[0]), SPEEDS[-1])
        if "playing" in body:
            self.playing = bool(body["playing"])
        if "step" in body:
            self.at_s = self._neighbour(1 if float(body["step"]) > 0 else -1)
        return {"at_s": self.at_s}, 200

    def _neighbour(self, by: int) -> float:
        """Return the time of the next or the previous event."""
        times = [e.time_s for e in self.history.events if e.kind in TICK_KINDS]
        later = [at_s for at_s in times if at_s > self.at_s + 0.5]
        earlier = [at_s for at_s in times if at_s < self.at_s - 0.5]
        if by > 0:
            return later[0] if later else self.moments.to_s
        return earlier[-1] if earlier else self.moments.from_s

    def view(self, time_s: float) -> TeamView:
        """Return the team at that time."""
        self._seq += 1
        estimate = self.moments.estimate_at(time_s)
        located = {} if estimate is None else {n.node: n for n in estimate.nodes}
        newest: dict[tuple[int, int], Range] = {}
        for _, row in self.moments.rows(time_s - BACK_S, time_s, Range):
            newest[min(row.node, row.peer), max(row.node, row.peer)] = row
        nodes = sorted(located.keys() | self.history.heard_s.keys() | self.history.alerts.keys())
        return TeamView(
            seq=self._seq,
            time_s=time_s,
            unix_s=time.time(),
            fused_s=None if estimate is None else estimate.time_s,
            ambiguous=estimate is not None and bool(estimate.alternatives),
            people=tuple(self._person(node, located.get(node), time_s) for node in nodes),
            pairs=() if estimate is None else estimate.pairs,
            ranges=tuple(
                MeasuredRange(*pair, r.range_m, max(time_s - r.time_s, 0.0))
                for pair, r in newest.items()
            ),
            alternatives=() if estimate is None else ghosts_of(estimate),
        )

    def _person(self, node: int, at: Any, time_s: float) -> Person:
        heard_s = self.history.heard(node, time_s)
        seen_s = None if heard_s is None else time_s - heard_s
        since_s, alert = self.history.alert(node, time_s)
        status = NodeStatus.UNLOCATED if at is None else at.status
        if alert is Alert.LOST:
            status = NodeStatus.LOST
        elif status is NodeStatus.OK and seen_s is not None and seen_s > STALE_S:
            status = NodeStatus.STALE
        limit_s = {Alert.STILL_ALARM: STILL_ALARM_S, Alert.STILL_WARNING: STILL_WARNING_S}
        still_s = time_s - since_s + limit_s[alert] if alert in limit_s else 0.0
        person = Person(
            node, name_of(node, self.names, self.posts), status=str(status), seen_s=seen_s,
            still_s=still_s, alert=alert, health="unknown", post=node in self.posts,
        )  # fmt: skip
        if at is None:
            return person
        return replace(person, **{name: getattr(at, name) for name in _POSE})


_POSE = (
    "x_m", "y_m", "z_m", "heading_rad", "sigma_major_m", "sigma_minor_m", "sigma_angle_rad",
    "sigma_heading_rad",
)  # fmt: skip
