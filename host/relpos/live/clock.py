"""The clock that arrivals are stamped with."""

from __future__ import annotations

import time

# Both go on while the computer sleeps, as the nodes' clocks do: Linux's under this name, macOS's
# under the other. Where there is neither, a sleep shows as a jump of all nodes' delays.
_CLOCK = getattr(time, "CLOCK_BOOTTIME", getattr(time, "CLOCK_MONOTONIC", None))


def _read_s() -> float:
    return time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK)


class SessionClock:
    """Seconds since it was made, a computer's sleep included; ``started_unix_s`` is its zero."""

    def __init__(self) -> None:
        self._zero_s = _read_s()
        self.started_unix_s = time.time()

    def __call__(self) -> float:
        """Seconds by now."""
        return _read_s() - self._zero_s
