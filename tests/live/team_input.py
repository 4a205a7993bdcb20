"""An emulated team as a session's input, in virtual time: no port, no wall clock."""

from __future__ import annotations

import math
import time

from relpos.emulator.air import STEP_US
from relpos.emulator.team import EmulatedTeam
from relpos.link.port import Link
from relpos.live.composer import Composer
from relpos.live.fusion_thread import FusionThread
from relpos.live.inputs import Received
from relpos.live.session import LiveSession
from relpos.live.sinks import Sink
from relpos.measurements import Motion, Range


class TeamInput:
    """Reads whatever left the team's coordinator; the session's clock is the team's.

    ``sleep(at_s, for_s)``: from then on nothing is read, and what arrives is lost, as with a
    laptop that sleeps. ``unplug(at_s, for_s)``: alike, but the session knows it.
    """

    name = "emulated"
    is_now = True
    recorded_unix_s = None

    def __init__(self, team: EmulatedTeam, until_s: float | None = None) -> None:
        self.team = team
        self.link = Link()
        self.until_s = team.seconds if until_s is None else until_s
        self._sleep: tuple[float, float] | None = None
        self._unplug: tuple[float, float] | None = None
        self._waiting: list[tuple[int, bytes]] = []
        self._given_s = -math.inf
        self.paced_by: FusionThread | None = None
        """A fusion that is waited for: virtual time has no pace of its own."""

    def sleep(self, at_s: float, for_s: float) -> None:
        self._sleep = (at_s, for_s)

    def unplug(self, at_s: float, for_s: float) -> None:
        self._unplug = (at_s, at_s + for_s)

    def read(self, timeout_s: float) -> Received | None:
        if self._waiting:
            time_us, data = self._waiting.pop(0)
            observations = self.link.feed(data, time_us * 1e-6)
            for o in observations:
                if isinstance(o, Motion | Range):
                    self._given_s = max(self._given_s, o.time_s)
            return Received(time_us * 1e-6, data, observations)
        fusion = self.paced_by
        while fusion is not None and fusion.failure is None and fusion.newest_s < self._given_s:
            time.sleep(0.001)
        if self._sleep is not None and self.now_s() >= self._sleep[0]:
            self.team.run(self.team.time_us + round(self._sleep[1] * 1e6))
            self._sleep = None
            return None
        output = self.team.run(self.team.time_us + STEP_US)
        if self.trouble() is None:
            self._waiting = output
        return None

    def now_s(self) -> float:
        return self.team.time_us * 1e-6

    def learn(self, estimate) -> None:
        pass

    def call_out(self, nodes) -> None:
        self.called = sorted(nodes)

    def called_out(self) -> list[int]:
        return []

    def remarks(self) -> list[str]:
        new, self.link.decoder.remarks = self.link.decoder.remarks, []
        return new

    def trouble(self) -> str | None:
        if self._unplug is not None and self._unplug[0] <= self.now_s() < self._unplug[1]:
            return "/dev/ttyUSB0: the port vanished"
        return None

    def over(self) -> bool:
        return self.now_s() >= self.until_s and not self._waiting

    def counters(self):
        return self.link.summary()

    def close(self) -> None:
        pass


class Album(Sink):
    """Keeps everything it is given."""

    def __init__(self) -> None:
        self.bytes: list[tuple[float, bytes]] = []
        self.observations = []
        self.estimates = []
        self.views = []
        self.log = []
        self.closed = False

    def received(self, arrival_s, data):
        self.bytes.append((arrival_s, data))

    def observed(self, arrival_s, observations):
        self.observations += [(arrival_s, o) for o in observations]

    def estimated(self, estimate):
        self.estimates.append(estimate)

    def updated(self, view):
        self.views.append(view)

    def logged(self, entry):
        self.log.append(entry)

    def close(self):
        self.closed = True


def make_session(
    source, make, *sinks, priors=(), common=False, paced=False, posts=frozenset(), **options
):
    """A session over ``source`` with an estimator made by ``make(priors)``, and its album."""
    album = Album()
    fusion = FusionThread(make, priors, common=common)
    source.paced_by = fusion if paced else None
    # As many pictures a second of the team's time as a session makes in real time.
    pace = source.now_s if isinstance(source, TeamInput) else time.monotonic
    composer = Composer(posts=posts)
    return LiveSession(source, fusion, composer, [album, *sinks], pace=pace, **options), album


def run_through(session, *, survives=()):
    """Run it to its end; the outcome. Of all that it can survive it has met ``survives`` alone."""
    for _ in session.run():
        pass
    outcome = session.finish()
    survived = {f"{what}s_failed" for what in ("update", "view", "request", "event")}
    assert survived & outcome.counters.keys() == set(survives)
    return outcome
