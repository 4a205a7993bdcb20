"""What browsers and phones ask of a session, and what becomes of it.

A phone's clock is its own. It tells how far the server's is ahead of it (``clock_offset_ms``), and
what it read when it sent. A press therefore happened, on the server's Unix clock, at its own time
plus the offset; where that contradicts the moment at which it arrived (a clock was set meanwhile),
its age on the phone's clock when it was sent counts instead.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from relpos.measurements import Event, Heading, Observation

EARLY_S = 1.0
LATE_S = 60.0
"""A request arrives at most so long before (clocks misjudged) and after (a slow network) it is
sent by the offset; else the offset is wrong."""
MOST_ACCEPTED = 100_000


@dataclass(frozen=True, slots=True)
class Ask:
    """A request that arrived at ``unix_s``; kinds and bodies as in the page's HTTP interface."""

    id: int
    kind: str
    unix_s: float
    body: dict[str, Any]


@runtime_checkable
class Visitors(Protocol):
    """Where requests come from: the page's server, the keys of a terminal."""

    def asks(self) -> Sequence[Ask]:
        """Requests since the last call; never waits."""

    def answer(self, ask: Ask, reply: dict[str, Any], status: int = 200) -> None:
        """Answer one."""


class Desk:
    """Turns requests into observations; the same press counts once, however often it is sent.

    ``session_s`` gives the session's time of a Unix time of the server's clock now.
    """

    def __init__(self, session_s: Callable[[float], float]) -> None:
        self._session_s = session_s
        self._accepted: set[str] = set()
        self.names: dict[int, str] = {}

    def presses(self, ask: Ask) -> tuple[dict[str, Any], list[Observation]]:
        """Answer, and the presses that are new."""
        new: list[Observation] = []
        for press in ask.body["presses"]:
            if press["id"] in self._accepted:
                continue
            if len(self._accepted) < MOST_ACCEPTED:
                self._accepted.add(press["id"])
            time_s = self._time_s(ask, press["unix_ms"])
            new.append(Event(time_s, ask.body["node"], "landmark", press["landmark"]))
        return {"accepted": [press["id"] for press in ask.body["presses"]]}, new

    def headings(self, ask: Ask) -> tuple[dict[str, Any], list[Observation]]:
        """Answer, and the headings."""
        new: list[Observation] = [
            Heading(
                self._time_s(ask, row["unix_ms"]),
                ask.body["node"],
                row["heading_rad"],
                row["sigma_rad"],
                "phone",
            )
            for row in ask.body["headings"]
        ]
        return {"accepted": len(new)}, new

    def _time_s(self, ask: Ask, unix_ms: float) -> float:
        sent_ms, offset_ms = ask.body["sent_unix_ms"], ask.body["clock_offset_ms"]
        server_s = (unix_ms + offset_ms) * 1e-3
        if sent_ms is not None:
            under_way_s = ask.unix_s - (sent_ms + offset_ms) * 1e-3
            if not -EARLY_S <= under_way_s <= LATE_S:
                server_s = ask.unix_s - (sent_ms - unix_ms) * 1e-3
        # Nothing happens after it was told.
        return self._session_s(min(server_s, ask.unix_s))
