"""Requests of browsers, phones and terminal keys, and the observations that they become.

A phone's clock is its own. A request carries the server's lead over it (``clock_offset_ms``) and
what it read when the request was sent. The Unix time of a press on the server's clock is therefore
the phone's time plus the offset. Where that contradicts the time of arrival (a clock was set
meanwhile), the age of the press on the phone's clock when it was sent counts instead.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from relpos.measurements import Event, Heading, Observation, out_of_bounds
from relpos.said import Said

EARLY_S = 1.0
LATE_S = 60.0
"""A request arrives at most this long before (misjudged clocks) and after (a slow network) the
time at which it was sent by the offset; otherwise the offset is wrong."""
MAX_ACCEPTED = 100_000
RECORDED = Said("recorded", "this is a recording: it takes no presses or headings")
AT_LANDMARK = Said("landmark", "{name} is at landmark {landmark}", name="", landmark="")


@dataclass(frozen=True, slots=True)
class Request:
    """A request that arrived at ``unix_s``; kinds and bodies as in the page's HTTP interface."""

    id: int
    kind: str
    unix_s: float
    body: dict[str, Any]


@runtime_checkable
class RequestSource(Protocol):
    """Where requests come from: the page's server, the keys of a terminal."""

    def requests(self) -> Sequence[Request]:
        """Return the requests since the last call; never waits."""

    def respond(self, request: Request, reply: dict[str, Any], status: int = 200) -> None:
        """Answer one of them."""


class RequestHandler:
    """Turns requests into observations; the same press or heading counts once, however often sent.

    ``session_s`` converts a Unix time of the server's clock to the session's time.
    """

    def __init__(self, session_s: Callable[[float], float]) -> None:
        self._session_s = session_s
        self._accepted: dict[str, None] = {}
        """The newest ids, the oldest first."""
        self._headings: dict[tuple[Any, ...], None] = {}
        """The newest headings, likewise."""
        self.names: dict[int, str] = {}
        self.counts: Counter[str] = Counter()
        """What was refused, and what failed, by name."""

    def accept(self, ids: Sequence[str]) -> None:
        """Note presses that a session before has accepted."""
        self._accepted.update(dict.fromkeys(ids))

    def presses(self, request: Request) -> tuple[dict[str, Any], list[Observation]]:
        """Return the reply and the presses that are new."""
        new: list[Observation] = []
        for press in request.body["presses"]:
            if not _is_new(self._accepted, press["id"]):
                continue
            time_s = self._time_s(request, press["unix_ms"])
            new.append(Event(time_s, request.body["node"], "landmark", press["landmark"]))
        new = self._believable("presses", new)
        # Those that are dropped, too: sent again, they would be no better.
        return {"accepted": [press["id"] for press in request.body["presses"]]}, new

    def headings(self, request: Request) -> tuple[dict[str, Any], list[Observation]]:
        """Return the reply and the headings."""
        new: list[Observation] = [
            Heading(
                self._time_s(request, row["unix_ms"]),
                request.body["node"],
                row["heading_rad"],
                row["sigma_rad"],
                "phone",
            )
            for row in request.body["headings"]
            if _is_new(self._headings, (request.body["node"], *row.values()))
        ]
        new = self._believable("headings", new)
        return {"accepted": len(new)}, new

    def _believable(self, kind: str, rows: Sequence[Observation]) -> list[Observation]:
        """Return the rows within bounds; count the others."""
        good = [row for row in rows if out_of_bounds(row) is None]
        if len(good) < len(rows):
            self.counts[f"{kind}_beyond_bounds"] += len(rows) - len(good)
        return good

    def _time_s(self, request: Request, unix_ms: float) -> float:
        sent_ms, offset_ms = request.body["sent_unix_ms"], request.body["clock_offset_ms"]
        server_s = (unix_ms + offset_ms) * 1e-3
        if sent_ms is not None:
            transit_s = request.unix_s - (sent_ms + offset_ms) * 1e-3
            if not -EARLY_S <= transit_s <= LATE_S:
                server_s = request.unix_s - (sent_ms - unix_ms) * 1e-3
        # Nothing happens after it was reported.
        return self._session_s(min(server_s, request.unix_s))


def _is_new(known: dict[Any, None], key: Any) -> bool:
    """Note a key; False where it was known."""
    if key in known:
        return False
    if len(known) >= MAX_ACCEPTED:
        del known[next(iter(known))]
    known[key] = None
    return True
