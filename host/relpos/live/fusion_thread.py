"""The estimator in a thread of its own, so that receiving never waits for it.

``submit`` takes observations in the order of the session's inputs; ``poll`` returns estimates, each
with the number of observations processed by then. Nothing is dropped: observations that the
estimator has not reached wait in a queue.
"""

from __future__ import annotations

import math
import queue
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from relpos.errors import RelposError
from relpos.fusion.estimator import Estimate, Estimator, NodeStatus
from relpos.fusion.linear_algebra import one_thread
from relpos.measurements import (
    Measurement,
    Motion,
    Observation,
    Prior,
    Range,
    common_priors,
)

GATHER_S = 3.0
"""A node reports its motion every second; with two losses in a row it has still been received."""

RESTART_S = 10.0
"""An estimator that fails again so soon fails for good."""

MakeEstimator = Callable[[Sequence[Prior]], Estimator]


@dataclass(frozen=True, slots=True)
class FusedEstimate:
    """An estimate, and how many observations the estimator had processed by then."""

    estimate: Estimate
    processed: int


def common_start(observations: Sequence[Observation]) -> list[Prior]:
    """Return priors at one pose for all nodes that are received in the first :data:`GATHER_S`."""
    nodes: set[int] = set()
    for o in observations:
        if isinstance(o, Motion | Range):
            nodes.add(o.node)
        if isinstance(o, Range):
            nodes.add(o.peer)
        if o.time_s - observations[0].time_s > GATHER_S:
            break
    return list(common_priors(nodes))


def known_poses(estimate: Estimate) -> list[Prior]:
    """Return where everybody was whose place was one; others are found anew by ranges."""
    return [
        Prior(n.node, n.x_m, n.y_m, n.heading_rad, n.sigma_major_m, n.sigma_heading_rad)
        for n in estimate.nodes
        if n.status in (NodeStatus.OK, NodeStatus.STALE, NodeStatus.LOST)
    ]


class FusionThread:
    """Runs the estimator that ``make(priors)`` returns, in its own thread.

    With ``restarts`` an estimator that fails is made anew where the team was by its last estimate.

    With ``common`` all nodes received in the first :data:`GATHER_S` start at one common pose;
    observations wait until these nodes are known.
    """

    def __init__(
        self,
        make: MakeEstimator,
        priors: Sequence[Prior] = (),
        *,
        common: bool = False,
        restarts: bool = False,
    ) -> None:
        self._make = make
        self._priors = tuple(priors)
        self._restarts = restarts
        self.restarted: list[Exception] = []
        """Why the estimator was made anew."""
        self._restarted_s = -math.inf
        self._last: Estimate | None = None
        self._since: list[Measurement] = []
        """What was processed after the last estimate."""
        self._gathering: list[Observation] | None = [] if common else None
        self._processed = 0
        self._inbox: queue.SimpleQueue[Sequence[Observation] | None] = queue.SimpleQueue()
        self._outbox: deque[FusedEstimate] = deque()
        self._estimator: Estimator | None = None
        self.failure: Exception | None = None
        """The exception that ended the thread early."""
        self.newest_s = -math.inf
        """Time of the newest processed motion or range."""
        self._abandon = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fusion", daemon=True)
        self._thread.start()

    def submit(self, observations: Sequence[Observation]) -> None:
        """Queue observations; never waits."""
        if observations and self.failure is None:
            self._inbox.put(observations)

    def poll(self) -> list[FusedEstimate]:
        """Return the estimates since the last call."""
        fused = []
        while self._outbox:
            fused.append(self._outbox.popleft())
        return fused

    def finish(self) -> None:
        """Let the thread process the rest and end, without waiting: see :meth:`join`."""
        self._inbox.put(None)

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait until the thread has ended; return whether it has."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def abandon(self) -> None:
        """End the thread at the next observation and drop the rest."""
        self._abandon.set()
        self._inbox.put(None)

    def counters(self) -> Mapping[str, int]:
        """Return the estimator's counters; call once the thread has ended."""
        return {} if self._estimator is None else self._estimator.counters()

    def _run(self) -> None:
        with one_thread():
            self._work()

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
        """Collect what still waits in an estimator that has failed on its input."""
        try:
            self._emit(estimator.finish())
        except RelposError:
            return

    def _gather(self, gathered: list[Observation], observation: Observation) -> None:
        gathered.append(observation)
        if observation.time_s - gathered[0].time_s > GATHER_S:
            self._begin(gathered)

    def _begin(self, gathered: Sequence[Observation]) -> None:
        self._gathering = None
        self._estimator = self._make(common_start(gathered))
        for observation in gathered:
            self._process(observation)

    def _process(self, observation: Observation) -> None:
        assert self._estimator is not None
        self._processed += 1
        if not isinstance(observation, Measurement):
            return
        try:
            estimates = self._estimator.process(observation)
        except Exception as error:
            self._restart(error, observation.time_s)
        else:
            self._since.append(observation)
            self._emit(estimates)
        if isinstance(observation, Motion | Range):
            self.newest_s = max(self.newest_s, observation.time_s)

    def _restart(self, error: Exception, time_s: float) -> None:
        """Make the estimator anew without the measurement that it failed on; else raise."""
        last = self._last
        if not self._restarts or last is None or time_s < self._restarted_s + RESTART_S:
            raise error
        self._restarted_s = time_s
        self._estimator = self._make(known_poses(last))
        for measurement in self._since:
            self._emit(self._estimator.process(measurement))
        self.restarted.append(error)

    def _emit(self, estimates: Sequence[Estimate]) -> None:
        if estimates:
            self._last = estimates[-1]
            self._since = [m for m in self._since if m.time_s > self._last.time_s]
        for estimate in estimates:
            self._outbox.append(FusedEstimate(estimate, self._processed))
