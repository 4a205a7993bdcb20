"""The estimator in a thread of its own, so that nobody waits for it.

Observations go in by ``give`` in the order of the session's inputs; estimates come out by
``take``, each with the count of observations that had been worked off. Nothing is dropped: what
the estimator is behind waits.
"""

from __future__ import annotations

import math
import queue
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from relpos.errors import RelposError
from relpos.fusion.estimator import Estimate, Estimator
from relpos.measurements import (
    Heading,
    Height,
    Measurement,
    Motion,
    Observation,
    Prior,
    Range,
)

GATHER_S = 3.0
"""A node reports its motion every second; with two losses in a row it has still been heard."""

Make = Callable[[Sequence[Prior]], Estimator]


@dataclass(frozen=True, slots=True)
class Fused:
    """An estimate, and how many observations had been given to the estimator by then."""

    estimate: Estimate
    given: int


def common_start(observations: Sequence[Observation]) -> list[Prior]:
    """One place and heading for everybody who is heard within :data:`GATHER_S` of the first."""
    nodes: set[int] = set()
    for o in observations:
        if isinstance(o, Motion | Range):
            nodes.add(o.node)
        if isinstance(o, Range):
            nodes.add(o.peer)
        if o.time_s - observations[0].time_s > GATHER_S:
            break
    return [Prior(node, 0.0, 0.0, 0.0) for node in sorted(nodes)]


class Fusing:
    """``make(priors)`` makes the estimator, in the thread.

    With ``common`` everybody who is heard in the first :data:`GATHER_S` starts from one place and
    the priors name them; what came meanwhile is worked off then.
    """

    def __init__(self, make: Make, priors: Sequence[Prior] = (), *, common: bool = False) -> None:
        self._make = make
        self._priors = tuple(priors)
        self._gathering: list[Observation] | None = [] if common else None
        self._given = 0
        self._inbox: queue.SimpleQueue[Sequence[Observation] | None] = queue.SimpleQueue()
        self._outbox: deque[Fused] = deque()
        self._estimator: Estimator | None = None
        self.failure: Exception | None = None
        """What ended it before its time."""
        self.newest_s = -math.inf
        """Time of the newest motion or range that was worked off."""
        self._abandon = threading.Event()
        self._thread = threading.Thread(target=self._work, name="fusion", daemon=True)
        self._thread.start()

    def give(self, observations: Sequence[Observation]) -> None:
        """Hand over; never waits."""
        if observations and self.failure is None:
            self._inbox.put(observations)

    def take(self) -> list[Fused]:
        """What has come out since the last call."""
        fused = []
        while self._outbox:
            fused.append(self._outbox.popleft())
        return fused

    def finish(self) -> None:
        """Let it work off the rest and end, without waiting: see :meth:`join`."""
        self._inbox.put(None)

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait until it has ended; whether it has."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def abandon(self) -> None:
        """Let it end at the next observation, whatever still waits."""
        self._abandon.set()
        self._inbox.put(None)

    def counters(self) -> Mapping[str, int]:
        """The estimator's; ask once it has ended."""
        return {} if self._estimator is None else self._estimator.counters()

    def _work(self) -> None:
        try:
            if self._gathering is None:
                self._estimator = self._make(self._priors)
            while (observations := self._inbox.get()) is not None:
                for observation in observations:
                    if self._abandon.is_set():
                        return
                    if self._gathering is None:
                        self._process(observation)
                    else:
                        self._gather(self._gathering, observation)
            if self._abandon.is_set():
                return
            if self._gathering is not None:
                self._begin(self._gathering)
            assert self._estimator is not None
            self._emit(self._estimator.finish())
        except Exception as error:
            self.failure = error
            if self._estimator is not None and isinstance(error, RelposError):
                self._rescue(self._estimator)

    def _rescue(self, estimator: Estimator) -> None:
        """Take what still waits in an estimator that has failed on its input."""
        try:
            self._emit(estimator.finish())
        except RelposError:
            return

    def _gather(self, came: list[Observation], observation: Observation) -> None:
        came.append(observation)
        if observation.time_s - came[0].time_s > GATHER_S:
            self._begin(came)

    def _begin(self, came: Sequence[Observation]) -> None:
        self._gathering = None
        self._estimator = self._make(common_start(came))
        for observation in came:
            self._process(observation)

    def _process(self, observation: Observation) -> None:
        assert self._estimator is not None
        self._given += 1
        if not isinstance(observation, Motion | Range | Height | Heading):
            return
        measurement: Measurement = observation
        self._emit(self._estimator.process(measurement))
        if isinstance(measurement, Motion | Range):
            self.newest_s = max(self.newest_s, measurement.time_s)

    def _emit(self, estimates: Sequence[Estimate]) -> None:
        for estimate in estimates:
            self._outbox.append(Fused(estimate, self._given))
