"""Late and out-of-order measurements are used at their own time: rewind and replay.

Over radio a report may come seconds late, and the estimate cannot wait for it. So the estimator
continues without it (a node that is silent for ``Timeline.max_lag_s`` is not waited for), keeps
copies of its whole state over the last ``window_s``, and when a late measurement arrives, it
restores the state before its time and processes everything since again, in order. Afterwards the
state is, to the last bit, the one that sorted data would have given: the copies contain the random
generator, and measurements of one instant have a fixed order.

A displacement is late, too, where steps behind the *beginning* of its chord have been released:
the node was assumed to stand there.

One call of ``process`` replays at most ``most_s`` of processor time, as the core estimates the cost
of its steps; the rest is replayed in the next calls, and estimates pause for so long. Costs are
estimated and not measured, so that the same measurements in the same order always give the same
estimates.

The cost is bounded: a burst of late reports is replayed once, at most one every ``every_s`` of
measurement time, and no rewind goes back farther than ``window_s``, one report (``max_lag_s``) and
one spacing of the copies. Counters: ``rewinds``, the repeated steps (``rewound_steps``), and what
came later than the window (the timeline's ``ranges_late`` and ``motions_late``;
``motions_beyond_window`` whose chord began before it).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import chain
from typing import Protocol

from relpos.fusion.clocks import Clocks
from relpos.fusion.estimator import Estimate
from relpos.fusion.timeline import Epoch, Step, Timeline, refusal
from relpos.measurements import Measurement


class Core(Protocol):
    """The filter behind a timeline: steps in, estimates out.

    A :class:`Rewinder` copies it with ``copy.deepcopy``, its random generators and counters
    included, and may continue from the copy. So a core owns all that it changes.
    """

    @property
    def shared(self) -> tuple[object, ...]:
        """Objects that the core never changes, so that its copies refer to the same ones."""

    @property
    def clocks(self) -> Clocks | None:
        """What the core has learned of time stamps; None where it learns nothing of them."""

    def update(self, step: Step, timeline: Timeline) -> Estimate | None:
        """Process one step that ``timeline`` has released; an estimate at the end of an epoch."""

    def cost_s(self, step: Step) -> float:
        """Return about how many seconds of a processor ``update`` needs for a step."""

    def check_run(self, counters: Mapping[str, int]) -> None:
        """Raise RelposError if the whole run was unfit; ``counters`` are the timeline's."""

    def counters(self) -> Counter[str]:
        """Name -> how often: everything rejected, clamped, reset or resampled."""


@dataclass(slots=True)
class _Copy:
    """The state after everything up to ``frontier_s``; it has seen ``pushed`` measurements."""

    frontier_s: float
    timeline: Timeline
    core: Core
    pushed: int


@dataclass(slots=True)
class Rewinder:
    """The estimator around ``core`` and ``timeline``; it yields one estimate for each epoch.

    ``window_s`` is how late a measurement may be, ``spacing_s`` how far apart copies are,
    ``every_s`` how often it may rewind, ``most_s`` how much a call replays. A replay does not
    repeat estimates that were returned already; times of estimates always increase.
    """

    core: Core
    timeline: Timeline
    window_s: float = 5.0
    spacing_s: float = 5.0
    every_s: float = 0.25
    most_s: float = 0.02
    _own: Counter[str] = field(default_factory=Counter)
    _copies: list[_Copy] = field(default_factory=list)
    _history: list[Measurement] = field(default_factory=list)
    """What came since the oldest copy, in the order of arrival and by its own time stamps."""
    _forgotten: int = 0
    """Measurements before ``_history``."""
    _newest_s: float = -math.inf
    _emitted_s: float = -math.inf
    _back_to_s: float = math.inf
    _rewound_s: float = -math.inf
    _rest: Iterator[Step] | None = None
    """Steps that the last call left."""
    _replaying: bool = False

    def __post_init__(self) -> None:
        self.timeline.keep_late = True

    def process(self, measurement: Measurement) -> list[Estimate]:
        """Add one measurement; return the estimates it completes."""
        reason = refusal(measurement)
        if reason is not None:
            self._own[reason] += 1
            return []
        if not self._copies:
            self._copy()
        self._history.append(measurement)
        measurement = self._redated(measurement)
        news = measurement.time_s > self._newest_s
        if news:
            self._newest_s = measurement.time_s
        timeline = self.timeline
        certain = timeline.take_in(measurement)
        if timeline.late:
            self._note_late()
        if self._back_to_s == math.inf:
            if not certain and self._rest is None:
                return []
            # What is left goes on with what has been sorted in since.
            return list(self._work_off(self._rest or timeline.push_all(())))
        # Until it has gone back, the timeline only sorts in. A burst of late measurements is
        # replayed at once, when the next new measurement comes.
        if news and self._newest_s >= self._rewound_s + self.every_s:
            return list(self._rewind(final=False))
        return []

    def finish(self) -> list[Estimate]:
        """Process everything that still waits; RelposError if the run was unfit."""
        steps = self.timeline.push_all((), final=True)
        self._note_late()
        if self._copies and self._back_to_s < math.inf:
            estimates = list(self._rewind(final=True))
        else:
            estimates = list(self._work_off(chain(self._rest or (), steps), math.inf))
        self.core.check_run(self.timeline.counters + self._own)
        return estimates

    def counters(self) -> Counter[str]:
        """Count everything refused, late or repeated, and what the core counts."""
        return self.timeline.counters + self._own + self.core.counters()

    def _redated(self, measurement: Measurement) -> Measurement:
        clocks = self.core.clocks
        return measurement if clocks is None else clocks.redate(measurement)

    def _hold(self, *, replaying: bool) -> None:
        self._replaying = replaying
        if self.core.clocks is not None:
            self.core.clocks.held = replaying

    def _note_late(self) -> None:
        """Find out whether to go back, and to what time."""
        for late in self.timeline.late:
            oldest_s = self._copies[0].frontier_s
            if late.time_s <= oldest_s:
                continue  # too late for all of it
            if late.since_s < oldest_s:
                self._own["motions_beyond_window"] += 1
            self._back_to_s = min(self._back_to_s, max(late.since_s, oldest_s))
        self.timeline.late.clear()

    def _rewind(self, *, final: bool) -> Iterator[Estimate]:
        """Go back to the newest copy at or before ``_back_to_s`` and work off all since."""
        while len(self._copies) > 1 and self._copies[-1].frontier_s > self._back_to_s:
            self._copies.pop()
        copy = self._copies[-1]
        self._back_to_s = math.inf
        self._rewound_s = self._newest_s
        self._own["rewinds"] += 1
        self.timeline = copy.timeline.snapshot()
        self.core = self._copy_of(copy.core)
        # With the clocks of that time, which are held until all of this is worked off.
        since = [self._redated(m) for m in self._history[copy.pushed - self._forgotten :]]
        steps = self.timeline.push_all(since, final=final)
        self.timeline.late.clear()  # behind the copy as well
        self._hold(replaying=True)
        yield from self._work_off(steps, math.inf if final else self.most_s)

    def _work_off(self, steps: Iterator[Step], most_s: float | None = None) -> Iterator[Estimate]:
        core, timeline = self.core, self.timeline
        left_s = self.most_s if most_s is None else most_s
        self._rest = steps
        for step in steps:
            left_s -= core.cost_s(step)
            if self._replaying:
                self._own["rewound_steps"] += 1
            estimate = core.update(step, timeline)
            if estimate is not None and estimate.time_s > self._emitted_s:
                self._emitted_s = estimate.time_s
                yield estimate
            if isinstance(step, Epoch):
                self._copy_if_due()
            if left_s < 0.0:
                return
        self._rest = None
        self._hold(replaying=False)
        # Without motion there are no epochs, but what is kept has to be bounded all the same.
        self._copy_if_due(overdue_s=self.spacing_s)

    def _copy_if_due(self, overdue_s: float = 0.0) -> None:
        frontier_s = self.timeline.frontier_s
        if frontier_s == -math.inf:  # nothing was handed out yet: there is nothing to go back to
            return
        if self._copies and frontier_s >= self._copies[-1].frontier_s + self.spacing_s + overdue_s:
            self._copy()

    def _copy(self) -> None:
        pushed = self._forgotten + len(self._history)
        self._copies.append(
            _Copy(
                self.timeline.frontier_s, self.timeline.snapshot(), self._copy_of(self.core), pushed
            )
        )
        # What is late by the window may belong to a chord that began a report earlier.
        horizon_s = self._newest_s - self.window_s - self.timeline.max_lag_s
        while len(self._copies) > 1 and self._copies[1].frontier_s < horizon_s:
            del self._copies[0]
        old = self._copies[0].pushed - self._forgotten
        if old > 0:
            del self._history[:old]
            self._forgotten += old

    @staticmethod
    def _copy_of(core: Core) -> Core:
        return deepcopy(core, {id(one): one for one in core.shared})
