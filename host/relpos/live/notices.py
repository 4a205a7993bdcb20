"""The notices of a session: what every user must know, some of it for a while only."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from relpos.live.team_view import Level, Notice

REMARK_S = 60.0
"""How long a remark, which has no end of its own, stays on the page."""


class NoticeBoard:
    """Notices by name; ``now_s`` is the session's time."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._notices: dict[str, Notice] = {}
        self._expiring: dict[str, float] = {}
        self._remarks = 0

    def all(self) -> Iterable[Notice]:
        """Return the notices in force, the oldest first."""
        return self._notices.values()

    def post(self, name: str, level: Level, text: str | None) -> bool:
        """Set a notice, or clear it where ``text`` is None; return whether one came or went."""
        before = self._notices.get(name)
        if text is None:
            return self._notices.pop(name, None) is not None
        since_s = self._now_s() if before is None else before.since_s
        if before is None or before.text != text:
            self._notices[name] = Notice(name, level, text, since_s)
        return before is None

    def post_remark(self, text: str) -> None:
        """Set a notice of its own for :data:`REMARK_S`."""
        self._remarks += 1
        name = f"remark-{self._remarks}"
        self.post(name, Level.INFO, text)
        self.expire(name)

    def expire(self, name: str) -> None:
        """Clear the notice after :data:`REMARK_S` from now."""
        self._expiring[name] = self._now_s() + REMARK_S

    def drop_expired(self, now_s: float) -> None:
        """Clear the notices whose time is over."""
        for name, until_s in list(self._expiring.items()):
            if now_s > until_s:
                del self._expiring[name]
                self._notices.pop(name, None)
