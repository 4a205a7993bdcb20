"""Absolute times as text: ISO 8601, and Unix seconds."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from relpos.errors import DataError
from relpos.measurements import BOUNDS

LATEST_UNIX_S = 2**31 - BOUNDS["time_s"][1]
"""Formats count seconds with 32 bits, up to 2038; the longest run ends before that."""

_LIKELY_FROM_S = 1e9
"""September 2001: a number that is a later time in another unit is most likely in that unit."""
_FINER = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


def unix_of(text: str, where: str) -> float:
    """Read ISO 8601 with its zone, or Unix seconds, of a time that every format can hold.

    DataError begins with ``where``.
    """
    try:
        value = float(text)
    except ValueError:
        pass
    else:
        if math.isfinite(value):
            return possible(value, text, where)
    try:
        time = datetime.fromisoformat(text.strip())
    except ValueError:
        raise DataError(
            f"{where}: {text!r} is no time; write 2026-05-04T09:30:00Z or Unix seconds"
        ) from None
    if time.tzinfo is None:
        raise DataError(f"{where}: {text!r} has no zone; add Z for UTC, or +02:00")
    return possible(time.timestamp(), text, where)


def possible(unix_s: float, text: str, where: str) -> float:
    """Return a Unix time; DataError where it is before 1970 or too late for the formats."""
    if 0.0 <= unix_s <= LATEST_UNIX_S:
        return unix_s
    for unit, a_second in _FINER.items():
        if _LIKELY_FROM_S <= unix_s / a_second <= LATEST_UNIX_S:
            raise DataError(
                f"{where}: {text!r} looks like {unit}; Unix time is in seconds: write "
                f"{unix_s / a_second:.3f}"
            )
    raise DataError(f"{where}: {text!r} is not between {iso_of(0.0)} and {iso_of(LATEST_UNIX_S)}")


def iso_of(unix_s: float) -> str:
    """Write a Unix time as ISO 8601 in UTC, to the millisecond."""
    return time_of(unix_s).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def time_of(unix_s: float) -> datetime:
    """Return a Unix time as a datetime in UTC, to the millisecond."""
    return datetime.fromtimestamp(round(unix_s, 3), UTC)
