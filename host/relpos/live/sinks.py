"""What a session feeds: whoever shows, keeps or sends on what is received and concluded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from relpos.fusion.estimator import Estimate
    from relpos.live.picture import Picture
    from relpos.measurements import Observation


class Sink(Protocol):
    """Called by the session's receive thread alone, in the order in which things happened.

    Every method is quick: while one works, nothing is received. None raises into the session; what
    goes wrong is told by ``trouble``, which the session shows to everybody as a notice.
    Times are seconds of the session's arrival clock.
    """

    def received(self, arrival_s: float, data: bytes) -> None:
        """Take raw serial bytes, whose last one arrived at ``arrival_s``."""

    def observed(self, arrival_s: float, observations: Sequence[Observation]) -> None:
        """Take what was decoded from bytes, or what phones sent (presses, headings)."""

    def estimated(self, estimate: Estimate) -> None:
        """Take a fused estimate; each comes once, in time order."""

    def pictured(self, picture: Picture) -> None:
        """Take the newest picture, at most twenty a second."""

    def trouble(self) -> str | None:
        """Say what is to be told to the user ("disk full: ..."); None when all is well."""

    def close(self) -> None:
        """End; what was given before is finished."""


class QuietSink:
    """A sink that does nothing: for those that care for some of the calls only."""

    def received(self, arrival_s: float, data: bytes) -> None:
        """Ignore."""

    def observed(self, arrival_s: float, observations: Sequence[Observation]) -> None:
        """Ignore."""

    def estimated(self, estimate: Estimate) -> None:
        """Ignore."""

    def pictured(self, picture: Picture) -> None:
        """Ignore."""

    def trouble(self) -> str | None:
        """All is well."""
        return None

    def close(self) -> None:
        """Nothing to end."""
