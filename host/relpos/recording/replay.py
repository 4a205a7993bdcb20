"""A recorded session once more: the same bytes at the same times give the same estimates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from relpos.errors import DataError
from relpos.link.port import Link
from relpos.live.inputs import Received
from relpos.measurements import Observation
from relpos.protocol.messages import PROTOCOL_VERSION
from relpos.recording import topics
from relpos.recording.reader import Recording


@dataclass
class Replay:
    """The inputs of a session in its order, through the link again.

    Without the team's ``key`` (None), where no bytes were recorded, other than this version's, or
    in the middle of a mission, they are what was decoded when it was recorded. ``link`` is None
    then, and ``remarks`` says why.
    """

    recording: Recording
    key: bytes | None
    link: Link | None = field(init=False, default=None)
    remarks: tuple[str, ...] = field(init=False, default=())

    def __post_init__(self) -> None:
        if not self.recording.has_serial:
            return
        if self.key is None:
            self.remarks = (
                f"{self.recording.path}: the team has a key of its own (--key-file): without it "
                "the measurements are those that were decoded when it was recorded",
            )
            return
        about = self.recording.about
        if about is not None and about.protocol not in (0, PROTOCOL_VERSION):
            self.remarks = (
                f"{self.recording.path}: recorded by relpos {about.version} under protocol version "
                f"{about.protocol}, this is {PROTOCOL_VERSION}: the measurements are those that "
                "were decoded when it was recorded",
            )
            return
        if about is not None and about.resumed:
            # Its bytes alone make the first motion of each node all of it since the node's start.
            self.remarks = (
                f"{self.recording.path}: the session went on from one before, or the recording's "
                "beginning is damaged: the measurements are those that were decoded when it was "
                "recorded",
            )
            return
        self.link = Link(key=self.key, newest_counters=about.newest_counters if about else None)

    def __iter__(self) -> Iterator[Received]:
        """Yield what entered the session together; once. DataError where the key does not fit."""
        if self.link is None:
            for arrival_s, row in self.recording.observations_by_arrival():
                yield Received(arrival_s, b"", (row,))
            return
        came = 0
        for arrival_s, entered in self.recording.inputs():
            if isinstance(entered, topics.Serial):
                arrival_s, data = entered.arrival_s, entered.data
                observations = tuple(self.link.feed(data, arrival_s))
                came += len(observations)
                yield Received(arrival_s, data, observations)
            else:
                yield Received(arrival_s, b"", (entered,))
        # Other teams' frames are refused, too: what counts is what was taken when it was recorded.
        if self.link.decoder.counts["FrameTagError"]:
            then = sum(1 for _ in self.recording.observations())
            if came < then / 2:
                raise DataError(
                    f"{self.recording.path}: recorded under another key: give that team's "
                    "--key-file"
                )

    def observations(self) -> tuple[Observation, ...]:
        """All of it at once."""
        return tuple(row for received in self for row in received.observations)

    def counters(self) -> Mapping[str, float]:
        """Counts of the link so far."""
        return {} if self.link is None else self.link.summary()
