"""Sinks: everything that shows, records or forwards what a live session receives and estimates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from relpos.fusion.estimator import Estimate
    from relpos.live.team_view import LogEntry, TeamView
    from relpos.live.tracks import Tracks
    from relpos.measurements import Observation


class Sink:
    """Base class whose methods do nothing; a sink overrides those that it needs.

    The session's receive thread alone calls them, in the order in which things happened. Every
    method must be quick, because nothing is received while it works, and must not raise: a sink
    reports an error through ``trouble``, which the session shows as a notice. Times are seconds of
    the session's arrival clock.
    """

    def received(self, arrival_s: float, data: bytes) -> None:
        """Add raw serial bytes, whose last one arrived at ``arrival_s``."""

    def observed(self, arrival_s: float, observations: Sequence[Observation]) -> None:
        """Add observations decoded from bytes, or sent by phones (presses, headings)."""

    def estimated(self, estimate: Estimate) -> None:
        """Add a fused estimate; each comes once, in time order."""

    def updated(self, view: TeamView) -> None:
        """Show the newest view of the team, at most twenty a second."""

    def named(self, names: dict[int, str]) -> None:
        """Note all names that wearers have given their nodes so far."""

    def logged(self, entry: LogEntry) -> None:
        """Add a line to the session's log."""

    def boarded(self, board: dict[str, Any]) -> None:
        """Show the accountability board, which has changed."""

    def timed(self, timeline: dict[str, Any]) -> None:
        """Show where a recording that is played stands."""

    def smoothed(self, tracks: Tracks) -> None:
        """Show where everybody was by the whole recording, once that is known."""

    def resumed(self, tracks: Tracks) -> None:
        """Go on with the tracks of a mission's sessions before."""

    def admitted(self, event: dict[str, Any]) -> None:
        """Note that a device was let in (``id``, ``role``) or shut out (``revoked``)."""

    def trouble(self) -> str | None:
        """Return what the user must know ("disk full: ..."); None when all is well."""
        return None

    def close(self) -> None:
        """Finish and release everything."""
