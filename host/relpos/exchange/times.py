"""Absolute times as text: ISO 8601, and Unix seconds."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from relpos.errors import DataError


def unix_of(text: str, where: str) -> float:
    """Read ISO 8601 with its zone, or Unix seconds; DataError begins with ``where``."""
    try:
        value = float(text)
    except ValueError:
        pass
    else:
        if math.isfinite(value):
            return value
    try:
        time = datetime.fromisoformat(text.strip())
    except ValueError:
        raise DataError(
            f"{where}: {text!r} is no time; write 2026-05-04T09:30:00Z or Unix seconds"
        ) from None
    if time.tzinfo is None:
        raise DataError(f"{where}: {text!r} has no zone; add Z for UTC, or +02:00")
    return time.timestamp()


def iso_of(unix_s: float) -> str:
    """Write a Unix time as ISO 8601 in UTC, to the millisecond."""
    return time_of(unix_s).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def time_of(unix_s: float) -> datetime:
    """Return a Unix time as a datetime in UTC, to the millisecond."""
    return datetime.fromtimestamp(round(unix_s, 3), UTC)
