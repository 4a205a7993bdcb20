"""Past positions of all people, thinned so that hours of them stay small."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from typing import Any

from relpos.live.team_view import to_json

MAX_POINTS = 2000
FIRST_SPACING_S = 0.5


class Tracks:
    """Points (time_s, x_m, y_m) of each node, at most :data:`MAX_POINTS`.

    A full track drops every second point and doubles its spacing, so that its points stay evenly
    apart in time.
    """

    def __init__(self) -> None:
        # Flat, three numbers a point: a sixth of the memory that tuples take.
        self._points: dict[int, array[float]] = {}
        self._spacing_s: dict[int, float] = {}

    def add(self, node: int, time_s: float, x_m: float, y_m: float) -> bool:
        """Add a point unless one is as close in time; return whether it was added."""
        points = self._points.setdefault(node, array("d"))
        spacing_s = self._spacing_s.get(node, FIRST_SPACING_S)
        if points and time_s < points[-3] + spacing_s:
            return False
        points.extend((round(time_s, 2), round(x_m, 2), round(y_m, 2)))
        if len(points) > 3 * MAX_POINTS:
            kept = array("d")
            for k in range(0, len(points), 6):
                kept.extend(points[k : k + 3])
            self._points[node] = kept
            self._spacing_s[node] = 2.0 * spacing_s
        return True

    def of(self, node: int) -> list[tuple[float, float, float]]:
        """Return the node's points by time."""
        points = self._points.get(node, array("d"))
        return list(zip(points[::3], points[1::3], points[2::3], strict=True))

    def to_json(self, kind: str = "tracks") -> str:
        """Return the message ``tracks``, or ``smoothed``, of the page's protocol."""
        tracks = {str(node): self.of(node) for node in sorted(self._points)}
        return to_json({"type": kind, "tracks": tracks})

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Tracks:
        """Restore the tracks of a ``tracks`` message."""
        tracks = cls()
        for node, points in message["tracks"].items():
            tracks._points[int(node)] = array("d", (value for point in points for value in point))
            if len(points) > 2:
                mean_s = (points[-1][0] - points[0][0]) / (len(points) - 1)
                tracks._spacing_s[int(node)] = max(FIRST_SPACING_S, 0.75 * mean_s)
        return tracks
