"""The clock of arrival times."""

from __future__ import annotations

import time

# Both count on while the computer sleeps, as the nodes' clocks do: CLOCK_BOOTTIME on Linux,
# CLOCK_MONOTONIC on macOS. Without either, a sleep shows as a jump of all nodes' delays.
_CLOCK = getattr(time, "CLOCK_BOOTTIME", getattr(time, "CLOCK_MONOTONIC", None))


def _read_s() -> float:
    return time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK)


class SessionClock:
    """Seconds since ``started_unix_s``, or its creation, sleep included."""

    def __init__(self, started_unix_s: float | None = None) -> None:
        self.started_unix_s = time.time() if started_unix_s is None else started_unix_s
        self._zero_s = _read_s() - (time.time() - self.started_unix_s)

    def __call__(self) -> float:
        """Return the seconds since then."""
        return _read_s() - self._zero_s
