"""Items of a session become messages: the same for a file and for Foxglove's viewer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus, PairEstimate
from relpos.live.sinks import Sink
from relpos.live.team_view import TeamView
from relpos.measurements import (
    Event,
    Heading,
    Height,
    Motion,
    Observation,
    Range,
    Status,
    Step,
)
from relpos.recording import topics
from relpos.recording.scene import Scene, log_message


@dataclass(frozen=True, slots=True)
class Line:
    """A line for the log; ``level`` is info, warning or alarm."""

    level: str
    text: str


Item = topics.Serial | topics.Gap | Line | Estimate | Sequence[Observation]


class Encoder:
    """Turns items into messages; ``names``: node -> what its wearer is called."""

    def __init__(self, started_unix_ns: int, names: Mapping[int, str]) -> None:
        self._started_unix_ns = started_unix_ns
        self._scene = Scene(started_unix_ns, dict(names))

    def rename(self, names: Mapping[int, str]) -> None:
        """Use these names from now on."""
        self._scene.names = dict(names)

    def rehearse(self) -> None:
        """Encode one item of each kind, because the first takes longest."""
        node = NodeEstimate(1, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, NodeStatus.OK)
        items: list[Item] = [
            topics.Serial(0.0, b""),
            topics.Gap(0.0, 0.0, 0, 0),
            Line("info", ""),
            (Motion(0.0, 1, 0.0, 0.0, 0.0), Height(0.0, 1, 0.0), Heading(0.0, 1, 0.0)),
            (Status(0.0, 1, "", 0.0), Event(0.0, 1, "", ""), Step(0.0, 1, 0.0)),
            Estimate(0.0, (node,), (PairEstimate(1, 2, 1.0, 1.0, 1.0, 1.0),)),
        ]
        stranger = Encoder(self._started_unix_ns, {})
        for item in items:
            for _ in stranger.messages(0.0, item):
                pass

    def messages(self, at_s: float, item: Item) -> Iterator[topics.Message]:
        """Messages of an item that the session had at ``at_s``."""
        match item:
            case topics.Serial():
                yield self._message(topics.SERIAL, at_s, at_s, topics.encode_serial(item))
            case topics.Gap():
                topic, data = topics.encode_row(item)
                yield self._message(topic, at_s, item.from_s, data)
            case Line():
                unix_ns = self._unix_ns(at_s)
                data = log_message(unix_ns, item.level, item.text)
                yield topics.Message(topics.LOG, unix_ns, unix_ns, data)
            case Estimate():
                for topic, data in (*topics.encode_estimate(item), *self._scene.draw(item)):
                    yield self._message(topic, at_s, item.time_s, data)
            case _:
                for observation in item:
                    if isinstance(observation, Range):
                        self._scene.range(observation)
                    topic, data = topics.encode_row(observation)
                    # A landmark has no time.
                    of_s = getattr(observation, "time_s", at_s)
                    yield self._message(topic, at_s, of_s, data)

    def _message(self, topic: str, at_s: float, of_s: float, data: bytes) -> topics.Message:
        return topics.Message(topic, self._unix_ns(at_s), self._unix_ns(of_s), data)

    def _unix_ns(self, time_s: float) -> int:
        return max(self._started_unix_ns + round(time_s * 1e9), 0)


class ItemSink(Sink):
    """A sink of the live session that turns every call into an item of its queue.

    ``_put`` must be quick and must not raise, because a session calls it while it receives.
    """

    def __init__(self) -> None:
        self._arrival_s = 0.0
        self._notices: dict[str, str] = {}
        self._trouble: str | None = None

    def received(self, arrival_s: float, data: bytes) -> None:
        """Add bytes of the serial port, as they were read."""
        self._arrival_s = arrival_s
        self._put(arrival_s, topics.Serial(arrival_s, bytes(data)))

    def observed(self, arrival_s: float, observations: Sequence[Observation]) -> None:
        """Add decoded observations, and those that phones sent."""
        self._arrival_s = max(arrival_s, self._arrival_s)
        if observations:
            self._put(arrival_s, tuple(observations))

    def estimated(self, estimate: Estimate) -> None:
        """Add an estimate."""
        self._put(self._arrival_s, estimate)

    def updated(self, view: TeamView) -> None:
        """Add new notices to the log."""
        for notice in view.notices:
            if self._notices.get(notice.id) != notice.text:
                self._notices[notice.id] = notice.text
                self.log(str(notice.level), notice.text)

    def log(self, level: str, text: str) -> None:
        """Add a line to the log; ``level`` is info, warning or alarm."""
        self._put(self._arrival_s, Line(level, text))

    def trouble(self) -> str | None:
        """Return what is wrong at present; None when all is well."""
        return self._trouble

    def _put(self, at_s: float, item: Item) -> None:
        """Queue an item that the session had at ``at_s``."""
        raise NotImplementedError
