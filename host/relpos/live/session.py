"""A live session: what is received goes to the fusion, to the picture and to whoever keeps it.

Two threads. The *receive thread* (whoever iterates over :meth:`Session.run`) reads the input,
decodes, judges, composes pictures and calls the sinks; it never waits for the fusion. The *fusion
thread* (:mod:`relpos.live.fusing`) works off what it is given. Everything else is in processes of
its own.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

from relpos.errors import RelposError
from relpos.fusion.estimator import Estimate
from relpos.live.composer import Composer
from relpos.live.fusing import Fusing
from relpos.live.inputs import Input, Received
from relpos.live.picture import Level, Notice, Picture
from relpos.live.sinks import QuietSink, Sink
from relpos.live.visitors import Ask, Desk, Visitors
from relpos.measurements import Observation

PICTURE_S = 0.05
"""At most twenty pictures a second: as smooth as anybody walks, and a twentieth of a second old."""
IDLE_PICTURE_S = 0.5
"""Silence is shown, too: how long somebody was not heard, how long not moved."""
WAIT_S = 0.05
BEHIND_S = 5.0
"""From so much on the fusion is told to be behind; two or three seconds it always waits."""
ASLEEP_S = 5.0
"""The receive thread looks twenty times a second; what is longer was sleep, or another program."""
REMARK_S = 60.0
SWITCH_S = 0.001
"""Python hands over between its threads so often: a packet does not wait for the fusion."""


class Named(Protocol):
    """Who wants to know the wearers' names."""

    def named(self, names: dict[int, str]) -> None:
        """Take all names that phones have given so far."""


@dataclass
class Outcome:
    """What a session came to."""

    estimates: int = 0
    last: Estimate | None = None
    received: int = 0
    failure: Exception | None = None
    counters: dict[str, float] = field(default_factory=dict)


class Session:
    """One session over ``source``; see the module's text.

    ``sinks`` are fed; ``visitors`` are asked for what people want to change. ``seconds`` end it
    (of the wall clock). The end of a recording and the failure of the fusion do, unless it
    ``lasts``: then receiving, and showing the last picture, go on until it is stopped. ``remark``
    is told what a user should read, once each. ``pace`` is the clock that pictures and ``seconds``
    go by.
    """

    def __init__(
        self,
        source: Input,
        fusing: Fusing,
        composer: Composer,
        sinks: Sequence[Sink] = (),
        *,
        visitors: Sequence[Visitors] = (),
        namings: Sequence[Named] = (),
        seconds: float | None = None,
        lasts: bool = False,
        remark: Callable[[str], None] = lambda _: None,
        pace: Callable[[], float] = time.monotonic,
    ) -> None:
        self.outcome = Outcome()
        self._source = source
        self._fusing = fusing
        self._composer = composer
        self._sinks = list(sinks)
        self._visitors = list(visitors)
        self._namings = list(namings)
        self._seconds = seconds
        self._lasts = lasts
        self._remark = remark
        self._pace = pace
        self._desk = Desk(lambda unix_s: source.now_s() - (time.time() - unix_s))
        self._stopped = threading.Event()
        self._notices: dict[str, Notice] = {}
        self._remarks = 0
        self._expiring: dict[str, float] = {}
        self._arrived_unix_s: float | None = None
        self._pictured_s = -math.inf
        self._news = False
        self._looked_s: float | None = None
        self._connected = True
        # Where nobody looks, no picture is composed.
        self._pictures = any(type(s).pictured is not QuietSink.pictured for s in self._sinks)
        self._finishing = False

    def stop(self) -> None:
        """End it soon; from any thread or signal handler."""
        self._stopped.set()

    # -- the receive thread -----------------------------------------------------------------------

    def run(self) -> Iterator[Observation]:
        """Yield every observation as it comes, until the session is over; then :meth:`finish`.

        Ctrl-C ends it. DeviceError where the port vanishes and is not to be opened again.
        """
        started_s = self._pace()
        before_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        try:
            with _ended_by_interrupt(self.stop):
                while not self._stopped.is_set():
                    received = self._source.read(self._wait_s())
                    if received is not None:
                        self._take(received)
                        yield from received.observations
                    self._look()
                    if self._seconds is not None and self._pace() - started_s > self._seconds:
                        return
                    if not self._lasts and (self._source.over() or self._fusing.failure):
                        return
        except RelposError as error:
            self.outcome.failure = error
        finally:
            sys.setswitchinterval(before_s)

    def finish(self, abandon: bool = False) -> Outcome:
        """Let the fusion work off the rest, end everything, and tell what it came to.

        A KeyboardInterrupt leaves it; call again with ``abandon`` to do without the rest.
        """
        if abandon:
            self._fusing.abandon()
        elif not self._finishing:
            self._fusing.finish()
        while not self._fusing.join(WAIT_S):
            self._take_estimates()
            self._picture_if_due()
        self._take_estimates()
        if self._pictures:
            self._picture(self._source.now_s())
        self._source.close()
        self.outcome.failure = self.outcome.failure or self._fusing.failure
        for sink in self._sinks:
            try:
                sink.close()
            except Exception as error:
                self.outcome.failure = self.outcome.failure or error
        self.outcome.counters = {**self._source.counters(), **self._fusing.counters()}
        return self.outcome

    def _wait_s(self) -> float:
        """How long to wait for bytes: until a picture with news in it is due."""
        if not self._news:
            return WAIT_S
        return min(max(self._pictured_s + PICTURE_S - self._pace(), 0.0), WAIT_S)

    def _take(self, received: Received) -> None:
        now_s = self._source.now_s()
        self._arrived_unix_s = time.time()
        self.outcome.received += len(received.observations)
        if received.data:
            self._tell(lambda sink: sink.received(received.arrival_s, received.data))
        link = self._source.link
        self._composer.observed(now_s, received.observations, link.decoder if link else None)
        if received.observations:
            self._hand_on(received.arrival_s, received.observations)
        self._news = True

    def _hand_on(self, arrival_s: float, observations: Sequence[Observation]) -> None:
        self._fusing.give(observations)
        self._tell(lambda sink: sink.observed(arrival_s, observations))

    def _tell(self, call: Callable[[Sink], None]) -> None:
        """Call every sink; one that raises after all is told of and asked no more."""
        for sink in list(self._sinks):
            try:
                call(sink)
            except Exception as error:
                self._sinks.remove(sink)
                self._note(
                    f"failed-{type(sink).__name__}",
                    Level.ALARM,
                    f"{type(sink).__name__} has failed and was ended: {error!r}",
                )

    def _look(self) -> None:
        """Do what has to be done all the time, whether anything was received or not."""
        now_s = self._source.now_s()
        self._take_estimates()
        self._serve()
        for words in self._source.remarks():
            self._remark(words)
            self._remarks += 1
            name = f"remark-{self._remarks}"
            self._note(name, Level.INFO, words)
            self._expiring[name] = now_s + REMARK_S
        self._watch(now_s)
        self._picture_if_due()

    def _take_estimates(self) -> None:
        for fused in self._fusing.take():
            self.outcome.estimates += 1
            self.outcome.last = fused.estimate
            self._composer.estimated(fused.estimate, fused.given)
            self._tell(lambda sink, e=fused.estimate: sink.estimated(e))  # type: ignore[misc]
            self._source.learn(fused.estimate)
            self._news = True

    # -- what everybody has to know ---------------------------------------------------------------

    def _watch(self, now_s: float) -> None:
        """Let alarms and notices follow the time."""
        gone = self._source.trouble()
        connected = gone is None and not self._source.over()
        slept_s = 0.0 if self._looked_s is None else now_s - self._looked_s
        self._looked_s = now_s
        # The clock of an emulated team jumps between its packets, and nobody has slept.
        virtual = self._source.link is not None and self._source.link.virtual_s is not None
        if slept_s > ASLEEP_S and not virtual and self._source.is_now:
            self._note(
                "asleep",
                Level.WARNING,
                f"this computer slept for {slept_s:.0f} s, or was too busy to listen",
            )
            self._expiring["asleep"] = now_s + REMARK_S
        self._composer.alarms.tick(now_s, listening=connected and self._connected)
        self._connected = connected
        self._note_or_clear(
            "port", Level.ALARM, None if gone is None else f"{gone}; tried again each second"
        )
        if self._source.over() and not self._finishing:
            self._finishing = True
            self._fusing.finish()
            self._note("over", Level.INFO, "the recording is over: this is its last picture")
        self._watch_fusion()
        nobody = not self._composer.team.nodes and gone is None
        self._note_or_clear(
            "nobody", Level.INFO, "nobody is heard yet: are the nodes on?" if nobody else None
        )
        for k, sink in enumerate(self._sinks):
            self._note_or_clear(f"sink-{k}", Level.ALARM, sink.trouble())
        for name, until_s in list(self._expiring.items()):
            if now_s > until_s:
                del self._expiring[name]
                self._notices.pop(name, None)

    def _watch_fusion(self) -> None:
        failure = self._fusing.failure
        if failure is not None:
            self._note("fusion", Level.ALARM, f"the fusion has ended: {failure}; receiving goes on")
            return
        newest_s, first_s, behind_s = self._composer.newest_s, self._composer.first_s, 0.0
        if newest_s is not None and first_s is not None:
            behind_s = newest_s - max(self._fusing.newest_s, first_s)
        self._note_or_clear(
            "fusion",
            Level.WARNING,
            f"the fusion is {behind_s:.0f} s behind: meanwhile positions go on from each wearer's "
            "own motion"
            if behind_s > BEHIND_S
            else None,
        )

    def _note_or_clear(self, name: str, level: Level, text: str | None) -> None:
        if text is None:
            if self._notices.pop(name, None) is not None:
                self._news = True
        else:
            self._note(name, level, text)

    def _note(self, name: str, level: Level, text: str) -> None:
        before = self._notices.get(name)
        since_s = self._source.now_s() if before is None else before.since_s
        if before is None or before.text != text:
            self._notices[name] = Notice(name, level, text, since_s)
            self._news = self._news or before is None

    # -- pictures ---------------------------------------------------------------------------------

    def _picture_if_due(self) -> None:
        if not self._pictures:
            self._news = False
            return
        since_s = self._pace() - self._pictured_s
        if since_s >= (PICTURE_S if self._news else IDLE_PICTURE_S):
            self._picture(self._source.now_s())

    def _picture(self, now_s: float) -> Picture:
        self._news = False
        self._pictured_s = self._pace()
        picture = self._composer.picture(
            now_s, time.time(), self._arrived_unix_s, self._notices.values()
        )
        self._tell(lambda sink: sink.pictured(picture))
        return picture

    # -- visitors ---------------------------------------------------------------------------------

    def _serve(self) -> None:
        for visitors in self._visitors:
            for ask in visitors.asks():
                reply, status = self._reply(ask)
                visitors.answer(ask, reply, status)
                self._news = True

    def _reply(self, ask: Ask) -> tuple[dict[str, object], int]:
        match ask.kind:
            case "acknowledge":
                return {"acknowledged": self._composer.alarms.acknowledge(ask.body["node"])}, 200
            case "name":
                self._desk.names[ask.body["node"]] = ask.body["name"]
                self._composer.names[ask.body["node"]] = ask.body["name"]
                for naming in self._namings:
                    naming.named(dict(self._desk.names))
                return {"node": ask.body["node"], "name": ask.body["name"]}, 200
        if not self._source.is_now:
            return {"error": "this is a recording: nothing can be added to it"}, 409
        take = self._desk.presses if ask.kind == "presses" else self._desk.headings
        reply, new = take(ask)
        if new:
            self._composer.told(new)
            self._hand_on(self._source.now_s(), new)
        return reply, 200


@contextmanager
def _ended_by_interrupt(stop: Callable[[], None]) -> Iterator[None]:
    """Let Ctrl-C end it between two packets, not within one; only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda *_: stop())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
