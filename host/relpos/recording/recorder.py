"""The sink that writes a session to an MCAP file, even on a slow or full disk.

The session only puts things into a queue. A thread of the recorder's own encodes them, closes a
block four times a second and has the disk confirm it. While the disk does not take it (slow, full,
gone) the queue grows up to a bound; beyond that things are left out, estimates first. What is lost
is counted, reported by :meth:`Recorder.trouble` and written into the recording (topic ``/gap``).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Lock, Thread

from relpos.fusion.estimator import Estimate
from relpos.recording import container, topics
from relpos.recording.about import DESCRIPTION, About
from relpos.recording.encoder import Encoder, Item, ItemSink, Line
from relpos.recording.output import NO_ROOM, Disk, Output
from relpos.recording.schemas import all_topics
from relpos.runs.description import description_text
from relpos.said import Said

TICK_S = 0.1
BLOCK_S = 0.25
"""A block is closed that often: a tick more is at stake, and most of a second is left for a
computer that is too busy to let us."""
BLOCK_BYTES = 1 << 20
RETRY_S = 0.5
LATE_S = 3.0
"""A disk that confirms nothing for so long is reported."""
CLOSE_WITHIN_S = 10.0
"""Longest wait at the end of a session for a disk that accepts nothing."""


@dataclass(frozen=True)
class Bounds:
    """Bounds of what waits for the disk, in bytes of memory, roughly.

    ``inputs``: of everything; a team of 20 fills it in an hour. ``others``: beyond it estimates are
    left out, which a replay gives again; a few minutes.
    """

    inputs: int = 96 << 20
    others: int = 32 << 20


@dataclass(frozen=True)
class _Names:
    """New names of the wearers."""

    names: Mapping[int, str]


class Recorder(ItemSink):
    """Writes a session to ``path``: a sink of the live session; see the module.

    DataError where the file exists already or cannot be made.
    """

    def __init__(
        self,
        path: Path | str,
        about: About,
        *,
        disk: Disk | None = None,
        bounds: Bounds | None = None,
    ) -> None:
        super().__init__()
        self._about = about
        self._bounds = bounds or Bounds()
        self._encoder = Encoder(about.started_unix_ns, about.description.names)
        self._topics = all_topics()
        self._block = container.Block(container.numbered(self._topics))
        self._looked_s = self._block_began_s = time.monotonic()
        self._queue: deque[tuple[int, float, Item | _Names]] = deque()
        self._lock = Lock()
        self._queued = 0
        self._gap: topics.Gap | None = None
        self.lost = (0, 0)
        """Numbers of lost inputs and of lost estimates."""
        self._refused_since_s: float | None = None
        self._retry_s = 0.0
        # The first of everything takes a while in Python, and here nothing is late.
        self._encoder.rehearse()
        self._output = Output(Path(path), self._beginning, disk or Disk())
        self._stop = Event()
        self._thread = Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    # -- what a session calls: quick, and never an error ------------------------------------------

    def named(self, names: Mapping[int, str]) -> None:
        """Add the names of the wearers."""
        self._put(self._arrival_s, _Names(dict(names)))

    @property
    def path(self) -> Path:
        """The file that is being written."""
        return self._output.path

    def close(self) -> None:
        """Write what waits and close the file; gives up on a disk that takes nothing."""
        self._stop.set()
        self._thread.join()

    def _put(self, at_s: float, item: Item | _Names) -> None:
        is_input = not isinstance(item, Estimate)
        weight, bound = _weight(item), self._bounds.inputs if is_input else self._bounds.others
        with self._lock:
            if self._queued + weight > bound:
                gap = self._gap or topics.Gap(at_s, at_s, 0, 0)
                self._gap = topics.Gap(
                    gap.from_s, at_s, gap.inputs + is_input, gap.others + (not is_input)
                )
                self.lost = (self.lost[0] + is_input, self.lost[1] + (not is_input))
                return
            self._queued += weight
            self._queue.append((weight, at_s, item))

    # -- the recorder's thread --------------------------------------------------------------------

    def _beginning(self, part: int) -> bytes:
        return container.beginning(replace(self._about, part=part).metadata(), self._topics)

    def _run(self) -> None:
        give_up_s: float | None = None
        while True:
            if self._stop.wait(TICK_S if give_up_s is None else 0.0):
                if give_up_s is None:
                    give_up_s = time.monotonic() + CLOSE_WITHIN_S
                else:
                    time.sleep(TICK_S)
            try:
                done = self._work(closing=give_up_s is not None)
            except Exception as error:
                # A fault of ours must neither end the session nor go unseen.
                self._trouble = Said(
                    "recording-failed",
                    "{file}: recording has failed: {error}",
                    file=str(self.path),
                    error=repr(error),
                )
                break
            if give_up_s is not None and (done or time.monotonic() > give_up_s):
                break
        left_s = CLOSE_WITHIN_S if give_up_s is None else max(give_up_s - time.monotonic(), 1.0)
        self._end(left_s)

    def _end(self, left_s: float) -> None:
        closed = self._output.close(left_s)
        with self._lock:
            left = len(self._queue)
            self._bounds = Bounds(0, 0)
        if left or self._output.waiting:
            self._trouble = Said(
                "recording-end",
                "{trouble}; the end of the session is not recorded: {count} reads and estimates, "
                "and what came in the moment before",
                trouble=self._trouble or str(self.path),
                count=left,
            )
        elif not closed and self._trouble is None:
            self._trouble = Said(
                "recording-summary",
                "{file}: no room for the summary that viewers seek by, or the disk did not "
                "confirm it; everything else is in there, and `relpos convert` makes it whole",
                file=str(self.path),
            )

    def _work(self, *, closing: bool) -> bool:
        """Encode and write what there is; whether nothing waits any more."""
        looked_s, self._looked_s = self._looked_s, time.monotonic()
        if not len(self._block):
            # What is in the queue may have waited there since the last look.
            self._block_began_s = looked_s
        while True:
            if self._output.waiting and (not self._flushed() or self._output.waiting):
                return False
            while self._queue and len(self._block) < BLOCK_BYTES and not self._output.waiting:
                self._encode_next()
            if not self._queue:
                self._encode_gap()
            full = len(self._block) >= BLOCK_BYTES
            old = time.monotonic() - self._block_began_s >= BLOCK_S
            if len(self._block) and (full or old or closing):
                self._output.put(self._block.pop())
                self._block_began_s = time.monotonic()
            if not self._output.waiting and not self._queue:
                return True

    def _flushed(self) -> bool:
        """Flush waiting blocks to the disk; report the reason where it refuses."""
        now_s = time.monotonic()
        if self._refused_since_s is not None and now_s < self._retry_s:
            return False
        part = self._output.part
        try:
            self._output.flush()
        except OSError as error:
            self._retry_s = now_s + RETRY_S
            if self._refused_since_s is None:
                self._refused_since_s = now_s
            self._report(error, now_s - self._refused_since_s)
            return False
        if self._output.part != part:
            self.log("warning", f"the recording goes on in {self._output.path.name}")
        if self._refused_since_s is not None:
            waited_s = now_s - self._refused_since_s
            self._refused_since_s = None
            self.log("info", f"the disk takes the recording again after {waited_s:.0f} s")
        late_s = self._output.late_s()
        late = Said(
            "disk-late",
            "the disk has not confirmed the recording {file} for {seconds:.0f} s: a power failure "
            "now would lose as much",
            file=str(self.path),
            seconds=late_s,
        )
        self._trouble = late if late_s > LATE_S else None
        return True

    def _report(self, error: OSError, since_s: float) -> None:
        reason = error.strerror or str(error)
        inputs, others = self.lost
        lost = Said(
            "recording-lost",
            "{inputs} reads of the port and {others} estimates are lost",
            inputs=inputs,
            others=others,
        )
        self._trouble = Said(
            "recording-waits",
            "{reason}: the recording {file} waits for room since {seconds:.0f} s; {lost}",
            reason=Said("disk-full", "disk full") if error.errno in NO_ROOM else reason,
            file=str(self.path),
            seconds=since_s,
            lost=lost if inputs or others else Said("nothing-lost", "nothing is lost yet"),
        )

    def _encode_next(self) -> None:
        weight, at_s, item = self._queue.popleft()
        with self._lock:
            self._queued -= weight
        if isinstance(item, _Names):
            self._rename(item.names)
        else:
            self._add(at_s, item)

    def _encode_gap(self) -> None:
        with self._lock:
            gap, self._gap = self._gap, None
        if gap is None:
            return
        self._add(gap.to_s, gap)
        words = (
            f"not recorded between {gap.from_s:.1f} s and {gap.to_s:.1f} s: "
            f"{gap.inputs} reads of the port, {gap.others} estimates"
        )
        self._add(gap.to_s, Line("warning", words))

    def _add(self, at_s: float, item: Item) -> None:
        for message in self._encoder.messages(at_s, item):
            self._block.add(message)

    def _rename(self, names: Mapping[int, str]) -> None:
        """Write names as metadata between two blocks, where the newest counts."""
        if len(self._block):
            self._output.put(self._block.pop())
        description = self._about.description.with_names(names)
        self._about = replace(self._about, description=description)
        self._encoder.rename(description.names)
        text = {"text": description_text(description)}
        self._output.put(container.metadata_record(DESCRIPTION, text))


def _weight(item: Item | _Names) -> int:
    """Return how much memory an item takes, roughly (bytes)."""
    match item:
        case topics.Serial():
            return 200 + len(item.data)
        case Estimate():
            rows = len(item.nodes) + len(item.pairs) + len(item.alternatives)
            return 400 * (rows + len(item.parameters))
        case Line():
            return 200 + len(item.text)
        case _Names():
            return 200 * len(item.names)
        case topics.Gap():
            return 200
        case _:
            return 300 * len(item)
